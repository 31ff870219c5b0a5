"""The channels of a cube: independent, tied, or in one posterior; a stopped run can be resumed.

Channels are solved independently. A joint posterior of component maps, or of positive skies, is
then computed from the information in all channels.

Channels share the instrument. The error of an unknown, z(f) in prior standard deviations, is a
Gaussian process over frequency, independent of other unknowns, ::

    K(f, f') = exp(-(log2 f - log2 f')^2 / (2 octaves^2)).

Its systematic sets ``octaves`` (:meth:`.Systematic.octaves`): finite for receivers, which have
smooth spectra; infinite for antennas, clock, pointing and horizon, which have one value; zero for
gains, ground and all else that differs by channel. The diagonal of K gives z ~ N(0, 1) for a
channel alone. Its posterior of sky m and z, with mean E and covariance V of z, is updated with
all data (:mod:`.amplitudes`) to ::

    mean of m + G (E' - E),    covariance of m + G (V' - V) G^T,    G = Cov(m, z) V^-1,

because m, like all other unknowns, depends on other channels only through z. Unknowns are tied by
name; a channel that lacks one does not constrain it. Each channel is linearised about the values
from its own data. Tied values differ from these by at most about one of its standard deviations, so
the linearisation is as accurate as for the channel alone.

In a joint posterior, z = R w of all channels, w ~ N(0, 1), is unknown in addition to the component
maps, and each channel's data constrain both together (:mod:`.joint`).

Files store unfinished work: ``DIR/channels/25.information.nc`` the information in a channel's data,
``25.alone.nc`` its posterior given its own data, ``25.result.nc`` its posterior given all data. So
memory stays bounded, and an interrupted run can be resumed. Files of other scenarios or data are
replaced. A joint posterior sums the information in the files of all channels.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import jax
import numpy as np
from jaxtyping import Float

from lusee_bayes.core import formats, trees
from lusee_bayes.core.arrays import T
from lusee_bayes.core.engine import Engine, Tasks, ThisProcess
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.progress import Stages
from lusee_bayes.experiment.data_files import Data, anchored, digest_of
from lusee_bayes.experiment.experiment import build, draw_key
from lusee_bayes.experiment.scenario import Scenario
from lusee_bayes.experiment.unknowns import SkyAbove, Unknowns, amplitudes_of, in_common
from lusee_bayes.judge.cube_fit import SharedTest, shared_tests
from lusee_bayes.linear import joint, positive_joint
from lusee_bayes.linear.amplitudes import AlikeAbove, AlikeErrors, Tied, kernel, tie
from lusee_bayes.linear.information import Information
from lusee_bayes.linear.posterior import Posterior
from lusee_bayes.results import finished_runs, sky_spectrum
from lusee_bayes.results.channel import ChannelData, ChannelResult, SkyModes
from lusee_bayes.results.channel_map import Conditioned, channel_result, conditioned
from lusee_bayes.results.map_result import Components, MapResult
from lusee_bayes.runs.cost import measured_experiment
from lusee_bayes.runs.folder import identity_of
from lusee_bayes.sky.spectral_prior import SpectralPrior

CHANNELS = "channels"


@dataclass(frozen=True)
class ChannelFiles:
    """The files of a run's channels; those with another identity are not used.

    Attributes
    ----------
    folder : Path
        Folder of unfinished work.
    identity : str
        Identity of the run (:func:`identity_of`).
    again : set of float
        Frequencies of channels that were solved twice: the second solution is used.
    """

    folder: Path
    identity: str
    again: frozenset[float] = frozenset()

    def path(self, channel: Scenario, kind: type) -> Path:
        """File of a channel's stored dataclass, such as :class:`ChannelInformation`."""
        name = kind.__name__.removeprefix("Channel").lower()
        if kind is not ChannelResult and channel.frequency_mhz in self.again:
            name += ".again"
        return self.folder / f"{channel.frequency_mhz:.15g}.{name}.nc"

    def kept(self, channel: Scenario, kind: type[T], make: Callable[[], T]) -> T:
        """Read the file if it is complete and of this run; otherwise make and write it."""
        path = self.path(channel, kind)
        if formats.says(path, {"identity": self.identity}):
            return self.read(channel, kind)
        made = make()
        trees.write_tree(path, made, formats.CHANNEL, {"identity": self.identity})
        return made

    def read(self, channel: Scenario, kind: type[T]) -> T:
        """Read a stored dataclass."""
        path = self.path(channel, kind)
        with h5py.File(path) as file:
            return trees.from_tree(kind, trees.StoredTree(file), str(path))

    def information(self, channel: Scenario, number: int, tied: Tied | None) -> Information:
        """Read the information of a :class:`ChannelInformation`, with common unknowns if any."""
        return self.read(channel, ChannelInformation).whole(number, tied)


