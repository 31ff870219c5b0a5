"""What the data tell besides the sky: receivers, ground, gain table, pointing, point sources.

A uniform sky, warmer ground and noisier receivers look much alike. Of their joint posterior, each
in units of its prior's standard deviation, the *null direction* is the one with the largest
variance, which is 1 where the data say nothing.

Of a joint posterior each channel has its own unknowns z ~ N(0, 1), and given the channel's sky m no
other channel's data tell of them: p(z | all data) is p(z | m, d) with the joint posterior of m
integrated out.

Of clock and pointing, the offsets of the model are told, and which each day prefers.

Together, the unknowns of the instrument are theta. With W = Cov(m, theta) and V = Cov(theta),
fixing theta at its posterior mean lowers the covariance C of the sky by W V^-1 W^T; the ratio of
the variances of this matrix and of C is the share of theta. The shares of single systematics, with
blocks of W and V, need not add up.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from operator import attrgetter
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Float, Int
from scipy.linalg import block_diag

from lusee_bayes.core.arrays import Modes, ModesMatrix, Pixels, Square, Vector
from lusee_bayes.core.trees import quantity
from lusee_bayes.experiment.experiment import Experiment
from lusee_bayes.experiment.model import base_model, radiometer, true_values
from lusee_bayes.experiment.rounds import Inference
from lusee_bayes.instrument.pointing import offset_names
from lusee_bayes.judge.measures import preferences
from lusee_bayes.linear.amplitudes import (
    Amplitudes,
    AmplitudesOfSky,
    Shared,
    Tied,
    amplitudes_of_sky,
)
from lusee_bayes.linear.information import Information
from lusee_bayes.linear.posterior import pixel_std
from lusee_bayes.sky.galaxy import kelvin_steradian
from lusee_bayes.systematics.context import Around
from lusee_bayes.systematics.gain_table import COMMON_GAIN
from lusee_bayes.systematics.pointing_offsets import PointingOffsets, shifted
from lusee_bayes.systematics.sources import PointSources
from lusee_bayes.systematics.systematic import Expanded, Truth

# a null direction is worth a sentence where it keeps more than that of the prior's variance, and a
# part of it a word where its weight is that large
WORTH, PART = 0.5, 0.2


@dataclass(frozen=True)
class NullDirection:
    """The combination of the sky's monopole and unknowns that the data tell least of.

    Attributes
    ----------
    names : tuple of str
        Of its parts.
    weights : (parts,) array
        A unit vector, in prior standard deviations of each; the largest is positive.
    share : float
        Its posterior variance over its prior variance.
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
            Of the parts.
        covariance : (parts, parts) array
            In prior standard deviations of each; the prior is the unit matrix.
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
        """What the data cannot tell; empty where they tell most of it."""
        if self.share <= WORTH:
            return ""
        return (
            f"One parameter combination is nearly unconstrained ({self.words()}, in prior standard "
            f"deviations): its variance is {self.share:.0%} of the prior variance."
        )


# of the table of a report, in their order; "true" stands behind them where it is known
UNKNOWN_COLUMNS = ("unknown", "unit", "value", "std", "prior", "prior_std")
# what the sky's monopole is called beside them
SKY = "uniform sky"
# an unknown that keeps more of its prior's standard deviation is not told by the data
UNTOLD = 0.9


@dataclass(frozen=True)
class UnknownsReport:
    """What a map tells of receivers, ground and gain table.

    Attributes
    ----------
    table : DataFrame
        A row for each: unknown, unit, value, std, prior, prior_std and, if known, true.
    null : NullDirection or None
        None for a channel of a joint posterior, whose sky has no prior of its own.
    common : float or None
        Standard deviation of what all errors of gains have in common, over its prior's; None
        without a gain table.
    onto : bool
        Whether the map is of earlier data, too, which the table is not of.
    """

    table: pd.DataFrame
    null: NullDirection | None
    common: float | None = None
    onto: bool = False

    @property
    def constrained(self) -> pd.Series:
        """Whether the data tell each of them."""
        return self.table["std"] <= UNTOLD * self.table["prior_std"]

    def notes(self) -> list[str]:
        """What has to be known to read the table, a sentence each."""
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
        """One line for every unknown, the sentence of the null direction, and the notes."""
        lines = [_line(row["unknown"], row) for row in self.table.to_dict("records")]
        return [*lines, *filter(None, [self.null_sentence()]), *self.notes()]

    def null_sentence(self) -> str:
        """What the data cannot tell; empty where they tell most of it, or it is not judged."""
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
    """A row of a table in words."""
    unit = f" {row['unit']}" if row.get("unit") else ""
    text = f"{name}: {row['value']:.4g} +- {row['std']:.2g}{unit}"
    if row["std"] > UNTOLD * row["prior_std"]:
        text += f" (unconstrained: prior +- {row['prior_std']:.2g})"
    return text


