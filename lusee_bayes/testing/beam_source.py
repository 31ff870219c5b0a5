"""The contract of beam sources."""

from __future__ import annotations

import numpy as np

from lusee_bayes.core.errors import InputError
from lusee_bayes.core.harmonics import turn_about_z
from lusee_bayes.instrument.beams import BeamSource, HemisphereGrid, Monopoles, stokes_beam
from lusee_bayes.instrument.products import auto_indices, labels, to_matrix, to_real
from lusee_bayes.testing.refusals import ROUNDING


def check_beam_source(
    source: BeamSource,
    turned: BeamSource,
    *,
    turned_deg: float,
    frequency_mhz: float = 20.0,
    lmax: int = 6,
    quadrature: float = 1e-9,
) -> None:
    """Check the laws that the beams of every source obey.

    Parameters
    ----------
    source : BeamSource
    turned : BeamSource
        The same antennas, turned by ``turned_deg`` from East towards North.
    turned_deg : float
    frequency_mhz : float
        One that the source knows.
    lmax : int
    quadrature : float
        Error of the source's own quadrature, relative to the largest coefficient.

    Raises
    ------
    AssertionError
        If a law is broken.
    """
    n, beams = source.n_ports, source.beams(frequency_mhz, lmax)
    modes = np.asarray(beams.modes)
    largest = np.abs(modes).max()
    rounding = {"rtol": 0.0, "atol": ROUNDING * largest}
    assert modes.shape == (n**2, (lmax + 1) ** 2)
    assert np.isfinite(modes).all()
    assert beams.labels == labels(n)
    assert beams.frequency_mhz == frequency_mhz

    # the coefficients are those of the patterns, in the beams' own unit, and these are the fields';
    # a smaller lmax is a slice
    grid = HemisphereGrid.for_lmax(lmax)
    patterns = np.asarray(source.patterns(frequency_mhz, grid))
    assert patterns.shape == (n, n, len(grid.theta), grid.n_phi)
    expected = np.asarray(grid.modes(to_real(patterns), lmax))
    try:
        fields = source.fields(frequency_mhz, grid)
    except InputError as error:
        assert "beams of products, not the E fields" in str(error)
    else:
        assert fields.grid is grid
        assert fields.n_antennas == n
        own = np.asarray(stokes_beam(fields))
        np.testing.assert_allclose(patterns, own, rtol=0, atol=ROUNDING * np.abs(own).max())
    unit = (modes * expected).sum() / (expected**2).sum()
    assert unit > 0
    np.testing.assert_allclose(modes, unit * expected, rtol=0, atol=quadrature * largest)
    fewer = np.asarray(source.beams(frequency_mhz, lmax - 1).modes)
    np.testing.assert_allclose(fewer, modes[:, : lmax**2], **rounding)

    # the voltages that a uniform sky makes have a covariance
    covariance = np.asarray(to_matrix(beams.modes))[..., 0]
    assert np.linalg.eigvalsh(covariance).min() > -ROUNDING * np.abs(covariance).max()

    # antennas that are turned see a sky that is turned the other way, and the same ground
    assert turned.n_ports == n
    rotated = turn_about_z(beams.modes, np.radians(turned_deg))
    np.testing.assert_allclose(turned.beams(frequency_mhz, lmax).modes, rotated, **rounding)

    background = np.asarray(source.background(frequency_mhz))
    assert background.shape == (n**2,)
    assert np.isfinite(background).all()
    assert background.any() == source.emits
    assert (background[auto_indices(n)] >= 0.0).all()
    atol = ROUNDING * np.abs(background).max()
    np.testing.assert_allclose(turned.background(frequency_mhz), background, rtol=0, atol=atol)

    impedance = source.impedance(frequency_mhz)
    assert impedance is None or np.isfinite(impedance)
    assert source.interpolated(frequency_mhz) in (None, "linear", "spline")
    circuit = source.circuit(frequency_mhz)
    if circuit is not None:  # a covariance of voltages, which may be singular
        per_kelvin = np.linalg.eigvalsh(circuit.per_kelvin)
        assert per_kelvin.min() > -ROUNDING * per_kelvin.max() and per_kelvin.max() > 0.0

    try:
        antennas = source.monopoles
    except InputError as error:
        assert "which beam.file replaces" in str(error)
    else:
        assert isinstance(antennas, Monopoles)
        own = antennas.fields(frequency_mhz, grid)
        np.testing.assert_array_equal(own.e_theta, fields.e_theta)
        np.testing.assert_array_equal(own.e_phi, fields.e_phi)
