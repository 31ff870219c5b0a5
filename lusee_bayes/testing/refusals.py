"""Bad input has to be refused."""

from __future__ import annotations

from collections.abc import Callable

from lusee_bayes.core.errors import InputError

# relative error that sums of a few thousand terms may make
ROUNDING = 1e-12


def assert_refused(call: Callable[[], object]) -> None:
    """Assert that a call raises InputError with one sentence, on one line."""
    try:
        call()
    except InputError as error:
        message = str(error)
        assert message
        assert "\n" not in message
    else:
        raise AssertionError("expected an InputError")
