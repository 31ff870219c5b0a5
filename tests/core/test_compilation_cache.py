"""The cache of compiled programs: shared, switched off, bounded, and whole after a kill."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time

import pytest

from lusee_bayes.core import compilation_cache
from lusee_bayes.core.compilation_cache import SWITCH

# one program, compiled anew or found; says which
PROGRAM = """
import jax, sys, time
from lusee_bayes.core.compilation_cache import publish, use_compilation_cache
found = []
jax.monitoring.register_event_listener(lambda name, **_: found.append(name))
use_compilation_cache()
x = jax.jit(lambda x: (x * {factor} + 1.0).sum())(jax.numpy.arange(7.0))
print(sum("cache_hits" in name for name in found), flush=True)
if {stay}:
    time.sleep(60)
"""


def start(cache, factor=2.0, stay=False):
    return subprocess.Popen(
        [sys.executable, "-c", PROGRAM.format(factor=factor, stay=stay)],
        stdout=subprocess.PIPE,
        text=True,
        env={k: v for k, v in os.environ.items() if not k.startswith("JAX")} | {SWITCH: str(cache)},
    )


def hits(process):
    out, _ = process.communicate(timeout=60)
    assert process.returncode == 0
    return int(out)


def kept(cache):
    return sorted(path.name for path in cache.rglob("*-cache"))


def test_what_one_process_compiles_the_next_one_finds(tmp_path):
    assert hits(start(tmp_path)) == 0
    programs = kept(tmp_path)
    assert programs
    assert hits(start(tmp_path)) >= 1
    # nothing else is left, and nothing was compiled anew
    assert kept(tmp_path) == programs
    (machine,) = (tmp_path / "programs").iterdir()
    assert sorted(path.name for path in machine.iterdir()) == programs


def test_processes_side_by_side_and_one_that_is_killed(tmp_path):
    killed = start(tmp_path, factor=5.0, stay=True)
    assert killed.stdout.readline()
    both = [start(tmp_path, factor) for factor in (3.0, 3.0)]
    for process in both:
        hits(process)
    os.kill(killed.pid, signal.SIGKILL)
    killed.communicate()
    # what the others compiled is whole; the folder of the killed one is cleared away
    assert hits(start(tmp_path, 3.0)) >= 1
    (machine,) = (tmp_path / "programs").iterdir()
    assert all(path.is_file() and path.stat().st_size for path in machine.iterdir())


def test_it_can_be_switched_off_and_do_without(tmp_path, monkeypatch):
    assert hits(start("off")) == 0
    # a place that cannot be written to: programs are compiled anew, and nothing is said
    blocked = tmp_path / "file"
    blocked.write_text("not a folder")
    assert hits(start(blocked)) == 0
    assert blocked.read_text() == "not a folder"


@pytest.mark.parametrize("largest", [250, 1000])
def test_it_is_bounded_by_the_oldest(largest, tmp_path, monkeypatch):
    monkeypatch.setattr(compilation_cache, "LARGEST_BYTES", largest)
    now = time.time()
    for k in range(6):
        path = tmp_path / f"program{k}-cache"
        path.write_bytes(bytes(100))
        os.utime(path, (now - k, now - k))
    compilation_cache._kept(tmp_path)
    expected = [f"program{k}-cache" for k in range(min(6, largest // 100))]
    assert kept(tmp_path) == expected


def test_a_program_that_imports_jax_first_sees_no_warnings_of_xla(tmp_path):
    """JAX sets a level of messages at which XLA warns of every program that it finds."""
    assert hits(start(tmp_path)) == 0
    own = {k: v for k, v in os.environ.items() if not k.startswith(("JAX", "TF_CPP"))}
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM.format(factor=2.0, stay=False)],
        capture_output=True,
        text=True,
        check=True,
        env=own | {SWITCH: str(tmp_path)},
    )
    assert (done.stdout, done.stderr) == ("0\n", "")
