"""A map run of several frequencies: every channel by itself, or all in one posterior."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from threading import get_ident

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from lusee_bayes.channels import (
    DRAWS,
    Channel,
    ChannelFiles,
    Told,
    each_channel,
    identity_of,
    result_dataset,
)
from lusee_bayes.checks import InputError
from lusee_bayes.devices import Fleet
from lusee_bayes.information import Information
from lusee_bayes.iterative_joint import DIRECT_UNKNOWNS, solve_iteratively
from lusee_bayes.joint import ComponentSums, channel_sky, component_posterior, paired, summed
from lusee_bayes.progress import Stages
from lusee_bayes.scenario import Scenario
from lusee_bayes.spectral_prior import SpectralPrior

# draws where conjugate gradients have no other way to tell standard deviations
LEAST_DRAWS = 50


@dataclass(frozen=True)
class Components:
    """The joint posterior of the component maps, in K.

    mean : (components, modes); spread : their covariance (``joint.paired``), None after conjugate
    gradients, which have no evidence either (NaN); draws : (n, components, modes); chi2 : of all
    data under the model, prior included: chi^2 of N_data if it holds; refinement : distance left in
    standard deviations
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


@dataclass(frozen=True)
class ChannelRun:
    """A run of several frequencies whose channels' results are in their files."""

    scenario: Scenario
    channels: list[Channel]
    files: ChannelFiles
    components: Components | None
    seconds: dict[str, float]

    @classmethod
    def make(
        cls,
        scenario: Scenario,
        folder: Path,
        *,
        data: Path | None = None,
        truth: bool = False,
        n_draws: int = 0,
        fleet: Fleet | None = None,
        stages: Stages | None = None,
    ) -> ChannelRun:
        """Work out all channels, going on from what an interrupted run has left in ``folder``.

        To be called by every process of ``fleet``. InputError for a scenario without frequencies,
        or one in which something is to be sampled.
        """
        fleet, stages = fleet or Fleet(), stages or Stages()
        if not scenario.frequencies_mhz:
            raise InputError("the scenario names no frequencies_mhz; give --frequencies")
        iterative = scenario.joint and _solver(scenario) == "conjugate_gradients"
        if iterative:
            n_draws = max(n_draws, LEAST_DRAWS)
        files = ChannelFiles(folder, identity_of(scenario, data, truth, n_draws))
        channels = [Channel(s, data, truth) for s in scenario.channels()]

        def observe(channel: Channel) -> None:
            if files.has(channel, "information" if scenario.joint else "result"):
                return
            told = Told.of(channel, n_draws if iterative else 0)
            if scenario.joint:
                files.write(channel, "information", told.to_dataset())
                return
            sky, nside = told.alone(channel, n_draws), channel.scenario.map_nside
            files.write(channel, "result", result_dataset(sky, told, nside))

        each_channel(observe, channels, fleet, stages, "channels")
        fleet.barrier("channels")
        components = None
        if scenario.joint:
            components = _components(scenario, channels, files, n_draws, fleet, stages)
            _joint_skies(components, scenario, channels, files, fleet, stages)
            fleet.barrier("joint")
        return cls(scenario, channels, files, components, stages.seconds)


def spectral_prior(scenario: Scenario, skies: np.ndarray) -> SpectralPrior:
    """The scenario's prior on the skies of all its channels, of which ``skies`` are the models."""
    section = scenario.spectral
    frequencies = np.array(scenario.frequencies_mhz)
    common = {"index": section.index, "reference_mhz": section.reference_mhz}
    if section.model == "components":
        return SpectralPrior.components(
            frequencies,
            skies,
            section.components,
            turnover_mhz=section.turnover_mhz,
            residual=section.residual,
            **common,
        )
    residual = {} if section.residual is None else {"residual": section.residual}
    return SpectralPrior.kernel(frequencies, skies, length=section.length, **common, **residual)


