"""The fewest draws and simulations that a validation needs; imports nothing heavy."""

from lusee_bayes.core.errors import InputError

# number of bins of a rank histogram, and simulations expected in each
N_BINS, PER_BIN = 20, 5
# draws of each chain, fewer of which cannot be as many independent ones as a comparison needs
LEAST_DRAWS = 300


def require_simulations(n: int) -> None:
    """Raise InputError for too few data sets: a histogram needs an average of five in each bin."""
    if n < PER_BIN * N_BINS:
        raise InputError(
            f"calibration needs at least {PER_BIN * N_BINS} simulations, {PER_BIN} for each of "
            f"the {N_BINS} bins of a rank histogram, got {n}; raise --simulations"
        )


def require_draws(n: int) -> None:
    """Raise InputError if a chain has fewer draws than a comparison needs."""
    if n < LEAST_DRAWS:
        wrong = f"a comparison needs {LEAST_DRAWS} draws of each chain, got {n}; raise --draws"
        raise InputError(wrong)
