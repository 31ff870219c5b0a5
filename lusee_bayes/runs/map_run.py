"""A map run: the posterior over the sky at one frequency, or at several."""

from contextlib import suppress
from dataclasses import replace as replace_fields
from pathlib import Path

import numpy as np

from lusee_bayes.core.engine import Engine
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.harmonics import modes_to_map
from lusee_bayes.core.progress import Stages
from lusee_bayes.experiment import data_files
from lusee_bayes.experiment.scenario import Scenario, load_scenario
from lusee_bayes.flight.reduced import REDUCED, Reduced, write_reduced
from lusee_bayes.instrument.visibilities import Visibilities
from lusee_bayes.report.figures import judgement, maps
from lusee_bayes.results import finished_runs
from lusee_bayes.results.map_result import MapResult
from lusee_bayes.runs.channels import CHANNELS, map_channels
from lusee_bayes.runs.cost import require_resources
from lusee_bayes.runs.folder import SCENARIO, Output, RunKind, RunOutcome, run_folder
from lusee_bayes.sky.sky_source import write_alms


def run_map(
    scenario: Scenario | str | Path,
    folder: str | Path,
    *,
    data: data_files.Data | None = None,
    truth: bool = False,
    earlier: str | Path | None = None,
    thorough: bool = False,
    engine: Engine | None = None,
    replace: bool = False,
    stages: Stages | None = None,
) -> RunOutcome[MapResult]:
    """Make a posterior map of a scenario, or of given data, and write its folder.

    The folder is written in one transaction. The same call resumes a stopped run of several
    frequencies.

    Parameters
    ----------
    scenario : Scenario, or its file or name
        With one or several frequencies; ``output`` selects results in addition to the maps.
    folder : path
        Folder of the results.
    data : Visibilities, path, or sequence of them, optional
        Visibilities to map, in memory or in a file, or sessions of the spectrometer; if omitted,
        data are simulated from the scenario.
    truth : bool
        Compare the map with the scenario's sky (use if the data were simulated from it).
    earlier : path, optional
        Folder of a run with saved information (``output.information``), whose posterior these data
        update.
    thorough : bool
        Test every group of data, and try the usual mistakes in data and model, even if the data
        fit.
    engine : Engine, optional
        Where channels are computed; by default in this process.
    replace : bool
        Replace results of another run in the folder.
    stages : Stages, optional
        Reports progress.

    Raises
    ------
    InputError
        If the scenario samples an unknown, or scenario, data or folder are invalid.
    """
    scenario = load_scenario(scenario)
    scenario = scenario if data is None else scenario.of_measured()
    stages = stages or Stages()
    scenario.require_marginal("a map", "use: lusee-bayes sample")
    if not scenario.single and data is None:
        require_resources(scenario, None, stages)
    origin = {"truth": truth or None, "earlier": earlier}
    with run_folder(folder, MAP, scenario, data, earlier, replace=replace, **origin) as run:
        reduced = None if data is None else data_files.reduced_of(data, scenario, stages)
        given = _given(data, reduced, scenario, run.path)
        if not scenario.single and given is not None:
            require_resources(scenario, _first(given, scenario), stages)
        more = {"truth": truth, "earlier": earlier, "thorough": thorough, "engine": engine}
        made = map_channels(scenario, run.path, data=given, stages=stages, **more)
        known_sky = made.stacked("truth") is not None
        times = finished_runs.taken_together(made.channels)
        made = replace_fields(made, reduced=reduced and _as_used(reduced, made))
        provenance = finished_runs.Provenance.of(scenario, times, data, known_sky=known_sky)
        return run.write(made, stages, provenance)


def _given(
    data: data_files.Data | None, reduced: Reduced | None, scenario: Scenario, folder: Path
) -> data_files.Data | None:
    """The data that channels read: sessions as reduced spectra, in a file for several channels."""
    if reduced is None:
        return data
    if scenario.single:
        return data_files.visibilities_of(reduced, scenario)
    if not data_files.are_sessions(data):
        return data
    path = folder / CHANNELS / REDUCED
    path.parent.mkdir(exist_ok=True)
    return write_reduced(path, reduced, scenario.to_yaml())


