"""The sources of beams: the embedded antennas, scalar files and four-port responses."""

from dataclasses import replace

import numpy as np
import pytest
from assertions import refuse

from lusee_bayes.instrument.beams import monopoles, sampled
from lusee_bayes.instrument.beams.fields import HemisphereGrid, beam_scale, product_modes
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


@pytest.mark.parametrize("kind", ["scalar", "response"])
def test_what_is_seen_in_directions_adds_up_to_the_beams(kind, request):
    """Splines of half a degree, integrated with harmonics over a grid of other directions."""
    source, grid = request.getfixturevalue(kind), HemisphereGrid.for_lmax(LMAX)
    theta, phi = (x.ravel() for x in np.meshgrid(grid.theta, grid.phi, indexing="ij"))
    ring = np.sin(theta) * np.exp(1j * phi)
    directions = np.stack([ring.real, ring.imag, np.cos(theta)], axis=1)
    beams, fields = source.beams(FREQUENCY, LMAX), source.fields(FREQUENCY, grid)
    circular = product_modes(fields, LMAX, stokes="V", normalise=False)
    expected = {"I": beams.modes, "V": beam_scale(fields, beams) * np.asarray(circular)}
    for stokes, modes in expected.items():
        seen = source.response(FREQUENCY, directions, stokes).reshape(16, -1, grid.n_phi)
        found = grid.modes(seen, LMAX)
        np.testing.assert_allclose(found, modes, atol=1e-7 * np.abs(beams.modes).max())
        assert not source.response(FREQUENCY, directions * [1.0, 1.0, -1.0], stokes).any()


def test_a_file_has_no_other_frequencies(scalar, response):
    for source in (replace(scalar, moon_k=250.0), replace(response, moon_k=250.0)):
        for ask in (lambda f, s=source: s.beams(f, 2), source.background):
            refuse("50 MHz.* 51", ask, 51.0)
    refuse("50 MHz.* 51", scalar.impedance, 51.0)
    assert replace(scalar, impedance_ohm=None).impedance(51.0) is None
