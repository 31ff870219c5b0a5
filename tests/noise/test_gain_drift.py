"""Gain drifts: the paper's equation by loops, and 1e5 histories of gains that really drift."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from assertions import close, refuse
from reference_linear import assert_draws_follow, z_of

import lusee_bayes as lb
from lusee_bayes.instrument.products import DataLayout
from lusee_bayes.noise.instrument_errors import GainDrift, with_gains
from lusee_bayes.noise.time_blocks import TimeBandedCovariance

# a gap of 27 hours, and of 190, beyond which nothing is correlated
HOURS = np.array([0.0, 2.0, 4.5, 31.5, 33.5, 223.5])
N_TIMES = len(HOURS)


def pairs(n_antennas):
    """Antennas of 00R, 01R, 01I, 02R, ...: twice the same pair for a cross product."""
    every = range(n_antennas)
    return [(i, j) for i in every for j in every[i:] for _ in range(1 + (i != j))]


def visibilities(n_antennas, n_times=N_TIMES, seed=0):
    """No symmetry, both signs in the crosses, as a (products, times) array in K."""
    grid = np.random.default_rng(seed).normal(size=(n_antennas**2, n_times)) * 3e3
    autos = [i == j for i, j in pairs(n_antennas)]
    grid[autos] = 2e4 + abs(grid[autos])
    return grid


def c_g(hours, sigma, correlation):
    return sigma**2 * np.exp(-0.5 * ((hours[:, None] - hours) / correlation) ** 2)


def by_the_papers_equation(d, hours, sigma, correlation, flags):
    """Appendix A, Eq. for Cov(e_ij(t), e_kl(t')), one entry at a time."""
    names = pairs(round(np.sqrt(len(d))))
    entries = [(p, t) for p in range(len(d)) for t in range(len(hours)) if not flags[p, t]]
    kernel, cov = c_g(hours, sigma, correlation), np.zeros((len(entries),) * 2)
    for a, (p, t) in enumerate(entries):
        for b, (q, s) in enumerate(entries):
            (i, j), (k, m) = names[p], names[q]
            c, linear = kernel[t, s], (i == k) + (i == m) + (j == k) + (j == m)
            quadratic = (i == k) * (j == m) + (i == m) * (j == k)
            cov[a, b] = d[p, t] * d[q, s] * c * (linear + c * quadratic)
    return cov


def complete(n_antennas, n_times=N_TIMES):
    return np.zeros((n_antennas**2, n_times), dtype=bool)


def gappy(n_antennas):
    flags = complete(n_antennas)
    flags[:, 1] = flags[2, 3] = flags[0, 0] = True
    return flags


def term(drift, d, hours, flags, width=None) -> TimeBandedCovariance:
    return drift.covariance(jnp.asarray(d), hours, DataLayout.from_flags(flags), width)


CASES = [(2, 0.3, complete), (2, 1e-3, gappy), (4, 0.3, gappy)]


@pytest.mark.parametrize(("n_antennas", "sigma", "make_flags"), CASES)
def test_every_entry_is_the_papers(n_antennas, sigma, make_flags):
    flags, d = make_flags(n_antennas), visibilities(n_antennas)
    expected = by_the_papers_equation(d, HOURS, sigma, 10.0, flags)
    got = term(GainDrift(sigma, 10.0), d, HOURS, flags)
    # a few roundings; entries beyond the band are below eps of the largest by its definition
    close(got.dense(), expected, 1e-15 * 4)
    close(got.diagonal(), np.diag(expected), 1e-15 * 4)


def gain_histories(rng, n, n_antennas, sigma, correlation=10.0):
    """(n, antennas, times) draws of C_g, by its eigenvectors."""
    value, vector = np.linalg.eigh(c_g(HOURS, sigma, correlation))
    return rng.normal(size=(n, n_antennas, N_TIMES)) @ (vector * np.sqrt(np.maximum(value, 0.0))).T


def test_mean_and_covariance_of_simulated_histories():
    """Entry by entry, 1e5 histories in chunks.

    The sample mean of e scatters by its standard deviation over sqrt(n), the sample mean of the
    product e_a e_b by that of the product, sqrt(<e_a^2 e_b^2> - <e_a e_b>^2) / sqrt(n), here taken
    from the same draws: gains make e a second-order polynomial of normals, so Wick's theorem for
    Gaussian e would not do.
    """
    n_antennas, sigma, n, chunk = 3, 0.3, 100_000, 20_000
    rng, d = np.random.default_rng(20270115), visibilities(n_antennas)
    flags, drift = gappy(n_antennas), GainDrift(sigma, 10.0)
    response = np.array([1.0 + sigma**2 * (i == j) for i, j in pairs(n_antennas)])
    np.testing.assert_allclose(drift.mean_response(n_antennas**2), response, rtol=1e-15)
    keep = ~flags.ravel()
    mean, scale = (d * response[:, None]).ravel()[keep], np.abs(d).ravel()[keep] * sigma
    many = jax.jit(jax.vmap(with_gains, (None, 0)))
    first, second, fourth = 0.0, 0.0, 0.0
    for _ in range(n // chunk):
        gains = gain_histories(rng, chunk, n_antennas, sigma)
        data = np.asarray(many(jnp.asarray(d), jnp.asarray(gains))).reshape(chunk, -1)[:, keep]
        e = (data - mean) / scale
        first, second = first + e.sum(0) / n, second + e.T @ e / n
        fourth = fourth + (e**2).T @ e**2 / n
    expected = np.asarray(term(drift, d, HOURS, flags).dense()) / np.outer(scale, scale)
    off = np.abs(first) / np.sqrt(np.diag(second) / n)
    assert off.max() < z_of(off.size), f"mean off by {off.max():.2f} sigma"
    off = np.abs(second - expected) / np.sqrt((fourth - second**2) / n)
    assert off.max() < z_of(off.size), f"covariance off by {off.max():.2f} sigma"

    # what such a sample tells apart: the linear term alone, and the autos without their shift
    auto = np.array([i == j for i, j in [pairs(n_antennas)[k] for k in np.nonzero(~flags)[0]]])
    shift = (sigma**2 * np.abs(d).ravel()[keep] / scale)[auto]
    assert (shift / np.sqrt(np.diag(second)[auto] / n)).min() > 8
    quadratic = np.where(auto, 2.0, 1.0) * sigma**2
    scatter = np.sqrt((np.diag(fourth) - np.diag(second) ** 2) / n)
    assert (quadratic / scatter).max() > 1.5 * z_of(off.size)


def test_with_gains_is_the_product_of_both_antennas():
    d, gains = visibilities(3), np.random.default_rng(1).normal(size=(3, N_TIMES))
    both = zip(pairs(3), d, strict=True)
    expected = [(1.0 + gains[i]) * (1.0 + gains[j]) * seen for (i, j), seen in both]
    got = with_gains(jnp.asarray(d), jnp.asarray(gains))
    np.testing.assert_allclose(got, expected, rtol=1e-15 * 2)


# --- the sampler ------------------------------------------------------------------------------


@pytest.mark.parametrize("correlation", [0.7, 300.0])
def test_the_samplers_covariance_is_c_g_exactly(monkeypatch, correlation):
    """g is linear in the white noise: with unit vectors for it, the sampler shows its root."""
    monkeypatch.setattr(jax.random, "normal", lambda key, shape, dtype: jnp.eye(shape[1]))
    root = np.asarray(GainDrift(0.02, correlation).sample(jax.random.key(0), HOURS))
    # the sum over the grid is the integral to exp(-8 pi^2); left: rounding
    close(root.T @ root, c_g(HOURS, 0.02, correlation), 1e-14)


def test_draws_of_the_sampler():
    """The antennas are independent draws: 40000 of them, and two keys."""
    drift = GainDrift(0.02, 10.0)
    gains = drift.sample(jax.random.key(3), HOURS, 40_000)
    assert_draws_follow(gains, np.zeros(N_TIMES), c_g(HOURS, 0.02, 10.0))
    four = drift.sample(jax.random.key(3), HOURS)
    assert four.shape == (4, N_TIMES)
    assert (np.asarray(four) != np.asarray(drift.sample(jax.random.key(4), HOURS))).all()
    np.testing.assert_array_equal(four, drift.sample(jax.random.key(3), HOURS))


# --- truncation, scaling ----------------------------------------------------------------------


@pytest.mark.long
def test_what_the_band_leaves_out_changes_nothing():
    """50 samples over 16 h with a correlation of half an hour, against the kernel in full."""
    hours = np.cumsum(np.random.default_rng(2).uniform(0.05, 0.6, 50))
    drift, flags = GainDrift(0.1, 0.5), complete(2, 50)
    d = visibilities(2, 50)
    gain = term(drift, d, hours, flags)
    width = gain.band.shape[1] - 1
    assert 10 < width < 49
    # everything that is left out is below eps of the kernel's peak, and the band is no wider
    beyond = [hours[t] - hours[t - width - 1] for t in range(width + 1, 50)]
    assert np.exp(-(min(beyond) ** 2) / (2 * 0.5**2)) < np.finfo(float).eps
    variance = np.full(d.size, 1e-3 * 2e4**2)
    noise = lb.DiagonalCovariance(jnp.asarray(variance)) + gain
    full = by_the_papers_equation(d, hours, 0.1, 0.5, flags) + np.diag(variance)
    x = d.ravel()
    tolerance = 10 * np.finfo(float).eps * np.linalg.cond(full)  # of a backward stable solve
    assert tolerance < 1e-7
    factor = noise.factor()
    close(factor.solve(jnp.asarray(x)), np.linalg.solve(full, x), tolerance)
    assert float(factor.log_det()) == pytest.approx(np.linalg.slogdet(full)[1], abs=200 * tolerance)
    # a band that is cut at one correlation time is not the same
    cut = lb.DiagonalCovariance(jnp.asarray(variance)) + term(drift, d, hours, flags, 1)
    assert np.abs(np.asarray(cut.dense()) - full).max() > 0.01 * full.max()


def test_derivatives_of_the_log_determinant():
    d, layout = visibilities(2), DataLayout.from_flags(gappy(2))
    radiometer = lb.DiagonalCovariance(jnp.asarray(layout.gather(jnp.asarray(d**2)) * 1e-4))
    hours = HOURS / 3.0

    @jax.jit
    def value(parameters):
        drift = GainDrift(parameters[0], parameters[1])
        return (radiometer + drift.covariance(jnp.asarray(d), hours, layout, 5)).log_det()

    at = np.array([0.1, 10.0])  # sigma and correlation_h
    slopes = jax.jit(jax.grad(value))(jnp.asarray(at))
    for k in range(2):
        step = 1e-4 * at * (np.arange(2) == k)
        up, down = (float(value(jnp.asarray(at + s))) for s in (step, -step))
        # central differences: step^2 f''' / 6 relative to f', 1e-8, and rounding 1e-12 / 1e-4
        assert float(slopes[k]) == pytest.approx((up - down) / (2 * step[k]), rel=1e-6)


# --- refusals ---------------------------------------------------------------------------------


@pytest.mark.parametrize("bad", [0.0, -0.01, np.nan, np.inf])
def test_bad_parameters_are_refused(bad):
    refuse("gain drift's sigma.*positive", GainDrift, bad)
    refuse("gain drift's correlation time.*positive", GainDrift, 0.01, bad)


def test_bad_visibilities_are_refused():
    drift, layout = GainDrift(0.01), DataLayout(4, N_TIMES)
    d = jnp.asarray(visibilities(2))
    short, shapes = d[:, :5], r"the visibilities has shape \(4, 5\), expected \(4, 6\)"
    refuse(shapes, drift.covariance, short, HOURS[:5], layout)
    refuse(r"visibilities.*NaN.*\(2, 1\)", drift.covariance, d.at[2, 1].set(jnp.nan), HOURS, layout)


def test_the_term_alone_is_not_a_noise():
    """It is singular: the Re and Im of a product drift together."""
    gain = term(GainDrift(0.01), visibilities(2), HOURS, complete(2))
    refuse("gain-drift covariance.*not positive definite.*radiometer", gain.factor)


def test_about_found_drifts_it_is_linear_in_the_rest():
    """F C_g F^T with derivatives of the exact product; what the band leaves out is below eps."""
    d, flags, drift = visibilities(4), gappy(4), GainDrift(0.3, 10.0)
    found = gain_histories(np.random.default_rng(2), 1, 4, 0.3)[0]
    slopes = jax.jacfwd(lambda g: with_gains(jnp.asarray(d), g))(jnp.asarray(found))
    slopes = np.asarray(slopes)[~flags]  # (data, antennas, times)
    kernel, layout = c_g(HOURS, 0.3, 10.0), DataLayout.from_flags(flags)
    got = drift.covariance(jnp.asarray(d), HOURS, layout, gains=jnp.asarray(found))
    close(got.dense(), np.einsum("kat,ts,las->kl", slopes, kernel, slopes), 1e-15 * 8)
    x = np.random.default_rng(3).normal(size=(4, N_TIMES))
    close(drift.correlated(x, HOURS), x @ kernel, 1e-14)
