"""The channel of a posterior with its model at hand: that of a map of one frequency."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from lusee_bayes.core.harmonics import mean_over_m
from lusee_bayes.experiment.experiment import Experiment
from lusee_bayes.experiment.plausibility import about_information
from lusee_bayes.experiment.rounds import Inference
from lusee_bayes.linear.metrics import expected_chi2, highest_altitude
from lusee_bayes.linear.pixel_variance import pixel_std
from lusee_bayes.results.channel import ChannelResult
from lusee_bayes.results.coverage import Counts
from lusee_bayes.results.draws import deviations, doubts, posterior_draws


def channel_of_posterior(
    experiment: Experiment,
    inference: Inference,
    covariance: Float[np.ndarray, "modes modes"],
    *,
    n_draws: int = 0,
    judged: Inference | None = None,
) -> ChannelResult:
    """The channel of a posterior over harmonic coefficients.

    Parameters
    ----------
    experiment : Experiment
    inference : Inference
        The posterior, and the model of the data.
    covariance : (modes, modes) array
        In K^2.
    n_draws : int
        How many draws of the posterior to keep.
    judged : Inference, optional
        The model that predicts the data and its posterior, where earlier data were there.
    """
    scenario, data, posterior = experiment.scenario, experiment.data, inference.posterior
    judged, found = inference if judged is None else judged, ()
    prior_variance = np.asarray(inference.model.prior.variance())
    std, width = np.sqrt(np.diagonal(covariance)), pixel_std(covariance, scenario.map_nside)
    fraction = np.divide(std**2, prior_variance, out=np.zeros(len(std)), where=prior_variance > 0)
    mean = np.asarray(posterior.mean)
    truth = None if data.truth is None else np.asarray(data.truth)
    if truth is not None:
        found = Counts.of_pixels(width, truth - mean, deviations(experiment, posterior)).coverage()
    return ChannelResult(
        frequency_mhz=scenario.frequency_mhz,
        mean=mean,
        std=std,
        prior_std=np.sqrt(prior_variance),
        prior_fraction=mean_over_m(fraction),
        pixel_std=width,
        highest_altitude=highest_altitude(data.observation, scenario.map_nside),
        draws=posterior_draws(experiment, posterior, n_draws),
        truth=truth,
        independent=None,
        log_evidence=float(posterior.log_evidence),
        information_bits=float(posterior.information_bits()),
        chi2=float(inference.model.chi2(posterior.mean, data.data)),
        chi2_expected=expected_chi2(judged.posterior, inference.model.n_data),
        chi2_model=float(judged.model.chi2(judged.posterior.mean, data.data))
        + float(judged.posterior.prior_chi2()),
        refinement=float(posterior.refinement),
        n_data=inference.model.n_data,
        n_missing=data.n_missing,
        rounds=inference.rounds,
        doubts=(
            *doubts(experiment, inference),
            *about_information(float(posterior.information_bits())),
        ),
        coverage=found,
    )
