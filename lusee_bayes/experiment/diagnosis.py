"""Usual mistakes in data and model: which of them would make the data fit.

If no sky explains the data, we undo each of the usual mistakes in turn. The residual chi^2 under a
prior wide enough for any sky (:mod:`lusee_bayes.judge.chi2`) shows whether the data would then fit.
To undo a mistake in the data, we mix the products of every time. To undo one in the model, we use
other beams, or another observation with other times, angles or another site.

All changes of data that mix the products of each time are tried at once: d' = sum_jk W_jk x_jk,
where x_jk has product k in the place of product j. Let K be the covariance of the data under a
prior that allows any sky, and b the model without a sky. Then ::

    chi^2(W) = (X w - b)^T K^-1 (X w - b) = (w, -1)^T Q (w, -1),    Q = (X, b)^T K^-1 (X, b).

Given Q, exchanges, signs and reversals cost nothing; factors and constants are solved for.

Each change of the model needs another normal matrix, so these are first compared up to
``SCREENED_LMAX``. The best of both kinds are computed at the scenario's lmax, with N for the data.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from lusee_bayes.core.arrays import Ells, Grid, Square
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.harmonics import lmax_of, mean_over_m, mode_numbers, n_modes, turn_about_z
from lusee_bayes.core.linalg import solve_lower
from lusee_bayes.experiment.model import full_model, moved
from lusee_bayes.experiment.rounds import Inference, as_expected
from lusee_bayes.experiment.scenario import load_scenario
from lusee_bayes.instrument.beams.fields import ProductBeams
from lusee_bayes.instrument.coupling import Coupling, CouplingMatrix
from lusee_bayes.instrument.observation import Observation
from lusee_bayes.instrument.pointing import Pointing, offset_kind, offset_names, with_offsets
from lusee_bayes.instrument.products import all_products, auto_indices, interpolated, ports
from lusee_bayes.instrument.visibilities import Visibilities
from lusee_bayes.judge.chi2 import ChiSquare, stands_out
from lusee_bayes.judge.residuals import Residuals
from lusee_bayes.judge.split import WIDER, beside_any_sky
from lusee_bayes.linear.linear_gaussian import FromInformation, LinearGaussian, Solution
from lusee_bayes.sky.prior import HarmonicPrior
from lusee_bayes.systematics.context import Around, Setup
from lusee_bayes.systematics.noise_level import NoiseLevel
from lusee_bayes.systematics.registered import SYSTEMATICS

# recurring array types
Products = Float[np.ndarray, " products"]
Columns = Float[np.ndarray, " columns"]
Mixing = Float[np.ndarray, "products products"]

# mistakes in the clock, and the seconds to add to the times
CLOCKS = {
    "the times are TT or TDB, not UTC": -69.184,
    "the times are TAI, not UTC": -37.0,
    "the times are an hour early": 3600.0,
    "the times are an hour late": -3600.0,
    "the times are a day early": 86400.0,
    "the times are a day late": -86400.0,
}


class DataMistake(NamedTuple):
    """A mistake in the data.

    Attributes
    ----------
    words, remedy : str
        The mistake, and the remedy.
    w : (columns,) array
        As in the module's equations, including b: turns the wrong data into the right ones.
    time : int or None
        The only wrong time; None for all times.
    """

    words: str
    remedy: str
    w: Columns
    time: int | None = None

    def undone(self, grid: Grid) -> Grid:
        """The visibilities without the mistake, in K."""
        n = len(grid)
        mixing, constant, (turned, _) = np.split(self.w, [n * n, n * n + n])
        right = mixing.reshape(n, n) @ grid + constant[:, None] + turned * grid[:, ::-1]
        if self.time is None:
            return right
        return np.where(np.arange(grid.shape[1]) == self.time, right, grid)


class ModelMistake(NamedTuple):
    """A mistake in the model: the mistake, the remedy, and beams and observation without it."""

    words: str
    remedy: str
    beams: ProductBeams
    observation: Observation


def weights(mixing: Mixing, *, reversed_times: bool = False, b: float = -1.0) -> Columns:
    """(w, -1) of a mixing without a constant; with ``b`` = 0, a change to such a vector."""
    return np.concatenate([mixing.ravel(), np.zeros(len(mixing)), [float(reversed_times), b]])


def port_mixing(numbers: Sequence[int], signs: Sequence[float] | None = None) -> Mixing:
    """The mixing that restores the products of ports 0, 1, ... in data with other port numbers.

    Parameters
    ----------
    numbers : sequence of int
        Number of each port in the data.
    signs : sequence of float, optional
        Sign of each port's voltage in the data.
    """
    products, signs = all_products(len(numbers)), signs or np.ones(len(numbers))
    place = {tuple(product): k for k, product in enumerate(products)}
    mixing = np.zeros((len(products), len(products)))
    for row, (a, b, part) in enumerate(products):
        i, j = numbers[a], numbers[b]
        conjugated = -1.0 if part == "I" and i > j else 1.0
        mixing[row, place[min(i, j), max(i, j), part]] = conjugated * signs[a] * signs[b]
    return mixing


def data_mistakes(n_ports: int) -> Iterator[tuple[str, str, Mixing]]:
    """Conjugation, signs and exchanges: the mistake, the remedy and the mixing of products."""
    products, numbers = all_products(n_ports), range(n_ports)
    first, second, imaginary = ports(n_ports)
    wrong = "the data are conjugated: the imaginary parts have the wrong sign"
    remedy = "change their sign (from_arrays: convention='conj(s_i) s_j')"
    yield wrong, remedy, np.diag(np.where(imaginary, -1.0, 1.0))
    wrong = "all crosses have the wrong sign"
    yield wrong, "change their sign", np.diag(np.where(first != second, -1.0, 1.0))
    for size in range(1, n_ports // 2 + 1):
        for flipped in combinations(numbers, size):
            if 2 * size == n_ports and 0 not in flipped:  # the same as flipping the others
                continue
            named = " and ".join(map(str, flipped))
            wrong = f"the voltages of port {named} have the wrong sign"
            remedy = f"change the sign of all crosses of port {named} with other ports"
            signs = [-1.0 if port in flipped else 1.0 for port in numbers]
            yield wrong, remedy, port_mixing(numbers, signs)
    for i, j in combinations(numbers, 2):
        wrong = f"ports {i} and {j} are exchanged"
        remedy = f"exchange ports {i} and {j} of the data"
        yield wrong, remedy, port_mixing([{i: j, j: i}.get(port, port) for port in numbers])
    for turn in range(1, n_ports):
        wrong = f"the ports are rotated by {turn}: the model's port 0 is the data's port {turn}"
        turned = port_mixing([(port + turn) % n_ports for port in numbers])
        yield wrong, "number the ports of the data like those of the beams", turned
    for k in np.flatnonzero(first != second):
        signs = 1.0 - 2.0 * (np.arange(len(products)) == k)
        yield f"product {products[k].label} has the wrong sign", "change its sign", np.diag(signs)
    for i, j in combinations(range(len(products)), 2):
        order = np.arange(len(products))
        order[[i, j]] = j, i
        named = f"{products[i].label} and {products[j].label}"
        mixing = np.eye(len(products))[order]
        yield f"products {named} are exchanged", f"exchange {named} of the data", mixing


def model_mistakes(setup: Setup) -> Iterator[ModelMistake]:
    """Angles, azimuths, clocks, the site's signs, and neighbouring channels."""
    observation, beams = setup.observation, setup.beams
    turntables = offset_names(("turntable_deg",), observation.n_runs)
    angles = dict(zip(turntables, observation.turntable_deg, strict=True))
    offsets: list[tuple[str, str, dict[str, float]]] = []
    for turn in (90.0, 180.0, 270.0):
        wrong = f"the array is rotated by {turn:g} degrees from East towards North"
        remedy = f"use --set beam.turntable_offset_deg={turn:g}"
        offsets.append((wrong, remedy, dict.fromkeys(turntables, turn)))
    if any(angles.values()):
        wrong = "the turntable's angles have the wrong sign"
        opposite = {name: -2.0 * angle for name, angle in angles.items()}
        offsets.append((wrong, "count them from East towards North", opposite))
    half = observation.step_s / 2.0
    starts = {"the times are starts of samples": half, "the times are ends of samples": -half}
    for wrong, seconds in (CLOCKS | starts).items():
        offsets.append((wrong, f"add {seconds:g} s to the times", {"clock_s": seconds}))
    for name, key in (("latitude", "lat_deg"), ("longitude", "lon_deg")):
        value = getattr(observation, key)
        remedy = f"use --set observation.{key}={-value:g}"
        offsets.append((f"the site's {name} has the wrong sign", remedy, {key: -2.0 * value}))
    for wrong, remedy, values in offsets:
        yield ModelMistake(wrong, remedy, beams, with_offsets(observation, values))
    _, m = mode_numbers(beams.lmax)
    mirrored = np.asarray(beams.modes) * np.where(m < 0, -1.0, 1.0)
    clockwise = np.asarray(turn_about_z(mirrored, np.pi / 2.0))
    for how, modes in {"mirrored": mirrored, "counted from North towards East": clockwise}.items():
        wrong, remedy = f"the azimuth of the beams is {how}", "count it from East towards North"
        yield ModelMistake(wrong, remedy, replace(beams, modes=modes), observation)
    width = setup.scenario.noise.radiometer.bandwidth_hz / 1e6
    for frequency in (beams.frequency_mhz - width, beams.frequency_mhz + width):
        try:
            other = setup.beam_source.beams(frequency, beams.lmax)
        except InputError:  # the source has no beams at this frequency
            continue
        wrong = f"the data are from the neighbouring channel, {frequency:g} MHz"
        yield ModelMistake(wrong, f"use --set frequency_mhz={frequency:g}", other, observation)


