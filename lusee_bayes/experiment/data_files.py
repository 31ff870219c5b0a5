"""Measured data of a scenario, from whatever file holds them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lusee_bayes.core.errors import InputError
from lusee_bayes.core.fits_files import is_fits
from lusee_bayes.core.reading import require_file
from lusee_bayes.experiment.scenario import Scenario
from lusee_bayes.instrument.visibilities import Visibilities, read_visibilities
from lusee_bayes.instrument.waterfalls import Waterfall, read_waterfall

# beams and data hold the impedances with 24 bits
SAME_SCALE = 1e-5


def read_data(path: Path, scenario: Scenario) -> Visibilities:
    """Read visibilities: the package's own files, or one channel of luseepy's waterfalls.

    Parameters
    ----------
    path : Path
    scenario : Scenario
        Of the frequency to read, and of the instrument that a waterfall has to fit.

    Raises
    ------
    InputError
        If the file cannot be used, or a waterfall does not fit the scenario's beams.
    """
    require_file(path, "data", "make some with: lusee-bayes simulate SCENARIO")
    if not is_fits(path):
        return read_visibilities(path)
    waterfall = read_waterfall(path)
    data = waterfall.at(scenario.frequency_mhz, scenario.beam.n_ports)
    if waterfall.per_kelvin is not None:
        _require_same_instrument(waterfall, scenario)
    return data


def _require_same_instrument(waterfall: Waterfall, scenario: Scenario) -> None:
    """InputError unless data in V^2/Hz are those of these antennas, receivers and temperatures."""
    section = scenario.beam
    ours = section.source().per_kelvin(scenario.frequency_mhz)
    if ours is None:
        raise InputError(
            f"{waterfall.path} is in V^2/Hz, at the receivers' inputs of a four-port instrument; "
            "give its response as beam.file"
        )
    theirs = waterfall.per_kelvin[waterfall.channel(scenario.frequency_mhz)]
    port = int(np.argmax(np.abs(theirs / ours - 1.0)))
    if abs(theirs[port] / ours[port] - 1.0) > SAME_SCALE:
        raise InputError(
            f"in {waterfall.path} 1 K is {theirs[port]:.6g} V^2/Hz at port {port}, with "
            f"{section.file} and beam.receiver={section.receiver} it is {ours[port]:.6g}; "
            "give the response and the receiver that the data were taken with"
        )
    for name, theirs_k, ours_k in (
        ("moon_temperature_k", waterfall.moon_k, section.moon_temperature_k),
        ("antenna_temperature_k", waterfall.antenna_k, section.antenna_temperature_k),
    ):
        if theirs_k != ours_k:
            raise InputError(
                f"{waterfall.path} holds the emission of {theirs_k:g} K, the scenario's {name} is "
                f"{ours_k:g}; use --set beam.{name}={theirs_k:g}"
            )
