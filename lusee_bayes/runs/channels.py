"""The channels of a cube, each by itself, tied, or in one posterior; a stopped run goes on.

Channels are worked out alone, and then all together where a joint posterior of component maps, or
positive skies, are asked for, from the information of every channel.

Where receivers have smooth spectra, channels are tied. What port i's power is off by, z_i(f) in
prior standard deviations, is a Gaussian process::

    K(f, f') = exp(-(log2 f - log2 f')^2 / (2 smooth_octaves^2)),    ports independent.

A channel alone has z ~ N(0, 1), as its diagonal says. Its posterior of sky m and powers z, with
means E and covariance V of z, becomes that given all data (:mod:`.amplitudes`) by ::

    mean of m + G (E' - E),    covariance of m + G (V' - V) G^T,    G = Cov(m, z) V^-1,

since m depends on other channels through z alone, and so do ground and gains.

Unfinished work is kept in files: ``DIR/channels/25.information.nc`` holds what its data say,
``25.result.nc`` its posterior. So memory stays bounded, and an interrupted run goes on where it
was. Files of other scenarios or data are made anew. A joint posterior adds up what the files of all
channels say.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import h5py
import jax
import numpy as np
from jaxtyping import Float, Int, PRNGKeyArray

from lusee_bayes.core import formats
from lusee_bayes.core.engine import Engine, Tasks, ThisProcess
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.formats import says
from lusee_bayes.core.progress import Stages
from lusee_bayes.core.trees import StoredTree, from_tree, write_tree
from lusee_bayes.core.version import __version__
from lusee_bayes.experiment.data_files import Data, anchored, digest_of
from lusee_bayes.experiment.experiment import build, draw_key
from lusee_bayes.experiment.scenario import Scenario
from lusee_bayes.experiment.unknowns import Unknowns
from lusee_bayes.judge.coverage import N_DRAWS
from lusee_bayes.linear.amplitudes import Amplitudes, Tied, information_given, tie, told_by_others
from lusee_bayes.linear.information import Information
from lusee_bayes.linear.joint import (
    ComponentSums,
    channel_sky,
    component_posterior,
    paired,
    summed_information,
)
from lusee_bayes.linear.positive_joint import (
    COARSE_LMAX,
    MAX_ROUNDS,
    PositiveMode,
    find_joint_mode,
    learn_laws,
    positive_sky,
)
from lusee_bayes.results.channel import ChannelData, ChannelResult
from lusee_bayes.results.channel_map import Conditioned, channel_result, conditioned
from lusee_bayes.results.map_files import information_file, read_information
from lusee_bayes.results.map_result import Components, MapResult
from lusee_bayes.runs.cost import measured_experiment
from lusee_bayes.sky.spectral_prior import SpectralPrior
from lusee_bayes.systematics.receivers import is_receiver

T = TypeVar("T")
CHANNELS = "channels"


class ChannelFiles:
    """The files of a run's channels.

    Parameters
    ----------
    folder : Path
        Of the run.
    identity : str
        Of the run (:func:`identity_of`), whose files alone are taken up again.
    """

    def __init__(self, folder: Path, identity: str):
        self.folder = folder / CHANNELS
        self.identity = identity

    def path(self, scenario: Scenario, kind: str) -> Path:
        """Of the ``information`` or the ``result`` of a channel."""
        return self.folder / f"{scenario.frequency_mhz:.15g}.{kind}.nc"

    def has(self, scenario: Scenario, kind: str) -> bool:
        """Whether it is there, whole and of this run."""
        return says(self.path(scenario, kind), {"identity": self.identity})

    def write(self, scenario: Scenario, kind: str, value: Any) -> None:
        """Write a dataclass whole or not at all."""
        path = self.path(scenario, kind)
        write_tree(path, value, formats.CHANNEL, {"identity": self.identity})

    def read(self, scenario: Scenario, kind: str, of: type[T], part: str = "/") -> T:
        """Read what was written, or a part of it by its path."""
        path = self.path(scenario, kind)
        with h5py.File(path) as file:
            return from_tree(of, StoredTree(file[part]), str(path))

    def arrays(self, scenario: Scenario, kind: str, *names: str) -> list[np.ndarray]:
        """Read some arrays of it, by their paths."""
        with h5py.File(self.path(scenario, kind)) as file:
            return [file[name][()] for name in names]


def identity_of(scenario: Scenario, data: Data | None, *others: object) -> str:
    """Of all that the results of a run depend on: scenario, data, others, and the package.

    Raises
    ------
    InputError
        If there are no data at the path.
    """
    parts = [scenario.to_yaml(), *map(str, others), __version__]
    if data is not None:
        parts.append(digest_of(data))
    return hashlib.sha256(json.dumps(parts).encode()).hexdigest()


@dataclass(frozen=True)
class ChannelInformation:
    """What a channel's data say, with what it takes to make a posterior of it and to judge it.

    Attributes
    ----------
    information : Information
    known : ChannelData
    unknowns : Unknowns or None
        Receivers, ground and gain table given the sky, where the model has them.
    sky : (modes,) array
        The scenario's model sky, in K.
    """

    information: Information
    known: ChannelData
    unknowns: Unknowns | None
    sky: Float[np.ndarray, " mode"]


# channels that one task adds up, one after the other
BLOCK = 4


@dataclass(frozen=True)
class ChannelsInFiles:
    """Channels whose information is read from files, by whatever carries out the tasks.

    Attributes
    ----------
    channels : tuple of Scenario
        Of the whole run.
    files : ChannelFiles
        With the information of every channel.
    engine : Engine
    stages : Stages
        Told what is being done.
    """

    channels: tuple[Scenario, ...]
    files: ChannelFiles
    engine: Engine
    stages: Stages

    def each(
        self,
        function: Callable[[int, Information], dict[str, np.ndarray]],
        shapes: dict[str, tuple[int, ...]],
    ) -> dict[str, np.ndarray]:
        """Call a function with number and information of every channel; its arrays, stacked."""
        files, channels = self.files, self.channels

        def call(number: int) -> dict[str, np.ndarray]:
            return function(number, _information(files, channels[number]))

        numbers = range(len(channels))
        tasks = Tasks(call, numbers, [names_of(channels[k : k + 1]) for k in numbers])
        found = self.engine.each(tasks, self.stages, "joint sums")
        return {name: np.stack([np.asarray(one[name]) for one in found]) for name in shapes}

    def summed(
        self,
        prior: SpectralPrior,
        reference: Float[np.ndarray, "channels modes"],
        function: Callable[[int, Information], Information],
    ) -> Information:
        """What a function of every channel's information says of the component maps."""
        files, channels = self.files, self.channels

        def add(numbers: range) -> ComponentSums:
            sums = ComponentSums.empty(prior, reference)
            for number in numbers:
                information = function(number, _information(files, channels[number]))
                sums = summed_information(sums, prior, number, information)
            return sums

        # the same blocks, and the same tree of them, whatever carries out the tasks
        blocks = [
            range(first, min(first + BLOCK, len(channels)))
            for first in range(0, len(channels), BLOCK)
        ]
        names = [names_of(channels[block.start : block.stop]) for block in blocks]
        tasks = Tasks(add, blocks, names)
        return self.engine.reduced(
            tasks, ComponentSums.plus, self.stages, "joint sums"
        ).information()