@dataclass(frozen=True)
class ChannelInformation:
    """The information in a channel's data, with everything needed for its posterior and tests.

    Attributes
    ----------
    information : Information
    known : ChannelData
    unknowns : Unknowns or None
        Receivers, ground and gain table given the sky, where the model has them.
    above : SkyAbove or None
    sky : (modes,) array
        The scenario's model sky, in K.
    share : Share or None
        Its constraints on the shared instrument.
    """

    information: Information
    known: ChannelData
    unknowns: Unknowns | None
    above: SkyAbove | None
    sky: Float[np.ndarray, " mode"]
    share: Share | None

    @classmethod
    def of(cls, made: Conditioned, data: ChannelData) -> ChannelInformation:
        """Make it from all data of a channel, earlier data included."""
        sky, share = np.asarray(made.experiment.setup.sky.modes), None
        if made.unknowns is not None and made.unknowns.shared.size:
            share = Share.of(made)
        return cls(made.information, made.of_all(data), made.unknowns, made.above, sky, share)

    def whole(self, number: int, tied: Tied | None) -> Information:
        """The information, with what the channel has in common with the others, if anything."""
        if tied is None:
            return self.information
        given = self.unknowns, self.above, tied, number, np.asarray(self.information.reference)
        return in_common(*given).information(self.information)

    def seen(self) -> Seen:
        """Inputs for the joint posterior: share, reference sky and model sky."""
        return Seen(self.share, np.asarray(self.information.reference), self.sky)

    def given(
        self, number: int, scenario: Scenario, tied: Tied | None, components: Components
    ) -> ChannelResult:
        """The channel given all data.

        Parameters
        ----------
        number : int
            Index of the channel in the joint posterior.
        scenario : Scenario
            The scenario of all channels.
        tied : Tied or None
            The prior of the shared unknowns, which every channel then has.
        components : Components
        """
        information, unknowns, data = self.whole(number, tied), self.unknowns, self.known
        n, key, n_draws = self.information.n_modes, draw_key(scenario), scenario.output.draws
        draws, spread, common = components.draws, components.spread, None
        if (mode := components.mode) is not None:
            sky = positive_joint.positive_sky(mode, number, information, spread, draws, key)
        else:
            means = (components.mean, spread, draws)
            sky = joint.channel_sky(components.prior, number, information, *means, key)
            common = partial(joint.sky_slopes, components.prior, number, information, sky.lower)
        mean, covariance, drawn = sky.mean[:n], sky.covariance[:n, :n], sky.draws[:, :n]
        if unknowns is not None:
            if tied is not None:
                reference = np.asarray(self.information.reference)
                shared = in_common(unknowns, self.above, tied, number, reference)
                given = amplitudes_of(unknowns, self.above, reference)
                unknowns = unknowns.given_all(given.with_shared(shared, sky.mean, sky.covariance))
            data = data.given(unknowns.table(mean, covariance))
        return channel_result(
            data,
            mean,
            covariance,
            drawn - mean,
            draws=drawn[:n_draws],
            log_likelihood=information.log_likelihood(sky.draws[:n_draws]),
            instrument=unknowns,
            common=common,
            joint=drawn,
            independent=np.asarray(self.information.reference),
            covariance_kept=scenario.output.covariance,
            **information.fit(sky.mean, sky.covariance),
        )


# number of channels that one task sums, one after the other
BLOCK = 8