@dataclass(frozen=True)
class UnderAnySky:
    """Data, and the model and wide prior for their residual chi^2.

    Attributes
    ----------
    setup : Setup
    around : Around
        The data, and the expansion point of the model.
    model : LinearGaussian
        Model of these data.
    spectrum : (ells,) array
        C_ell of the wide prior, in K^2.
    """

    setup: Setup
    around: Around
    model: LinearGaussian
    spectrum: Ells

    @classmethod
    def of(cls, setup: Setup, around: Around, model: LinearGaussian | None = None) -> UnderAnySky:
        """Choose a prior that allows any sky as bright as the data suggest."""
        model = model or full_model(setup, around)
        prior = setup.prior if setup.family is None else setup.family.expected()
        power = np.asarray(prior.variance() + prior.colour(prior.white_mean) ** 2)
        autos = auto_indices(setup.beam_source.n_ports)
        modelled = float(np.median(np.asarray(setup.signal)[autos]))
        seen = np.asarray(around.data.grid())[autos]
        brighter = np.nanmedian(np.append(seen, modelled)) / modelled
        return cls(setup, around, model, mean_over_m(power) * (WIDER * np.fmax(1.0, brighter)) ** 2)

    def wide(self, coupling: Coupling) -> tuple[ChiSquare, Solution]:
        """Residual chi^2, and the solution under the wide prior."""
        n_ells = lmax_of(coupling.shape[1]) + 1
        more = max(0, n_ells - len(self.spectrum))
        spectrum = np.pad(self.spectrum, (0, more), mode="edge")[:n_ells]
        model = replace(self.model, coupling=coupling, prior=HarmonicPrior(spectrum))
        solution = model.condition(np.asarray(self.around.data.data), FromInformation)
        return beside_any_sky(solution.chi2, solution.posterior, model.n_data), solution

    def under(self, beams: ProductBeams, observation: Observation, pointing: Pointing) -> ChiSquare:
        """Residual chi^2 with other beams or another observation.

        ``pointing`` belongs to the data's own observation, and sets lmax.
        """
        lmax = len(pointing.pole_from_galactic.blocks) - 1
        same = (observation.times == self.setup.observation.times).all()
        pointing = pointing.placed(observation) if same else Pointing.of(observation, lmax)
        hidden = 0.0 if self.setup.hidden is None else self.setup.hidden
        modes = (np.asarray(beams.modes) + hidden)[..., : n_modes(lmax)]
        return self.wide(CouplingMatrix.of_modes(modes, pointing, self.around.data.layout))[0]

    def without(self, mistake: DataMistake) -> ChiSquare:
        """Residual chi^2 of the data without a mistake, with N rebuilt for them."""
        data, layout = self.around.data, self.around.data.layout
        undone = mistake.undone(interpolated(data.grid()))
        data = replace(data, data=np.asarray(layout.gather(undone)))
        try:
            around = replace(self.around, data=data, visibilities=None, gains=None)
            model = full_model(self.setup, around)
        except InputError:  # undoing it makes some auto negative or zero
            return ChiSquare(np.inf, float(layout.size))
        return replace(self, around=around, model=model).wide(model.coupling)[0]


