"""A prior whose parameters the data of an experiment tell."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from lusee_bayes.core.harmonics import n_modes
from lusee_bayes.experiment.model import full_model
from lusee_bayes.experiment.rounds import rebuilds, settled
from lusee_bayes.experiment.setup import Setup
from lusee_bayes.experiment.terms import Around
from lusee_bayes.instrument.visibilities import Visibilities
from lusee_bayes.linear.information import Information
from lusee_bayes.linear.learning import Learned, learn_whatever_fits
from lusee_bayes.linear.marginal_information import marginalised
from lusee_bayes.sky.prior_family import PriorFamily

# the map and its prior are found together when the map moves by less than this, rms; a step of
# learning that is not taken moves it by a hundredth
SETTLED, MAX_ROUNDS = 0.05, 8
# parameters are learned up to this ell first, in a tenth of the time, where there are more
COARSE_LMAX = 24


def with_learned_prior(
    setup: Setup, data: Visibilities
) -> tuple[Setup, Learned | None, Around | None]:
    """Learn the prior from data; a prior that is given stays as it is.

    Systematics are in N as far as they are marginalised. Where N is built around what the data
    tell, learning takes part in the rounds: N under the prior so far, the prior under this N, and
    so on, until the map moves by less than 0.05 standard deviations (rms).

    Parameters
    ----------
    setup : Setup
    data : Visibilities

    Returns
    -------
    Setup
        With the prior.
    Learned or None
        How it was learned.
    Around or None
        What N was built around in the last round; None where that is the data alone.
    """
    if setup.family is None:
        return setup, None, None
    if not rebuilds(setup):
        learned = learned_prior(setup, setup.family, about_sky(setup, data))
        return replace(setup, prior=learned.prior), learned, None
    learned, before, found = None, None, settled(setup, data)
    for _ in range(MAX_ROUNDS):
        information = full_model(setup, found.around).inform(data.data)[0]
        start = None if learned is None or not learned.settled else learned.parameters
        learned = learned_prior(setup, setup.family, information, start)
        setup = replace(setup, prior=learned.prior)
        before, found = found, settled(setup, data, found.around)
        moved = float(found.posterior.rms_shift_from(before.posterior))
        if moved < SETTLED:
            return setup, learned, found.around
    return setup, replace(learned, still_moves=moved), found.around


def about_sky(setup: Setup, data: Visibilities) -> Information:
    """What data say of the sky; only its reference sky depends on the setup's prior.

    Where N is built around what data tell, it is about that of the prior before them.
    """
    around = settled(setup, data).around if rebuilds(setup) else Around(data)
    return full_model(setup, around).inform(data.data)[0]


def learned_prior(
    setup: Setup,
    family: PriorFamily,
    information: Information,
    start: Float[np.ndarray, " parameters"] | None = None,
) -> Learned:
    """Learn the prior of a family, up to a lower ell first where there are many.

    Parameters
    ----------
    setup : Setup
        Of the scenario that the family is of.
    family : PriorFamily
    information : Information
        What the data say of the sky (:func:`about_sky`).
    start : (parameters,) array, optional
        Where to begin.
    """
    scenario, seed = setup.scenario, setup.scenario.seed
    if start is not None or scenario.lmax <= COARSE_LMAX:
        return learn_whatever_fits(family, information, start, seed)
    coarse = scenario.prior.family(scenario.frequency_mhz, COARSE_LMAX)
    n = n_modes(COARSE_LMAX)
    variance = np.asarray(setup.prior.variance())[n:]
    first = learn_whatever_fits(coarse, marginalised(information, n, variance), seed=seed)
    start = family.start_from(coarse, first.parameters) if first.settled else None
    return learn_whatever_fits(family, information, start=start, seed=seed)
