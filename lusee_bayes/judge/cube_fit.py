"""Whether the data of all channels fit: instrument and noise by channel, the prior for all.

The chi^2 that no sky explains (:mod:`.chi2`) is computed for each channel, independently of the
prior and of whether channels share a posterior. Channels are independent: their chi^2 add up, and
each is above its median with a probability of one half. The sum and the number above the median
reveal excesses too small to be seen in single channels, such as 38 of 46 channels above. If the
model has a sky above lmax, nearly the same in all channels, its part of chi^2 varies in all alike:
with k of n degrees of freedom, c channels count as c / (1 + (c - 1) k / n) independent ones.

The rest of chi^2 of all data under the model tests the prior. Channels see one sky, whose departure
from the prior is much the same in all: without a joint prior, its mean over channels is judged like
that of one.

Channels that share the instrument can contradict each other. The data of channel k constrain the
shared unknowns by a likelihood N(y, L^-1), with L = V^-1 - 1 and L y = V^-1 E (:mod:`.amplitudes`);
all other channels, with the prior, predict N(m, P). If the instrument is the same, ::

    chi^2 = (y - m)^T (L^-1 + P)^-1 (y - m)

has one degree of freedom for each direction that channel k constrains. A wrong channel spoils the
prediction of all the others. The worst channel is therefore left out, and the others are tested
again, until no channel stands out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from pydantic import computed_field
from scipy.special import bdtr, chdtrc

from lusee_bayes.judge.chi2 import LEVELS, ChiSquare, Fit, Level, in_brief, probability, stands_out
from lusee_bayes.linear.amplitudes import root_of_kernels

# number of joint tests
N_TESTS = 4


@dataclass(frozen=True)
class JointTest:
    """One of the joint tests.

    Attributes
    ----------
    name : str
    p : float
        Uniform, or on average larger, if the model is correct.
    n : int
        Number of probabilities of which ``p`` is the smallest.
    found : str
        The result in words.
    of_prior : bool
        Whether it tests the prior; otherwise instrument and noise.
    """

    name: str
    p: float
    n: int
    found: str
    of_prior: bool = False

    @computed_field
    @property
    def level(self) -> Level:
        """The verdict of this test, one of ``N_TESTS``."""
        if not stands_out(self.p, N_TESTS * self.n):
            return "consistent"
        return "unlike the prior" if self.of_prior else "does not fit"


@dataclass(frozen=True)
class ChannelFits:
    """chi^2 of every channel, and the tests of all of them together.

    Attributes
    ----------
    frequencies_mhz : (channels,) array
    channels : tuple of ChiSquare
        chi^2 of each channel that no sky explains.
    prior : ChiSquare
        Tests the prior: of all channels in a joint posterior, else the mean over channels.
    joint : bool
        Whether channels share a posterior.
    shared : tuple of SharedTest
        If they share the instrument.
    learned : bool
        Whether priors were learned from these data.
    seen_above : tuple of float
        Of each channel, degrees of freedom of the sky above lmax, which are common to channels.
    """

    frequencies_mhz: Float[np.ndarray, " channels"]
    channels: tuple[ChiSquare, ...]
    prior: ChiSquare
    joint: bool = False
    shared: tuple[SharedTest, ...] = ()
    learned: bool = False
    seen_above: tuple[float, ...] = ()

    @property
    def total(self) -> ChiSquare:
        """chi^2 of all channels together."""
        return ChiSquare(sum(c.chi2 for c in self.channels), sum(c.degrees for c in self.channels))

    @property
    def independent(self) -> float:
        """Number of independent channels whose sum scatters as much as that of these."""
        n = len(self.channels)
        return n / (1.0 + (n - 1.0) * sum(self.seen_above) / self.total.degrees)

    def p(self) -> Float[np.ndarray, " channels"]:
        """Probability of every channel's chi^2, two-sided."""
        return np.array([one.p for one in self.channels])

    def extremes(self) -> list[int]:
        """Channels that stand out among all of them, the least probable first."""
        p = self.p()
        return [int(k) for k in np.argsort(p) if stands_out(float(p[k]), N_TESTS * len(p))]

    def tests(self) -> list[JointTest]:
        """The joint tests: sum, number above the median, most deviant channel, and the prior."""
        p, n = self.p(), len(self.channels)
        least = int(np.argmin(p))
        above = sum(bool(chdtrc(one.degrees, one.chi2) < 0.5) for one in self.channels)
        # of as many channels as are independent: the sum scatters more, too
        share = self.independent / n
        whole = ChiSquare(share * self.total.chi2, share * self.total.degrees).p
        apart = max(1, round(self.independent))
        signs = min(1.0, 2.0 * float(bdtr(min(above, n - above) * apart // n, apart, 0.5)))
        name = "prior" if self.joint else "prior, mean over channels"
        of_prior = self.prior.p_of_prior(self.learned)
        where = f"{self.frequencies_mhz[least]:g} MHz, {self.channels[least].chi2_words()}"
        return [
            JointTest("sum over all channels", whole, 1, self.total.chi2_words(share)),
            JointTest("channels above the median", signs, 1, f"{above} of {n}"),
            JointTest("most deviant channel", float(p[least]), n, where),
            JointTest(name, of_prior, 1, self.prior.chi2_words(), of_prior=True),
        ]

    def fit(self) -> Fit:
        """The verdict of all tests, and the channels that stand out."""
        tests, p = self.tests(), self.p()
        contradiction = disagreement(self.shared)
        level = max((test.level for test in tests), key=LEVELS.index)
        level = "does not fit" if contradiction else level
        quiet = "The data scatter less than the assumed noise"
        misfit = quiet if self._too_quiet() else "No sky explains the data of all channels"
        verdicts = {
            "consistent": "Instrument, noise and prior fit in all channels.",
            "unlike the prior": "Instrument and noise fit in all channels, "
            f"but the skies are {self.prior.of_sky}.",
            "does not fit": contradiction or f"{misfit}.",
        }
        sentences = [verdicts[level]]
        for test in tests:
            p_value = probability(min(1.0, test.n * test.p))
            times = f" among {test.n}" if test.n > 1 else ""
            sentences.append(f"{test.name.capitalize()}: {test.found} (p {p_value}{times}).")
        if extremes := self.extremes():
            frequencies = self.frequencies_mhz
            names = [f"{frequencies[k]:g} MHz (p {probability(float(p[k]))})" for k in extremes]
            sentences.append(f"{len(extremes)} of {len(p)} channels flagged: {in_brief(names)}.")
        return Fit(level, " ".join([*sentences, *([] if contradiction else self._advice(level))]))

    def _too_quiet(self) -> bool:
        """Whether the least probable chi^2, of a channel or of all together, is too small."""
        return min([*self.channels, self.total], key=lambda one: one.p).too_small

    def _advice(self, level: Level) -> list[str]:
        if level == "does not fit" and self._too_quiet():
            return [
                "The assumed noise (noise.radiometer) is too large, or the data lack the sky above "
                "lmax that the model expects (noise.above_lmax)."
            ]
        if level == "does not fit":
            others = "Without them, map the others again: their skies moved, too."
            advice = "Map the flagged channels one by one: this also tests their products and days."
            return [advice, *[others][: self.joint]]
        if level == "unlike the prior" and self.prior.too_small:
            narrower = "smaller spectral.residual" if self.joint else "narrower prior"
            finding = "The prior is wider than the skies require, and error bars are too wide"
            return [f"{finding}: a {narrower} would give a sharper map (compare the evidence)."]
        if level == "unlike the prior" and self.joint:
            return [
                "The skies may not follow the spectral prior, and error bars be too small: compare "
                "the evidence of other spectral.components and a larger spectral.residual."
            ]
        if level == "unlike the prior":
            return [
                "Error bars may be too narrow where skies are brighter than the prior assumes, and "
                "too wide elsewhere: map with another prior (docs/howto/priors.md)."
            ]
        return []


# information in prior units below which a channel's own data do not constrain a direction
LEAST_INFORMATION = 1e-2


@dataclass(frozen=True)
class SharedTest:
    """A channel's own constraints on the shared instrument, compared with all other channels.

    Attributes
    ----------
    frequency_mhz : float
    chi2 : float
        Of the difference from all others that agree with each other.
    degrees : int
        Directions of the unknowns that the channel's own data constrain.
    disagrees : bool
        Whether it stands out among all channels.
    shares : dict of float
        By unknown that all channels have in common: this channel's fraction of the information,
        which is 1 / variance - 1 in prior units. Each channel is counted separately; zero for one
        that disagrees, and if no channel constrains the unknown.
    """

    frequency_mhz: float
    chi2: float
    degrees: int
    disagrees: bool
    shares: dict[str, float]

    @computed_field
    @property
    def p(self) -> float:
        """Probability of a larger chi^2 if all channels share one instrument."""
        return float(chdtrc(self.degrees, self.chi2)) if self.degrees else 1.0


def shared_tests(
    mean: Float[np.ndarray, "channels n"],
    covariance: Float[np.ndarray, "channels n n"],
    kernels: Float[np.ndarray, "n channels channels"],
    names: Sequence[str],
    frequencies_mhz: Sequence[float],
) -> tuple[SharedTest, ...]:
    """Test each channel against all others, and compare their information about the instrument.

    Parameters
    ----------
    mean, covariance, kernels : array
        As for :func:`.tie`, in prior standard deviations.
    names : sequence of str
        Of the n unknowns.
    frequencies_mhz : sequence of float
        Of the channels.
    """
    inverse, blocks = np.linalg.inv(covariance), root_of_kernels(kernels)
    pull, precision = np.einsum("kij,kj->ki", inverse, mean), inverse - np.eye(len(names))
    seen = np.swapaxes(blocks, 1, 2) @ precision @ blocks
    pulled = np.einsum("kiw,ki->kw", blocks, pull)
    agree, tests = list(range(len(mean))), [(0.0, 0)] * len(mean)

    def compared(k: int) -> tuple[float, int]:
        """chi^2 of channel k and its degrees of freedom."""
        peers = [j for j in agree if j != k]
        others = np.eye(blocks.shape[2]) + seen[peers].sum(0)
        predicted = blocks[k] @ np.linalg.solve(others, pulled[peers].sum(0))
        spread = blocks[k] @ np.linalg.solve(others, blocks[k].T)
        values, axes = np.linalg.eigh(precision[k])
        kept = values > max(LEAST_INFORMATION, len(values) * np.finfo(float).eps * values[-1])
        # in units of the channel's own errors: chi^2 = r^T (1 + L^1/2 P L^1/2)^-1 r
        white = axes[:, kept] / np.sqrt(values[kept])
        off = white.T @ (inverse[k] @ (mean[k] - predicted) + predicted)
        half = precision[k] @ white
        variance = np.eye(len(off)) + half.T @ spread @ half
        return float(off @ np.linalg.solve(variance, off)), len(off)

    def excess(k: int) -> float:
        return (tests[k][0] - tests[k][1]) / np.sqrt(2.0 * tests[k][1] or 1.0)

    while len(agree) > 1:
        for k in agree:
            tests[k] = compared(k)
        worst = max(agree, key=excess)
        if not stands_out(float(chdtrc(max(tests[worst][1], 1), tests[worst][0])), len(mean)):
            break
        # if only two differ, either may be wrong
        agree = [k for k in agree if k != worst] if len(agree) > 2 else []
    alone = np.maximum(1.0 / np.diagonal(covariance, axis1=1, axis2=2) - 1.0, 0.0)
    alone[np.setdiff1d(np.arange(len(alone)), agree)] = 0.0
    common = [i for i, kernel in enumerate(kernels) if (kernel == 1.0).all()]
    total = alone.sum(0)
    shares = np.divide(alone, total, out=np.zeros(alone.shape), where=total > 0)
    return tuple(
        SharedTest(f, *tests[k], k not in agree, {names[i]: float(shares[k, i]) for i in common})
        for k, f in enumerate(frequencies_mhz)
    )


def disagreement(tests: Sequence[SharedTest]) -> str:
    """Name the channels that disagree, in a sentence; empty if all agree."""
    bad = [f"{t.frequency_mhz:g} MHz (p {probability(t.p)})" for t in tests if t.disagrees]
    if not bad:
        return ""
    disagree, are = ("disagrees", "is") if len(bad) == 1 else ("disagree", "are")
    others = "the other channels on the shared instrument"
    advice = f"and {are} solved without them: check beams and data there."
    return f"{in_brief(bad)} {disagree} with {others}, {advice}"
