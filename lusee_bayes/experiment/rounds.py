"""N that is built around what the data tell, in rounds, and the posterior of each."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from lusee_bayes.core.arrays import Array
from lusee_bayes.core.errors import InputError
from lusee_bayes.experiment.model import base_model, marginalised, systematics
from lusee_bayes.experiment.setup import Setup
from lusee_bayes.experiment.terms import Around, pointed
from lusee_bayes.instrument.coupling import CouplingMatrix
from lusee_bayes.instrument.visibilities import Visibilities
from lusee_bayes.linear.model import LinearGaussian
from lusee_bayes.linear.posterior import Posterior
from lusee_bayes.linear.templates import template_amplitudes
from lusee_bayes.systematics import PointingOffsets

# N is rebuilt until the map moves by less than this (rms, in standard deviations)
SETTLED, MAX_ROUNDS = 1e-2, 30
# no offset moves further in a round, in prior standard deviations: beyond, the first order that
# the move comes from says little
FARTHEST = 2.0
# steps that swing about where they lead to are halved, down to this part of the whole
SHORTEST = 0.125


@dataclass(frozen=True)
class Inference:
    """A model, the posterior given the data, and how it was found.

    Attributes
    ----------
    model : LinearGaussian
        With every systematic in N that the scenario does not ignore.
    posterior : Posterior
    rounds : int
        How often N was built.
    around : Around
        What it was built around.
    offsets : PointingOffsets or None
        Of clock and pointing, as they are in N.
    """

    model: LinearGaussian
    posterior: Posterior | None
    rounds: int
    around: Around
    offsets: PointingOffsets | None = None


def settled(setup: Setup, data: Visibilities) -> Inference:
    """Condition the model on data, in as many rounds as its N needs.

    One round, unless a term of N is built around what the data tell: the gains around the
    posterior's own prediction, or clock and pointing around its sky and their own values. Then N
    and the map are repeated until the map moves by less than 0.01 standard deviations (rms).
    Clock and pointing go part of the way where they would go far, or swing: what is second order
    in them may outweigh what tells two offsets apart.

    Parameters
    ----------
    setup : Setup
    data : Visibilities

    Raises
    ------
    InputError
        If N is not positive definite, or the map does not settle in 30 rounds.
    """

    def conditioned(around: Around, rounds: int) -> Inference:
        model, offsets = model_about(setup, around)
        return Inference(model, model.condition(data.data), rounds, around, offsets)

    found = conditioned(Around(data), 1)
    if not rebuilds(setup):
        return found
    step = _Step()
    for rounds in range(2, MAX_ROUNDS + 1):
        around, step = _around(setup, found, step)
        before, found = found, conditioned(around, rounds)
        if float(found.posterior.rms_shift_from(before.posterior)) < SETTLED * step.size:
            return found
    remedies = []
    if rebuilds_gains(setup):
        remedies.append("noise.gain.visibilities=model")
    if rebuilds_pointing(setup):
        remedies.append("smaller standard deviations in noise.pointing, or its treatment=sampled")
    raise InputError(
        f"the map still moves after {MAX_ROUNDS} rounds of rebuilding N around it; use "
        + ", and ".join(remedies)
    )


def model_about(setup: Setup, around: Around) -> tuple[LinearGaussian, PointingOffsets | None]:
    """The full model, and the offsets of clock and pointing in its N."""
    found = systematics(setup, around)
    offsets = [s for _, s in found if isinstance(s, PointingOffsets)]
    return marginalised(base_model(setup, around.data), found), next(iter(offsets), None)


@dataclass(frozen=True)
class _Step:
    """Of clock and pointing, from what N is built around to what the data then tell.

    whole : (offsets,) array, the way there in prior standard deviations, None before the first;
    swing : how much of it is gone unless it is far; size : how much of it is gone
    """

    whole: Float[np.ndarray, " offsets"] | None = None
    swing: float = 1.0
    size: float = 1.0

    def after(self, whole: Float[np.ndarray, " offsets"]) -> _Step:
        """The next step: a smaller part if it turns back without becoming short."""
        back = (
            self.whole is not None
            and whole @ self.whole < 0.0
            and np.linalg.norm(whole) > np.linalg.norm(self.whole) / 2.0
        )
        swing = max(self.swing / 2.0, SHORTEST) if back else min(2.0 * self.swing, 1.0)
        size = min(swing, FARTHEST / max(float(np.abs(whole).max()), FARTHEST))
        return _Step(whole, swing, size)


def _around(setup: Setup, found: Inference, step: _Step) -> tuple[Around, _Step]:
    """What the terms of N are built around next, given a posterior, and the step there."""
    visibilities, sky, values = None, None, None
    if rebuilds_pointing(setup):
        offsets = found.offsets
        here = np.asarray(setup.sky.modes if found.around.sky is None else found.around.sky)
        told, _ = offset_posterior(found)
        whole = np.array(list(told.values())) / np.asarray(offsets.stds) - offsets.centre
        step = step.after(whole)
        sky = here + step.size * (np.asarray(found.posterior.mean) - here)
        values = offsets.in_units(offsets.centre + step.size * whole)
    if rebuilds_gains(setup):
        visibilities = prediction(pointed(setup, values), found.posterior)
    return Around(found.around.data, visibilities, sky, values), step


def offset_posterior(
    found: Inference,
) -> tuple[dict[str, float], Float[np.ndarray, "offsets offsets"]]:
    """Mean of every offset of clock and pointing by name, and their covariance.

    Parameters
    ----------
    found : Inference
        Of its data alone, with offsets.

    Returns
    -------
    mean : dict of float
        In the units that the names end with.
    covariance : (offsets, offsets) array
        In these units.
    """
    offsets, data = found.offsets, found.around.data.data
    z, covariance = template_amplitudes(found.model, found.posterior, data, offsets.templates)
    stds = np.asarray(offsets.stds)
    return offsets.in_units(z), covariance * np.outer(stds, stds)


def rebuilds(setup: Setup) -> bool:
    """Whether some term of N is built around what the data tell."""
    return rebuilds_gains(setup) or rebuilds_pointing(setup)


def rebuilds_pointing(setup: Setup) -> bool:
    """Whether clock and pointing are to first order about the sky and the values of the data."""
    section = setup.scenario.noise.pointing
    return section is not None and section.treatment != "ignored" and section.around == "posterior"


def rebuilds_gains(setup: Setup) -> bool:
    """Whether the gain term is built around the posterior's own prediction."""
    gain = setup.scenario.noise.gain
    return gain is not None and gain.treatment != "ignored" and gain.visibilities == "posterior"


def prediction(setup: Setup, posterior: Posterior) -> Float[Array, "products times"]:
    """Visibilities of the mean map, with the sources' mean fluxes, at every time; in K."""
    complete = CouplingMatrix.build(setup.beams, setup.pointing)
    difference_of_skies = posterior.mean - setup.sky.modes
    return setup.signal + complete.layout.scatter(complete @ difference_of_skies)
