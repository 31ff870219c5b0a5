"""Tasks on workers of Dask: the same numbers, and workers that die or lack memory."""

import gc
import os
import signal
import time
from pathlib import Path

import numpy as np
import pytest
from assertions import refuse
from core.test_engine import joined, tasks_of, tree
from threadpoolctl import threadpool_info

from lusee_bayes.core import dask_engine
from lusee_bayes.core.dask_engine import DaskEngine
from lusee_bayes.core.engine import Demand, open_engine, processors
from lusee_bayes.core.errors import InputError, WorkersLost
from lusee_bayes.core.progress import Stages

distributed = pytest.importorskip("distributed")

SMALL = Demand(base_bytes=1e6, task_bytes=1e6)


@pytest.fixture(scope="module")
def engine(tmp_path_factory):
    """Of workers that are processes of their own."""
    with open_engine(SMALL, workers=2) as found:
        found.work_in(tmp_path_factory.mktemp("run"))
        yield found


def cluster_of(workers):
    scheduler = {
        "cls": distributed.Scheduler,
        "options": {"host": "127.0.0.1", "port": 0, "dashboard": False},
    }
    return distributed.SpecCluster(scheduler=scheduler, workers=workers)


class Said(Stages):
    """Keeps the lines."""

    def __init__(self):
        super().__init__()
        self.lines = []

    def say(self, text):
        self.lines.append(text)


@pytest.mark.parametrize("n", [1, 3, 12])
def test_results_come_in_order_and_merge_as_a_tree(engine, n):
    assert engine.each(tasks_of(lambda k: k * k, n), Stages(), "s") == [k * k for k in range(n)]
    assert engine.reduced(tasks_of(str, n), joined, Stages(), "s") == tree([*map(str, range(n))])
    assert engine.each(tasks_of(abs, 0), Stages(), "s") == []


def test_tasks_share_what_is_large(engine):
    large = np.arange(1e6)
    found = engine.each(tasks_of(lambda k: (large[k], os.getpid()), 6), Stages(), "s")
    assert [f[0] for f in found] == list(range(6))
    assert os.getpid() not in {f[1] for f in found}


