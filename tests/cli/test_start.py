"""What a command waits for: the libraries that it imports, and the programs that it compiles."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

# as without the extra "cluster": xarray imports Dask where it is there, and Dask SciPy
PROGRAM = """
import sys
sys.modules["dask"] = None
from lusee_bayes.cli.main import main
counted = []
if {count}:
    import jax
    jax.monitoring.register_event_duration_secs_listener(
        lambda name, *_, **__: counted.append(name)
    )
assert main({arguments!r}) == 0
print(len([name for name in counted if "backend_compile" in name]), *sys.modules)
"""


def outcome(*arguments, count=False):
    """The number of programs compiled, and the modules imported."""
    program = PROGRAM.format(count=count, arguments=[str(a) for a in arguments])
    environment = {name: v for name, v in os.environ.items() if not name.startswith("JAX")}
    found = subprocess.run(
        [sys.executable, "-c", program],
        capture_output=True,
        text=True,
        check=True,
        env=environment | {"LUSEE_BAYES_CACHE": "off"},
    )
    n, *modules = found.stdout.splitlines()[-1].split()
    return int(n), set(modules)


@pytest.mark.parametrize("arguments", [["--help"], ["map", "--help"], ["--version"]])
def test_help_waits_for_no_library(arguments):
    _, modules = outcome(*arguments)
    assert not modules & {"jax", "numpy", "astropy", "healpy", "matplotlib", "xarray", "pydantic"}


@pytest.mark.parametrize(
    ("name", "spared"),
    [
        ("posterior.nc", {"jax", "healpy", "matplotlib", "scipy"}),
        ("diagnostics.nc", {"jax", "healpy", "matplotlib", "scipy"}),
        ("mean.fits", {"numpyro", "xarray", "lunarsky", "scipy.stats"}),
    ],
)
def test_info_waits_for_no_more_than_its_file(name, spared, small_map):
    _, modules = outcome("info", small_map.folder / name)
    assert not modules & spared


def test_a_map_compiles_little_and_imports_no_sampler(tmp_path):
    n, modules = outcome(
        *("map", "fiducial", "--set", "lmax=8", "--set", "observation.runs.0.cycles=0.2"),
        *("-o", tmp_path / "map", "-q"),
        count=True,
    )
    # single random numbers, most of them; none of it grows with the map
    assert 0 < n <= 60
    assert not modules & {"numpyro", "arviz_stats", "scipy.stats", "scipy.optimize"}
