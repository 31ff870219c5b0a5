"""The channels of a cube, each on its own, tied, or in one posterior; a stopped run goes on."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lusee_bayes.core.arrays import on_host
from lusee_bayes.core.engine import Engine, Tasks, ThisProcess
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.progress import Stages
from lusee_bayes.experiment.data_files import Data, anchored, read_data
from lusee_bayes.experiment.experiment import build, explained, with_truth
from lusee_bayes.experiment.inference import inform
from lusee_bayes.experiment.scenario import Scenario
from lusee_bayes.linear.joint_skies import channel_sky
from lusee_bayes.linear.positive_channel import positive_sky
from lusee_bayes.results.channel import ChannelResult, channel_of_information
from lusee_bayes.results.channel_files import ChannelFiles, identity_of
from lusee_bayes.results.channel_information import ChannelInformation
from lusee_bayes.results.coverage import N_DRAWS
from lusee_bayes.results.cube import Components, CubeResult
from lusee_bayes.results.draws import deviations, draw_key, posterior_draws
from lusee_bayes.results.joint_channels import names_of
from lusee_bayes.results.joint_components import solve_components
from lusee_bayes.results.smooth_receivers import ChannelAlone, tie_receivers, write_tied_sky


def cube_result(
    scenario: Scenario,
    folder: Path,
    *,
    data: Data | None = None,
    truth: bool = False,
    engine: Engine | None = None,
    stages: Stages | None = None,
) -> CubeResult:
    """Work out all channels, going on from what an interrupted run has left in ``folder``.

    Where receivers have smooth spectra, each channel is worked out alone, and then given what the
    others tell of its receivers (:mod:`.smooth_receivers`). A channel that cannot be mapped leaves
    the others as they are: it is named in the result, and a joint posterior is that of the others.

    Parameters
    ----------
    scenario : Scenario
        Of several frequencies.
    folder : Path
        Of the run; unfinished work is kept in it.
    data : Visibilities, path, or sequence of them, optional
        Measured; without them the scenario's own are simulated.
    truth : bool
        The data are of the scenario's own sky.
    engine : Engine, optional
        What carries out the channels; by default this process.
    stages : Stages, optional
        Told what is being done.

    Raises
    ------
    InputError
        For a scenario without frequencies, if no channel can be mapped, or if too few of them can
        for a joint posterior.
    """
    engine, stages = engine or ThisProcess(), stages or Stages()
    engine.work_in(folder)
    if not scenario.frequencies_mhz:
        raise InputError("the scenario names no frequencies_mhz; give --frequencies")
    n_draws = scenario.output.draws
    # workers may have other folders of their own
    files = ChannelFiles(folder.resolve(), identity_of(scenario, data, truth, n_draws))
    channels = tuple(channel.anchored() for channel in scenario.channels())
    data = None if data is None else anchored(data)
    names = [names_of((channel,)) for channel in channels]
    tied = scenario.ties_receivers
    wanted = "information" if scenario.joint else "alone" if tied else "result"

    def observe(channel: Scenario) -> None:
        if files.has(channel, wanted):
            return
        measured = None if data is None else read_data(data, channel)
        experiment = build(channel, measured)
        if truth:
            experiment = with_truth(experiment)
        with explained(experiment):
            information, inference = inform(experiment)
        known = ChannelInformation.of(experiment, information, inference)
        if scenario.joint:
            files.write(channel, wanted, known.to_dataset())
            return
        posterior = on_host(inference.posterior)
        mean, covariance = posterior.mean, posterior.covariance()
        draws = posterior_draws(experiment, posterior, n_draws)
        compared = None if known.observed.truth is None else deviations(experiment, posterior)
        numbers = {
            "log_evidence": float(posterior.log_evidence),
            "information_bits": float(posterior.information_bits()),
            "chi2_model": float(information.chi2(mean) + posterior.prior_chi2()),
            "refinement": float(posterior.refinement),
        }
        if tied:
            rest = np.zeros((0, len(mean))) if compared is None else compared
            alone = ChannelAlone(known, mean, covariance, draws - mean, rest, numbers)
            files.write(channel, wanted, alone.to_dataset())
            return
        found = channel_of_information(
            known.observed,
            information,
            mean,
            covariance,
            draws,
            compared=compared,
            **numbers,
        )
        files.write(channel, wanted, found.to_dataset())

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
    if tied:
        receivers = tie_receivers(scenario, mapped, files)
        tie_log_evidence = receivers.log_evidence

        def write_tied(number: int) -> None:
            write_tied_sky(number, mapped, receivers, files)

        skies = Tasks(write_tied, range(len(mapped)), [names_of((c,)) for c in mapped])
        engine.each(skies, stages, "smooth receivers")
    if scenario.joint:
        left = _without(unmapped, scenario)
        # coverage is compared with draws
        known = data is None or truth
        n_solved = max(n_draws, N_DRAWS) if known else n_draws
        components = solve_components(left, files, n_solved, engine, stages)
        # for workers of other processes
        shared = on_host(components)

        def write_sky(number: int) -> None:
            _write_joint_sky(number, mapped, shared, scenario, files, n_draws)

        skies = Tasks(write_sky, range(len(mapped)), [names_of((c,)) for c in mapped])
        engine.each(skies, stages, "joint skies")
    found = tuple(ChannelResult.from_dataset(files.read(c, "result")) for c in mapped)
    return CubeResult(
        scenario,
        found,
        components,
        stages.seconds,
        unmapped,
        tie_log_evidence=tie_log_evidence,
    )


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
    number: int,
    channels: tuple[Scenario, ...],
    components: Components,
    scenario: Scenario,
    files: ChannelFiles,
    n_draws: int,
) -> None:
    channel, key = channels[number], draw_key(scenario)
    if files.has(channel, "result"):
        return
    known = ChannelInformation.from_dataset(files.read(channel, "information"))
    if components.mode is not None:
        sky = positive_sky(
            components.mode,
            number,
            known.information,
            np.asarray(components.spread),
            np.asarray(components.draws),
            key,
        )
    else:
        sky = channel_sky(
            components.prior,
            number,
            known.information,
            components.mean,
            components.spread,
            components.draws,
            key,
        )
    found = channel_of_information(
        known.observed,
        known.information,
        sky.mean,
        sky.covariance,
        sky.draws[:n_draws],
        compared=np.asarray(sky.draws) - np.asarray(sky.mean),
        independent=known.information.reference,
    )
    files.write(channel, "result", found.to_dataset())
