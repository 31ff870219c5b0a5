"""Commands that are ended at any moment, and started again: nothing is lost and nothing is mixed.

Each is a process of its own, killed at moments that are spread over what an undisturbed one takes.
"""

import os
import random
import shutil
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import h5py
import numpy as np
import pytest
from commands import content, sets

from lusee_bayes.core.files import MANIFEST, SCRATCH, locked, recover

pytestmark = pytest.mark.long

# figures and pages take most of a run's time and are files as any other; the paper has three cases
DRIVER = """
import signal, sys
from dataclasses import replace
from lusee_bayes.cli.main import main
from lusee_bayes.paper import cases
from lusee_bayes.runs import folder, map_run, paper_run, sample_run

# listened to even where the tests run in the background, which ignores it
signal.signal(signal.SIGINT, signal.default_int_handler)
folder.PAGES = {}
for module, name in ((map_run, "MAP"), (sample_run, "SAMPLE"), (paper_run, "PAPER")):
    setattr(module, name, replace(getattr(module, name), figures={}))
tiny, *arguments = sys.argv[1:]
cases.CASES = {name: ("fiducial", [*tiny.split(), f"noise.radiometer.factor={factor}"])
               for name, factor in (("fiducial", 1), ("noise_x10", 10), ("noise_x100", 100))}
claim = dict.fromkeys(("section", "paper", "obtained", "agrees", "reason"), "yes")
paper_run.claim_table = lambda cases: [claim]
print("started", flush=True)
sys.exit(main(arguments))
"""
# of each command, with an earlier run in its folder and without: half a minute each. Ten before a
# release
MOMENTS = int(os.environ.get("LUSEE_BAYES_TEST_KILLS", "1"))
TINY = ["lmax=3", "observation.step_s=43200"]
ROOT = Path(__file__).resolve().parents[2]
ENVIRONMENT = {
    "PYTHONPATH": str(ROOT),
    "MPLBACKEND": "agg",
    "JAX_COMPILATION_CACHE_DIR": str(ROOT / ".pytest_cache" / "xla" / "interrupted"),
    "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
    "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1",
}
# by name: the command and the folder of its unfinished work
COMMANDS = {
    "map": (["map", "fiducial", "--draws", "3"], None),
    "cube": (["map", "fiducial", "--frequencies", "20,25", "--draws", "3"], "channels"),
    "sample": (
        ["sample", "fiducial", "--chains", "1", "--warmup", "25", "--draws", "75"],
        "chains",
    ),
    "paper": (["paper"], "unfinished-cases"),
}
AGAIN = "the same command continues from the finished"
RESUME = {"cube": f"{AGAIN} channels", "paper": f"{AGAIN} cases"}
RESUME["sample"] = "continue with --resume"


class Command:
    """A command with a seed, as a process; ``folder`` is that of an undisturbed run of it."""

    def __init__(self, name: str, folder: Path, seed: int):
        self.arguments, self.unfinished = COMMANDS[name]
        self.name, self.folder = name, folder
        self.settings = [*TINY, f"seed={seed}"]
        self.timed(folder)

    def timed(self, folder: Path) -> float:
        """Run it to its end; seconds."""
        process, start = self.start(folder), time.monotonic()
        errors = process.communicate(timeout=600)[1]
        assert process.returncode == 0, errors
        return time.monotonic() - start

    def start(self, folder: Path, *more: str) -> subprocess.Popen:
        options = [] if self.name == "paper" else sets(*self.settings)
        # the earlier run has another seed
        arguments = [*self.arguments, *options, *more, "--force", "-q", "-o", str(folder)]
        command = [sys.executable, "-c", DRIVER, " ".join(self.settings), *arguments]
        env, pipe = os.environ | ENVIRONMENT, subprocess.PIPE
        process = subprocess.Popen(command, env=env, stdout=pipe, stderr=pipe, text=True)
        assert process.stdout.readline() == "started\n", process.communicate()[1]
        return process

    def resumed(self, folder: Path) -> list[str]:
        """--resume, where something was drawn."""
        return ["--resume"] if self.name == "sample" and (folder / "chains").exists() else []

    def killed(self, folder: Path, moment: float) -> int:
        """Kill it at this part of its time; the exit code."""
        process = self.start(folder, *self.resumed(folder))
        with suppress(subprocess.TimeoutExpired):
            process.wait(moment * self.seconds)
        process.kill()
        process.communicate()
        return process.returncode

    def again(self, folder: Path) -> tuple[int, str]:
        """What a user does who sees the folder: the same command."""
        process = self.start(folder, *self.resumed(folder))
        errors = process.communicate(timeout=600)[1]
        return process.returncode, errors


