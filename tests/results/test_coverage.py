"""Coverage by band of latitude: by counting, and against simulated skies."""

from __future__ import annotations

import healpy
import numpy as np
import pytest

from lusee_bayes.core.harmonics import pixel_matrix
from lusee_bayes.results.coverage import EXPECTED, coverage


def test_every_band_is_counted():
    """A truth that is off by 0.5, 1.5 and 2.5 standard deviations in the three bands."""
    nside = 16
    n = 12 * nside**2
    b = np.degrees(np.pi / 2 - healpy.pix2ang(nside, np.arange(n))[0])
    off = np.where(np.abs(b) < 10, 0.5, np.where(np.abs(b) < 30, 1.5, 2.5))
    std = np.random.default_rng(1).uniform(1.0, 5.0, n)
    bands = coverage(np.zeros(n), std, off * std, 8)
    assert [(band.within_1, band.within_2) for band in bands[:3]] == [(1, 1), (0, 1), (0, 0)]
    assert [band.rms for band in bands[:3]] == pytest.approx([0.5, 1.5, 2.5])
    # areas between circles of latitude, up to a ring of pixels
    areas = np.diff(np.sin(np.radians([0, 10, 30, 90])))
    assert [band.sky for band in bands[:3]] == pytest.approx(areas, abs=0.04)
    whole = bands[3]
    assert whole.sky == 1.0
    assert whole.within_1 == pytest.approx(sum(x.sky * x.within_1 for x in bands[:3]))


def test_the_error_is_that_of_simulated_skies():
    """White sky up to lmax: shares are as expected on average, and scatter as said up to a third
    (a leading term; the number of directions in a narrow band is a fraction of a circle's)."""
    lmax, nside, n = 12, 16, 400
    y = pixel_matrix(nside, lmax)
    rng = np.random.default_rng(2)
    maps = rng.standard_normal((n, y.shape[1])) @ y.T
    std = np.full(y.shape[0], np.sqrt((lmax + 1) ** 2 / (4 * np.pi)))
    found = [coverage(one, std, np.zeros_like(one), lmax) for one in maps]
    for k in range(4):
        for share, error, expected in (
            ("within_1", "error_1", EXPECTED[0]),
            ("within_2", "error_2", EXPECTED[1]),
        ):
            shares = np.array([getattr(bands[k], share) for bands in found])
            told = getattr(found[0][k], error)
            assert shares.mean() == pytest.approx(expected, abs=4 * told / np.sqrt(n))
            assert 0.67 < shares.std() / told < 1.33
