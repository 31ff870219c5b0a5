"""How many draws and simulations a judgement needs at least; nothing heavy is imported."""

from __future__ import annotations

from lusee_bayes.core.errors import InputError

# bins of a rank histogram, and the simulations that each should expect
N_BINS, PER_BIN = 20, 5


LEAST_DRAWS = 100


def require_simulations(n: int) -> None:
    """Raise InputError for too few data sets: each bin of the histogram should expect five."""
    if n < PER_BIN * N_BINS:
        raise InputError(
            f"calibration needs at least {PER_BIN * N_BINS} simulations, {PER_BIN} for each of "
            f"the {N_BINS} bins of a rank histogram, got {n}; raise --simulations"
        )


def require_draws(n: int) -> None:
    """Raise InputError for fewer draws of a chain than a comparison needs."""
    if n < LEAST_DRAWS:
        raise InputError(
            f"a comparison needs {LEAST_DRAWS} draws of each chain, got {n}; raise --draws"
        )
