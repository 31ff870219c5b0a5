"""Data in files: simulated visibilities, reduced or simulated sessions, and averages.

Sessions are files of the spectrometer, in luseepy's layout. Averages are means of data over longer
times, reported with the information they lose.
"""

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lusee_bayes.core.errors import InputError
from lusee_bayes.core.files import require_new, transaction, user_path
from lusee_bayes.core.progress import Stages
from lusee_bayes.core.reading import naming
from lusee_bayes.experiment import data_files, experiment, model
from lusee_bayes.experiment.flight_simulation import FlightSimulation, flight_of, simulate_flight
from lusee_bayes.experiment.scenario import Scenario, load_scenario
from lusee_bayes.flight.clock import Clock
from lusee_bayes.flight.gain_model import write_gain_table
from lusee_bayes.flight.reduced import Reduced, write_reduced
from lusee_bayes.flight.session_files import write_session
from lusee_bayes.instrument.averaging import averaged, product_live_s
from lusee_bayes.instrument.times import later
from lusee_bayes.instrument.visibilities import Visibilities
from lusee_bayes.instrument.waterfalls import NO_ROOM, write_four_port, write_waterfall
from lusee_bayes.runs import cost, plan_run
from lusee_bayes.runs.folder import RunKind, inputs_of, run_folder
from lusee_bayes.systematics import context, gain_drifts


def run_simulate(
    scenario: Scenario | str | Path,
    path: str | Path,
    *,
    replace: bool = False,
    stages: Stages | None = None,
) -> list[Visibilities]:
    """Simulate the visibilities of a scenario, and write them completely or not at all.

    Parameters
    ----------
    scenario : Scenario, or its file or name
        With one frequency, or several for a waterfall; the seed of the noise increases by one from
        channel to channel.
    path : path
        The file: netCDF, or luseepy's waterfall if the name ends in ``.fits``.
    replace : bool
        Replace the file if it exists already.
    stages : Stages, optional
        Reports progress.

    Returns
    -------
    list of Visibilities
        One for each channel.

    Raises
    ------
    InputError
        If the file exists already, for several channels in a netCDF file, and for data that a
        waterfall cannot store.
    """
    scenario = load_scenario(scenario)
    path, stages = user_path(path), stages or Stages()
    require_new(path, replace=replace, inputs=inputs_of(scenario))
    is_waterfall = path.suffix == ".fits"
    planned = scenario.observation.observation()
    if is_waterfall and (planned.windows is not None or planned.turntable_deg != (0.0,)):
        raise InputError(f"{path}: {NO_ROOM}")
    if scenario.frequencies_mhz and not is_waterfall:
        raise InputError(
            f"'{path}': a netCDF file contains one frequency; for frequencies_mhz (--frequencies), "
            "give -o a name that ends in .fits"
        )
    channels = (scenario,) if scenario.single else scenario.channels()
    cost.require_fits(cost.simulation_cost(scenario, len(channels)), scenario)
    setups = [model.set_up(channel, stages=stages) for channel in channels]
    with stages("noise"):
        data = [model.simulate(setup) for setup in setups]
    if is_waterfall:
        _write_waterfall(path, data, setups, scenario)
    else:
        data[0].write(path, {"scenario": scenario.to_yaml()})
    return data


def _write_waterfall(
    path: Path, data: Sequence[Visibilities], setups: Sequence[context.Setup], scenario: Scenario
) -> None:
    """Write luseepy's four-port layout if the beams have circuits, else its scalar layout."""
    sources = [(setup.beam_source, setup.frequency_mhz) for setup in setups]
    circuits = [circuit for source, f in sources if (circuit := source.circuit(f)) is not None]
    if circuits:
        beam = scenario.beam
        emission = {"moon_k": beam.moon_temperature_k, "antenna_k": beam.antenna_temperature_k}
        said = {"interpolation": beam.interpolation, "response": beam.file}
        write_four_port(path, data, circuits, **emission, **said, scenario=scenario.to_yaml())
        return
    unknown = complex(np.nan, np.nan)
    ohm = [unknown if (z := source.impedance(f)) is None else z for source, f in sources]
    write_waterfall(path, data, np.array(ohm), scenario.to_yaml())


