"""A map run: the posterior over the sky at one frequency, or at several."""

from __future__ import annotations

from dataclasses import replace as replace_fields
from pathlib import Path

import jax
import numpy as np

from lusee_bayes.core.arrays import on_host
from lusee_bayes.core.engine import Engine
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.progress import Stages
from lusee_bayes.core.reading import rows_of
from lusee_bayes.experiment.data_files import (
    Data,
    are_sessions,
    read_data,
    reduced_of,
)
from lusee_bayes.experiment.diagnosis import diagnose
from lusee_bayes.experiment.experiment import Experiment, explained, infer
from lusee_bayes.experiment.flight_data import visibilities_of
from lusee_bayes.experiment.rounds import Inference
from lusee_bayes.experiment.scenario import Scenario, load_scenario
from lusee_bayes.experiment.unknowns import flux_table, pointing_report, unknowns_report
from lusee_bayes.flight.reduced import Reduced, write_reduced
from lusee_bayes.judge.chi2 import LEVELS
from lusee_bayes.judge.residuals import residuals
from lusee_bayes.linear.linear_gaussian import composed, deviation_model
from lusee_bayes.report.figures import judgement, maps
from lusee_bayes.results.channel import channel_of_posterior
from lusee_bayes.results.cube import CubeResult
from lusee_bayes.results.diagnostics_file import write_diagnostics
from lusee_bayes.results.finished_runs import Provenance
from lusee_bayes.results.map_files import cards, posterior_dataset, write_cubes, write_maps
from lusee_bayes.results.map_result import MapResult
from lusee_bayes.results.saved import REDUCED
from lusee_bayes.results.updatable import Updatable, read_updatable
from lusee_bayes.runs.channel_files import CHANNELS
from lusee_bayes.runs.channels import cube_result
from lusee_bayes.runs.cost import measured_experiment, posterior_cost, require_fits
from lusee_bayes.runs.diagnostics import diagnostics
from lusee_bayes.runs.folder import (
    SCENARIO,
    Output,
    RunKind,
    RunOutcome,
    json_file,
    netcdf_file,
    require_marginal,
    require_single_frequency,
    rows_file,
    scenario_run,
    table_file,
)
from lusee_bayes.sky.sky_files import write_alms

DOES_NOT_FIT = LEVELS[-1]


def run_map(
    scenario: Scenario | str | Path,
    folder: str | Path,
    *,
    data: Data | None = None,
    truth: bool = False,
    onto: str | Path | None = None,
    diagnosed: bool = False,
    engine: Engine | None = None,
    replace: bool = False,
    stages: Stages | None = None,
) -> RunOutcome[MapResult | CubeResult]:
    """Make a posterior map of a scenario, or of given data, and write its folder.

    The folder is written in one transaction. A run of several frequencies that was stopped goes on
    with the same call.

    Parameters
    ----------
    scenario : Scenario, or its file or name
        Of one frequency or of several; ``output`` says what is written besides the maps.
    folder : path
        Of the results.
    data : Visibilities, path, or sequence of them, optional
        Visibilities to map, in memory or in a file, or sessions of the spectrometer; without them
        the scenario's own are simulated.
    truth : bool
        The given data are of the scenario's own sky: compare the map with it.
    onto : path, optional
        Folder of an updatable run, to whose data these are added.
    diagnosed : bool
        Try the usual mistakes in data and model even if the data fit.
    engine : Engine, optional
        What carries out the channels; by default this process.
    replace : bool
        Replace results of another run in the folder.
    stages : Stages, optional
        Told what is being done.

    Raises
    ------
    InputError
        If the scenario samples something, or for whatever is wrong with scenario, data or folder.
    """
    scenario = load_scenario(scenario)
    stages = stages or Stages()
    require_marginal("a map", "use: lusee-bayes sample", scenario)
    output, several = scenario.output, bool(scenario.frequencies_mhz)
    for name, given in {
        "--covariance": output.covariance,
        "--updatable": output.updatable,
        "--onto": onto is not None,
        "--diagnose": diagnosed,
    }.items():
        require_single_frequency(name, given and several)
    if several:
        require_fits(cost := posterior_cost(scenario), scenario)
    kind, origin = CUBE if several else MAP, {"truth": truth or None, "onto": onto}
    with scenario_run(folder, kind, scenario, data, onto, replace=replace, **origin) as run:
        if several:
            stages.say(cost.line())
            place = run.path
            file, reduced = _one_file(data, scenario, place, stages)
            made = cube_result(
                scenario, place, data=file, truth=truth, engine=engine, stages=stages
            )
            provenance = _provenance_of_channels(scenario, data, made, reduced)
        else:
            reduced = None if data is None else reduced_of(data, scenario, stages)
            measured = data if reduced is None else visibilities_of(reduced, scenario)
            experiment = measured_experiment(scenario, measured, stages, truth=truth)
            made = map_result(experiment, onto=onto, diagnosed=diagnosed, stages=stages)
            provenance = Provenance.of_experiment(experiment, data)
            reduced = reduced and _as_used(reduced, experiment)
        made = replace_fields(made, reduced=reduced)
        return run.write(made, stages, provenance)


