"""The single pieces that a scenario's sections stand for."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Array, Float

from lusee_bayes.beams import (
    AntennaFields,
    HemisphereGrid,
    Monopoles,
    PortResponse,
    ProductBeams,
    Regolith,
    ScalarBeam,
    monopole_beams,
    read_beam,
)
from lusee_bayes.beams.gridded import at_frequency
from lusee_bayes.checks import InputError, nearest
from lusee_bayes.ephemeris import BODIES, body_direction
from lusee_bayes.noise import GainDrift
from lusee_bayes.observation import Observation, Run
from lusee_bayes.scenario import Scenario
from lusee_bayes.sections import SourceSection
from lusee_bayes.sky import (
    BRIGHT_SOURCES,
    Sky,
    galactic_unit_vector,
    galaxy_sky,
    kelvin_steradian,
    sky_from_file,
)
from lusee_bayes.source_response import source_response


def build_observation(scenario: Scenario) -> Observation:
    """Site, times and turntable angles."""
    section = scenario.observation
    return Observation.from_runs(
        tuple(Run(r.cycles, r.turntable_deg, r.night_only) for r in section.runs),
        start=section.start,
        step_s=section.step_s,
        lon_deg=section.lon_deg,
        lat_deg=section.lat_deg,
        fixed_axis=section.fixed_axis,
    )


def build_monopoles(scenario: Scenario) -> Monopoles:
    """The embedded antennas with the scenario's parameters."""
    beam = scenario.beam
    return Monopoles(
        regolith=Regolith(beam.surface_permittivity, beam.deep_permittivity, beam.loss_tangent),
        length_m=beam.length_m,
        zenith_angle_deg=beam.zenith_angle_deg,
        height_m=beam.height_m,
        turntable_offset_deg=beam.turntable_offset_deg,
    )


def build_beams(
    scenario: Scenario, frequency_mhz: float | None = None, file: str | None = None
) -> ProductBeams:
    """Beams of all products, of the embedded antennas or of a file.

    ``frequency_mhz``, ``file``: of other beams than the scenario's.
    """
    frequency = scenario.frequency_mhz if frequency_mhz is None else frequency_mhz
    file = scenario.beam.file if file is None else file
    if file is None:
        return monopole_beams(frequency, scenario.lmax, build_monopoles(scenario))
    beam = build_beam_file(scenario, file)
    grid = beam.luseepy_grid if scenario.beam.quadrature == "luseepy" else None
    return beam.beams(frequency, scenario.lmax, grid=grid, **_placement(scenario, beam))


def build_background(
    scenario: Scenario, frequency_mhz: float | None = None, file: str | None = None
) -> Float[Array, " products"] | None:
    """Visibilities without any sky, in K: what Moon and antennas emit; None where nothing does.

    ``frequency_mhz``, ``file``: as for :func:`build_beams`.
    """
    section = scenario.beam
    moon, antenna = section.moon_temperature_k, section.antenna_temperature_k
    file = section.file if file is None else file
    if file is None or not (moon or antenna):
        return None
    beam = build_beam_file(scenario, file)
    frequency = scenario.frequency_mhz if frequency_mhz is None else frequency_mhz
    if isinstance(beam, PortResponse):
        return beam.background(frequency, moon, antenna)
    if antenna:
        raise InputError(
            f"{file} is a scalar beam, which knows of no losses; leave out "
            "beam.antenna_temperature_k"
        )
    grid = beam.luseepy_grid if section.quadrature == "luseepy" else None
    return beam.background(frequency, moon, grid=grid, **_placement(scenario, beam))


def build_fields(scenario: Scenario, grid: HemisphereGrid) -> AntennaFields:
    """Fields of the antennas at the scenario's frequency, embedded or of a file."""
    if scenario.beam.file is None:
        return build_monopoles(scenario).fields(scenario.frequency_mhz, grid)
    beam = build_beam_file(scenario, scenario.beam.file)
    return beam.fields(scenario.frequency_mhz, grid=grid, **_placement(scenario, beam))


