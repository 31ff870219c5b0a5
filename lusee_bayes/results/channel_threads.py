"""A function of every channel of this process, shared out among its devices."""

from __future__ import annotations

import gc
from collections.abc import Callable, Sequence
from concurrent.futures import as_completed
from threading import Event, Lock

import jax

from lusee_bayes.core.process_group import ProcessGroup
from lusee_bayes.core.progress import Stages
from lusee_bayes.core.threads import threads
from lusee_bayes.experiment.scenario import Scenario

# threads that share a device: while one waits for numbers the other makes some
THREADS_PER_DEVICE = 2


def each_channel(
    function: Callable[[Scenario], None],
    channels: Sequence[Scenario],
    group: ProcessGroup,
    stages: Stages,
    name: str,
) -> None:
    """Call ``function`` with the scenario of every channel that is this process's.

    Parameters
    ----------
    function : callable
    channels : sequence of Scenario
        Of the whole run.
    group : ProcessGroup
    stages : Stages
        Told how many are done.
    name : str
        Of the stage.
    """
    mine = group.mine(channels)
    n_threads = min(THREADS_PER_DEVICE * len(jax.local_devices()), len(mine))
    gc.freeze()  # modules stay: they need not be searched
    stopped, counting, finished = Event(), Lock(), 0
    with stages.progress(name, len(mine)) as done:

        def run(thread: int) -> None:
            nonlocal finished
            with jax.default_device(group.device_of(thread)):
                for number in range(thread, len(mine), n_threads):
                    if stopped.is_set():
                        return
                    function(mine[number])
                    # what a channel was made of may refer to itself, and is large
                    gc.collect()
                    with counting:
                        finished += 1
                        done(finished, f"{mine[number].frequency_mhz:g} MHz")

        # a channel on each of two processors takes less than two after another on both
        with threads(max(n_threads, 1)) as pool:
            running = [pool.submit(run, thread) for thread in range(n_threads)]
            try:
                for thread in as_completed(running):
                    thread.result()
            finally:
                stopped.set()
