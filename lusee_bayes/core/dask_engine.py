"""The tasks of a run on the workers of Dask.

Tasks are functions of files: what they share is written into the run's folder, and so is what they
find out. So Dask carries no more than numbers of tasks, and the sums of a reduction. Whatever
worker, scheduler or command ends, nothing is lost that was finished. A task whose worker ends is
repeated elsewhere, by Dask, ``REPEATS`` times at most.
"""

from __future__ import annotations

import shutil
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from queue import Empty, SimpleQueue
from threading import TIMEOUT_MAX
from typing import Any, TypeVar
from uuid import uuid4

import cloudpickle
import dask
import distributed

from lusee_bayes.core.dask_worker import (
    HANGS,
    Failed,
    Job,
    Terms,
    host_of_worker,
    refusal_of,
    run_merge,
    run_task,
    this_process,
    versions,
)
from lusee_bayes.core.engine import Demand, Engine, Tasks
from lusee_bayes.core.errors import InputError, WorkersLost
from lusee_bayes.core.files import scratch_folder
from lusee_bayes.core.memory import gigabytes
from lusee_bayes.core.progress import Stages

T = TypeVar("T")
R = TypeVar("R")

# of a task whose worker ends, or which lacks memory or disk
REPEATS = 3
# seconds between looks at scheduler and workers
POLL_S = 1.0
# what a future says of a task that failed, and of one that the scheduler does not know
BAD = ("error", "cancelled")
# a task hangs that takes so many times as long as expected, and longer than that
HANGING, LEAST_LIMIT_S = 50.0, 3600.0
# seconds after which a result that does not come is asked for again
FETCH_S = 300.0
# how long no worker may be there before the run ends (DASK_LUSEE_BAYES__PATIENCE)
PATIENCE = "lusee-bayes.patience", "10 minutes"


