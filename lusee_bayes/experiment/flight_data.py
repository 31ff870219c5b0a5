"""Sessions of the spectrometer as a scenario reduces them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from lusee_bayes.core import formats
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.files import user_path
from lusee_bayes.core.formats import format_of
from lusee_bayes.core.progress import Stages
from lusee_bayes.experiment.instrument_sections import FlightSection
from lusee_bayes.experiment.scenario import Scenario
from lusee_bayes.flight.bands import shared_noise
from lusee_bayes.flight.clock import read_clock
from lusee_bayes.flight.flags import NO_LINES, read_lines
from lusee_bayes.flight.gain_model import GainModel, read_gain_table
from lusee_bayes.flight.recipe import Recipe
from lusee_bayes.flight.reduced import Reduced
from lusee_bayes.flight.reduction import reduce_sessions
from lusee_bayes.flight.session_files import read_session
from lusee_bayes.instrument.products import CONVENTIONS
from lusee_bayes.instrument.visibilities import Visibilities


def reduce_files(
    paths: Sequence[str | Path], scenario: Scenario, stages: Stages | None = None
) -> Reduced:
    """Reduce sessions to the scenario's frequencies.

    Parameters
    ----------
    paths : sequence of paths
        HDF5 or FITS of luseepy's ``lusee.ingest``, in any order.
    scenario : Scenario
    stages : Stages, optional
        Told how far it is.

    Raises
    ------
    InputError
        If the scenario does not say what the files leave open, a file is given twice or reduced
        already, or as :func:`.read_session` and :func:`.reduce_sessions`.
    """
    stages = stages or Stages()
    paths = [user_path(path) for path in paths]
    known = [path.resolve() for path in paths]
    for k, path in enumerate(known):
        if path in known[:k]:
            raise InputError(f"'{paths[k]}' is given twice; give every session once")
        if format_of(path) == formats.REDUCED:
            raise InputError(f"'{paths[k]}' is reduced already; give it to lusee-bayes map --data")
    recipe = recipe_of(scenario)
    with stages("sessions"):
        sessions = [read_session(path) for path in paths]
    return reduce_sessions(sessions, recipe, stages)


def recipe_of(scenario: Scenario) -> Recipe:
    """How a scenario reduces sessions.

    Raises
    ------
    InputError
        If it does not say what the files leave open: gains, bin origin, what the times are.
    """
    section = scenario.flight
    if section is None:
        raise InputError(
            "the data are sessions of the spectrometer, and the scenario does not say how they "
            "become visibilities; give it a section flight, or --set 'flight={gain_table: ..., "
            "bin_origin: centre}' (docs/howto/first_light.md)"
        )
    if section.gain_table is None:
        raise InputError(
            "the sessions hold counts, and the scenario names no gain table; use --set "
            "flight.gain_table=... (the folder of luseepy's gain model, or a netCDF file)"
        )
    if section.bin_origin is None:
        raise InputError(
            "it is not settled whether channel k of the spectrometer has its centre or its lower "
            "edge at k times 25 kHz, which differ by 12.5 kHz; use --set flight.bin_origin=centre "
            "(luseepy's labels) or edge"
        )
    timestamp = scenario.observation.timestamp
    if timestamp is None:
        raise InputError(
            "the sessions do not say whether their times are the start, the middle or the end of "
            "the integrations; use --set observation.timestamp=middle (or start, end, instant)"
        )
    here = scenario.observation
    as_given = {"degree", "turntable_deg", "comb", "false_alarm", "gain_std"}
    return Recipe(
        gain_table_of(section),
        section.bin_origin,
        timestamp,
        scenario.frequencies_mhz or (scenario.frequency_mhz,),
        section.bandwidth_hz / 1e6,
        average_s=here.average_s,
        shared_noise=shared_noise(section.filter_taps, section.filter_window),
        sign=int(CONVENTIONS[section.convention]),
        lines=NO_LINES if section.lines is None else read_lines(section.lines),
        clock=None if section.clock is None else read_clock(section.clock),
        site=(here.lon_deg, here.lat_deg) if section.site == "scenario" else None,
        **section.model_dump(include=as_given),
    )


def visibilities_of(reduced: Reduced, scenario: Scenario) -> Visibilities:
    """One band of reduced spectra, in K, as the scenario's beams have it.

    Raises
    ------
    InputError
        If there is no such band, nothing is left of it, or the beams know no volts.
    """
    return reduced.at(scenario.frequency_mhz, per_kelvin_of(scenario))


def per_kelvin_of(scenario: Scenario) -> Float[np.ndarray, " ports"]:
    """V^2/Hz that an enclosure of 1 K makes at each port.

    Raises
    ------
    InputError
        If neither the beams nor the scenario say it.
    """
    said = None if scenario.flight is None else scenario.flight.per_kelvin_v2_hz
    circuit = scenario.beam.source().circuit(scenario.frequency_mhz)
    if circuit is None and said is None:
        raise InputError(
            "flight data are in V^2/Hz, at the receivers' inputs, and these beams know no volts; "
            "give luseepy's four-port response as beam.file (beam.model=response), or say what "
            "1 K makes: --set flight.per_kelvin_v2_hz=..."
        )
    if circuit is not None and said is not None:
        raise InputError(
            "flight.per_kelvin_v2_hz is for beams that know no volts, and these have impedances; "
            "leave it out"
        )
    if circuit is None:
        return np.full(scenario.beam.n_ports, float(said))
    return np.ascontiguousarray(circuit.per_kelvin.diagonal().real)


def gain_table_of(section: FlightSection) -> GainModel:
    """The gain table that a scenario names, with what it says of its errors.

    Raises
    ------
    InputError
        If the table cannot be read, or says itself what the scenario says of its components.
    """
    table = read_gain_table(section.gain_table, section.gain_model)
    return table.with_component_std(section.component_std)