def _first(data: data_files.Data, scenario: Scenario) -> Visibilities | None:
    """The data of the first channel that has any."""
    for channel in scenario.channels():
        with suppress(InputError):
            return data_files.read_data(data, channel)
    return None


def _as_used(reduced: Reduced, result: MapResult) -> Reduced:
    """Reduced spectra without the data that did not fit."""
    for channel in result.channels:
        if channel.flagged is not None:
            band = reduced.band(channel.frequency_mhz)
            gone = np.zeros(reduced.values.shape[1:], dtype=bool)
            gone[:, reduced.bins_at(band)] = channel.flagged
            reduced = reduced.without(band, gone)
    return reduced


# a FITS table has 999 columns; posterior.nc has all draws
MOST_DRAWS = 100


def _write_maps(result: MapResult, folder: Path) -> None:
    if result.single:
        channel = result.channel
        draws = channel.draws[:MOST_DRAWS] if len(channel.draws) else channel.details.draws
        skies = {f"draw_{k}": modes_to_map(sky, channel.nside) for k, sky in enumerate(draws, 1)}
        observed = channel.highest_altitude >= 0
        shown = channel.maps() | skies
        finished_runs.write_map(folder / "map.fits", shown, observed, result.scenario)
    else:
        finished_runs.write_cubes(folder, result.maps(), result.frequencies_mhz, result.scenario)


def _write_coefficients(result: MapResult, folder: Path) -> None:
    header = finished_runs.cards("mean", result.scenario)
    write_alms(folder / "mean_alm.fits", result.channel.mean, header)


def _write_spectrum(result: MapResult, folder: Path) -> None:
    Output.netcdf("spectrum.nc", finished_runs.spectrum_tree).write(result, folder)
    Output.ecsv("spectrum.ecsv", lambda result: result.sky_spectrum().table()).write(result, folder)


# contents of the folder of a map; a new file is one line here
MAP = RunKind(
    "map",
    outputs=(
        Output.netcdf("posterior.nc", finished_runs.posterior_tree),
        Output.netcdf("diagnostics.nc", finished_runs.diagnostics_tree),
        Output(_write_maps),
        Output(_write_coefficients, wanted=lambda result: result.single),
        Output.ecsv("power_spectra.ecsv", lambda result: result.spectra()),
        Output(_write_spectrum, wanted=lambda result: not result.single),
        Output(finished_runs.write_index_maps, wanted=lambda r: r.index_maps() is not None),
        Output.table("sources.csv", lambda result: result.table("fluxes")),
        Output.table("pointing.csv", lambda result: result.table("pointing", "offsets")),
        Output.table("pointing_by_day.csv", lambda result: result.table("pointing", "preferred")),
        Output.table("unknowns.csv", lambda result: result.table("unknowns", "table")),
        Output(
            lambda r, folder: write_reduced(folder / REDUCED, r.reduced, r.scenario.to_yaml()),
            wanted=lambda r: r.reduced is not None,
        ),
        SCENARIO,
        Output.model("summary.json", lambda result: result.summary()),
    ),
    figures={
        "maps": maps.sky_maps,
        "data_vector": maps.data_vector,
        "beams": maps.beams,
        "fidelity": maps.fidelity,
        "spectra": maps.spectra,
        "sky_spectrum": maps.sky_spectrum,
        "spectral_index": maps.spectral_index,
        "draws": maps.draws,
        "chi2": maps.chi2,
        "residuals": judgement.residuals_by_product,
        "groups": judgement.groups_by_frequency,
        "pointing": judgement.pointing_by_day,
        "unknowns": judgement.unknowns_by_frequency,
        "corner": judgement.corner,
        "instrument_share": maps.instrument_share,
        "flight_waterfall": judgement.waterfall,
        "flight_time_line": lambda r: r.reduced and judgement.time_line(r.reduced),
        "flight_calibration": lambda r: r.reduced and judgement.calibration(r.reduced),
    },
    unfinished=CHANNELS,
    resume="the same command continues from the finished channels",
)
