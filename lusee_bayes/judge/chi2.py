"""chi^2 of data and maps: tests at one false-alarm rate, and the chi^2 that no sky explains.

If a model is correct, chi^2 with n degrees of freedom has ::

    p = 2 min(P(chi^2_n > chi^2), P(chi^2_n < chi^2)),

uniform from 0 to 1: too large a chi^2 counts as much as too small a one. The smallest p of k such
probabilities is judged by k p, which is below any bound at most that often, however they depend on
one another (Bonferroni). All tests of a report share one rate, so that at most one in
1 / ``FALSE_ALARM`` reports flags data that fit.

Maps are judged by their fidelity to a known truth, and by measures that need none.

chi^2 of all data under the model, (d - A mu)^T (A S A^T + N)^-1 (d - A mu), mixes instrument and
prior. With a prior of the sky that is k times as wide, ::

    q = (d - A mu)^T (k^2 A S A^T + N)^-1 (d - A mu)

remains: noise alone, since the wide prior explains any sky. Let Lambda = 1 + W be the precision of
the whitened sky in units of the prior, and W = sum_i lambda_i e_i e_i^T. Noise enters q along e_i
with the weight 1 / (1 + k^2 lambda_i), and sky of variance v with v lambda_i / (1 + k^2 lambda_i),
so that ::

    E q = N_data - (1 - v / k^2) (p - tr Lambda_k^-1),    Lambda_k = 1 + k^2 W  (p x p).

With k^2 = 100 v the sky contributes little. v is 1, or, if the sky is stronger than its prior, its
estimated variance. The rest, chi^2 - q, tests the prior. Weights lie between 0 and 1: both parts
scatter like a chi^2 with their means as degrees of freedom, or less.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from pydantic import computed_field

from lusee_bayes.core.lazy import special

Level = Literal["consistent", "unlike the prior", "does not fit"]
LEVELS: tuple[Level, ...] = ("consistent", "unlike the prior", "does not fit")
# probability that a report flags data that fit: a mission makes some hundred reports
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
    """A chi^2 with its degrees of freedom, which need not be whole; JSON includes ``p``.

    Attributes
    ----------
    chi2, degrees : float
    """

    chi2: float
    degrees: float

    @computed_field
    @property
    def p(self) -> float:
        """Two-sided p-value: uniform from 0 to 1 if the model is correct; NaN of less than 0."""
        tails = special.chdtr(self.degrees, self.chi2), special.chdtrc(self.degrees, self.chi2)
        # both are one half at the median, up to rounding
        return float(np.minimum(1.0, 2.0 * np.minimum(*tails)))

    def p_of_prior(self, learned: bool) -> float:
        """p-value of a prior's chi^2: one-sided if the prior was fitted to the same data."""
        return float(special.chdtrc(self.degrees, self.chi2)) if learned else self.p

    @property
    def fits(self) -> bool:
        """Whether chance explains it, as a single test."""
        return not stands_out(self.p, 1)

    @property
    def too_small(self) -> bool:
        """Whether it is below its expectation; relevant if it stands out."""
        return bool(self.chi2 < self.degrees)

    @property
    def of_sky(self) -> str:
        """The sky relative to its prior, in words, if the prior's chi^2 stands out."""
        if self.too_small:
            return "fainter, or closer to the prior's mean, than the prior assumes"
        return "inconsistent with the prior"

    def allowing(self, unused: float) -> "ChiSquare":
        """The same if unknowns, of less than their prior's size, leave up to so many unused."""
        return ChiSquare(self.chi2, min(self.degrees, max(self.chi2, self.degrees - unused)))

    def words(self) -> str:
        """p, and chi^2 with its expectation."""
        return f"p {probability(self.p)}, {self.chi2_words()}"

    def chi2_words(self, share: float = 1.0) -> str:
        """chi^2 with its expectation, if only this share of its degrees is independent."""
        expected = f"{self.degrees:.0f} +- {np.sqrt(2.0 * self.degrees / share):.0f}"
        return f"chi2 {self.chi2:.0f}, expected {expected}"


@dataclass(frozen=True)
class Fit:
    """A verdict.

    Attributes
    ----------
    level : {"consistent", "unlike the prior", "does not fit"}
    details : str
        Sentences on the tests that stand out, and on remedies.
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


def stands_out(p: float, among: int) -> bool:
    """Whether a p-value, one of ``among`` in a report, is too small for chance."""
    return among * p < FALSE_ALARM


def in_brief(names: list[str]) -> str:
    """The first ``NAMED`` of several names, and the number of the others."""
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
        Such as "= 0.62", or "< 1e-300" if it is too small for a float.
    """
    return f"= {p:.2g}" if p > 0 else "< 1e-300"