# number of times to try one by one, the worst first
TIMES = 32


@dataclass(frozen=True)
class MixedProducts:
    """Q of the module's equations for some data.

    judge : UnderAnySky; solution : under the wide prior; grid : (products, times) array, in K; q :
    (columns, columns) array, for every x_jk, ones in every product, the reversed times, and b
    """

    judge: UnderAnySky
    solution: Solution
    grid: Grid
    q: Float[np.ndarray, "columns columns"]

    @classmethod
    def of(cls, judge: UnderAnySky, solution: Solution) -> MixedProducts:
        """Compute Q from data and their solution under the wide prior."""
        data, offset = judge.around.data, judge.model.offset
        grid, layout = interpolated(data.grid()), data.layout
        n, product, time = len(grid), layout.product, layout.time
        mixed = np.zeros((layout.size, n, n))
        mixed[np.arange(layout.size), product] = grid[:, time].T
        steady = np.zeros(layout.size) if offset is None else np.asarray(offset)
        columns = [mixed.reshape(layout.size, -1), np.eye(n)[product]]
        columns += [np.stack([grid[:, ::-1][product, time], steady], axis=1)]
        return cls(judge, solution, grid, _gram(solution, np.concatenate(columns, axis=1)))

    def tried(self) -> Iterator[tuple[float, DataMistake]]:
        """Yield every mistake in the data with its chi^2."""
        n_ports, n = self.judge.setup.beam_source.n_ports, len(self.grid)
        first, second, _ = ports(n_ports)
        autos = first == second
        names = [f"product {product.label}" for product in all_products(n_ports)]
        some = np.asarray(self.judge.around.data.layout.present).any(1)

        def apart(which: Products) -> bool:
            """Whether it changes some, but not all, of the data: a factor of all is the sky's."""
            return bool(0 < np.count_nonzero(which[some]) < some.sum())

        factors = [*zip(names, np.eye(n), strict=True), ("every auto", autos * 1.0)]
        mistakes = [self._factor(*one) for one in factors if apart(one[1])]
        gains = [(k, 1.0 * (first == k) + (second == k)) for k in range(n_ports)]
        mistakes += [self._gain(*one) for one in gains if apart(one[1])]
        if (autos & some).any():
            mistakes.append(self._constant(np.flatnonzero(autos & some)))
        yield from ((self.chi2(mistake.w), mistake) for mistake in mistakes)
        yield from self.plain()

    def plain(self) -> Iterator[tuple[float, DataMistake]]:
        """Exchanges, signs, reversals and wrong times: mistakes unlike any instrument."""
        n_ports, n = self.judge.setup.beam_source.n_ports, len(self.grid)
        mistakes = [DataMistake(*one, weights(mixing)) for *one, mixing in data_mistakes(n_ports)]
        turned = weights(np.zeros((n, n)), reversed_times=True)
        mistakes.append(DataMistake("the times are reversed", "sort the data by time", turned))
        yield from ((self.chi2(mistake.w), mistake) for mistake in mistakes)
        yield from self._times()

    def explains(self, base: ChiSquare) -> bool:
        """Whether one of these explains most of a large misfit."""
        most, (chi2, mistake) = PROMISING * base.chi2, min(self.plain(), key=lambda one: one[0])
        return bool(chi2 < most and self.judge.without(mistake).chi2 < most)

    def chi2(self, w: Columns) -> float:
        """chi^2 of (w, -1)."""
        return float(w @ self.q @ w)

    def _factor(self, name: str, which: Products) -> DataMistake:
        """A factor of some products: chi^2 is a parabola in the missing part."""
        whole, step = weights(np.eye(len(which))), weights(np.diag(which), b=0.0)
        curvature = self.chi2(step)
        missing = -float(step @ self.q @ whole) / curvature
        factor = _number(1.0 / (1.0 + missing), curvature**-0.5)
        wrong = f"{name} is {factor} times the prediction from the others"
        return DataMistake(wrong, f"check the calibration of {name}", whole + missing * step)

    def _gain(self, port: int, powers: Products) -> DataMistake:
        """A gain of a port's voltage, squared in its auto: chi^2 is a quartic in the gain."""
        parts = [weights(np.diag((powers == k) * 1.0), b=-1.0 * (k == 0)) for k in range(3)]
        gram = np.array([[u @ self.q @ v for v in parts] for u in parts])
        powers_of_gain = [np.trace(gram[:, ::-1], offset=2 - order) for order in range(5)]
        chi2 = np.polynomial.Polynomial(powers_of_gain)
        roots = chi2.deriv().roots()
        real = roots.real[np.abs(roots.imag) <= 1e-6 * np.abs(roots.real)]
        gain = real[np.argmin(chi2(real))]
        wrong = f"port {port}'s voltage is {1.0 / gain:.5g} times the prediction from the others"
        remedy = f"check the calibration of port {port}"
        return DataMistake(wrong, remedy, weights(np.diag(gain**powers)))

    def _constant(self, autos: Int[np.ndarray, " autos"]) -> DataMistake:
        """A constant in every auto."""
        n = len(self.grid)
        whole, places = weights(np.eye(n)), n * n + autos
        level = np.linalg.solve(self.q[np.ix_(places, places)], self.q[places] @ whole)
        whole[places] -= level
        named = ", ".join(f"{x:.4g}" for x in level)
        wrong = f"the autos contain a constant of {named} K besides the sky"
        return DataMistake(wrong, "give noise.receiver, or subtract it", whole)

    def _times(self) -> Iterator[tuple[float, DataMistake]]:
        """A factor of all products at one time, for each of the worst times."""
        layout, values = (data := self.judge.around.data).layout, self.solution.data
        left = self.solution.weighted_residual()  # K^-1 (d - b)
        variance = np.asarray(self.solution.model.noise.diagonal())
        pull = np.bincount(layout.time, values * left, layout.n_times)
        most = np.bincount(layout.time, values**2 / variance, layout.n_times)
        worst = np.argsort(-(pull**2) / np.where(most > 0.0, most, np.inf))[:TIMES]
        worst = worst[most[worst] > 0.0]
        columns = np.where(layout.time[:, None] == worst, values[:, None], 0.0)
        curvature = np.diagonal(_gram(self.solution, columns))
        whole = weights(np.eye(len(self.grid)))
        for time, bend in zip(worst.tolist(), curvature.tolist(), strict=True):
            if not bend > 0.0:  # other times do not predict this one
                continue
            factor, when = 1.0 - pull[time] / bend, data.observation.times[time].isot[:19]
            times = _number(1.0 / factor, bend**-0.5)
            wrong = f"all products at {when} are {times} times the prediction from other times"
            right = weights(factor * np.eye(len(self.grid)))
            mistake = DataMistake(wrong, "flag this time", right, time)
            yield self.chi2(whole) - pull[time] ** 2 / bend, mistake


