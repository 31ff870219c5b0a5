"""A^T N^-1 A without A, against A and N as matrices."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from assertions import close, off, refuse

import lusee_bayes as lb
from lusee_bayes.core import arrays, harmonics
from lusee_bayes.instrument.averaging import windowed
from lusee_bayes.instrument.beams.fields import ProductBeams
from lusee_bayes.instrument.pointing import Pointing
from lusee_bayes.instrument.products import DataLayout
from lusee_bayes.linear import information, linear_gaussian
from lusee_bayes.linear.normal_matrix import CHUNK, normal_matrix, summed, time_sums
from lusee_bayes.linear.posterior import pixel_std
from lusee_bayes.noise import covariance as cov
from lusee_bayes.noise import time_blocks

LMAX, N_PRODUCTS = 5, 4
# the first and the last run see the sky through the same beams
RUNS = [lb.Run(0.5), lb.Run(0.3, 35.0), lb.Run(0.4)]


def setting(order=2, missing=True, step_s=40000.0):
    """A coupling matrix of random beams; some samples, and all of one time, are missing."""
    rng, o = np.random.default_rng(3), lb.Observation.from_runs(RUNS, step_s=step_s)
    flags = np.zeros((N_PRODUCTS, o.n_times), dtype=bool)
    if missing:
        flags[1, 4], flags[:, 9], flags[0, -1] = True, True, True
    layout = DataLayout.from_flags(flags)
    beams = ProductBeams(jnp.asarray(rng.standard_normal((N_PRODUCTS, (LMAX + 1) ** 2))), 25.0)
    # a pole that wanders a hundred times further than the Moon's: the tilt is not to be missed
    pointing = Pointing.of(o, LMAX, order)
    times, once = np.arange(o.n_times), np.ones(o.n_times)
    wandering = 0.05 * rng.standard_normal((o.n_times, 2))
    azimuth, *rest = windowed(times, once, np.asarray(pointing.azimuth), wandering, order, LMAX)
    functions, factors = map(jnp.asarray, rest)
    pointing = replace(pointing, azimuth=azimuth, functions=functions, factors=factors)
    return lb.CouplingMatrix.build(beams, pointing, layout)


def noise_of(kind, layout):
    rng = np.random.default_rng(5)
    if kind == "diagonal":
        return lb.DiagonalCovariance(jnp.asarray(rng.uniform(0.5, 2.0, layout.size)))
    roots = rng.standard_normal((layout.n_times, N_PRODUCTS, 2 * N_PRODUCTS))
    blocks = jnp.asarray(roots @ np.swapaxes(roots, 1, 2))
    if kind == "blocks":
        return time_blocks.TimeBlockCovariance(blocks, layout)
    if kind == "templates":
        root = jnp.asarray(rng.standard_normal((layout.size, 2)))
        return time_blocks.TimeBlockCovariance(blocks, layout) + cov.LowRankCovariance(root)
    # sums of what neighbouring times share: positive by construction
    shared = 0.3 * rng.standard_normal((layout.n_times + 2, N_PRODUCTS, N_PRODUCTS))
    band = np.zeros((layout.n_times, 3, N_PRODUCTS, N_PRODUCTS))
    for w in range(3):
        for t in range(w, layout.n_times):
            band[t, w] = sum(shared[t - w + k] @ shared[t - w + k].T for k in range(w, 3)) * 0.3
    band[:, 0] += np.asarray(blocks)
    return time_blocks.TimeBandedCovariance(jnp.asarray(band), layout)


KINDS = ["diagonal", "blocks", "templates", pytest.param("banded", marks=pytest.mark.long)]


@pytest.mark.parametrize("place", [arrays.on_host, arrays.on_device])
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("order", "missing"), [(0, True), (1, True), (2, True), (2, False)])
def test_equals_the_product_of_matrices(place, kind, order, missing):
    coupling = place(setting(order, missing))
    noise = place(noise_of(kind, coupling.layout))
    a, n = np.asarray(coupling.dense()), np.asarray(noise.dense())
    expected = a.T @ np.linalg.solve(n, a)
    got = np.asarray(normal_matrix(coupling, noise))
    np.testing.assert_array_equal(got, got.T)
    # sums of some 500 terms, in another order
    close(got, expected, 1e-12)
    if order:  # which does matter here
        lower = np.asarray(setting(order - 1, missing).dense())
        assert off(lower.T @ np.linalg.solve(n, lower), expected) > 1e-4


def test_more_times_than_a_chunk():
    rng, n = np.random.default_rng(0), CHUNK + 37
    weights, phi = rng.standard_normal((2, n)), rng.uniform(0, 9, n)
    factors = rng.standard_normal((3, n))
    got = time_sums(weights, phi, factors.T, 2)
    for q in range(-4, 5):
        expected = np.einsum("ct,at,bt,t->cab", weights, factors, factors, np.exp(1j * q * phi))
        np.testing.assert_allclose(got[..., q + 4], expected, rtol=0, atol=1e-11)


@pytest.mark.parametrize("blocks", [False, True])
def test_products_without_weight_take_no_part(blocks):
    coupling = arrays.on_host(setting(missing=False))
    rng, n_times = np.random.default_rng(5), coupling.layout.n_times
    weights = np.zeros((N_PRODUCTS, N_PRODUCTS, n_times))
    weights[1, 1], weights[3, 3] = rng.uniform(1.0, 2.0, (2, n_times))
    if blocks:
        weights[1, 3] = weights[3, 1] = rng.uniform(0.0, 0.5, n_times)
    a = np.asarray(coupling.dense()).reshape(N_PRODUCTS, n_times, -1)
    expected = np.einsum("ktm,kjt,jtn->mn", a, weights, a, optimize=True)
    close(summed(coupling, weights if blocks else np.einsum("kkt->kt", weights)), expected, 1e-12)


def test_nearly_singular_blocks_lose_no_digits():
    """Eigenvalues of 1 to 1e-9: with inverses, 1 + A^T N^-1 A would not be positive."""
    coupling = arrays.on_host(setting(missing=False))
    q = np.linalg.qr(np.random.default_rng(2).normal(size=(N_PRODUCTS, N_PRODUCTS)))[0]
    block = (q * np.logspace(0, -9, N_PRODUCTS)) @ q.T
    blocks = np.tile((block + block.T) / 2.0, (coupling.layout.n_times, 1, 1))
    noise = time_blocks.TimeBlockCovariance(blocks, coupling.layout)
    white = np.asarray(noise.factor().whiten(coupling.dense()))
    got = np.linalg.eigvalsh(normal_matrix(coupling, noise))
    np.testing.assert_allclose(got, np.linalg.svd(white)[1][::-1] ** 2, rtol=1e-6)


def test_without_structure():
    coupling = setting()
    diagonal = noise_of("diagonal", coupling.layout)
    dense = cov.DenseCovariance(diagonal.dense())
    more = dense + cov.LowRankCovariance(jnp.ones((dense.size, 1)))
    response = coupling.with_response(jnp.linspace(1.0, 2.0, dense.size))
    for made, noise in ((coupling, dense), (coupling, more), (response, diagonal)):
        a = np.asarray(made.dense())
        close(normal_matrix(made, noise), a.T @ np.linalg.solve(noise.dense(), a), 1e-12)
    refuse("N has shape", normal_matrix, coupling, lb.DiagonalCovariance(jnp.ones(7)))


def model(kind="diagonal"):
    coupling = setting()
    prior = lb.HarmonicPrior(jnp.asarray(10.0 / (1.0 + np.arange(LMAX + 1.0)) ** 2))
    noise = noise_of("diagonal", coupling.layout)
    if kind == "low rank":
        noise = noise + cov.LowRankCovariance(jnp.ones((coupling.layout.size, 1)))
    offset = jnp.asarray(np.linspace(0, 1, coupling.layout.size)) if kind == "offset" else None
    return lb.LinearGaussian(coupling, prior, noise, offset)


NOISES = ["diagonal", *(pytest.param(k, marks=pytest.mark.long) for k in ("offset", "low rank"))]


@pytest.mark.parametrize("kind", NOISES)
def test_information_gives_the_posterior_of_the_dense_form(kind):
    gaussian, rng = model(kind), np.random.default_rng(11)
    data = jnp.asarray(rng.standard_normal(gaussian.n_data))
    expected = gaussian.condition(data, form=linear_gaussian.InMap).posterior
    solution = gaussian.condition(data, linear_gaussian.FromInformation)
    found = solution.information
    for posterior in (solution.posterior, found.posterior(gaussian.prior)):
        np.testing.assert_allclose(posterior.mean, expected.mean, rtol=0, atol=1e-11)
        np.testing.assert_allclose(posterior.std(), expected.std(), rtol=1e-11)
        np.testing.assert_allclose(posterior.log_evidence, expected.log_evidence, rtol=1e-11)
    sky = jnp.asarray(rng.standard_normal(gaussian.prior.size))
    residual = np.asarray(data - gaussian.predict(sky))
    chi2 = residual @ np.linalg.solve(np.asarray(gaussian.noise.dense()), residual)
    np.testing.assert_allclose(found.chi2(sky), chi2, rtol=1e-10)


def test_inside_a_transformation_the_form_is_one_in_jax():
    gaussian = model()
    data = jnp.asarray(np.random.default_rng(3).standard_normal((2, gaussian.n_data)))
    got = jax.jit(jax.vmap(lambda d: gaussian.condition(d).posterior.mean))(data)
    for one, mean in zip(data, got, strict=True):
        np.testing.assert_allclose(mean, gaussian.condition(one).posterior.mean, rtol=0, atol=1e-11)


@pytest.mark.parametrize("kind", ["diagonal", "low rank"])
def test_the_matrix_is_not_formed_where_there_is_structure(kind, monkeypatch):
    gaussian = model(kind)
    data = jnp.asarray(np.random.default_rng(2).standard_normal(gaussian.n_data))
    expected = np.asarray(gaussian.condition(data, linear_gaussian.InMap).posterior.mean)
    monkeypatch.setattr(lb.CouplingMatrix, "dense", None)
    assert linear_gaussian.form_of(gaussian) is linear_gaussian.FromInformation
    got = gaussian.condition(data).posterior.mean
    np.testing.assert_allclose(got, expected, rtol=0, atol=1e-11)


def test_information_that_cannot_settle_says_so(monkeypatch):
    monkeypatch.setattr(information, "CONVERGENCE", 0.0)
    gaussian = model()
    refuse("not converge.*last step", gaussian.condition, jnp.ones(gaussian.n_data))


@pytest.mark.parametrize(("lmax", "nside"), [(0, 1), (3, 2), (7, 4)])
def test_pixel_variances_are_those_of_every_direction(lmax, nside):
    n = (lmax + 1) ** 2
    a = np.random.default_rng(lmax).standard_normal((n, n + 2))
    expected = np.sqrt(((harmonics.pixel_matrix(nside, lmax) @ a) ** 2).sum(1))
    np.testing.assert_allclose(pixel_std(jnp.asarray(a @ a.T), nside), expected, rtol=1e-12)
