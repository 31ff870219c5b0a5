"""The sources of beams: the embedded antennas, scalar files and four-port responses."""

from dataclasses import replace

import numpy as np
import pytest
from assertions import refuse

from lusee_bayes.instrument.beams import monopoles, sampled
from lusee_bayes.instrument.beams.source import BeamSource
from lusee_bayes.testing import check_beam_source

FREQUENCY, LMAX, TURNED_DEG = 25.0, 6, 30.0


@pytest.fixture(scope="module")
def scalar(test_data):
    """The beam of one arm: synthetic, in steps of 1 degree."""
    return sampled.read_beam(test_data / "luseepy" / "synthetic_monopole_beam.fits")


@pytest.fixture(scope="module")
def response(test_data):
    """Short dipoles with luseepy's receivers, in steps of 2 degrees."""
    return sampled.read_beam(test_data / "luseepy" / "synthetic_response_v3.fits")


# nodes between the files' directions see splines: 1e-10 measured. luseepy's rule for scalar beams
# costs h^2 / 12 of the slopes at zenith and horizon (1.7e-4 measured), its rule for responses
# counts the horizon half (4.8e-4)
SPLINES, LUSEEPY = 1e-9, 1e-3


def check(source: BeamSource, quadrature: float) -> None:
    turned = replace(source, turntable_offset_deg=source.turntable_offset_deg + TURNED_DEG)
    sizes = {"frequency_mhz": FREQUENCY, "lmax": LMAX}
    check_beam_source(source, turned, turned_deg=TURNED_DEG, quadrature=quadrature, **sizes)


def test_embedded_beams():
    source = monopoles.Monopoles(turntable_offset_deg=4.0)
    check(source, 1e-12)
    assert not source.background(FREQUENCY).any() and source.impedance(FREQUENCY) is None
    assert source.circuit(FREQUENCY) is None


TWO_ARMS = {"moon_k": 250.0, "rotations_deg": (0.0, 90.0), "taper": False}
BY_LUSEEPY = {"moon_k": 250.0, "luseepy_quadrature": True, "turntable_offset_deg": 7.0}, LUSEEPY


@pytest.mark.parametrize(
    ("options", "quadrature"), [({}, SPLINES), (TWO_ARMS, SPLINES), BY_LUSEEPY]
)
def test_scalar_file_beams(scalar, options, quadrature):
    source = replace(scalar, **options)
    check(source, quadrature)
    assert source.impedance(FREQUENCY) == scalar.impedance_ohm[scalar.frequencies_mhz == FREQUENCY]
    assert source.circuit(FREQUENCY) is None


@pytest.mark.parametrize(("options", "quadrature"), [({"antenna_k": 300.0}, SPLINES), BY_LUSEEPY])
def test_response_beams(response, options, quadrature):
    losses = np.tile(0.5 * np.eye(4, dtype=complex), (4, 1, 1))
    source = replace(response, loss_ohm=losses, **options)
    check(source, quadrature)
    assert source.impedance(FREQUENCY) is None
    kelvin = source.circuit(FREQUENCY).per_kelvin.diagonal().real
    np.testing.assert_array_equal(kelvin, response.per_kelvin(FREQUENCY))


def test_a_file_has_no_embedded_antennas_and_no_other_frequencies(scalar, response):
    for source in (replace(scalar, moon_k=250.0), replace(response, moon_k=250.0)):
        refuse(r"embedded antennas, which beam\.file replaces", getattr, source, "monopoles")
        for ask in (lambda f, s=source: s.beams(f, 2), source.background):
            refuse("50 MHz.* 51", ask, 51.0)
    refuse("50 MHz.* 51", scalar.impedance, 51.0)
    assert replace(scalar, impedance_ohm=None).impedance(51.0) is None
