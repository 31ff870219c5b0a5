"""Independent pieces of work in as many threads as there are processors.

NumPy and LAPACK (:mod:`.lapack`) let other threads go on while they compute. A thread with one
processor of its own does more than two that share both for every product of matrices.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import cached_property
from threading import RLock
from typing import Any, TypeVar

from threadpoolctl import threadpool_limits

# each has its own memory to work in
MOST = 8

T = TypeVar("T")
R = TypeVar("R")


def processors() -> int:
    """How many processors this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def in_threads(function: Callable[[T], R], items: Sequence[T]) -> list[R]:
    """Call a function with every item; what it gives, in their order.

    Parameters
    ----------
    function : callable
        Safe to be called by several threads.
    items : sequence
        Its arguments.

    Returns
    -------
    list
    """
    n_threads = min(len(items), processors(), MOST)
    if n_threads < 2:
        return [function(item) for item in items]
    with threads(n_threads) as pool:
        return list(pool.map(function, items))


@contextmanager
def threads(n: int) -> Iterator[ThreadPoolExecutor]:
    """Start so many threads, each with its share of the processors for products of matrices."""
    share = max(1, processors() // n)
    with threadpool_limits(share, "blas"), ThreadPoolExecutor(n) as pool:
        yield pool


class once(cached_property):
    """A cached property that one thread computes while others wait for it."""

    def __init__(self, function: Callable[[Any], Any]):
        super().__init__(function)
        self._computing = RLock()

    def __get__(self, instance: Any, owner: type | None = None) -> Any:
        with self._computing:
            return super().__get__(instance, owner)
