"""What the model predicts of data from all other data, and what does not fit.

Under a prior that is wide enough for any sky (:mod:`.chi2`), with K = k^2 A S A^T + N the
covariance of data and u = K^-1 (d - E[d]), a group s of data differs from its prediction by all
others by K_ss^-1 u_s, K_ss being a block of K^-1, and ::

    chi^2_s = u_s^T K_ss^-1 u_s,    chi^2_all - chi^2_s = chi^2 of the others without s.

Directions of the sky that only the group measures take a degree of freedom each: a day that sees
what no other day does is not blamed for it. A bad group spoils the predictions for all others too;
the culprit is the group whose removal makes the rest fit.

The density ln p(d_s | all others) of a group is that of its prediction, whose width counts: a prior
that predicts too much is punished as one that predicts too little is.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Int

from lusee_bayes.core.arrays import DataVector, on_host
from lusee_bayes.core.engine import in_threads
from lusee_bayes.instrument.visibilities import Visibilities
from lusee_bayes.judge.chi2 import ChiSquare, Fit, Level, probability, stands_out, two_sided
from lusee_bayes.judge.left_out import (
    NOT_TOLD,
    DenseLeftOut,
    LeftOut,
    Missed,
    StructuredLeftOut,
    base_and_templates,
)
from lusee_bayes.judge.split import Split, with_sky
from lusee_bayes.linear.linear_gaussian import LinearGaussian
from lusee_bayes.linear.posterior import Posterior

# a larger A is not formed, and its groups of data are not judged: 60,000 data at lmax 47
DENSE_BYTES = 1.2e9
# groups that stand out and are named in a sentence
NAMED = 4
HOURS_A_DAY = 24.0
# of a prior that the sky is unlike
TOO_WIDE = (
    "The prior is wider than the sky needs: where the sky is weaker than it expects, error bars "
    "are too wide; a narrower prior would tell more (lusee-bayes compare-priors)."
)
TOO_NARROW = (
    "Where the sky is stronger than the prior expects, error bars are too narrow, and too wide "
    "where it is weaker: choose another prior (lusee-bayes compare-priors)."
)


@dataclass(frozen=True)
class Group:
    """Data that are left out together.

    Attributes
    ----------
    name : str
        Of the product, day or turntable angle.
    n : int
        Number of data.
    degrees : float
        Mean of ``chi2`` if there is noise alone: ``n`` less the directions of the sky that only
        this group measures.
    chi2 : float
        Of these data given all others.
    p : float
        Probability of a ``chi2`` as far out on its side if instrument and noise are right.
    others_p : float
        The same of the others without these; NaN if there are no others.
    """

    name: str
    n: int
    degrees: float
    chi2: float
    p: float
    others_p: float


@dataclass(frozen=True)
class Residuals:
    """Data against noise and prior, and every group of data against all others.

    Attributes
    ----------
    predicted : (data,) array
        A mean + offset, in K.
    z : (data,) array
        Each datum less its prediction by all others, in standard deviations: N(0, 1) or narrower,
        and not independent. NaN where groups are not judged.
    split : Split
        chi^2 of all data: what no sky explains, and what the prior does not expect.
    products, days, angles : tuple of Group
        The data of every product, day and turntable angle; none where they are not judged, since
        noise that couples times would need an A of more than ``DENSE_BYTES``.
    """

    predicted: DataVector
    z: DataVector
    split: Split
    products: tuple[Group, ...]
    days: tuple[Group, ...]
    angles: tuple[Group, ...]

    def kinds(self) -> tuple[tuple[str, tuple[Group, ...]], ...]:
        """The groups by kind, each with the kind's name."""
        return (("product", self.products), ("day", self.days), ("turntable angle", self.angles))

    def compared(self) -> list[tuple[str, Group]]:
        """The groups that others predict, with their kinds."""
        return [(k, g) for k, groups in self.kinds() for g in groups if np.isfinite(g.others_p)]

    @property
    def n_tests(self) -> int:
        """Number of all tests: instrument, prior, and every group."""
        return 2 + len(self.compared())

    def extremes(self) -> list[tuple[str, Group]]:
        """Groups that stand out from what all others predict, the least probable first."""
        found = [(k, g) for k, g in self.compared() if stands_out(g.p, self.n_tests)]
        return sorted(found, key=lambda one: one[1].p)

    def level(self) -> Level:
        """The verdict in a word.

        Instrument, noise and groups are judged whatever the prior; only where they are right does
        the rest of chi^2 tell of the prior.
        """
        if self.extremes() or stands_out(self.split.instrument.p, self.n_tests):
            return "does not fit"
        unlike = stands_out(self.split.prior.p, self.n_tests)
        return "unlike the prior" if unlike else "consistent"

    def suspects(self) -> list[tuple[str, Group]]:
        """Find the groups without which the rest fits.

        Returns
        -------
        list of (str, Group)
            With their kinds, those of a kind that say most against all others first; empty if all
            data fit. Only groups that stand out are looked at, if any does.
        """
        if self.level() != "does not fit":
            return []
        looked_at = self.extremes() or self.compared()
        found = [one for one in looked_at if not stands_out(one[1].others_p, self.n_tests)]
        kinds = [kind for kind, _ in self.kinds()]
        return sorted(found, key=lambda one: (kinds.index(one[0]), one[1].p))

    def fit(self, strengths: str = "") -> Fit:
        """Judge whether the data fit, and say what to do if not.

        Parameters
        ----------
        strengths : str
            How strong the sky is, compared with its prior, where and at which scales.
        """
        level = self.level()
        instrument, prior = (part.words() for part in (self.split.instrument, self.split.prior))
        if level == "consistent":
            told = f"instrument and noise fit ({instrument}), and so does the prior ({prior})."
            return Fit(level, f"Consistent: {told}")
        if level == "unlike the prior":
            sky, advice = "not what the prior allows", TOO_NARROW
            if self.split.prior.too_small:
                sky, advice = (
                    "weaker, or closer to the prior's mean, than the prior expects",
                    TOO_WIDE,
                )
            fits = f"Unlike the prior: instrument and noise fit ({instrument}), but the sky is"
            return Fit(
                level, " ".join(filter(None, [f"{fits} {sky} ({prior}).", strengths, advice]))
            )
        small = self.split.instrument.too_small and not self.extremes()
        why = "the noise is smaller than assumed" if small else "no sky explains these data"
        told = f"Does not fit: {why} ({instrument}); do not trust the error bars."
        return Fit(level, " ".join([told, *self._blame()]))

    def _blame(self) -> list[str]:
        """Which groups stand out, and what to leave out or to look at."""
        if not self.products:
            return [
                "Products, days and turntable angles were not judged: the noise couples different "
                "times, which would need the whole of A."
            ]
        parts, extremes, suspects = [], self.extremes(), self.suspects()
        if suspects and extremes:
            named = [f"{kind} {g.name} (p {probability(g.p)})" for kind, g in extremes[:NAMED]]
            more = len(extremes) - NAMED
            named += [f"{more} more"] if more > 0 else []
            parts.append(f"Of {len(self.compared())} groups these stand out: {', '.join(named)}.")
        for kind, _ in self.kinds():
            mine = [group for of, group in suspects if of == kind]
            named = ", ".join(group.name for group in mine[:NAMED])
            if len(mine) == 1:
                p = probability(mine[0].others_p)
                parts.append(f"The others fit without {kind} {named} (p {p}): leave it out.")
            elif mine:
                more = f" and {len(mine) - NAMED} more" if len(mine) > NAMED else ""
                parts.append(
                    f"The others fit without any one of {len(mine)} {kind}s ({named}{more}): the "
                    "data do not tell which."
                )
        if not suspects:
            parts.append(
                f"{len(extremes)} of {len(self.compared())} products, days and turntable angles "
                "stand out, and no single one is to blame."
            )
        return parts


