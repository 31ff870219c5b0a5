"""The cache of compiled programs: shared, and switched off."""

from __future__ import annotations

import os
import subprocess
import sys

from lusee_bayes.core.arrays import SWITCH

# one program, compiled anew or found; says which
PROGRAM = """
import jax
from lusee_bayes.core.arrays import use_compilation_cache
found = []
jax.monitoring.register_event_listener(lambda name, **_: found.append(name))
use_compilation_cache()
x = jax.jit(lambda x: (x * 2.0 + 1.0).sum())(jax.numpy.arange(7.0))
print(sum("cache_hits" in name for name in found), flush=True)
"""


def start(cache):
    return subprocess.Popen(
        [sys.executable, "-c", PROGRAM],
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
    assert kept(tmp_path) == programs


def test_it_can_be_switched_off_and_do_without(tmp_path):
    assert hits(start("off")) == 0
    # a place that cannot be written to: programs are compiled anew, and nothing is said
    blocked = tmp_path / "file"
    blocked.write_text("not a folder")
    assert hits(start(blocked)) == 0
    assert blocked.read_text() == "not a folder"


def test_a_program_that_imports_jax_first_sees_no_warnings_of_xla(tmp_path):
    """JAX sets a level of messages at which XLA warns of every program that it finds."""
    assert hits(start(tmp_path)) == 0
    own = {k: v for k, v in os.environ.items() if not k.startswith(("JAX", "TF_CPP"))}
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM],
        capture_output=True,
        text=True,
        check=True,
        env=own | {SWITCH: str(tmp_path)},
    )
    assert (done.stdout, done.stderr) == ("0\n", "")
