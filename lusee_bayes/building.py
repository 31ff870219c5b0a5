"""The single pieces that a scenario's sections stand for."""

from __future__ import annotations

from lusee_bayes.beams import Monopoles, ProductBeams, Regolith, monopole_beams
from lusee_bayes.noise import GainDrift
from lusee_bayes.observation import Observation, Run
from lusee_bayes.scenario import Scenario
from lusee_bayes.sky import BRIGHT_SOURCES, Sky, galaxy_sky, sky_from_file


def build_observation(scenario: Scenario) -> Observation:
    """Site, times and turntable angles."""
    section = scenario.observation
    return Observation.from_runs(
        tuple(Run(r.cycles, r.turntable_deg, r.night_only) for r in section.runs),
        start=section.start,
        step_s=section.step_s,
        lon_deg=section.lon_deg,
        lat_deg=section.lat_deg,
    )


def build_monopoles(scenario: Scenario) -> Monopoles:
    """The embedded antennas with the scenario's parameters."""
    beam = scenario.beam
    return Monopoles(
        regolith=Regolith(beam.surface_permittivity, beam.deep_permittivity, beam.loss_tangent),
        length_m=beam.length_m,
        zenith_angle_deg=beam.zenith_angle_deg,
        height_m=beam.height_m,
    )


def build_beams(scenario: Scenario) -> ProductBeams:
    """Beams of all products at the scenario's frequency."""
    return monopole_beams(scenario.frequency_mhz, scenario.lmax, build_monopoles(scenario))


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
