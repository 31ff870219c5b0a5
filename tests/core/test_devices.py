"""Runs spread over devices and processes: the same numbers, and nobody left waiting."""

import os
import signal
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from lusee_bayes.core.errors import InputError
from lusee_bayes.core.launcher import run_processes
from lusee_bayes.core.process_group import ProcessGroup, use_cpu_devices
from lusee_bayes.core.rendezvous import COORDINATOR, HEARTBEAT, PROCESS, PROCESSES, join

# what each process of a run does; the last argument is a folder for what it finds
CREW = """
import os, sys, time
import jax, numpy as np
import lusee_bayes
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.rendezvous import join

def numbers(k):
    return np.random.default_rng(k).standard_normal((3, 1 << 20))

what, folder = sys.argv[1:]

def here(name, text=""):
    with open(f"{folder}/{name}", "w") as file:
        file.write(text)

def run():
    with join() as group:
        k = group.number
        here(f"pid{k}", str(os.getpid()))
        if what == "sum":
            total = group.total(numbers(k))
            mine = np.array(group.mine(range(7)), dtype=np.float64)
            everything = group.total(np.array([k + 0.5])) + group.total(np.array(k * 0.25))
            np.savez(f"{folder}/{k}.npz", total=total, mine=mine, everything=everything,
                     processes=group.processes, first=group.is_first, devices=jax.device_count())
            print("said by", k)
        elif what == "out of step":
            group.barrier("a" if k == 0 else "b")
        elif what == "wait for 1":
            if k == 1:
                time.sleep(60)
            group.total(np.ones(3))
        elif what == "compute" or (what == "the last finds none" and k == 2):
            time.sleep(60)
        elif what == "one finds bad input" and k == 1:
            raise InputError("the sky is missing")
        elif what == "one fails" and k == 1:
            raise ZeroDivisionError("of process 1")
        elif what in ("all find bad input", "the last finds none"):
            if what == "the last finds none" and k == 0:
                time.sleep(0.5)
            raise InputError("the sky is missing")
    return 1 if what == "a verdict" else 0

if what in ("start slowly", "deaf"):
    import signal
    if what == "deaf":
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    here(f"pid{os.environ['LUSEE_BAYES_PROCESS']}", str(os.getpid()))
    time.sleep(60)
try:
    sys.exit(run())
except InputError as error:
    print(f"crew: {error}", file=sys.stderr)
    sys.exit(2)
except KeyboardInterrupt:
    print("crew: interrupted", file=sys.stderr)
    sys.exit(130)
"""

ROOT = Path(__file__).resolve().parents[2]
# Ctrl-C is listened to even where the tests run in the background, which ignores it
LAUNCH = """
import signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)
from lusee_bayes.core import launcher as processes
processes.GRACE = 1.5
sys.exit(processes.run_processes(int(sys.argv[1]), sys.argv[2:], module="crew"))
"""
PLAIN = {k: v for k, v in os.environ.items() if not k.startswith(("SLURM_", "LUSEE_BAYES_P"))}


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "crew.py").write_text(CREW)
    return tmp_path


def environment(folder: Path, **others: str) -> dict[str, str]:
    return PLAIN | {"PYTHONPATH": f"{folder}{os.pathsep}{ROOT}", "JAX_PLATFORMS": "cpu"} | others


