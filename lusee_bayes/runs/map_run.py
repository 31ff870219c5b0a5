"""A map run: the posterior over the sky at one frequency, or at several."""

from __future__ import annotations

import json
from dataclasses import replace as replace_fields
from pathlib import Path

import numpy as np

from lusee_bayes.core.engine import Engine
from lusee_bayes.core.progress import Stages
from lusee_bayes.core.reading import rows_of, write_csv
from lusee_bayes.experiment.data_files import (
    Data,
    are_sessions,
    read_data,
    reduced_of,
)
from lusee_bayes.experiment.experiment import Experiment, build, with_truth
from lusee_bayes.experiment.flight_data import visibilities_of
from lusee_bayes.experiment.scenario import Scenario, load_scenario
from lusee_bayes.flight.reduced import Reduced, write_reduced
from lusee_bayes.report.figures.checks import (
    calibration,
    draws_of_posterior,
    pointing_by_day,
    residuals_by_product,
    time_line,
    unknowns_by_frequency,
    waterfall,
)
from lusee_bayes.report.figures.maps import (
    beams,
    channel_fidelity,
    channel_maps,
    channel_spectra,
    chi2,
    data_vector,
    map_fidelity,
    sky_maps,
    sky_spectra,
)
from lusee_bayes.results.cube import CubeResult
from lusee_bayes.results.diagnostics import write_diagnostics
from lusee_bayes.results.finished_runs import Provenance
from lusee_bayes.results.map_files import cards, write_cube, write_map, write_posterior
from lusee_bayes.results.map_result import MapResult, map_result
from lusee_bayes.results.saved import REDUCED
from lusee_bayes.runs.channel_files import CHANNELS
from lusee_bayes.runs.cost import posterior_cost, require_fits, require_resources
from lusee_bayes.runs.cube import cube_result
from lusee_bayes.runs.folder import (
    Output,
    Run,
    RunKind,
    inputs_of,
    origin_of,
    require_marginal,
    require_single_frequency,
    run_folder,
    write_run,
)
from lusee_bayes.sky.sky_files import write_alms


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
) -> Run[MapResult | CubeResult]:
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
    require_marginal("a map", "use: lusee-bayes sample", scenario.samples)
    if not scenario.frequencies_mhz:
        return _run_single(scenario, folder, data, truth, onto, diagnosed, replace, stages)
    output = scenario.output
    require_single_frequency("--covariance", output.covariance)
    require_single_frequency("--updatable", output.updatable)
    require_single_frequency("--onto", onto is not None)
    require_single_frequency("--diagnose", diagnosed)
    resume = "the same command continues from the finished channels"
    origin = origin_of(scenario, data, truth=truth or None)
    cost = posterior_cost(scenario)
    require_fits(cost, scenario)
    inputs = inputs_of(scenario, data)
    with run_folder(folder, CUBE, origin, resume, replace=replace, inputs=inputs) as place:
        stages.say(cost.line())
        file, reduced = _one_file(data, scenario, place, stages)
        cube = cube_result(scenario, place, data=file, truth=truth, engine=engine, stages=stages)
        cube = replace_fields(cube, reduced=reduced)
        provenance = _provenance_of_channels(scenario, data, cube)
        return write_run(place, cube, CUBE, origin, stages, provenance)


def _run_single(
    scenario: Scenario,
    folder: str | Path,
    data: Data | None,
    truth: bool,
    onto: str | Path | None,
    diagnosed: bool,
    replace: bool,
    stages: Stages,
) -> Run[MapResult | CubeResult]:
    origin = origin_of(scenario, data, truth=truth or None, onto=onto)
    inputs = inputs_of(scenario, data, onto)
    with run_folder(folder, MAP, origin, replace=replace, inputs=inputs) as place:
        reduced = None if data is None else reduced_of(data, scenario, stages)
        if reduced is not None:
            measured = visibilities_of(reduced, scenario)
        else:
            measured = None if data is None else read_data(data, scenario)
        require_resources(scenario, measured, stages)
        experiment = build(scenario, measured, stages)
        if truth:
            experiment = with_truth(experiment)
        result = map_result(experiment, onto=onto, diagnosed=diagnosed, stages=stages)
        if reduced is not None:
            result = replace_fields(result, reduced=_as_used(reduced, experiment))
        provenance = Provenance.of_experiment(experiment, data)
        return write_run(place, result, MAP, origin, stages, provenance)


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


def _provenance_of_channels(scenario: Scenario, data: Data | None, cube: CubeResult) -> Provenance:
    """Of the data of the first channel that could be mapped; all have the same times."""
    first = next(c for c in scenario.channels() if c.frequency_mhz not in cube.unmapped)
    if data is None:
        observation = scenario.observation.observation()
    elif cube.reduced is not None:
        observation = visibilities_of(cube.reduced, first).observation
    else:
        observation = read_data(data, first).observation
    known = cube.stacked("truth") is not None
    return Provenance.of(scenario, observation, data, known_sky=known)


