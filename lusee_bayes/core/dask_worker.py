"""What a worker of Dask does for a run: it carries out tasks, if it can."""

from __future__ import annotations

import gc
import os
import pickle
import signal
import socket
import sys
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from threading import TIMEOUT_MAX, Lock, Timer
from typing import Any

import dask
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
_jobs: dict[Path, Job] = {}


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
    """Under which conditions tasks are carried out.

    Attributes
    ----------
    versions : str
        Those that code is sent between processes by.
    folder : Path
        Of the run.
    demand : Demand or None
        What a task takes.
    process : str
        Of the command, which stays as it is where a worker is a thread of it.
    limit_s : float
        A task that takes longer hangs: its worker is ended.
    threads : mapping
        For products of matrices, by host name.
    """

    versions: str
    folder: Path
    demand: Demand | None
    process: str
    limit_s: float = TIMEOUT_MAX
    threads: Mapping[str, int] = field(default_factory=dict)


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
    worker = distributed.get_worker()
    if refusal := refusal_of(terms, worker):
        return Failed(InputError(refusal))
    own = this_process() != terms.process
    if own:
        _prepare()
        share = processors() // worker.state.nthreads
        _divide_processors(terms.threads.get(socket.gethostname(), max(1, share)))
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
        if own:
            publish()


def refusal_of(terms: Terms, dask_worker: distributed.Worker) -> str | None:
    """Why a worker cannot do what a command asks for, in one sentence; None if it can.

    Dask gives the worker to an argument of this name.
    """
    here = f"worker {dask_worker.address} on {socket.gethostname()}"
    if versions() != terms.versions:
        return f"{here} has {versions()}, the command {terms.versions}; install the same on both"
    limit, n = dask_worker.memory_manager.memory_limit, dask_worker.state.nthreads
    if terms.demand is not None and limit and terms.demand.process_bytes(n) > limit:
        return (
            f"{here} may take {gigabytes(limit)} of memory, and {n} task(s) at a time need about "
            f"{gigabytes(terms.demand.process_bytes(n))}; start it with a larger --memory-limit or "
            "fewer --nthreads"
        )
    if not terms.folder.is_dir():
        return (
            f"{here} does not see '{terms.folder}'; command and workers have to share a disk: give "
            "a folder on it with -o"
        )
    return None


def versions() -> str:
    """Those that code is sent between processes by."""
    return f"lusee_bayes {__version__} and Python {sys.version_info.major}.{sys.version_info.minor}"


def this_process() -> str:
    """A name that no other process has."""
    return f"{socket.gethostname()} {os.getpid()}"


def host_of_worker() -> tuple[str, int]:
    """Name of this host, and how many of its processors may be used."""
    return socket.gethostname(), processors()


@lru_cache(maxsize=1)
def _prepare() -> None:
    """Let this process work as one of a command does."""
    gc.set_threshold(100_000, 20, 100)
    use_compilation_cache()
    # xarray would ask the scheduler for a lock for every file, over a client of its own
    dask.config.set(scheduler="threads")


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
        if path not in _jobs:
            # not both at a time
            _jobs.clear()
            with path.open("rb") as file:
                _jobs[path] = pickle.load(file)
        return _jobs[path]


def _result(function: Callable[..., Any], *arguments: Any) -> Any:
    try:
        return function(*arguments)
    except TRANSIENT:
        raise
    except InputError as error:
        return Failed(error)
    except Exception as error:
        found = _to_send(error)
        found.add_note(f"of a worker:\n{traceback.format_exc()}")
        return Failed(found)


def _to_send(error: Exception) -> Exception:
    """The same, or its words where it would not arrive."""
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:
        return RuntimeError(f"{type(error).__name__}: {error}")
    return error


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
