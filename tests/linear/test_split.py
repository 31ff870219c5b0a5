"""chi^2 in two parts: matrices by hand, and simulated data with skies of any strength."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

import lusee_bayes as lb
from lusee_bayes.core.arrays import on_host
from lusee_bayes.linear.split import WIDER, Split, widened

N_MODES = 25
# the seed is fixed: what is right fails once in 10,000 seeds
RARE = 1e-4


def model_of(n_data=60, prior="harmonic", seed=1):
    """Data that know some directions to 1e-3 of the prior, and others hardly."""
    rng = np.random.default_rng(seed)
    left, _ = np.linalg.qr(rng.standard_normal((n_data, N_MODES if n_data > N_MODES else n_data)))
    right, _ = np.linalg.qr(rng.standard_normal((N_MODES, left.shape[1])))
    a = (left * np.geomspace(1e3, 1e-4, left.shape[1])) @ right.T
    spectrum = jnp.asarray([4.0, 2.0, 1.0, 0.5, 0.3])
    if prior == "harmonic":
        s = lb.HarmonicPrior(spectrum)
    else:
        root = np.tril(0.1 * rng.standard_normal((N_MODES, N_MODES)), -1) + np.eye(N_MODES)
        s = lb.DensePrior(jnp.asarray(root), mean=jnp.asarray(rng.standard_normal(N_MODES)))
    noise = rng.standard_normal((n_data, n_data))
    n = lb.DenseCovariance(jnp.asarray(noise @ noise.T / n_data + np.eye(n_data)))
    return lb.LinearGaussian(jnp.asarray(a), s, n, jnp.asarray(rng.standard_normal(n_data)))


def drawn(model, rng, strength=1.0):
    """Data of a sky whose deviations from the prior mean are so many times the prior's."""
    u = strength * rng.standard_normal(N_MODES)
    mean = model.prior.white_mean
    sky = model.prior.colour(jnp.asarray(u) if mean is None else u + mean)
    root = np.linalg.cholesky(np.asarray(model.noise.dense()))
    return model.predict(sky) + jnp.asarray(root @ rng.standard_normal(model.n_data))


def split_of(model, data, form="map"):
    posterior = model.condition(data, form=form)
    chi2 = float(model.chi2(posterior.mean, data) + posterior.prior_chi2())
    return Split.of(posterior, chi2, model.n_data), posterior, chi2


def with_prior(model, prior):
    return lb.LinearGaussian(model.coupling, prior, model.noise, model.offset)


@pytest.mark.parametrize("form", ["map", "root", "data"])
@pytest.mark.parametrize("prior", ["harmonic", "dense"])
def test_the_posterior_under_a_wider_prior(form, prior):
    """Against conditioning on the data again."""
    model = model_of(60 if form != "data" else 18, prior)
    data = drawn(model, np.random.default_rng(2))
    posterior = on_host(model.condition(data, form=form))
    wide, less = widened(posterior, 3.0)
    expected = with_prior(model, model.prior.widened(3.0)).condition(data, form=form)
    std = np.asarray(expected.std())
    assert np.abs((wide.mean - expected.mean) / std).max() < 1e-6
    np.testing.assert_allclose(wide.std(), std, rtol=1e-6)
    assert float(wide.log_evidence) == pytest.approx(float(expected.log_evidence), abs=1e-6)
    totals = [float(model.chi2(p.mean, data) + p.prior_chi2()) for p in (posterior, expected)]
    assert less == pytest.approx(totals[0] - totals[1], abs=1e-6 * totals[0])


@pytest.mark.parametrize("strength", [1.0, 30.0])
def test_the_two_parts_by_matrices(strength):
    model = model_of()
    data = drawn(model, np.random.default_rng(3), strength)
    found, posterior, chi2 = split_of(model, data)
    a, s, n = (
        np.asarray(x)
        for x in (model.coupling.dense(), model.prior.covariance(), model.noise.dense())
    )
    d = np.asarray(data - model.offset)
    k = a @ s @ a.T + n
    # how strong the sky is: |u|^2 over its mean, tr (1 - C S^-1), at least 1
    known = N_MODES - np.trace(np.asarray(posterior.covariance()) @ np.linalg.inv(s))
    power = max(1.0, float(posterior.prior_chi2()) / known)
    assert (power > 100.0) == (strength > 1.0)
    wide = WIDER**2 * power * (k - n) + n
    assert found.instrument.chi2 == pytest.approx(d @ np.linalg.solve(wide, d), rel=1e-6)
    expected = np.trace(np.linalg.solve(wide, n + power * (k - n)))
    assert found.instrument.degrees == pytest.approx(expected, rel=1e-6)
    assert found.instrument.chi2 + found.prior.chi2 == pytest.approx(chi2)
    assert found.instrument.degrees + found.prior.degrees == pytest.approx(model.n_data)


def p_values(model, strength, n=120, truth=None):
    rng = np.random.default_rng(5)
    parts = [split_of(model, drawn(truth or model, rng, strength))[0] for _ in range(n)]
    return np.array([[one.instrument.p, one.prior.p] for one in parts])


def test_no_sky_makes_the_instrument_look_wrong():
    """The instrument's p is uniform whatever the sky, 100 times the prior's too; the prior's is
    where it holds, but for the transition between known and unknown directions."""
    model = model_of()
    for strength in (0.0, 1.0, 100.0):
        instrument, prior = p_values(model, strength).T
        assert stats.kstest(instrument, "uniform").pvalue > RARE
        if strength == 1.0:
            for q in (0.02, 0.1, 0.3):
                assert np.mean(prior <= q) <= q + 4.0 * np.sqrt(q / len(prior))
        else:
            assert np.median(prior) < 1e-2


def test_noise_that_is_wrong_is_no_matter_of_the_prior():
    """Data with 1.5 times the noise variance."""
    model = model_of(n_data=200)
    noise = lb.DenseCovariance(1.5 * model.noise.dense())
    truth = lb.LinearGaussian(model.coupling, model.prior, noise, model.offset)
    instrument, _ = p_values(model, 1.0, n=20, truth=truth).T
    assert np.median(instrument) < 1e-3


def test_data_that_are_fewer_than_the_modes_leave_little():
    """Every sky explains them: what is left has few degrees of freedom, and no verdict."""
    model = lb.LinearGaussian(
        jnp.asarray(100.0 * np.random.default_rng(1).standard_normal((9, N_MODES))),
        lb.HarmonicPrior(jnp.ones(5)),
        lb.DiagonalCovariance(jnp.ones(9)),
    )
    found, _, _ = split_of(model, drawn(model, np.random.default_rng(2)), form="data")
    assert found.instrument.degrees == pytest.approx(0.01 * 9, rel=1e-3)
    assert 0.0 < found.instrument.p <= 1.0
