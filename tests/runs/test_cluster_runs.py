"""Runs on a real cluster: a scheduler and three workers, started as a user starts them."""

import json
import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from assertions import assert_same_map
from commands import posterior_of, sets, sky_draws_of

import lusee_bayes as lb
from lusee_bayes.core.engine import ThisProcess

pytest.importorskip("distributed")

TWELVE = [12.0 + 2 * k for k in range(12)]
SETTINGS = ["lmax=6", "observation.runs.0.cycles=0.1"]
MAP = ["map", "fiducial", "--frequencies", "12:34:2", "--draws", "3", *sets(*SETTINGS)]

# listens to Ctrl-C even where the tests run in the background, which ignores it
PROGRAM = """
import signal, sys
from lusee_bayes.cli.main import main
signal.signal(signal.SIGINT, signal.default_int_handler)
if __name__ == "__main__":
    sys.exit(main())
"""


def wait_for(condition, seconds=60):
    """Until it is so."""
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


class Cluster:
    """Processes of ``dask scheduler`` and ``dask worker``, in a folder of their own."""

    def __init__(self, folder: Path):
        self.folder, self.workers = folder, []
        patience = {"DASK_DISTRIBUTED__SCHEDULER__NO_WORKERS_TIMEOUT": "3s"}
        self.environment = os.environ | {"MPLBACKEND": "agg"} | patience
        self.environment["PYTHONPATH"] = os.pathsep.join(path for path in sys.path if path)
        self.start()

    def start(self):
        """A scheduler, anew where one has been killed."""
        written = self.folder / f"scheduler-{time.monotonic_ns()}.json"
        options = ["--host", "127.0.0.1", "--port", "0", "--scheduler-file", str(written)]
        self.scheduler = self._dask("scheduler", "--no-dashboard", *options)
        wait_for(written.is_file)
        wait_for(lambda: written.read_text().endswith("}"))
        self.address = json.loads(written.read_text())["address"]
        self.workers = []

    def add(self, n=3):
        """Workers of one thread."""
        options = ["--nthreads", "1", "--no-dashboard", "--host", "127.0.0.1"]
        self.workers += [self._dask("worker", self.address, *options) for _ in range(n)]

    def command(self, *arguments) -> subprocess.Popen:
        """The command line, as a process."""
        words = [sys.executable, "-c", PROGRAM, *map(str, arguments)]
        environment = self.environment | {"DASK_SCHEDULER_ADDRESS": self.address}
        pipe = subprocess.PIPE
        return subprocess.Popen(words, env=environment, stdout=pipe, stderr=pipe, text=True)

    def kill(self, process: subprocess.Popen):
        """With all that it has started: a nanny's worker ends with it."""
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()

    def close(self):
        for process in (*self.workers, self.scheduler):
            self.kill(process)

    def _dask(self, *words) -> subprocess.Popen:
        options = {"env": self.environment, "cwd": self.folder, "start_new_session": True}
        command, nowhere = [sys.executable, "-m", "dask", *words], subprocess.DEVNULL
        return subprocess.Popen(command, stdout=nowhere, stderr=nowhere, **options)


@pytest.fixture
def cluster(tmp_path):
    found = Cluster(tmp_path)
    found.add()
    yield found
    found.close()


@pytest.fixture(scope="module")
def alone(tmp_path_factory):
    """The same runs in this process, independent and joint, with one thread for each product."""
    folder = tmp_path_factory.mktemp("alone")
    settings = [*SETTINGS, f"frequencies_mhz={TWELVE}", "output.draws=3"]
    for name in ("independent", "joint"):
        scenario = lb.load_scenario("fiducial", [*settings, f"joint={name == 'joint'}".lower()])
        lb.run_map(scenario, folder / name, engine=ThisProcess(2))
    return {name: (folder / name) for name in ("independent", "joint")}


def assert_same(folder: Path, other: Path):
    """Within 1e-9 standard deviations, whatever the threads for products of matrices."""
    expected = posterior_of(other)
    assert_same_map(posterior_of(folder), expected, 1e-9)
    far = np.abs(sky_draws_of(folder) - sky_draws_of(other))
    assert far.shape[1] == 3 and (far / expected["std"].values[:, None]).max() < 1e-9


