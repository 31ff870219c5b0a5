"""The joint posterior of the component maps, from the information of every channel."""

from __future__ import annotations

from dataclasses import replace

import jax
import numpy as np

from lusee_bayes.core.engine import Engine
from lusee_bayes.core.progress import Stages
from lusee_bayes.experiment.scenario import Scenario
from lusee_bayes.linear.joint import component_posterior
from lusee_bayes.linear.joint_skies import paired
from lusee_bayes.linear.posterior import Posterior
from lusee_bayes.results.channel_files import ChannelFiles
from lusee_bayes.results.cube import Components
from lusee_bayes.results.draws import draw_key
from lusee_bayes.results.joint_channels import ChannelsInFiles
from lusee_bayes.results.positive_components import positive_mode
from lusee_bayes.sky.spectral_prior import SpectralPrior


def solve_components(
    scenario: Scenario, files: ChannelFiles, n_draws: int, engine: Engine, stages: Stages
) -> Components:
    """Work out the joint posterior from the files of all channels.

    Parameters
    ----------
    scenario : Scenario
        Of several frequencies.
    files : ChannelFiles
        With the information of every channel.
    n_draws : int
        Draws of the component maps.
    engine : Engine
        What carries out the channels.
    stages : Stages
        Told what is being done.

    Raises
    ------
    InputError
        If data are too precise to be solved for, or positive skies do not settle.
    """
    channels = scenario.channels()
    at_hand = ChannelsInFiles(channels, files, engine, stages)
    if scenario.spectral.model == "positive":
        return _positive(scenario, at_hand, n_draws, stages)
    small = [files.read(channel, "information", ["reference", "sky"]) for channel in channels]
    reference = np.array([np.asarray(s["reference"]) for s in small])
    skies = np.array([np.asarray(s["sky"]) for s in small])
    prior = scenario.spectral.prior(np.array(scenario.frequencies_mhz), skies)
    return _direct(prior, scenario, at_hand, reference, n_draws, stages)


def _positive(
    scenario: Scenario, channels: ChannelsInFiles, n_draws: int, stages: Stages
) -> Components:
    mode = positive_mode(scenario, channels, stages)
    with stages("joint posterior"):
        found = _gaussian(mode.prior, mode.posterior, scenario, n_draws, mode.energy)
    return replace(found, refinement=mode.moved, mode=mode)


def _direct(
    prior: SpectralPrior,
    scenario: Scenario,
    channels: ChannelsInFiles,
    reference: np.ndarray,
    n_draws: int,
    stages: Stages,
) -> Components:
    information = channels.summed(prior, reference, lambda _, information: information)
    with stages("joint posterior"):
        posterior = component_posterior(information, prior)
        chi2 = float(information.chi2(posterior.mean) + posterior.prior_chi2())
        return _gaussian(prior, posterior, scenario, n_draws, chi2)


def _gaussian(
    prior: SpectralPrior,
    posterior: Posterior,
    scenario: Scenario,
    n_draws: int,
    chi2: float,
) -> Components:
    components, modes = prior.n_components, posterior.mean.shape[0] // prior.n_components
    spread = jax.block_until_ready(paired(posterior.covariance(), prior))
    draws = posterior.sample(draw_key(scenario), n_draws)
    return Components(
        prior,
        posterior.mean.reshape(components, modes),
        spread,
        draws.reshape(n_draws, components, modes),
        chi2,
        float(posterior.log_evidence),
        float(posterior.information_bits()),
        float(posterior.refinement),
    )
