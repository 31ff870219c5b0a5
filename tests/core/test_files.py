"""Transactions: a folder is wholly old or wholly new, whenever the process that writes it dies.

And locks: one run at a time works in a folder.
"""

import json
import os
import subprocess
import sys
import threading
from functools import partial
from pathlib import Path

import pytest
from assertions import raising, refuse, refused
from tables import tables

import lusee_bayes
from lusee_bayes.core import files as fs

OLD = {
    "mean.fits": "old mean", "only_old.csv": "1", "figures/maps.png": "old", "gone/deep/x": "2",
    "kept.fits": "kept",
}  # fmt: skip
NEW = {"mean.fits": "new mean", "only_new.csv": "3", "figures/maps.png": "new", "cases/a/b.nc": "4"}
PACKAGE = str(Path(lusee_bayes.__file__).parent)
OWN = {"notes.txt": "a user's own", "figures/own.png": "and another"}
WORK = {"chains/chunk-1.npz": "draws", "chains/run.json": "{}"}

# a process for every k that dies before the k-th event that changes the folder (audit events see
# every call): what each death left, and what recovery makes of it
EVENTS = """
import json, os, sys, types
from pathlib import Path

base, old, new, own, work, root = json.loads(sys.argv[1])
# without JAX a fork takes a millisecond; what is tested takes one class of what needs JAX
for name in ("lusee_bayes", "lusee_bayes.core.checks"):
    sys.modules[name] = types.ModuleType(name)
sys.modules["lusee_bayes"].__path__ = [root]
sys.modules["lusee_bayes.core.checks"].InputError = ValueError
from lusee_bayes.core.files import locked, recover, transaction

CHANGES = {"os.rename", "os.remove", "os.rmdir", "os.mkdir", "os.link"}
left = None

def before(event, arguments):
    global left
    writes = event == "open" and arguments[1] is not None and set(arguments[1]) & set("wxa+")
    if left is not None and (event in CHANGES or writes):
        if left == 0:
            os._exit(9)
        left -= 1

sys.addaudithook(before)

def write(folder, files):
    for name, text in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)

def content(folder):
    return {str(p.relative_to(folder)): p.read_text() if p.is_file() else None
            for p in sorted(folder.rglob("*"))}

def run(folder, files):
    folder.mkdir(exist_ok=True)
    with locked(folder), transaction(folder, "test", ["chains"]) as stage:
        write(stage, files)
        # a file that is kept: a second link to the one that is there
        if (folder / "kept.fits").exists():
            os.link(folder / "kept.fits", stage / "kept.fits")

def dies(action, after):
    global left
    child = os.fork()
    if child == 0:
        left = after
        action()
        os._exit(0)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 9

def prepared(folder, earlier):
    write(folder, own)
    if earlier:
        run(folder, old)
    write(folder, work)
    return folder

def deaths(base, earlier):
    start, found, died, again = content(prepared(base / "start", earlier)), [], True, 0
    while died:
        folder = prepared(base / str(len(found)), earlier)
        died = dies(lambda: run(folder, new), len(found))
        hit = content(folder)
        if ".committed" in hit and not again:
            # whoever recovers dies as well, each time one event later
            while dies(lambda: recover(folder), again):
                again += 1
        with locked(folder):
            recover(folder)
        found.append([hit, content(folder)])
    return start, found, again

print(json.dumps([deaths(Path(base) / str(earlier), earlier) for earlier in (False, True)]))
"""


def content(folder: Path) -> dict[str, str]:
    return {str(p.relative_to(folder)): p.read_text() for p in folder.rglob("*") if p.is_file()}


def write(folder: Path, files: dict[str, str]) -> None:
    for name, text in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)


def finished(folder: Path, files: dict[str, str]) -> None:
    with fs.transaction(folder, "test") as stage:
        write(stage, files)


@pytest.fixture
def folder(tmp_path):
    """A user's own files, and the results of an earlier run."""
    write(tmp_path, OWN)
    finished(tmp_path, OLD)
    return tmp_path


