"""The cache of compiled programs: shared, and switched off."""

import os
import subprocess
import sys

import pytest

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


def run(cache, *without):
    """What the program says, in an environment without variables that begin so."""
    own = {k: v for k, v in os.environ.items() if not k.startswith(("JAX", *without))}
    command, env = [sys.executable, "-c", PROGRAM], own | {SWITCH: str(cache)}
    done = subprocess.run(command, capture_output=True, text=True, check=True, env=env)
    return done.stdout, done.stderr


def kept(cache):
    return sorted(path.name for path in cache.rglob("*-cache"))


def test_what_one_process_compiles_the_next_one_finds(tmp_path):
    assert run(tmp_path)[0] == "0\n"
    programs = kept(tmp_path)
    assert programs
    assert int(run(tmp_path)[0]) >= 1
    assert kept(tmp_path) == programs
    # JAX sets a level of messages at which XLA warns of every program that it finds: a program
    # that imports JAX first sees no such warnings
    assert run(tmp_path, "TF_CPP") == ("0\n", "")


@pytest.mark.long
def test_it_can_be_switched_off_and_do_without(tmp_path):
    assert run("off")[0] == "0\n"
    # a place that cannot be written to: programs are compiled anew, and nothing is said
    blocked = tmp_path / "file"
    blocked.write_text("not a folder")
    assert run(blocked)[0] == "0\n"
    assert blocked.read_text() == "not a folder"
