"""The embedded sky as a template."""

from __future__ import annotations

import healpy
import numpy as np

from lusee_bayes.core.harmonics import map_to_modes
from lusee_bayes.core.sphere_grid import SphereGrid
from lusee_bayes.sky.galaxy import galaxy_map
from lusee_bayes.sky.template import EmbeddedTemplate


def test_the_embedded_template_is_the_sky_without_its_random_part():
    template = EmbeddedTemplate(25.0)
    smooth = template.modes(8)
    # with it, synchrotron emission, most of the sky's, is multiplied by exp(g), of rms 5 %
    ratio = galaxy_map(25.0, 64, seed=3) / template.pixels(64)
    assert abs(ratio.mean() - 1.0) < 0.01
    assert 0.02 < np.log(ratio).std() < 0.05
    # its values in directions, and on pixels, are those of the same sky, whose edges are sharp
    grid = SphereGrid.of(8, 128)
    values = template.at(*grid.directions()).reshape(grid.shape)
    np.testing.assert_allclose(grid.analyse(values), smooth, atol=1e-3 * smooth[0])
    np.testing.assert_allclose(map_to_modes(template.pixels(64), 8), smooth, rtol=1e-9)
    at = template.at(*healpy.pix2ang(16, np.arange(healpy.nside2npix(16))))
    np.testing.assert_allclose(at, template.pixels(16), rtol=1e-9)