def with_folders(files: dict[str, str]) -> dict[str, str | None]:
    """The files, and None for every folder that they lie in."""
    parents = {str(p) for name in files for p in Path(name).parents if p != Path(".")}
    return dict.fromkeys(parents) | files


def test_a_death_at_any_step_leaves_the_old_or_the_new(tmp_path):
    """Until the rename the old results with the unfinished work, from it on only the new ones."""
    given = json.dumps([str(tmp_path), OLD, NEW, OWN, WORK, PACKAGE])
    program = [sys.executable, "-c", EVENTS, given]
    done = subprocess.run(program, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    for (start, found, again), earlier in zip(json.loads(done.stdout), ({}, OLD), strict=True):
        old = with_folders(OWN | WORK | earlier)
        assert {name: text for name, text in start.items() if name != fs.MANIFEST} == old
        files = NEW | ({"kept.fits": OLD["kept.fits"]} if earlier else {})
        manifest = {"kind": "test", "files": sorted(files), "discard": ["chains"], "origin": {}}
        new = with_folders(OWN | files) | {fs.MANIFEST: json.dumps(manifest, indent=2) + "\n"}
        there = new[fs.MANIFEST]
        committed = [fs.COMMITTED in hit or hit.get(fs.MANIFEST) == there for hit, _ in found]
        assert committed == sorted(committed)
        for is_new, (_, after) in zip(committed, found, strict=True):
            assert after == (new if is_new else start)
        # every step was hit: each file's writing, and behind the rename each file's move
        assert committed.count(False) > len(files) + 2
        assert committed.count(True) > len(files) + len(WORK) + 2
        assert again > 4


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt, SystemExit])
def test_a_failure_leaves_the_folder_as_it_was(error, folder):
    before = content(folder)
    with pytest.raises(error), fs.transaction(folder, "test", ["figures"]) as stage:
        write(stage, NEW)
        raise error
    assert content(folder) == before
    assert not list(folder.glob(f"{fs.SCRATCH}*"))


def test_a_failing_rename_leaves_the_folder_as_it_was(folder, monkeypatch):
    before = content(folder)

    monkeypatch.setattr(os, "replace", raising(OSError("the disk is full")))
    with pytest.raises(OSError, match="full"):
        finished(folder, NEW)
    assert content(folder) == before and not list(folder.glob(".*"))


def test_own_files_stay_and_those_of_the_earlier_run_go(folder):
    """Of a commit in a thread, too."""
    thread = threading.Thread(target=finished, args=(folder, NEW))
    thread.start()
    thread.join()
    assert content(folder).keys() == {*OWN, *NEW, fs.MANIFEST}
    assert fs.read_manifest(folder)["files"] == sorted(NEW)
    assert not (folder / "gone").exists()
    # without a manifest nobody knows whose the files are
    (folder / fs.MANIFEST).unlink()
    finished(folder, {"mean.fits": "newer"})
    assert content(folder).keys() == {*OWN, *NEW, fs.MANIFEST}


def test_a_run_removes_what_a_dead_one_has_left_and_a_reader_leaves_it(folder):
    """The one that works may be alive: only who has the lock knows that it is not."""
    write(folder, {f"{fs.SCRATCH}abc/figures/maps.png": "half"})
    fs.recover(folder)
    assert (folder / f"{fs.SCRATCH}abc/figures/maps.png").exists()
    with fs.locked(folder):
        assert not (folder / f"{fs.SCRATCH}abc").exists()


def test_an_interrupt_while_files_are_moved_loses_nothing(folder, monkeypatch):
    """Raised at each move in turn: what opens the folder next completes it."""
    moves = iter(range(100))

    def interrupted_once(at, *paths, replace=os.replace):
        if next(moves) == at:
            raise KeyboardInterrupt
        replace(*paths)

    # the rename, each file and the manifest
    for at in range(1, len(NEW) + 2):
        moves = iter(range(100))
        finished(folder, OLD)
        with monkeypatch.context() as patched, pytest.raises(KeyboardInterrupt):
            patched.setattr(os, "replace", partial(interrupted_once, at))
            finished(folder, NEW)
        fs.recover(folder)
        assert content(folder).keys() == {*OWN, *NEW, fs.MANIFEST}


