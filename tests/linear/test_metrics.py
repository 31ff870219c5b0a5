"""Fidelity numbers against plain loops and closed forms."""

import healpy
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lusee_bayes as lb
from lusee_bayes.core.harmonics import to_healpy
from lusee_bayes.linear.metrics import (
    correlation,
    effective_resolution_deg,
    ell_cross,
    expected_chi2,
    highest_altitude,
    prior_fraction_per_ell,
    signal_to_noise,
)

LMAX = 5


def test_rho_and_snr_against_complex_coefficients_and_loops():
    # the paper writes them with complex a_lm over m = -ell..ell; healpy keeps m >= 0
    rng = np.random.default_rng(1)
    mean, truth = rng.standard_normal((2, (LMAX + 1) ** 2))
    a, b = to_healpy(mean), to_healpy(truth)
    rho, snr = correlation(mean, truth), signal_to_noise(mean, truth)
    for ell in range(LMAX + 1):
        ab = aa = bb = dd = 0.0
        for m in range(ell + 1):
            index, weight = healpy.Alm.getidx(LMAX, ell, m), 1 if m == 0 else 2
            x, y = a[index], b[index]
            ab += weight * (x * np.conj(y)).real
            aa, bb = aa + weight * abs(x) ** 2, bb + weight * abs(y) ** 2
            dd += weight * abs(x - y) ** 2
        assert rho[ell] == pytest.approx(ab / np.sqrt(aa * bb), rel=1e-12)
        assert snr[ell] == pytest.approx(np.sqrt(aa / dd), rel=1e-12)


def test_a_perfect_map_and_an_empty_one():
    truth = np.random.default_rng(2).standard_normal(16)
    np.testing.assert_allclose(correlation(truth, truth), 1.0, rtol=1e-12)
    assert np.isnan(signal_to_noise(truth, truth)).all()  # no residual: undefined, not infinite
    assert np.isnan(correlation(np.zeros(16), truth)).all()


def test_ell_cross_counts_from_one():
    assert ell_cross(np.array([0.1, 3.0, 2.0, 0.9, 2.0])) == 3
    assert ell_cross(np.array([0.1, 3.0])) is None


def test_effective_resolution():
    assert effective_resolution_deg(np.array([1.0, 0.1, 0.4, 0.6, 0.2])) == 60.0
    assert effective_resolution_deg(np.array([0.0, 0.1])) is None


@pytest.fixture(scope="module")
def solved():
    rng = np.random.default_rng(5)
    n_data = 60
    coupling = jnp.asarray(rng.standard_normal((n_data, 16)))
    noise = lb.DiagonalCovariance(jnp.asarray(rng.uniform(0.5, 2.0, n_data)))
    prior = lb.HarmonicPrior(jnp.asarray([4.0, 2.0, 1.0, 0.5]))
    model = lb.LinearGaussian(coupling, prior, noise)
    return model, model.factorise()


def test_residuals_and_their_expected_chi2(solved):
    model, solver = solved
    data = np.asarray(model.sample(jax.random.key(0))[1])
    posterior = solver.condition(jnp.asarray(data))
    plain = (data - np.asarray(model.coupling.dense()) @ np.asarray(posterior.mean)) / np.sqrt(
        np.asarray(model.noise.variance)
    )
    got = float(model.chi2(posterior.mean, jnp.asarray(data)))
    assert got == pytest.approx(plain @ plain, rel=1e-10)
    # tr (1 + W W^T)^-1, the mean of |r|^2 over data from the model
    white = np.asarray(solver.whitened)
    trace = np.trace(np.linalg.inv(np.eye(60) + white @ white.T))
    assert expected_chi2(posterior, 60) == pytest.approx(trace, rel=1e-10)


def test_prior_fraction_per_ell(solved):
    model, solver = solved
    posterior = solver.condition(jnp.zeros(60))
    covariance = np.diag(np.asarray(posterior.covariance()))
    prior = np.asarray(model.prior.variance())
    expected = [np.mean((covariance / prior)[e**2 : (e + 1) ** 2]) for e in range(4)]
    np.testing.assert_allclose(prior_fraction_per_ell(posterior), expected, rtol=1e-10)


def test_the_sky_that_never_rises_is_a_cap_round_the_north_pole():
    # from latitude -23.8 the Moon's north pole stays 23.8 degrees below the horizon; the site sees
    # all but a cap of that radius about it in one cycle (paper: "within ~24 degrees of the NCP")
    observation = lb.Observation.from_runs([lb.Run()], step_s=3600.0)
    nside = 32
    highest = highest_altitude(observation, nside)
    hidden = highest < 0
    radius = np.radians(-observation.lat_deg)
    expected = (1 - np.cos(radius)) / 2
    # pixels on the rim: 2 pi sin(radius) / pixel size of them, half a pixel each at worst
    rim = 2 * np.pi * np.sin(radius) * healpy.nside2resol(nside) / (4 * np.pi) / 2
    assert abs(hidden.mean() - expected) < rim
    pole = observation.mcmf_from_galactic()[:, 2].mean(axis=0)
    distance = np.arccos(np.array(healpy.pix2vec(nside, np.flatnonzero(hidden))).T @ pole)
    assert distance.max() < radius + 0.002  # the axis wanders by 0.0008 rad
