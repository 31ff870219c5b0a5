"""Statements about maps, from exact draws, against the Gaussian posterior's closed forms."""

import healpy
import jax
import numpy as np
import pytest
from arviz_stats.base import array_stats
from assertions import refuse
from reference_linear import matrices, z_of
from reference_linear import posterior as naive_posterior
from scipy.stats import norm
from small_models import random_gaussian

from lusee_bayes.core.harmonics import modes_to_map, pixel_matrix
from lusee_bayes.sampling import mode
from lusee_bayes.sampling.mode import pixel_statistics, sky_quantities, summary

LMAX, NSIDE, N_MODES = 3, 4, 16
N_CHAINS, N_DRAWS = 4, 5000
N = N_CHAINS * N_DRAWS


@pytest.fixture(scope="module")
def gaussian():
    """(posterior of the package, textbook answer): sixteen modes, ten data."""
    model = random_gaussian([4.0, 2.0, 1.0, 0.5], 10, 3)
    _, data = model.sample(jax.random.key(0))
    return model.condition(data).posterior, naive_posterior(*matrices(model), data)


@pytest.fixture(scope="module")
def skies(gaussian):
    """Independent draws, as if of four chains."""
    return np.asarray(gaussian[0].sample(jax.random.key(1), N)).reshape(N_CHAINS, N_DRAWS, N_MODES)


def pixel_posterior(answer):
    """Mean, std and covariance of every pixel; healpy makes the maps of single modes."""
    y = np.stack([modes_to_map(mode, NSIDE) for mode in np.eye(N_MODES)], axis=1)
    covariance = y @ answer.covariance @ y.T
    return y @ answer.mean, np.sqrt(np.diag(covariance)), covariance


def test_mean_and_standard_deviation_of_pixels(gaussian, skies):
    posterior, answer = gaussian
    mean, std, _ = pixel_posterior(answer)
    n_pixels = healpy.nside2npix(NSIDE)
    # the mean of N draws scatters by std / sqrt(N), their standard deviation by std / sqrt(2 N)
    found = pixel_statistics(skies, NSIDE)
    assert np.abs((found["mean"] - mean) / (std / np.sqrt(N))).max() < z_of(n_pixels)
    for expected in (std, np.linalg.norm(pixel_matrix(NSIDE, LMAX) @ posterior.root(), axis=1)):
        assert np.abs(found["std"] / expected - 1).max() < z_of(n_pixels) / np.sqrt(2 * N)


def test_intervals_of_pixels_are_the_central_gaussian_ones(gaussian, skies):
    mean, std, _ = pixel_posterior(gaussian[1])
    tail = 0.05
    _, _, lower, upper = pixel_statistics(skies, NSIDE).values()
    # a quantile scatters by sqrt(p (1 - p) / N) / density; 1.1: tails are binomial, not normal
    error = std * np.sqrt(tail * (1 - tail) / N) / norm.pdf(norm.ppf(tail))
    limit = 1.1 * z_of(2 * len(mean))
    assert (np.abs(lower - (mean + std * norm.ppf(tail))) / error).max() < limit
    assert (np.abs(upper - (mean - std * norm.ppf(tail))) / error).max() < limit


def test_pixels_do_not_depend_on_how_many_are_held_at_once(skies, monkeypatch):
    whole = pixel_statistics(skies[:, :50], NSIDE)
    monkeypatch.setattr(mode, "CHUNK", 100)  # 192 pixels: 100 and 92
    for name, values in pixel_statistics(skies[:, :50], NSIDE).items():
        # sums of sixteen terms, perhaps in another order
        np.testing.assert_allclose(values, whole[name], rtol=1e-9, atol=1e-12)


