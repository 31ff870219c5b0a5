"""The joint posterior of the component maps, from the information of every channel."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from threading import get_ident

import jax
import numpy as np

from lusee_bayes.core.arrays import Array
from lusee_bayes.core.process_group import ProcessGroup
from lusee_bayes.core.progress import Stages
from lusee_bayes.experiment.scenario import Scenario
from lusee_bayes.linear.information import Information
from lusee_bayes.linear.iterative_joint import DIRECT_UNKNOWNS, solve_iteratively
from lusee_bayes.linear.joint import ComponentSums, component_posterior, summed
from lusee_bayes.linear.joint_skies import paired
from lusee_bayes.results.channel_files import ChannelFiles
from lusee_bayes.results.channel_information import ChannelInformation
from lusee_bayes.results.channel_threads import each_channel
from lusee_bayes.results.draws import draw_key
from lusee_bayes.sky.spectral_prior import SpectralPrior

# draws where conjugate gradients have no other way to tell standard deviations
LEAST_DRAWS = 50


@dataclass(frozen=True)
class Components:
    """The joint posterior of the component maps, in K.

    Attributes
    ----------
    prior : SpectralPrior
    mean : (components, modes) array
    spread : (pairs, modes, modes) array or None
        Their covariance (``joint.paired``); None after conjugate gradients.
    draws : (n, components, modes) array
    chi2 : float
        Of all data under the model, prior included: chi^2 of N_data if it holds. NaN, as evidence
        and information are, after conjugate gradients.
    log_evidence, information_bits : float
    refinement : float
        Distance left, in standard deviations.
    solver : str
    iterations : int
    """

    prior: SpectralPrior
    mean: Array
    spread: Array | None
    draws: Array
    chi2: float
    log_evidence: float
    information_bits: float
    refinement: float
    solver: str
    iterations: int


def is_iterative(scenario: Scenario) -> bool:
    """Whether a joint posterior is solved by conjugate gradients: as said, or as it fits."""
    section = scenario.spectral
    if section.solver != "auto":
        return section.solver == "conjugate_gradients"
    count = len(section.components)
    if section.model == "kernel":
        # as many principal spectra as matter: known once the prior is made, at most the channels
        frequencies = np.array(scenario.frequencies_mhz)
        count = section.prior(frequencies, np.ones((len(frequencies), 1))).n_components
    return count * (scenario.lmax + 1) ** 2 > DIRECT_UNKNOWNS


def solve_components(
    scenario: Scenario, files: ChannelFiles, n_draws: int, group: ProcessGroup, stages: Stages
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
    group : ProcessGroup
    stages : Stages
        Told what is being done.

    Raises
    ------
    InputError
        If conjugate gradients do not converge, or data are too precise to be solved for.
    """
    channels = scenario.channels()
    small = [files.read(channel, "information", ["reference", "sky"]) for channel in channels]
    reference = np.array([np.asarray(s["reference"]) for s in small])
    skies = np.array([np.asarray(s["sky"]) for s in small])
    prior = scenario.spectral.prior(np.array(scenario.frequencies_mhz), skies)
    if not is_iterative(scenario):
        return _direct(prior, scenario, files, reference, n_draws, group, stages)
    section = scenario.spectral
    with stages.progress("conjugate gradients", section.iterations) as report:
        found = solve_iteratively(
            prior,
            _informations(channels, files),
            reference,
            draw_key(scenario),
            tolerance=section.tolerance,
            iterations=section.iterations,
            report=report,
        )
    unknown = float("nan")
    return Components(
        prior,
        found.mean,
        None,
        found.draws,
        unknown,
        unknown,
        unknown,
        found.distance,
        "conjugate gradients",
        found.iterations,
    )


def _informations(channels: tuple[Scenario, ...], files: ChannelFiles) -> Iterator[Information]:
    for channel in channels:
        yield ChannelInformation.from_dataset(files.read(channel, "information")).information


def _direct(
    prior: SpectralPrior,
    scenario: Scenario,
    files: ChannelFiles,
    reference: np.ndarray,
    n_draws: int,
    group: ProcessGroup,
    stages: Stages,
) -> Components:
    channels = scenario.channels()
    start = ComponentSums.empty(prior, reference)
    by_thread: dict[int, ComponentSums] = {}
    number = {channel.frequency_mhz: k for k, channel in enumerate(channels)}

    def add(channel: Scenario) -> None:
        (information,) = _informations((channel,), files)
        # every thread has sums of its own, on its device
        before = by_thread.get(get_ident())
        if before is None:
            before = ComponentSums.empty(prior, reference)
        after = summed(before, prior, number[channel.frequency_mhz], information)
        by_thread[get_ident()] = jax.block_until_ready(after)

    each_channel(add, channels, group, stages, "joint sums")
    with stages("joint posterior"):
        leaves, shape = jax.tree.flatten(start)
        # with the empty ones: a process may have no channels
        parts = [jax.tree.leaves(sums) for sums in (start, *by_thread.values())]
        # everything but the maps that all is written about is a sum
        whole = [
            leaf
            if leaf is start.reference
            else group.total(np.asarray(sum(np.asarray(part[k]) for part in parts)))
            for k, leaf in enumerate(leaves)
        ]
        information = jax.tree.unflatten(shape, whole).information()
        posterior = component_posterior(information, prior)
        chi2 = float(information.chi2(posterior.mean) + posterior.prior_chi2())
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
        "direct",
        0,
    )
