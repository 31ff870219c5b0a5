"""Run tasks on Dask workers.

Tasks are functions of files: their shared input and their results are files in the run's folder.
Dask transfers only the numbers of tasks and the sums of a reduction. Finished work therefore
survives the end of any worker, of the scheduler or of the command. If a worker ends, Dask repeats
its task elsewhere.
"""

import asyncio
import gc
import logging
import os
import pickle
import shutil
import signal
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError
from contextlib import closing, contextmanager
from functools import lru_cache, partial
from pathlib import Path
from threading import Lock
from typing import Any

import cloudpickle
import dask
import distributed
from distributed.scheduler import NoWorkerError

from lusee_bayes.core import arrays, engine, files
from lusee_bayes.core.engine import Merge, R, T, Tasks
from lusee_bayes.core.errors import InputError, WorkersLost
from lusee_bayes.core.progress import Stages, gigabytes, memory_limit
from lusee_bayes.core.version import __version__

# retries of a failed task: memory or disk may have been full
REPEATS = 3
ENVIRONMENT = "distributed.nanny.pre-spawn-environ"
# seconds within which a scheduler has to answer
ANSWER_S = 10.0

_reading = Lock()


class DaskEngine(engine.Engine):
    """Runs tasks on the workers of a Dask cluster.

    The workers need this package and a disk shared with this process, because tasks write into the
    run's folder.

    Parameters
    ----------
    client : distributed.Client
        Client of the cluster; it stays open.
    demand : Demand, optional
        Memory that the tasks need; workers with too little memory are refused.
    """

    def __init__(self, client: distributed.Client, demand: engine.Demand | None = None):
        self.client = client
        self._demand = demand
        self._folder: Path | None = None

    def work_in(self, folder: Path) -> None:
        self._folder = folder.resolve()
        asked = code_versions(), self._folder, self._demand
        for worker, answer in self.client.run(refusal_of, *asked, on_error="return").items():
            if answer is not None:
                raise InputError(f"worker {worker}: {answer}")

    def each(self, tasks: Tasks[T, R], stages: Stages, stage: str) -> list[R]:
        with self._submitted(tasks, None, stages, stage) as (_, _, finished):
            results = {number: future.result() for number, future in finished}
        return [results[number] for number in range(len(tasks.items))]

    def reduced(self, tasks: Tasks[T, R], merge: Merge[R], stages: Stages, stage: str) -> R:
        with self._submitted(tasks, merge, stages, stage) as (job, futures, finished):
            # merges go before other tasks, so that few parts wait
            merged = partial(self._submit, run_merge, job, priority=1)
            total = engine.merged_as_tree(iter(futures), len(futures), merged)
            # results of tasks stay on the workers; only errors are fetched
            for _, future in finished:
                if future.status != "finished":
                    future.result()
            return total.result()

    def _submit(self, *call: Any, **options: Any) -> distributed.Future:
        return self.client.submit(*call, pure=False, retries=REPEATS, **options)

    @contextmanager
    def _submitted(
        self, tasks: Tasks[T, R], merge: Merge[R] | None, stages: Stages, stage: str
    ) -> Iterator[tuple[Path, list[distributed.Future], Iterator[tuple[int, distributed.Future]]]]:
        """Submit all tasks, and report in one sentence any worker that ends.

        Yields the job file, which the workers can read; the futures of all tasks; and an iterator
        over numbers and futures as tasks finish, successfully or not. Starting the iterator empties
        the list, so that results are freed.
        """
        if self._folder is None:
            raise RuntimeError("the engine has no folder: call work_in first")
        place, numbers = files.scratch_folder(self._folder), {}
        job = place / "job.pickle"

        def note(event: tuple[float, Any]) -> None:
            said = event[1]
            if said.get("action") == "remove-worker" and not said.get("expected"):
                again = [tasks.names[numbers[k]] for k in said["processing-tasks"] if k in numbers]
                if again:
                    ended = f"worker {said['worker']} ended"
                    stages.say(f"  {ended}; reassigned to others: {', '.join(again)}")

        def finished() -> Iterator[tuple[int, distributed.Future]]:
            waiting = distributed.as_completed(futures, loop=self.client.loop)
            futures.clear()
            try:
                with stages.progress(stage, len(tasks.items)) as done:
                    for n_done, future in enumerate(waiting, start=1):
                        yield numbers[future.key], future
                        done(n_done, tasks.names[numbers[future.key]])
            finally:
                waiting.clear()

        self.client.subscribe_topic("all", note)
        try:
            with job.open("wb") as file:
                cloudpickle.dump((os.getpid(), tasks.function, tasks.items, merge), file)
            futures = [self._submit(run_task, job, number) for number in range(len(tasks.items))]
            numbers |= {future.key: number for number, future in enumerate(futures)}
            # closed immediately if an error is raised
            with closing(finished()) as by_number:
                yield job, futures, by_number
        except distributed.KilledWorker as error:
            number = numbers.get(str(error.task))
            what = "a sum" if number is None else tasks.names[number]
            raise WorkersLost(
                f"{stage}, {what}: {error.allowed_failures + 1} workers died on it in succession, "
                f"the last at {error.last_worker.address} (killed, or out of memory)"
            ) from error
        except (CancelledError, NoWorkerError) as error:
            wrong = "the Dask scheduler has ended, has no workers, or has lost this run"
            raise WorkersLost(wrong) from error
        finally:
            if self.client.status == "running":
                self.client.unsubscribe_topic("all")
            shutil.rmtree(place, ignore_errors=True)


def run_task(job: Path, number: int) -> Any:
    """Call the function of a job with one of its items."""
    function, items, _ = read_job(job)
    return engine.carry_out(function, items[number])


