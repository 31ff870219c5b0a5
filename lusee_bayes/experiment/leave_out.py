"""Data that do not fit what all others predict for them, found one after the other.

The worst times are flagged, or a single product of theirs without which the time fits; what is left
is compared again under the same model, and so on, until none has a chi^2 that noise gives with less
than the rate of false alarms. Then products and days are compared in the same way. A bad product or
day spoils the predictions of all times: where more times do not fit than may be flagged, it goes
first. What is left is fitted again, since N is built around the data, until nothing more goes.

All rules together, those of the reduction included, take a fifth of the data at most. A port's auto
never goes whole while its crosses stay, whose noise depends on it. A map whose lmax is too small
fits no data; so before much is flagged, higher ones are tried.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from lusee_bayes.core.errors import InputError
from lusee_bayes.core.harmonics import n_modes
from lusee_bayes.core.progress import Stages
from lusee_bayes.experiment.comparison import Comparison, Group, compared
from lusee_bayes.experiment.rounds import rebuilds
from lusee_bayes.experiment.setup import Setup, set_up
from lusee_bayes.instrument.layout import DataLayout
from lusee_bayes.instrument.products import all_products
from lusee_bayes.instrument.visibilities import Visibilities

MAX_ROUNDS = 10
NOT_JUDGED = (
    "Times were not compared with each other, which would need too much memory; use a longer "
    "observation.average_s."
)
TOO_MANY = (
    "More than a fifth of the data are inconsistent with the rest, so that none was flagged: "
    "noise, gains or beams are not those of the data."
)
# where all rules together would take more, it is not the data but noise, gains or beams
MOST = 0.2
# flagged without looking for another cause, whatever the rules of the reduction took
SMALL = 0.05
# by how much lmax is raised to look for it, how often, and how far chi^2 then falls at least
STEP, STEPS, FALLS = 8, 3, 0.5
# what stands out less than this part of the worst waits for the next fit; what stands out this much
# more than half of the times goes before N is built around what all others say: it would take N
# along, which then settles nowhere
FAR, OBVIOUS = 1e-2, 1e2


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
    share : float
        Of the values, flagged.
    refused : bool
        Whether so much would have to go that nothing does.
    cause : str
        Why good data do not fit, where that was found: also why a map of them may fail.
    """

    flagged: Bool[np.ndarray, "products times"]
    rounds: int
    chi2: Float[np.ndarray, " times"]
    remark: str = ""
    groups: tuple[Group, ...] = ()
    share: float = 0.0
    refused: bool = False
    cause: str = ""

    @property
    def times(self) -> Bool[np.ndarray, " times"]:
        """Times of which every product is flagged."""
        return self.flagged.all(axis=0)


def fitting(
    setup: Setup, data: Visibilities, false_alarm: float, stages: Stages | None = None
) -> Fitting:
    """Find data that do not fit.

    Parameters
    ----------
    setup : Setup
    data : Visibilities
        Measured.
    false_alarm : float
        Chance that a time of noise alone is flagged, one of its products, or a whole product or
        day.
    stages : Stages, optional
        Told how far it is.

    Returns
    -------
    Fitting
        With nothing flagged, and a remark, if so many data do not fit that it is not them; with
        what does not fit at a higher lmax either, if others do.
    """
    stages = stages or Stages()
    found = _found(setup, data, false_alarm, stages)
    if not found.refused and found.share <= SMALL:
        return found
    return _at_higher_lmax(setup, data, false_alarm, found, stages)