def names_of(channels: tuple[Scenario, ...]) -> str:
    """What one channel, or neighbouring ones, are called: 25 MHz, or 25 to 28 MHz."""
    first, last = (f"{c.frequency_mhz:g}" for c in (channels[0], channels[-1]))
    return f"{first} MHz" if len(channels) == 1 else f"{first} to {last} MHz"


def _information(files: ChannelFiles, channel: Scenario) -> Information:
    return files.read(channel, "information", Information, "information")


def positive_mode(scenario: Scenario, channels: ChannelsInFiles, stages: Stages) -> PositiveMode:
    """Find the most probable skies of all channels.

    Parameters
    ----------
    scenario : Scenario
        Of positive joint skies.
    channels : ChannelsInFiles
    stages : Stages
        Told what is being done.

    Raises
    ------
    InputError
        As :func:`.find_joint_mode`.
    """
    with stages("templates"):
        skies = scenario.spectral.positive_skies(scenario.frequencies_mhz, scenario.lmax)
    silent = replace(channels, stages=Stages())
    coarse = scenario.spectral.lmax_of_fields(min(scenario.lmax, COARSE_LMAX))
    with stages.progress("laws of the fields", MAX_ROUNDS) as report:
        laws = learn_laws(skies, silent, lmax_fields=coarse, report=report)
    with stages.progress("positive skies", MAX_ROUNDS) as report:
        return find_joint_mode(skies, laws, silent, report=report)


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
    at_hand, mode = ChannelsInFiles(channels, files, engine, stages), None
    if scenario.spectral.model == "positive":
        mode = positive_mode(scenario, at_hand, stages)
        prior, posterior, chi2 = mode.prior, mode.posterior, mode.energy
    else:
        names = ("information/reference", "sky")
        small = [files.arrays(channel, "information", *names) for channel in channels]
        reference, skies = map(np.array, zip(*small, strict=True))
        prior = scenario.spectral.prior(np.array(scenario.frequencies_mhz), skies)
        information = at_hand.summed(prior, reference, lambda _, information: information)
    with stages("joint posterior"):
        if mode is None:
            posterior = component_posterior(information, prior)
            chi2 = float(information.chi2(posterior.mean) + posterior.prior_chi2())
        shape = (prior.n_components, posterior.mean.shape[0] // prior.n_components)
        return Components(
            prior,
            posterior.mean.reshape(shape),
            jax.block_until_ready(paired(posterior.covariance(), prior)),
            posterior.sample(draw_key(scenario), n_draws).reshape(n_draws, *shape),
            chi2,
            float(posterior.log_evidence),
            float(posterior.information_bits()),
            float(posterior.refinement) if mode is None else mode.moved,
            mode=mode,
        )


# what the key of draws is folded with: numbers of channels are smaller
TIED = 1 << 20


@dataclass(frozen=True)
class ChannelAlone:
    """A channel's posterior given its own data, as it is kept until all channels are known.

    Attributes
    ----------
    known : ChannelData
    information : Information
        Of its own data.
    unknowns : Unknowns
        Receivers, ground and gain table given the sky.
    mean, covariance : (modes,) and (modes, modes) array
        In K and K^2.
    deviations : (all, modes) array
        Draws less the mean, those that are kept first, then those that coverage is compared with,
        in K.
    n_draws : int
        That are kept.
    figures : dict
        :meth:`.Conditioned.figures`.
    """

    known: ChannelData
    information: Information
    unknowns: Unknowns
    mean: Float[np.ndarray, " mode"]
    covariance: Float[np.ndarray, "mode mode_2"]
    deviations: Float[np.ndarray, "all mode"]
    n_draws: int
    figures: dict[str, float | bool]

    def receivers(self) -> tuple[Float[np.ndarray, " ports"], Float[np.ndarray, "ports ports"]]:
        """E and V of the receivers' powers, in prior standard deviations."""
        told, own = self._told(), self._own()
        return told.mean[own], told.covariance[np.ix_(own, own)]

    def _told(self) -> Amplitudes:
        return self.unknowns.amplitudes.integrated(self.mean, self.covariance)

    def _own(self) -> Int[np.ndarray, " ports"]:
        """Which unknowns are powers of receivers."""
        return np.flatnonzero([is_receiver(row["unknown"]) for row in self.unknowns.rows])

    def tied(
        self,
        mean: Float[np.ndarray, " ports"],
        covariance: Float[np.ndarray, "ports ports"],
        draws: Float[np.ndarray, "all ports"],
        key: PRNGKeyArray,
    ) -> ChannelResult:
        """The channel given all data.

        Parameters
        ----------
        mean, covariance : (ports,) and (ports, ports) array
            E' and V' of its receivers' powers.
        draws : (all, ports) array
            Of these, for ``deviations``.
        key : PRNG key
            For the powers that go with the channel's own draws.
        """
        told, own = self._told(), self._own()
        e, v = told.mean[own], told.covariance[np.ix_(own, own)]
        gain = np.linalg.solve(v, told.with_sky[:, own].T).T
        moved = self.mean + gain @ (mean - e)
        left = self.covariance + gain @ (covariance - v) @ gain.T
        # powers that go with the channel's own draws, less their mean
        amplitudes = self.unknowns.amplitudes
        inner = amplitudes.covariance[np.ix_(own, own)]
        normals = np.asarray(jax.random.normal(key, (len(self.deviations), len(own))))
        variances, axes = np.linalg.eigh(inner)
        normals = (normals * np.sqrt(np.maximum(variances, 0.0))) @ axes.T
        with_them = normals - self.deviations @ amplitudes.pull[own].T
        deviations = self.deviations + (draws - mean - with_them) @ gain.T
        # what the other channels tell of this one's unknowns
        n = len(amplitudes.mean)
        precision, vector = np.zeros((n, n)), np.zeros(n)
        precision[np.ix_(own, own)], vector[own] = told_by_others(e, v, mean, covariance)
        unknowns = replace(self.unknowns, amplitudes=amplitudes.given(precision, vector))
        sky_share = np.linalg.solve(v, (np.linalg.solve(v, v - inner)).T)
        gained = np.linalg.slogdet(np.eye(len(own)) + (covariance - v) @ sky_share)[1]
        bits = self.figures["information_bits"] - 0.5 * gained / np.log(2.0)
        information = information_given(self.information, amplitudes, precision, vector)
        skies = moved + deviations[: self.n_draws]
        return channel_result(
            self.known,
            moved,
            left,
            skies,
            information.log_likelihood(skies),
            deviations[self.n_draws :],
            unknowns=unknowns.report(moved, left),
            **(self.figures | information.fit(moved, left) | {"information_bits": float(bits)}),
        )


def kernel(
    frequencies_mhz: Float[np.ndarray, " channels"], octaves: float
) -> Float[np.ndarray, "channels channels"]:
    """K of the module's equations, with a port's values at all frequencies."""
    x = np.log2(frequencies_mhz) / octaves
    return np.exp(-0.5 * (x[:, None] - x[None]) ** 2)


def tie_receivers(scenario: Scenario, channels: Sequence[Scenario], files: ChannelFiles) -> Tied:
    """The receivers' powers given the data of all channels, from what is kept of each alone.

    Parameters
    ----------
    scenario : Scenario
        Of several frequencies.
    channels : sequence of Scenario
        That could be mapped.
    files : ChannelFiles

    Raises
    ------
    InputError
        As :func:`.tie`.
    """
    means, covariances, n_draws = [], [], 0
    for channel in channels:
        alone = files.read(channel, "alone", ChannelAlone)
        mean, covariance = alone.receivers()
        means.append(mean)
        covariances.append(covariance)
        n_draws = len(alone.deviations)
    own = jax.random.fold_in(draw_key(scenario), TIED)
    normals = np.asarray(jax.random.normal(own, (n_draws, sum(map(len, means)))))
    frequencies = np.array([channel.frequency_mhz for channel in channels])
    ties = kernel(frequencies, scenario.noise.receiver.smooth_octaves)
    return tie(np.stack(means), np.stack(covariances), ties, normals)


def _write_tied_sky(
    channels: Sequence[Scenario], tied: Tied, files: ChannelFiles, number: int
) -> None:
    """Write the result of one channel, unless it is there."""
    channel = channels[number]
    if files.has(channel, "result"):
        return
    alone = files.read(channel, "alone", ChannelAlone)
    key = jax.random.fold_in(draw_key(channel), TIED + 1)
    found = alone.tied(tied.mean[number], tied.covariance[number], tied.draws[:, number], key)
    files.write(channel, "result", found)


def map_channels(
    scenario: Scenario,
    folder: Path,
    *,
    data: Data | None = None,
    truth: bool = False,
    earlier: str | Path | None = None,
    thorough: bool = False,
    engine: Engine | None = None,
    stages: Stages | None = None,
) -> MapResult:
    """Work out all channels, going on from what an interrupted run has left in ``folder``.

    Where receivers have smooth spectra, each channel is worked out alone, and then given what the
    others tell of its receivers. A channel that cannot be mapped leaves the others as they are: it
    is named in the result, and a joint posterior is that of the others. Of a single frequency
    nothing unfinished is kept.

    Parameters
    ----------
    scenario : Scenario
        Of one frequency or of several.
    folder : Path
        Of the run; unfinished work is kept in it.
    data : Visibilities, path, or sequence of them, optional
        Measured; without them the scenario's own are simulated.
    truth : bool
        The data are of the scenario's own sky.
    earlier : path, optional
        Folder of a run that has kept its information, to whose data these are added.
    thorough : bool
        Judge groups of data and try the usual mistakes even if the data fit.
    engine : Engine, optional
        What carries out the channels; by default this process.
    stages : Stages, optional
        Told what is being done.

    Raises
    ------
    InputError
        If no channel can be mapped, if too few of them can for a joint posterior, or as
        :func:`.conditioned`.
    """
    engine, stages, single = engine or ThisProcess(), stages or Stages(), scenario.single
    # workers may have other folders of their own
    data = None if data is None else anchored(data)
    kept = None if earlier is None else information_file(earlier)

    def condition(channel: Scenario, told: Stages) -> Conditioned:
        before = None if kept is None else read_information(kept, channel)
        information = None if before is None else before.information
        make = partial(build, earlier=information)
        experiment = measured_experiment(channel, data, told, truth=truth, make=make)
        return conditioned(experiment, before, told)

    if single:
        made = condition(scenario, stages)
        known = made.known(stages, alone=True, thorough=thorough)
        return MapResult(scenario, (made.result(known, stages),), seconds=stages.seconds)
    engine.work_in(folder)
    n_draws = scenario.output.draws
    digest = None if kept is None else digest_of(kept)
    identity = identity_of(scenario, data, truth, digest, thorough)
    files = ChannelFiles(folder.resolve(), identity)
    channels = tuple(channel.anchored() for channel in scenario.channels())
    names, tied = [names_of((channel,)) for channel in channels], scenario.ties_receivers
    wanted = "information" if scenario.joint else "alone" if tied else "result"

    def observe(channel: Scenario) -> None:
        if files.has(channel, wanted):
            return
        silent = Stages()
        made = condition(channel, silent)
        known = made.known(silent, alone=False, thorough=thorough)
        if scenario.joint:
            sky = np.asarray(made.experiment.setup.sky.modes)
            known = made.of_all(known)
            found = ChannelInformation(made.information, known, made.unknowns, sky)
            files.write(channel, wanted, found)
        elif tied:
            compared = made.compared()
            deviations = [
                made.draws - made.posterior.mean,
                *([] if compared is None else [compared]),
            ]
            alone = ChannelAlone(
                known,
                made.information,
                made.unknowns,
                made.posterior.mean,
                made.covariance,
                np.concatenate(deviations),
                n_draws,
                made.figures(),
            )
            files.write(channel, wanted, alone)
        else:
            files.write(channel, wanted, made.result(known, silent))

    def refusal(channel: Scenario) -> str:
        try:
            observe(channel)
        except InputError as error:
            return str(error)
        return ""

    refusals = engine.each(Tasks(refusal, channels, names), stages, "channels")
    unmapped = {c.frequency_mhz: r for c, r in zip(channels, refusals, strict=True) if r}
    mapped = tuple(c for c in channels if c.frequency_mhz not in unmapped)
    if not mapped:
        raise InputError(f"no channel can be mapped: {_reasons(unmapped)}")
    components, tie_log_evidence = None, 0.0
    numbers, names = range(len(mapped)), [names_of((channel,)) for channel in mapped]
    if tied:
        receivers = tie_receivers(scenario, mapped, files)
        tie_log_evidence = receivers.log_evidence
        write = partial(_write_tied_sky, mapped, receivers, files)
        engine.each(Tasks(write, numbers, names), stages, "smooth receivers")
    if scenario.joint:
        left = _without(unmapped, scenario)
        # coverage is compared with draws
        known = data is None or truth
        n_solved = max(n_draws, N_DRAWS) if known else n_draws
        components = solve_components(left, files, n_solved, engine, stages)
        # for workers of other processes
        write = partial(_write_joint_sky, mapped, components, scenario, files)
        engine.each(Tasks(write, numbers, names), stages, "joint skies")
    found = tuple(files.read(c, "result", ChannelResult) for c in mapped)
    seconds, tied_evidence = stages.seconds, {"tie_log_evidence": tie_log_evidence}
    return MapResult(scenario, found, components, seconds, unmapped, **tied_evidence)


def _without(unmapped: dict[float, str], scenario: Scenario) -> Scenario:
    """A joint scenario of the channels that can be mapped. InputError if these are too few."""
    left = tuple(f for f in scenario.frequencies_mhz if f not in unmapped)
    try:
        scenario.spectral.require_channels(len(left))
    except InputError as error:
        raise InputError(f"{error}; not mapped: {_reasons(unmapped)}") from error
    return scenario.model_copy(update={"frequencies_mhz": left})


def _reasons(unmapped: dict[float, str]) -> str:
    """Why channels cannot be mapped, each reason once."""
    alike: dict[str, list[str]] = {}
    for frequency, reason in unmapped.items():
        alike.setdefault(reason, []).append(f"{frequency:g}")
    return "; ".join(f"{', '.join(known)} MHz: {reason}" for reason, known in alike.items())


def _write_joint_sky(
    channels: tuple[Scenario, ...],
    components: Components,
    scenario: Scenario,
    files: ChannelFiles,
    number: int,
) -> None:
    channel, key, n_draws = channels[number], draw_key(scenario), scenario.output.draws
    if files.has(channel, "result"):
        return
    alone = files.read(channel, "information", ChannelInformation)
    information, draws = alone.information, components.draws
    if components.mode is not None:
        spread = np.asarray(components.spread)
        sky = positive_sky(components.mode, number, information, spread, np.asarray(draws), key)
    else:
        means = (components.mean, components.spread, draws)
        sky = channel_sky(components.prior, number, information, *means, key)
    skies = np.asarray(sky.draws[:n_draws])
    report = None
    if alone.unknowns is not None:
        report = alone.unknowns.report(sky.mean, sky.covariance, joint=True)
    found = channel_result(
        alone.known,
        sky.mean,
        sky.covariance,
        skies,
        information.log_likelihood(skies),
        np.asarray(sky.draws) - np.asarray(sky.mean),
        unknowns=report,
        independent=np.asarray(information.reference),
        covariance_kept=scenario.output.covariance,
        **information.fit(sky.mean, sky.covariance),
    )
    files.write(channel, "result", found)