def blas_threads(_):
    """Those that products of matrices use here."""
    assert np.ones((2, 2)) @ np.ones((2, 2)) is not None
    return {pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"}


def test_processors_are_divided_among_workers(engine):
    expected = {max(1, processors() // 2)} if processors() < 4 else {max(1, processors() // 4)}
    assert engine.each(tasks_of(blas_threads, 2), Stages(), "s") == [expected, expected]


def test_a_failure_of_ours_ends_the_stage_as_it_is(engine):
    def fail(k):
        raise InputError(f"of number {k}")

    refuse("^of number 0$", engine.each, tasks_of(fail, 1), Stages(), "s")
    refuse("^of number ", engine.reduced, tasks_of(fail, 3), joined, Stages(), "s")

    def wrong(k):
        return 1 // (k - k)

    with pytest.raises(ZeroDivisionError) as caught:
        engine.each(tasks_of(wrong, 1), Stages(), "s")
    assert "wrong" in [frame.name for frame in caught.traceback]

    class Two(Exception):
        """What cannot be sent arrives in words."""

        def __init__(self, a, b):
            super().__init__(f"{a} and {b}")

    def unsent(k):
        raise Two("one", "other")

    with pytest.raises(Exception, match="one and other"):
        engine.each(tasks_of(unsent, 1), Stages(), "s")


def attempts(folder: Path, k: int) -> int:
    """How often a task has been begun, this time included."""
    (folder / f"{k}-{time.monotonic_ns()}").touch()
    return len(list(folder.glob(f"{k}-*")))


def test_lack_of_memory_or_disk_is_tried_again(engine, tmp_path):
    def short(k):
        if attempts(tmp_path, k) < 3:
            raise MemoryError("none left")
        return k

    assert engine.each(tasks_of(short, 3), Stages(), "s") == [0, 1, 2]

    def full(k):
        attempts(tmp_path, 10 + k)
        raise OSError(28, "No space left on device")

    with pytest.raises(OSError, match="No space left on device"):
        engine.each(tasks_of(full, 1), Stages(), "maps")
    # on a busy machine, one may die after it got the task and before it begins
    assert len(list(tmp_path.glob("10-*"))) in (3, 4)


@pytest.mark.essential
def test_a_task_whose_worker_dies_is_done_again_elsewhere(engine, tmp_path):
    def die(k):
        if k == 2 and attempts(tmp_path, k) < 3:
            os.kill(os.getpid(), signal.SIGKILL)
        return k

    said = Said()
    assert engine.each(tasks_of(die, 5), said, "s") == list(range(5))
    assert len(list(tmp_path.glob("2-*"))) == 3
    told = [line for line in said.lines if "worker" in line]
    assert told and all("reassigned to others: " in line for line in told)
    assert any("number 2" in line for line in told)

    def always(k):
        if k == 1:
            attempts(tmp_path, 10)
            os.kill(os.getpid(), signal.SIGKILL)
        time.sleep(0.1)
        return k

    with pytest.raises(WorkersLost, match="^sums, number 1: 4 workers died on"):
        engine.reduced(tasks_of(always, 3), joined, Stages(), "sums")
    # on a busy machine, one may die after it got the task and before it begins
    assert len(list(tmp_path.glob("10-*"))) in (3, 4)
    # and what comes next is not affected
    assert engine.each(tasks_of(abs, 4), Stages(), "s") == [0, 1, 2, 3]


@pytest.mark.long
def test_a_task_that_takes_too_much_memory_is_named(tmp_path):
    def hold(k):
        if k == 1:
            held = np.ones(int(4e8 / 8))  # 0.4 GB, and the process's own
            time.sleep(60)
            del held
        return k

    options = {"host": "127.0.0.1", "nthreads": 1, "memory_limit": 500_000_000}
    nanny = {"cls": distributed.Nanny, "options": options}
    with (
        cluster_of({0: nanny, 1: nanny}) as own,
        distributed.Client(own, set_as_default=False) as client,
    ):
        engine = DaskEngine(client)
        engine.work_in(tmp_path)
        with pytest.raises(WorkersLost, match=r"maps, number 1: 4 workers .* or out of memory"):
            engine.each(tasks_of(hold, 2), Stages(), "maps")


LARGE = Demand(base_bytes=1e9, task_bytes=1e15)


def test_workers_that_cannot_do_it_are_refused(engine, tmp_path, monkeypatch):
    new = DaskEngine(engine.client)
    refuse(r"memory.*1 task\(s\)", DaskEngine(engine.client, LARGE).work_in, tmp_path)
    refuse("gone'.*command and workers", new.work_in, tmp_path / "gone")
    with monkeypatch.context() as patch:
        patch.setattr(dask_engine, "code_versions", lambda: "lusee_bayes 0.0 and Python 3.0")
        refuse(r"lusee_bayes.*command lusee_bayes 0\.0", new.work_in, tmp_path)
    with pytest.raises(RuntimeError, match="call work_in first"):
        DaskEngine(engine.client).each(tasks_of(abs, 1), Stages(), "s")


def test_threads_of_this_process_leave_it_as_it_is(tmp_path):
    before = blas_threads(0), gc.get_threshold(), os.getcwd()
    with distributed.Client(
        processes=False, n_workers=2, threads_per_worker=1, dashboard_address=None,
        set_as_default=False,
    ) as client:  # fmt: skip
        engine = DaskEngine(client)
        engine.work_in(tmp_path)
        assert engine.each(tasks_of(abs, 3), Stages(), "s") == [0, 1, 2]
    assert (blas_threads(0), gc.get_threshold(), os.getcwd()) == before


@pytest.mark.essential
def test_a_scheduler_without_workers_ends_the_run_where_it_is_told_to(tmp_path):
    dask = pytest.importorskip("dask")
    with (
        dask.config.set({"distributed.scheduler.no-workers-timeout": "1s"}),
        cluster_of(None) as own,
        open_engine(SMALL, cluster=own.scheduler_address) as engine,
    ):
        engine.work_in(tmp_path)
        with pytest.raises(WorkersLost, match="has no workers"):
            engine.each(tasks_of(abs, 2), Stages(), "s")
