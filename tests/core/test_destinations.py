"""Where results go: refused before anything is computed, and one run at a time."""

import os
import subprocess
import sys

import pytest

from lusee_bayes.core.errors import InputError
from lusee_bayes.core.files import LOCK, locked, require_folder, require_target

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
    process = subprocess.Popen(
        [sys.executable, "-c", HOLD, str(tmp_path)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stdout.readline() == "held\n"
    yield process
    process.kill()
    process.wait()
    process.stdin.close()
    process.stdout.close()


def test_two_runs_cannot_mix(tmp_path, elsewhere):
    message = f"another run works in .*process {elsewhere.pid} on"
    with pytest.raises(InputError, match=message), locked(tmp_path):
        pass


def test_a_lock_ends_with_its_process(tmp_path, elsewhere):
    elsewhere.kill()
    elsewhere.wait()
    with locked(tmp_path):
        assert (tmp_path / LOCK).exists()
    assert list(tmp_path.iterdir()) == []


def test_a_lock_can_be_taken_again(tmp_path):
    for _ in range(2):
        with locked(tmp_path):
            pass


@pytest.mark.parametrize("name", ["new", "new/inside", ".", "folder"])
def test_folders_that_can_be_written_into(name, tmp_path):
    (tmp_path / "folder").mkdir()
    require_folder(tmp_path / name)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["folder"]  # nothing is made


@pytest.mark.parametrize("what", ["file", "pipe", "link", "file/inside", "n" * 300, "a\0b"])
def test_what_is_no_folder(what, tmp_path):
    (tmp_path / "file").write_text("")
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "link").symlink_to("nowhere")
    with pytest.raises(InputError):
        require_folder(tmp_path / what)


@pytest.mark.parametrize("target", ["/dev/full", "/dev/null", "/", "."])
def test_devices_and_folders_are_no_files(target):
    with pytest.raises(InputError):
        require_target(target)


def test_a_file_may_be_replaced(tmp_path):
    (tmp_path / "x.nc").write_text("old")
    require_target(tmp_path / "x.nc")
    require_target(tmp_path / "new.nc")
