"""Pieces of work in threads: in order, with their errors, and once where they share something."""

from __future__ import annotations

import os
import time
from threading import Barrier, get_ident

import pytest

from lusee_bayes.core.engine import in_threads, once


def test_results_come_in_the_order_of_the_items():
    def late(k: int) -> int:
        time.sleep(0.002 * (7 - k))
        return k * k

    assert in_threads(late, range(8)) == [k * k for k in range(8)]
    assert in_threads(late, []) == []


@pytest.mark.skipif((os.cpu_count() or 1) < 2, reason="one processor")
def test_pieces_run_side_by_side():
    """Two that wait for each other end only if both have begun."""
    meeting = Barrier(2, timeout=30)

    def meet(_: int) -> int:
        meeting.wait()
        return get_ident()

    assert len(set(in_threads(meet, range(2)))) == 2


def test_an_error_is_the_callers():
    def fail(k: int) -> None:
        if k == 3:
            raise ValueError("the third")

    with pytest.raises(ValueError, match="the third"):
        in_threads(fail, range(6))


def test_what_is_shared_is_computed_once():
    class Shared:
        count = 0

        @once
        def value(self) -> int:
            time.sleep(0.01)
            Shared.count += 1
            return 42

    shared = Shared()
    assert in_threads(lambda _: shared.value, range(6)) == [42] * 6
    assert Shared.count == 1