def finished(folder: Path) -> dict[str, int]:
    """The channels that are there, and when each was written."""
    found = {}
    for path in folder.glob("channels/*.nc"):
        with suppress(FileNotFoundError):
            found[path.name] = path.stat().st_mtime_ns
    return found


def when_some_are_there(process: subprocess.Popen, folder: Path, n: int = 3):
    def enough():
        assert process.poll() is None, process.communicate()
        return len(finished(folder)) >= n

    wait_for(enough, 120)


def goes_on(cluster: Cluster, folder: Path, *more):
    """The same command ends well, and repeats nothing that was finished."""
    before, seen = finished(folder), {}
    process = cluster.command(*MAP, *more, "-o", folder, "-q")
    while process.poll() is None:
        seen |= finished(folder)
        time.sleep(0.01)
    assert process.returncode == 0, process.communicate()
    process.communicate()
    assert before and {name: seen[name] for name in before} == before


@pytest.mark.long
def test_a_cluster_gives_the_same_numbers_though_a_worker_is_killed(cluster, alone, tmp_path):
    process = cluster.command(*MAP, "-o", tmp_path / "a")
    when_some_are_there(process, tmp_path / "a")
    cluster.kill(cluster.workers[0])
    said, errors = process.communicate(timeout=120)
    assert process.returncode == 0, errors
    assert "reassigned to others: " in said
    assert_same(tmp_path / "a", alone["independent"])
    process = cluster.command(*MAP, "--joint", "-o", tmp_path / "b", "-q")
    assert process.communicate(timeout=120) == ("", "") and process.returncode == 0
    assert_same(tmp_path / "b", alone["joint"])


@pytest.mark.long
@pytest.mark.parametrize("killed", ["workers", "scheduler", signal.SIGKILL, signal.SIGINT])
def test_what_is_killed_goes_on_where_it_was(killed, cluster, alone, tmp_path):
    """All workers of a joint run, the scheduler, or the command itself."""
    joint = ["--joint"] if killed == "workers" else []
    process = cluster.command(*MAP, *joint, "-o", tmp_path / "a")
    when_some_are_there(process, tmp_path / "a")
    if killed in ("workers", "scheduler"):
        for one in cluster.workers if killed == "workers" else [cluster.scheduler]:
            cluster.kill(one)
    else:
        process.send_signal(killed)
    _, errors = process.communicate(timeout=120)
    code = {"workers": 1, "scheduler": 1, signal.SIGKILL: -9, signal.SIGINT: 130}[killed]
    assert process.returncode == code
    if code == 1:
        assert errors.startswith("lusee-bayes: the Dask scheduler has ended, has no workers")
    if code != -9:
        assert errors.endswith("the same command continues from the finished channels\n")
    if killed == "scheduler":
        for worker in cluster.workers:
            cluster.kill(worker)
        cluster.start()
    if code == 1:
        cluster.add()
    goes_on(cluster, tmp_path / "a", *joint)
    assert_same(tmp_path / "a", alone["joint" if joint else "independent"])


@pytest.mark.long
def test_workers_of_a_killed_command_end_with_it(tmp_path):
    command = [sys.executable, "-m", "lusee_bayes.cli", *MAP, "--workers", "2", "-q"]
    process = subprocess.Popen([*command, "-o", tmp_path])
    when_some_are_there(process, tmp_path)
    command = ["ps", "-o", "pid=", "--ppid", str(process.pid)]
    started = subprocess.run(command, capture_output=True, text=True).stdout.split()
    assert started
    process.kill()
    process.wait()
    wait_for(lambda: not any(Path(f"/proc/{pid}").exists() for pid in started), 30)
    assert list(tmp_path.glob("channels/*.nc"))


@pytest.mark.long
def test_plans_say_the_same(cluster, tmp_path):
    """Sums of other numbers of threads differ by rounding."""
    options, tables = ["--set", "lmax=6", "--vary", "frequency_mhz=10,20,30"], []
    for name, more in (("one", ["--workers", "1"]), ("own", ["--workers", "2"]), ("all", [])):
        where = ["-o", tmp_path / name, "-q"]
        process = cluster.command("plan", "fiducial", *options, *more, *where)
        _, errors = process.communicate(timeout=200)
        assert process.returncode in (0, 1), errors
        tables.append(pd.read_csv(tmp_path / name / "plan.csv"))
    for table in tables[1:]:
        pd.testing.assert_frame_equal(table, tables[0], rtol=1e-6)