@dataclass(frozen=True)
class ChannelsInFiles:
    """Channels whose information tasks read from files, wherever they run.

    Attributes
    ----------
    channels : tuple of Scenario
        All channels of the joint posterior.
    files : ChannelFiles
        With the information of every channel.
    engine : Engine
    stages : Stages
        Reports progress.
    tied : Tied or None
        The prior of the shared unknowns, which are then unknowns of the joint posterior, too.
    """

    channels: tuple[Scenario, ...]
    files: ChannelFiles
    engine: Engine
    stages: Stages
    tied: Tied | None = None

    def each(self, function: Callable[[int, Information], Any]) -> list[Any]:
        """Call a function with number and information of every channel."""
        files, channels, tied = self.files, self.channels, self.tied

        def call(number: int) -> Any:
            return function(number, files.information(channels[number], number, tied))

        tasks = Tasks(call, range(len(channels)), [names_of((one,)) for one in channels])
        return self.engine.each(tasks, self.stages, "joint sums")

    def summed(
        self,
        prior: SpectralPrior,
        reference: Float[np.ndarray, "channels modes"],
        function: positive_joint.Linearised,
    ) -> Information:
        """Apply a function to every channel's information, and sum it for the component maps."""
        files, channels, tied = self.files, self.channels, self.tied

        def add(numbers: range) -> joint.ComponentSums:
            sums = joint.ComponentSums.empty(prior, reference)
            for number in numbers:
                relative = function(number, files.information(channels[number], number, tied))
                sums = joint.summed_information(sums, prior, number, relative)
            return sums

        # the same blocks and the same summation tree, wherever tasks run
        numbers = range(len(channels))
        blocks = [numbers[first : first + BLOCK] for first in numbers[::BLOCK]]
        names = [names_of(channels[block.start : block.stop]) for block in blocks]
        return self.engine.reduced(
            Tasks(add, blocks, names), joint.ComponentSums.plus, self.stages, "joint sums"
        ).information()


def names_of(channels: tuple[Scenario, ...]) -> str:
    """Name of one channel, or of neighbouring ones: 25 MHz, or 25 to 28 MHz."""
    first, last = (f"{c.frequency_mhz:g}" for c in (channels[0], channels[-1]))
    return f"{first} MHz" if len(channels) == 1 else f"{first} to {last} MHz"


def solve_components(
    scenario: Scenario, channels: ChannelsInFiles, seen: Sequence[Seen], n_draws: int
) -> tuple[Components, Posterior]:
    """Compute the joint posterior of all channels.

    Parameters
    ----------
    scenario : Scenario
        The scenario of the channels.
    channels : ChannelsInFiles
    seen : sequence of Seen
        One for each channel.
    n_draws : int
        Number of draws of the component maps.

    Raises
    ------
    InputError
        If data are too precise for a solution, or positive skies do not converge.
    """
    spectral, stages, frequencies = scenario.spectral, channels.stages, scenario.frequencies_mhz
    tied, mode = channels.tied, None
    white = np.zeros(0) if tied is None else tied.start
    if spectral.model == "positive":
        with stages("templates"):
            skies = spectral.positive_skies(frequencies, scenario.lmax)
        silent = replace(channels, stages=Stages())
        coarse = spectral.lmax_of_fields(min(scenario.lmax, positive_joint.COARSE_LMAX))
        in_rounds = {"total": positive_joint.MAX_ROUNDS, "rounds": True}
        with stages.progress("laws of the fields", **in_rounds) as report:
            alone = replace(silent, tied=None)
            laws = positive_joint.learn_laws(skies, alone, lmax_fields=coarse, report=report)
        with stages.progress("positive skies", **in_rounds) as report:
            mode = positive_joint.find_joint_mode(skies, laws, silent, white, report=report)
        prior, posterior, chi2, moved = mode.prior, mode.posterior, mode.energy, mode.moved
    else:
        prior = spectral.prior(np.array(frequencies), np.array([one.sky for one in seen]))
        reference = np.array([np.concatenate([one.reference, white]) for one in seen])
        information = channels.summed(prior, reference, lambda _, information: information)
    with stages("joint posterior"):
        if mode is None:
            posterior = joint.component_posterior(information, prior)
            chi2 = float(information.chi2(posterior.mean) + posterior.prior_chi2())
            moved = float(posterior.refinement)
        spread = jax.block_until_ready(joint.paired(posterior.covariance(), prior))
        drawn = posterior.sample(draw_key(scenario), n_draws)
        figures = chi2, float(posterior.log_evidence), float(posterior.information_bits()), moved
        mean = np.asarray(posterior.mean)
        return Components(prior, mean, spread, drawn, *figures, mode), posterior


# folded into the random key of the draws; channel numbers are smaller
TIED = 1 << 20