def _solver(scenario: Scenario) -> str:
    """The joint solver: the scenario's, or the one that fits."""
    if scenario.spectral.solver != "auto":
        return scenario.spectral.solver
    if scenario.spectral.model == "kernel":
        # as many principal spectra as matter: known once the prior is made, at most the channels
        prior = spectral_prior(scenario, np.ones((len(scenario.frequencies_mhz), 1)))
        count = prior.n_components
    else:
        count = len(scenario.spectral.components)
    fits = count * (scenario.lmax + 1) ** 2 <= DIRECT_UNKNOWNS
    return "direct" if fits else "conjugate_gradients"


def _components(
    scenario: Scenario,
    channels: list[Channel],
    files: ChannelFiles,
    n_draws: int,
    fleet: Fleet,
    stages: Stages,
) -> Components:
    small = [files.read(channel, "information", ["about", "sky"]) for channel in channels]
    about = np.array([np.asarray(s["about"]) for s in small])
    prior = spectral_prior(scenario, np.array([np.asarray(s["sky"]) for s in small]))
    key = jax.random.fold_in(jax.random.key(scenario.seed), DRAWS)
    if _solver(scenario) == "direct":
        return _direct(prior, channels, files, about, key, n_draws, fleet, stages)
    section = scenario.spectral
    with stages.progress("conjugate gradients", section.iterations) as report:
        found = solve_iteratively(
            prior,
            _informations(channels, files),
            about,
            key,
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


def _informations(channels: list[Channel], files: ChannelFiles) -> Iterator[Information]:
    for channel in channels:
        yield Told.from_dataset(files.read(channel, "information")).information


def _direct(
    prior: SpectralPrior,
    channels: list[Channel],
    files: ChannelFiles,
    about: np.ndarray,
    key: Array,
    n_draws: int,
    fleet: Fleet,
    stages: Stages,
) -> Components:
    start = ComponentSums.empty(prior, about)
    lanes: dict[int, ComponentSums] = {}
    number = {channel.name: k for k, channel in enumerate(channels)}

    def add(channel: Channel) -> None:
        (told,) = _informations([channel], files)
        # every thread has sums of its own, on its device
        before = lanes.get(get_ident())
        if before is None:
            before = ComponentSums.empty(prior, about)
        after = summed(before, prior, number[channel.name], told)
        lanes[get_ident()] = jax.block_until_ready(after)

    each_channel(add, channels, fleet, stages, "joint sums")
    with stages("joint posterior"):
        leaves, shape = jax.tree.flatten(start)
        parts = [jax.tree.leaves(lane) for lane in lanes.values()]
        # everything but the maps that all is written about is a sum
        whole = [
            leaf
            if leaf is start.about
            else jnp.asarray(
                fleet.total(np.asarray(sum(np.asarray(part[k]) for part in [*parts, leaves])))
            )
            for k, leaf in enumerate(leaves)
        ]
        told = jax.tree.unflatten(shape, whole).information()
        posterior = component_posterior(told, prior)
        chi2 = float(told.chi2(posterior.mean) + (posterior.white_mean**2).sum())
        components, modes = prior.n_components, posterior.mean.shape[0] // prior.n_components
        spread = jax.block_until_ready(paired(posterior.covariance(), prior))
        draws = posterior.sample(key, n_draws)
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


def _joint_skies(
    components: Components,
    scenario: Scenario,
    channels: list[Channel],
    files: ChannelFiles,
    fleet: Fleet,
    stages: Stages,
) -> None:
    number = {channel.name: k for k, channel in enumerate(channels)}
    key = jax.random.fold_in(jax.random.key(scenario.seed), DRAWS)

    def write(channel: Channel) -> None:
        if files.has(channel, "result"):
            return
        told = Told.from_dataset(files.read(channel, "information"))
        sky = channel_sky(
            components.prior,
            number[channel.name],
            told.information,
            components.mean,
            components.spread,
            components.draws,
            key,
        )
        files.write(channel, "result", result_dataset(sky, told, scenario.map_nside))

    each_channel(write, channels, fleet, stages, "joint skies")
