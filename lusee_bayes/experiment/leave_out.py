"""Data that do not fit what all others predict for them, found one after the other.

Every time is left out under a prior that is wide enough for any sky (:mod:`.linear.residuals`), so
that neither the prior nor what only that time sees is held against it. The worst are flagged, or a
single product of theirs without which the time fits; what is left is fitted again, and so on, until
none has a chi^2 that noise gives with less than the rate of false alarms.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from lusee_bayes.core.arrays import on_host
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.lazy import special
from lusee_bayes.core.threads import in_threads
from lusee_bayes.experiment.rounds import model_about, settled
from lusee_bayes.experiment.setup import Setup
from lusee_bayes.experiment.terms import Around
from lusee_bayes.instrument.layout import DataLayout
from lusee_bayes.instrument.visibilities import Visibilities
from lusee_bayes.linear.model import LinearGaussian
from lusee_bayes.linear.posterior import Posterior
from lusee_bayes.linear.residuals import leave_out
from lusee_bayes.linear.split import WIDER, Split, widened

# of the times beyond the limit, those within this share of the worst go in one round
WORST = 0.3
MAX_ROUNDS = 40
NOT_JUDGED = "Times were not compared with each other: that would need too much memory."
TOO_MANY = (
    "More than a fifth of the times do not fit what the others predict, so that none is left out: "
    "noise, gains or beams are not those of the data."
)
# where more do not fit, it is not the data but noise, gains or beams that are wrong
MOST = 0.2


@dataclass(frozen=True)
class Fitting:
    """Which data do not fit.

    Attributes
    ----------
    flagged : (products, times) array of bool
    rounds : int
    chi2 : (times,) array
        Of each time against its prediction by the others, before anything was flagged, over its
        mean; 0 where the others do not tell.
    remark : str
        What is to be said; empty if there is nothing.
    """

    flagged: Bool[np.ndarray, "products times"]
    rounds: int
    chi2: Float[np.ndarray, " times"]
    remark: str = ""

    @property
    def times(self) -> Bool[np.ndarray, " times"]:
        """Times of which every product is flagged."""
        return self.flagged.all(axis=0)


def fitting(setup: Setup, data: Visibilities, false_alarm: float) -> Fitting:
    """Find data that do not fit.

    Parameters
    ----------
    setup : Setup
    data : Visibilities
        Measured.
    false_alarm : float
        Chance that a time of noise alone is flagged, or one of its products.

    Returns
    -------
    Fitting
        With nothing flagged, and a remark, if so many times do not fit that it is not them.
    """
    shape = (data.layout.n_products, data.layout.n_times)
    gone, nothing, before = np.zeros(shape, dtype=bool), np.zeros(shape, dtype=bool), None
    here = setup, data
    for rounds in range(1, MAX_ROUNDS + 1):
        found = _compared(*here)
        if found is None:
            return Fitting(nothing, rounds, np.zeros(shape[1]), NOT_JUDGED)
        before = found.ratio if before is None else before
        out = found.worst(false_alarm)
        if not out.any():
            return Fitting(gone, rounds, before, _remark(gone, false_alarm))
        gone |= out
        if gone.any(axis=0).sum() > max(MOST * shape[1], 1.0):
            break
        here = without(setup, data, gone)
    return Fitting(nothing, rounds, before, TOO_MANY)


def _remark(gone: Bool[np.ndarray, "products times"], false_alarm: float) -> str:
    whole, n = gone.all(axis=0), gone.shape[1]
    single = int(gone[:, ~whole].sum())
    parts = []
    if whole.any():
        parts.append(f"{int(whole.sum())} of {n} times")
    if single:
        parts.append(f"{single} single value" + ("s" if single > 1 else ""))
    if not parts:
        return ""
    return (
        f"{' and '.join(parts)} do not fit what the others predict, and are left out (noise alone "
        f"would do so to {2.0 * n * false_alarm:.2g})."
    )


@dataclass(frozen=True)
class _Compared:
    """Times and data against their prediction by all others.

    chi2, degrees : (times,) arrays, of each time, with its mean; degrees 0 where there is nothing
    to compare with; z : (products, times) array, of each datum in standard deviations, or 0
    """

    chi2: Float[np.ndarray, " times"]
    degrees: Float[np.ndarray, " times"]
    z: Float[np.ndarray, "products times"]

    @property
    def ratio(self) -> Float[np.ndarray, " times"]:
        return np.where(self.degrees > 0.0, self.chi2 / np.maximum(self.degrees, 0.5), 0.0)

    def worst(self, false_alarm: float) -> Bool[np.ndarray, "products times"]:
        """The worst of what stands out: whole times, or a value without which its time fits.

        chi^2 of a time less z^2 of one of its data is that of its other data.
        """
        squares = self.z**2
        most, product = squares.max(axis=0), squares.argmax(axis=0)
        judged = self.degrees > 0.0
        tail = _tail(self.chi2, self.degrees)
        single = np.where(judged, special.chdtrc(1.0, most), 1.0) * len(squares)
        out = (tail < false_alarm) | (single < false_alarm)
        size = np.maximum(self.ratio, most / len(squares))
        out &= size >= WORST * size.max()
        rest = _tail(self.chi2 - most, self.degrees - 1.0)
        alone = out & (self.degrees > 1.5) & (rest >= false_alarm)
        found = np.broadcast_to(out & ~alone, squares.shape).copy()
        found[product[alone], np.flatnonzero(alone)] = True
        return found


def _tail(
    chi2: Float[np.ndarray, " times"], degrees: Float[np.ndarray, " times"]
) -> Float[np.ndarray, " times"]:
    """Probability of this chi^2 or more; 1 where there are no degrees of freedom."""
    some = degrees > 0.0
    found = special.chdtrc(np.where(some, degrees, 1.0), np.maximum(chi2, 0.0))
    return np.where(some, found, 1.0)


def _compared(setup: Setup, data: Visibilities) -> _Compared | None:
    """Leave out every time; None if that is not possible."""
    model, posterior = on_host(_conditioned(setup, data))
    wide = _wide(posterior, model.n_data)
    left_out = leave_out(replace(model, prior=wide.prior), wide, data)
    if left_out is None:
        return None
    n = data.layout.n_times
    counts = np.bincount(data.layout.time, minlength=n)
    some = np.flatnonzero(counts)
    times = np.arange(n)
    missed = in_threads(lambda k: left_out.stretch(times == k), some.tolist())
    chi2, degrees = np.zeros(n), np.zeros(n)
    chi2[some] = [m.chi2 for m in missed]
    new = np.array([m.directions for m in missed])
    degrees[some] = counts[some] - np.clip(new, 0.0, counts[some])
    # where the others tell less than half a datum, there is nothing to compare with
    told = np.isfinite(chi2) & (degrees >= 0.5)
    chi2, degrees = np.where(told, chi2, 0.0), np.where(told, degrees, 0.0)
    with np.errstate(invalid="ignore", divide="ignore"):
        z = left_out.u / np.sqrt(left_out.inverse_diagonal)
    known = np.asarray(data.layout.present) & np.isfinite(z) & (degrees > 0.0)
    return _Compared(chi2, degrees, np.where(known, z, 0.0))


def _conditioned(setup: Setup, data: Visibilities) -> tuple[LinearGaussian, Posterior]:
    """Model and posterior, in as many rounds as N needs; in one where bad data let none settle."""
    try:
        found = settled(setup, data)
    except InputError:
        model, _ = model_about(setup, Around(data))
        return model, model.condition(data.data)
    return found.model, found.posterior


def _wide(posterior: Posterior, n_data: int) -> Posterior:
    """Under a prior that allows the sky, and what the worst data make of it where that is possible.

    Bad data ask for a sky that is stronger by orders of magnitude. Under a prior for that, numbers
    of 64 bits do not tell noise from sky; they stand out under a narrower one, too.
    """
    try:
        return Split.of(posterior, 0.0, n_data).wide
    except InputError:
        return widened(posterior, WIDER)[0]


def without(
    setup: Setup, data: Visibilities, gone: Bool[np.ndarray, "products times"]
) -> tuple[Setup, Visibilities]:
    """Setup and data without some of the data.

    Raises
    ------
    InputError
        If nothing is left.
    """
    layout = DataLayout.from_flags(~np.asarray(data.layout.present) | gone)
    kept = replace(data, data=layout.gather(data.layout.scatter(data.data)), layout=layout)
    instrument = replace(setup.instrument, layout=layout)
    coupling = replace(setup.coupling, layout=layout)
    return replace(setup, instrument=instrument, coupling=coupling), kept