def _found(setup: Setup, data: Visibilities, false_alarm: float, stages: Stages) -> Fitting:
    """Find data that do not fit at the setup's lmax."""
    limits = _Limits.of(data)
    gone = nothing = np.zeros(limits.present.shape, dtype=bool)
    before, groups, kept = np.zeros(nothing.shape[1]), (), ""
    first = 0 if rebuilds(setup) else 1
    for rounds in range(first, MAX_ROUNDS + 1):
        start = compared(*without(setup, data, gone), settle=rounds > 0)
        if start is None:
            return Fitting(nothing, rounds, before, NOT_JUDGED)
        before = np.where(before > 0.0, before, start.ratio)
        if not rounds:
            least = OBVIOUS * max(float(np.median(start.size)), 1.0)
            _, obvious = _one_by_one(start, gone, nothing, limits, false_alarm, least)
            gone = nothing if obvious is None else obvious
            before = np.where(gone.any(axis=0), before, 0.0)
            continue
        more, auto = _eliminated(start, gone, limits, false_alarm)
        kept = kept or auto
        if more is None:
            break
        gone, groups = gone | more.flagged, (*groups, *more.groups)
        stages.say(
            f"  times compared at lmax={setup.scenario.lmax}, round {rounds}: "
            f"{limits.count(gone)} of {data.layout.size} values flagged"
        )
        if not more.flagged.any():
            share = limits.count(gone) / data.layout.size
            remark = " ".join(filter(None, [_remark(gone, groups, share, false_alarm), kept]))
            return Fitting(gone, rounds, before, remark, groups, share)
    remark = f"{TOO_MANY} {kept}".strip()
    return Fitting(nothing, rounds, before, remark, refused=True)


def _at_higher_lmax(
    setup: Setup, data: Visibilities, false_alarm: float, found: Fitting, stages: Stages
) -> Fitting:
    """What does not fit at a higher lmax, where others do; ``found`` where none is any better.

    It is raised as long as chi^2 of the times falls and there is memory.
    """
    lmax, best, size = setup.scenario.lmax, found, float(np.median(found.chi2))
    enough = SMALL if found.refused else min(SMALL, found.share / 2.0)
    for higher in range(lmax + STEP, lmax + STEPS * STEP + 1, STEP):
        if n_modes(higher) > data.layout.size / 2:
            # so many modes fit anything
            break
        try:
            wider = set_up(setup.scenario.model_copy(update={"lmax": higher}), data)
        except InputError:
            # no beams or sky up to there
            break
        again, before = _found(wider, data, false_alarm, stages), size
        size = float(np.median(again.chi2))
        if again.remark == NOT_JUDGED:
            break
        if not again.refused and again.share <= enough:
            cause = (
                f"lmax={lmax} is too small for these data: lmax={higher} fits; use --set "
                f"lmax={higher}"
            )
            remark = f"{cause}. {again.remark}".strip()
            return replace(again, chi2=found.chi2, remark=remark, cause=cause)
        if not 0.0 < size < FALLS * before:
            break
        cause = (
            f"lmax={lmax} is too small for these data, so that none was flagged: with "
            f"lmax={higher} chi^2 of the times is {size / float(np.median(found.chi2)):.2g} of "
            f"what it is now; use --set lmax={higher} or more"
        )
        nothing = np.zeros_like(found.flagged)
        best = Fitting(nothing, found.rounds, found.chi2, f"{cause}.", refused=True, cause=cause)
    return best


@dataclass(frozen=True)
class _Limits:
    """How much may go.

    present : (products, times) array of bool; values : number of values
    """

    present: Bool[np.ndarray, "products times"]
    values: float

    @classmethod
    def of(cls, data: Visibilities) -> _Limits:
        """A fifth of what there was, less what the rules of the reduction took."""
        n = data.layout.size
        lost = 0.0 if data.calibration is None else data.calibration.lost
        left = (MOST - lost) / (1.0 - lost) * n
        return cls(np.asarray(data.layout.present), max(left, SMALL * n, data.layout.n_products))

    def count(self, gone: Bool[np.ndarray, "products times"]) -> int:
        """Number of values that there were."""
        return int((gone & self.present).sum())

    def broken(
        self,
        gone: Bool[np.ndarray, "products times"],
        groups: Bool[np.ndarray, "products times"],
    ) -> bool:
        """Whether too much goes, ``groups`` as a whole, or an auto without its port's crosses."""
        times = (gone & ~groups).any(axis=0).sum()
        too_many = times > max(MOST * gone.shape[1], 1.0) or self.count(gone) > self.values
        return bool(too_many) or self.auto_alone(gone) is not None

    def auto_alone(self, gone: Bool[np.ndarray, "products times"]) -> int | None:
        """The port whose auto goes while crosses stay."""
        products = all_products(round(np.sqrt(len(gone))))
        left = (self.present & ~gone).any(axis=1)
        for number, product in enumerate(products):
            if product.i == product.j and self.present[number].any() and not left[number]:
                port = product.i
                crosses = [k for k, p in enumerate(products) if port in (p.i, p.j)]
                if left[crosses].any():
                    return port
        return None


