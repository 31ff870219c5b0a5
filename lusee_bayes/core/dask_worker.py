"""What a worker of Dask does for a run: prepares itself, and carries out a task."""

from __future__ import annotations

import gc
import os
import pickle
import signal
import socket
import sys
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from threading import Lock, Timer
from typing import Any

import distributed
import jax
from threadpoolctl import threadpool_limits

from lusee_bayes.core.compilation_cache import publish, use_compilation_cache
from lusee_bayes.core.engine import Demand
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.memory import gigabytes
from lusee_bayes.core.threads import processors
from lusee_bayes.core.version import __version__

# what may go well elsewhere, or another time: lack of memory or disk
TRANSIENT = (MemoryError, OSError, jax.errors.JaxRuntimeError)

# topic of the events by which workers say why they end
HANGS = "lusee_bayes-hangs"

_reading, _dividing, _threads = Lock(), Lock(), [0]


@dataclass(frozen=True)
class Failed:
    """A task failed, and would fail anywhere."""

    error: Exception


@dataclass(frozen=True)
class Job:
    """What the tasks of a stage share: written once, read once by every worker.

    Attributes
    ----------
    function : callable
    items : sequence
    merge : callable or None
        Of two results.
    """

    function: Callable[[Any], Any]
    items: Sequence[Any]
    merge: Callable[[Any, Any], Any] | None = None


@dataclass(frozen=True)
class Terms:
    """Under which conditions a task is carried out.

    Attributes
    ----------
    threads : mapping
        For products of matrices, by host name.
    limit_s : float
        A task that takes longer hangs: its worker is ended.
    """

    threads: Mapping[str, int]
    limit_s: float


class Preparation(distributed.WorkerPlugin):
    """Makes a worker work as the command does: in its folder, with its version and its programs.

    Parameters
    ----------
    folder : str
        In which the command was given; paths may be relative to it.
    demand : Demand or None
        What the tasks take.
    """

    name = "lusee_bayes"

    def __init__(self, folder: str, demand: Demand | None):
        self.folder, self.demand, self.versions = folder, demand, _versions()

    def setup(self, worker: distributed.Worker) -> None:
        """Prepare a worker. InputError if it cannot do what the command asks for."""
        here = f"worker {worker.address} on {socket.gethostname()}"
        if _versions() != self.versions:
            raise InputError(
                f"{here} has {_versions()}, the command {self.versions}; install the same on both"
            )
        limit, threads = worker.memory_manager.memory_limit, worker.state.nthreads
        if self.demand and limit and self.demand.process_bytes(threads) > limit:
            raise InputError(
                f"{here} may take {gigabytes(limit)} of memory, and {threads} task(s) at a time "
                f"need about {gigabytes(self.demand.process_bytes(threads))}; start it with a "
                "larger --memory-limit or fewer --nthreads"
            )
        try:
            os.chdir(self.folder)
        except OSError as error:
            raise InputError(
                f"{here} does not see '{self.folder}' ({error.strerror}); command and workers have "
                "to share a disk"
            ) from error
        gc.set_threshold(100_000, 20, 100)
        use_compilation_cache()


def _versions() -> str:
    """Of what code is sent between processes by."""
    return f"lusee_bayes {__version__} and Python {sys.version_info.major}.{sys.version_info.minor}"


def host_of_worker() -> tuple[str, int]:
    """Name of this host, and how many of its processors may be used."""
    return socket.gethostname(), processors()


def run_task(job: Path, number: int, terms: Terms) -> Any:
    """Carry out a task: call the function of a job with one of its items.

    Returns
    -------
    object
        What the function gives, or :class:`Failed`.

    Raises
    ------
    Exception
        One of ``TRANSIENT``, for which Dask repeats the task.
    """
    _divide_processors(terms.threads.get(socket.gethostname(), 1))
    worker = distributed.get_worker()
    watch = Timer(terms.limit_s, _end_hanging, (worker, terms.limit_s))
    watch.daemon = True
    if worker.nanny is not None:
        # which starts another worker
        watch.start()
    try:
        known = read_job(job)
        return _result(known.function, known.items[number])
    finally:
        watch.cancel()
        # what a task was made of may refer to itself, and is large
        gc.collect()
        publish()


def run_merge(job: Path, one: Any, other: Any) -> Any:
    """Merge two results of a job, or hand on that one of them failed."""
    for part in (one, other):
        if isinstance(part, Failed):
            return part
    merge = read_job(job).merge
    assert merge is not None
    return _result(merge, one, other)


def read_job(path: Path) -> Job:
    """What :class:`.DaskEngine` has written; that of the last stage is kept."""
    with _reading:
        return _read(path)


@lru_cache(maxsize=1)
def _read(path: Path) -> Job:
    with path.open("rb") as file:
        return pickle.load(file)


def _result(function: Callable[..., Any], *arguments: Any) -> Any:
    try:
        return function(*arguments)
    except TRANSIENT:
        raise
    except Exception as error:
        if not isinstance(error, InputError):
            error.add_note(f"of a worker:\n{traceback.format_exc()}")
        return Failed(error)


def _divide_processors(n: int) -> None:
    """Let products of matrices use so many threads in this process from now on."""
    with _dividing:
        if _threads[0] != n:
            threadpool_limits(n, "blas")
            _threads[0] = n


def _end_hanging(worker: distributed.Worker, limit_s: float) -> None:
    """End this worker, one of whose tasks hangs: threads cannot be ended, and Dask starts anew."""
    worker.log_event(HANGS, {"worker": worker.address, "limit_s": limit_s})
    # what is logged is sent a moment later
    Timer(1.0, os.kill, (os.getpid(), signal.SIGKILL)).start()
