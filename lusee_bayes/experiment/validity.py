"""Validity of a map: limits of its Gaussian approximation, and errors that it would not reveal.

**Reach.** A Gaussian around the inferred values describes the unknowns of the instrument; draws
from it show whether it, and the map's errors, are valid (:mod:`.second_order`).

**Blind spots.** An instrument error that no unknown describes adds T z to the data. It moves the
mean map by C A^T N^-1 T z. It raises the residual chi^2, the part that no sky can absorb, by ::

    z^T T^T [N^-1 - N^-1 A (A^T N^-1 A)^-1 A^T N^-1] T z

(the inverse with a very wide prior). Neither needs data.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from lusee_bayes.core.arrays import Modes
from lusee_bayes.experiment import rounds, unknowns
from lusee_bayes.experiment.experiment import Experiment
from lusee_bayes.experiment.model import base_model, moved
from lusee_bayes.experiment.second_order import LARGEST_K, LARGEST_MOVE, SecondOrder, weighed
from lusee_bayes.linear.linear_gaussian import LinearGaussian
from lusee_bayes.systematics.beam import InstrumentParameters
from lusee_bayes.systematics.context import Around, Setup
from lusee_bayes.systematics.field_errors import FieldErrors, FieldErrorsSection
from lusee_bayes.systematics.horizon import Horizon, HorizonSection
from lusee_bayes.systematics.pointing_offsets import PointingOffsets
from lusee_bayes.systematics.systematic import Systematic, Unknown

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
    if not (unseen := [spot for spot in spots if spot.shown <= SEEN and spot.bias > 1.0]):
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
    if priors := tuple(Unknown(n, v, PARAMETERS * abs(v)) for n, v in values.items() if v):
        sizes = {unknown.name: 100.0 * PARAMETERS for unknown in priors}
        yield sizes, " %", 1, columns(InstrumentParameters(priors, setup.instrument))
    steps = {name: step for name, step in unknowns.tested_offsets(setup).items() if name not in has}
    if steps:
        steps |= {"clock_s": CLOCK_S} if "clock_s" in steps else {}
        yield steps, "", 1, columns(PointingOffsets.of(setup, steps, dict.fromkeys(steps, 0.0)))
    if setup.hidden is None:
        half = TERRAIN_DEG / 2.0
        terrain = HorizonSection(altitude_deg=half, std_deg=half, harmonics=1, treatment="ignored")
        behind = Horizon.moved(terrain, setup, {"horizon_cos_1_deg": half}).coupling
        more = np.asarray(behind @ sky - model.coupling @ sky)
        yield {"horizon_deg": TERRAIN_DEG}, "", 3, more[:, None]


def blind_spots(setup: Setup, inference: rounds.Inference, sky: Modes) -> tuple[BlindSpot, ...]:
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


def reach(experiment: Experiment, inference: rounds.Inference, alone: bool = True) -> Reach:
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
    keys = ", ".join(dict.fromkeys(part.systematic.key for part in inference.moving))
    if any(isinstance(part.systematic, SecondOrder) for part in inference.systematics):
        notes.append(f"N contains the second order of {keys}: the first alone would bias the map.")
        more = f"What channels share of {keys} is not Gaussian: given all, errors may be too small."
        doubts += [more] * (not alone)
    if wrong or (alone and k > LARGEST_K):
        quite, hold = ("", "do not hold") if wrong else ("quite ", "hold")
        (doubts if wrong else notes).append(
            f"The posterior of {keys} is not {quite}Gaussian. The map's errors {hold}: terms "
            f"beyond first order move it by {moved_by:.2g} of its standard deviations (rms; "
            f"accepted: {LARGEST_MOVE:g}), and the weights of draws have Pareto k = {k:.2g} "
            f"(accepted: {LARGEST_K:g}). treatment=sampled needs no Gaussian."
        )
    if alone and setup.measured:
        spots = blind_spots(setup, inference, inference.posterior.mean)
        notes += filter(None, [blind_sentence(spots)])
    return doubts, notes
