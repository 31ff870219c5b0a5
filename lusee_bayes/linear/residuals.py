"""Compare data with what all other data predict, to find products, days or angles that do not fit.

With K = A S A^T + N, the covariance of data under the model, and u = K^-1 (d - offset), a group s
of data differs from its prediction by all others by K_ss^-1 u_s, K_ss being a block of K^-1, and ::

    chi^2_s = u_s^T K_ss^-1 u_s,    chi^2_all - chi^2_s = chi^2 of the others without s.

Both follow chi^2 distributions exactly if the model holds. A bad group spoils the predictions for
all others too; it is recognised by the others fitting once it is left out.
"""

from __future__ import annotations

from dataclasses import dataclass

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.linalg import cho_factor, cho_solve
from scipy.stats import chi2

from lusee_bayes.core.arrays import Array
from lusee_bayes.instrument.visibilities import Visibilities
from lusee_bayes.linear.model import LinearGaussian
from lusee_bayes.noise.covariance import Factor

# a fit less probable than this is called bad; real skies are not drawn from the prior, and that
# alone gives probabilities of 1e-3
SIGNIFICANCE = 1e-6
HOURS_A_DAY = 24.0
# the largest group whose block of K^-1 is formed, and how many columns of N^-1 at a time
LARGEST_GROUP, COLUMNS = 8000, 512


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
        Probability of a larger ``chi2`` if the model holds.
    others_p : float
        Probability of a larger chi^2 of the others without these; NaN if there are no others.
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
        independent.
    chi2 : float
        Of all data under the model.
    products, days, angles : tuple of Group
        The data of every product, day and turntable angle.
    """

    predicted: Float[np.ndarray, " data"]
    z: Float[np.ndarray, " data"]
    chi2: float
    products: tuple[Group, ...]
    days: tuple[Group, ...]
    angles: tuple[Group, ...]

    @property
    def p(self) -> float:
        """Probability of a larger chi^2 of all data."""
        return float(chi2.sf(self.chi2, len(self.z)))

    def suspects(self) -> list[tuple[str, Group]]:
        """Find the groups without which all other data fit.

        Returns
        -------
        list of (str, Group)
            For each kind at most one group, with the kind; empty if all data fit.
        """
        if self.p > SIGNIFICANCE:
            return []
        found = []
        for kind, groups in (
            ("product", self.products),
            ("day", self.days),
            ("turntable angle", self.angles),
        ):
            known = [group for group in groups if np.isfinite(group.others_p)]
            if not known:
                continue
            best = max(known, key=lambda group: group.others_p)
            if best.others_p > SIGNIFICANCE:
                found.append((kind, best))
        return found

    def verdict(self) -> str:
        """Describe in a sentence whether the data fit, and which group is to blame if not.

        Returns
        -------
        str
            For people to read.
        """
        if self.p > SIGNIFICANCE:
            return f"The data fit the model (p {probability(self.p)})."
        text = f"The data do not fit the model (p {probability(self.p)})."
        suspects = self.suspects()
        if not suspects:
            return text + " No single product, day or turntable angle is to blame for it."
        parts = [f"{kind} {g.name} (p {probability(g.others_p)})" for kind, g in suspects]
        return f"{text} They do without {', or without '.join(parts)}."


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


def residuals(model: LinearGaussian, data: Visibilities) -> Residuals:
    """Compare data with what the model predicts for them, group by group.

    Days of 24 hours are counted from the first sample. Runs of one turntable angle are one group.
    Groups of more than ``LARGEST_GROUP`` data, but not all, are left out.

    Parameters
    ----------
    model : LinearGaussian
        Of these data.
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
    solver = model.factorise()
    factor, half = solver.factor, solver.half()
    centred = data.data if model.offset is None else data.data - model.offset
    white = factor.whiten(centred)
    u = np.asarray(factor.whiten_transpose(white - half.T @ (half @ white)))
    root = np.asarray(factor.whiten_transpose(half.T))
    total = float(np.asarray(centred) @ u)
    kinds = [
        [(name, index) for name, index in kind if _can_be_tested(len(index), len(u))]
        for kind in _groups(data)
    ]
    diagonal, blocks = _inverse(
        factor, len(u), [index for kind in kinds for _, index in kind if len(index) < len(u)]
    )
    left = iter(blocks)

    def group(name: str, index: np.ndarray) -> Group:
        squared, others = total, np.nan
        if len(index) < len(u):
            matrix = next(left) - root[index] @ root[index].T
            squared = float(u[index] @ cho_solve(cho_factor(matrix, lower=True), u[index]))
            others = float(chi2.sf(total - squared, len(u) - len(index)))
        return Group(name, len(index), squared, float(chi2.sf(squared, len(index))), others)

    products, days, angles = (tuple(group(*g) for g in kind) for kind in kinds)
    # K (K^-1 d) = d, so that d - N u is what the sky explains
    predicted = np.asarray(data.data) - np.asarray(model.noise.mv(jnp.asarray(u)))
    z = u / np.sqrt(diagonal - (root**2).sum(1))
    return Residuals(predicted, z, total, products, days, angles)


def _groups(data: Visibilities) -> list[list[tuple[str, np.ndarray]]]:
    """Names and data of every product, every day and every turntable angle."""
    layout, observation = data.layout, data.observation
    day = np.floor(observation.hours / HOURS_A_DAY).astype(int)
    angles, angle_of_run = np.unique(observation.turntable_deg, return_inverse=True)
    kinds = [
        (data.labels, layout.product),
        ([str(k) for k in range(day.max() + 1)], day[layout.time]),
        ([f"{angle:g}" for angle in angles], angle_of_run[observation.run[layout.time]]),
    ]
    return [
        [(name, np.flatnonzero(of == number)) for number, name in enumerate(names)]
        for names, of in kinds
    ]


def _can_be_tested(n: int, n_all: int) -> bool:
    return 0 < n <= LARGEST_GROUP or n == n_all


def _inverse(
    factor: Factor, size: int, groups: list[np.ndarray]
) -> tuple[Float[np.ndarray, " data"], list[np.ndarray]]:
    """The diagonal of N^-1 and its blocks for groups of data, a few columns at a time."""
    diagonal, blocks = np.empty(size), [np.empty((len(index), len(index))) for index in groups]
    place = np.full((len(groups), size), -1)
    for row, index in zip(place, groups, strict=True):
        row[index] = np.arange(len(index))
    for first in range(0, size, COLUMNS):
        columns = np.arange(first, min(first + COLUMNS, size))
        unit = np.zeros((size, COLUMNS))
        unit[columns, columns - first] = 1.0
        solved = np.asarray(_solve(factor, jnp.asarray(unit)))
        diagonal[columns] = solved[columns, columns - first]
        for row, index, block in zip(place, groups, blocks, strict=True):
            here = columns[row[columns] >= 0]
            block[:, row[here]] = solved[np.ix_(index, here - first)]
    return diagonal, blocks


@eqx.filter_jit
def _solve(factor: Factor, x: Float[Array, "data columns"]) -> Float[Array, "data columns"]:
    return factor.solve(x)
