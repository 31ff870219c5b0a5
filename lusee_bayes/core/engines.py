"""Which engine carries out the tasks of a run: this process, workers of its own, or a cluster."""

from __future__ import annotations

import gc
import os
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from importlib.util import find_spec

from lusee_bayes.core.engine import Demand, Engine, ThisProcess
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.progress import memory_limit

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
        raise InputError("--workers starts workers of its own, --cluster uses others; give one")
    if workers is None:
        cluster, workers = cluster or os.environ.get(SCHEDULER), 1
    if not cluster and workers == 1:
        fits = demand.process_bytes() <= memory_limit()
        gc.freeze()  # modules stay: they need not be searched
        yield ThisProcess(demand.side_by_side if fits else 1)
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
