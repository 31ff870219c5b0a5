"""Predictions of data from all other data, and data that do not fit.

Under a prior that is wide enough for any sky (:mod:`.chi2`), let K = k^2 A S A^T + N be the
covariance of data, and u = K^-1 (d - E[d]). A group s of data differs from its prediction by all
others by K_ss^-1 u_s, where K_ss is a block of K^-1, and ::

    chi^2_s = u_s^T K_ss^-1 u_s,    chi^2_all - chi^2_s = chi^2 of the others without s.

Each direction of the sky that only the group measures uses a degree of freedom: a day that alone
sees a part of the sky is not blamed for it. A bad group spoils the predictions for all others, too;
the culprit is the group whose removal makes the rest fit.
"""

from dataclasses import dataclass, replace

import numpy as np

from lusee_bayes.core.arrays import DataVector
from lusee_bayes.instrument.visibilities import Visibilities
from lusee_bayes.judge.chi2 import ChiSquare, Fit, Level, in_brief, probability, stands_out
from lusee_bayes.judge.left_out import KINDS, DataGroup, LeftOut, Missed, groups_of
from lusee_bayes.judge.split import Split, with_sky
from lusee_bayes.linear.linear_gaussian import Solution

# if the sky is inconsistent with the prior
TOO_WIDE = (
    "The prior is wider than the sky requires: error bars are too wide where the sky is fainter "
    "than the prior assumes. Map with a narrower prior (docs/howto/priors.md)."
)
TOO_NARROW = (
    "Error bars are too narrow where the sky is brighter than the prior assumes, and too wide "
    "where it is fainter. Map with another prior (docs/howto/priors.md)."
)


@dataclass(frozen=True)
class Group:
    """Data that are left out together, and how they differ from their prediction.

    Attributes
    ----------
    kind, name : str
        Of the product, day or turntable angle, as in :class:`.DataGroup`.
    n : int
        Number of data.
    degrees : float
        Mean of ``chi2`` for noise alone: ``n`` minus the directions of the sky that only this group
        measures.
    chi2 : float
        Of these data given all others.
    p : float
        Two-sided p-value of ``chi2`` if instrument and noise are correct.
    others_p : float
        The same for all other data without these; NaN if there are no others.
    """

    kind: str
    name: str
    n: int
    degrees: float
    chi2: float
    p: float
    others_p: float

    def __str__(self) -> str:
        return f"{self.kind} {self.name}"


