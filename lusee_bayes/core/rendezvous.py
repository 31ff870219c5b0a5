"""How the processes of a run find each other, and what happens when one of them ends.

How a run is started, and not its code, says over how many processes it is spread. Several
processes make up one run if the launcher started them on this machine, or if Slurm did (``srun``);
else there is one. Under Slurm JAX gives every process the one GPU of its rank on the node; a single
process per node gets several by ``JAX_LOCAL_DEVICE_IDS=0,1,2,3``.

When a process ends before the others, they end too, after ``HEARTBEAT`` seconds at most. Those
that wait for a sum raise :class:`ProcessLost`; but mostly JAX aborts them first, with a message
that Python cannot replace (*Terminating process because the JAX distributed service detected fatal
errors ... another task died*). On one machine the launcher ends them before that, and says which
process failed.
"""

from __future__ import annotations

import atexit
import inspect
import os
import sys
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import jax

from lusee_bayes.core.errors import InputError
from lusee_bayes.core.process_group import ProcessGroup

# the launcher sets these for each process: host:port of the first one, how many there are, which
# one it is, and a pipe that closes when the launcher ends
COORDINATOR = "LUSEE_BAYES_COORDINATOR"
PROCESSES = "LUSEE_BAYES_PROCESSES"
PROCESS = "LUSEE_BAYES_PROCESS"
LEASH = "LUSEE_BAYES_LEASH"

# what srun sets for every process of a step; sbatch alone does not set the last two
SLURM = ("SLURM_JOB_ID", "SLURM_PROCID", "SLURM_STEP_NODELIST", "SLURM_STEP_NUM_TASKS")

# seconds without a sign of life after which a process counts as dead (an older JAX: always 100)
HEARTBEAT = 30


@contextmanager
def join() -> Iterator[ProcessGroup]:
    """Join the run that the environment variables describe, before JAX computes anything.

    At the end of the ``with`` block all processes wait for each other. A process that leaves it by
    an exception does not wait: it exits, and JAX or the launcher end the others.

    Yields
    ------
    ProcessGroup
        Of one process where the environment describes no run.

    Raises
    ------
    InputError
        If the launcher's environment variables contradict each other, or JAX cannot start.
    """
    _end_with_launcher()
    settings = _launched(os.environ) or _slurm(os.environ)
    if settings is None:
        yield ProcessGroup()
        return
    try:
        group = _start(settings)
        yield group
        group.barrier("end")
    except BaseException as error:
        # runs before JAX's own, which would wait for the others for minutes
        atexit.register(_leave, _exit_code(error))
        raise


def is_launched() -> bool:
    """Return whether the launcher has started this process."""
    return COORDINATOR in os.environ


def _launched(environment: Mapping[str, str]) -> dict[str, Any] | None:
    """Settings of JAX for a process of the launcher, None if this is not one."""
    if COORDINATOR not in environment:
        return None
    try:
        n, k = (int(environment[name]) for name in (PROCESSES, PROCESS))
    except (KeyError, ValueError):
        n = k = 0
    if not 0 <= k < n:
        raise InputError(
            f"{COORDINATOR} is set, but {PROCESSES} and {PROCESS} are not numbers n and 0..n-1; "
            "unset it, or set all three"
        )
    if n == 1:
        return None
    address = environment[COORDINATOR]
    return {
        "coordinator_address": address,
        "coordinator_bind_address": address,
        "num_processes": n,
        "process_id": k,
        # a GPU each, where there are some
        "local_device_ids": None if "JAX_LOCAL_DEVICE_IDS" in environment else [k],
        "cluster_detection_method": "deactivate",
    }


def _slurm(environment: Mapping[str, str]) -> dict[str, Any] | None:
    """Settings of JAX for one of several processes of a Slurm step, None if this is not one."""
    if any(name not in environment for name in SLURM):
        return None
    several = int(environment["SLURM_STEP_NUM_TASKS"]) > 1
    return {"cluster_detection_method": "slurm"} if several else None


def _start(settings: dict[str, Any]) -> ProcessGroup:
    jax.config.update("jax_cpu_collectives_implementation", "gloo")
    # with it, SIGTERM would not end a process
    if hasattr(jax.config, "jax_enable_preemption_service"):
        jax.config.update("jax_enable_preemption_service", False)
    if "coordinator_address" in settings:
        # the launcher keeps proxies out
        jax.config.update("jax_check_proxy_envs", False)
    if "heartbeat_timeout_seconds" in inspect.signature(jax.distributed.initialize).parameters:
        settings = settings | {"heartbeat_timeout_seconds": HEARTBEAT}
    jax.distributed.initialize(**settings)
    try:
        jax.local_devices()
    except RuntimeError as error:
        raise InputError(
            f"JAX cannot start here: {' '.join(str(error).split())[:300]} (are there more "
            "processes than GPUs, or does this machine's own name not resolve?)"
        ) from error
    group = ProcessGroup(jax.process_count(), jax.process_index())
    # processes connect at their first sum, and have to come to it within 30 s of each other
    with _silent_stdout():
        group.barrier("start")
    return group


@contextmanager
def _silent_stdout() -> Iterator[None]:
    """Discard what C++ code prints: Gloo reports its connections."""
    sys.stdout.flush()
    kept = os.dup(1)
    with open(os.devnull, "wb") as nowhere:
        os.dup2(nowhere.fileno(), 1)
    try:
        yield
    finally:
        os.dup2(kept, 1)
        os.close(kept)


def _end_with_launcher() -> None:
    """End this process when its launcher ends, for whatever reason."""
    if LEASH not in os.environ:
        return
    # processes that this one starts must not inherit it
    leash = int(os.environ.pop(LEASH))

    def wait():
        os.read(leash, 1)
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()


def _exit_code(error: BaseException) -> int:
    if isinstance(error, SystemExit):
        return error.code if isinstance(error.code, int) else int(error.code is not None)
    if isinstance(error, KeyboardInterrupt):
        return 130
    return 2 if isinstance(error, InputError) else 1


def _leave(code: int) -> None:
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)
