"""How far a map can be trusted: what its Gaussian leaves out, and which errors it would not show.

**Reach.** Unknowns of the instrument are described by a Gaussian about their found values. Draws of
sky and unknowns from it are weighed against the exact density, ::

    ln w = -1/2 [ |L^-1 (d - v(m, z))|^2 - |L^-1 (d - v_lin(m, z))|^2 ] - z^2 / 2 + (z - e)^2 / 2,

with L of the noise without them, and e the moved means of the model's prior. The tail of the
weights says whether it is all of the posterior (Pareto k of Vehtari et al. 2024: up to 0.7). Of
hundreds of unknowns it hardly ever is: many small second orders add up in w, and not in the map.
What they do to the mean map, C A^T N^-1 (v - v_lin), says whether its errors hold.

**Blind spots.** An error of the instrument that no unknown describes adds T z to the data. It moves
the mean map by C A^T N^-1 T z, and raises the residual chi^2, what no sky can absorb, by ::

    z^T T^T [N^-1 - N^-1 A (A^T N^-1 A)^-1 A^T N^-1] T z

(the inverse with a very wide prior). Neither needs data.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import jax
import numpy as np

from lusee_bayes.core.arrays import Modes
from lusee_bayes.core.engine import in_threads
from lusee_bayes.core.lazy import arviz_stats
from lusee_bayes.experiment.experiment import Experiment
from lusee_bayes.experiment.model import base_model, moved, systematics
from lusee_bayes.experiment.rounds import WIDE, Inference
from lusee_bayes.experiment.unknowns import TESTED
from lusee_bayes.instrument.pointing import offset_names
from lusee_bayes.linear.amplitudes import amplitudes_of_sky
from lusee_bayes.noise.covariance import LowRankFactor
from lusee_bayes.systematics.beam import InstrumentParameters
from lusee_bayes.systematics.context import Around, Setup
from lusee_bayes.systematics.field_errors import FieldErrors, FieldErrorsSection
from lusee_bayes.systematics.pointing_offsets import PointingOffsets
from lusee_bayes.systematics.systematic import Systematic, Unknown

# draws that are weighed, the first of them, and the k up to which a Gaussian serves
N_WEIGHED, N_FIRST, LARGEST_K = 100, 25, 0.7
# weights whose logarithms differ by less (rms) count for 1 / (1 + EVEN^2) = 0.92 of their number
EVEN = 0.3
# moves of the map, in standard deviations (rms), that make its error larger by a twentieth
LARGEST_MOVE = 0.3
# an error of the fields, and of each parameter of the antennas, relative
FIELDS, PARAMETERS = 1e-3, 1e-2
# of the fields: enough to see whether anything shows
FIELD_LMAX = 3
# a residual chi^2 is seen to be too large by so many of its standard deviations
SEEN = 3.0
FIELDS_NAME = "the ports' fields"
# what raises chi^2 by less is what a sky can absorb altogether, but for rounding
NOTHING = 1e-3
# standard deviations of the noise that the sky above lmax may add without being mentioned
LITTLE = 0.1
# errors that a sentence names
MOST_NAMED = 4


def weighed(setup: Setup, data: np.ndarray, inference: Inference) -> tuple[float, float] | None:
    """Weigh draws of sky and unknowns from the Gaussian of an inference.

    Parameters
    ----------
    setup : Setup
    data : (data,) array
        In K.
    inference : Inference

    Returns
    -------
    (float, float) or None
        Pareto k of the weights, -inf where they hardly differ, and by how much what is beyond first
        order moves the map, rms in standard deviations; None where nothing was found in rounds.
    """
    parts, factor = inference.expanded, inference.solution.factor
    if not inference.moving or not isinstance(factor, LowRankFactor):
        return None
    columns = np.concatenate([part.columns for part in parts], axis=1)
    amplitudes = amplitudes_of_sky(inference.solution, columns)
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
        z = dict(zip(kinds, np.split(a + expected, ends), strict=True))
        model = base
        for systematic in built:
            if type(systematic) in z:
                sites = systematic.values(z[type(systematic)])
                model = systematic.effect(model, sites)
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
    if weights.sum() ** 2 < 2.0 * (weights**2).sum():  # one draw has nearly all of it: no tail
        return np.inf, moved_by
    return float(arviz_stats.array_stats.psislw(-log_weights)[1]), moved_by


@dataclass(frozen=True)
class BlindSpot:
    """An error of the instrument that no unknown of the model describes.

    Attributes
    ----------
    name : str
        What it is of.
    size : float
        Its standard deviation, in ``unit``.
    unit : str
    bias : float
        By how much it moves the map: rms over modes, in posterior standard deviations.
    shown : float
        By how much it raises the residual chi^2, in standard deviations of that.
    """

    name: str
    size: float
    unit: str
    bias: float
    shown: float

    @property
    def unnoticed(self) -> tuple[float, float]:
        """The size up to which the residual chi^2 does not show it, and the bias of that size."""
        factor = float(np.sqrt(SEEN / max(self.shown, np.finfo(np.float64).tiny)))
        return self.size * factor, self.bias * factor

    def words(self) -> str:
        """What it does, in a few words."""
        return f"{self.name} by {self.size:g}{self.unit} ({self.bias:.2g})"


def blind_sentence(spots: Iterable[BlindSpot]) -> str:
    """Which errors would move the map and not be seen; empty where there are none."""
    unseen = [spot for spot in spots if spot.shown < SEEN and spot.bias > 1.0]
    if not unseen:
        return ""
    unseen = sorted(unseen, key=lambda spot: -spot.bias)[:MOST_NAMED]
    return (
        "The model assumes an exact instrument, and residual chi2 would not reveal an error of "
        f"{', '.join(spot.words() for spot in unseen)}; in brackets, the resulting error of the "
        "map in standard deviations (rms). noise.beam.parameters and noise.fields include such "
        "errors; a second turntable angle reveals more of them."
    )


def errors_of(
    setup: Setup, *, pointing: bool
) -> Iterator[tuple[str, float, str, Systematic, slice]]:
    """Name, size and unit of errors that a model may lack, with what describes them."""
    source = setup.beam_source
    if source.has_fields:
        section = FieldErrorsSection(std=FIELDS, lmax=FIELD_LMAX, learned=False)
        fields = FieldErrors.build(section, setup, Around())
        yield FIELDS_NAME, 100.0 * FIELDS, " %", fields, slice(None)
    values = {name: float(p.value) for name, p in source.parameters().items() if float(p.value)}
    priors = tuple(Unknown(name, value, PARAMETERS * abs(value)) for name, value in values.items())
    parameters = InstrumentParameters(setup.instrument, priors)
    for k, name in enumerate(values):
        yield name, 100.0 * PARAMETERS, " %", parameters, slice(k, k + 1)
    if not pointing:
        return
    runs = setup.observation.n_runs
    steps = {name: step for kind, step in TESTED.items() for name in offset_names((kind,), runs)}
    offsets = PointingOffsets.of(setup, steps, dict.fromkeys(steps, 0.0))
    for k, (name, step) in enumerate(steps.items()):
        yield name, step, "", offsets, slice(k, k + 1)


def blind_spots(
    setup: Setup, inference: Inference, sky: Modes, *, pointing: bool = True
) -> tuple[BlindSpot, ...]:
    """Work out what errors of the instrument do that the model does not have.

    Parameters
    ----------
    setup : Setup
    inference : Inference
    sky : (modes,) array
        In K.
    pointing : bool
        Clock and pointing, too, besides fields and antennas.
    """
    has = {name for part in inference.expanded for name in part.systematic.names}
    if any(isinstance(part.systematic, FieldErrors) for part in inference.expanded):
        has.add(FIELDS_NAME)
    moved_setup = moved(setup, inference.around.values)
    solution, model = inference.solution, base_model(moved_setup, inference.around)
    root = solution.posterior.root()
    wide = solution.under(inference.model.prior.widened(WIDE)).posterior.root()
    spots, slopes, degrees = [], {}, max(inference.model.n_data - len(sky), 1)
    for name, size, unit, systematic, which in errors_of(moved_setup, pointing=pointing):
        if name in has:
            continue
        if type(systematic) not in slopes:
            centre = np.zeros(len(systematic.names))
            columns = np.asarray(systematic.linearised(model, centre)(sky))
            solved = np.asarray(solution.factor.solve(columns))
            pull = np.asarray(inference.model.coupling.transpose_mv(solved))
            moves = ((root.T @ pull) ** 2).sum(0)
            left = (columns * solved).sum(0) - ((wide.T @ pull) ** 2).sum(0)
            slopes[type(systematic)] = moves, left
        moves, left = (x[which].sum() for x in slopes[type(systematic)])
        bias = float(np.sqrt(moves / len(sky)))
        spots.append(BlindSpot(name, size, unit, bias, float(left / np.sqrt(2.0 * degrees))))
    return tuple(spots)


def about_sky_above(setup: Setup) -> str:
    """What the sky above lmax adds to the data, and where it ends; empty where that is little."""
    above, section = setup.above, setup.scenario.noise.above_lmax
    if above is None or section.treatment == "ignored":
        return ""
    if (added := float(np.sqrt(above.power.sum() / len(above.root)))) < LITTLE:
        return ""
    lmax, above_ell = setup.scenario.lmax, np.append(np.cumsum(above.power[::-1])[::-1], 0.0)
    enough = lmax + int(np.argmax(above_ell < np.sqrt(2.0 * len(above.root))))
    return (
        f"The sky above lmax = {lmax} adds about {added:.2g} standard deviations of the noise to "
        "every datum (rms). It is marginalised: the error bars are valid, but larger. Above lmax = "
        f"{enough} it would add less to chi2 than chance."
    )


def reach(experiment: Experiment, inference: Inference) -> list[str]:
    """What is doubtful about the Gaussian, and what data would not show, a sentence each.

    Parameters
    ----------
    experiment : Experiment
    inference : Inference
        Of its data.
    """
    sentences, setup = [], experiment.setup
    k, moved_by = weighed(setup, np.asarray(experiment.data.data), inference) or (0.0, 0.0)
    if k > LARGEST_K:
        keys = ", ".join(dict.fromkeys(part.systematic.key for part in inference.moving))
        holds = "its errors are valid" if moved_by < LARGEST_MOVE else "its errors are not valid"
        sentences.append(
            f"The posterior of {keys} is not Gaussian (Pareto k = {k:.2g}, accepted: "
            f"{LARGEST_K:g}). Terms beyond first order move the map by {moved_by:.2g} of its "
            f"standard deviations (rms), so that {holds}; treatment=sampled avoids the Gaussian "
            "approximation."
        )
    sentences += filter(None, [about_sky_above(setup)])
    if setup.measured:
        spots = blind_spots(setup, inference, inference.posterior.mean, pointing=False)
        sentences += filter(None, [blind_sentence(spots)])
    return sentences
