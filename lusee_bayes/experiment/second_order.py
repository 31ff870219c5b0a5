"""Terms beyond first order in the unknowns of the instrument: what they do to the map, and to N.

Draws of sky m and unknowns z from the Gaussian of an inference show what the first order omits,
q = v(m, z) - v_lin(m, z).

**In N.** If q would move the mean map, C A^T N^-1 q, by 0.3 of its standard deviations or more, the
mean of q is added to the model and its covariance to N. Both are right to second order: q, even in
the distance from the expansion point, is not correlated with the first order, which is odd. Turns
of the antennas that the sky can follow need it: the posterior then curves with the turned sky m(z).

**Other modes.** Such a valley may have two ends that fit. From both sides of the inferred values
rounds lead to the other, which is named: the map is that of one.

**Weights.** Draws get the ratio w of the exact density to the Gaussian's, ::

    ln w = -1/2 [ |L^-1 (d - v)|^2 - |L'^-1 (d - v_lin)|^2 ] - z^2 / 2 + (z - e)^2 / 2,

with L for the noise without the unknowns, L' for this and q (v_lin with the mean of q), and e the
moved means of the model's prior. The tail of the weights shows whether the Gaussian covers the
posterior (Pareto k of Vehtari et al. 2024: up to 0.7). With hundreds of unknowns it rarely does:
many small second orders add up in w, but not in the map.
"""

from dataclasses import replace
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from lusee_bayes.core import engine, lazy
from lusee_bayes.core.errors import InputError
from lusee_bayes.experiment.model import base_model, systematics
from lusee_bayes.experiment.rounds import Inference, approached, less_moved, settled, solved_at
from lusee_bayes.instrument.pointing import CLOCK, offset_kind
from lusee_bayes.linear.amplitudes import AmplitudesOfSky
from lusee_bayes.noise.covariance import LowRankFactor, LowRankUpdate
from lusee_bayes.systematics.context import Around, Setup
from lusee_bayes.systematics.systematic import LowRankNoise, Marginalised, with_added

# steps along the widest direction of clock and pointing, in prior standard deviations, and a mode:
# so far is its map (rms, in standard deviations), and ln p at most so much lower
STEPS, APART, RIVAL = (-2.0, 2.0), 3.0, 5.0
# number of draws to weight, in total and first, of those that show whether the map would move, and
# the largest k for a valid Gaussian
N_WEIGHED, N_FIRST, N_FEW, LARGEST_K = 100, 25, 8, 0.7
# if log-weights scatter by less (rms), the effective sample is 1 / (1 + EVEN^2) = 0.92 of the draws
EVEN = 0.3
# a move of the map (rms, in standard deviations) that enlarges its error by a twentieth
LARGEST_MOVE = 0.3


class SecondOrder(LowRankNoise):
    """Terms beyond first order in the data: their covariance as noise, and their mean.

    Attributes
    ----------
    mean : (data,) array
        In K.
    """

    words = "terms beyond first order"

    mean: Float[np.ndarray, " data"]

    def marginalised(self, model):
        """Add the covariance to N, and the mean."""
        return with_added(super().marginalised(model), self.mean)


class Draws(NamedTuple):
    """Draws of sky and unknowns from the Gaussian of an inference.

    steps : the unknowns minus their moved prior means, in prior standard deviations
    linear : the data that they predict to first order, in K; beyond : all else
    """

    steps: Float[np.ndarray, "n unknowns"]
    linear: Float[np.ndarray, "n data"]
    beyond: Float[np.ndarray, "n data"]

    @classmethod
    def of(cls, setup: Setup, inference: Inference, which: range) -> "Draws | None":
        """Draw those with these numbers; None if no values were found in rounds."""
        parts = inference.expanded
        if not inference.moving or not isinstance(inference.solution.factor, LowRankFactor):
            return None
        columns = np.concatenate([part.columns for part in parts], axis=1)
        amplitudes = AmplitudesOfSky.of(inference.solution, columns)
        keys = jax.random.split(jax.random.key(setup.scenario.seed), 2)
        skies = np.asarray(inference.posterior.sample(keys[0], N_WEIGHED))[which]
        values, axes = np.linalg.eigh(amplitudes.covariance)
        spread = axes * np.sqrt(np.maximum(values, 0.0))
        normals = np.asarray(jax.random.normal(keys[1], (N_WEIGHED, len(spread))))[which]
        mean = amplitudes.mean - (skies - amplitudes.reference) @ amplitudes.pull.T
        steps = mean + normals @ spread.T
        expected = np.concatenate([part.expected for part in parts])
        ends = np.cumsum([len(part.centre) for part in parts])[:-1]
        base = base_model(setup, inference.around)
        built = [systematic for _, systematic in systematics(setup, inference.around)]
        linear, beyond = np.empty((2, len(skies), inference.model.n_data))

        def draw(k: int) -> None:
            kinds, model = (type(part.systematic) for part in parts), base
            z = dict(zip(kinds, np.split(steps[k] + expected, ends), strict=True))
            for systematic in built:
                if type(systematic) in z:
                    within = systematic.inside(z[type(systematic)])
                    model = systematic.effect(model, systematic.values(within))
                elif not systematic.first_order:
                    model = systematic.averaged(model)
            linear[k] = inference.model.predict(skies[k]) + columns @ steps[k]
            beyond[k] = model.predict(skies[k]) - linear[k]

        engine.in_threads(draw, range(len(skies)))
        return cls(steps, linear, beyond)

    def moves(self, inference: Inference) -> float:
        """RMS move of the map by all beyond first order, in standard deviations."""
        solved = np.asarray(inference.solution.factor.solve(self.beyond.T))
        pulls = np.asarray(inference.model.coupling.transpose_mv(solved))
        return float(np.sqrt(np.mean((np.asarray(inference.posterior.root()).T @ pulls) ** 2)))


