"""Strict tests: 64 bit, no silent promotion, types and shapes enforced, warnings are errors."""

import os
from pathlib import Path

from jaxtyping import install_import_hook

# before the package is imported anywhere: every annotated shape and dtype is checked at run time
install_import_hook("lusee_bayes", "beartype.beartype")

import jax  # noqa: E402
import pytest  # noqa: E402

import lusee_bayes  # noqa: E402, F401

jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")

DATA = Path(
    os.environ.get("LUSEE_BAYES_TEST_DATA", Path(__file__).resolve().parents[2] / "shared" / "data")
)


# Linux lets a process have 65530 memory maps; every compiled program takes some, and XLA crashes
# where there are no more
MANY_MAPS = 25_000


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
