"""Flag data that are inconsistent with the rest.

We compare times, values, products and days with the model's predictions from all other data. The
worst times are flagged, or only one product of a time if the others then fit. The remaining data
are compared again under the same model, until noise explains every chi^2 at the false-alarm rate.
Then products and days are compared in the same way. A bad product or day spoils the predictions of
all times, so it is flagged first if more times are inconsistent than may be flagged. Since N is
built around the data, the remaining data are then fitted again, until nothing more is flagged.

All rules together, including those of the reduction, flag at most a fifth of the data. A port's
auto is never flagged completely while its crosses stay, because their noise depends on it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from lusee_bayes.core import checks, lazy, section
from lusee_bayes.core.arrays import Grid, GridFlags, Vector
from lusee_bayes.core.progress import Stages, memory_limit
from lusee_bayes.experiment.model import full_model
from lusee_bayes.experiment.rounds import rebuilds, settled
from lusee_bayes.instrument.products import DataLayout, auto_indices, ports
from lusee_bayes.instrument.visibilities import Visibilities
from lusee_bayes.judge.left_out import DataGroup, LeftOut, Missed, groups_of
from lusee_bayes.judge.split import WIDER, Split
from lusee_bayes.systematics.context import Around, Setup

# one round flags the times beyond the limit whose size is at least this fraction of the worst
WORST = 0.3
# number of arrays of the size of A in memory at once, and the fraction of memory allowed for them
ARRAYS, MOST_MEMORY = 5, 0.5


@dataclass(frozen=True)
class GroupsCompared:
    """Times and data compared with their predictions from all others.

    Attributes
    ----------
    left_out : LeftOut
        With the data that are compared.
    chi2, degrees : (times,) arrays
        chi^2 of each time and its mean; 0 without a prediction.
    z : (products, times) array
        Deviation of each datum, in standard deviations; 0 without a prediction.
    """

    left_out: LeftOut
    chi2: Float[np.ndarray, " times"]
    degrees: Float[np.ndarray, " times"]
    z: Grid

    @classmethod
    def of(cls, left_out: LeftOut) -> GroupsCompared:
        """Leave out each time in turn."""
        present, times = left_out.present, np.arange(left_out.data.layout.n_times)
        some = np.flatnonzero(present.any(axis=0))
        of_time = [np.broadcast_to(times == k, present.shape) for k in some]
        chi2, degrees = np.zeros((2, len(times)))
        chi2[some], degrees[some] = _judged(left_out.each(of_time))
        with np.errstate(invalid="ignore"):
            z = left_out.u / np.sqrt(left_out.inverse_diagonal)
        usable = present & np.isfinite(z) & (degrees > 0.0)
        return cls(left_out, chi2, degrees, np.where(usable, z, 0.0))

    def without(self, gone: GridFlags) -> GroupsCompared:
        """Compare the remaining data with the same model."""
        return GroupsCompared.of(self.left_out.without(gone))

    @property
    def size(self) -> Float[np.ndarray, " times"]:
        """How far each time, or its worst datum, stands out: chi^2 over its mean."""
        ratio = np.where(self.degrees > 0.0, self.chi2 / np.maximum(self.degrees, 0.5), 0.0)
        return np.maximum(ratio, (self.z**2).max(axis=0) / len(self.z))

    def worst(self, false_alarm: float, least: float = 0.0) -> GridFlags:
        """Flag the worst outliers: whole times, or a value without which its time fits.

        chi^2 of a time minus z^2 of one datum is chi^2 of the time's other data.

        Parameters
        ----------
        false_alarm : float
            Probability that noise alone flags a time, or one of its products.
        least : float
            Ignore times with a smaller ``size``.

        Returns
        -------
        (products, times) array of bool
        """
        squares = self.z**2
        most, product = squares.max(axis=0), squares.argmax(axis=0)
        tail = _tail(self.chi2, self.degrees)
        single = np.where(self.degrees > 0.0, lazy.special.chdtrc(1.0, most), 1.0) * len(squares)
        out = (tail < false_alarm) | (single < false_alarm)
        out &= self.size >= max(WORST * self.size.max(), least)
        others = _tail(self.chi2 - most, self.degrees - 1.0)
        alone = out & (self.degrees > 1.5) & (others >= false_alarm)
        flags = np.broadcast_to(out & ~alone, squares.shape).copy()
        flags[product[alone], np.flatnonzero(alone)] = True
        return flags

    def worst_group(self, false_alarm: float) -> DataGroup | None:
        """Find the inconsistent product or day whose removal lowers chi^2 most.

        Parameters
        ----------
        false_alarm : float
            Probability that noise alone makes a product or day stand out.

        Returns
        -------
        DataGroup or None
            None if no product or day stands out.
        """
        groups = [one for one in groups_of(self.left_out.data) if one.kind in ("product", "day")]
        groups = [one for one in groups if (one.data & self.left_out.present).any()]
        chi2, degrees = _judged(self.left_out.each([group.data for group in groups]))
        out = _tail(chi2, degrees) < false_alarm
        return groups[np.where(out, chi2 - degrees, -np.inf).argmax()] if out.any() else None


def _judged(missed: list[Missed]) -> tuple[Vector, Vector]:
    """chi^2 of groups and its means; 0 where the mean is below half a datum."""
    chi2, degrees = np.reshape([(one.chi2, one.degrees) for one in missed], (-1, 2)).T
    predicted = np.isfinite(chi2) & (degrees >= 0.5)
    return np.where(predicted, chi2, 0.0), np.where(predicted, degrees, 0.0)


def _tail(chi2: Vector, degrees: Vector) -> Vector:
    """Probability of this chi^2 or more; 1 where there are no degrees of freedom."""
    return np.where(degrees > 0.0, lazy.special.chdtrc(degrees, np.maximum(chi2, 0.0)), 1.0)


def compared(setup: Setup, data: Visibilities, *, settle: bool = True) -> GroupsCompared:
    """Leave out each time in turn.

    The prior is wide enough for any sky (:mod:`lusee_bayes.judge.residuals`), so that a time is
    judged neither by the prior nor by the part of the sky that only it sees.

    Parameters
    ----------
    setup : Setup
    data : Visibilities
        Measured.
    settle : bool
        Rebuild N around the inference until rounds converge, if they do. Otherwise use one round,
        and a prior whose width does not depend on the data: this finds obvious outliers.
    """
    inference = settled(setup, Around(data)) if settle else None
    if inference is not None and not inference.unsettled:
        model, posterior = inference.model, inference.posterior
    else:  # with bad data, rounds may never converge
        model = full_model(setup, Around(data))
        posterior = model.condition(data.data).posterior if settle else None
    wide = None if posterior is None else Split.of(posterior, 0.0, data.layout.size).wide
    prior = model.prior.widened(WIDER) if wide is None else wide.prior
    return GroupsCompared.of(LeftOut(replace(model, prior=prior), data, posterior=wide))


MAX_ROUNDS = 10
NOT_JUDGED = "Times were not compared, for lack of memory; use a longer observation.average_s."
TOO_MANY = (
    "More than 20 % of the data contradict the rest; none is flagged: check noise, gains, beams."
)
KEPT = (
    "Product {port}{port}R is inconsistent with the rest but was kept, because the noise of port "
    "{port}'s other products depends on it: check the gain and the receiver of port {port}."
)
# fraction of the data that all rules may flag together; beyond, noise, gains or beams are wrong
MOST = 0.2
# fraction that may always be flagged, however much the reduction flagged
SMALL = 0.05
# FAR: outliers below this fraction of the worst wait for the next fit. OBVIOUS: times above this
# multiple of the median are flagged before N is built around the inference, because they would
# distort N so that it never converges
FAR, OBVIOUS = 1e-2, 1e2


@dataclass(frozen=True)
class Fitting:
    """The data that are inconsistent with the rest.

    Attributes
    ----------
    flagged : (products, times) array of bool
    remark : str
        A remark for the report, or empty.
    share : float
        Fraction of the values that is flagged.
    """

    flagged: GridFlags
    remark: str = ""
    share: float = 0.0


def fitting(
    setup: Setup, data: Visibilities, false_alarm: float, stages: Stages | None = None
) -> Fitting:
    """Find data that are inconsistent with the rest.

    Parameters
    ----------
    setup : Setup
    data : Visibilities
        Measured.
    false_alarm : float
        Probability that noise alone flags a time, one of its products, or a whole product or day.
    stages : Stages, optional
        Shows the progress.

    Returns
    -------
    Fitting
        Without flags, but with a remark, if too many data are inconsistent, or if comparing them
        would need too much memory.
    """
    rules, stages = _Rules.of(data, false_alarm), stages or Stages()
    gone = nothing = np.zeros(rules.present.shape, dtype=bool)
    # if N couples times, it is also a matrix of all data
    n, across = data.layout.size, section.is_modelled(setup.scenario.noise.gain)
    if 8.0 * ARRAYS * n * (setup.prior.size + n * across) > MOST_MEMORY * memory_limit():
        return Fitting(nothing, NOT_JUDGED)
    groups, kept = (), ""
    if rebuilds(setup):
        start = compared(setup, data, settle=False)
        least = OBVIOUS * max(float(np.median(start.size)), 1.0)
        _, obvious = rules.one_by_one(start, nothing, least)
        gone = nothing if obvious is None else obvious
    for rounds in range(1, MAX_ROUNDS + 1):
        more, auto = rules.eliminated(compared(*without(setup, data, gone)), gone)
        kept = kept or auto
        if more is None:
            break
        flagged, blamed = more
        gone, groups = gone | flagged, (*groups, *blamed)
        share = rules.count(gone) / n
        what = f"times compared at lmax={setup.scenario.lmax}, round {rounds}"
        stages.say(f"  {what}: {share:.2%} bad")
        if not flagged.any():
            remark = " ".join(filter(None, [rules.remark(gone, groups, share), kept]))
            return Fitting(gone, remark, share)
    return Fitting(nothing, f"{TOO_MANY} {kept}".strip())


@dataclass(frozen=True)
class _Rules:
    """Rules for which data to flag, and how many.

    false_alarm : as in :func:`fitting`; present : (products, times) array of bool; values : largest
    number of values to flag
    """

    false_alarm: float
    present: GridFlags
    values: float

    @classmethod
    def of(cls, data: Visibilities, false_alarm: float) -> _Rules:
        """Allow a fifth of the original data, minus those that the reduction flagged."""
        n = data.layout.size
        lost = 0.0 if data.calibration is None else data.calibration.lost
        left = max((MOST - lost) / (1.0 - lost) * n, SMALL * n, data.layout.n_products)
        return cls(false_alarm, np.asarray(data.layout.present), left)

    def count(self, gone: GridFlags) -> int:
        """Number of flags on values that are present."""
        return int((gone & self.present).sum())

    def broken(self, gone: GridFlags, groups: GridFlags) -> bool:
        """Whether too much is flagged (times outside ``groups``, values), or an auto alone."""
        times = (gone & ~groups).any(axis=0).sum()
        too_many = times > max(MOST * gone.shape[1], 1.0) or self.count(gone) > self.values
        return bool(too_many) or self.auto_alone(gone) is not None

    def auto_alone(self, gone: GridFlags) -> int | None:
        """The port whose auto is completely flagged while crosses remain."""
        n_ports = round(np.sqrt(len(gone)))
        first, second, _ = ports(n_ports)
        used, left = self.present.any(axis=1), (self.present & ~gone).any(axis=1)
        for port, auto in enumerate(auto_indices(n_ports)):
            if used[auto] and not left[auto] and left[(first == port) | (second == port)].any():
                return port
        return None

    def one_by_one(
        self, left: GroupsCompared, before: GridFlags, least: float
    ) -> tuple[GroupsCompared, GridFlags | None]:
        """Flag the worst data first, in addition to those ``before``, missing from ``left``.

        Returns the last comparison, and all flags; None in their place if they are too many.
        """
        gone = before
        while (worst := left.worst(self.false_alarm, least)).any():
            gone = gone | worst
            if self.broken(gone, before):
                return left, None
            left = left.without(worst)
        return left, gone

    def eliminated(
        self, start: GroupsCompared, gone: GridFlags
    ) -> tuple[tuple[GridFlags, tuple[DataGroup, ...]] | None, str]:
        """Flags under one model in addition to ``gone``, and their groups; None if too many.

        Also returns a remark on an auto that had to be kept, or an empty text.
        """
        base, groups, first = start, (), None
        of_groups = np.zeros_like(gone)
        while True:
            whole, least = gone | of_groups, FAR * float(base.size.max())
            left, flagged = self.one_by_one(base, whole, least)
            result = None if flagged is None else (flagged & ~gone, groups)
            first = first if groups else result
            if result is not None and left.worst(self.false_alarm).any():
                return result, ""
            if (group := left.worst_group(self.false_alarm)) is None:
                # no group stands out: if this result flags too much, use the first, without groups
                return result or first, ""
            of_groups = of_groups | group.data
            if self.broken(gone | of_groups, gone | of_groups):
                port = self.auto_alone(gone | of_groups)
                return first, "" if port is None else KEPT.format(port=port)
            groups, base = (*groups, group), start.without(of_groups)

    def remark(self, gone: GridFlags, groups: tuple[DataGroup, ...], share: float) -> str:
        """The flags in words."""
        single = gone & ~np.any([np.zeros_like(gone), *(group.data for group in groups)], axis=0)
        whole = gone.all(axis=0) & single.any(axis=0)
        n_single, n = int(single[:, ~whole].sum()), gone.shape[1]
        parts = [f"{group.kind} {group.name}" for group in groups]
        parts += [f"{int(whole.sum())} of {n} times"] if whole.any() else []
        parts += [checks.counted(n_single, "single value")] if n_single else []
        if not parts:
            return ""
        named = " and ".join(filter(None, [", ".join(parts[:-1]), parts[-1]]))
        return (
            f"Flagged as inconsistent with the remaining data: {named}, {share:.2g} of all values. "
            f"Noise alone would cause {2.0 * n * self.false_alarm:.2g} such flags."
        )


def without(setup: Setup, data: Visibilities, gone: GridFlags) -> tuple[Setup, Visibilities]:
    """Return setup and data without the flagged data.

    Raises
    ------
    InputError
        If no data remain.
    """
    if not gone.any():
        return setup, data
    layout = DataLayout.from_flags(~np.asarray(data.layout.present) | gone)
    kept = replace(data, data=layout.gather(data.layout.scatter(data.data)), layout=layout)
    return setup.with_layout(layout), kept
