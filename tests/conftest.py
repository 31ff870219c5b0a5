"""Strict tests: 64 bit, no silent promotion, types and shapes enforced, warnings are errors."""

import gc
import os
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path

# tests spend their time compiling small programs that run once: without LLVM's optimisations that
# takes a third less. The numbers are those of the same operations. What computes for long gains by
# them: LUSEE_BAYES_TEST_XLA_LEVEL=3
LEVEL = os.environ.get("LUSEE_BAYES_TEST_XLA_LEVEL", "0")
flags = [os.environ.get("XLA_FLAGS", ""), f"--xla_backend_optimization_level={LEVEL}"]
# nor with fusions that are written kernel by kernel, nor in 32 parts: that takes half. Only where
# these flags are known to exist: XLA ends the process for any other
if LEVEL == "0" and version("jaxlib").startswith("0.9."):
    flags += ["--xla_cpu_use_fusion_emitters=false", "--xla_cpu_parallel_codegen_split_count=1"]
os.environ["XLA_FLAGS"] = " ".join(flags).strip()
# of healpy, whose threads wait for each other where other processes want the processors, too: a map
# of NSIDE 8 then takes 25 us with one of them, and 900 us with two
os.environ.setdefault("OMP_NUM_THREADS", "1")
# as the package says it, for what imports JAX before
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")

from jaxtyping import install_import_hook  # noqa: E402

# before the package is imported anywhere: every annotated shape and dtype is checked at run time
install_import_hook("lusee_bayes", "beartype.beartype")

import jax  # noqa: E402
import pytest  # noqa: E402
from experiments import small_experiment as make_small_experiment  # noqa: E402
from fits_files import write_response  # noqa: E402

import lusee_bayes as lb  # noqa: E402
from lusee_bayes.experiment.experiment import Experiment  # noqa: E402
from lusee_bayes.instrument.beams import monopoles  # noqa: E402

# a program that was compiled once is not compiled again, in this run or the next. A folder for each
# worker: JAX's cache is not safe for several that write
ROOT = Path(__file__).resolve().parents[1]
WORKER = os.environ.get("PYTEST_XDIST_WORKER", "main")
jax.config.update("jax_compilation_cache_dir", str(ROOT / ".pytest_cache" / "xla" / WORKER))
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)

jax.config.update("jax_numpy_dtype_promotion", "strict")

known, beams_of = {}, monopoles._modes


def known_beams(*given):
    """Beams that an earlier test has asked for, too, are not computed again."""
    leaves = jax.tree.leaves(given)
    if any(isinstance(leaf, jax.Array) for leaf in leaves):
        return beams_of(*given)
    key = tuple(leaf.tobytes() if hasattr(leaf, "tobytes") else leaf for leaf in leaves)
    if key not in known:
        known[key] = beams_of(*given)
        known[key].flags.writeable = False
    return known[key]


monopoles._modes = known_beams
jax.config.update("jax_numpy_rank_promotion", "raise")

DATA = Path(os.environ.get("LUSEE_BAYES_TEST_DATA", ROOT.parent / "shared" / "data"))


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items):
    """What is essential is long, before anything is deselected."""
    for item in items:
        if item.get_closest_marker("essential"):
            item.add_marker("long")


def pytest_collection_finish():
    """What is there for good, modules and tests, is not looked at by every collection of garbage.

    Runs collect it behind every task, which takes a second with all of it and 50 ms without.
    """
    gc.freeze()


# Linux lets a process have 65530 memory maps; every compiled program takes some, and XLA crashes
# where there are no more
MANY_MAPS = 45_000


@pytest.fixture(autouse=True, scope="module")
def no_more_programs_than_memory_maps():
    """Forgets compiled programs behind a module that leaves too many."""
    yield
    maps = Path("/proc/self/maps")
    if maps.exists() and maps.read_text().count("\n") > MANY_MAPS:
        jax.clear_caches()


@pytest.fixture(scope="session")
def test_data() -> Path:
    """Folder of real data; tests that need it are skipped where it does not exist."""
    if not DATA.is_dir():
        pytest.skip(f"no test data at {DATA} (set LUSEE_BAYES_TEST_DATA)")
    return DATA


@pytest.fixture(scope="session")
def flight(test_data) -> Path:
    """Folder of sessions that luseepy has written of a known sky."""
    if not (test_data / "flight").is_dir():
        pytest.skip("no flight sessions")
    return test_data / "flight"


@pytest.fixture(scope="session")
def tiny_experiment() -> Experiment:
    """Six times of the paper's observation: 96 data, 49 modes."""
    return make_small_experiment()


@pytest.fixture(scope="session")
def small_experiment() -> Experiment:
    """A fifth of a lunar day: enough data for a map that recovers its sky."""
    return make_small_experiment(cycles=0.2)


@pytest.fixture(scope="session")
def response_file(tmp_path_factory) -> Path:
    """A small four-port response (:func:`fits_files.write_response`)."""
    return write_response(tmp_path_factory.mktemp("response") / "response.fits")


# a little of the observation, before and after a turn of the table
SMALL_MAP = [
    "lmax=8",
    "observation.runs=[{cycles: 0.1}, {cycles: 0.1, turntable_deg: 30}]",
    "output={draws: 400, covariance: true}",
]


@pytest.fixture
def numbers_alone(monkeypatch):
    """Maps of this process are written without figures and pages, which take longer."""
    from lusee_bayes.runs import folder, map_run

    monkeypatch.setattr(map_run, "MAP", replace(map_run.MAP, figures={}))
    monkeypatch.setattr(folder, "PAGES", {})


@pytest.fixture
def write(tmp_path, request):
    """Writes a text to a file, by default that of the module; its path."""

    def write(text: str, name: str = getattr(request.module, "WRITTEN", "text")) -> Path:
        path = tmp_path / name
        path.write_text(text)
        return path

    return write


@pytest.fixture
def exact_tilt(monkeypatch):
    """Tilts about the pole between two runs as exact as about each one's own."""
    monkeypatch.setattr("lusee_bayes.instrument.pointing.LEAST_ORDER", 4)
    monkeypatch.setattr("lusee_bayes.instrument.averaging.TOLERANCE", 1e-13)


# runs are imported when they are asked for: matplotlib and all that draws take seconds
@pytest.fixture(scope="session")
def small_map(tmp_path_factory):
    """A finished map run of 81 modes with draws and covariance; its folder is to be read only."""
    folder = tmp_path_factory.mktemp("small") / "map"
    return lb.run_map(lb.load_scenario("fiducial", SMALL_MAP), folder)


@pytest.fixture(scope="session")
def small_cube(tmp_path_factory):
    """A finished run of three frequencies, each on its own, with draws; to be read only."""
    sizes = ["lmax=4", "observation.runs.0.cycles=0.1", "output.draws=3"]
    scenario = lb.load_scenario("fiducial", [*sizes, "frequencies_mhz=[20, 25, 30]"])
    return lb.run_map(scenario, tmp_path_factory.mktemp("small") / "cube")
