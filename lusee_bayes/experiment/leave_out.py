"""Data that do not fit what all others predict for them, found one after the other.

The worst times are flagged, or a single product of theirs without which the time fits; what is left
is fitted again, and so on, until none has a chi^2 that noise gives with less than the rate of false
alarms. Then products and days are compared in the same way. A bad product or day spoils the
predictions of all times: where more times do not fit than may be left out, it goes first.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from lusee_bayes.experiment.comparison import Comparison, Group, compared
from lusee_bayes.experiment.setup import Setup
from lusee_bayes.instrument.layout import DataLayout
from lusee_bayes.instrument.visibilities import Visibilities

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
        How often the data were fitted.
    chi2 : (times,) array
        Of each time against its prediction by the others, before anything was flagged, over its
        mean; 0 where the others do not tell.
    remark : str
        What is to be said; empty if there is nothing.
    groups : tuple of Group
        Products and days that are flagged as a whole.
    """

    flagged: Bool[np.ndarray, "products times"]
    rounds: int
    chi2: Float[np.ndarray, " times"]
    remark: str = ""
    groups: tuple[Group, ...] = ()

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
        Chance that a time of noise alone is flagged, one of its products, or a whole product or
        day.

    Returns
    -------
    Fitting
        With nothing flagged, and a remark, if so many times do not fit that it is not them.
    """
    shape = (data.layout.n_products, data.layout.n_times)
    nothing, groups, passes = np.zeros(shape, dtype=bool), (), []
    while True:
        of_groups = np.any([nothing, *(group.data for group in groups)], axis=0)
        found = _one_by_one(setup, data, of_groups, false_alarm)
        if found is None:
            return Fitting(nothing, 1, np.zeros(shape[1]), NOT_JUDGED)
        passes.append(found)
        worst = found.comparison.worst_group(false_alarm)
        if worst is None or _too_many(groups, worst):
            break
        groups = (*groups, worst)
    rounds, before = sum(one.rounds for one in passes), passes[0].before
    if worst is not None or found.flagged is None:
        # no few groups are to blame: what was found without blaming any
        found, groups = passes[0], ()
    if found.flagged is None:
        return Fitting(nothing, rounds, before, TOO_MANY)
    remark = _remark(found.flagged, of_groups if groups else nothing, groups, false_alarm)
    return Fitting(found.flagged, rounds, before, remark, groups)


@dataclass(frozen=True)
class _OneByOne:
    """Times and values that do not fit, some groups left out.

    flagged : (products, times) array with those of the groups, or None if they are too many;
    comparison : of what is left, or of what was before they were too many; rounds : int;
    before : (times,) array, as chi2 of ``Fitting``
    """

    flagged: Bool[np.ndarray, "products times"] | None
    comparison: Comparison
    rounds: int
    before: Float[np.ndarray, " times"]


def _one_by_one(
    setup: Setup, data: Visibilities, groups: Bool[np.ndarray, "products times"], false_alarm: float
) -> _OneByOne | None:
    """Flag times and values, the worst first; None if they cannot be compared."""
    gone, first = groups, None
    for rounds in range(1, MAX_ROUNDS + 1):
        found = compared(*(without(setup, data, gone) if gone.any() else (setup, data)))
        if found is None:
            return None
        first = first or found
        out = found.worst(false_alarm)
        if not out.any():
            return _OneByOne(gone, found, rounds, first.ratio)
        gone = gone | out
        if (gone & ~groups).any(axis=0).sum() > max(MOST * data.layout.n_times, 1.0):
            break
    return _OneByOne(None, found, rounds, first.ratio)


def _too_many(groups: tuple[Group, ...], worst: Group) -> bool:
    n = 1 + sum(group.kind == worst.kind for group in groups)
    return n > max(MOST * worst.of, 1.0)


def _remark(
    gone: Bool[np.ndarray, "products times"],
    of_groups: Bool[np.ndarray, "products times"],
    groups: tuple[Group, ...],
    false_alarm: float,
) -> str:
    single = gone & ~of_groups
    whole = gone.all(axis=0) & single.any(axis=0)
    n_single, n = int(single[:, ~whole].sum()), gone.shape[1]
    parts = [f"{group.kind} {group.name}" for group in groups]
    if whole.any():
        parts.append(f"{int(whole.sum())} of {n} times")
    if n_single:
        parts.append(f"{n_single} single value" + ("s" if n_single > 1 else ""))
    if not parts:
        return ""
    named = f"{', '.join(parts[:-1])} and {parts[-1]}" if len(parts) > 1 else parts[0]
    return (
        f"Left out, since the others predict otherwise: {named}. Noise alone would do so to "
        f"{2.0 * n * false_alarm:.2g} times or values."
    )


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