def _number(factor: float, std: float) -> str:
    """A factor with the error of its inverse."""
    return f"{factor:.5g} +- {std * factor**2:.1g}"


def _gram(solution: Solution, columns: Float[np.ndarray, "data n"]) -> Square:
    """X^T K^-1 X with K^-1 = N^-1 - N^-1 A C A^T N^-1."""
    solved = np.asarray(solution.factor.solve(columns))
    seen = np.asarray(solution.model.coupling.transpose_mv(solved)).T
    white = np.asarray(solution.model.prior.colour_columns(seen)).T
    half = solve_lower(solution.posterior.lower, white, transpose=False)
    return columns.T @ solved - half.T @ half


# highest ell when comparing changes of the model
SCREENED_LMAX = 12
# number of the best mistakes, in data and in model, to compute at the scenario's lmax; those in the
# data only if less than this fraction of the excess chi^2 remains
TRIED, PROMISING = 3, 0.1
# if nothing makes the data fit, list mistakes that leave less than this fraction of the excess, or
# less than PROMISING if a plain mistake does
EXPLAINED = 0.03
# a smaller chi^2 per degree of freedom means that without the mistake N would be far too large
LEAST = 0.5
# any mistake must reduce chi^2, or its excess, by more than this number of standard deviations, and
# is listed if it reduces it by more than this fraction of the best one's, and of what fields absorb
SIGNIFICANT, COMPARABLE = 15.0, 0.5
# mistakes are indistinguishable for these antennas if their chi^2 differ by less, relative
SAME = 1e-5
# ells to add to lmax
BEYOND, MORE_ELLS = "the sky has structure beyond lmax", 8
# offsets to solve for, and decreasing steps in degrees to either side
OFFSETS, REACHES = ("turntable_deg", "tilt_east_deg", "tilt_north_deg"), (4.0, 0.5)
# limit on the sum of products of neighbouring times, in standard deviations for white noise; what
# sky and instrument absorb leaves a negative one
WHITE = 5.0


