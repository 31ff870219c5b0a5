"""How strong a sky is compared with its prior: by hand, and for skies of the prior."""

import numpy as np
import pytest

from lusee_bayes.core.harmonics import mode_numbers, pixel_matrix
from lusee_bayes.judge.measures import strengths, strengths_in_words

LMAX, NSIDE = 6, 8


def test_strengths_are_powers_of_all_but_the_monopole():
    rng = np.random.default_rng(1)
    ell, _ = mode_numbers(LMAX)
    variance = 1.0 / (1.0 + ell) ** 2
    y = pixel_matrix(NSIDE, LMAX)
    of_pixels = (y[:, 1:] ** 2) @ variance[1:]
    sky = np.sqrt(variance) * rng.standard_normal(len(ell))
    found = strengths(sky, variance, of_pixels)
    bands = ["|b| < 10 deg", "|b| 10 to 30 deg", "|b| > 30 deg"]
    assert list(found) == [*bands, "ell 1 to 4", "ell 5 to 6"]
    twice = strengths(2.0 * sky, variance, of_pixels)
    assert twice == pytest.approx({name: 4.0 * value for name, value in found.items()})
    # the monopole does not count
    sky[0] = 1e6
    assert strengths(sky, variance, of_pixels) == found


def test_parts_are_squares_over_what_is_expected():
    rng = np.random.default_rng(2)
    sky, of_modes = rng.standard_normal((LMAX + 1) ** 2), rng.uniform(0.5, 2.0, (LMAX + 1) ** 2)
    of_pixels = rng.uniform(0.5, 2.0, 12 * NSIDE**2)
    found = strengths(sky, of_modes, of_pixels)
    assert found["ell 5 to 6"] == pytest.approx((sky[25:] ** 2).sum() / of_modes[25:].sum())
    pixels = pixel_matrix(NSIDE, LMAX)[:, 1:] @ sky[1:]
    height = np.arange(12 * NSIDE**2)
    cap = height < 100  # |b| > 30 degrees holds the whole cap
    assert found["|b| > 30 deg"] > (pixels[cap] ** 2).sum() / of_pixels.sum()
    words = strengths_in_words(found)
    assert words.startswith("Power of the sky over what the prior expects: ")
    assert f"{found['ell 5 to 6']:.2g} at ell 5 to 6." in words
    # of what is not known nothing is said
    assert strengths(sky, 0.0 * of_modes, 0.0 * of_pixels) == {}
    assert strengths_in_words({}) == ""