def _write_maps(result: MapResult, folder: Path) -> None:
    for name, pixels in result.channel.maps().items():
        write_map(folder / f"{name}.fits", name, pixels, result.scenario)


def _write_coefficients(result: MapResult, folder: Path) -> None:
    header = cards("mean", result.scenario)
    write_alms(folder / "mean_alm.fits", result.channel.mean, header)


def _write_reduced(result: MapResult | CubeResult, folder: Path) -> None:
    write_reduced(folder / REDUCED, result.reduced, result.scenario.to_yaml())


def _write_offsets(result: MapResult, folder: Path) -> None:
    result.pointing.offsets.to_csv(folder / "pointing.csv", index=False)


def _write_preferred(result: MapResult, folder: Path) -> None:
    result.pointing.preferred.to_csv(folder / "pointing_by_day.csv", index=False)


def _write_cubes(result: CubeResult, folder: Path) -> None:
    for name, pixels in result.maps().items():
        write_cube(folder / f"{name}.fits", name, pixels, result.frequencies_mhz, result.scenario)


def _write_scenario(result: MapResult | CubeResult, folder: Path) -> None:
    (folder / "scenario.yaml").write_text(result.scenario.to_yaml(), encoding="utf-8")


def _write_summary(result: MapResult | CubeResult, folder: Path) -> None:
    (folder / "summary.json").write_text(
        json.dumps(result.summary(), indent=2) + "\n", encoding="utf-8"
    )


def _write_unknowns(result: MapResult | CubeResult, folder: Path) -> None:
    result.unknowns.table.to_csv(folder / "unknowns.csv", index=False)


UNKNOWNS = Output(_write_unknowns, wanted=lambda result: result.unknowns is not None)

# what the folder of a map holds; a new file is one line here
MAP = RunKind(
    "map",
    outputs=(
        Output(lambda result, folder: write_posterior(result, folder / "posterior.nc")),
        Output(_write_maps),
        Output(_write_coefficients),
        Output(
            lambda result, folder: write_csv(
                folder / "spectra.csv", rows_of(result.channel.spectra())
            )
        ),
        Output(
            lambda result, folder: result.fluxes.to_csv(folder / "sources.csv", index=False),
            wanted=lambda result: result.fluxes is not None,
        ),
        Output(_write_offsets, wanted=lambda r: r.pointing and r.pointing.offsets is not None),
        UNKNOWNS,
        Output(_write_preferred, wanted=lambda result: result.pointing is not None),
        Output(
            lambda result, folder: write_diagnostics(result.diagnostics, folder / "diagnostics.nc")
        ),
        Output(_write_reduced, wanted=lambda result: result.reduced is not None),
        Output(_write_scenario),
        Output(_write_summary),
    ),
    figures={
        "maps": lambda result: sky_maps(result.channel),
        "data_vector": lambda result: data_vector(result.experiment.data),
        "beams": lambda result: beams(result.experiment.setup),
        "fidelity": lambda result: map_fidelity(result.channel),
        "spectra": lambda result: sky_spectra(result.channel),
        "draws": lambda result: draws_of_posterior(result.diagnostics),
        "residuals": lambda result: residuals_by_product(result.diagnostics),
        "pointing": lambda result: result.pointing and pointing_by_day(result.pointing.preferred),
        "flight_time_line": lambda r: r.reduced and time_line(r.reduced),
        "flight_waterfall": lambda r: r.reduced and waterfall(r.reduced, r.band),
        "flight_calibration": lambda r: r.reduced and calibration(r.reduced),
    },
)

CUBE = RunKind(
    "cube",
    outputs=(
        Output(
            lambda result, folder: result.to_dataset().to_netcdf(
                folder / "posterior.nc", engine="h5netcdf"
            )
        ),
        Output(_write_cubes),
        Output(lambda result, folder: write_csv(folder / "spectra.csv", result.spectra())),
        UNKNOWNS,
        Output(_write_reduced, wanted=lambda result: result.reduced is not None),
        Output(_write_scenario),
        Output(_write_summary),
    ),
    figures={
        "maps": channel_maps,
        "spectra": channel_spectra,
        "fidelity": channel_fidelity,
        "chi2": chi2,
        "unknowns": lambda r: r.unknowns and unknowns_by_frequency(r.unknowns),
        "flight_time_line": lambda r: r.reduced and time_line(r.reduced),
        "flight_calibration": lambda r: r.reduced and calibration(r.reduced),
    },
    unfinished=CHANNELS,
    dpi=100,
)