# unknowns in a corner plot, at most
MOST_IN_CORNER = 12
ALL_TOGETHER = "all together"


@dataclass(frozen=True)
class InstrumentPosterior:
    """Posterior of theta, the unknowns of the instrument, and what it does to the map.

    Attributes
    ----------
    table : DataFrame
        A row for each unknown, or for each ell of the errors of fields: ``systematic``,
        ``unknown``, ``n`` (how many it stands for), ``moved`` and ``width``, the rms distance of
        posterior means from prior means and the rms standard deviation, in prior standard
        deviations.
    corner : DataFrame
        At most 12 unknowns, no errors of fields: first those that channels share, then those that
        are best constrained relative to their priors. Columns as in :class:`UnknownsReport`.
    correlation : (parameters, parameters) array
        Of these.
    shares : dict of float
        The share of the map's variance, summed over all modes, that would vanish if a systematic,
        or all together, were known.
    pixel_share : (pixels,) array
        The same share for each pixel of the map, all systematics together.
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
class Unknowns:
    """What some data tell of the instrument given the sky: what reports list, and what is shared.

    Attributes
    ----------
    rows : tuple of dict
        As of :func:`before_data`.
    amplitudes : AmplitudesOfSky or Amplitudes
        Of all of them, about ``expected``; the latter given all data of a joint posterior.
    expected : (n,) array
        In prior standard deviations.
    octaves : (n,) array
        Over which channels share them (:meth:`.Systematic.octaves`).
    names : tuple of str
        Of what may look like a uniform sky: powers and temperatures, and what all errors of gains
        have in common.
    parts : (parts, n) array
        Of the latter one unit vector, since those of single ports and levels look like no sky.
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
        """Of data and their model; None if that has no such unknowns.

        Parameters
        ----------
        experiment : Experiment
        inference : Inference
            Of these data alone.
        """
        held = [s for s in inference.expanded if not isinstance(s.systematic, PointSources)]
        if not held:
            return None
        octaves, alike = [], []
        for part in held:
            systematic, none = part.systematic, ((), np.zeros((0, len(part.expected))))
            over = systematic.octaves(attrgetter(systematic.key)(experiment.scenario))
            octaves.append(np.full(len(part.expected), over))
            alike.append(none if systematic.has_table else systematic.like_the_sky())
        data, columns = experiment.data, np.concatenate([s.columns for s in held], axis=1)
        # of spectra, the sky behind them may be known, but not what the scenario would have drawn
        has_truth = data.truth is not None and data.calibration is None
        rows = before_data(held, true_values(experiment.setup) if has_truth else None)
        return cls(
            tuple(rows.to_dict("records")),
            amplitudes_of_sky(inference.solution, columns),
            np.concatenate([s.expected for s in held]),
            np.concatenate(octaves),
            tuple(name for names, _ in alike for name in names),
            block_diag(*(parts for _, parts in alike)),
            float(np.sqrt(np.asarray(inference.model.prior.variance())[0])),
        )

    @property
    def shared(self) -> Int[np.ndarray, " shared"]:
        """Which of them channels share."""
        return np.flatnonzero(self.octaves)

    @property
    def shared_names(self) -> list[str]:
        """Names of these."""
        return [self.rows[k]["unknown"] for k in self.shared]

    def among(self, tied: Tied) -> list[int]:
        """Their places among all that is tied."""
        return [tied.names.index(name) for name in self.shared_names]

    def _of(self, tied: Tied, number: int) -> Shared:
        root = tied.prior_root[number, self.among(tied)]
        return self.amplitudes.shared(self.shared, self.expected[self.shared], root)

    def whole(self, information: Information, tied: Tied, number: int) -> Information:
        """What these data say of the sky and of what all channels share together.

        Parameters
        ----------
        information : Information
            Of the sky, with the unknowns in N.
        tied : Tied
            The prior of what is shared.
        number : int
            Of the channel among those that are tied.
        """
        return self._of(tied, number).information(information, self.amplitudes.reference)

    def given_all(self, tied: Tied, number: int, mean: Vector, covariance: Square) -> Unknowns:
        """These given all data of a joint posterior.

        Parameters
        ----------
        tied : Tied
            The prior of what is shared.
        number : int
            Of the channel among those that are tied.
        mean, covariance : (modes + w,) and square array
            Of the sky and w, in K and K^2.
        """
        amplitudes = self.amplitudes.with_shared(self._of(tied, number), mean, covariance)
        return replace(self, amplitudes=amplitudes)

    def table(self, mean: Modes, covariance: ModesMatrix) -> pd.DataFrame:
        """All of them with value and std, the sky integrated out; parameters are of the report."""
        return given_data(pd.DataFrame(self.rows), self.amplitudes.integrated(mean, covariance))

    def report(
        self, mean: Modes, covariance: ModesMatrix, *, joint: bool = False
    ) -> UnknownsReport | None:
        """What is told of those that are listed, the sky integrated out; None without any.

        Parameters
        ----------
        mean, covariance : (modes,) and (modes, modes) array
            Posterior of the sky, in K and K^2.
        joint : bool
            It is also that of other data: no null direction is looked for.
        """
        posterior, rows = self.amplitudes.integrated(mean, covariance), self.table(mean, covariance)
        rows = rows[rows["listed"]]
        if rows.empty:
            return None
        null = None if joint else self._null_direction(posterior, float(covariance[0, 0]))
        common = None
        if COMMON_GAIN in self.names:
            gain = self.parts[self.names.index(COMMON_GAIN)]
            common = float(np.sqrt(gain @ posterior.covariance @ gain))
        columns = [*UNKNOWN_COLUMNS, *(["true"] if "true" in rows else [])]
        return UnknownsReport(rows[columns], null, common)

    def instrument(
        self, mean: Modes, covariance: ModesMatrix, pixels: Pixels
    ) -> InstrumentPosterior:
        """Posterior of all of them, and what it does to the map.

        Parameters
        ----------
        mean, covariance : (modes,) and (modes, modes) array
            Posterior of the sky, in K and K^2.
        pixels : (pixels,) array
            Posterior standard deviation of each pixel, in K.
        """
        given, total = self.amplitudes.integrated(mean, covariance), float(np.trace(covariance))
        rows = given_data(pd.DataFrame(self.rows), given)

        correlation = given.covariance / np.outer(given.std, given.std)

        def root(which: Int[np.ndarray, " which"]) -> Float[np.ndarray, "modes kept"]:
            """R of W V^-1 W^T = R R^T."""
            values, axes = np.linalg.eigh(correlation[np.ix_(which, which)])
            kept = values > len(values) * np.finfo(np.float64).eps
            return (given.with_sky / given.std)[:, which] @ (axes[:, kept] / np.sqrt(values[kept]))

        every = root(np.arange(len(rows)))
        kinds = rows.groupby("systematic", sort=False).indices
        parts = {ALL_TOGETHER: every} | {name: root(at) for name, at in kinds.items()}
        moved = (rows["value"] - rows["prior"]) / rows["prior_std"]
        squares = rows.assign(n=1, moved=moved**2, width=given.std**2)
        named = squares.rename(columns={"unknown": "one", "site": "unknown"})
        groups = named.groupby(["systematic", "unknown"], sort=False)
        table = groups.agg({"n": "sum", "moved": "mean", "width": "mean"}).reset_index()
        table[["moved", "width"]] **= 0.5
        single = np.flatnonzero(rows["site"] == rows["unknown"])
        best = np.lexsort((given.std[single], self.octaves[single] == 0))[:MOST_IN_CORNER]
        corner = np.sort(single[best])
        columns = [*UNKNOWN_COLUMNS, *(["true"] if "true" in rows else [])]
        nside = round(np.sqrt(len(pixels) / 12))
        return InstrumentPosterior(
            table,
            rows.loc[corner, columns].reset_index(drop=True),
            {name: float((part**2).sum()) / total for name, part in parts.items()},
            correlation[np.ix_(corner, corner)],
            (pixel_std(every @ every.T, nside) / pixels) ** 2,
        )

    def _null_direction(self, posterior: Amplitudes, variance: float) -> NullDirection:
        mixed = self.parts @ posterior.with_sky[0] / self.sky_std
        inner = self.parts @ posterior.covariance @ self.parts.T
        sky = variance / self.sky_std**2
        blocks = np.block([[np.full((1, 1), sky), mixed[None]], [mixed[:, None], inner]])
        return NullDirection.of((SKY, *self.names), blocks)


