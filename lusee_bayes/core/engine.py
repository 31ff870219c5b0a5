"""The independent tasks of a run, and what carries them out.

A run of many channels, scenarios or data sets is a list of tasks that do not wait for each other,
and here and there a sum over all of them. An engine carries them out: in threads of this process,
or on the workers of Dask (:mod:`.dask_engine`). What a sum adds to what does not depend on it, so
that the numbers are the same to the last bit wherever they are made, by the same number of threads
for products of matrices.

Smaller pieces of work run in as many threads as there are processors (:func:`in_threads`). NumPy
and LAPACK (:mod:`.linalg`) let other threads go on while they compute. A thread with one processor
of its own does more than two that share both for every product of matrices.
"""

from __future__ import annotations

import gc
import os
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import cached_property, partial
from importlib.util import find_spec
from pathlib import Path
from threading import RLock
from typing import Any, Generic, TypeVar

from threadpoolctl import threadpool_limits

from lusee_bayes.core.errors import InputError
from lusee_bayes.core.progress import Stages, memory_limit

# each has its own memory to work in
MOST = 8

T = TypeVar("T")
R = TypeVar("R")
# of two results
Merge = Callable[[R, R], R]


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
    with threadpool_limits(max(1, processors() // n), "blas"), ThreadPoolExecutor(n) as pool:
        yield pool


class once(cached_property):
    """A cached property that one thread computes while others wait for it."""

    def __init__(self, function: Callable[[Any], Any]):
        super().__init__(function)
        self._computing = RLock()

    def __get__(self, instance: Any, owner: type | None = None) -> Any:
        with self._computing:
            return super().__get__(instance, owner)


# tasks of one process at a time: one on each of two processors takes less than two after another
# on both, and more than two wait for each other, and take memory
SIDE_BY_SIDE = 2


@dataclass(frozen=True)
class Tasks(Generic[T, R]):
    """A function, and all that it is to be called with.

    Attributes
    ----------
    function : callable
        Of one item; safe to be called by several threads, and again with the same item.
    items : sequence
    names : sequence of str
        Of the items, for progress and for what is said if one fails.
    """

    function: Callable[[T], R]
    items: Sequence[T]
    names: Sequence[str]


@dataclass(frozen=True)
class Demand:
    """What the tasks of a run take, about.

    Attributes
    ----------
    base_bytes : float
        Memory of a process before it does anything.
    task_bytes : float
        What every task adds that is carried out at a time.
    side_by_side : int
        How many a process carries out at a time; one where a task uses all processors.
    """

    base_bytes: float
    task_bytes: float
    side_by_side: int = SIDE_BY_SIDE

    def process_bytes(self, side_by_side: int | None = None) -> float:
        """Memory of a process that carries out so many tasks at a time."""
        at_once = self.side_by_side if side_by_side is None else side_by_side
        return self.base_bytes + at_once * self.task_bytes


class Engine(ABC):
    """What carries out the tasks of a run."""

    @abstractmethod
    def each(self, tasks: Tasks[T, R], stages: Stages, stage: str) -> list[R]:
        """Carry out all tasks.

        Parameters
        ----------
        tasks : Tasks
        stages : Stages
            Told how many are done.
        stage : str
            What the stage is called.

        Returns
        -------
        list
            What the function gives, in the order of the items.

        Raises
        ------
        Exception
            That of the first task, in their order, that raises one; those that wait then are not
            begun.
        WorkersLost
            If a task cannot be carried out because its workers fail.
        """

    @abstractmethod
    def reduced(self, tasks: Tasks[T, R], merge: Merge[R], stages: Stages, stage: str) -> R:
        """Carry out all tasks, and merge what they give: neighbours first, as a tree.

        Parameters
        ----------
        tasks : Tasks
            One or more.
        merge : callable
            Of two results; it must not change them.
        stages, stage
            As for :meth:`each`.

        Raises
        ------
        Exception
            As :meth:`each`.
        """

    @abstractmethod
    def work_in(self, folder: Path) -> None:
        """Say in which folder the tasks write.

        Raises
        ------
        InputError
            If a worker does not see it, has another version of the package, or too little memory.
        """


@dataclass(frozen=True)
class ThisProcess(Engine):
    """Carries tasks out in threads of this process.

    Attributes
    ----------
    side_by_side : int
        How many at a time.
    """

    side_by_side: int = SIDE_BY_SIDE

    def each(self, tasks: Tasks[T, R], stages: Stages, stage: str) -> list[R]:
        with self._results(tasks, stages, stage) as results:
            return list(results)

    def reduced(self, tasks: Tasks[T, R], merge: Merge[R], stages: Stages, stage: str) -> R:
        with self._results(tasks, stages, stage) as results:
            return merged_as_tree(results, len(tasks.items), merge)

    def work_in(self, folder: Path) -> None:
        pass

    @contextmanager
    def _results(self, tasks: Tasks[T, R], stages: Stages, stage: str) -> Iterator[Iterator[R]]:
        """What the function gives, in the order of the items."""
        n_threads = max(1, min(self.side_by_side, len(tasks.items)))
        with stages.progress(stage, len(tasks.items)) as done, threads(n_threads) as pool:
            given = pool.map(partial(carry_out, tasks.function), tasks.items)

            def in_order() -> Iterator[R]:
                for number, name in enumerate(tasks.names, start=1):
                    # a list that is emptied: what was given is not kept here
                    result = [next(given)]
                    done(number, name)
                    yield result.pop()

            try:
                yield in_order()
            finally:
                pool.shutdown(wait=False, cancel_futures=True)


def carry_out(function: Callable[[T], R], item: T) -> R:
    """Call a function, and free at once what it leaves: it may refer to itself, and is large."""
    try:
        return function(item)
    finally:
        gc.collect()


def merged_as_tree(parts: Iterator[R], n: int, merge: Merge[R]) -> R:
    """Merge n parts as they come: neighbours first, then their neighbours.

    Which with which depends on n alone. Besides the last part, one for each level is kept.
    """
    if n == 1:
        return next(parts)
    half = 1 << ((n - 1).bit_length() - 1)
    return merge(merged_as_tree(parts, half, merge), merged_as_tree(parts, n - half, merge))


# the variable by which Dask's own programs are told of a cluster
SCHEDULER = "DASK_SCHEDULER_ADDRESS"


@contextmanager
def open_engine(
    demand: Demand, workers: int | None = None, cluster: str | None = None
) -> Iterator[Engine]:
    """Start what is to carry out the tasks of a run, and end it after the block.

    Parameters
    ----------
    demand : Demand
        What the tasks take.
    workers : int, optional
        Processes of this machine; one, as by default, is this process, without any server.
    cluster : str, optional
        Address of the scheduler of a Dask cluster, as tcp://host:8786; by default that of the
        environment variable ``DASK_SCHEDULER_ADDRESS``, if it is set.

    Yields
    ------
    Engine

    Raises
    ------
    InputError
        If Dask is not installed, the workers do not fit into the memory, no scheduler answers, or
        as :class:`.DaskEngine`.
    """
    if workers is not None and cluster is not None:
        raise InputError("--workers starts local workers, --cluster uses existing ones; give one")
    if workers is None:
        cluster, workers = cluster or os.environ.get(SCHEDULER), 1
    if not cluster and workers == 1:
        gc.freeze()  # modules stay: they need not be searched
        yield ThisProcess(demand.side_by_side if demand.process_bytes() <= memory_limit() else 1)
        return
    if find_spec("distributed") is None:
        raise InputError(
            "--workers and --cluster need Dask; install it with pip install '.[cluster]' in the "
            "clone of lusee_bayes"
        )
    # an optional library, which takes a second
    from lusee_bayes.core.dask_engine import connected, own_workers

    # before JAX starts: workers on the same GPU as this process need some of its memory
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
    with ExitStack() as stack:
        place = cluster or stack.enter_context(own_workers(workers, demand))
        yield stack.enter_context(connected(place, demand))
