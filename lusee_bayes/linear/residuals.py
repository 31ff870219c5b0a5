"""Compare data with what all other data predict, to find products, days or angles that do not fit.

With K = A S A^T + N, the covariance of data under the model, and u = K^-1 (d - offset), a group s
of data differs from its prediction by all others by K_ss^-1 u_s, K_ss being a block of K^-1, and ::

    chi^2_s = u_s^T K_ss^-1 u_s,    chi^2_all - chi^2_s = chi^2 of the others without s.

Both follow chi^2 distributions exactly if the model holds. A bad group spoils the predictions for
all others too; the culprit is the group whose removal makes the rest fit.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from lusee_bayes.core.arrays import Array, on_host
from lusee_bayes.core.threads import in_threads
from lusee_bayes.instrument.visibilities import Visibilities
from lusee_bayes.linear.fit import (
    LEVELS,
    MISFIT,
    TENSION,
    Fit,
    Level,
    level_of,
    probability,
    sentence,
    size_of_residuals,
    two_sided,
    worst,
)
from lusee_bayes.linear.left_out import LeftOut
from lusee_bayes.linear.left_out_dense import DenseLeftOut
from lusee_bayes.linear.left_out_structured import StructuredLeftOut
from lusee_bayes.linear.model import LinearGaussian
from lusee_bayes.linear.posterior import Posterior
from lusee_bayes.noise.covariance import LowRankUpdate

# a larger A is not formed, and its groups of data are not judged: 60,000 data at lmax 47
DENSE_BYTES = 1.2e9
# groups that stand out and are named in a sentence
NAMED = 4
HOURS_A_DAY = 24.0


@dataclass(frozen=True)
class Group:
    """Data that are left out together.

    Attributes
    ----------
    name : str
        Of the product, day or turntable angle.
    n : int
        Number of data.
    chi2 : float
        Of these data given all others.
    p : float
        Probability of a ``chi2`` as far out on its side if the model holds.
    others_p : float
        The same of the others without these; NaN if there are no others.
    """

    name: str
    n: int
    chi2: float
    p: float
    others_p: float


@dataclass(frozen=True)
class Residuals:
    """Every datum and every group of data against the prediction of all others.

    Attributes
    ----------
    predicted : (data,) array
        A mean + offset, in K.
    z : (data,) array
        Each datum less its prediction by all others, in standard deviations: N(0, 1), though not
        independent. NaN where groups are not judged.
    chi2 : float
        Of all data under the model.
    products, days, angles : tuple of Group
        The data of every product, day and turntable angle; none where they are not judged, since
        noise that couples times would need an A of more than ``DENSE_BYTES``.
    """

    predicted: Float[np.ndarray, " data"]
    z: Float[np.ndarray, " data"]
    chi2: float
    products: tuple[Group, ...]
    days: tuple[Group, ...]
    angles: tuple[Group, ...]

    @property
    def p(self) -> float:
        """Probability of a chi^2 of all data as far out on its side."""
        return two_sided(self.chi2, len(self.z))

    def kinds(self) -> tuple[tuple[str, tuple[Group, ...]], ...]:
        """The groups by kind, each with the kind's name."""
        return (
            ("product", self.products),
            ("day", self.days),
            ("turntable angle", self.angles),
        )

    def compared(self) -> list[tuple[str, Group]]:
        """The groups that others predict, with their kinds."""
        return [(k, g) for k, groups in self.kinds() for g in groups if np.isfinite(g.others_p)]

    def extremes(self) -> list[tuple[str, Group]]:
        """Groups that stand out from what all others predict, the least probable first.

        Returns
        -------
        list of (str, Group)
            With the kind. Their p-values times the number of all groups are below ``TENSION``.
        """
        groups = self.compared()
        found = [
            (kind, group) for kind, group in groups if level_of(group.p, len(groups)) != LEVELS[0]
        ]
        return sorted(found, key=lambda one: one[1].p)

    def level(self) -> Level:
        """The verdict in a word.

        A product or a turntable angle is predicted from others that saw the same sky, so that it
        counts as all data do. A day is predicted from other days that saw other directions: there
        the prediction is the prior's, and a bright part of the sky is enough to make it stand out.
        It makes a fit tense, not bad.
        """
        found = [level_of(self.p)]
        for kind, group in self.extremes():
            bad = level_of(group.p, len(self.compared()))
            found.append("in tension" if kind == "day" else bad)
        return worst(found)

    def suspects(self) -> list[tuple[str, Group]]:
        """Find the groups whose removal makes the rest fit.

        Returns
        -------
        list of (str, Group)
            For each kind at most one group, with the kind; empty if all data fit.
        """
        level = self.level()
        if level == "consistent":
            return []
        enough = TENSION if level == "in tension" else MISFIT
        standing_out = self.extremes()
        found = []
        for kind, groups in self.kinds():
            known = [group for group in groups if np.isfinite(group.others_p)]
            if level == "in tension":
                known = [group for group in known if (kind, group) in standing_out]
            if not known:
                continue
            best = max(known, key=lambda group: group.others_p)
            if best.others_p > enough:
                found.append((kind, best))
        return found

    def fit(self) -> Fit:
        """Judge whether the data fit, and which groups stand out or are to blame if not."""
        level = self.level()
        words = sentence(level)
        if level == "in tension" and level_of(self.p) == "consistent":
            words = "In tension: the data fit the model as a whole, but not everywhere"
        parts = [f"{words} ({size_of_residuals(self.chi2, len(self.z), self.p)})."]
        if level != "consistent" and not self.products:
            parts.append(
                "Products, days and turntable angles were not judged: the noise couples different "
                "times, which would need the whole of A."
            )
        extremes = self.extremes()
        if extremes:
            named = [f"{kind} {g.name} (p {probability(g.p)})" for kind, g in extremes[:NAMED]]
            more = len(extremes) - NAMED
            named += [f"{more} more"] if more > 0 else []
            parts.append(f"Of {len(self.compared())} groups these stand out: {', '.join(named)}.")
        suspects = self.suspects()
        if suspects:
            without = [f"{kind} {g.name} (p {probability(g.others_p)})" for kind, g in suspects]
            parts.append(f"The others fit without {', or without '.join(without)}.")
        elif level == "does not fit" and self.products:
            parts.append("No single product, day or turntable angle is to blame for it.")
        return Fit(level, self.p, " ".join(parts))