def reduced_lines(reduced: Reduced) -> list[str]:
    """Flags of each band, and its noise relative to the radiometer's, in lines."""
    lines = [reduced.description()[0], *reduced.notes()]
    for band, frequency in enumerate(reduced.frequencies_mhz):
        noise = reduced.scatter[band]
        scatter = "" if np.isnan(noise) else f"; scatter {noise:.2f} times the radiometer's"
        lines.append(f"{frequency:g} MHz: {reduced.flag_line(band)}{scatter}")
        lines += [f"  {text}" for text in reduced.doubts(band)]
    return lines


def run_reduce(
    scenario: Scenario | str | Path,
    files: Sequence[str | Path],
    path: str | Path,
    *,
    replace: bool = False,
    stages: Stages | None = None,
) -> Reduced:
    """Reduce sessions to the scenario's frequencies, and write them completely or not at all.

    Parameters
    ----------
    scenario : Scenario, or its file or name
    files : sequence of paths
        Sessions, in any order.
    path : path
        The netCDF file to write.
    replace, stages : bool and Stages, optional
        As in :func:`run_simulate`.

    Raises
    ------
    InputError
        If the file would replace a session, if it exists already (unless ``replace``), if the
        sessions have no number in any band, and as :func:`.reduce_files`.
    """
    scenario = load_scenario(scenario)
    stages, path = stages or Stages(), user_path(path)
    require_new(path, replace=replace, inputs=inputs_of(scenario, files))
    reduced = data_files.reduce_files(files, scenario, stages)
    if np.isnan(reduced.before).all():
        raise InputError(
            f"nothing to reduce: all {len(reduced.bin_of)} spectra of {', '.join(map(str, files))} "
            "are NaN in every band; check the sessions, and the frequencies of the scenario"
        )
    with stages("file"):
        write_reduced(path, reduced, scenario.to_yaml())
    return reduced


SUFFIX = {"hdf5": "h5", "fits": "fits"}
GAINS, CLOCK, TRUTH, SCENARIO = "gains.nc", "clock.json", "truth.npz", "scenario.yaml"
# averaging time of spectra for a map, unless the scenario sets it
AVERAGE_S = 7200.0
FLIGHT = RunKind("simulated sessions", outputs=(), figures={})


@dataclass(frozen=True)
class FlightFiles:
    """Files that a simulation has written.

    Attributes
    ----------
    sessions : tuple of Path
    scenario : Path
        Scenario with which to map them.
    n_spectra : int
    """

    sessions: tuple[Path, ...]
    scenario: Path
    n_spectra: int

    def lines(self) -> tuple[str, str]:
        """The files written, and the command that maps them."""
        return (
            f"{self.n_spectra} spectra of {len(self.sessions)} sessions -> {self.scenario.parent}",
            f"lusee-bayes map {self.scenario} --data {' '.join(map(str, self.sessions))}",
        )


