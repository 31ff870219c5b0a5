"""chi^2 of data and maps: tests at one rate of false alarms, and what no sky explains.

If a model holds, chi^2 of n degrees of freedom has ::

    p = 2 min(P(chi^2_n > chi^2), P(chi^2_n < chi^2)),

uniform from 0 to 1: too large a chi^2 counts as much as too small a one. The best of k such
probabilities is judged by k p, which is below any bound at most that often, however they depend on
one another (Bonferroni). A report makes all of its tests at one rate, so that a report of data that
fit says otherwise at most once in 1 / ``FALSE_ALARM``.

Maps are judged by their fidelity to a known truth, and by measures that need none.

chi^2 of all data under the model, (d - A mu)^T (A S A^T + N)^-1 (d - A mu), mixes up instrument and
prior. Give the sky a prior k times as wide, and ::

    q = (d - A mu)^T (k^2 A S A^T + N)^-1 (d - A mu)

is left: noise alone, since the wide prior explains any sky. In units of the prior, with Lambda =
1 + W the precision of the whitened sky and W = sum_i lambda_i e_i e_i^T, noise enters q along e_i
with the weight 1 / (1 + k^2 lambda_i), and sky of variance v with v lambda_i / (1 + k^2 lambda_i),
so that ::

    E q = N_data - (1 - v / k^2) (p - tr Lambda_k^-1),    Lambda_k = 1 + k^2 W  (p x p).

With k^2 = 100 v the sky hardly matters. v is 1, or, where the sky is stronger than its prior, what
it is found to be. The rest, chi^2 - q, tests the prior. Weights lie between 0 and 1: both parts
scatter like a chi^2 with their means as degrees of freedom, or less.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from pydantic import computed_field

from lusee_bayes.core.lazy import special

Level = Literal["consistent", "unlike the prior", "does not fit"]
LEVELS: tuple[Level, ...] = ("consistent", "unlike the prior", "does not fit")
# of a report of data that fit: a mission makes some hundred of them
FALSE_ALARM = 1e-3
# groups or channels that are named in a sentence
NAMED = 4
RULE = (
    f"A test is flagged if its Bonferroni-corrected p-value is below {FALSE_ALARM:g}: a false "
    f"alarm in 1 of {1.0 / FALSE_ALARM:.0f} reports"
)
HEADLINES: dict[Level, str] = {
    "consistent": "The map is consistent with the data, the noise and the prior.",
    "unlike the prior": "Prior mismatch: the data fit, but the sky is implausible under the prior.",
    "does not fit": "The data do not fit the model: do not trust the error bars.",
}


@dataclass(frozen=True)
class ChiSquare:
    """A chi^2 with its degrees of freedom, which need not be whole; ``p`` goes into JSON, too.

    Attributes
    ----------
    chi2, degrees : float
    """

    chi2: float
    degrees: float

    @computed_field
    @property
    def p(self) -> float:
        """Probability of a chi^2 as far out on its side, if the model holds."""
        return two_sided(self.chi2, self.degrees)

    @property
    def fits(self) -> bool:
        """Whether it alone is what chance makes."""
        return not stands_out(self.p, 1)

    @property
    def too_small(self) -> bool:
        """Whether it is below what is expected, where it stands out."""
        return bool(self.chi2 < self.degrees)

    @property
    def of_sky(self) -> str:
        """What the sky is where its prior's chi^2 stands out."""
        if self.too_small:
            return "fainter, or closer to the prior's mean, than the prior assumes"
        return "inconsistent with the prior"

    def words(self) -> str:
        """p, and chi^2 with what is expected of it."""
        return f"p {probability(self.p)}, {self.chi2_words()}"

    def chi2_words(self) -> str:
        """chi^2 with what is expected of it."""
        expected = f"{self.degrees:.0f} +- {np.sqrt(2.0 * self.degrees):.0f}"
        return f"chi2 {self.chi2:.0f}, expected {expected}"


@dataclass(frozen=True)
class Fit:
    """A verdict.

    Attributes
    ----------
    level : {"consistent", "unlike the prior", "does not fit"}
    details : str
        In sentences: what stands out, and what to do.
    """

    level: Level
    details: str

    @property
    def headline(self) -> str:
        """The verdict in one sentence."""
        return HEADLINES[self.level]

    @property
    def text(self) -> str:
        """The verdict with its details."""
        return f"{self.headline} {self.details}"


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


def stands_out(p: float, among: int) -> bool:
    """Whether a probability, one of ``among`` of a report, is too small for chance."""
    return among * p < FALSE_ALARM


def in_brief(names: list[str]) -> str:
    """The first ``NAMED`` of several names, and how many more there are."""
    more = len(names) - NAMED
    return ", ".join([*names[:NAMED], *([f"{more} more"] if more > 0 else [])])


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