def run_merge(job: Path, one: Any, other: Any) -> Any:
    """Merge two results of a job."""
    return read_job(job)[2](one, other)


def read_job(path: Path) -> tuple[Callable[..., Any], Any, Any]:
    """Function, items and merge of a job; every worker reads them once."""
    # both threads of a worker need them at the same time
    with _reading:
        return _read_job(path)


@lru_cache(maxsize=1)
def _read_job(path: Path) -> tuple[Callable[..., Any], Any, Any]:
    with path.open("rb") as file:
        command, *job = pickle.load(file)
    if os.getpid() != command:
        # configure this worker like the process of a command
        gc.set_threshold(100_000, 20, 100)
        arrays.use_compilation_cache()
        # otherwise xarray asks the scheduler for a lock per file, through another client
        dask.config.set(scheduler="threads")
    return tuple(job)


def code_versions() -> str:
    """Versions that command and workers must share to exchange code."""
    return f"lusee_bayes {__version__} and Python {sys.version_info.major}.{sys.version_info.minor}"


def refusal_of(
    wanted: str, folder: Path, demand: engine.Demand | None, dask_worker: distributed.Worker
) -> str | None:
    """The reason why a worker cannot serve a command, in one sentence; None if it can.

    Parameters
    ----------
    wanted : str
        The command's :func:`code_versions`.
    folder : Path
        Folder of the run.
    demand : Demand or None
    dask_worker : distributed.Worker
        Dask passes the worker to an argument with this name.
    """
    if code_versions() != wanted:
        return f"it has {code_versions()}, the command {wanted}; install the same versions on both"
    limit, n = dask_worker.memory_manager.memory_limit, dask_worker.state.nthreads
    if demand is not None and limit and demand.process_bytes(n) > limit:
        return (
            f"it is limited to {gigabytes(limit)} of memory, but {n} task(s) at a time need about "
            f"{gigabytes(demand.process_bytes(n))}; raise its --memory-limit, or lower --nthreads"
        )
    advice = "command and workers must share a disk: give a folder on it with -o"
    return None if folder.is_dir() else f"it does not see '{folder}'; {advice}"


@contextmanager
def own_workers(n: int, demand: engine.Demand) -> Iterator[distributed.LocalCluster]:
    """A cluster on this machine; its workers divide the processors and the memory.

    Raises
    ------
    InputError
        If the workers do not fit into the memory.
    """
    side_by_side = min(demand.side_by_side, max(1, engine.processors() // n))
    if (needed := n * demand.process_bytes(side_by_side)) > memory_limit():
        wrong = f"{n} workers need {gigabytes(needed)} of {gigabytes(memory_limit())}: use fewer"
        raise InputError(wrong)
    settings = {
        # Dask makes glibc return memory early (MALLOC_TRIM_THRESHOLD_). This also fixes at 128 kB
        # the size above which the system maps and clears new memory for every array, and a channel
        # takes a third longer; 32 MB is the largest size allowed
        f"{ENVIRONMENT}.MALLOC_MMAP_THRESHOLD_": 32 << 20,
        f"{ENVIRONMENT}.OPENBLAS_NUM_THREADS": max(1, engine.processors() // (n * side_by_side)),
        # no worker queues tasks that another could run
        "distributed.scheduler.worker-saturation": 1.0,
    }
    # workers ignore Ctrl-C: it ends the command, which then ends them
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with dask.config.set(settings):
            each = {"threads_per_worker": side_by_side, "memory_limit": memory_limit() // n}
            address = {"host": "127.0.0.1", "dashboard_address": "127.0.0.1:0"}
            more = each | address | {"silence_logs": logging.CRITICAL}
            cluster = distributed.LocalCluster(n_workers=n, **more)
    finally:
        signal.signal(signal.SIGINT, before)
    with cluster:
        yield cluster


@contextmanager
def connected(place: str | distributed.LocalCluster, demand: engine.Demand) -> Iterator[DaskEngine]:
    """The engine of a cluster, connected during the block.

    Parameters
    ----------
    place : str or distributed.LocalCluster
        The cluster, or the address of its scheduler.
    demand : Demand

    Raises
    ------
    InputError
        If no scheduler answers.
    """
    if isinstance(place, str):
        _require_answer(place)
    # silence Dask's log: errors become one sentence
    for name in [name for name in logging.root.manager.loggerDict if "distributed" in name]:
        logging.getLogger(name).setLevel(logging.CRITICAL + 1)
    with distributed.Client(place, timeout=ANSWER_S, set_as_default=False) as client:
        yield DaskEngine(client, demand)


def _require_answer(address: str) -> None:
    """Ask a scheduler for its identity; a Client waits forever if nothing answers."""

    async def ask() -> None:
        arguments = distributed.Security().get_connection_args("client")
        async with distributed.rpc(address, timeout=ANSWER_S, connection_args=arguments) as server:
            await asyncio.wait_for(server.identity(), ANSWER_S)

    try:
        # in a new thread: this one may have a running event loop, as in a notebook
        with engine.threads(1) as pool:
            pool.submit(asyncio.run, ask()).result()
    except (OSError, ValueError, TypeError, MemoryError) as error:
        # TypeError: TLS without certificates; MemoryError: Dask reads the answer of a web server as
        # the length of a message
        why = " ".join(str(error).split())[:200] or f"silent for {ANSWER_S:g} s"
        raise InputError(
            f"no Dask scheduler answers at '{address}' ({why}); start one with: dask scheduler, "
            "and give its address as tcp://host:8786 (8787 is its dashboard's)"
        ) from error