def run_simulate_flight(
    scenario: Scenario | str | Path,
    folder: str | Path,
    *,
    replace: bool = False,
    stages: Stages | None = None,
) -> FlightFiles:
    """Simulate sessions, and write them with everything needed to map them.

    Parameters
    ----------
    scenario : Scenario, or its file or name
        With one or several frequencies.
    folder : path
        Folder for ``session_000.h5``, ... , ``truth.npz`` with the content of every spectrum,
        ``scenario.yaml``, ``gains.nc`` if the scenario has no gain table, and ``clock.json`` if the
        files have no clock.
    replace : bool
        Replace sessions that are in the folder already.
    stages : Stages, optional
        Reports progress.

    Raises
    ------
    InputError
        If the folder has sessions already or is not writable, and as :func:`.simulate_flight`.
    """
    scenario, folder, stages = load_scenario(scenario), user_path(folder), stages or Stages()
    if not replace and (earlier := sorted(folder.glob("session_*"))):
        raise InputError(
            f"'{folder}' already contains sessions ({earlier[0].name}); give another -o, or --force"
        )
    with run_folder(folder, FLIGHT, scenario, replace=replace) as run:
        made, place = simulate_flight(scenario, stages), run.path
        with transaction(place, FLIGHT.name, origin=run.origin) as stage:
            names = _write_flight(made, stage, place.resolve(), stages)
        paths = tuple(place / name for name in names)
        return FlightFiles(paths, place / SCENARIO, made.observation.n_times)


def _write_flight(made: FlightSimulation, stage: Path, folder: Path, stages: Stages) -> list[str]:
    """Write the files for ``folder`` into ``stage``; return the names of the sessions."""
    suffix = SUFFIX[made.section.kind]
    names = [f"session_{number:03d}.{suffix}" for number in range(len(made.sessions))]
    if flight_of(made.scenario).gain_table is None:
        write_gain_table(stage / GAINS, made.table)
    if made.section.clock == "unknown":
        (stage / CLOCK).write_text(_clock_text(made.clock), encoding="utf-8")
    np.savez(stage / TRUTH, **_truth(made))
    (stage / SCENARIO).write_text(_to_be_mapped(made, folder).to_yaml(), encoding="utf-8")
    with stages.progress("spectra", made.observation.n_times) as done:
        for name, session in zip(names, made.sessions, strict=True):
            blocks = _told(made.blocks(session), session.start, done)
            write_session(stage / name, made.rows(session), blocks, kind=made.section.kind)
    return names


def _told(
    blocks: Iterator[np.ndarray], start: int, done: Callable[..., None]
) -> Iterator[np.ndarray]:
    for block in blocks:
        yield block
        start += len(block)
        done(start)


def _to_be_mapped(made: FlightSimulation, folder: Path) -> Scenario:
    """The scenario, completed with everything that the files lack."""
    flight, observation = flight_of(made.scenario), made.scenario.observation
    seen = made.observation
    # windows are centred on times
    starts = later(seen.times, seen.windows.start_s).isot[np.unique(seen.run, return_index=True)[1]]
    said = {
        "gain_table": flight.gain_table or str(folder / GAINS),
        # a table written by the simulation contains it
        "component_std": flight.component_std if flight.gain_table else None,
        "bin_origin": made.origin,
        "clock": str(folder / CLOCK) if made.section.clock == "unknown" else None,
        "turntable_deg": seen.turntable_deg[0],
        "turns": dict(list(zip(starts.tolist(), seen.turntable_deg, strict=True))[1:]),
        "site": "file",
        "simulated": made.section,
    }
    average_s = observation.average_s or (AVERAGE_S if observation.step_s < AVERAGE_S else None)
    times = {"timestamp": "middle", "average_s": average_s}
    scenario, flight = made.scenario.anchored(), flight.anchored().model_copy(update=said)
    observation = scenario.observation.model_copy(update=times)
    return scenario.model_copy(update={"flight": flight, "observation": observation})


def _clock_text(clock: Clock) -> str:
    record = {
        "format_version": 1,
        "reference_event": "simulated",
        "clock_reference_isot": clock.isot,
        "time_scale": clock.scale,
        "clocks": {"spectrometer": {"clock_reference_raw_seconds": clock.raw_s}},
        "source": "simulated",
        "assumed": False,
    }
    return json.dumps(record, indent=2) + "\n"


