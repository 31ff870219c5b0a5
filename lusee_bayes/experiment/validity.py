"""Validity of a map: limits of its Gaussian approximation, and errors that it would not reveal.

**Reach.** A Gaussian around the inferred values describes the unknowns of the instrument. Draws of
sky and unknowns from it get weights w, the ratio of the exact density to it, ::

    ln w = -1/2 [ |L^-1 (d - v(m, z))|^2 - |L^-1 (d - v_lin(m, z))|^2 ] - z^2 / 2 + (z - e)^2 / 2,

with L for the noise without the unknowns, and e the moved means of the model's prior. The tail of
the weights shows whether the Gaussian covers the posterior (Pareto k of Vehtari et al. 2024: up to
0.7). With hundreds of unknowns it rarely does: many small second orders add up in w, but not in
the map. Their effect on the mean map, C A^T N^-1 (v - v_lin), shows whether its errors are valid.

**Blind spots.** An instrument error that no unknown describes adds T z to the data. It moves the
mean map by C A^T N^-1 T z. It raises the residual chi^2, the part that no sky can absorb, by ::

    z^T T^T [N^-1 - N^-1 A (A^T N^-1 A)^-1 A^T N^-1] T z

(the inverse with a very wide prior). Neither needs data.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import jax
import numpy as np
from jaxtyping import Float

from lusee_bayes.core.arrays import Modes
from lusee_bayes.core.engine import in_threads
from lusee_bayes.core.lazy import arviz_stats
from lusee_bayes.experiment.experiment import Experiment
from lusee_bayes.experiment.model import base_model, moved, systematics
from lusee_bayes.experiment.rounds import Inference
from lusee_bayes.experiment.unknowns import tested_offsets
from lusee_bayes.linear.amplitudes import AmplitudesOfSky
from lusee_bayes.linear.linear_gaussian import LinearGaussian
from lusee_bayes.noise.covariance import LowRankFactor
from lusee_bayes.systematics.beam import InstrumentParameters
from lusee_bayes.systematics.context import Around, Setup
from lusee_bayes.systematics.field_errors import FieldErrors, FieldErrorsSection
from lusee_bayes.systematics.horizon import Horizon, HorizonSection
from lusee_bayes.systematics.pointing_offsets import PointingOffsets
from lusee_bayes.systematics.systematic import Systematic, Unknown

# number of draws to weight, in total and first, and the largest k for a valid Gaussian
N_WEIGHED, N_FIRST, LARGEST_K = 100, 25, 0.7
# if log-weights scatter by less (rms), the effective sample is 1 / (1 + EVEN^2) = 0.92 of the draws
EVEN = 0.3
# a move of the map (rms, in standard deviations) that enlarges its error by a twentieth
LARGEST_MOVE = 0.3
# relative errors of the fields and of each parameter of the antennas, and an error of the clock
FIELDS, PARAMETERS, CLOCK_S = 1e-3, 1e-2, 600.0
# unknown terrain on one side, whose effect grows as the cube of its altitude
TERRAIN_DEG = 5.0
# highest ell of field errors, enough to show whether they have an effect
FIELD_LMAX = 3
# excess of the residual chi^2 that is noticed, in its standard deviations
SEEN = 3.0
FIELDS_NAME = "the ports' fields"
# a smaller rise of chi^2, over the bias squared, is only rounding: the sky absorbs all of the error
NOTHING = 1e-6
# the sky above lmax is not reported if it adds less, in standard deviations of the noise
LITTLE = 0.1
# largest number of errors in a sentence
MOST_NAMED = 4
# sizes of errors, by name, their unit, the power of them that acts, and what is added to the data
Columns = Float[np.ndarray, "data columns"]
Errors = tuple[dict[str, float], str, int, Columns]
Reach = tuple[list[str], list[str]]


def weighed(setup: Setup, data: np.ndarray, inference: Inference) -> tuple[float, float] | None:
    """Weight draws of sky and unknowns from the Gaussian of an inference.

    Parameters
    ----------
    setup : Setup
    data : (data,) array
        In K.
    inference : Inference

    Returns
    -------
    (float, float) or None
        Pareto k of the weights, -inf if these are nearly equal, and the rms move of the map by
        terms beyond first order, in standard deviations; None if no values were found in rounds.
    """
    parts, factor = inference.expanded, inference.solution.factor
    if not inference.moving or not isinstance(factor, LowRankFactor):
        return None
    columns = np.concatenate([part.columns for part in parts], axis=1)
    amplitudes = AmplitudesOfSky.of(inference.solution, columns)
    keys = jax.random.split(jax.random.key(setup.scenario.seed), 2)
    skies = np.asarray(inference.posterior.sample(keys[0], N_WEIGHED))
    values, axes = np.linalg.eigh(amplitudes.covariance)
    spread = axes * np.sqrt(np.maximum(values, 0.0))
    normals = np.asarray(jax.random.normal(keys[1], (N_WEIGHED, len(amplitudes.mean))))
    off = amplitudes.mean + normals @ spread.T - (skies - amplitudes.reference) @ amplitudes.pull.T
    expected = np.concatenate([part.expected for part in parts])
    ends = np.cumsum([len(part.centre) for part in parts])[:-1]
    base = base_model(setup, inference.around)
    built = [systematic for _, systematic in systematics(setup, inference.around)]
    first_order, beyond = np.empty((2, len(data), N_WEIGHED))

    def drawn(k: int) -> None:
        sky, a, kinds = skies[k], off[k], (type(part.systematic) for part in parts)
        z, model = dict(zip(kinds, np.split(a + expected, ends), strict=True)), base
        for systematic in built:
            if type(systematic) in z:
                model = systematic.effect(model, systematic.values(z[type(systematic)]))
            elif not systematic.first_order:
                model = systematic.averaged(model)
        first_order[:, k] = inference.model.predict(sky) + columns @ a
        beyond[:, k] = model.predict(sky) - first_order[:, k]

    root, begin = np.asarray(inference.posterior.root()), 0
    for n in (N_FIRST, N_WEIGHED):
        in_threads(drawn, range(begin, n))
        begin, steps, linear, more = n, off[:n], first_order[:, :n], beyond[:, :n]
        left = data[:, None] - linear
        exact, linear = (np.asarray(factor.base.whiten(one)) for one in (left - more, left))
        misfit = (linear**2).sum(0) - (exact**2).sum(0)
        log_weights = 0.5 * (misfit + (steps**2).sum(1) - ((steps + expected) ** 2).sum(1))
        pulls = np.asarray(inference.model.coupling.transpose_mv(np.asarray(factor.solve(more))))
        moved_by = float(np.sqrt(np.mean((root.T @ pulls) ** 2)))
        if log_weights.std() < EVEN:
            return -np.inf, moved_by
    weights = np.exp(log_weights - log_weights.max())
    if weights.sum() ** 2 < 2.0 * (weights**2).sum():  # one draw has nearly all weight: no tail
        return np.inf, moved_by
    return float(arviz_stats.array_stats.psislw(-log_weights)[1]), moved_by


@dataclass(frozen=True)
class BlindSpot:
    """An error of the instrument that no unknown of the model describes.

    Attributes
    ----------
    name : str
        The quantity in error.
    size : float
        Its standard deviation, in ``unit``.
    unit : str
    bias : float
        Move of the map: rms over independent directions, in posterior standard deviations.
    shown : float
        Rise of the residual chi^2, in standard deviations of chi^2.
    power : int
        Of the size, with which the data change.
    """

    name: str
    size: float
    unit: str
    bias: float
    shown: float
    power: int = 1

    @property
    def unnoticed(self) -> tuple[float, float]:
        """Largest size that the residual chi^2 does not reveal, and the bias of this size."""
        factor = float(np.sqrt(SEEN / max(self.shown, np.finfo(np.float64).tiny)))
        return self.size * factor ** (1.0 / self.power), self.bias * factor


def blind_sentence(spots: Iterable[BlindSpot]) -> str:
    """Errors that would move the map unnoticed, in one sentence; empty if there are none."""
    unseen = [spot for spot in spots if spot.shown <= SEEN and spot.bias > 1.0]
    if not unseen:
        return ""
    unseen = sorted(unseen, key=lambda spot: -spot.bias)[:MOST_NAMED]
    named = ", ".join(f"{one.name} by {one.size:.3g}{one.unit} ({one.bias:.2g})" for one in unseen)
    return (
        f"Residual chi2 would not reveal an error of {named}, which the model takes as exact. In "
        "brackets: by how many standard deviations it would shift the map (rms over independent "
        "directions). Unknowns (noise.pointing, .horizon, .fields, .beam.parameters) allow for it."
    )


def errors_of(setup: Setup, model: LinearGaussian, sky: Modes, has: set[str]) -> Iterator[Errors]:
    """Errors of the instrument besides unknowns that it has: the names of these are ``has``.

    Parameters
    ----------
    setup : Setup
    model : LinearGaussian
        Without unknowns.
    sky : (modes,) array
        In K.
    has : set of str
    """

    def columns(systematic: Systematic) -> Columns:
        return np.asarray(systematic.linearised(model, np.zeros(len(systematic.names)))(sky))

    source = setup.beam_source
    if source.has_fields and FieldErrors.treatment(setup.scenario) in (None, "ignored"):
        section = FieldErrorsSection(std=FIELDS, lmax=FIELD_LMAX, learned=False)
        fields = FieldErrors.build(section, setup, Around())
        yield {FIELDS_NAME: 100.0 * FIELDS}, " %", 1, columns(fields)
    values = {name: float(p.value) for name, p in source.parameters().items() if name not in has}
    priors = tuple(Unknown(n, v, PARAMETERS * abs(v)) for n, v in values.items() if v)
    if priors:
        sizes = {unknown.name: 100.0 * PARAMETERS for unknown in priors}
        yield sizes, " %", 1, columns(InstrumentParameters(priors, setup.instrument))
    steps = {name: step for name, step in tested_offsets(setup).items() if name not in has}
    if steps:
        steps |= {"clock_s": CLOCK_S} if "clock_s" in steps else {}
        yield steps, "", 1, columns(PointingOffsets.of(setup, steps, dict.fromkeys(steps, 0.0)))
    if setup.hidden is None:
        half = TERRAIN_DEG / 2.0
        terrain = HorizonSection(altitude_deg=half, std_deg=half, harmonics=1, treatment="ignored")
        behind = Horizon.moved(terrain, setup, {"horizon_cos_1_deg": half}).coupling
        more = np.asarray(behind @ sky - model.coupling @ sky)
        yield {"horizon_deg": TERRAIN_DEG}, "", 3, more[:, None]


def blind_spots(setup: Setup, inference: Inference, sky: Modes) -> tuple[BlindSpot, ...]:
    """Compute the effect of instrument errors that the model does not include.

    Parameters
    ----------
    setup : Setup
    inference : Inference
    sky : (modes,) array
        In K.
    """
    has = {name for part in inference.expanded for name in part.systematic.names}
    moved_setup = moved(setup, inference.around.values)
    solution, model = inference.solution, base_model(moved_setup, inference.around)
    root, wide = solution.posterior.root(), inference.under_any_sky().posterior.root()
    spots, degrees = [], max(inference.model.n_data - len(sky), 1)
    for sizes, unit, power, columns in errors_of(moved_setup, model, sky, has):
        solved = np.asarray(solution.factor.solve(columns))
        pull = np.asarray(inference.model.coupling.transpose_mv(solved))
        moves = ((root.T @ pull) ** 2).sum(0)
        left = (columns * solved).sum(0) - ((wide.T @ pull) ** 2).sum(0)
        moves, left = (x.reshape(len(sizes), -1).sum(1) for x in (moves, left))
        bias, shown = np.sqrt(moves / len(sky)), left / np.sqrt(2.0 * degrees)
        for k, (name, size) in enumerate(sizes.items()):
            spot = BlindSpot(name, size, unit, float(bias[k]), float(shown[k]), power)
            if power > 1 and spot.shown > SEEN:  # state the largest that is not noticed
                size, more = spot.unnoticed
                spot = replace(spot, size=size, bias=more, shown=SEEN)
            spots.append(spot)
    return tuple(spots)


def about_sky_above(setup: Setup) -> list[str]:
    """A sentence on the sky above lmax in the data, and the lmax that suffices; none if small."""
    above, section, n_data = setup.above, setup.scenario.noise.above_lmax, setup.layout.size
    if above is None or section.treatment == "ignored":
        return []
    if (added := float(np.sqrt(above.power.sum() / n_data))) < LITTLE:
        return []
    lmax, above_ell = setup.scenario.lmax, np.append(np.cumsum(above.power[::-1])[::-1], 0.0)
    enough = lmax + int(np.argmax(above_ell < np.sqrt(2.0 * n_data)))
    return [
        f"The sky above lmax = {lmax} adds about {added:.2g} standard deviations of the noise to "
        f"every datum (rms), and makes error bars larger. Above lmax = {enough} it would add less "
        "than chance. Simulations may end at lmax: then use noise.above_lmax.treatment=ignored."
    ]


def reach(experiment: Experiment, inference: Inference, alone: bool = True) -> Reach:
    """Doubts about the Gaussian; and notes, on errors that data would not reveal. A sentence each.

    Parameters
    ----------
    experiment : Experiment
    inference : Inference
        Inference from its data.
    alone : bool
        Whether it is the only channel; of several, only doubts are listed.
    """
    doubts, notes, setup = [], [], experiment.setup
    k, moved_by = weighed(setup, np.asarray(experiment.data.data), inference) or (0.0, 0.0)
    wrong = moved_by >= LARGEST_MOVE
    if wrong or (alone and k > LARGEST_K):
        keys = ", ".join(dict.fromkeys(part.systematic.key for part in inference.moving))
        hold = "do not hold" if wrong else "hold"
        (doubts if wrong else notes).append(
            f"The posterior of {keys} is not quite Gaussian. The map's errors {hold}: terms beyond "
            f"first order move it by {moved_by:.2g} of its standard deviations (rms; accepted: "
            f"{LARGEST_MOVE:g}), and the weights of draws have Pareto k = {k:.2g} (accepted: "
            f"{LARGEST_K:g}). treatment=sampled needs no Gaussian."
        )
    if alone and setup.measured:
        spots = blind_spots(setup, inference, inference.posterior.mean)
        notes += filter(None, [blind_sentence(spots)])
    return doubts, notes