def residuals(model: LinearGaussian, posterior: Posterior, data: Visibilities) -> Residuals:
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
    layout, observation = data.layout, data.observation
    left_out = leave_out(model, posterior, data)
    if left_out is None:
        predicted = model.predict(posterior.mean)
        u = np.asarray(model.noise.solve(data.data - predicted))
        total = float(np.asarray(_less_expected(model, data)) @ u)
        return Residuals(np.asarray(predicted), np.full(len(u), np.nan), total, (), (), ())
    u = left_out.u[layout.product, layout.time]
    day = np.floor(observation.hours / HOURS_A_DAY).astype(int)
    angles, angle_of_run = np.unique(observation.turntable_deg, return_inverse=True)
    angle = angle_of_run[observation.run]
    total = float(np.asarray(_less_expected(model, data)) @ u)

    def group(name: str, n: int, squared: float) -> Group:
        if n == len(u):
            return Group(name, n, total, two_sided(total, n), np.nan)
        others = two_sided(total - squared, len(u) - n)
        return Group(name, n, squared, two_sided(squared, n), others)

    def groups(
        names: Sequence[str], counts: np.ndarray, leave: Callable[[int], float]
    ) -> tuple[Group, ...]:
        """Of those that have data: number k has counts[k] of them, and leave(k) is its chi^2."""
        some = np.flatnonzero(counts).tolist()
        squared = in_threads(leave, some)
        return tuple(group(names[k], int(counts[k]), x) for k, x in zip(some, squared, strict=True))

    def unless_all(counts: np.ndarray, leave: Callable[[int], float]) -> Callable[[int], float]:
        return lambda k: total if counts[k] == len(u) else leave(k)

    of_product, of_day, of_angle = (
        np.bincount(numbers, minlength=n)
        for numbers, n in (
            (layout.product, len(data.labels)),
            (day[layout.time], day.max() + 1),
            (angle[layout.time], len(angles)),
        )
    )
    products = groups(data.labels, of_product, unless_all(of_product, left_out.product))
    # every day is left out, even if there is but one: that gives each datum's own variance
    names = [str(k) for k in range(len(of_day))]
    days = groups(names, of_day, lambda k: left_out.stretch(day == k))
    together = unless_all(of_angle, lambda k: left_out.together(angle == k))
    of_angles = groups([f"{value:g}" for value in angles], of_angle, together)
    # K (K^-1 d) = d, so that d - N u is what the sky explains
    predicted = np.asarray(data.data) - np.asarray(model.noise.mv(u))
    z = u / np.sqrt(left_out.inverse_diagonal[layout.product, layout.time])
    return Residuals(predicted, z, total, products, days, of_angles)


def _less_expected(model: LinearGaussian, data: Visibilities) -> Float[Array, " data"]:
    """Less what the prior's mean sky predicts."""
    if model.prior.white_mean is not None:
        return data.data - model.predict(model.prior.colour(model.prior.white_mean))
    return data.data if model.offset is None else data.data - model.offset


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
    noise = model.noise.base if isinstance(model.noise, LowRankUpdate) else model.noise
    within_times = noise.time_weights(data.layout) is not None
    diagonal = posterior.basis is None and model.prior.diagonal_root() is not None
    if model.coupling.has_time_structure and within_times and diagonal:
        return StructuredLeftOut(model, posterior, data.data)
    if 8 * model.n_data * model.prior.size > DENSE_BYTES:
        return None
    return DenseLeftOut(model, data.data, data.layout)