def with_other_modes(setup: Setup, inference: Inference) -> Inference:
    """Look for other orientations of the antennas: two turns that the sky can follow often fit."""
    part, around = inference.offsets, inference.around
    turns = () if part is None else [n for n in part.systematic.names if n not in CLOCK]
    if len(set(map(offset_kind, turns))) < 2 or inference.unsettled or not inference.fits:
        return inference
    amplitudes, best = inference.amplitudes(part), inference
    middle, way = part.expected + amplitudes.mean, np.linalg.eigh(amplitudes.covariance)[1][:, -1]
    for step in STEPS:
        values = {**(around.values or {}), **part.systematic.in_units(middle + step * way)}
        try:
            beside = solved_at(setup, Around(around.data, values=values)).around
            found, _ = approached(setup, beside, lambda rounds, remark: None)
        except InputError:  # the antennas cannot be turned that far
            continue
        gained = float(found.posterior.log_evidence - best.posterior.log_evidence)
        if found.posterior.rms_shift_from(best.posterior.mean) > APART and gained > -RIVAL:
            named = ", ".join(f"{name} = {found.around.values[name]:.3g}" for name in turns)
            said = f"The data fit as well with {named}, and another map (ln p {gained:+.1f}): "
            said += "error bars are those of one of the two."
            if gained > RIVAL:
                best = replace(settled(setup, found.around), learned=inference.learned)
                said = ""
            best = replace(best, unsettled=said)
    return best


def with_second_order(setup: Setup, inference: Inference) -> Inference:
    """Add terms beyond first order to the model, if they would move the map of data that fit."""
    few = Draws.of(setup, inference, range(N_FEW))
    if few is None or few.moves(inference) < LARGEST_MOVE or not inference.fits:
        return inference
    beyond = Draws.of(setup, inference, range(N_WEIGHED)).beyond
    mean, layout = beyond.mean(axis=0), setup.layout
    root = (beyond - mean).T / np.sqrt(N_WEIGHED - 1.0)
    more = Marginalised(SecondOrder(name="second_order", layout=layout, root=root, mean=mean))
    solution = more.marginalised(inference.model).condition(inference.solution.data)
    held = *inference.systematics, more
    return replace(inference, solution=less_moved(solution, held), systematics=held)


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
        terms that the model omits, in standard deviations; None if no values were found in rounds.
    """
    draws, factor = None, inference.solution.factor
    expected = np.concatenate([part.expected for part in inference.expanded] or [np.zeros(0)])
    for which in (range(N_FIRST), range(N_FIRST, N_WEIGHED)):
        if (new := Draws.of(setup, inference, which)) is None:
            return None
        draws = new if draws is None else Draws(*map(np.concatenate, zip(draws, new, strict=True)))
        left, whiten = (data - draws.linear).T, factor.base.whiten
        exact = whiten(left - draws.beyond.T)
        for part in inference.systematics:
            if isinstance(part.systematic, SecondOrder):
                noise = LowRankUpdate(inference.model.noise.base, part.systematic.covariance())
                whiten = noise.factor(factor.base).whiten
        misfit = (np.asarray(whiten(left)) ** 2).sum(0) - (np.asarray(exact) ** 2).sum(0)
        steps, moved_by = draws.steps, draws.moves(inference)
        log_weights = 0.5 * (misfit + (steps**2).sum(1) - ((steps + expected) ** 2).sum(1))
        if log_weights.std() < EVEN:
            return -np.inf, moved_by
    weights = np.exp(log_weights - log_weights.max())
    if weights.sum() ** 2 < 2.0 * (weights**2).sum():  # one draw has nearly all weight: no tail
        return np.inf, moved_by
    return float(lazy.arviz_stats.array_stats.psislw(-log_weights)[1]), moved_by