def residuals(
    model: LinearGaussian, posterior: Posterior, data: Visibilities, chi2: float
) -> Residuals:
    """Compare data with what the model predicts for them, group by group.

    Days of 24 hours are counted from the first sample. Runs of one turntable angle are one group.

    Parameters
    ----------
    model : LinearGaussian
        Of these data.
    posterior : Posterior
        Of the model, given these data.
    data : Visibilities
        In K, with their times and turntable angles.
    chi2 : float
        Of the data under the model, sky included.

    Returns
    -------
    Residuals
        Of every datum and group.

    Raises
    ------
    InputError
        If the model cannot be factorised.
    """
    model = on_host(model)
    layout, observation, n_data = data.layout, data.observation, model.n_data
    predicted = np.asarray(model.predict(posterior.mean))
    split = Split.of(posterior, chi2, n_data)
    wide = replace(model, prior=split.wide.prior)
    left_out = leave_out(wide, split.wide, data)
    if left_out is None:
        return Residuals(predicted, np.full(n_data, np.nan), split, (), (), ())
    day = np.floor(observation.hours / HOURS_A_DAY).astype(int)
    angles, angle_of_run = np.unique(observation.turntable_deg, return_inverse=True)
    angle, whole = angle_of_run[observation.run], split.instrument

    def group(name: str, n: int, missed: Missed) -> Group:
        if n == n_data:
            return Group(name, n, whole.degrees, whole.chi2, whole.p, np.nan)
        # random directions tell the number of those in the sky: it may come out a little beyond
        degrees = n - with_sky(float(np.clip(missed.directions, 0.0, n)))
        others = ChiSquare(whole.chi2 - missed.chi2, whole.degrees - degrees)
        return Group(name, n, degrees, missed.chi2, two_sided(missed.chi2, degrees), others.p)

    def groups(
        names: Sequence[str],
        number: Int[np.ndarray, " data"],
        leave: Callable[[int], Missed],
        *,
        always: bool = False,
    ) -> tuple[Group, ...]:
        """Of those that have data; one that has all of them is left out only if ``always``."""
        counts = np.bincount(number, minlength=len(names))
        some = np.flatnonzero(counts).tolist()
        missed = in_threads(lambda k: leave(k) if always or counts[k] < n_data else NOT_TOLD, some)
        return tuple(group(names[k], int(counts[k]), x) for k, x in zip(some, missed, strict=True))

    products = groups(data.labels, layout.product, left_out.product)
    # every day is left out, even if there is but one: that gives each datum's own variance
    names = [str(k) for k in range(day.max() + 1)]
    days = groups(names, day[layout.time], lambda k: left_out.stretch(day == k), always=True)
    names = [f"{value:g}" for value in angles]
    of_angles = groups(names, angle[layout.time], lambda k: left_out.together(angle == k))
    u = left_out.u[layout.product, layout.time]
    z = u / np.sqrt(left_out.inverse_diagonal[layout.product, layout.time])
    return Residuals(predicted, z, split, products, days, of_angles)


