"""What has been tried, and what came of it."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable

from lusee_bayes.core.errors import InputError

TRIED: Counter[str] = Counter()
# how many times as many inputs the long run tries
SCALE = int(os.environ.get("LUSEE_BAYES_FUZZ", "1"))


def require_answer(what: str, call: Callable[[], object]) -> None:
    """Assert that a call succeeds, or says in one sentence why it cannot; anything else fails."""
    try:
        call()
    except InputError as error:
        message = str(error)
        assert message and "\n" not in message, repr(message)
        # sentences are read by people
        assert len(message) < 1500, message
        TRIED[f"{what}: refused"] += 1
    else:
        TRIED[f"{what}: accepted"] += 1