def map_result(
    experiment: Experiment,
    *,
    onto: str | Path | None = None,
    diagnosed: bool = False,
    stages: Stages | None = None,
) -> MapResult:
    """Condition an experiment's model on its data, and work out the uncertainties.

    Parameters
    ----------
    experiment : Experiment
    onto : path, optional
        Folder of an updatable run, to whose data these are added.
    diagnosed : bool
        Try the usual mistakes even if the data fit.
    stages : Stages, optional
        Told what is being done.

    Raises
    ------
    InputError
        For data that the earlier run holds already, and as :func:`infer`.
    """
    stages = stages or Stages()
    scenario, data = experiment.scenario, experiment.data
    earlier = None if onto is None else read_updatable(onto, scenario)
    digests = (data.digest(),)
    with stages("posterior"), explained(experiment):
        found = judged = alone = infer(experiment)
        if earlier is not None:
            found, judged = _updated(earlier, found, experiment)
            digests = (*earlier.digests, *digests)
        elif scenario.output.updatable:
            posterior = found.model.condition(data.data, form="root")
            found = judged = replace_fields(found, posterior=posterior)
        jax.block_until_ready(found.posterior.white_mean)
    with stages("standard deviations"):
        covariance = on_host(found.posterior).covariance()
        channel = channel_of_posterior(
            experiment, found, covariance, n_draws=scenario.output.draws, judged=judged
        )
    fluxes = None
    if experiment.setup.responses and scenario.sources.treatment != "ignored":
        with stages("fluxes"):
            fluxes = flux_table(experiment, alone)
    unknowns = unknowns_report(experiment, alone)
    if unknowns is not None and earlier is not None:
        unknowns = replace_fields(unknowns, onto=True)
    with stages("diagnostics"):
        left = residuals(judged.model, judged.posterior, data, channel.chi2_model)
        page = diagnostics(experiment, found, left, channel, covariance)
    pointing, diagnosis = None, None
    if diagnosed or page.attrs["level"] == DOES_NOT_FIT:
        with stages("usual mistakes"):
            diagnosis = diagnose(experiment, alone, left)
    if scenario.noise.pointing is not None or page.attrs["level"] == DOES_NOT_FIT:
        with stages("clock and pointing"):
            own = covariance if earlier is None else on_host(alone.posterior).covariance()
            pointing = pointing_report(experiment, alone, own)
    told = (fluxes, pointing, unknowns, digests, diagnosis)
    return MapResult(experiment, found, channel, page, *told, stages.seconds)


def _updated(
    earlier: Updatable, alone: Inference, experiment: Experiment
) -> tuple[Inference, Inference]:
    """The posterior given earlier data and these, and the model of these given the earlier ones."""
    data = experiment.data
    if data.digest() in earlier.digests:
        raise InputError(
            "these data are behind the earlier posterior already; used again, they would count "
            "twice"
        )
    deviations = deviation_model(earlier.posterior, alone.model)
    deviation = deviations.condition(data.data, form="root")
    posterior = composed(earlier.posterior, deviation)
    return (
        replace_fields(alone, posterior=posterior),
        Inference(deviations, alone.systematics, deviation, alone.rounds, alone.around),
    )


def _as_used(reduced: Reduced, experiment: Experiment) -> Reduced:
    """Reduced spectra without what did not fit."""
    if experiment.fitting is None or not experiment.fitting.flagged.any():
        return reduced
    band = reduced.band(experiment.scenario.frequency_mhz)
    values = np.zeros(reduced.values.shape[1:], dtype=bool)
    values[:, reduced.bins_at(band)] = experiment.fitting.flagged
    return reduced.without(band, values)


