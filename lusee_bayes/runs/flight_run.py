"""Sessions of the spectrometer, simulated, in files of luseepy's layout."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lusee_bayes.core.errors import InputError
from lusee_bayes.core.files import transaction, user_path
from lusee_bayes.core.progress import Stages
from lusee_bayes.experiment.flight_simulation import FlightSimulation, flight_of, simulate_flight
from lusee_bayes.experiment.scenario import Scenario, load_scenario
from lusee_bayes.flight.clock import Clock
from lusee_bayes.flight.gain_model import write_gain_table
from lusee_bayes.flight.session_files import write_session
from lusee_bayes.runs.folder import RunKind, run_folder
from lusee_bayes.runs.origins import inputs_of, origin_of

SUFFIX = {"hdf5": "h5", "fits": "fits"}
GAINS, CLOCK, TRUTH, SCENARIO = "gains.nc", "clock.json", "truth.npz", "scenario.yaml"
# how long spectra are averaged for a map, where the scenario does not say it
AVERAGE_S = 7200.0
FLIGHT = RunKind("simulated sessions", outputs=(), figures={})


@dataclass(frozen=True)
class FlightFiles:
    """What a simulation has written.

    Attributes
    ----------
    sessions : tuple of Path
    scenario : Path
        By which they are mapped.
    n_spectra : int
    """

    sessions: tuple[Path, ...]
    scenario: Path
    n_spectra: int

    @property
    def command(self) -> str:
        """The command that maps them."""
        return f"lusee-bayes map {self.scenario} --data {' '.join(map(str, self.sessions))}"


def run_simulate_flight(
    scenario: Scenario | str | Path,
    folder: str | Path,
    *,
    frequencies_mhz: Sequence[float] = (),
    replace: bool = False,
    stages: Stages | None = None,
) -> FlightFiles:
    """Simulate sessions, and write them with all that it takes to map them.

    Parameters
    ----------
    scenario : Scenario, or its file or name
        Of one frequency, or several.
    folder : path
        Takes ``session_000.h5``, ... , ``truth.npz`` with what is in which spectrum,
        ``scenario.yaml``, and ``gains.nc`` and ``clock.json`` where the scenario has no gain table
        and the files no clock.
    frequencies_mhz : sequence of float
        In place of the scenario's.
    replace : bool
        Replace sessions that are in the folder already.
    stages : Stages, optional
        Told how far it is.

    Raises
    ------
    InputError
        As :func:`.simulate_flight`, and if the folder holds sessions already, or cannot be written.
    """
    scenario, folder = load_scenario(scenario), user_path(folder)
    _require_no_sessions(folder, replace)
    stages = stages or Stages()
    if frequencies_mhz:
        scenario = scenario.model_copy(update={"frequencies_mhz": tuple(frequencies_mhz)})
    origin = origin_of(scenario)
    inputs = inputs_of(scenario)
    with run_folder(folder, FLIGHT, origin, replace=replace, inputs=inputs) as place:
        return _simulated(scenario, place, origin, stages)


def _simulated(
    scenario: Scenario, folder: Path, origin: Mapping[str, str], stages: Stages
) -> FlightFiles:
    made = simulate_flight(scenario, stages)
    suffix = SUFFIX[made.section.kind]
    names = [f"session_{number:03d}.{suffix}" for number in range(len(made.sessions))]
    with transaction(folder, FLIGHT.name, origin=origin) as stage:
        if flight_of(scenario).gain_table is None:
            write_gain_table(stage / GAINS, made.table)
        if made.section.clock == "unknown":
            (stage / CLOCK).write_text(_clock_text(made.clock), encoding="utf-8")
        np.savez(stage / TRUTH, **_truth(made))
        (stage / SCENARIO).write_text(
            _to_be_mapped(made, folder.resolve()).to_yaml(), encoding="utf-8"
        )
        with stages.progress("spectra", made.observation.n_times) as done:
            for name, session in zip(names, made.sessions, strict=True):
                write_session(
                    stage / name,
                    made.rows(session),
                    _told(made.blocks(session), session.start, done),
                    kind=made.section.kind,
                )
    paths = tuple(folder / name for name in names)
    return FlightFiles(paths, folder / SCENARIO, made.observation.n_times)


def _require_no_sessions(folder: Path, replace: bool) -> None:
    """InputError where simulated sessions would take the place of others."""
    found = sorted(path.name for path in folder.glob("session_*"))
    if found and not replace:
        raise InputError(
            f"'{folder}' holds sessions already ({found[0]}); give -o another folder, or --force"
        )


def _told(
    blocks: Iterator[np.ndarray], start: int, done: Callable[..., None]
) -> Iterator[np.ndarray]:
    for block in blocks:
        yield block
        start += len(block)
        done(start)


def _to_be_mapped(made: FlightSimulation, folder: Path) -> Scenario:
    """The scenario, with what the files leave open."""
    flight, observation = flight_of(made.scenario), made.scenario.observation
    said = {
        "gain_table": flight.gain_table or str(folder / GAINS),
        # a table that is written has its own
        "component_std": flight.component_std if flight.gain_table else None,
        "bin_origin": made.origin,
        "clock": str(folder / CLOCK) if made.section.clock == "unknown" else None,
        "turntable_deg": made.observation.turntable_deg[0],
        "site": "file",
        "simulated": made.section,
    }
    average_s = observation.average_s
    if average_s is None and observation.step_s < AVERAGE_S:
        average_s = AVERAGE_S
    times = {"timestamp": "middle", "average_s": average_s}
    scenario = made.scenario.anchored()
    return scenario.model_copy(
        update={
            "flight": flight.anchored().model_copy(update=said),
            "observation": scenario.observation.model_copy(update=times),
        }
    )


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
    """What was put into which spectrum, in the order of all sessions."""
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
