"""Which engine carries out the tasks of a run: this process, workers of its own, or a cluster."""

from __future__ import annotations

import asyncio
import gc
import logging
import os
import signal
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from importlib.util import find_spec
from threading import current_thread, main_thread

import jax

from lusee_bayes.core.engine import SIDE_BY_SIDE, Demand, Engine, ThisProcess
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.files import uninterrupted
from lusee_bayes.core.memory import gigabytes, memory_limit
from lusee_bayes.core.threads import processors, threads

# the variable by which Dask's own programs are told of a cluster
SCHEDULER = "DASK_SCHEDULER_ADDRESS"
# workers pay where each has two processors for each of its tasks, and the run takes long enough
# for them to start: on two processors a second process gains nothing (docs/cubes.md)
PROCESSORS_OF_WORKER, LONG_S = 2 * SIDE_BY_SIDE, 60.0
# of workers of our own. Dask makes glibc return memory early (MALLOC_TRIM_THRESHOLD_), which fixes
# at 128 kB the size from which every array is new memory that the system clears: a third more time
# for a channel; this is the largest size. And no worker has tasks that wait for others
OWN = {
    "distributed.nanny.pre-spawn-environ.MALLOC_MMAP_THRESHOLD_": 32 << 20,
    "distributed.scheduler.worker-saturation": 1.0,
}
# seconds in which a scheduler has to answer
ANSWER_S = 10.0