def test_quantities_against_direct_computation(skies):
    few, places = skies[:, :5], {"somewhere": (33.0, -21.0), "pole": (0.0, 90.0)}
    found = sky_quantities(few, modes=[(0, 0), (2, -1), (3, 3)], ells=[0, 2, 3], pixels=places)
    assert list(found) == [
        "T(somewhere) [K]", "T(pole) [K]", "C_0 [K2]", "C_2 [K2]", "C_3 [K2]",
        "sky(0, 0) [K]", "sky(2, -1) [K]", "sky(3, 3) [K]",
    ]  # fmt: skip
    np.testing.assert_array_equal(found["sky(0, 0) [K]"], few[..., 0])
    np.testing.assert_array_equal(found["sky(2, -1) [K]"], few[..., 5])
    np.testing.assert_array_equal(found["sky(3, 3) [K]"], few[..., 15])
    for ell in (0, 2, 3):
        expected = (few[..., ell**2 : (ell + 1) ** 2] ** 2).sum(-1) / (2 * ell + 1)
        np.testing.assert_allclose(found[f"C_{ell} [K2]"], expected, rtol=1e-14)
    # NSIDE 64 puts a pixel's centre within half a degree of any place: the place that is asked for
    # is then the pixel's own
    pixel = healpy.ang2pix(64, 33.0, -21.0, lonlat=True)
    l_deg, b_deg = (float(x) for x in healpy.pix2ang(64, pixel, lonlat=True))
    there = sky_quantities(few, pixels={"there": (l_deg, b_deg)})["T(there) [K]"]
    for index in np.ndindex(4, 5):
        expected = modes_to_map(few[index], 64)[pixel]
        assert there[index] == pytest.approx(expected, rel=1e-9, abs=1e-11)
    # at the pole only m = 0 is left: sum of sqrt((2 l + 1) / 4 pi) a_l0
    ell = np.arange(LMAX + 1)
    expected = few[..., ell**2 + ell] @ np.sqrt((2 * ell + 1) / (4 * np.pi))
    np.testing.assert_allclose(found["T(pole) [K]"], expected, rtol=1e-12, atol=1e-13)


def test_modes_that_the_sky_does_not_have(skies):
    for ell in (4, -1):
        refuse(f"ell = {ell} is outside 0..lmax = 3", sky_quantities, skies, ells=[1, ell])
    for ell, m in ((4, 0), (1, 2), (1, -2), (-1, 0)):
        refuse(rf"\(ell, m\) = \({ell}, {m}\) is not", sky_quantities, skies, modes=[(ell, m)])


def test_what_has_no_pixels_is_refused():
    refuse("15 coefficients.*lmax", pixel_statistics, np.zeros((1, 2, 15)), NSIDE)


def test_the_summary_has_a_row_for_each_quantity_with_its_own_numbers(gaussian, skies):
    """Against numpy, the Gaussian, and ArviZ's own array functions."""
    answer = gaussian[1]
    quantities = sky_quantities(skies, modes=[(0, 0), (3, -2)], pixels={"centre": (0.0, 0.0)})
    table = summary(quantities)
    assert list(table.index) == list(quantities)
    for name, draws in quantities.items():
        row = table.loc[name]
        assert row["mean"] == pytest.approx(draws.mean(), rel=1e-10)
        assert row["sd"] == pytest.approx(draws.std(ddof=1), rel=1e-3)
        # 5 % in each tail: the columns' own interpolation of quantiles is of order 1 / N
        low, high = np.quantile(draws, [0.05, 0.95])
        found = row.filter(regex="90").sort_values()
        np.testing.assert_allclose(found, [low, high], atol=2e-3 * draws.std())
        for column, method in [("ess_bulk", "bulk"), ("ess_tail", "tail")]:
            tails = (0.05, 0.95) if method == "tail" else None
            ess = array_stats.ess(draws, chain_axis=0, draw_axis=1, method=method, prob=tails)
            # the tail's definition has moved between versions of ArviZ
            assert row[column] == pytest.approx(float(ess), rel=1e-6 if method == "bulk" else 0.3)
            assert row[column] == pytest.approx(N, rel=0.15)  # independent draws
        assert abs(row["r_hat"] - 1) < 0.002
        assert row["mcse_mean"] == pytest.approx(draws.std() / np.sqrt(N), rel=0.1)
    mode = table.loc["sky(3, -2) [K]"]
    assert mode["sd"] == pytest.approx(answer.std[10], rel=5 / np.sqrt(2 * N))


def test_the_summary_of_many_short_chains_warns_of_nothing():
    """More chains than draws is unusual, not wrong."""
    assert list(summary({"x": np.random.default_rng(0).normal(size=(8, 6))}).index) == ["x"]