def _truth(made: FlightSimulation) -> dict[str, np.ndarray]:
    """The content of every spectrum, in the order of all sessions."""
    session = np.repeat(np.arange(len(made.sessions)), [s.stop - s.start for s in made.sessions])
    return {
        "session": session,
        "mjd_utc": made.observation.times.mjd,
        "frequency_mhz": made.frequencies_mhz,
        "visibility_v2_hz": made.visibilities,
        "frames": np.array(made.frames),
        "gain_error_name": np.array(list(made.gain_errors), dtype=np.str_),
        "gain_error": np.array(list(made.gain_errors.values())),
        **made.disturbances.truth(),
    }


@dataclass(frozen=True)
class Averages:
    """Data, their averages, and the information lost.

    Attributes
    ----------
    data, averaged : Visibilities
        Before and after.
    bits : tuple of float, or None
        Information about the map in both, ``ln|1 + S^1/2 A^T N^-1 A S^1/2| / (2 ln 2)``; None if
        it was not requested.
    """

    data: Visibilities
    averaged: Visibilities
    bits: tuple[float, float] | None

    @property
    def lost_share(self) -> float:
        """Share of the live time of all products that averaging drops because of flags."""
        return 1.0 - product_live_s(self.averaged) / product_live_s(self.data)

    def lines(self) -> tuple[str, ...]:
        """Lines for a terminal."""
        before, after = (d.observation for d in (self.data, self.averaged))
        said = [
            f"{before.n_times} samples of {before.step_s:g} s -> {after.n_times} of "
            f"{after.step_s:g} s",
            f"live time lost where products have different flags: {self.lost_share:.2%}",
        ]
        if self.bits is not None:
            fine, coarse = self.bits
            lost = f"{fine - coarse:.3g} lost"
            said.append(f"information about the map: {fine:.2f} bits -> {coarse:.2f} bits, {lost}")
        return tuple(said)


def run_average(
    scenario: Scenario | str | Path,
    data: data_files.Data,
    to_s: float,
    path: str | Path,
    *,
    information: bool = True,
    replace: bool = False,
    stages: Stages | None = None,
) -> Averages:
    """Average data, write them completely or not at all, and compute the loss of information.

    Parameters
    ----------
    scenario : Scenario, or its file or name
        How to read the data and compute the information; ``average_s`` is ignored.
    data : Visibilities or path
        With windows.
    to_s : float
        Length of the averages, in seconds.
    path : path
        The netCDF file to write.
    information : bool
        Compute the information about the map, in the data and in their averages.
    replace, stages : bool and Stages, optional
        As in :func:`run_simulate`.

    Raises
    ------
    InputError
        If the data do not fit the scenario, if it needs too much memory, if the file exists already
        (unless ``replace``), and as :func:`.read_data` and :func:`.averaged`.
    """
    scenario = load_scenario(scenario)
    stages, path = stages or Stages(), user_path(path)
    if path.suffix == ".fits":
        wrong = f"'{path}': luseepy's waterfalls cannot store windows; give -o a name without .fits"
        raise InputError(wrong)
    require_new(path, replace=replace, inputs=inputs_of(scenario, data))
    scenario.require_single("averages have")
    scenario = scenario.with_section("observation", average_s=None)
    with stages("data"):
        fine = data_files.read_data(data, scenario)
        with naming(data_files.names_of_data(data)[0]):
            coarse = averaged(fine, to_s)
    model.require_fitting(fine, scenario)
    if said := gain_drifts.drift_within(scenario.noise.gain, coarse.observation):
        raise InputError(said)
    if information:
        cost.require_resources(scenario, fine, stages)
    coarse.write(path)
    if not information:
        return Averages(fine, coarse, None)
    with stages("information of the data"):
        before = _bits(scenario, fine)
    with stages("and of the averages"):
        return Averages(fine, coarse, (before, _bits(scenario, coarse)))


def _bits(scenario: Scenario, data: Visibilities) -> float:
    setup = experiment.observed(scenario.of_measured(), data).setup
    return float(plan_run.expected_inference(setup).posterior.information_bits())
