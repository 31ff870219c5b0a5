"""From an experiment to the posterior over its sky."""

from __future__ import annotations

from dataclasses import replace

from lusee_bayes.experiment.experiment import Experiment
from lusee_bayes.experiment.rounds import Inference, model_about, rebuilds, settled
from lusee_bayes.experiment.terms import Around
from lusee_bayes.linear.information import Information


def infer(experiment: Experiment) -> Inference:
    """Condition the experiment's model on its data (:func:`.settled`).

    Parameters
    ----------
    experiment : Experiment

    Raises
    ------
    InputError
        As :func:`.settled`.
    """
    return settled(experiment.setup, experiment.data, experiment.around)


def inform(experiment: Experiment) -> tuple[Information, Inference]:
    """What the data say of the sky as a quadratic form, and the posterior that it gives.

    Parameters
    ----------
    experiment : Experiment

    Raises
    ------
    InputError
        As :func:`infer`.
    """
    if rebuilds(experiment.setup):
        found = infer(experiment)
    else:
        around = Around(experiment.data)
        found = Inference(*model_about(experiment.setup, around), None, 1, around)
    information, posterior = found.model.inform(experiment.data.data)
    return information, replace(found, posterior=posterior)