def before_data(parts: Sequence[Expanded], truth: Truth | None) -> pd.DataFrame:
    """Unknowns of systematics as their priors have them.

    Parameters
    ----------
    parts : sequence of Expanded
    truth : dict or None
        True values of all systematics; None where they are not known.

    Returns
    -------
    DataFrame
        A row for each: unknown, unit, prior, prior_std, ``expected`` (the prior mean in N),
        ``listed`` (whether it is in the report's table: pointing has one of its own), what it
        belongs to (``systematic``, and ``site``: the ell of errors of fields) and, if known, true.
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
    """The same with value and std, from amplitudes in prior standard deviations."""
    value = table["expected"] + table["prior_std"] * amplitudes.mean
    return table.assign(value=value, std=table["prior_std"] * amplitudes.std)


def _alone(experiment: Experiment, inference: Inference, part: Expanded) -> pd.DataFrame:
    """The table of one systematic."""
    truth = None if experiment.data.truth is None else true_values(experiment.setup)
    return given_data(before_data([part], truth), inference.amplitudes(part))


# offsets that are tested whatever the scenario says, and how far apart the two sides of their
# derivative are; longitude and latitude do what clock and lean do
TESTED = {"clock_s": 10.0, "turntable_deg": 0.1, "tilt_east_deg": 0.1, "tilt_north_deg": 0.1}
# more days than that are taken together in groups of equal length
MOST_STRETCHES = 31
# what is left beyond first order may be that much of the radiometer noise, rms
NEGLIGIBLE = 0.1


@dataclass(frozen=True)
class PointingReport:
    """What a map tells of clock and pointing.

    Attributes
    ----------
    offsets : DataFrame or None
        A row for each offset that the model has: value, std, prior_std, beyond_first_order (rms,
        in radiometer noise) and, if known, true. None if it has none.
    preferred : DataFrame
        What the data prefer besides, of each offset for all days and for each: a row with offset,
        first_day and last_day (-1 for all), value, std and chi2_gain.
    """

    offsets: pd.DataFrame | None
    preferred: pd.DataFrame

    def given(self, unknowns: pd.DataFrame) -> PointingReport:
        """The same with the value and std of each offset that a table of unknowns has."""
        unknowns, table = unknowns.set_index("unknown"), self.offsets
        columns = {name: table["offset"].map(unknowns[name]) for name in ("value", "std")}
        return replace(self, offsets=table.assign(**columns))

    def lines(self) -> list[str]:
        """One line for every offset."""
        lines = []
        for row in [] if self.offsets is None else self.offsets.to_dict("records"):
            left = row["beyond_first_order"]
            text = f"{_line(row['offset'], row)}; beyond first order: {left:.1g} of the noise"
            if left > NEGLIGIBLE:
                text += ", too much: set noise.pointing.treatment=sampled"
            lines.append(text)
        return lines


def pointing_report(experiment: Experiment, inference: Inference) -> PointingReport:
    """Work out the offsets of the model, and those that the data prefer besides.

    Parameters
    ----------
    experiment : Experiment
    inference : Inference
        Of these data alone.
    """
    table = None if inference.offsets is None else _table(experiment, inference)
    values = {} if table is None else dict(zip(table["offset"], table["value"], strict=True))
    return PointingReport(table, _preferred(experiment, inference, values))


def _table(experiment: Experiment, inference: Inference) -> pd.DataFrame:
    table = _alone(experiment, inference, inference.offsets)
    shares = np.asarray(table["std"] / table["prior_std"])  # what is left of the offsets
    noise = np.sqrt(np.asarray(radiometer(experiment.setup).diagonal()))
    model = base_model(experiment.setup)
    left = inference.offsets.systematic.beyond_first_order(model, inference.posterior.mean, shares)
    beyond = [float(np.sqrt(np.mean((left[name] / noise) ** 2))) for name in table["unknown"]]
    table = table.assign(beyond_first_order=beyond).rename(columns={"unknown": "offset"})
    columns = ["offset", "value", "std", "prior_std", "beyond_first_order", "true"]
    return table[[name for name in columns if name in table]]


def _preferred(experiment: Experiment, result: Inference, values: dict[str, float]) -> pd.DataFrame:
    setup, data, sky = experiment.setup, experiment.data, result.posterior.mean
    n_runs = setup.observation.n_runs
    steps = {name: step for kind, step in TESTED.items() for name in offset_names((kind,), n_runs)}
    centre = dict.fromkeys(steps, 0.0) | values
    offsets = PointingOffsets.of(shifted(setup, centre), steps, centre)
    expanded = Expanded.at(offsets, base_model(setup), Around(sky=sky, values=centre))
    per_unit = np.asarray(expanded.columns) / offsets.stds
    day = setup.observation.day
    length = -(-(int(day.max()) + 1) // MOST_STRETCHES)
    stretches = [(-1, -1, np.ones(len(day), dtype=bool))]
    for first in (np.unique(day // length) * length).tolist():
        stretches.append((first, first + length - 1, day // length * length == first))
    rows, columns = [], []
    for name, template in zip(steps, per_unit.T, strict=True):
        for first, last, times in stretches:
            column = np.where(times[data.layout.time], template, 0.0)
            if first < 0 or column.any():
                rows.append((name, first, last))
                columns.append(column)
    preferred = preferences(result.solution, np.stack(columns, axis=1))
    table = pd.DataFrame(rows, columns=["offset", "first_day", "last_day"])
    return table.assign(value=preferred.amplitude, std=preferred.std, chi2_gain=preferred.gain)


def flux_table(experiment: Experiment, inference: Inference) -> pd.DataFrame:
    """Posterior of every source's flux in Jy and in K sr, with its prior and, if known, its truth.

    Parameters
    ----------
    experiment : Experiment
        With sources that are not ignored.
    inference : Inference
        Of these data alone.

    Returns
    -------
    DataFrame
        A row for each source, or block of it. ``above_horizon``: whether it is ever up; if not,
        its flux is known from the prior only.
    """
    held = next(s for s in inference.expanded if isinstance(s.systematic, PointSources))
    fluxes = _alone(experiment, inference, held)
    jansky = 1.0 / kelvin_steradian(1.0, experiment.scenario.frequency_mhz)
    sources = held.systematic.sources
    blocks = [(s.name, block, bool(up)) for s in sources for block, up in enumerate(s.seen())]
    table = pd.DataFrame(blocks, columns=["source", "block", "above_horizon"]).assign(
        flux_jy=fluxes["value"] * jansky,
        std_jy=fluxes["std"] * jansky,
        flux_k_sr=fluxes["value"],
        std_k_sr=fluxes["std"],
        prior_jy=fluxes["prior"] * jansky,
        prior_std_jy=fluxes["prior_std"] * jansky,
    )
    return table.assign(true_jy=fluxes["true"] * jansky) if "true" in fluxes else table


def flux_lines(fluxes: pd.DataFrame) -> list[str]:
    """One line for every source, or block of it."""
    lines = []
    for row in fluxes.to_dict("records"):
        name = row["source"] if row["block"] == 0 else f"{row['source']} ({row['block']})"
        text = f"{name}: {row['flux_jy']:.4g} +- {row['std_jy']:.2g} Jy"
        if not row["above_horizon"]:
            text += " (prior: never above the horizon)"
        lines.append(text)
    return lines
