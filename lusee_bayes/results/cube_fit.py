"""Whether the data of all channels fit: each channel by itself, and all of them together.

A channel with a posterior of its own is judged by chi^2 of its data under the model, sky included,
which follows a chi^2 distribution exactly. Channels are then independent: their chi^2 add up, and
each is above its median with a chance of one half. Small excesses that no channel shows by itself,
such as 38 of 46 channels above, are seen in the sum and in the number of those above.

Of a joint posterior, what is known of a channel is chi^2 of the residuals about the map. It is
r^T r with r ~ N(0, M) and 0 <= M <= 1, so that its variance, 2 tr M^2, is at most twice its mean,
tr M: a chi^2 distribution of tr M degrees of freedom is the widest that it can be, and p-values
from that are not too small. All data together then follow a chi^2 distribution exactly again.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.special import bdtr, chdtrc

from lusee_bayes.linear.fit import (
    Fit,
    Level,
    level_of,
    probability,
    sentence,
    two_sided,
    worst,
)

# channels that are named in a sentence
NAMED = 4


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
    """

    name: str
    p: float
    n: int
    found: str

    @property
    def level(self) -> Level:
        """The verdict of this test."""
        return level_of(self.p, self.n)


@dataclass(frozen=True)
class ChannelFits:
    """chi^2 of every channel, and the tests of all of them together.

    Attributes
    ----------
    frequencies_mhz : (channels,) array
    chi2 : (channels,) array
    degrees : (channels,) array
        Degrees of freedom of the distribution that judges ``chi2``: its mean if the model holds.
    total : tuple of float and int or None
        chi^2 of all data under a joint model and their number; None where channels are independent,
        whose chi^2 add up, and where it is not known.
    residuals : tuple of float and float or None
        Of independent channels: chi^2 of the residuals about all maps, and its mean. The rest of
        ``chi2`` is m^T S^-1 m of the maps; the larger excess tells which of noise and sky is off.
    joint : bool
        Whether channels share a posterior.
    bound : bool
        ``degrees`` are an upper bound (the number of data): only a larger ``chi2`` counts.
    """

    frequencies_mhz: Float[np.ndarray, " channels"]
    chi2: Float[np.ndarray, " channels"]
    degrees: Float[np.ndarray, " channels"]
    total: tuple[float, int] | None = None
    residuals: tuple[float, float] | None = None
    joint: bool = False
    bound: bool = False

    def p(self) -> Float[np.ndarray, " channels"]:
        """Probability of every channel's chi^2, two-sided (upper side only, for a bound)."""
        if self.bound:
            return chdtrc(self.degrees, self.chi2)
        pairs = zip(self.chi2.tolist(), self.degrees.tolist(), strict=True)
        return np.array([two_sided(chi2, n) for chi2, n in pairs])

    def extremes(self) -> list[int]:
        """Channels that stand out among all of them, the least probable first."""
        p = self.p()
        found = [k for k in np.argsort(p) if level_of(float(p[k]), len(p)) != "consistent"]
        return [int(k) for k in found]

    def tests(self) -> list[JointTest]:
        """The joint tests: sum, number above the median, and the channel furthest out."""
        p, n = self.p(), len(self.chi2)
        least = int(np.argmin(p))
        found = [
            JointTest(
                "channel furthest out",
                float(p[least]),
                n,
                f"{self.frequencies_mhz[least]:g} MHz, chi^2 {self.chi2[least]:.0f}, expected "
                f"{self.degrees[least]:.0f}",
            )
        ]
        if self.bound:
            return found
        above = int((chdtrc(self.degrees, self.chi2) < 0.5).sum())
        fewer = min(above, n - above)
        signs = min(1.0, 2.0 * float(bdtr(fewer, n, 0.5)))
        found.insert(0, JointTest("channels above the median", signs, 1, f"{above} of {n}"))
        total = self.total
        if total is None and not self.joint:
            total = float(self.chi2.sum()), round(float(self.degrees.sum()))
        if total is not None:
            text = f"chi^2 {total[0]:.0f}, expected {total[1]} +- {np.sqrt(2.0 * total[1]):.0f}"
            found.insert(0, JointTest("sum over all channels", two_sided(*total), 1, text))
        return found

    def _cause(self, level: Level) -> list[str]:
        """Whether sky or noise is further from the model, of channels of their own."""
        if level == "consistent" or self.residuals is None:
            return []
        about, expected = self.residuals
        noise = about / expected
        sky = (float(self.chi2.sum()) - about) / (float(self.degrees.sum()) - expected)
        told = (
            f"Against their expectations, the residuals about the maps are {noise:.3g} times, and "
            f"the squared sky in units of its prior is {sky:.3g} times as large: "
        )
        if abs(sky - 1.0) > abs(noise - 1.0):
            return [
                told + "it is the sky that the model does not describe, which its prior takes to "
                "be isotropic and Gaussian, more than the noise."
            ]
        return [told + "look at noise and beams."]

    def fit(self) -> Fit:
        """The verdict of all tests, and the channels that stand out."""
        tests, p = self.tests(), self.p()
        level = worst([test.level for test in tests])
        told = [f"{sentence(level, 'data of all channels')}."]
        for test in tests:
            corrected = min(1.0, test.n * test.p)
            times = f" among {test.n}" if test.n > 1 else ""
            told.append(
                f"{test.name.capitalize()}: {test.found} (p {probability(corrected)}{times})."
            )
        extremes = self.extremes()
        if extremes:
            names = ", ".join(
                f"{self.frequencies_mhz[k]:g} MHz (p {probability(float(p[k]))})"
                for k in extremes[:NAMED]
            )
            more = len(extremes) - NAMED
            names += f", {more} more" if more > 0 else ""
            told.append(f"{len(extremes)} of {len(p)} channels stand out: {names}.")
        told += self._cause(level)
        if self.bound:
            told.append(
                "Conjugate gradients leave the expected chi^2 unknown; the number of data, its "
                "upper bound, stands for it."
            )
        if self.joint and level != "consistent":
            told.append(
                "Skies may not obey the spectral prior, and error bars be too small: compare the "
                "evidence of other spectral.components and of a larger spectral.residual."
            )
        return Fit(level, tests[0].p, " ".join(told))