@dataclass(frozen=True)
class Share:
    """Constraints from one channel on shared unknowns, for the other channels.

    octaves : of each shared unknown, by name; mean, covariance : its E and V; n_draws : of the sky;
    priors : mean and standard deviation of each unknown, by name; fits : whether its data fit;
    log_evidence : of its own data
    """

    octaves: dict[str, float]
    mean: Float[np.ndarray, " unknown"]
    covariance: Float[np.ndarray, "unknown unknown_2"]
    n_draws: int
    priors: dict[str, tuple[float, float]]
    fits: bool
    log_evidence: float
    slopes: Float[np.ndarray, "unknown any_mode"] | None = None
    departure: Float[np.ndarray, " mode"] | None = None

    @classmethod
    def of(cls, made: Conditioned, n_draws: int = 0, data: ChannelData | None = None) -> Share:
        """Make it from a channel: its unknowns, and its posterior of the sky."""
        unknowns, inferred, above = made.unknowns, made.from_data, made.above
        amplitudes = unknowns.amplitudes if above is None else above.amplitudes
        posterior = amplitudes.integrated(made.posterior.mean, made.covariance)
        shared, n = unknowns.shared, len(unknowns.rows)
        octaves = dict(zip(unknowns.shared_names, unknowns.octaves[shared].tolist(), strict=True))
        priors = {row["unknown"]: (row["prior"], row["prior_std"]) for row in unknowns.rows}
        spread = posterior.covariance[np.ix_(shared, shared)]
        figures = n_draws, priors, inferred.fits, float(inferred.posterior.log_evidence)
        parts = octaves, unknowns.expected[shared] + posterior.mean[shared], spread, *figures
        if data is None:
            return cls(*parts)
        slopes = np.asarray(made.posterior.prior.whiten(-posterior.with_sky[:, shared].T))
        if above is not None:
            beyond = -posterior.covariance[shared, n:] @ above.directions.T
            slopes = np.concatenate([slopes, beyond], axis=1)
        return cls(*parts, np.linalg.solve(spread, slopes), data.departure.mean)


class Seen(NamedTuple):
    """Inputs from one channel for all: its share and, for joint skies, reference and model sky."""

    share: Share | None
    reference: SkyModes | None = None
    sky: SkyModes | None = None


@dataclass(frozen=True)
class ChannelAlone:
    """A channel's posterior given its own data, stored until all channels are done.

    Attributes
    ----------
    known : ChannelData
    information : Information
        Information in its own data, without earlier data.
    unknowns : Unknowns
        Unknowns of the instrument, given the sky.
    mean, covariance : (modes,) and (modes, modes) array
        In K and K^2.
    deviations : (all, modes) array
        Draws minus the mean, in K: first those of the scenario's output, then those for coverage.
    figures : dict
        :meth:`.Conditioned.figures`.
    share : Share
        Its constraints on the shared instrument.
    """

    known: ChannelData
    information: Information
    unknowns: Unknowns
    mean: Float[np.ndarray, " mode"]
    covariance: Float[np.ndarray, "mode mode_2"]
    deviations: Float[np.ndarray, "all mode"]
    figures: dict[str, float | bool]
    share: Share

    @classmethod
    def of(cls, made: Conditioned, data: ChannelData) -> ChannelAlone:
        """Make it from a channel: its posterior includes earlier data, its tests do not."""
        mean, compared = made.posterior.mean, made.compared()
        deviations = made.draws - mean
        if compared is not None:
            deviations = np.concatenate([deviations, compared])
        share = Share.of(made, len(deviations), data)
        kept = made.covariance, deviations, made.figures(), share
        return cls(data, made.from_data.solution.information, made.unknowns, mean, *kept)

    def seen(self) -> Seen:
        """Inputs for the other channels."""
        return Seen(self.share)

    def given(self, number: int, scenario: Scenario, tied: Tied) -> ChannelResult:
        """The channel given all data.

        Parameters
        ----------
        number : int
            Index of the channel among the tied channels.
        scenario : Scenario
            The channel's scenario.
        tied : Tied
            E', V' and draws of the shared unknowns.
        """
        shared, at = self.unknowns.shared, self.unknowns.among(tied)
        posterior = self.unknowns.amplitudes.integrated(self.mean, self.covariance)
        expected = self.unknowns.expected[shared]
        mean, draws = tied.mean[number, at] - expected, tied.draws[:, number, at] - expected
        covariance = tied.covariance[number][np.ix_(at, at)]
        key = jax.random.fold_in(draw_key(scenario), TIED + 1)
        e, v = posterior.mean[shared], posterior.covariance[np.ix_(shared, shared)]
        of_all = np.linalg.solve(v, self.unknowns.fluxes(posterior).with_all[:, shared].T).T
        gain = of_all[: len(self.mean)]
        moved = self.mean + gain @ (mean - e)
        left = self.covariance + gain @ (covariance - v) @ gain.T
        # amplitudes that match the channel's own draws, minus their mean
        amplitudes = self.unknowns.amplitudes
        inner = amplitudes.covariance[np.ix_(shared, shared)]
        normals = np.asarray(jax.random.normal(key, (len(self.deviations), len(shared))))
        variances, axes = np.linalg.eigh(inner)
        normals = (normals * np.sqrt(np.maximum(variances, 0.0))) @ axes.T
        with_them = normals - self.deviations @ amplitudes.pull[shared].T
        deviations = self.deviations + (draws - mean - with_them) @ gain.T
        # constraints from the other channels on this one's unknowns
        n = len(amplitudes.mean)
        precision, vector, expansion = np.zeros((n, n)), np.zeros(n), np.zeros(n)
        inverse = np.linalg.inv(v)
        precision[np.ix_(shared, shared)] = np.linalg.inv(covariance) - inverse
        vector[shared], expansion[shared] = inverse @ (mean - e), mean
        others = precision, vector, expansion
        unknowns = replace(self.unknowns, amplitudes=amplitudes.given(*others))
        sky_share = np.linalg.solve(v, (np.linalg.solve(v, v - inner)).T)
        gained = np.linalg.slogdet(np.eye(len(shared)) + (covariance - v) @ sky_share)[1]
        bits = self.figures["information_bits"] - 0.5 * gained / np.log(2.0)
        information = amplitudes.information_given(self.information, *others)
        drawn, compared = np.split(deviations, [scenario.output.draws])
        skies = moved + drawn
        return channel_result(
            self.known.given(unknowns.table(moved, left)),
            moved,
            left,
            compared,
            draws=skies,
            log_likelihood=information.log_likelihood(skies),
            instrument=unknowns,
            common=lambda rows: rows @ (of_all @ tied.root[number, at]),
            **(self.figures | information.fit(moved, left) | {"information_bits": float(bits)}),
        )