@dataclass(frozen=True)
class Proposal:
    """A usual mistake that would explain the data.

    Attributes
    ----------
    words, remedy : str
        The mistake, and the remedy.
    chi2 : ChiSquare
        Residual chi^2 of the data without the mistake.
    of_noise : bool
        Whether N is the mistake.
    """

    words: str
    remedy: str
    chi2: ChiSquare
    of_noise: bool = False

    def gained(self, before: ChiSquare) -> float:
        """By how much chi^2 is smaller without the mistake or, with another N, closer to its mean.

        In standard deviations.
        """
        free, now = max(before.degrees - self.chi2.degrees, 1.0), self.chi2.chi2
        closer = abs(before.chi2 - before.degrees) - abs(now - self.chi2.degrees)
        return (closer if self.of_noise else before.chi2 - now) / (2.0 * free) ** 0.5

    def suffices(self, before: ChiSquare) -> bool:
        """Whether chi^2 fits without the mistake, and much better than before."""
        return self.explains and self.gained(before) > SIGNIFICANT

    @property
    def explains(self) -> bool:
        """Whether chi^2 fits, or is smaller, e.g. for simulations without what N allows for."""
        return self.chi2.fits or LEAST * self.chi2.degrees < self.chi2.chi2 < self.chi2.degrees


