"""The independent tasks of a run, and what carries them out.

A run of many channels, scenarios or data sets is a list of tasks that do not wait for each other,
and here and there a sum over all of them. An engine carries them out: in threads of this process,
or on the workers of Dask (:mod:`.dask_engine`). What a sum adds to what does not depend on it, so
that the numbers are the same to the last bit wherever they are made, by the same number of threads
for products of matrices.
"""

from __future__ import annotations

import gc
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from concurrent.futures import as_completed
from dataclasses import dataclass
from pathlib import Path
from threading import Event, Lock
from typing import Any, Generic, TypeVar

from lusee_bayes.core.progress import Stages
from lusee_bayes.core.threads import threads

T = TypeVar("T")
R = TypeVar("R")

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

    def __post_init__(self):
        if len(self.items) != len(self.names):
            raise ValueError(f"{len(self.items)} items have {len(self.names)} names")


@dataclass(frozen=True)
class Demand:
    """What the tasks of a run take, about.

    Attributes
    ----------
    n_tasks : int
    base_bytes : float
        Memory of a process before it does anything.
    task_bytes : float
        What every task adds that is carried out at a time.
    seconds : float
        Of all tasks in one process of this machine.
    side_by_side : int
        How many a process carries out at a time; one where a task uses all processors.
    """

    n_tasks: int
    base_bytes: float
    task_bytes: float
    seconds: float
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
            The first that a task raises; no further ones are begun.
        WorkersLost
            If a task cannot be carried out because its workers fail.
        """

    @abstractmethod
    def reduced(
        self, tasks: Tasks[T, R], merge: Callable[[R, R], R], stages: Stages, stage: str
    ) -> R:
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
        found: list[Any] = [None] * len(tasks.items)

        def keep(number: int, value: R) -> None:
            found[number] = value

        self._run(tasks, keep, stages, stage)
        return found

    def reduced(
        self, tasks: Tasks[T, R], merge: Callable[[R, R], R], stages: Stages, stage: str
    ) -> R:
        tree = _Tree(len(tasks.items), merge)
        self._run(tasks, tree.add, stages, stage)
        return tree.result()

    def work_in(self, folder: Path) -> None:
        pass

    def _run(
        self, tasks: Tasks[T, R], keep: Callable[[int, R], None], stages: Stages, stage: str
    ) -> None:
        """Call ``keep`` with the number of every item and what the function gives for it."""
        n_threads = max(1, min(self.side_by_side, len(tasks.items)))
        stopped, counting, finished = Event(), Lock(), 0
        waiting = iter(range(len(tasks.items)))
        with stages.progress(stage, len(tasks.items)) as done:

            def work() -> None:
                nonlocal finished
                while not stopped.is_set():
                    with counting:
                        number = next(waiting, None)
                    if number is None:
                        return
                    keep(number, tasks.function(tasks.items[number]))
                    # what a task was made of may refer to itself, and is large
                    gc.collect()
                    with counting:
                        finished += 1
                        done(finished, tasks.names[number])

            with threads(n_threads) as pool:
                running = [pool.submit(work) for _ in range(n_threads)]
                try:
                    for one in as_completed(running):
                        one.result()
                finally:
                    stopped.set()


class _Tree(Generic[R]):
    """Merges results as they come; which with which depends on their numbers alone."""

    def __init__(self, n: int, merge: Callable[[R, R], R]):
        self._widths = [n]
        while self._widths[-1] > 1:
            self._widths.append((self._widths[-1] + 1) // 2)
        self._merge = merge
        self._lock = Lock()
        self._waiting: dict[tuple[int, int], R] = {}

    def add(self, number: int, value: R) -> None:
        """Merge a result with its neighbour, that with its own and so on, as far as they are there.

        Parameters
        ----------
        number : int
            Of the item.
        value
            What the function gave.
        """
        for level, width in enumerate(self._widths[:-1]):
            neighbour = number ^ 1
            if neighbour < width:
                with self._lock:
                    if (level, neighbour) not in self._waiting:
                        self._waiting[level, number] = value
                        return
                    other = self._waiting.pop((level, neighbour))
                value = self._merge(*((value, other) if number < neighbour else (other, value)))
            number //= 2
        self._waiting[len(self._widths) - 1, 0] = value

    def result(self) -> R:
        """All of them, when the last one has come."""
        return self._waiting.pop((len(self._widths) - 1, 0))