@contextmanager
def launched(n: int, what: str, folder: Path, **others: str):
    """The launcher as a process of its own; its crew is gone behind it, or the test fails."""
    launcher = subprocess.Popen(
        [sys.executable, "-c", LAUNCH, str(n), what, str(folder)],
        env=environment(folder, **others),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        yield launcher
    finally:
        launcher.kill()
        launcher.communicate()
        crew = [int(f.read_text()) for f in folder.glob("pid?")]
        deadline = time.monotonic() + 5
        while any(map(alive, crew)) and time.monotonic() < deadline:
            time.sleep(0.05)
        left = [pid for pid in crew if alive(pid)]
        for pid in left:
            os.kill(pid, signal.SIGKILL)
        assert not left


def launch(n: int, what: str, folder: Path, **others: str) -> tuple[int, str, str]:
    with launched(n, what, folder, **others) as launcher:
        out, err = launcher.communicate(timeout=60)
        return launcher.returncode, out, err


def alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    status = Path(f"/proc/{pid}/stat")
    # a zombie whose parent is not ours to wait for has ended
    return not status.exists() or status.read_text().rsplit(")", 1)[1].split()[0] != "Z"


def pid_of(k: int, folder: Path) -> int:
    """Waits until process k of a run is there."""
    file = folder / f"pid{k}"
    deadline = time.monotonic() + 30
    while not file.exists() or not file.read_text():
        assert time.monotonic() < deadline
        time.sleep(0.02)
    return int(file.read_text())


def check_sums(folder: Path, n: int) -> None:
    found = [dict(np.load(folder / f"{k}.npz")) for k in range(n)]
    expected = sum(np.random.default_rng(k).standard_normal((3, 1 << 20)) for k in range(n))
    for k, of in enumerate(found):
        assert of["processes"] == n
        assert of["first"] == (k == 0)
        # the order of a sum of three is not ours
        np.testing.assert_allclose(of["total"], expected, rtol=0, atol=0 if n == 2 else 1e-14)
        np.testing.assert_array_equal(of["total"], found[0]["total"])
        np.testing.assert_array_equal(
            of["everything"], [sum(range(n)) + 0.5 * n + 0.25 * sum(range(n))]
        )
    parts = [of["mine"] for of in found]
    assert max(map(len, parts)) - min(map(len, parts)) <= 1
    assert sorted(np.concatenate(parts)) == list(range(7))


@pytest.mark.parametrize("n", [2, pytest.param(3, marks=pytest.mark.long)])
def test_processes_share_items_and_add_up(n, folder):
    # a proxy that does not exist is not asked
    code, out, err = launch(n, "sum", folder, http_proxy="http://127.0.0.1:9")
    assert (code, out, err) == (0, "said by 0\n", "")
    check_sums(folder, n)


@pytest.mark.long
def test_slurm_is_recognised(folder):
    def start(k):
        slurm = {
            "SLURM_JOB_ID": str(os.getpid()),
            "SLURM_STEP_NODELIST": "localhost",
            "SLURM_STEP_NUM_NODES": "1",
            "SLURM_STEP_NUM_TASKS": "2",
            "SLURM_NTASKS": "2",
            "SLURM_PROCID": str(k),
            "SLURM_LOCALID": str(k),
        }
        return subprocess.Popen(
            [sys.executable, "-m", "crew", "sum", str(folder)], env=environment(folder, **slurm)
        )

    crew = [start(k) for k in range(2)]
    assert [process.wait(60) for process in crew] == [0, 0]
    check_sums(folder, 2)


@pytest.mark.parametrize(
    "slurm",
    [
        # sbatch without srun, and a step of one process within a larger job
        {"SLURM_JOB_ID": "7", "SLURM_NTASKS": "4", "SLURM_PROCID": "0"},
        {
            "SLURM_JOB_ID": "7",
            "SLURM_NTASKS": "4",
            "SLURM_PROCID": "0",
            "SLURM_STEP_NODELIST": "localhost",
            "SLURM_STEP_NUM_TASKS": "1",
        },
    ],
)
def test_a_single_process_in_a_larger_job_waits_for_nobody(slurm, monkeypatch):
    for name, value in slurm.items():
        monkeypatch.setenv(name, value)
    with join() as group:
        assert (group.processes, group.number) == (1, 0)


@pytest.mark.parametrize(
    "given", [{}, {PROCESSES: "2"}, {PROCESSES: "2", PROCESS: "2"}, {PROCESSES: "x", PROCESS: "0"}]
)
def test_half_an_environment_is_refused(given, monkeypatch):
    monkeypatch.setenv(COORDINATOR, "127.0.0.1:1")
    for name, value in given.items():
        monkeypatch.setenv(name, value)
    with pytest.raises(InputError, match=COORDINATOR), join():
        pass


def test_alone_a_sum_is_a_copy():
    group, array = ProcessGroup(), np.arange(6.0).reshape(2, 3)
    total = group.total(array)
    np.testing.assert_array_equal(total, array)
    assert not np.shares_memory(total, array)
    assert group.mine("abc") == ["a", "b", "c"]
    group.barrier("alone")
    with pytest.raises(InputError, match="float64"):
        group.total(np.arange(3))


@pytest.mark.parametrize(
    ("victim", "what"), [(0, "compute"), pytest.param(1, "wait for 1", marks=pytest.mark.long)]
)
def test_a_killed_process_ends_the_run(victim, what, folder):
    with launched(2, what, folder) as launcher:
        pids = [pid_of(k, folder) for k in range(2)]
        time.sleep(0.5)
        os.kill(pids[victim], signal.SIGKILL)
        start = time.monotonic()
        out, err = launcher.communicate(timeout=20)
        assert time.monotonic() - start < 8
        assert launcher.returncode == 1
        assert not any(map(alive, pids))
    # JAX may notice the death, and say so in its own log, before the launcher has stopped it
    *log, said = err.splitlines()
    assert not any(line.startswith(("Traceback", "lusee-bayes")) for line in log)
    assert said == (
        f"lusee-bayes: process {victim} of 0..1 was ended by SIGKILL, and the others were stopped; "
        "the same command continues from what is finished"
    )
    assert out == ""


@pytest.mark.long
def test_a_process_that_fails_shows_why(folder):
    code, _, err = launch(2, "one fails", folder)
    assert code == 1
    assert err.count("ZeroDivisionError: of process 1") == 1
    assert err.endswith(
        "lusee-bayes: process 1 of 0..1 ended with exit code 1, and the others were stopped; the "
        "same command continues from what is finished\n"
    )


@pytest.mark.parametrize(
    ("n", "what"),
    [
        pytest.param(2, "one finds bad input", marks=pytest.mark.long),
        (2, "all find bad input"),
        pytest.param(3, "the last finds none", marks=pytest.mark.long),
    ],
)
def test_bad_input_is_said_once(n, what, folder):
    assert launch(n, what, folder) == (2, "", "crew: the sky is missing\n")


@pytest.mark.long
def test_a_common_verdict_is_no_accident(folder):
    assert launch(2, "a verdict", folder) == (1, "", "")


@pytest.mark.long
def test_processes_out_of_step_are_told(folder):
    code, _, err = launch(2, "out of step", folder)
    assert code == 1
    assert err.count("the processes of this run are out of step at 'a'") == 1


@pytest.mark.long
@pytest.mark.parametrize(
    ("how", "code", "what"),
    [
        (signal.SIGINT, 130, "compute"),
        pytest.param(signal.SIGTERM, -signal.SIGTERM, "start slowly", marks=pytest.mark.long),
        pytest.param(signal.SIGKILL, -signal.SIGKILL, "compute", marks=pytest.mark.long),
    ],
)
def test_nobody_outlives_the_launcher(how, code, what, folder):
    with launched(2, what, folder) as launcher:
        pids = [pid_of(k, folder) for k in range(2)]
        time.sleep(0.5)
        launcher.send_signal(how)
        _, err = launcher.communicate(timeout=20)
        assert launcher.returncode == code
        if how != signal.SIGKILL:
            assert not any(map(alive, pids))
    assert err == ("crew: interrupted\n" if how == signal.SIGINT else "")


@pytest.mark.long
def test_processes_that_do_not_listen_are_killed(folder):
    with launched(2, "deaf", folder) as launcher:
        for k in range(2):
            pid_of(k, folder)
        launcher.send_signal(signal.SIGINT)
        _, err = launcher.communicate(timeout=20)
        assert launcher.returncode == 130
    assert err == "lusee-bayes: interrupted; the same command continues from what is finished\n"


@pytest.mark.long
@pytest.mark.parametrize("victim", [0, 1])
def test_without_the_launcher_a_death_ends_the_run_too(victim, folder):
    crew = []
    try:
        for k in range(2):
            ours = {COORDINATOR: "127.0.0.1:41237", PROCESSES: "2", PROCESS: str(k)}
            crew.append(
                subprocess.Popen(
                    [sys.executable, "-m", "crew", "wait for 1", str(folder)],
                    env=environment(folder, **ours),
                    stderr=subprocess.PIPE,
                    text=True,
                )
            )
        for k in range(2):
            pid_of(k, folder)
        time.sleep(1)
        crew[victim].kill()
        _, err = crew[1 - victim].communicate(timeout=HEARTBEAT + 15)
        assert crew[1 - victim].returncode != 0
        assert "another task died" in err or "another process of this run has ended" in err
    finally:
        for process in crew:
            process.kill()
            process.communicate()


@pytest.mark.long
def test_results_do_not_depend_on_the_device(tmp_path):
    code = """
import sys
import lusee_bayes
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.process_group import ProcessGroup, use_cpu_devices
n = int(sys.argv[1])
use_cpu_devices(n)
import jax, jax.numpy as jnp, numpy as np
group = ProcessGroup()
solve = jax.jit(lambda a: jnp.linalg.solve(a @ a.T + jnp.eye(40), a.sum(axis=1)))
matrices = [np.random.default_rng(k).standard_normal((40, 40)) for k in range(6)]
on = [jax.device_put(a, group.device_of(k)) for k, a in enumerate(matrices)]
results = [solve(a) for a in on]
assert [r.devices() for r in results] == [{jax.devices()[k % n]} for k in range(6)]
np.save(sys.argv[2], np.array([np.asarray(r) for r in results]))
use_cpu_devices(n)
try:
    use_cpu_devices(n + 1)
except InputError as error:
    print(error)
"""
    results = []
    for n in (1, 4):
        file = tmp_path / f"{n}.npy"
        done = subprocess.run(
            [sys.executable, "-c", code, str(n), str(file)],
            env=environment(tmp_path),
            capture_output=True,
            text=True,
            check=False,
        )
        assert (done.returncode, done.stderr) == (0, "")
        assert done.stdout == (
            f"JAX has already started with {n} CPU device(s) in this process; ask for {n + 1} "
            "before anything is computed\n"
        )
        results.append(np.load(file))
    assert results[0].dtype == np.float64
    np.testing.assert_array_equal(results[0], results[1])


def test_numbers_below_one_are_refused():
    with pytest.raises(InputError, match="CPU devices must be at least 1, got 0"):
        use_cpu_devices(0)
    with pytest.raises(InputError, match="processes must be at least 1, got 0"):
        run_processes(0, [])