def _one_file(
    data: Data | None, scenario: Scenario, folder: Path, stages: Stages
) -> tuple[Data | None, Reduced | None]:
    """The data that all channels are read from: of sessions, the file of their reduced spectra."""
    if data is None:
        return None, None
    reduced = reduced_of(data, scenario, stages)
    if reduced is None or not are_sessions(data):
        return data, reduced
    path = folder / CHANNELS / REDUCED
    path.parent.mkdir(exist_ok=True)
    return write_reduced(path, reduced, scenario.to_yaml()), reduced


def _provenance_of_channels(
    scenario: Scenario, data: Data | None, cube: CubeResult, reduced: Reduced | None
) -> Provenance:
    """Of the data of the first channel that could be mapped; all have the same times."""
    first = next(c for c in scenario.channels() if c.frequency_mhz not in cube.unmapped)
    if data is None:
        observation = scenario.observation.observation()
    elif reduced is not None:
        observation = visibilities_of(reduced, first).observation
    else:
        observation = read_data(data, first).observation
    known = cube.stacked("truth") is not None
    return Provenance.of(scenario, observation, data, known_sky=known)


def _write_coefficients(result: MapResult, folder: Path) -> None:
    header = cards("mean", result.scenario)
    write_alms(folder / "mean_alm.fits", result.channel.mean, header)


# what maps of one frequency and of several have
SHARED = (
    table_file("unknowns.csv", lambda result: result.unknowns and result.unknowns.table),
    Output(
        lambda r, folder: write_reduced(folder / REDUCED, r.reduced, r.scenario.to_yaml()),
        wanted=lambda r: r.reduced is not None,
    ),
    SCENARIO,
    json_file("summary.json", lambda result: result.summary()),
)

FLIGHT_FIGURES = {
    "flight_time_line": lambda r: r.reduced and judgement.time_line(r.reduced),
    "flight_calibration": lambda r: r.reduced and judgement.calibration(r.reduced),
}

# what the folder of a map holds; a new file is one line here
MAP = RunKind(
    "map",
    outputs=(
        netcdf_file("posterior.nc", posterior_dataset),
        Output(lambda r, folder: write_maps(folder, r.channel.maps(), r.scenario)),
        Output(_write_coefficients),
        rows_file("spectra.csv", lambda result: rows_of(result.channel.spectra())),
        table_file("sources.csv", lambda result: result.fluxes),
        table_file("pointing.csv", lambda r: r.pointing and r.pointing.offsets),
        table_file("pointing_by_day.csv", lambda r: r.pointing and r.pointing.preferred),
        Output(
            lambda result, folder: write_diagnostics(result.diagnostics, folder / "diagnostics.nc")
        ),
        *SHARED,
    ),
    figures={
        "maps": lambda result: maps.sky_maps(result.channel),
        "data_vector": lambda result: maps.data_vector(result.experiment.data),
        "beams": lambda result: maps.beams(result.experiment.setup),
        "fidelity": lambda result: maps.map_fidelity(result.channel),
        "spectra": lambda result: maps.sky_spectra(result.channel),
        "draws": lambda result: judgement.draws_of_posterior(result.diagnostics),
        "residuals": lambda result: judgement.residuals_by_product(result.diagnostics),
        "pointing": lambda result: (
            result.pointing and judgement.pointing_by_day(result.pointing.preferred)
        ),
        "flight_waterfall": lambda r: r.reduced and judgement.waterfall(r.reduced, r.band),
        **FLIGHT_FIGURES,
    },
)

CUBE = RunKind(
    "cube",
    outputs=(
        netcdf_file("posterior.nc", lambda result: result.to_dataset()),
        Output(lambda r, folder: write_cubes(folder, r.maps(), r.frequencies_mhz, r.scenario)),
        rows_file("spectra.csv", lambda result: result.spectra()),
        *SHARED,
    ),
    figures={
        "maps": maps.channel_maps,
        "spectra": maps.channel_spectra,
        "fidelity": maps.channel_fidelity,
        "chi2": maps.chi2,
        "unknowns": lambda r: r.unknowns and judgement.unknowns_by_frequency(r.unknowns),
        **FLIGHT_FIGURES,
    },
    unfinished=CHANNELS,
    resume="the same command continues from the finished channels",
    dpi=100,
)
