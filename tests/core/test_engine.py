"""Tasks in threads: order, progress, failures, the tree of a sum, and what is shared."""

import gc
import io
import os
import socketserver
import threading
import time
from dataclasses import replace

import pytest
from assertions import refuse
from rich.console import Console

from lusee_bayes.core import engine, progress
from lusee_bayes.core.errors import InputError

DEMAND = engine.Demand(base_bytes=1e9, task_bytes=1e9)


@pytest.fixture(autouse=True, scope="module")
def frozen():
    """As open_engine does: what other tests have left is not searched behind every task."""
    gc.freeze()


def tasks_of(function, n):
    return engine.Tasks(function, range(n), [f"number {k}" for k in range(n)])


def tree(parts):
    """Neighbours first, then their neighbours; one that has none waits for the next level."""
    while len(parts) > 1:
        pairs = [parts[k : k + 2] for k in range(0, len(parts), 2)]
        parts = [pair[0] if len(pair) == 1 else f"({pair[0]}+{pair[1]})" for pair in pairs]
    return parts[0]


def joined(a, b):
    return f"({a}+{b})"


@pytest.mark.parametrize(("n", "side_by_side"), [(1, 2), (2, 1), (3, 2), (7, 5), (12, 2)])
def test_results_come_in_order_and_merge_as_a_tree(n, side_by_side):
    found, stages = engine.ThisProcess(side_by_side), progress.Stages()
    assert found.each(tasks_of(lambda k: k * k, n), stages, "s") == [k * k for k in range(n)]
    assert found.reduced(tasks_of(str, n), joined, stages, "sum") == tree([*map(str, range(n))])
    assert [*stages.seconds] == ["s", "sum"]


def test_so_many_are_carried_out_at_a_time():
    """Each waits until another one has begun: with one thread nobody would come."""
    together = threading.Barrier(2, timeout=20)

    def meet(k):
        together.wait()
        return k

    assert engine.ThisProcess(2).each(tasks_of(meet, 6), progress.Stages(), "s") == list(range(6))
    now = set()

    def alone(k):
        now.add(k)
        time.sleep(0.005)
        assert now == {k}
        now.remove(k)

    engine.ThisProcess(1).each(tasks_of(alone, 5), progress.Stages(), "s")


def test_a_failure_ends_the_stage():
    begun = []

    def fail(k):
        begun.append(k)
        if k == 1:
            raise InputError("of number 1")
        time.sleep(0.2)

    refuse("of number 1", engine.ThisProcess(1).each, tasks_of(fail, 5), progress.Stages(), "s")
    assert begun[:2] == [0, 1] and len(begun) < 4
    assert engine.ThisProcess().each(tasks_of(abs, 0), progress.Stages(), "s") == []


def opened(demand=DEMAND, **given):
    with engine.open_engine(demand, **given):
        pass


def test_one_worker_is_this_process_which_needs_no_dask(monkeypatch):
    # a machine of 64 GB, without a cluster
    monkeypatch.setattr(engine, "memory_limit", lambda: 64 * 10**9)
    monkeypatch.delenv(engine.SCHEDULER, raising=False)
    monkeypatch.setattr(engine, "find_spec", lambda name: None)
    for n in (None, 1):
        with engine.open_engine(DEMAND, n) as found:
            assert found == engine.ThisProcess(2)
    # two at a time would not fit
    with engine.open_engine(replace(DEMAND, task_bytes=40e9)) as found:
        assert found == engine.ThisProcess(1)
    for given in ({"workers": 2}, {"cluster": "tcp://127.0.0.1:1"}):
        refuse("Dask.*pip", opened, **given)


NOT_STARTED = [
    ({"workers": 2, "cluster": "tcp://x:1"}, "give one"),
    ({"workers": 12}, "12 workers need 1.* GB of .* GB: use fewer"),
    ({"cluster": "nonsense:x"}, "no Dask scheduler answers at 'nonsense:x' .* as tcp://"),
    ({"cluster": "tls://127.0.0.1:1"}, "no Dask scheduler answers .*TLS"),
]


@pytest.mark.parametrize(("given", "message"), NOT_STARTED)
def test_what_cannot_be_started_is_refused(given, message):
    pytest.importorskip("distributed")
    refuse(message, opened, replace(DEMAND, task_bytes=1e13), **given)


ANSWERS = [b"", b"HTTP/1.0 400 Bad Request\r\n\r\n"]


@pytest.mark.parametrize("answer", ANSWERS, ids=["silent", "HTTP"])
def test_what_is_no_scheduler_is_refused_in_seconds(answer, monkeypatch):
    """A Client would wait for ever, deaf to Ctrl-C, or ask for exabytes of memory."""
    monkeypatch.setattr(pytest.importorskip("lusee_bayes.core.dask_engine"), "ANSWER_S", 0.5)

    class Answer(socketserver.BaseRequestHandler):
        def handle(self):
            self.request.sendall(answer)
            self.request.recv(1 << 16)

    with socketserver.ThreadingTCPServer(("127.0.0.1", 0), Answer) as server:
        server.daemon_threads, server.block_on_close = True, False
        threading.Thread(target=server.serve_forever, args=(0.05,), daemon=True).start()
        address = f"tcp://127.0.0.1:{server.server_address[1]}"
        refuse("no Dask scheduler answers", opened, cluster=address)
        server.shutdown()


def test_results_of_threads_come_in_order_and_an_error_is_the_callers():
    meeting = threading.Barrier(2, timeout=30)

    def late(k: int) -> float:
        if k < 2 and (os.cpu_count() or 1) > 1:
            meeting.wait()  # which ends only if both have begun
        time.sleep(0.002 * abs(7 - k))
        return 1.0 / (k - 8)

    assert engine.in_threads(late, range(8)) == [1.0 / (k - 8) for k in range(8)]
    assert engine.in_threads(late, []) == []
    with pytest.raises(ZeroDivisionError):
        engine.in_threads(late, range(6, 10))


def test_what_is_shared_is_computed_once():
    class Shared:
        count = 0

        @engine.once
        def value(self) -> int:
            time.sleep(0.01)
            Shared.count += 1
            return 42

    shared = Shared()
    assert engine.in_threads(lambda _: shared.value, range(6)) == [42] * 6
    assert Shared.count == 1


@pytest.mark.parametrize(("line_s", "expected"), [(0.0, range(5, 100, 5)), (10.0, [])])
def test_a_file_has_a_line_for_each_five_percent_of_long_stages(line_s, expected, monkeypatch):
    monkeypatch.setattr(progress, "LINE_S", line_s)
    file = io.StringIO()
    with progress.Stages(Console(file=file)).progress("channels [x]", 200) as done:
        for number in range(1, 201):
            done(number, "20 MHz")
    *lines, last = file.getvalue().splitlines()
    assert lines == [f"  channels [x]: {2 * p} of 200 ({p}%) 20 MHz" for p in expected]
    assert last.split()[-1] == "s"