class DaskEngine(Engine):
    """Carries tasks out on the workers of a Dask cluster.

    The workers have this package and share a disk with this process: tasks write into the run's
    folder. The processors of a host are divided among all threads of its workers.

    Parameters
    ----------
    client : distributed.Client
        Of the cluster; it stays open.
    demand : Demand, optional
        What the tasks take. With it, workers whose memory would not suffice are refused, and tasks
        that take far too long are taken for hanging.
    """

    def __init__(self, client: distributed.Client, demand: Demand | None = None):
        self.client = client
        self._demand = demand
        self._limit_s = TIMEOUT_MAX
        if demand is not None:
            expected = demand.seconds / max(demand.n_tasks, 1)
            self._limit_s = max(LEAST_LIMIT_S, HANGING * expected)
        self._terms: Terms | None = None
        # workers that have ended, and why
        self._ended: deque[dict[str, Any]] = deque()
        self._causes: dict[str, str] = {}

    def work_in(self, folder: Path) -> None:
        place, process = folder.resolve(), this_process()
        self._terms = Terms(versions(), place, self._demand, process)
        answers = self.client.run(refusal_of, self._terms, on_error="return")
        for answer in answers.values():
            if isinstance(answer, ModuleNotFoundError):
                raise InputError(
                    f"workers of {self._scheduler()} lack {answer.name}; install lusee_bayes for "
                    "them"
                )
            if isinstance(answer, str):
                raise InputError(answer)

    def each(self, tasks: Tasks[T, R], stages: Stages, stage: str) -> list[R]:
        found: list[Any] = [None] * len(tasks.items)
        with self._job(tasks) as job:
            futures = self._submitted(job, tasks)
            for number, value in self._results(futures, 0, tasks, stages, stage):
                found[number] = value
        return found

    def reduced(
        self, tasks: Tasks[T, R], merge: Callable[[R, R], R], stages: Stages, stage: str
    ) -> R:
        with self._job(tasks, merge) as job:
            futures = self._submitted(job, tasks)
            level, height = list(futures), 0
            while len(level) > 1:
                height += 1
                level = [
                    self._merged(job, level[first : first + 2], height)
                    for first in range(0, len(level), 2)
                ]
            if height:
                futures.append(level[0])
            level.clear()
            # what the tasks give is left with the workers
            last = len(futures) - 1
            ((_, value),) = self._results(futures, last, tasks, stages, stage)
        return value

    def _submitted(self, job: Path, tasks: Tasks[T, R]) -> list[distributed.Future]:
        terms = replace(self._told(), threads=self._threads(), limit_s=self._limit_s)
        label = uuid4().hex
        return [
            self.client.submit(
                run_task, job, number, terms, key=f"{label}-{number}", retries=REPEATS
            )
            for number in range(len(tasks.items))
        ]

    def _merged(
        self, job: Path, parts: list[distributed.Future], height: int
    ) -> distributed.Future:
        if len(parts) == 1:
            return parts[0]
        # before other tasks, so that few parts wait
        return self.client.submit(
            run_merge, job, *parts, pure=False, retries=REPEATS, priority=height
        )

    def _results(
        self,
        futures: list[distributed.Future],
        first: int,
        tasks: Tasks[T, R],
        stages: Stages,
        stage: str,
    ) -> Iterator[tuple[int, Any]]:
        """Numbers and values of the futures from the ``first`` on, as they finish.

        The list is emptied, so that none is held longer than needed. If one fails, the others are
        cancelled.
        """
        ended: SimpleQueue[distributed.Future] = SimpleQueue()
        numbers = {future.key: number for number, future in enumerate(futures)}
        names = dict(zip(numbers, tasks.names, strict=False))  # a sum has none
        waiting = dict(zip(numbers, futures, strict=True))
        futures.clear()
        for future in waiting.values():
            future.add_done_callback(ended.put)
        absence, finished = _Absence(), 0
        try:
            with self._listening(), stages.progress(stage, len(tasks.items)) as done:
                while waiting:
                    try:
                        future = ended.get(timeout=POLL_S)
                    except Empty:
                        self._require_workers(absence)
                    else:
                        number = numbers[future.key]
                        if number >= first or future.status in BAD:
                            yield number, self._value(future, names, stage)
                        del waiting[future.key]
                        if future.key in names:
                            finished += 1
                            done(finished, names[future.key])
                    self._tell(names, stages)
        except BaseException:
            # to cancel them would be to ask for sums, too, which nobody holds
            for future in waiting.values():
                future.release()
            raise

    def _value(self, future: distributed.Future, names: dict[str, str], stage: str) -> Any:
        """What a task gave, from the worker that holds it; if that has ended, from another.

        WorkersLost, in one sentence, if it could not be carried out.
        """
        absence = _Absence()
        while future.status not in BAD:
            try:
                value = future.result(timeout=FETCH_S)
            except TimeoutError:
                self._require_workers(absence)
            except Exception:
                # its status says why
                if future.status not in BAD:
                    raise
            else:
                if isinstance(value, Failed):
                    raise value.error
                return value
        if future.status != "error":
            raise WorkersLost(f"{self._scheduler()} is gone, or has forgotten this run")
        error = future.exception()
        killed = isinstance(error, distributed.KilledWorker)
        key = str(error.task) if killed else future.key
        name = f"{stage}, {names[key]}" if key in names else stage
        if not killed:
            raise WorkersLost(
                f"{name}: failed {REPEATS + 1} times, at last with {type(error).__name__}: "
                f"{' '.join(str(error).split())[:300]}"
            ) from error
        last = str(error.last_worker.address)
        why = self._causes.get(last, "killed, or out of memory")
        raise WorkersLost(
            f"{name}: {error.allowed_failures + 1} workers ended while they worked on it, one "
            f"after the other, the last of them {last} ({why})"
        ) from error

    def _require_workers(self, absence: _Absence) -> None:
        """WorkersLost if the scheduler is gone, or all workers have been for long."""
        if self.client.status != "running":
            raise WorkersLost(f"{self._scheduler()} is gone")
        patience = dask.utils.parse_timedelta(dask.config.get(*PATIENCE))
        missing = absence.seconds(there=bool(self._workers()))
        if missing > patience:
            raise WorkersLost(
                f"{self._scheduler()} has had no workers for {missing:.0f} s; start some, with: "
                f"dask worker {self._address()}"
            )

    def _scheduler(self) -> str:
        return f"the Dask scheduler at {self._address()}"

    def _address(self) -> str:
        scheduler = self.client.scheduler
        return "an unknown address" if scheduler is None else str(scheduler.address)

    def _workers(self) -> dict[str, Any]:
        return dict(self.client.scheduler_info(n_workers=-1)["workers"])

    def _threads(self) -> dict[str, int]:
        """Threads for products of matrices of every task, by host."""
        at_once: Counter[str] = Counter()
        found: dict[str, int] = {}
        workers, hosts = self._workers(), self.client.run(host_of_worker, on_error="ignore")
        for address, (host, n_processors) in hosts.items():
            if address in workers:
                at_once[host] += workers[address]["nthreads"]
                found[host] = n_processors
        return {host: max(1, n // at_once[host]) for host, n in found.items()}

    def _told(self) -> Terms:
        if self._terms is None:
            raise RuntimeError("the engine is not told where to work: call work_in first")
        return self._terms

    @contextmanager
    def _job(self, tasks: Tasks[T, R], merge: Callable[[R, R], R] | None = None) -> Iterator[Path]:
        """Write what all tasks share where the workers see it."""
        with _scratch(self._told().folder) as place:
            path = place / "job.pickle"
            with path.open("wb") as file:
                cloudpickle.dump(Job(tasks.function, tasks.items, merge), file)
            yield path

    @contextmanager
    def _listening(self) -> Iterator[None]:
        """Take note of workers that end."""
        topics = {"all": self._note_ended, "worker-restart-memory": self._note_memory}
        topics[HANGS] = self._note_hanging
        for topic, handler in topics.items():
            self.client.subscribe_topic(topic, handler)
        try:
            yield
        finally:
            for topic in topics:
                with suppress(Exception):
                    self.client.unsubscribe_topic(topic)

    def _note_ended(self, event: tuple[float, Any]) -> None:
        said = event[1]
        if said.get("action") == "remove-worker" and not said.get("expected"):
            self._ended.append(said)

    def _note_memory(self, event: tuple[float, Any]) -> None:
        said = event[1]
        self._causes[said["worker"]] = f"it took {gigabytes(said['rss'])} of memory, too much"

    def _note_hanging(self, event: tuple[float, Any]) -> None:
        said = event[1]
        self._causes[said["worker"]] = f"its task took longer than {said['limit_s']:.0f} s"

    def _tell(self, names: dict[str, str], stages: Stages) -> None:
        """Say which workers have ended, and what they had begun or were to begin."""
        while self._ended:
            said = self._ended.popleft()
            worker = said["worker"]
            again = [name for key, name in names.items() if key in said["processing-tasks"]]
            why = f" ({self._causes[worker]})" if worker in self._causes else ""
            if again:
                stages.say(f"  worker {worker} ended{why}; given to others: {', '.join(again)}")


class _Absence:
    """How long the workers have been away."""

    def __init__(self):
        self._since: float | None = None

    def seconds(self, *, there: bool) -> float:
        """Since when they have not been there; 0 if they are."""
        if there:
            self._since = None
            return 0.0
        self._since = self._since or time.monotonic()
        return time.monotonic() - self._since


@contextmanager
def _scratch(folder: Path) -> Iterator[Path]:
    """A folder inside ``folder`` during the block."""
    place = scratch_folder(folder)
    try:
        yield place
    finally:
        shutil.rmtree(place, ignore_errors=True)