def leave_out(model: LinearGaussian, posterior: Posterior, data: Visibilities) -> LeftOut | None:
    """Choose how groups are left out: through the structure of A, or dense.

    Parameters
    ----------
    model : LinearGaussian
        Of these data.
    posterior : Posterior
        Of the model, given these data.
    data : Visibilities
        In K.

    Returns
    -------
    LeftOut or None
        None if A would be needed and be larger than ``DENSE_BYTES``.
    """
    within_times = base_and_templates(model.noise)[0].time_weights(data.layout) is not None
    of_modes = posterior.basis is None and model.prior.invertible
    if model.coupling.has_time_structure and within_times and of_modes:
        return StructuredLeftOut(model, posterior, data.data)
    if 8 * model.n_data * model.prior.size > DENSE_BYTES:
        return None
    return DenseLeftOut(model, data.data, data.layout)


@dataclass(frozen=True)
class HeldOut:
    """Groups of data, each against what all others predict of it, added up.

    Attributes
    ----------
    kind : {"product", "day"}
    groups, n : int
        Number of groups, and of their data.
    chi2 : float
        About ``n`` if the model holds.
    log_density : float
        ln p of each group given all others, data in K.
    """

    kind: str
    groups: int
    n: int
    chi2: float
    log_density: float


def held_out(
    model: LinearGaussian, posterior: Posterior, data: Visibilities
) -> tuple[HeldOut, ...]:
    """Predict products, and days of 24 hours from the first sample, from all others.

    Parameters
    ----------
    model : LinearGaussian
        Of these data.
    posterior : Posterior
        Of the model, given these data.
    data : Visibilities
        In K.

    Returns
    -------
    tuple of HeldOut
        One for each kind that has several groups; none where noise couples times and A would be
        too large to be formed (:func:`.leave_out`).

    Raises
    ------
    InputError
        If the model cannot be factorised.
    """
    model, layout = on_host(model), data.layout
    left_out = leave_out(model, posterior, data)
    if left_out is None:
        return ()
    day = np.floor(data.observation.hours / HOURS_A_DAY).astype(int)
    found = (
        _added("product", layout.product, left_out.product),
        _added("day", day[layout.time], lambda k: left_out.stretch(day == k)),
    )
    return tuple(one for one in found if one.groups > 1)


def _added(kind: str, group: Int[np.ndarray, " data"], leave: Callable[[int], Missed]) -> HeldOut:
    counts = np.bincount(group)
    some = np.flatnonzero(counts).tolist()
    if len(some) < 2:
        return HeldOut(kind, len(some), len(group), np.nan, np.nan)
    missed = in_threads(leave, some)
    densities = [one.log_density(int(counts[k])) for k, one in zip(some, missed, strict=True)]
    chi2 = sum(one.chi2 for one in missed)
    return HeldOut(kind, len(some), len(group), float(chi2), float(sum(densities)))
