"""Times whose data do not fit what all others predict for them, found one after the other.

Every time is left out under a prior that is wide enough for any sky (:mod:`.linear.residuals`), so
that neither the prior nor what only that time sees is held against it. The worst are flagged, what
is left is fitted again, and so on, until none has a chi^2 that noise gives with less than the rate
of false alarms.
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
    """Which times do not fit.

    Attributes
    ----------
    flagged : (times,) array of bool
    rounds : int
    chi2 : (times,) array
        Of each time against its prediction by the others, before anything was flagged, over its
        mean; 0 where the others do not tell.
    remark : str
        What is to be said; empty if there is nothing.
    """

    flagged: Bool[np.ndarray, " times"]
    rounds: int
    chi2: Float[np.ndarray, " times"]
    remark: str = ""


def fitting(setup: Setup, data: Visibilities, false_alarm: float) -> Fitting:
    """Find times that do not fit.

    Parameters
    ----------
    setup : Setup
    data : Visibilities
        Measured.
    false_alarm : float
        Chance that a time of noise alone is flagged.

    Returns
    -------
    Fitting
        With nothing flagged, and a remark, if so many times do not fit that it is not them.
    """
    n = data.layout.n_times
    gone, nothing, before = np.zeros(n, dtype=bool), np.zeros(n, dtype=bool), np.zeros(n)
    here = setup, data
    for rounds in range(1, MAX_ROUNDS + 1):
        tail, ratio = _tails(*here)
        if tail is None:
            return Fitting(nothing, rounds, before, NOT_JUDGED)
        if rounds == 1:
            before = ratio
        out = (tail < false_alarm) & (ratio >= 1.0 + WORST * (ratio.max() - 1.0))
        if not out.any():
            return Fitting(gone, rounds, before, _remark(gone, false_alarm))
        gone |= out
        if gone.sum() > max(MOST * n, 1.0):
            break
        here = without(setup, data, gone)
    return Fitting(nothing, rounds, before, TOO_MANY)


def _remark(gone: Bool[np.ndarray, " times"], false_alarm: float) -> str:
    if not gone.any():
        return ""
    n = len(gone)
    return (
        f"{int(gone.sum())} of {n} times do not fit what the others predict, and are left out "
        f"(noise alone would do so to {n * false_alarm:.2g})."
    )


def _tails(
    setup: Setup, data: Visibilities
) -> tuple[Float[np.ndarray, " times"] | None, Float[np.ndarray, " times"]]:
    """Probability of each time's chi^2 or more, and chi^2 over its mean; None if not known."""
    model, posterior = on_host(_conditioned(setup, data))
    wide = _wide(posterior, model.n_data)
    left_out = leave_out(replace(model, prior=wide.prior), wide, data)
    n = data.layout.n_times
    if left_out is None:
        return None, np.ones(n)
    counts = np.bincount(data.layout.time, minlength=n)
    some = np.flatnonzero(counts)
    times = np.arange(n)
    missed = in_threads(lambda k: left_out.stretch(times == k), some.tolist())
    found = np.array([m.chi2 for m in missed])
    new = np.array([m.directions for m in missed])
    degrees = counts[some] - np.clip(new, 0.0, counts[some])
    # where the others tell less than half a datum, there is nothing to compare with
    judged = degrees > 0.5
    tail, ratio = np.ones(n), np.zeros(n)
    tail[some[judged]] = special.chdtrc(degrees[judged], found[judged])
    ratio[some[judged]] = found[judged] / degrees[judged]
    return tail, ratio


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
    setup: Setup, data: Visibilities, gone: Bool[np.ndarray, " times"]
) -> tuple[Setup, Visibilities]:
    """Setup and data without some times.

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
