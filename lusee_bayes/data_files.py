"""Measured data of a scenario, from whatever file holds them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lusee_bayes.beams import PortResponse
from lusee_bayes.building import build_beam_file
from lusee_bayes.checks import InputError
from lusee_bayes.fits_images import is_fits
from lusee_bayes.products import N_ANTENNAS
from lusee_bayes.scenario import Scenario
from lusee_bayes.visibilities import Visibilities, read_visibilities
from lusee_bayes.waterfalls import Waterfall, read_waterfall

# beams and data hold the impedances with 24 bits
SAME_SCALE = 1e-5


def read_data(path: Path, scenario: Scenario) -> Visibilities:
    """Visibilities of the package's own files, or one channel of luseepy's waterfalls.

    InputError if a waterfall does not fit the scenario's beams.
    """
    if not (path.is_file() and is_fits(path)):
        return read_visibilities(path)
    waterfall = read_waterfall(path)
    section = scenario.beam
    beam = None if section.file is None else build_beam_file(scenario, section.file)
    response = beam if isinstance(beam, PortResponse) else None
    scalar = beam is not None and response is None
    data = waterfall.at(
        scenario.frequency_mhz, len(section.rotations_deg) if scalar else N_ANTENNAS
    )
    if waterfall.per_kelvin is not None:
        _require_same_instrument(waterfall, scenario, response)
    return data


def _require_same_instrument(
    waterfall: Waterfall, scenario: Scenario, response: PortResponse | None
) -> None:
    """InputError unless data in V^2/Hz are those of these antennas, receivers and temperatures."""
    if response is None:
        raise InputError(
            f"{waterfall.path} is in V^2/Hz, at the receivers' inputs of a four-port instrument; "
            "give its response as beam.file"
        )
    theirs = waterfall.per_kelvin[waterfall.channel(scenario.frequency_mhz)]
    ours = response.per_kelvin(scenario.frequency_mhz)
    port = int(np.argmax(np.abs(theirs / ours - 1.0)))
    if abs(theirs[port] / ours[port] - 1.0) > SAME_SCALE:
        raise InputError(
            f"in {waterfall.path} 1 K is {theirs[port]:.6g} V^2/Hz at port {port}, with "
            f"{response.path} and beam.receiver={scenario.beam.receiver} it is {ours[port]:.6g}; "
            "give the response and the receiver that the data were taken with"
        )
    section = scenario.beam
    for name, theirs_k, ours_k in (
        ("moon_temperature_k", waterfall.moon_k, section.moon_temperature_k),
        ("antenna_temperature_k", waterfall.antenna_k, section.antenna_temperature_k),
    ):
        if theirs_k != ours_k:
            raise InputError(
                f"{waterfall.path} holds the emission of {theirs_k:g} K, the scenario's {name} is "
                f"{ours_k:g}; use --set beam.{name}={theirs_k:g}"
            )
