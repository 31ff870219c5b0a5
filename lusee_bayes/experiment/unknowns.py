"""Posterior of the unknowns besides the sky: receivers, ground, gains, pointing, point sources.

A uniform sky, warmer ground and noisier receivers look alike. In their joint posterior, in units of
the prior standard deviations, the *null direction* has the largest variance. It is 1 if the data
do not constrain this direction.

In a joint posterior, each channel has its own unknowns z ~ N(0, 1). Given the channel's sky m, data
of other channels do not constrain them: p(z | all data) is p(z | m, d) integrated over the joint
posterior of m.

For clock and pointing, reports list the offsets of the model and those that each day prefers.

Let theta be all unknowns of the instrument and fluxes, W = Cov(m, theta) and V = Cov(theta).
Fixing theta at its posterior mean lowers the covariance C of the sky by W V^-1 W^T. The share of
theta is the variance of this matrix over the variance of C. Shares of single systematics, from
blocks of W and V, need not add up.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from operator import attrgetter
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Float, Int
from scipy.linalg import block_diag

from lusee_bayes.core import checks, linalg
from lusee_bayes.core.arrays import Modes, ModesMatrix, Pixels, Square
from lusee_bayes.core.trees import quantity
from lusee_bayes.experiment.experiment import Experiment
from lusee_bayes.experiment.model import base_model, true_values
from lusee_bayes.experiment.rounds import Inference
from lusee_bayes.instrument.pointing import offset_names
from lusee_bayes.judge.measures import preferences
from lusee_bayes.linear.amplitudes import Amplitudes, AmplitudesOfSky, Shared, Tied
from lusee_bayes.linear.posterior import Posterior, pixel_std
from lusee_bayes.sky.galaxy import kelvin_steradian
from lusee_bayes.systematics import context, gain_table
from lusee_bayes.systematics.above_lmax import AboveLmax
from lusee_bayes.systematics.pointing_offsets import PointingOffsets, shifted
from lusee_bayes.systematics.sources import PointSources
from lusee_bayes.systematics.systematic import Expanded, Truth

# in sr
WHOLE_SKY = 4.0 * np.pi
# report a null direction that keeps more than WORTH of its prior variance, and its parts with
# weights of at least PART
WORTH, PART = 0.5, 0.2


@dataclass(frozen=True)
class NullDirection:
    """The combination of the sky's monopole and unknowns that the data constrain least.

    Attributes
    ----------
    names : tuple of str
        Names of its parts.
    weights : (parts,) array
        A unit vector, in prior standard deviations of the parts; the largest is positive.
    share : float
        Posterior variance over prior variance.
    """

    names: tuple[str, ...]
    weights: Float[np.ndarray, " parts"] = quantity("1", "in prior standard deviations")
    share: float

    @classmethod
    def of(cls, names: Sequence[str], covariance: Square) -> NullDirection:
        """Find it in a posterior covariance.

        Parameters
        ----------
        names : sequence of str
            Names of the parts.
        covariance : (parts, parts) array
            In prior standard deviations of the parts; the prior covariance is the unit matrix.
        """
        variances, directions = np.linalg.eigh(covariance)
        weights = directions[:, -1]
        weights = weights * np.sign(weights[np.argmax(np.abs(weights))])
        return cls(tuple(names), weights, float(variances[-1]))

    def words(self) -> str:
        """Its larger parts with their weights, the largest first."""
        large = [k for k in np.argsort(-np.abs(self.weights)) if abs(self.weights[k]) >= PART]
        return ", ".join(f"{self.names[k]} {self.weights[k]:+.2f}" for k in large)

    def sentence(self) -> str:
        """The unconstrained combination in one sentence; empty if the data constrain it."""
        if self.share <= WORTH:
            return ""
        return (
            f"One parameter combination is nearly unconstrained ({self.words()}, in prior standard "
            f"deviations): its variance is {self.share:.0%} of the prior variance."
        )


# columns of a report's table, in order; "true" only if known
UNKNOWN_COLUMNS = ("unknown", "unit", "value", "std", "prior", "prior_std", "true")
# name of the sky's monopole among the unknowns
SKY = "uniform sky"
# an unknown that keeps more of its prior standard deviation is unconstrained
UNTOLD = 0.9


@dataclass(frozen=True)
class UnknownsReport:
    """A map's results on receivers, ground and gain table.

    Attributes
    ----------
    table : DataFrame
        One row per unknown: unknown, unit, value, std, prior, prior_std and, if known, true.
    null : NullDirection or None
        None for a channel of a joint posterior, whose sky has no independent prior.
    common : float or None
        Standard deviation of the common error of all gains, over its prior's; None without a gain
        table.
    onto : bool
        Whether the map also contains earlier data, which the table does not.
    """

    table: pd.DataFrame
    null: NullDirection | None
    common: float | None = None
    onto: bool = False

    @property
    def constrained(self) -> pd.Series:
        """Whether the data constrain each unknown."""
        return self.table["std"] <= UNTOLD * self.table["prior_std"]

    def notes(self) -> list[str]:
        """Notes on the table, one sentence each."""
        sentences = []
        if self.common is not None and self.common > UNTOLD:
            sentences.append(
                "The common gain of all ports is unconstrained (standard deviation "
                f"{self.common:.2f} of the prior's): it is degenerate with the sky's brightness."
            )
        if self.onto:
            sentences.append(
                "Receivers, ground and gains are constrained here by the new data only; for the "
                "earlier data, see the folder of the earlier map."
            )
        return sentences

    def lines(self) -> list[str]:
        """One line per unknown, the sentence on the null direction, and the notes."""
        lines = [_line(row["unknown"], row) for row in self.table.to_dict("records")]
        return [*lines, *filter(None, [self.null_sentence()]), *self.notes()]

    def null_sentence(self) -> str:
        """The null direction in one sentence; empty if it is constrained or not computed."""
        return "" if self.null is None else self.null.sentence()

    def summary(self) -> dict[str, Any]:
        """Entry of summary.json."""
        rows, notes = self.table.to_dict("records"), self.notes()
        entry: dict[str, Any] = {"rows": rows, "common_gain_std_share": self.common, "notes": notes}
        if self.null is not None:
            weights = zip(self.null.names, self.null.weights.tolist(), strict=True)
            entry |= {"null_direction": dict(weights), "null_share": self.null.share}
            entry["null_sentence"] = self.null_sentence()
        return entry


def _line(name: str, row: Mapping[str, Any]) -> str:
    """Format a row of a table as text."""
    unit = f" {row['unit']}" if row.get("unit") else ""
    text = f"{name}: {checks.with_error(row['value'], row['std'])}{unit}"
    if row["std"] > UNTOLD * row["prior_std"]:
        text += f" (unconstrained: prior +- {row['prior_std']:.2g})"
    return text


# largest number of unknowns in a corner plot
MOST_IN_CORNER = 12
ALL_TOGETHER = "all together"


@dataclass(frozen=True)
class InstrumentPosterior:
    """Posterior of theta, the unknowns of the instrument and fluxes, and its effect on the map.

    Attributes
    ----------
    table : DataFrame
        One row per unknown, or per ell for errors of fields: ``systematic``, ``unknown``, ``n``
        (number of unknowns in the row), ``moved`` (rms distance of posterior from prior means) and
        ``width`` (rms standard deviation), both in prior standard deviations.
    corner : DataFrame
        At most 12 unknowns, without errors of fields: first those that channels share, then those
        best constrained relative to their priors. Columns as in :class:`UnknownsReport`.
    correlation : (parameters, parameters) array
        Correlation of the unknowns in ``corner``.
    shares : dict of float
        Fraction of the map's variance, summed over all modes, that would vanish if a systematic, or
        all together, were known.
    pixel_share : (pixels,) array
        This fraction in each pixel of the map, for all systematics together.
    """

    table: pd.DataFrame
    corner: pd.DataFrame
    shares: dict[str, float]
    correlation: Float[np.ndarray, "parameter parameter_2"] = quantity(
        "1", "correlation of unknowns"
    )
    pixel_share: Pixels = quantity("1", "share of the variance that unknowns of the instrument add")

    def summary(self) -> dict[str, Any]:
        """Entry of summary.json."""
        tables = {name: getattr(self, name).to_dict("records") for name in ("table", "corner")}
        return {"shares": self.shares, **tables, "correlation": self.correlation.tolist()}


@dataclass(frozen=True)
class Fluxes:
    """Posterior of point sources, each as the mean temperature that it adds to the sky, in K.

    names : of the sources; truth : NaN if unknown; with_sky : covariance with the sky, in K^2;
    with_all : covariance of the sky, and of the sources, with all amplitudes, in K
    """

    names: tuple[str, ...]
    mean: Float[np.ndarray, " source"]
    std: Float[np.ndarray, " source"]
    truth: Float[np.ndarray, " source"]
    with_sky: Float[np.ndarray, "source mode"]
    with_all: Float[np.ndarray, "mode_or_source n"]


@dataclass(frozen=True)
class Unknowns:
    """Posterior of the unknowns beside the sky given it, for reports and for joint channels.

    Attributes
    ----------
    rows : tuple of dict
        As in :func:`before_data`.
    amplitudes : AmplitudesOfSky or Amplitudes
        Of all unknowns, relative to ``expected``; Amplitudes given all data of a joint posterior.
    expected : (n,) array
        Prior means in N, in prior standard deviations.
    octaves : (n,) array
        Octaves over which channels share them (:meth:`.Systematic.octaves`).
    names : tuple of str
        Parts that may look like a uniform sky: powers, temperatures, and the common error of all
        gains.
    parts : (parts, n) array
        Directions of these parts among the unknowns. Gain errors have one unit vector, since those
        of single ports and levels do not look like a sky.
    sky_std : float
        Prior standard deviation of the monopole, in K.
    """

    rows: tuple[dict[str, Any], ...]
    amplitudes: AmplitudesOfSky | Amplitudes
    expected: Float[np.ndarray, " n"]
    octaves: Float[np.ndarray, " n"]
    names: tuple[str, ...]
    parts: Float[np.ndarray, "parts n"]
    sky_std: float

    @classmethod
    def of(cls, experiment: Experiment, inference: Inference) -> Unknowns | None:
        """Collect the unknowns of a model; None if it has none.

        Parameters
        ----------
        experiment : Experiment
        inference : Inference
            Inference from these data alone.
        """
        if not (held := inference.expanded):
            return None
        octaves, alike = [], []
        for part in held:
            systematic, none = part.systematic, ((), np.zeros((0, len(part.expected))))
            over = systematic.octaves(attrgetter(systematic.key)(experiment.scenario))
            octaves.append(np.full(len(part.expected), over))
            alike.append(none if systematic.has_table else systematic.like_the_sky())
        columns = np.concatenate([part.columns for part in held], axis=1)
        # of given data, the true sky may be known, but not whether this scenario simulated them
        rows = before_data(held, None if (s := experiment.setup).measured else true_values(s))
        return cls(
            tuple(rows.to_dict("records")),
            AmplitudesOfSky.of(inference.solution, columns),
            np.concatenate([s.expected for s in held]),
            np.concatenate(octaves),
            tuple(name for names, _ in alike for name in names),
            block_diag(*(parts for _, parts in alike)),
            float(np.sqrt(np.asarray(inference.model.prior.variance())[0])),
        )

    @property
    def shared(self) -> Int[np.ndarray, " shared"]:
        """Indices of the unknowns that channels share."""
        return np.flatnonzero(self.octaves)

    @property
    def shared_names(self) -> list[str]:
        """Names of the shared unknowns."""
        return [self.rows[k]["unknown"] for k in self.shared]

    def fluxes(self, given: Amplitudes) -> Fluxes:
        """The fluxes of sources that are constant in time, sky integrated out."""
        table = given_data(pd.DataFrame(self.rows), given)
        own = table["systematic"].eq(PointSources.words) & table["unknown"].eq(table["site"])
        k = np.flatnonzero(own)
        kelvin = table.loc[k].reindex(columns=["value", "std", "true", "prior_std"]) / WHOLE_SKY
        scale = kelvin["prior_std"].to_numpy()[:, None]
        return Fluxes(
            tuple(name.removeprefix("flux_").replace("_", " ") for name in table["unknown"][k]),
            *(kelvin[name].to_numpy() for name in ("value", "std", "true")),
            scale * given.with_sky[:, k].T,
            np.concatenate([given.with_sky, scale * given.covariance[k]]),
        )

    def among(self, tied: Tied) -> list[int]:
        """Indices of the shared unknowns in ``tied``."""
        return [tied.names.index(name) for name in self.shared_names]

    def given_all(self, amplitudes: Amplitudes) -> Unknowns:
        """Return the unknowns given all data of a joint posterior."""
        n = len(self.rows)
        inner = amplitudes.mean[:n], amplitudes.covariance[:n, :n], amplitudes.with_sky[:, :n]
        return replace(self, amplitudes=Amplitudes(*inner))

    def table(self, mean: Modes, covariance: ModesMatrix) -> pd.DataFrame:
        """All unknowns with value and std, sky integrated out; parameters as in :meth:`report`."""
        return given_data(pd.DataFrame(self.rows), self.amplitudes.integrated(mean, covariance))

    def report(
        self, mean: Modes, covariance: ModesMatrix, *, joint: bool = False
    ) -> UnknownsReport | None:
        """The report on listed unknowns, with the sky integrated out; None if there are none.

        Parameters
        ----------
        mean, covariance : (modes,) and (modes, modes) array
            Posterior of the sky, in K and K^2.
        joint : bool
            The posterior includes other data, so no null direction is computed.
        """
        posterior, rows = self.amplitudes.integrated(mean, covariance), self.table(mean, covariance)
        rows = rows[rows["listed"]]
        if rows.empty:
            return None
        null = None if joint else self._null_direction(posterior, float(covariance[0, 0]))
        common = None
        if gain_table.COMMON_GAIN in self.names:
            gain = self.parts[self.names.index(gain_table.COMMON_GAIN)]
            common = float(np.sqrt(gain @ posterior.covariance @ gain))
        return UnknownsReport(rows.filter(UNKNOWN_COLUMNS), null, common)

    def instrument(
        self, mean: Modes, covariance: ModesMatrix, pixels: Pixels
    ) -> tuple[InstrumentPosterior, dict[str, Float[np.ndarray, "modes_and_sources kept"]], Fluxes]:
        """Compute the posterior of all unknowns, and its effect on the map.

        Parameters
        ----------
        mean, covariance : (modes,) and (modes, modes) array
            Posterior of the sky, in K and K^2.
        pixels : (pixels,) array
            Posterior standard deviation of each pixel, in K.

        Returns
        -------
        InstrumentPosterior
        dict of (modes + sources, kept) arrays
            For each systematic, and all together, R of W V^-1 W^T = R R^T, the part of the
            covariance of sky, and of fluxes, that would vanish if it were known; that of fluxes
            only for systematics other than the sources themselves.
        Fluxes
        """
        given, total = self.amplitudes.integrated(mean, covariance), float(np.trace(covariance))
        rows = given_data(pd.DataFrame(self.rows), given)

        correlation = given.covariance / np.outer(given.std, given.std)
        fluxes = self.fluxes(given)
        with_all = fluxes.with_all / given.std

        def root(which: Int[np.ndarray, " which"]) -> Float[np.ndarray, "modes_and_sources kept"]:
            """R of W V^-1 W^T = R R^T."""
            values, axes = np.linalg.eigh(correlation[np.ix_(which, which)])
            kept = values > len(values) * np.finfo(np.float64).eps
            return with_all[:, which] @ (axes[:, kept] / np.sqrt(values[kept]))

        every, n = root(np.arange(len(rows))), len(mean)
        kinds = rows.groupby("systematic", sort=False).indices
        others = np.flatnonzero(rows["systematic"] != PointSources.words)
        together = block_diag(every[:n], root(others)[n:])
        parts = {ALL_TOGETHER: together} | {name: root(at) for name, at in kinds.items()}
        if PointSources.words in parts:
            parts[PointSources.words][n:] = 0.0
        moved = (rows["value"] - rows["prior"]) / rows["prior_std"]
        squares = rows.assign(unknown=rows["site"], n=1, moved=moved**2, width=given.std**2)
        groups = squares.groupby(["systematic", "unknown"], sort=False)
        table = groups.agg({"n": "sum", "moved": "mean", "width": "mean"}).reset_index()
        table[["moved", "width"]] **= 0.5
        single = np.flatnonzero(rows["site"] == rows["unknown"])
        best = np.lexsort((given.std[single], self.octaves[single] == 0))[:MOST_IN_CORNER]
        corner = np.sort(single[best])
        theta = InstrumentPosterior(
            table,
            rows.loc[corner].filter(UNKNOWN_COLUMNS).reset_index(drop=True),
            {name: float((part[:n] ** 2).sum()) / total for name, part in parts.items()},
            correlation[np.ix_(corner, corner)],
            (pixel_std(every[:n] @ every[:n].T, round(np.sqrt(len(pixels) / 12))) / pixels) ** 2,
        )
        return theta, parts, fluxes

    def _null_direction(self, posterior: Amplitudes, variance: float) -> NullDirection:
        mixed = self.parts @ posterior.with_sky[0] / self.sky_std
        inner = self.parts @ posterior.covariance @ self.parts.T
        blocks = np.block([[variance / self.sky_std**2, mixed], [mixed[:, None], inner]])
        return NullDirection.of((SKY, *self.names), blocks)


@dataclass(frozen=True)
class SkyAbove:
    """The sky above lmax that a channel's data see, and the unknowns, given the sky of the map.

    Attributes
    ----------
    directions : (others, few) array
        Orthonormal directions of its departure from the prior, in prior standard deviations.
    amplitudes : AmplitudesOfSky
        Of all unknowns, and then along these directions.
    mean, covariance : (few,) and (few, few) array
        Along these directions, for any sky of the map.
    model : (others,) array
        The model sky's departure.
    """

    directions: Float[np.ndarray, "others few"]
    amplitudes: AmplitudesOfSky
    mean: Float[np.ndarray, " few"]
    covariance: Float[np.ndarray, "few few_2"]
    model: Float[np.ndarray, " others"]

    @classmethod
    def of(cls, setup: context.Setup, inference: Inference, wide: Posterior) -> SkyAbove | None:
        """Find it in a solved model; None if that ends at lmax. ``wide`` allows any sky."""
        parts = [part.systematic for part in inference.systematics]
        roots = [part.root for part in parts if isinstance(part, AboveLmax)]
        if not roots:
            return None
        above, n = setup.above, setup.prior.size
        lower = linalg.checked_cholesky("the prior above lmax", above.covariance)
        own = np.column_stack([above.root[n:], above.modes - above.mean[n:]])
        directions, model = np.split(linalg.solve_lower(lower, own, transpose=False), [-1], axis=1)
        columns = np.concatenate([*(part.columns for part in inference.expanded), *roots], axis=1)
        amplitudes = AmplitudesOfSky.of(inference.solution, columns)
        given = amplitudes.integrated(np.asarray(wide.mean), np.asarray(wide.covariance()))
        few = slice(-directions.shape[1], None)
        return cls(directions, amplitudes, given.mean[few], given.covariance[few, few], model[:, 0])

    @property
    def told(self) -> float:
        """Number of these directions that the data measure."""
        return float((1.0 - np.diagonal(self.covariance)).sum())


def amplitudes_of(
    unknowns: Unknowns | None, above: SkyAbove | None, reference: Modes
) -> AmplitudesOfSky:
    """All amplitudes of a channel given its sky: none, if there is nothing beside this sky."""
    if (given := unknowns if above is None else above) is not None:
        return given.amplitudes
    return AmplitudesOfSky(np.zeros(0), np.zeros((0, len(reference))), np.zeros((0, 0)), reference)


def in_common(
    unknowns: Unknowns | None, above: SkyAbove | None, tied: Tied, number: int, reference: Modes
) -> Shared:
    """What a channel has in common with the others of a joint posterior, given its sky.

    Parameters
    ----------
    unknowns : Unknowns or None
    above : SkyAbove or None
        None if the channel's model ends at lmax.
    tied : Tied
        Prior of the common unknowns.
    number : int
        Index of the channel in ``tied``.
    reference : (modes,) array
        A sky in K, about which a channel without such unknowns is described.
    """
    given = amplitudes_of(unknowns, above, reference)
    mean, turn, root = given.mean.copy(), np.zeros((len(given.mean), 0)), np.zeros((0, 0))
    if unknowns is not None:
        mean[: len(unknowns.expected)] += unknowns.expected
        turn = np.eye(len(mean))[:, unknowns.shared]
        root = tied.prior_root[number, unknowns.among(tied)]
    if tied.above is not None:
        directions = tied.above.directions[:, :0] if above is None else above.directions
        alike = tied.above.root(number, directions)
        turn = np.hstack([turn, np.pad(alike, ((len(mean) - len(alike), 0), (0, 0)))])
        root = block_diag(root, np.eye(alike.shape[1]))
    across = given.covariance @ turn
    spread = turn.T @ across + np.eye(turn.shape[1]) - turn.T @ turn
    return Shared(across, turn.T @ mean, turn.T @ given.pull, spread, root, given.reference)


def before_data(parts: Sequence[Expanded], truth: Truth | None) -> pd.DataFrame:
    """The unknowns of systematics with their priors.

    Parameters
    ----------
    parts : sequence of Expanded
    truth : dict or None
        True values of all systematics; None if unknown.

    Returns
    -------
    DataFrame
        One row per unknown: unknown, unit, prior, prior_std, ``expected`` (the prior mean in N),
        ``listed`` (whether in the report's table; pointing has another table), ``systematic``,
        ``site`` (the ell of errors of fields) and, if known, true.
    """
    tables = []
    for part in parts:
        systematic = part.systematic
        columns = {
            "expected": systematic.in_units(part.expected),
            "prior": systematic.in_units(0.0 * systematic.stds),
            "prior_std": dict(zip(systematic.names, systematic.stds.tolist(), strict=True)),
            "true": {} if truth is None else systematic.true(truth),
        }
        table = pd.DataFrame({name: values for name, values in columns.items() if values})
        table = table.rename_axis("unknown").reset_index()
        sites = [u.name for u in systematic.unknowns for _ in range(u.size or 1)]
        sites = sites if systematic.has_table else systematic.names
        table = table.assign(unit=systematic.unit, listed=not systematic.has_table, site=sites)
        tables.append(table.assign(systematic=systematic.words))
    return pd.concat(tables, ignore_index=True)


def given_data(table: pd.DataFrame, amplitudes: Amplitudes) -> pd.DataFrame:
    """Add value and std to a table, from amplitudes in prior standard deviations, its own first."""
    mean, std = amplitudes.mean[: len(table)], amplitudes.std[: len(table)]
    value = table["expected"] + table["prior_std"] * mean
    return table.assign(value=value, std=table["prior_std"] * std)


def _alone(experiment: Experiment, inference: Inference, part: Expanded) -> pd.DataFrame:
    """The table of one systematic."""
    truth = None if experiment.setup.measured else true_values(experiment.setup)
    return given_data(before_data([part], truth), inference.amplitudes(part))


# offsets that are always tested, with the step of their derivatives; longitude and latitude act
# like clock and tilt
TESTED = {"clock_s": 10.0, "turntable_deg": 0.1, "tilt_east_deg": 0.1, "tilt_north_deg": 0.1}


def tested_offsets(setup: context.Setup) -> dict[str, float]:
    """The steps of all tested offsets, by name."""
    n_runs = setup.observation.n_runs
    return {name: step for kind, step in TESTED.items() for name in offset_names((kind,), n_runs)}


# if there are more days, they form groups of equal length
MOST_STRETCHES = 31


@dataclass(frozen=True)
class PointingReport:
    """A map's results on clock and pointing.

    Attributes
    ----------
    offsets : DataFrame or None
        One row per offset of the model: offset, value, std, prior_std and, if known, true. None
        without offsets.
    preferred : DataFrame
        Additional offsets that the data prefer, one row per offset for all days and for each group
        of days: offset, first_day and last_day (-1 for all), value, std and chi2_gain.
    """

    offsets: pd.DataFrame | None
    preferred: pd.DataFrame

    def given(self, unknowns: pd.DataFrame) -> PointingReport:
        """Return the report with value and std of each offset from a table of unknowns."""
        unknowns, table = unknowns.set_index("unknown"), self.offsets
        columns = {name: table["offset"].map(unknowns[name]) for name in ("value", "std")}
        return replace(self, offsets=table.assign(**columns))

    def lines(self) -> Iterator[str]:
        """One line per offset."""
        for row in [] if self.offsets is None else self.offsets.to_dict("records"):
            yield _line(row["offset"], row)


def pointing_report(experiment: Experiment, inference: Inference) -> PointingReport:
    """Compute the offsets of the model, and additional offsets that the data prefer.

    Parameters
    ----------
    experiment : Experiment
    inference : Inference
        Inference from these data alone.
    """
    table, values = None, {}
    if inference.offsets is not None:
        table = _alone(experiment, inference, inference.offsets)
        table = table.rename(columns={"unknown": "offset"})
        table = table.filter(["offset", "value", "std", "prior_std", "true"])
        values = dict(zip(table["offset"], table["value"], strict=True))
    return PointingReport(table, _preferred(experiment, inference, values))


def _preferred(experiment: Experiment, result: Inference, values: dict[str, float]) -> pd.DataFrame:
    setup, data, sky = experiment.setup, experiment.data, result.posterior.mean
    steps = tested_offsets(setup)
    centre = dict.fromkeys(steps, 0.0) | values
    offsets = PointingOffsets.of(shifted(setup, centre), steps, centre)
    expanded = Expanded.at(offsets, base_model(setup), context.Around(sky=sky, values=centre))
    per_unit, day = np.asarray(expanded.columns) / offsets.stds, setup.observation.day
    length = -(-(int(day.max()) + 1) // MOST_STRETCHES)
    stretches = [(-1, -1, np.ones(len(day), dtype=bool))]
    for first in (np.unique(day // length) * length).tolist():
        stretches.append((first, first + length - 1, day // length * length == first))
    rows, columns = [], []
    for name, template in zip(steps, per_unit.T, strict=True):
        for first, last, times in stretches:
            column = np.where(times[data.layout.time], template, 0.0)
            # of all days together, the model has inferred its own offsets
            if name not in values if first < 0 else column.any():
                rows.append((name, first, last))
                columns.append(column)
    table = pd.DataFrame(rows, columns=["offset", "first_day", "last_day"])
    return table.assign(**preferences(result.solution, np.stack(columns, axis=1)))


def flux_table(experiment: Experiment, inference: Inference) -> pd.DataFrame:
    """Posterior of every source's flux in Jy and in K sr, with its prior and, if known, its truth.

    Parameters
    ----------
    experiment : Experiment
        With sources that are not ignored.
    inference : Inference
        Inference from these data alone.

    Returns
    -------
    DataFrame
        One row per source, or per block of it. ``above_horizon``: whether it ever rises; if not,
        only the prior constrains its flux.
    """
    held = next(s for s in inference.expanded if isinstance(s.systematic, PointSources))
    fluxes = _alone(experiment, inference, held)
    frequency_mhz = experiment.scenario.frequency_mhz
    own = zip(experiment.scenario.sources.list, held.systematic.unknowns, strict=True)
    blocks = [(source.name, block) for source, flux in own for block in range(flux.size or 1)]
    table = pd.DataFrame(blocks, columns=["source", "block"])
    table["above_horizon"] = np.asarray(held.systematic.columns).any(0)
    in_jy = fluxes.filter(["prior", "prior_std", "true"]) / kelvin_steradian(1.0, frequency_mhz)
    return pd.concat([table, in_both_units(fluxes, frequency_mhz), in_jy.add_suffix("_jy")], axis=1)


def in_both_units(unknowns: pd.DataFrame, frequency_mhz: float) -> pd.DataFrame:
    """Value and std of the fluxes among unknowns, in Jy and in K sr."""
    of_sources = unknowns[unknowns["systematic"] == PointSources.words].reset_index(drop=True)
    found = of_sources[["value", "std"]].rename(columns={"value": "flux"})
    in_jy = found / kelvin_steradian(1.0, frequency_mhz)
    return pd.concat([in_jy.add_suffix("_jy"), found.add_suffix("_k_sr")], axis=1)


def flux_lines(fluxes: pd.DataFrame) -> Iterator[str]:
    """One line per source, or per block of it."""
    for row in fluxes.to_dict("records"):
        name = row["source"] if row["block"] == 0 else f"{row['source']} ({row['block']})"
        text = f"{name}: {checks.with_error(row['flux_jy'], row['std_jy'])} Jy"
        if not row["above_horizon"]:
            text += " (prior: never above the horizon)"
        yield text
