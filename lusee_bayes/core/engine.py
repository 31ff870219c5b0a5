"""The independent tasks of a run, and the engines that run them.

A run over many channels, scenarios or data sets is a list of independent tasks, sometimes followed
by a sum over all of them. An engine runs the tasks in threads of this process or on Dask workers
(:mod:`.dask_engine`). The order of summation does not depend on the engine. Results are therefore
identical to the last bit everywhere, if matrix products use the same number of threads.

Smaller pieces of work run in up to one thread per processor (:func:`in_threads`). NumPy and LAPACK
(:mod:`.linalg`) release the interpreter's lock while they compute. Two threads with one processor
each achieve more than two threads that share both processors for every matrix product.
"""

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

# most threads at once: each needs its own working memory
MOST = 8

T = TypeVar("T")
R = TypeVar("R")
# combines two results
Merge = Callable[[R, R], R]


def processors() -> int:
    """The number of processors that this process may use."""
    return len(getattr(os, "sched_getaffinity", lambda _: range(os.cpu_count() or 1))(0))


def in_threads(function: Callable[[T], R], items: Sequence[T]) -> list[R]:
    """Call a function with every item, in parallel threads.

    Parameters
    ----------
    function : callable
        Must be thread-safe.
    items : sequence
        Its arguments.

    Returns
    -------
    list
        Results in the order of the items.
    """
    if (n_threads := min(len(items), processors(), MOST)) < 2:
        return [function(item) for item in items]
    with threads(n_threads) as pool:
        return list(pool.map(function, items))


@contextmanager
def threads(n: int) -> Iterator[ThreadPoolExecutor]:
    """Start n threads, each with its share of the processors for matrix products."""
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


# tasks that a process runs at once: two side by side, on one processor each, take less time than
# two in succession on both; more than two wait for each other and need memory
SIDE_BY_SIDE = 2


@dataclass(frozen=True)
class Tasks(Generic[T, R]):
    """A function and the items to call it with.

    Attributes
    ----------
    function : callable
        Of one item; thread-safe, and may be called again with the same item.
    items : sequence
    names : sequence of str
        Names of the items, for progress and error messages.
    """

    function: Callable[[T], R]
    items: Sequence[T]
    names: Sequence[str]


@dataclass(frozen=True)
class Demand:
    """The approximate memory that the tasks of a run need.

    Attributes
    ----------
    base_bytes : float
        Memory of an idle process.
    task_bytes : float
        Additional memory of every task that runs at the same time.
    side_by_side : int
        Number of tasks that a process runs at once; one if a task uses all processors.
    """

    base_bytes: float
    task_bytes: float
    side_by_side: int = SIDE_BY_SIDE

    def process_bytes(self, side_by_side: int | None = None) -> float:
        """Memory of a process that runs this number of tasks at once."""
        at_once = self.side_by_side if side_by_side is None else side_by_side
        return self.base_bytes + at_once * self.task_bytes


class Engine(ABC):
    """Runs the tasks of a run."""

    @abstractmethod
    def each(self, tasks: Tasks[T, R], stages: Stages, stage: str) -> list[R]:
        """Run all tasks.

        Parameters
        ----------
        tasks : Tasks
        stages : Stages
            Shows how many are done.
        stage : str
            Name of the stage.

        Returns
        -------
        list
            Results of the function, in the order of the items.

        Raises
        ------
        Exception
            That of the first task, in order, that raises one; waiting tasks are then not started.
        WorkersLost
            If a task cannot be completed because its workers fail.
        """

    @abstractmethod
    def reduced(self, tasks: Tasks[T, R], merge: Merge[R], stages: Stages, stage: str) -> R:
        """Run all tasks and merge their results as a tree, neighbours first.

        Parameters
        ----------
        tasks : Tasks
            One or more.
        merge : callable
            Of two results; it must not change them.
        stages, stage
            As in :meth:`each`.

        Raises
        ------
        Exception
            As in :meth:`each`.
        """

    @abstractmethod
    def work_in(self, folder: Path) -> None:
        """Set the folder into which the tasks write.

        Raises
        ------
        InputError
            If a worker does not see it, has another version of the package, or too little memory.
        """


@dataclass(frozen=True)
class ThisProcess(Engine):
    """Runs tasks in threads of this process.

    Attributes
    ----------
    side_by_side : int
        Number of tasks at once.
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
        """Yield an iterator over the results, in the order of the items."""
        n_threads = max(1, min(self.side_by_side, len(tasks.items)))
        with stages.progress(stage, len(tasks.items)) as done, threads(n_threads) as pool:
            given = pool.map(partial(carry_out, tasks.function), tasks.items)

            def in_order() -> Iterator[R]:
                for number, name in enumerate(tasks.names, start=1):
                    # popped from a list, so that no reference to the result is kept here
                    result = [next(given)]
                    done(number, name)
                    yield result.pop()

            try:
                yield in_order()
            finally:
                pool.shutdown(wait=False, cancel_futures=True)


def carry_out(function: Callable[[T], R], item: T) -> R:
    """Call a function, then collect garbage: it may be large and contain reference cycles."""
    try:
        return function(item)
    finally:
        gc.collect()


def merged_as_tree(parts: Iterator[R], n: int, merge: Merge[R]) -> R:
    """Merge n parts as they arrive: first neighbours, then their sums.

    The pairing depends only on n. Besides the last part, one sum per level is kept in memory.
    """
    if n == 1:
        return next(parts)
    half = 1 << ((n - 1).bit_length() - 1)
    return merge(merged_as_tree(parts, half, merge), merged_as_tree(parts, n - half, merge))


# the environment variable that gives Dask's own programs the address of a cluster
SCHEDULER = "DASK_SCHEDULER_ADDRESS"


@contextmanager
def open_engine(
    demand: Demand, workers: int | None = None, cluster: str | None = None
) -> Iterator[Engine]:
    """Start the engine for the tasks of a run, and end it after the block.

    Parameters
    ----------
    demand : Demand
        Memory that the tasks need.
    workers : int, optional
        Number of processes on this machine; 1 (the default) uses this process and no server.
    cluster : str, optional
        Address of a Dask scheduler, such as tcp://host:8786; by default the environment variable
        ``DASK_SCHEDULER_ADDRESS``, if set.

    Yields
    ------
    Engine

    Raises
    ------
    InputError
        If Dask is not installed, the workers do not fit into the memory, no scheduler answers, or
        as in :class:`.DaskEngine`.
    """
    if workers is not None and cluster is not None:
        raise InputError("--workers starts local workers, --cluster uses existing ones; give one")
    if workers is None:
        cluster, workers = cluster or os.environ.get(SCHEDULER), 1
    if not cluster and workers == 1:
        gc.freeze()  # modules are permanent: exclude them from collection
        yield ThisProcess(demand.side_by_side if demand.process_bytes() <= memory_limit() else 1)
        return
    if find_spec("distributed") is None:
        wrong = "--workers and --cluster need Dask: pip install '.[cluster]' in lusee_bayes's clone"
        raise InputError(wrong)
    # an optional library, whose import takes a second
    from lusee_bayes.core.dask_engine import connected, own_workers

    # before JAX starts: workers on the same GPU as this process need some of its memory
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
    with ExitStack() as stack:
        place = cluster or stack.enter_context(own_workers(workers, demand))
        yield stack.enter_context(connected(place, demand))
