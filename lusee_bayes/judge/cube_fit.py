"""Whether the data of all channels fit: instrument and noise by channel, the prior for all.

What no sky explains (:mod:`.chi2`) is known of each channel by itself, whatever the prior and
whether or not channels share a posterior. Channels are independent: their chi^2 add up, and each
is above its median with a chance of one half. Small excesses that no channel shows by itself, such
as 38 of 46 channels above, are seen in the sum and in the number of those above.

The rest of chi^2 of all data under the model tells of the prior.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from pydantic import computed_field
from scipy.special import bdtr, chdtrc

from lusee_bayes.judge.chi2 import LEVELS, ChiSquare, Fit, Level, in_brief, probability, stands_out

# of the joint tests
N_TESTS = 4


@dataclass(frozen=True)
class JointTest:
    """One of the joint tests.

    Attributes
    ----------
    name : str
    p : float
        Uniform, or on average larger, if the model holds.
    n : int
        How many probabilities ``p`` is the smallest of.
    found : str
        What was found, in words.
    of_prior : bool
        Whether it tests the prior, else instrument and noise.
    """

    name: str
    p: float
    n: int
    found: str
    of_prior: bool = False

    @computed_field
    @property
    def level(self) -> Level:
        """The verdict of this test, one of four."""
        if not stands_out(self.p, N_TESTS * self.n):
            return "consistent"
        return "unlike the prior" if self.of_prior else "does not fit"


@dataclass(frozen=True)
class ChannelFits:
    """chi^2 of every channel, and the tests of all of them together.

    Attributes
    ----------
    frequencies_mhz : (channels,) array
    chi2, degrees : (channels,) array
        What no sky explains of each channel, and its mean if instrument and noise are right.
    rest : ChiSquare
        Of all channels together, what the prior does not expect.
    joint : bool
        Whether channels share a posterior.
    """

    frequencies_mhz: Float[np.ndarray, " channels"]
    chi2: Float[np.ndarray, " channels"]
    degrees: Float[np.ndarray, " channels"]
    rest: ChiSquare
    joint: bool = False

    @property
    def by_channel(self) -> list[ChiSquare]:
        """That of every channel."""
        return list(map(ChiSquare, self.chi2.tolist(), self.degrees.tolist()))

    @property
    def total(self) -> ChiSquare:
        """That of all channels together."""
        return ChiSquare(float(self.chi2.sum()), float(self.degrees.sum()))

    def p(self) -> Float[np.ndarray, " channels"]:
        """Probability of every channel's chi^2, two-sided."""
        return np.array([one.p for one in self.by_channel])

    def extremes(self) -> list[int]:
        """Channels that stand out among all of them, the least probable first."""
        p = self.p()
        found = [k for k in np.argsort(p) if stands_out(float(p[k]), N_TESTS * len(p))]
        return [int(k) for k in found]

    def tests(self) -> list[JointTest]:
        """The joint tests: sum, number above the median, channel furthest out, and the prior."""
        p, n = self.p(), len(self.chi2)
        least = int(np.argmin(p))
        above = int((chdtrc(self.degrees, self.chi2) < 0.5).sum())
        signs = min(1.0, 2.0 * float(bdtr(min(above, n - above), n, 0.5)))
        where = f"{self.frequencies_mhz[least]:g} MHz, {self.by_channel[least].found()}"
        return [
            JointTest("sum over all channels", self.total.p, 1, self.total.found()),
            JointTest("channels above the median", signs, 1, f"{above} of {n}"),
            JointTest("channel furthest out", float(p[least]), n, where),
            JointTest("prior", self.rest.p, 1, self.rest.found(), of_prior=True),
        ]

    def fit(self) -> Fit:
        """The verdict of all tests, and the channels that stand out."""
        tests, p = self.tests(), self.p()
        level = max((test.level for test in tests), key=LEVELS.index)
        sky, misfit = self.rest.of_sky, "no sky explains the data of all channels"
        if self._too_quiet():
            misfit = (
                "the data scatter less about what a sky explains than the noise would have them"
            )
        told = [
            {
                "consistent": "Consistent: instrument, noise and prior fit in all channels.",
                "unlike the prior": "Unlike the prior: instrument and noise fit in all channels, "
                f"but the skies are {sky}.",
                "does not fit": f"Does not fit: {misfit}.",
            }[level]
        ]
        for test in tests:
            corrected = min(1.0, test.n * test.p)
            times = f" among {test.n}" if test.n > 1 else ""
            told.append(
                f"{test.name.capitalize()}: {test.found} (p {probability(corrected)}{times})."
            )
        extremes = self.extremes()
        if extremes:
            frequencies = self.frequencies_mhz
            names = [f"{frequencies[k]:g} MHz (p {probability(float(p[k]))})" for k in extremes]
            told.append(f"{len(extremes)} of {len(p)} channels stand out: {in_brief(names)}.")
        return Fit(level, " ".join([*told, *self._advice(level)]))

    def _too_quiet(self) -> bool:
        """Whether all channels together, or the one furthest out if that is less probable, have
        too small a chi^2.
        """
        return min([*self.by_channel, self.total], key=lambda one: one.p).too_small

    def _advice(self, level: Level) -> list[str]:
        if level == "does not fit" and self._too_quiet():
            return ["The noise is given too large (noise.radiometer): error bars are too wide."]
        if level == "does not fit":
            return ["Map the channels that stand out one by one: products and days are judged."]
        if level == "unlike the prior" and self.rest.too_small:
            narrower = "smaller spectral.residual" if self.joint else "narrower prior"
            return [
                "The prior is wider than the skies need, and error bars are too wide: a "
                f"{narrower} would tell more (compare the evidence)."
            ]
        if level == "unlike the prior" and self.joint:
            return [
                "Skies may not obey the spectral prior, and error bars be too small: compare the "
                "evidence of other spectral.components and of a larger spectral.residual."
            ]
        if level == "unlike the prior":
            return [
                "Error bars may be too narrow where skies are stronger than the prior expects, and "
                "too wide elsewhere: choose another prior (lusee-bayes compare-priors)."
            ]
        return []
