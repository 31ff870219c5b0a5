"""The beam of drawn maps: healpy's Gaussian, and no rings where there is an edge."""

from __future__ import annotations

import healpy
import numpy as np
import pytest

from lusee_bayes.core.harmonics import map_to_modes, modes_to_map
from lusee_bayes.report.figures.drawing import LEFT_AT_LMAX, shown, taper, taper_fwhm_deg


@pytest.mark.parametrize("lmax", [1, 8, 47])
def test_the_taper_is_healpys_gaussian_beam(lmax):
    beam = healpy.gauss_beam(np.radians(taper_fwhm_deg(lmax)), lmax)
    np.testing.assert_allclose(taper(lmax), beam, rtol=1e-12)
    assert taper(lmax)[-1] == pytest.approx(LEFT_AT_LMAX)


def test_a_sky_of_one_mode_is_shown():
    np.testing.assert_allclose(taper(0), [1.0])
    np.testing.assert_allclose(shown(np.array([2.0]), 4), 2.0 / np.sqrt(4.0 * np.pi))


@pytest.mark.parametrize("lmax", [12, 47])
def test_an_edge_has_no_rings(lmax):
    # A belt of 10 on a sky of 1, |b| < 5 degrees. Cut at lmax it swings to both sides; seen
    # through a positive beam it stays between 1 and 10. A tenth of the highest ell is left, so
    # that a tenth of the swing is allowed.
    pixels = np.ones(12 * 64**2)
    lat = healpy.pix2ang(64, np.arange(pixels.size), lonlat=True)[1]
    pixels[np.abs(lat) < 5.0] = 10.0
    modes = map_to_modes(pixels, lmax)
    swing = 1.0 - modes_to_map(modes, 64).min()
    assert swing > 0.5
    assert shown(modes, 64).min() > 1.0 - 0.1 * swing
    # the mean is kept
    assert shown(modes, 64).mean() == pytest.approx(pixels.mean(), rel=1e-3)
