"""Templates: the embedded sky, and skies of files."""

from __future__ import annotations

import healpy
import numpy as np
import pytest

from lusee_bayes.core.errors import InputError
from lusee_bayes.core.harmonics import map_to_modes, n_modes, to_healpy
from lusee_bayes.sky import write_alms
from lusee_bayes.sky.galaxy import galaxy_map
from lusee_bayes.sky.template import EmbeddedTemplate, HarmonicTemplate, Template, read_template

LMAX, OF_TEMPLATE = 4, 5
N = n_modes(LMAX)
TEMPLATE = HarmonicTemplate(np.random.default_rng(1).normal(5.0, size=n_modes(OF_TEMPLATE)))


def test_the_embedded_template_is_the_sky_without_its_random_part():
    template = EmbeddedTemplate(25.0)
    smooth = template.modes(8)
    # with it, synchrotron emission, most of the sky's, is multiplied by exp(g), of rms 5 %
    ratio = galaxy_map(25.0, 64, seed=3) / template.pixels(64)
    assert abs(ratio.mean() - 1.0) < 0.01
    assert 0.02 < np.log(ratio).std() < 0.05
    # its values in directions, and on pixels, are those of the same sky, whose edges are sharp
    np.testing.assert_allclose(Template.modes(template, 8), smooth, atol=1e-3 * smooth[0])
    np.testing.assert_allclose(map_to_modes(template.pixels(64), 8), smooth, rtol=1e-9)
    np.testing.assert_allclose(Template.pixels(template, 16), template.pixels(16), rtol=1e-9)


def test_a_harmonic_template_is_healpys_map():
    pixels = healpy.alm2map(to_healpy(TEMPLATE.coefficients), 32)
    np.testing.assert_allclose(TEMPLATE.pixels(32), pixels, rtol=1e-12)
    with pytest.raises(InputError, match="up to ell = 5, not up to 6"):
        TEMPLATE.modes(6)


def test_templates_of_files(tmp_path):
    pixels = HarmonicTemplate(TEMPLATE.coefficients[:N]).pixels(32)
    healpy.write_map(tmp_path / "map.fits", pixels, coord="G", column_units="K", dtype=np.float64)
    write_alms(tmp_path / "alm.fits", TEMPLATE.coefficients, {})
    expected = TEMPLATE.coefficients[:N]
    for name, tolerance in (("map.fits", 1e-8), ("alm.fits", 1e-14)):
        found = read_template(tmp_path / name, 20.0, LMAX)
        np.testing.assert_allclose(found.coefficients, expected, atol=tolerance)
    scaled = read_template(tmp_path / "alm.fits", 20.0, LMAX, file_frequency_mhz=10.0)
    np.testing.assert_allclose(scaled.coefficients, expected * 2.0**-2.5, rtol=1e-14)
    smooth = read_template(tmp_path / "alm.fits", 20.0, LMAX, smoothing_deg=20.0)
    alm = healpy.smoothalm(to_healpy(expected), fwhm=np.radians(20.0))
    np.testing.assert_allclose(to_healpy(smooth.coefficients), alm, atol=1e-12)


def test_the_mean_of_another_channel(small_map):
    path = small_map.folder / "posterior.nc"
    mean = small_map.result.channel.mean
    found = read_template(path, 12.5, LMAX)
    # its own frequency is 25 MHz
    np.testing.assert_allclose(found.coefficients, mean[:N] * 2.0**2.5, rtol=1e-12)
    with pytest.raises(InputError, match="is of 25 MHz, file_frequency_mhz says 20"):
        read_template(path, 12.5, LMAX, file_frequency_mhz=20.0)
    with pytest.raises(InputError, match="up to ell = 8, not up to 9"):
        read_template(path, 12.5, 9)