def numbers(folder: Path) -> dict[str, np.ndarray]:
    """Every array of every netCDF file."""
    found = {}
    for path in sorted(folder.rglob("*.nc")):
        items = []
        with h5py.File(path) as file:
            file.visititems(lambda _, item, items=items: items.append(item))
            arrays = [item for item in items if isinstance(item, h5py.Dataset)]
            found |= {f"{path.relative_to(folder)}{item.name}": item[()] for item in arrays}
    return found


def assert_same_results(folder: Path, expected: Path) -> None:
    """The same files, and bit by bit the same numbers."""
    assert content(folder).keys() == content(expected).keys()
    found, wanted = numbers(folder), numbers(expected)
    assert found.keys() == wanted.keys() and len(wanted) > 5
    for name, values in wanted.items():
        np.testing.assert_array_equal(found[name], values, err_msg=name)


def state_of(folder: Path, command: Command, earlier: Path | None) -> str:
    """``old`` or ``new``, with unfinished work or without; fails if it is neither."""
    if not folder.exists():
        assert earlier is None
        return "old"
    recover(folder)
    # as the next run does
    with locked(folder):
        pass
    assert not list(folder.glob(f"{SCRATCH}*")) and not (folder / ".committed").exists()
    before, found = content(earlier) if earlier else {}, content(folder)
    if found.get(MANIFEST) is not None and numbers(folder).keys() == numbers(command.folder).keys():
        written = {n for n in found if not n.startswith(f"{command.unfinished}/")}
        if {n: found[n] for n in written} != before:
            assert_same_results(folder, command.folder)
            return "new"
    unfinished = {n for n in found if n not in before}
    assert {n: found[n] for n in found if n not in unfinished} == before
    assert all(n.startswith(f"{command.unfinished}/") for n in unfinished)
    return "old, resumable" if unfinished else "old"


@pytest.fixture(scope="module", params=COMMANDS)
def command(request, tmp_path_factory) -> tuple[Command, Path]:
    """A command, undisturbed, and the folder of an earlier run with another seed."""
    base = tmp_path_factory.mktemp(request.param)
    earlier = Command(request.param, base / "earlier", seed=2)
    command = Command(request.param, base / "whole", seed=1)
    # the first ones compile; a kill behind the end would show nothing
    command.seconds = min(command.timed(base / f"again {k}") for k in range(2))
    return command, earlier.folder


def prepared(tmp_path: Path, name: str, earlier: Path | None) -> Path:
    folder = tmp_path / name
    return folder if earlier is None else Path(shutil.copytree(earlier, folder))


@pytest.mark.parametrize("number", range(MOMENTS))
@pytest.mark.parametrize("with_earlier", [False, True], ids=["nothing before", "an earlier run"])
def test_a_kill_at_any_moment(command, with_earlier, number, tmp_path):
    it, earlier = command[0], command[1] if with_earlier else None
    folder = prepared(tmp_path, "run", earlier)
    # each in its own part of the run
    moment = (number + random.Random(f"{it.name} {with_earlier} {number}").random()) / MOMENTS
    returncode = it.killed(folder, moment)
    assert returncode in (0, -signal.SIGKILL)
    state = state_of(folder, it, earlier)
    print(f"{it.name}, earlier run {with_earlier}, at {moment:.2f} of its time: {state}")
    assert returncode != 0 or state == "new"
    if state != "new":
        # and once more on the way, of which nothing is to be seen in the end
        it.killed(folder, 0.5)
        code, errors = it.again(folder)
        assert code == 0, errors
    assert_same_results(folder, it.folder)


@pytest.mark.parametrize("with_earlier", [False, True], ids=["nothing before", "an earlier run"])
def test_an_interrupt_says_what_the_folder_holds(command, with_earlier, tmp_path):
    """Sent as soon as there is something in the folder that is not finished."""
    it, earlier = command[0], command[1] if with_earlier else None
    folder = prepared(tmp_path, "run", earlier)
    process = it.start(folder)
    wanted = f"{it.unfinished}/[!.]*.n*" if it.unfinished else f"{SCRATCH}*"
    while process.poll() is None and not list(folder.glob(wanted)):
        time.sleep(0.005)
    process.send_signal(signal.SIGINT)
    errors = process.communicate(timeout=600)[1].strip()
    assert process.returncode == 130, errors
    state = state_of(folder, it, earlier)
    before = "the earlier results are unchanged" if earlier else "no results were written"
    sentence = {
        "new": f"the new results in '{folder}' are complete",
        "old": f"{before} in '{folder}'",
        "old, resumable": f"{before} in '{folder}'; {RESUME.get(it.name)}",
    }[state]
    # the interpreter tells of objects, too, whose making was interrupted
    said = [line for line in errors.splitlines() if line.startswith("lusee-bayes: ")]
    assert said == [f"lusee-bayes: interrupted; {sentence}"]
    code, errors = (0, "") if state == "new" else it.again(folder)
    assert code == 0, errors
    assert_same_results(folder, it.folder)