@dataclass(frozen=True)
class _Eliminated:
    """What goes, groups among it."""

    flagged: Bool[np.ndarray, "products times"]
    groups: tuple[Group, ...]


def _one_by_one(
    start: Comparison,
    gone: Bool[np.ndarray, "products times"],
    groups: Bool[np.ndarray, "products times"],
    limits: _Limits,
    false_alarm: float,
    least: float,
) -> tuple[Comparison, Bool[np.ndarray, "products times"] | None]:
    """Flag times and values, the worst first; ``groups`` are among what is ``gone`` from ``start``.

    Of what is left, and what goes in all; or of what was left before that was too much, and None.
    """
    found = start
    while (worst := found.worst(false_alarm, least)).any():
        gone = gone | worst
        if limits.broken(gone, groups):
            return found, None
        found = found.without(worst)
    return found, gone


def _eliminated(
    start: Comparison,
    gone: Bool[np.ndarray, "products times"],
    limits: _Limits,
    false_alarm: float,
) -> tuple[_Eliminated | None, str]:
    """What goes under one model, besides what is ``gone``; None if that is too much.

    And what is to be said of an auto that cannot go.
    """
    base, groups, first = start, (), None
    of_groups = np.zeros_like(gone)
    while True:
        least = FAR * float(base.size.max())
        found, flagged = _one_by_one(
            base, gone | of_groups, gone | of_groups, limits, false_alarm, least
        )
        result = None if flagged is None else _Eliminated(flagged & ~gone, groups)
        first = first if groups else result
        if result is not None and found.worst(false_alarm).any():
            return result, ""
        group = found.worst_group(false_alarm)
        if group is None:
            # where no few groups are to blame: what was found without blaming any
            return result or first, ""
        of_groups = of_groups | group.data
        if limits.broken(gone | of_groups, gone | of_groups):
            return first, _about_auto(limits.auto_alone(gone | of_groups))
        groups, base = (*groups, group), start.without(of_groups)


def _about_auto(port: int | None) -> str:
    if port is None:
        return ""
    return (
        f"Product {port}{port}R is inconsistent with the rest and was kept, since the noise of "
        f"port {port}'s other products depends on it: check the gain and the receiver of port "
        f"{port}."
    )


def _remark(
    gone: Bool[np.ndarray, "products times"],
    groups: tuple[Group, ...],
    share: float,
    false_alarm: float,
) -> str:
    single = gone & ~np.any([np.zeros_like(gone), *(group.data for group in groups)], axis=0)
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
        f"Flagged as inconsistent with the remaining data: {named}, {share:.2g} of the values. "
        f"Noise alone would cause {2.0 * n * false_alarm:.2g} such flags of times or values."
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
    if not gone.any():
        return setup, data
    layout = DataLayout.from_flags(~np.asarray(data.layout.present) | gone)
    kept = replace(data, data=layout.gather(data.layout.scatter(data.data)), layout=layout)
    instrument = replace(setup.instrument, layout=layout)
    coupling = replace(setup.coupling, layout=layout)
    return replace(setup, instrument=instrument, coupling=coupling), kept