def tie_channels(
    scenario: Scenario, frequencies_mhz: Sequence[float], shared: Sequence[Share]
) -> tuple[Tied, tuple[SharedTest, ...]]:
    """Tie shared unknowns given all data, and test whether each channel agrees with the others.

    A channel that disagrees is not tied to any other.

    Parameters
    ----------
    scenario : Scenario
        The scenario of all channels.
    frequencies_mhz : sequence of float
        Frequencies of the mapped channels.
    shared : sequence of Share
        One for each of these.

    Raises
    ------
    InputError
        As :func:`.tie`.
    """
    octaves = {name: over for one in shared for name, over in one.octaves.items()}
    names, n_channels = tuple(octaves), len(shared)
    # channels do not constrain unknowns that they lack
    mean = np.zeros((n_channels, len(names)))
    covariance = np.tile(np.eye(len(names)), (n_channels, 1, 1))
    for number, one in enumerate(shared):
        at = [names.index(name) for name in one.octaves]
        mean[number, at], covariance[number][np.ix_(at, at)] = one.mean, one.covariance
    key = jax.random.fold_in(draw_key(scenario), TIED)
    normals = np.asarray(jax.random.normal(key, (shared[0].n_draws, mean.size)))
    kernels = np.stack([kernel(np.array(frequencies_mhz), over) for over in octaves.values()])
    tests = shared_tests(mean, covariance, kernels, names, frequencies_mhz)
    alike = None
    if all(one.departure is not None for one in shared):
        # a channel's model may end at lmax
        slopes = np.zeros((*mean.shape, max(one.slopes.shape[1] for one in shared)))
        for number, one in enumerate(shared):
            slopes[number, [names.index(x) for x in one.octaves], : one.slopes.shape[1]] = (
                one.slopes
            )
        departures = np.stack([one.departure for one in shared])
        alike = AlikeErrors(slopes, sky_spectrum.correlation_of_departures(departures))
    for number, test in enumerate(tests):
        if test.disagrees:
            kernels[:, number], kernels[:, :, number] = 0.0, 0.0
            kernels[:, number, number] = 1.0
            if alike is not None:
                alike.correlation[number], alike.correlation[:, number] = 0.0, 0.0
    return replace(tie(mean, covariance, kernels, normals, alike), names=names), tests


