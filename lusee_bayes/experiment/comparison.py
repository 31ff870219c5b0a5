"""Times, values, products and days of data against what the model predicts from all others."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from lusee_bayes.core.arrays import on_host
from lusee_bayes.core.engine import in_threads
from lusee_bayes.core.lazy import special
from lusee_bayes.core.progress import memory_limit
from lusee_bayes.experiment.rounds import model_about, settled
from lusee_bayes.experiment.setup import Setup
from lusee_bayes.experiment.terms import Around
from lusee_bayes.instrument.visibilities import Visibilities
from lusee_bayes.linear.left_out import Missed
from lusee_bayes.linear.left_out_dense import DenseLeftOut
from lusee_bayes.linear.model import LinearGaussian
from lusee_bayes.linear.posterior import Posterior
from lusee_bayes.linear.residuals import HOURS_A_DAY
from lusee_bayes.linear.split import WIDER, Split

# of the times beyond the limit, those within this share of the worst go in one round
WORST = 0.3
# arrays of the size of A that are in memory at once, and the share of it that they may take
ARRAYS, MOST_MEMORY = 5, 0.5


class Group(NamedTuple):
    """A product or a day.

    Attributes
    ----------
    kind : {"product", "day"}
    name : str
    data : (products, times) array of bool
        Which data it has.
    of : int
        Number of groups of its kind.
    """

    kind: str
    name: str
    data: Bool[np.ndarray, "products times"]
    of: int


@dataclass(frozen=True)
class Comparison:
    """Times and data against their prediction by all others.

    Attributes
    ----------
    data : Visibilities
        With the times and the labels; which of them are compared, ``left_out`` knows.
    left_out : DenseLeftOut
    chi2, degrees : (times,) arrays
        Of each time, and its mean; 0 where there is nothing to compare with.
    z : (products, times) array
        Of each datum, in standard deviations; 0 where there is nothing to compare with.
    """

    data: Visibilities
    left_out: DenseLeftOut
    chi2: Float[np.ndarray, " times"]
    degrees: Float[np.ndarray, " times"]
    z: Float[np.ndarray, "products times"]

    @classmethod
    def of(cls, left_out: DenseLeftOut, data: Visibilities) -> Comparison:
        """Leave out every time, one after the other."""
        layout, n = left_out.layout, data.layout.n_times
        counts = np.bincount(layout.time, minlength=n)
        some, times = np.flatnonzero(counts), np.arange(n)
        missed = in_threads(lambda k: left_out.stretch(times == k), some.tolist())
        chi2, degrees = np.zeros(n), np.zeros(n)
        chi2[some], degrees[some] = _judged(missed, counts[some])
        with np.errstate(invalid="ignore"):
            z = left_out.u / np.sqrt(left_out.inverse_diagonal)
        known = np.asarray(layout.present) & np.isfinite(z) & (degrees > 0.0)
        return cls(data, left_out, chi2, degrees, np.where(known, z, 0.0))

    def without(self, gone: Bool[np.ndarray, "products times"]) -> Comparison:
        """Compare the others, with the same model."""
        return Comparison.of(self.left_out.without(gone), self.data)

    @property
    def ratio(self) -> Float[np.ndarray, " times"]:
        """chi^2 of the times over their means, or 0."""
        return np.where(self.degrees > 0.0, self.chi2 / np.maximum(self.degrees, 0.5), 0.0)

    @property
    def size(self) -> Float[np.ndarray, " times"]:
        """By how much times, or one of their data, stand out: chi^2 over its mean."""
        return np.maximum(self.ratio, (self.z**2).max(axis=0) / len(self.z))

    def worst(self, false_alarm: float, least: float = 0.0) -> Bool[np.ndarray, "products times"]:
        """The worst of what stands out: whole times, or a value without which its time fits.

        chi^2 of a time less z^2 of one of its data is that of its other data.

        Parameters
        ----------
        false_alarm : float
            Chance that a time of noise alone is flagged, or one of its products.
        least : float
            ``size`` of what is looked at.

        Returns
        -------
        (products, times) array of bool
        """
        squares = self.z**2
        most, product = squares.max(axis=0), squares.argmax(axis=0)
        judged = self.degrees > 0.0
        tail = _tail(self.chi2, self.degrees)
        single = np.where(judged, special.chdtrc(1.0, most), 1.0) * len(squares)
        out = (tail < false_alarm) | (single < false_alarm)
        out &= self.size >= max(WORST * self.size.max(), least)
        rest = _tail(self.chi2 - most, self.degrees - 1.0)
        alone = out & (self.degrees > 1.5) & (rest >= false_alarm)
        found = np.broadcast_to(out & ~alone, squares.shape).copy()
        found[product[alone], np.flatnonzero(alone)] = True
        return found

    def worst_group(self, false_alarm: float) -> Group | None:
        """Find the product or day that stands out and without which chi^2 falls most.

        Parameters
        ----------
        false_alarm : float
            Chance that one of noise alone stands out.

        Returns
        -------
        Group or None
            None if none stands out.
        """
        left_out = self.left_out
        layout = left_out.layout
        shape = (layout.n_products, layout.n_times)
        day = np.floor(self.data.observation.hours / HOURS_A_DAY).astype(int)
        groups, leave = [], []
        for number in np.unique(layout.product).tolist():
            mine = np.arange(shape[0])[:, None] == number
            groups.append(("product", self.data.labels[number], np.broadcast_to(mine, shape)))
            leave.append(lambda number=number: left_out.product(number))
        for number in np.unique(day[layout.time]).tolist():
            mine = day == number
            groups.append(("day", str(number), np.broadcast_to(mine, shape)))
            leave.append(lambda mine=mine: left_out.stretch(mine))
        counts = np.array([int((mine & np.asarray(layout.present)).sum()) for _, _, mine in groups])
        # one that holds all data has nothing to be compared with
        some = np.flatnonzero(counts < layout.size)
        missed: list[Missed] = in_threads(lambda k: leave[k](), some.tolist())
        chi2, degrees = _judged(missed, counts[some])
        out = _tail(chi2, degrees) < false_alarm
        if not out.any():
            return None
        kind, name, mine = groups[some[np.where(out, chi2 - degrees, -np.inf).argmax()]]
        return Group(kind, name, mine, sum(of == kind for of, _, _ in groups))


def _judged(
    missed: list[Missed], counts: Int[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """chi^2 of groups and its means; 0 where the others tell less than half a datum."""
    chi2, new = np.array([(m.chi2, m.directions) for m in missed]).reshape(-1, 2).T
    degrees = counts - np.clip(new, 0.0, counts)
    told = np.isfinite(chi2) & (degrees >= 0.5)
    return np.where(told, chi2, 0.0), np.where(told, degrees, 0.0)


def _tail(
    chi2: Float[np.ndarray, " n"], degrees: Float[np.ndarray, " n"]
) -> Float[np.ndarray, " n"]:
    """Probability of this chi^2 or more; 1 where there are no degrees of freedom."""
    some = degrees > 0.0
    found = special.chdtrc(np.where(some, degrees, 1.0), np.maximum(chi2, 0.0))
    return np.where(some, found, 1.0)


def compared(setup: Setup, data: Visibilities, *, settle: bool = True) -> Comparison | None:
    """Leave out every time.

    Under a prior that is wide enough for any sky (:mod:`lusee_bayes.linear.residuals`), so that
    neither the prior nor what only that time sees is held against it.

    Parameters
    ----------
    setup : Setup
    data : Visibilities
        Measured.
    settle : bool
        In as many rounds as N needs to be built around what the data say; else in one, and under
        a prior whose width asks nothing of them: for what stands out in any case.

    Returns
    -------
    Comparison or None
        None where it would need too much memory.
    """
    if _memory(setup, data) > MOST_MEMORY * memory_limit():
        return None
    if settle:
        model, posterior = on_host(_conditioned(setup, data))
        prior = Split.of(posterior, 0.0, model.n_data).wide.prior
    else:
        model = on_host(model_about(setup, Around(data))[0])
        prior = model.prior.widened(WIDER)
    left_out = DenseLeftOut(replace(model, prior=prior), data.data, data.layout)
    return Comparison.of(left_out, data)


def _memory(setup: Setup, data: Visibilities) -> float:
    """Bytes; where N couples times, it is a matrix of all data, too."""
    n, gain = data.layout.size, setup.scenario.noise.gain
    across = gain is not None and gain.treatment != "ignored"
    return 8.0 * ARRAYS * n * (setup.prior.size + (n if across else 0))


def _conditioned(setup: Setup, data: Visibilities) -> tuple[LinearGaussian, Posterior]:
    """Model and posterior, in as many rounds as N needs; in one where bad data let none settle."""
    found = settled(setup, data)
    if found.unsettled:
        model, _ = model_about(setup, Around(data))
        return model, model.condition(data.data)
    return found.model, found.posterior