@contextmanager
def open_engine(
    demand: Demand,
    workers: int | None = None,
    cluster: str | None = None,
    *,
    verbose: bool = False,
    say: Callable[[str], None] = lambda line: None,
) -> Iterator[Engine]:
    """Start what is to carry out the tasks of a run, and end it after the block.

    Parameters
    ----------
    demand : Demand
        What the tasks take.
    workers : int, optional
        Processes of this machine; one is this process, without any server. By default as many as
        pay.
    cluster : str, optional
        Address of the scheduler of a Dask cluster, as tcp://host:8786; by default that of the
        environment variable ``DASK_SCHEDULER_ADDRESS``, if it is set.
    verbose : bool
        Say where Dask's dashboard is.
    say : callable
        Prints a line.

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
        raise InputError("--workers starts workers of its own, --cluster uses others; give one")
    if workers is None and cluster is None:
        cluster = os.environ.get(SCHEDULER) or None
    if workers != 1:
        # before JAX starts: workers on the same GPU as this process need some of its memory
        os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
    with ExitStack() as stack:
        if cluster is not None:
            _require_dask("--cluster")
            place: object = cluster
        else:
            wanted = workers_that_pay(demand) if workers is None else workers
            if wanted == 1:
                fits = demand.process_bytes() <= memory_limit()
                gc.freeze()  # modules stay: they need not be searched
                yield ThisProcess(demand.side_by_side if fits else 1)
                return
            _require_dask("--workers")
            place = stack.enter_context(_own_workers(wanted, demand, verbose))
        yield stack.enter_context(_connected(place, demand, verbose, say))


def workers_that_pay(demand: Demand) -> int:
    """How many workers are worth starting on this machine; 1 is this process."""
    if not _dask_is_there():
        return 1
    devices = _gpus()
    if devices > 1:
        return min(devices, demand.n_tasks)
    if demand.seconds < LONG_S:
        return 1
    by_memory = int(memory_limit() // demand.process_bytes())
    by_tasks = demand.n_tasks // demand.side_by_side
    return max(1, min(processors() // PROCESSORS_OF_WORKER, by_memory, by_tasks))


def _gpus() -> int:
    return len(jax.local_devices()) if jax.default_backend() == "gpu" else 0


def _dask_is_there() -> bool:
    return find_spec("distributed") is not None


def _require_dask(option: str) -> None:
    if not _dask_is_there():
        raise InputError(
            f"{option} needs Dask; install it with pip install '.[cluster]' in the clone of "
            "lusee_bayes"
        )


@contextmanager
def _own_workers(n: int, demand: Demand, verbose: bool) -> Iterator[object]:
    """A cluster of this machine alone, whose processors and memory its workers share."""
    import dask
    import distributed

    n_gpus = _gpus()
    if n_gpus and n > n_gpus:
        raise InputError(f"--workers {n}: this machine has {n_gpus} GPU(s), one for each worker")
    side_by_side = 1 if n_gpus else min(demand.side_by_side, max(1, processors() // n))
    needed, share = demand.process_bytes(side_by_side), memory_limit() / n
    if needed > share:
        fit = int(memory_limit() // demand.process_bytes(1))
        raise InputError(
            f"{n} workers need about {gigabytes(n * needed)} of memory; this machine has "
            f"{gigabytes(memory_limit())}: " + (f"use --workers {fit}" if fit > 0 else "use none")
        )
    local = {"host": "127.0.0.1"}
    server = {**local, "port": 0, "dashboard": verbose, "dashboard_address": "127.0.0.1:0"}
    options = {**local, "nthreads": side_by_side, "memory_limit": int(share)}
    options["silence_logs"] = logging.CRITICAL
    nannies = [
        {"cls": distributed.Nanny, "options": {**options, "env": _environment(worker, n_gpus)}}
        for worker in range(n)
    ]
    with _quiet(), dask.config.set(OWN):
        # Ctrl-C ends the command, which ends them: they do not hear it
        with _ignoring_interrupts():
            own = distributed.SpecCluster(
                scheduler={"cls": distributed.Scheduler, "options": server},
                workers=dict(enumerate(nannies)),
                silence_logs=logging.CRITICAL,
                name="lusee_bayes",
            )
        with own:
            yield own


def _environment(worker: int, n_gpus: int) -> dict[str, str]:
    """What a worker has besides what this process has."""
    if n_gpus == 0:
        return {}
    # a GPU each, of those that this process may see
    seen = os.environ.get("CUDA_VISIBLE_DEVICES")
    names = seen.split(",") if seen else [str(number) for number in range(n_gpus)]
    return {"CUDA_VISIBLE_DEVICES": names[worker]}


@contextmanager
def _connected(
    place: object, demand: Demand, verbose: bool, say: Callable[[str], None]
) -> Iterator[Engine]:
    import distributed

    from lusee_bayes.core.dask_engine import DaskEngine

    with _quiet():
        if isinstance(place, str):
            _require_address(place)
            _require_answer(place)
        try:
            # one that is not finished complains when it is forgotten
            with uninterrupted():
                client = distributed.Client(place, timeout=ANSWER_S, set_as_default=False)
        except (OSError, ValueError) as error:
            raise _no_answer(place, error) from error
        try:
            if verbose:
                there = "dashboard" in client.scheduler_info()["services"]
                say(f"  Dask's dashboard: {client.dashboard_link if there else 'none'}")
            yield DaskEngine(client, demand)
        finally:
            client.close()


def _require_address(address: str) -> None:
    import distributed

    try:
        distributed.comm.addressing.get_address_host_port(address, strict=True)
    except ValueError as error:
        raise InputError(
            f"'{address}' is no address of a Dask scheduler ({' '.join(str(error).split())}); give "
            f"--cluster, or {SCHEDULER}, as tcp://host:8786"
        ) from error
    secret = distributed.Security().get_connection_args("client")["ssl_context"] is not None
    if address.startswith(("tls:", "wss:")) and not secret:
        raise InputError(
            f"'{address}' needs certificates; name them in Dask's configuration, under "
            "distributed.comm.tls"
        )


def _require_answer(address: str) -> None:
    """Ask a scheduler who it is; a Client waits for ever where connections meet silence."""
    import distributed

    async def ask() -> None:
        arguments = distributed.Security().get_connection_args("client")
        async with distributed.rpc(address, timeout=ANSWER_S, connection_args=arguments) as server:
            await asyncio.wait_for(server.identity(), ANSWER_S)

    try:
        # in a thread: this one may have a loop that runs, as in a notebook
        with threads(1) as pool:
            pool.submit(asyncio.run, ask()).result()
    except (OSError, ValueError, MemoryError) as error:
        # MemoryError: Dask reads the length of a message from whatever a web server answers
        raise _no_answer(address, error) from error


def _no_answer(place: object, error: Exception) -> InputError:
    why = " ".join(str(error).split())[:200] or f"silent for {ANSWER_S:g} s"
    return InputError(
        f"no Dask scheduler answers at '{place}' ({why}); start one with: dask scheduler. Its "
        "address ends in 8786 by default, that of its dashboard in 8787"
    )


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep Dask from writing into the terminal what the engine says in one sentence."""
    loggers = [logging.getLogger(n) for n in logging.root.manager.loggerDict if "distributed" in n]
    before = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        for logger, level in zip(loggers, before, strict=True):
            logger.setLevel(level)


@contextmanager
def _ignoring_interrupts() -> Iterator[None]:
    """Ignore Ctrl-C during the block, and for ever in processes that are started in it."""
    if current_thread() is not main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