def from_fitting(
    scenario: Scenario, frequencies_mhz: Sequence[float], shared: Sequence[Share]
) -> dict[str, float]:
    """Values, by name, of the unknowns common to all channels, given those that fit."""
    fitting = [(f, one) for f, one in zip(frequencies_mhz, shared, strict=True) if one.fits]
    tied, tests = tie_channels(scenario, *zip(*fitting, strict=True))
    agrees = [not test.disagrees for test in tests]
    k = agrees.index(True) if any(agrees) else 0
    z, (_, first) = dict(zip(tied.names, tied.mean[k].tolist(), strict=True)), fitting[k]
    common = {name: first.priors[name] for name, over in first.octaves.items() if np.isinf(over)}
    return {name: prior + std * z[name] for name, (prior, std) in common.items()}


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
    """Map all channels, continuing an interrupted run in ``folder``.

    If channels share unknowns, each is first solved independently, starting from the instrument of
    the first one, and then updated with the constraints from the others. A channel whose data do
    not fit is solved again, starting from the instrument of those that fit; the solution with the
    higher evidence is used. A channel that cannot be mapped does not affect the others: the result
    names it, and a joint posterior excludes it. A single frequency leaves no unfinished work.

    Parameters
    ----------
    scenario : Scenario
        With one or several frequencies.
    folder : Path
        Folder of the run, including unfinished work.
    data : Visibilities, path, or sequence of them, optional
        Measured data; if omitted, data are simulated from the scenario.
    truth : bool
        The data were simulated from this scenario's sky.
    earlier : path, optional
        Folder of a run with saved information, to be combined with these data.
    thorough : bool
        Test groups of data and try the usual mistakes even if the data fit.
    engine : Engine, optional
        Where channels are computed; by default in this process.
    stages : Stages, optional
        Reports progress.

    Raises
    ------
    InputError
        If no channel can be mapped, if a joint posterior has too few channels, or as
        :func:`.conditioned`.
    """
    engine, stages, single = engine or ThisProcess(), stages or Stages(), scenario.single
    # workers may have another working directory
    data = None if data is None else anchored(data)
    kept = None if earlier is None else finished_runs.information_file(earlier)

    def condition(
        channel: Scenario, progress: Stages, values: dict[str, float] | None = None
    ) -> Conditioned:
        before = None if kept is None else finished_runs.read_information(kept, channel)
        make = partial(build, earlier=None if before is None else before.information, values=values)
        experiment = measured_experiment(channel, data, progress, truth=truth, make=make)
        return conditioned(experiment, before, progress)

    if single:
        made = condition(scenario, stages)
        channel_data = made.channel_data(stages, alone=True, thorough=thorough)
        return MapResult(scenario, (made.result(channel_data, stages),), seconds=stages.seconds)
    engine.work_in(folder)
    digests = [None if given is None else digest_of(given) for given in (data, kept)]
    identity = identity_of(scenario, *digests, truth, thorough)
    files = ChannelFiles(folder.resolve() / CHANNELS, identity)
    channels = tuple(channel.anchored() for channel in scenario.channels())
    alone = not scenario.joint and not scenario.shared
    kind = ChannelResult if alone else ChannelInformation if scenario.joint else ChannelAlone
    examine = {"alone": False, "joint": scenario.joint, "thorough": thorough}

    begin: dict[str, float] | None = None

    def observe(channel: Scenario) -> Seen | str:
        """Solve a channel; return the inputs for the others, or why it cannot be mapped."""

        def make() -> ChannelResult | ChannelInformation | ChannelAlone:
            made = condition(channel, Stages(), begin)
            if begin is not None and not made.from_data.fits:
                made = condition(channel, Stages())
            channel_data = made.channel_data(**examine)
            return made.result(channel_data) if alone else kind.of(made, channel_data)

        try:
            kept = files.kept(channel, kind, make)
        except InputError as error:
            return str(error)
        return Seen(None) if alone else kept.seen()

    def each(function: Callable[[Scenario], Any], channels: Sequence[Scenario], stage: str) -> list:
        names = [names_of((channel,)) for channel in channels]
        return engine.each(Tasks(function, channels, names), stages, stage)

    views = []
    if scenario.shared:  # the others start from the instrument of the first
        views = each(observe, channels[:1], "first channel")
        if isinstance(views[0], Seen) and views[0].share.fits:
            begin = from_fitting(scenario, [channels[0].frequency_mhz], [views[0].share]) or None
    views += each(observe, channels[len(views) :], "channels")
    by_channel = list(zip(channels, views, strict=True))
    unmapped = {channel.frequency_mhz: why for channel, why in by_channel if isinstance(why, str)}
    if len(unmapped) == len(channels):
        raise InputError(f"no channel can be mapped: {_reasons(unmapped)}")
    mapped, seen = zip(*(one for one in by_channel if not isinstance(one[1], str)), strict=True)
    components, tied, tests = None, None, ()
    if scenario.shared:
        frequencies, shares = [channel.frequency_mhz for channel in mapped], [s.share for s in seen]
        unfit = [channel for channel, one in zip(mapped, shares, strict=True) if not one.fits]
        if 0 < len(unfit) < len(mapped):
            values = from_fitting(scenario, frequencies, shares)
            again = [channel.frequency_mhz for channel in unfit]
            first, files = files, replace(files, again=frozenset(again))

            def look_again(channel: Scenario) -> Seen:
                """Solve a channel again, starting from the instrument of the others."""

                def make() -> ChannelInformation | ChannelAlone:
                    made, before = condition(channel, Stages(), values), first.read(channel, kind)
                    if Share.of(made).log_evidence < before.share.log_evidence:
                        return before
                    return kind.of(made, made.channel_data(**examine))

                return files.kept(channel, kind, make).seen()

            changed = dict(zip(again, each(look_again, unfit, "channels again"), strict=True))
            seen = [changed.get(f, one) for f, one in zip(frequencies, seen, strict=True)]
        tied, tests = tie_channels(scenario, frequencies, [one.share for one in seen])
    if scenario.joint:
        tied, misfit = _with_sky_above(tied, mapped, files)
        at_hand = ChannelsInFiles(mapped, files, engine, stages, tied)
        n_draws = max(scenario.output.draws, sky_spectrum.N_DRAWS)
        fewer = _without(unmapped, scenario)
        components, posterior = solve_components(fewer, at_hand, seen, n_draws)
        components = replace(components, misfit_above=misfit)

    def finish(channel: Scenario) -> None:
        """Write the result of a channel, given the data of all channels."""
        number = mapped.index(channel)
        common = (channel, tied) if components is None else (scenario, tied, components)
        files.kept(channel, ChannelResult, lambda: files.read(channel, kind).given(number, *common))

    if not alone:
        each(finish, mapped, "joint skies" if scenario.joint else "shared instrument")
    results = [files.read(channel, ChannelResult) for channel in mapped]
    if components is not None and components.mode is None:
        regions = sky_spectrum.combined([result.temperatures for result in results], posterior)
        results = [replace(a, temperatures=b) for a, b in zip(results, regions, strict=True)]
    more = {"tie_log_evidence": 0.0 if tied is None else tied.log_evidence, "shared_tests": tests}
    return MapResult(scenario, tuple(results), components, stages.seconds, unmapped, **more)


def _with_sky_above(
    tied: Tied | None, channels: Sequence[Scenario], files: ChannelFiles
) -> tuple[Tied | None, float]:
    """Add the sky above lmax, if any, to what channels have in common, and its part of chi^2."""
    n = len(channels)

    def above(number: int) -> SkyAbove | None:
        return files.read(channels[number], ChannelInformation).above

    # the model of other channels ends at lmax
    skies = {k: one.model for k in range(n) if (one := above(k)) is not None}
    if not (seeing := [*skies]):
        return tied, 0.0
    some = [above(k).directions for k in sorted({seeing[0], seeing[len(seeing) // 2], seeing[-1]})]
    model = np.zeros((n, len(some[0])))
    model[seeing] = [*skies.values()]
    alike = AlikeAbove.of(some, model)
    # one after the other: all together may be large
    each = ((k, x.directions, x.mean, x.covariance) for k in seeing if (x := above(k)))
    return replace(tied or Tied.of_nothing(n), above=alike), alike.misfit(each)


def _without(unmapped: dict[float, str], scenario: Scenario) -> Scenario:
    """A joint scenario of the mapped channels. InputError if there are too few."""
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
    return "; ".join(f"{', '.join(mhz)} MHz: {reason}" for reason, mhz in alike.items())
