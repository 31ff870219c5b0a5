"""From an experiment to the posterior over its sky."""

from __future__ import annotations

from dataclasses import dataclass

from jaxtyping import Float, PRNGKeyArray

from lusee_bayes.core.arrays import Array
from lusee_bayes.core.errors import InputError
from lusee_bayes.experiment.experiment import Experiment
from lusee_bayes.experiment.model import full_model
from lusee_bayes.experiment.setup import Setup
from lusee_bayes.experiment.terms import Around
from lusee_bayes.instrument.coupling import CouplingMatrix
from lusee_bayes.linear.information import Information
from lusee_bayes.linear.model import LinearGaussian
from lusee_bayes.linear.posterior import Posterior

# the gain term is rebuilt until the map moves by less than this (rms, in standard deviations)
SETTLED, MAX_ROUNDS = 1e-2, 20


@dataclass(frozen=True)
class Inference:
    """A model, the posterior given the data, and how it was found.

    Attributes
    ----------
    model : LinearGaussian
        With every systematic in N that the scenario does not ignore.
    posterior : Posterior
    rounds : int
        How often the gain term was built.
    around : Around
        What it was built around.
    """

    model: LinearGaussian
    posterior: Posterior
    rounds: int
    around: Around


def infer(experiment: Experiment) -> Inference:
    """Condition the experiment's model on its data.

    One round, unless the gain term is built around the posterior's own prediction: then N and the
    map are repeated until the map moves by less than 0.01 standard deviations (rms).

    Parameters
    ----------
    experiment : Experiment

    Raises
    ------
    InputError
        If N is not positive definite, or the map does not settle in 20 rounds.
    """
    setup, data = experiment.setup, experiment.data
    around = Around(data)
    model = full_model(setup, around)
    posterior = model.condition(data.data)
    if not rebuilds_gains(setup):
        return Inference(model, posterior, 1, around)
    for rounds in range(2, MAX_ROUNDS + 1):
        around = Around(data, prediction(setup, posterior))
        model = full_model(setup, around)
        previous, posterior = posterior, model.condition(data.data)
        if float(posterior.rms_shift_from(previous)) < SETTLED:
            return Inference(model, posterior, rounds, around)
    raise InputError(
        f"the map still moves after {MAX_ROUNDS} rounds of rebuilding the gain term around it; "
        "use noise.gain.visibilities=model"
    )


def inform(
    experiment: Experiment, key: PRNGKeyArray, n_perturbations: int = 0
) -> tuple[Information, Inference]:
    """What the data say of the sky as a quadratic form, and the posterior that it gives.

    Parameters
    ----------
    experiment : Experiment
    key : PRNG key
        For the perturbations.
    n_perturbations : int
        See :meth:`LinearGaussian.inform`.

    Raises
    ------
    InputError
        As :func:`infer`.
    """
    data, around, rounds = experiment.data, Around(experiment.data), 1
    if rebuilds_gains(experiment.setup):
        settled = infer(experiment)
        model, around, rounds = settled.model, settled.around, settled.rounds
    else:
        model = full_model(experiment.setup, around)
    information, posterior = model.inform(data.data, key, n_perturbations)
    return information, Inference(model, posterior, rounds, around)


def rebuilds_gains(setup: Setup) -> bool:
    """Whether the gain term is built around the posterior's own prediction."""
    gain = setup.scenario.noise.gain
    return gain is not None and gain.treatment != "ignored" and gain.visibilities == "posterior"


def prediction(setup: Setup, posterior: Posterior) -> Float[Array, "products times"]:
    """Visibilities of the mean map, with the sources' mean fluxes, at every time; in K."""
    complete = CouplingMatrix.build(setup.beams, setup.pointing)
    difference_of_skies = posterior.mean - setup.sky.modes
    return setup.signal + complete.layout.scatter(complete @ difference_of_skies)