@dataclass(frozen=True)
class Diagnosis:
    """The usual mistakes that would explain data.

    Attributes
    ----------
    chi2 : ChiSquare
        Residual chi^2 of the data as they are.
    proposals : tuple of Proposal
        The best first: mistakes without which the data fit or, if there are none, those that
        explain nearly all of the excess chi^2.
    n_tried : int
        Number of mistakes tried.
    absent : tuple of str
        Systematics that the model does not have.
    """

    chi2: ChiSquare
    proposals: tuple[Proposal, ...]
    n_tried: int
    absent: tuple[str, ...] = ()

    @property
    def is_truncation(self) -> bool:
        """Whether structure of the sky beyond lmax explains the misfit."""
        return any(BEYOND in one.words and one.chi2.fits for one in self.proposals)

    def sentences(self) -> list[str]:
        """The proposals, one sentence each; or one sentence if there are none."""
        if not self.proposals and self.chi2.fits:
            return [f"As a whole, the data fit without assuming a mistake ({self.chi2.words()})."]
        if not self.proposals:
            others = f" The model has no {', '.join(self.absent)}: try them." if self.absent else ""
            return [f"None of the {self.n_tried} usual mistakes explains the misfit.{others}"]
        first = f"Explains most of chi2 {self.chi2.chi2:.4g} of the instrument as expected"
        first = "Did you mean" if self.proposals[0].explains else first
        return [f"{first}:"] + [
            f"({number}) {one.words}: {one.remedy} ({one.chi2.words()})."
            for number, one in enumerate(self.proposals, 1)
        ]


def is_mistaken(setup: Setup, start: Around) -> bool:
    """Whether a plain mistake in the data explains most of a large misfit.

    Tested with the instrument at the values of ``start``: others could absorb a mistake.
    """
    judge = UnderAnySky.of(as_expected(moved(setup, start.values)), Around(start.data))
    base, solution = judge.wide(judge.model.coupling)
    return PROMISING * base.chi2 > base.degrees and MixedProducts.of(judge, solution).explains(base)


