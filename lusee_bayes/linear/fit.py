"""Whether data fit a model, in three words, with the thresholds that part them.

If the model holds, chi^2 of all n data, the sky included, follows a chi^2 distribution with n
degrees of freedom, and ::

    p = 2 min(P(chi^2_n > chi^2), P(chi^2_n < chi^2))

is uniform from 0 to 1: too large a chi^2 counts as much as too small a one. The best of k such
probabilities is judged by k p, which is below any bound at most that often, however they depend on
one another (Bonferroni).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from lusee_bayes.core.lazy import special

Level = Literal["consistent", "in tension", "does not fit"]
LEVELS: tuple[Level, ...] = ("consistent", "in tension", "does not fit")
# Data of a model that holds are called in tension once in a hundred runs. Real skies are not drawn
# from the prior, which alone makes probabilities of 1e-3 (the fiducial sky); nothing that is right
# in data and instrument has been seen to make less than 1e-6, and chance does not in any number of
# runs that a mission makes.
TENSION, MISFIT = 1e-2, 1e-6
THRESHOLDS = (
    f"consistent: p of at least {TENSION:g}; in tension: from {MISFIT:g} to {TENSION:g}; does not "
    f"fit: below {MISFIT:g}"
)


@dataclass(frozen=True)
class Fit:
    """A verdict.

    Attributes
    ----------
    level : {"consistent", "in tension", "does not fit"}
    p : float
        Two-sided, of all data.
    text : str
        The verdict in sentences, with what stands out.
    """

    level: Level
    p: float
    text: str


def two_sided(chi2: float, n: float | int) -> float:
    """Compute how probable it is that chi^2 of n degrees of freedom is as far out on its side.

    Parameters
    ----------
    chi2 : float
    n : float
        Degrees of freedom.

    Returns
    -------
    float
        From 0 to 1, uniform if the model holds.
    """
    # both tails are one half at the median, up to rounding
    return float(min(1.0, 2.0 * min(special.chdtr(n, chi2), special.chdtrc(n, chi2))))


def level_of(p: float, n: int = 1) -> Level:
    """Sort a probability, the smallest of ``n``, into one of the three levels.

    Parameters
    ----------
    p : float
        Uniform if the model holds.
    n : int
        How many there were to choose from.
    """
    corrected = n * p
    if corrected >= TENSION:
        return "consistent"
    return "in tension" if corrected >= MISFIT else "does not fit"


def worst(levels: Sequence[Level]) -> Level:
    """The worst of several levels."""
    return max(levels, key=LEVELS.index)


def probability(p: float) -> str:
    """Format a probability.

    Parameters
    ----------
    p : float
        The probability.

    Returns
    -------
    str
        Such as "= 0.62", or "< 1e-300" where it is too small for a float.
    """
    return f"= {p:.2g}" if p > 0 else "< 1e-300"


def sentence(level: Level, what: str = "data") -> str:
    """The verdict's first words.

    Parameters
    ----------
    level : {"consistent", "in tension", "does not fit"}
    what : str
        What is judged, in the plural.
    """
    return {
        "consistent": f"Consistent: the {what} fit the model",
        "in tension": f"In tension: the {what} and the model agree poorly",
        "does not fit": f"Does not fit: the {what} contradict the model",
    }[level]


def size_of_residuals(chi2: float, n: int, p: float) -> str:
    """``chi^2`` with what is expected of it, and its p-value; says if it is too small.

    Parameters
    ----------
    chi2 : float
    n : int
    p : float
        From :func:`two_sided`.
    """
    text = f"p {probability(p)}; chi^2 {chi2:.0f}, expected {n} +- {np.sqrt(2.0 * n):.0f}"
    return text + (", smaller than chance allows" if chi2 < n and p < TENSION else "")