def build_impedance(scenario: Scenario) -> complex:
    """Impedance of the arms in Ohm, NaN unless a scalar beam file has it."""
    beam = None if scenario.beam.file is None else build_beam_file(scenario, scenario.beam.file)
    if not isinstance(beam, ScalarBeam) or beam.impedance is None:
        return complex(np.nan, np.nan)
    known = beam.frequencies_mhz
    (z,) = at_frequency(beam.path, known, scenario.frequency_mhz, beam.impedance)
    return complex(z)


def build_beam_file(scenario: Scenario, file: str) -> ScalarBeam | PortResponse:
    """The beams of a file, with the scenario's receivers on the ports of a response."""
    beam = read_beam(file)
    if isinstance(beam, PortResponse) and scenario.beam.receiver == "open":
        return replace(beam, receiver=None)
    return beam


def _placement(scenario: Scenario, beam: ScalarBeam | PortResponse) -> dict[str, Any]:
    """How the patterns of a file are put up."""
    section = scenario.beam
    if isinstance(beam, PortResponse):
        return {"turn_deg": section.turntable_offset_deg}
    rotations = tuple(angle + section.turntable_offset_deg for angle in section.rotations_deg)
    return {"taper": section.taper, "rotations_deg": rotations}


def build_sky(scenario: Scenario) -> Sky:
    """The scenario's sky up to lmax."""
    section = scenario.sky
    if section.file is None:
        sources = BRIGHT_SOURCES if section.sources else ()
        return galaxy_sky(scenario.frequency_mhz, scenario.lmax, seed=section.seed, sources=sources)
    return sky_from_file(
        section.file,
        scenario.frequency_mhz,
        scenario.lmax,
        dataset=section.dataset,
        file_frequency_mhz=section.file_frequency_mhz,
        spectral_index=section.spectral_index,
    )


def build_gain_drift(scenario: Scenario) -> GainDrift | None:
    """The gain drifts of the scenario, or None."""
    gain = scenario.noise.gain
    return None if gain is None else GainDrift(gain.sigma, gain.correlation_h)


def build_source_responses(
    scenario: Scenario,
    observation: Observation,
    antennas: Monopoles,
    frequency_mhz: float | None = None,
) -> tuple[Float[Array, "products times"], ...]:
    """Response to 1 K sr of each of the scenario's sources, with these antennas.

    ``frequency_mhz``: of the beams, by default the scenario's.
    """
    frequency = scenario.frequency_mhz if frequency_mhz is None else frequency_mhz
    return tuple(
        source_response(
            observation,
            _direction(source, observation),
            frequency,
            antennas,
            stokes_v=source.stokes_v,
        )
        for source in scenario.sources.list
    )


def _direction(source: SourceSection, observation: Observation) -> Float[np.ndarray, "..."]:
    """Galactic unit vector(s) of a source: its own, the catalogue's, or the ephemeris'."""
    if source.ra_deg is not None:
        return galactic_unit_vector(source.ra_deg, source.dec_deg)
    if source.name in BODIES:
        return body_direction(source.name, observation)
    known = {s.name: s for s in BRIGHT_SOURCES}
    if source.name not in known:
        raise InputError(
            f"unknown source '{source.name}'; {nearest(source.name, [*known, *BODIES])} "
            "(or give ra_deg and dec_deg of your own)"
        )
    return galactic_unit_vector(known[source.name].ra_deg, known[source.name].dec_deg)


def source_flux(source: SourceSection, frequency_mhz: float) -> float:
    """Mean of the prior of a source's flux, in K sr. InputError if nothing is known about it."""
    if source.flux_jy is not None:
        return float(kelvin_steradian(source.flux_jy, frequency_mhz))
    for known in BRIGHT_SOURCES:
        if known.name == source.name:
            return float(known.kelvin_steradian(frequency_mhz))
    raise InputError(
        f"the source '{source.name}' is not in the catalogue, so that its flux is not known; give "
        "flux_jy, the mean of its prior"
    )