@dataclass(frozen=True)
class Residuals:
    """Data against noise and prior, and every group of data against all others.

    Attributes
    ----------
    z : (data,) array
        Each datum minus its prediction by all others, in standard deviations: N(0, 1) or narrower,
        and not independent. NaN if groups are not judged.
    split : Split
        chi^2 of all data: the part that no sky explains, and the part that tests the prior.
    groups : tuple of Group
        The data of every product, day and turntable angle; none if they are not judged because
        the test would need too large an A (:meth:`.LeftOut.of`).
    learned : bool
        Whether the prior was learned from these data: its chi^2 may then be small.
    """

    z: DataVector
    split: Split
    groups: tuple[Group, ...]
    learned: bool = False

    def compared(self) -> list[Group]:
        """Groups that other data predict."""
        return [group for group in self.groups if np.isfinite(group.others_p)]

    @property
    def n_tests(self) -> int:
        """Number of all tests: instrument, prior, and every group."""
        return 2 + len(self.compared())

    def extremes(self) -> list[Group]:
        """Groups inconsistent with their prediction by all others, the least probable first."""
        groups = [group for group in self.compared() if stands_out(group.p, self.n_tests)]
        return sorted(groups, key=lambda group: group.p)

    def level(self) -> Level:
        """The verdict in a word.

        Instrument, noise and groups are judged independently of the prior. Only if they are correct
        does the rest of chi^2 test the prior.
        """
        if self.extremes() or stands_out(self.split.instrument.p, self.n_tests):
            return "does not fit"
        p = self.split.prior.p_of_prior(self.learned)
        return "unlike the prior" if stands_out(p, self.n_tests) else "consistent"

    def suspects(self) -> list[Group]:
        """Find the groups without which the rest fits.

        Returns
        -------
        list of Group
            By kind, the least probable first; empty if all data fit. If any group stands out, only
            such groups are considered.
        """
        if self.level() != "does not fit":
            return []
        looked_at = self.extremes() or self.compared()
        groups = [one for one in looked_at if not stands_out(one.others_p, self.n_tests)]
        return sorted(groups, key=lambda group: (KINDS.index(group.kind), group.p))

    def fit(self, strengths: str = "", *, truncated: bool = False) -> Fit:
        """Judge whether the data fit, and recommend a remedy if not.

        Parameters
        ----------
        strengths : str
            Sentence on the strength of the sky relative to its prior, by place and scale.
        truncated : bool
            Whether structure beyond lmax explains a misfit, so that no data are to be excluded.
        """
        level = self.level()
        instrument, prior = (part.words() for part in (self.split.instrument, self.split.prior))
        if level == "consistent":
            return Fit(level, f"Instrument and noise: {instrument}. Prior: {prior}.")
        if level == "unlike the prior":
            advice = TOO_WIDE if self.split.prior.too_small else TOO_NARROW
            sky = f"The sky is {self.split.prior.of_sky} ({prior}); instrument and noise fit "
            return Fit(level, " ".join(filter(None, [f"{sky}({instrument}).", strengths, advice])))
        whole = stands_out(self.split.instrument.p, self.n_tests)
        quiet = all(one.chi2 < one.degrees for one in self.extremes())
        small = whole and quiet and self.split.instrument.too_small
        why = "The noise is smaller than assumed" if small else "No sky explains these data"
        why = why if whole else "As a whole, the data fit"
        blame = [] if small else self._blame(truncated)
        return Fit(level, " ".join([f"{why} ({instrument}).", *blame]))

    def _blame(self, truncated: bool) -> list[str]:
        """Which groups stand out and, unless lmax is too low, which to exclude."""
        if not self.compared():
            return [
                "Products, days and turntable angles were not tested: rounding hides their chi2, "
                "or the noise couples different times, so that the test would need all of A."
            ]
        parts, extremes, suspects = [], self.extremes(), self.suspects()
        if (suspects or truncated) and extremes:
            named = in_brief([f"{group} (p {probability(group.p)})" for group in extremes])
            parts.append(f"Of {len(self.compared())} groups, these are inconsistent: {named}.")
        if truncated:
            return parts
        for kind in KINDS:
            mine = [group for group in suspects if group.kind == kind]
            if len(mine) == 1:
                p = probability(mine[0].others_p)
                parts.append(f"The others fit without {mine[0]} (p {p}): exclude it.")
            elif mine:
                any_one = f"any one of {len(mine)} {kind}s ({in_brief([one.name for one in mine])})"
                parts.append(f"The others fit without {any_one}: the data cannot show which.")
        if not suspects:
            many = f"{len(extremes)} of {len(self.compared())} products, days and turntable angles"
            parts.append(f"{many} are inconsistent; excluding any one of them is not enough.")
        return parts


def residuals(
    solution: Solution, data: Visibilities, unused: float = 0.0, *, learned: bool = False
) -> Residuals:
    """Compare data with the model's predictions for them, group by group.

    Days have 24 hours from the first sample. Runs at the same turntable angle are one group.

    Parameters
    ----------
    solution : Solution
        Of these data.
    data : Visibilities
        In K, with their times and turntable angles.
    unused : float
        Degrees of freedom that unknowns may leave unused (:meth:`.ChiSquare.allowing`).
    learned : bool
        Whether the prior was learned from these data.

    Returns
    -------
    Residuals
        Of every datum and group.

    Raises
    ------
    InputError
        If the model cannot be factorised.
    """
    model, layout = solution.model, data.layout
    split = Split.of(solution.posterior, solution.chi2, model.n_data, solution.matrix)
    split = replace(split, instrument=split.instrument.allowing(unused))
    if (left_out := LeftOut.of(replace(model, prior=split.wide.prior), data, split.wide)) is None:
        return Residuals(np.full(model.n_data, np.nan), split, (), learned)
    whole = split.instrument

    def judged(group: DataGroup, missed: Missed) -> Group:
        n, own, others_p = missed.n, whole, np.nan
        if n < model.n_data:
            own = ChiSquare(missed.chi2, n - with_sky(n - missed.degrees))
            own = own.allowing(unused * own.degrees / whole.degrees)
            # NaN if own is larger, which rounding causes
            others_p = ChiSquare(whole.chi2 - own.chi2, whole.degrees - own.degrees).p
        return Group(group.kind, group.name, n, own.degrees, own.chi2, own.p, others_p)

    groups = groups_of(data)
    tests = tuple(map(judged, groups, left_out.each([group.data for group in groups])))
    z = layout.gather(left_out.u) / np.sqrt(layout.gather(left_out.inverse_diagonal))
    return Residuals(z, split, tests, learned)