def diagnose(setup: Setup, inference: Inference, residuals: Residuals) -> Diagnosis:
    """Try the usual mistakes on data.

    Parameters
    ----------
    setup : Setup
    inference : Inference
        Inference from these data alone.
    residuals : Residuals
        Residuals of the map.

    Returns
    -------
    Diagnosis
        With the instrument as expected if this explains a misfit: unknowns absorb part of it.
    """
    if inference.moving and residuals.level() == "does not fit":
        judge = UnderAnySky.of(as_expected(setup), Around(inference.around.data))
        if (found := _tried(judge, residuals)).proposals:
            return found
    judge = UnderAnySky.of(setup, inference.around, inference.model)
    return _tried(judge, residuals, inference.unused())


def _tried(judge: UnderAnySky, residuals: Residuals, unused: float = 0.0) -> Diagnosis:
    """Try the usual mistakes on data under a model whose unknowns leave some degrees unused."""
    setup, data = judge.setup, judge.around.data
    base, solution = judge.wide(judge.model.coupling)
    fits = base.allowing(unused).fits

    def best(tried: Sequence[tuple[float, object]], most: float) -> list:
        """The mistakes with the smallest chi^2, below ``most``."""
        better = sorted((one for one in tried if one[0] < most), key=lambda one: one[0])
        return [one for _, one in better[:TRIED]]

    of_data = list((mixed := MixedProducts.of(judge, solution)).tried())
    promising = base.degrees + PROMISING * abs(base.chi2 - base.degrees)
    proposals = [Proposal(m.words, m.remedy, judge.without(m)) for m in best(of_data, promising)]
    low = Pointing.of(setup.observation, min(SCREENED_LMAX, setup.scenario.lmax))
    # with the instrument that was found
    placed = moved(setup, judge.around.values)
    mistakes = list(model_mistakes(placed))
    screened = [judge.under(m.beams, m.observation, low).chi2 for m in mistakes]
    # at low lmax, sky structure above it remains in the residuals
    whole = judge.under(placed.beams, placed.observation, low).chi2
    of_model = [*zip(screened, mistakes, strict=True), *_offsets(judge, placed, low)]
    proposals += [
        Proposal(m.words, m.remedy, judge.under(m.beams, m.observation, setup.pointing))
        for m in best(of_model, whole)
    ]
    excess = (PROMISING if mixed.explains(base) else EXPLAINED) * abs(base.chi2 - base.degrees)
    nearly = [p for p in proposals if 0.0 <= p.chi2.chi2 - p.chi2.degrees < excess]
    others = list(_noise_of(judge, "exact"))
    suffice = [one for one in (*proposals, *others) if one.suffices(base)]
    # these always absorb part of any misfit, and count only if they absorb all of it
    for absorbing in _finer(judge), _noise_level(residuals, data), _noise_of(judge, "paper"):
        if not (suffice or fits):
            others += (last := list(absorbing))
            suffice = [one for one in last if one.suffices(base)]
    listed = suffice or ([] if fits else nearly)
    # in data that fit, what unknown errors of the fields explain
    absorbed = fits * (base.chi2 - base.degrees + unused) / 2.0**0.5
    most = max((absorbed, *(one.gained(base) for one in listed)))
    better = [one for one in listed if one.gained(base) > COMPARABLE * most]
    better = [replace(one, chi2=one.chi2.allowing(unused)) for one in better]
    better = sorted(better, key=lambda one: (-one.chi2.p, one.chi2.chi2))
    n_tried = len(of_data) + len(of_model) + len(others)
    treatments = {cls.key: cls.treatment(setup.scenario) for cls in SYSTEMATICS}
    absent = [key for key, treatment in treatments.items() if treatment in (None, "ignored")]
    absent = tuple(k for k in absent if k.startswith("noise.") and k != NoiseLevel.key)
    return Diagnosis(base.allowing(unused), tuple(_merged(better)), n_tried, absent)