MANIFESTS = tables(__file__)["manifests"]


@pytest.mark.parametrize("text", MANIFESTS)
def test_a_damaged_manifest_is_one_sentence_before_anything_is_written(text, folder):
    (folder / fs.MANIFEST).write_text(text)
    before = content(folder)
    for action in (fs.read_manifest, fs.recover):
        refuse(r"manifest\.json'.*read.*delete", action, folder)
    with refused("cannot be read"), fs.transaction(folder, "test"):
        pytest.fail("it began")
    assert content(folder) == before
    (folder / fs.MANIFEST).unlink()
    finished(folder, NEW)
    assert content(folder).keys() == {*OWN, *OLD, *NEW, fs.MANIFEST}


def test_what_is_in_the_way_is_refused_before_the_commit(folder, tmp_path):
    before = content(folder)
    for name, words in {
        "figures": "'.*figures' is a folder, but a result file has the same name",
        "mean.fits/x": "'.*mean.fits' is a file",
    }.items():
        refuse(words, finished, folder, {name: "x"})
        assert content(folder) == before
    for place in ("notes.txt", "notes.txt/below"):
        refuse(r"notes\.txt'.*file.*folder", finished, folder / place, NEW)
    assert content(folder) == before


def test_folders_are_made(tmp_path):
    finished(tmp_path / "a" / "b", NEW)
    assert content(tmp_path / "a" / "b").keys() == {*NEW, fs.MANIFEST}
    fs.recover(tmp_path / "nowhere")
    assert not (tmp_path / "nowhere").exists()


def test_a_file_is_replaced_whole_or_not_at_all(tmp_path):
    path = tmp_path / "a" / "page.html"
    with fs.replacing(path) as partial:
        partial.write_text("first")
        assert not path.exists()
    with pytest.raises(KeyboardInterrupt), fs.replacing(path) as partial:
        partial.write_text("half")
        raise KeyboardInterrupt
    assert content(tmp_path) == {"a/page.html": "first"}


FULL = """
import resource, sys
from pathlib import Path
from xarray import Dataset
from lusee_bayes.core import files, formats
resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[2]), resource.RLIM_INFINITY))
try:
    with files.replacing(sys.argv[1]) as partial:
        formats.write_netcdf(Dataset({name: ("x", [0.0] * 5000) for name in "abc"}), partial)
except OSError as error:
    print(error)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="the limit on a file is Linux's")
@pytest.mark.parametrize("size", [10, 50_000, 120_000])
def test_a_full_disk_does_not_crash_the_hdf5_library(tmp_path, size):
    command = [sys.executable, "-c", FULL, str(path := tmp_path / "data.nc"), str(size)]
    ended = subprocess.run(command, capture_output=True, text=True, check=True)
    assert ended.stdout == f"[Errno 27] File too large: '{path}'\n"
    assert not ended.stderr and not list(tmp_path.iterdir())


HOLD = """
import sys
from pathlib import Path
from lusee_bayes.core.files import locked
with locked(Path(sys.argv[1])):
    print("held", flush=True)
    sys.stdin.readline()
"""


@pytest.fixture
def elsewhere(tmp_path):
    """Another process that works in the folder."""
    program, pipe = [sys.executable, "-c", HOLD, str(tmp_path)], subprocess.PIPE
    process = subprocess.Popen(program, stdin=pipe, stdout=pipe, text=True)
    assert process.stdout.readline() == "held\n"
    yield process
    process.kill()
    process.wait()
    process.stdin.close()
    process.stdout.close()


def test_two_runs_cannot_mix(tmp_path, elsewhere):
    with refused(f"another run uses .*process {elsewhere.pid} on"), fs.locked(tmp_path):
        pass


def test_a_lock_ends_with_its_process(tmp_path, elsewhere):
    elsewhere.kill()
    elsewhere.wait()
    for _ in range(2):
        with fs.locked(tmp_path):
            assert (tmp_path / fs.LOCK).exists()
    assert list(tmp_path.iterdir()) == []