def _noise_of(judge: UnderAnySky, form: str) -> Iterator[Proposal]:
    """Correlate the products in the noise as a radiometer does (exact), or as the paper, not."""
    scenario = judge.setup.scenario
    if scenario.noise.radiometer.form != form:
        scenario = load_scenario(scenario, [f"noise.radiometer.form={form}"])
        model = full_model(replace(judge.setup, scenario=scenario), judge.around)
        chi2 = replace(judge, model=model).wide(model.coupling)[0]
        how = {"exact": "correlated", "paper": "independent, as in some simulations"}[form]
        words = f"the noise of the products is {how}"
        yield Proposal(words, f"use --set noise.radiometer.form={form}", chi2, True)


def _merged(proposals: list[Proposal]) -> Iterator[Proposal]:
    """Merge proposals with equal chi^2, which identical antennas cannot distinguish."""
    while proposals:
        first, *others = proposals
        alike = [p for p in others if abs(p.chi2.chi2 - first.chi2.chi2) < SAME * first.chi2.chi2]
        proposals = [p for p in others if p not in alike]
        yield replace(first, words=", or ".join(p.words for p in (first, *alike)))


def _finer(judge: UnderAnySky) -> Iterator[Proposal]:
    """Try a map with a larger lmax."""
    setup, lmax = judge.setup, judge.setup.scenario.lmax + MORE_ELLS
    if setup.hidden is not None:  # what the terrain hides is known up to lmax
        return
    try:
        beams = setup.beam_source.beams(setup.scenario.frequency_mhz, lmax)
    except InputError:  # the beams of a file end at a lower ell
        return
    chi2 = judge.under(beams, setup.observation, Pointing.of(setup.observation, lmax))
    yield Proposal(BEYOND, f"use --set lmax={lmax}", chi2)


def _offsets(
    judge: UnderAnySky, setup: Setup, low: Pointing
) -> Iterator[tuple[float, ModelMistake]]:
    """Best-fitting offsets of angles, from parabolas through three ever closer values."""
    for name in offset_names(OFFSETS, setup.observation.n_runs):

        def shifted(value: float, name: str = name) -> Observation:
            return with_offsets(setup.observation, {name: value})

        value, chi2 = 0.0, np.inf
        for reach in REACHES:
            values = value + reach * np.array([-1.0, 0.0, 1.0])
            seen = [judge.under(setup.beams, shifted(v), low).chi2 for v in values]
            if (curvature := seen[0] - 2.0 * seen[1] + seen[2]) > 0.0:
                value += reach * np.clip(0.5 * (seen[0] - seen[2]) / curvature, -3.0, 3.0)
            chi2 = min(seen)
        section, kind = setup.scenario.noise.pointing, offset_kind(name)
        remedy = f"give noise.pointing.{kind}"
        if section is not None and kind in section.kinds:
            remedy = f"widen its prior, noise.pointing.{kind}, or set treatment=sampled"
            if section.treatment == "ignored":
                remedy = "set noise.pointing.treatment=marginalised"
        words = f"{name} is off by {value:.3g}"
        yield chi2, ModelMistake(words, remedy, setup.beams, shifted(value))


def _noise_level(residuals: Residuals, data: Visibilities) -> Iterator[Proposal]:
    """Another noise level, if residuals are alike in all groups, and do not persist in time."""
    whole, groups = residuals.split.instrument, [g for g in residuals.compared() if g.degrees > 1.0]
    factor = whole.chi2 / whole.degrees
    if not groups or whole.fits or not factor > 0.0:
        return
    least = min(ChiSquare(group.chi2 / factor, group.degrees).p for group in groups)
    z = np.where(data.layout.present, data.layout.scatter(residuals.z), np.nan) / np.sqrt(factor)
    pairs = (z[:, 1:] * z[:, :-1])[np.isfinite(z[:, 1:] * z[:, :-1])]
    if stands_out(least, len(groups)) or pairs.sum() > WHITE * np.sqrt(len(pairs)):
        return
    words = f"the noise variance is {factor:.3g} times the assumed one"
    remedy = f"multiply noise.radiometer.factor by {factor:.3g}"
    yield Proposal(words, remedy, ChiSquare(whole.degrees, whole.degrees), of_noise=True)
