"""The prior on the sky: S = diag(C_ell) in coefficients, Y diag(C_ell) Y^T in pixels."""

from __future__ import annotations

import healpy as hp
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reference_linear import posterior, random_covariance
from scipy.special import eval_legendre

from lusee_bayes.core.errors import InputError
from lusee_bayes.linear.model import LinearGaussian
from lusee_bayes.noise.covariance import DiagonalCovariance
from lusee_bayes.sky.prior import DensePrior, HarmonicPrior, IndependentPrior, PixelPrior
from lusee_bayes.testing.checks import check_prior

SPECTRUM = np.array([4.0, 1.0, 0.0, 0.25])  # nothing at ell = 2
LMAX, NSIDE = 3, 2
PER_MODE = np.array([SPECTRUM[ell] for ell in range(LMAX + 1) for _ in range(2 * ell + 1)])


def pixel_covariance() -> np.ndarray:
    """S_pq = sum_l (2l+1)/(4 pi) C_l P_l(cos angle_pq): the addition theorem, no harmonics."""
    vectors = np.array(hp.pix2vec(NSIDE, np.arange(12 * NSIDE**2)))
    cosine = np.clip(vectors.T @ vectors, -1.0, 1.0)
    return sum(
        (2 * ell + 1) / (4 * np.pi) * c * eval_legendre(ell, cosine)
        for ell, c in enumerate(SPECTRUM)
    )


@pytest.fixture(scope="module")
def harmonic():
    return HarmonicPrior(jnp.asarray(SPECTRUM))


@pytest.fixture(scope="module")
def pixel():
    return PixelPrior(jnp.asarray(SPECTRUM), NSIDE)


def dense_covariance() -> np.ndarray:
    return random_covariance(np.random.default_rng(4), 16, scale=3.0)


ROOT, MEAN = np.linspace(0.5, 2.0, 6), np.linspace(-2.0, 5.0, 16)
HOLES = np.where(PER_MODE > 0, MEAN, 0.0)
KINDS = {
    "harmonic": lambda: (HarmonicPrior(jnp.asarray(SPECTRUM)), np.diag(PER_MODE)),
    "harmonic about a mean": lambda: (
        HarmonicPrior(jnp.asarray(SPECTRUM), mean=jnp.asarray(HOLES)),
        np.diag(PER_MODE),
        HOLES,
    ),
    "independent": lambda: (IndependentPrior(jnp.asarray(ROOT)), np.diag(ROOT**2)),
    "pixels": lambda: (PixelPrior(jnp.asarray(SPECTRUM), NSIDE), pixel_covariance()),
    "dense": lambda: (DensePrior.of_covariance(dense_covariance()), dense_covariance()),
    "dense about a mean": lambda: (
        DensePrior.of_covariance(jnp.asarray(dense_covariance()), jnp.asarray(MEAN)),
        dense_covariance(),
        MEAN,
    ),
}


@pytest.mark.parametrize("kind", KINDS)
def test_every_prior_keeps_the_contract(kind):
    check_prior(*KINDS[kind]())


def test_the_contract_notices_a_wrong_prior():
    class Transposed(DensePrior):
        def colour_columns(self, a):
            return a @ self.root.T

    class Uncentred(DensePrior):
        @property
        def white_mean(self):
            return None if self.mean is None else self.mean

    prior = DensePrior.of_covariance(dense_covariance(), MEAN)
    for wrong in (Transposed, Uncentred):
        with pytest.raises(AssertionError):
            check_prior(wrong(prior.root, mean=prior.mean), dense_covariance(), MEAN)
    with pytest.raises(AssertionError):
        check_prior(prior, 1.1 * dense_covariance(), MEAN)


def test_covariances_that_cannot_be_are_refused():
    covariance = dense_covariance()
    skewed, singular = covariance.copy(), covariance - 10.0 * np.eye(16)
    skewed[3, 1] += 1e-6
    with pytest.raises(InputError, match=r"not symmetric: S\[1, 3\] = .*S\[3, 1\]"):
        DensePrior.of_covariance(skewed)
    with pytest.raises(InputError, match="not positive definite: its lowest eigenvalue is -"):
        DensePrior.of_covariance(jnp.asarray(singular))
    with pytest.raises(InputError, match="lower triangular with a positive diagonal"):
        DensePrior(covariance)
    with pytest.raises(InputError, match="the prior mean has shape"):
        DensePrior.of_covariance(covariance, np.zeros(9))
    with pytest.raises(InputError, match="the prior covariance holds NaN"):
        DensePrior.of_covariance(np.full((4, 4), np.nan))


@pytest.mark.parametrize("build", [HarmonicPrior, lambda s: PixelPrior(s, NSIDE)])
def test_bad_spectra_are_refused(build):
    with pytest.raises(InputError, match=r"negative at ell = 2: C_ell = -0\.5"):
        build(jnp.array([1.0, 1.0, -0.5, -1.0]))
    with pytest.raises(InputError, match=r"prior spectrum holds NaN .*\(1,\)"):
        build(jnp.array([1.0, jnp.nan]))
    with pytest.raises(InputError, match=r"prior spectrum must be a float64 array.*float32"):
        build(jnp.ones(3, dtype=jnp.float32))


def test_too_few_pixels_are_refused():
    with pytest.raises(InputError, match="NSIDE 1 has 12 pixels, too few for the 16 modes of lmax"):
        PixelPrior(jnp.asarray(SPECTRUM), 1)


def test_pixel_coupling_sees_the_same_sky(pixel):
    rng = np.random.default_rng(2)
    a, sky = rng.normal(size=(9, 16)), rng.normal(size=16)
    on_pixels = pixel.coupling(jnp.asarray(a))
    assert on_pixels.shape == (9, 48)
    # healpy synthesises the map; A_pix on it must give A on the coefficients
    alm = np.zeros(hp.Alm.getsize(LMAX), dtype=complex)
    for ell in range(LMAX + 1):
        centre = ell * (ell + 1)
        alm[hp.Alm.getidx(LMAX, ell, 0)] = sky[centre]
        for m in range(1, ell + 1):
            value = (sky[centre + m] + 1j * sky[centre - m]) / np.sqrt(2)
            alm[hp.Alm.getidx(LMAX, ell, m)] = value
    pixels = hp.alm2map(alm, NSIDE, lmax=LMAX)
    # 48 terms of order one, and Y^+ is of condition number below 2
    np.testing.assert_allclose(np.asarray(on_pixels) @ pixels, a @ sky, atol=1e-12)


@pytest.mark.parametrize("n_data", [30, 9])
def test_posterior_in_pixels_is_the_synthesised_harmonic_one(pixel, harmonic, n_data):
    rng = np.random.default_rng(3)
    a, d = rng.normal(size=(n_data, 16)), jnp.asarray(rng.normal(size=n_data))
    variance = rng.uniform(0.5, 2.0, n_data)
    noise = DiagonalCovariance(jnp.asarray(variance))
    on_coefficients = LinearGaussian(jnp.asarray(a), harmonic, noise).condition(d)
    a_pixels = pixel.coupling(jnp.asarray(a))
    on_pixels = LinearGaussian(a_pixels, pixel, noise).condition(d)
    y = np.asarray(pixel.synthesis)
    # numbers of order one through Y and Y^+ and a posterior of condition number below 1e3
    np.testing.assert_allclose(on_pixels.mean, y @ np.asarray(on_coefficients.mean), atol=1e-12)
    expected = y @ np.asarray(on_coefficients.covariance()) @ y.T
    np.testing.assert_allclose(on_pixels.covariance(), expected, atol=1e-12)
    assert float(on_pixels.log_evidence) == pytest.approx(float(on_coefficients.log_evidence))
    naive = posterior(a_pixels, pixel_covariance(), np.diag(variance), d)
    np.testing.assert_allclose(on_pixels.mean, naive.mean, atol=1e-12)
    np.testing.assert_allclose(on_pixels.std(), naive.std, rtol=1e-11)
    np.testing.assert_allclose(on_coefficients.std_of(pixel.synthesis), naive.std, rtol=1e-11)


def test_a_prior_can_be_built_inside_jit_from_known_numbers():
    spectrum = jnp.asarray(SPECTRUM)
    got = jax.jit(lambda u: HarmonicPrior(spectrum).colour(u))(jnp.ones(16))
    np.testing.assert_allclose(got, np.sqrt(PER_MODE))


def test_an_ell_without_power_does_not_spoil_gradients():
    def total(amplitude):
        return HarmonicPrior(amplitude * jnp.asarray(SPECTRUM)).colour(jnp.ones(16)).sum()

    expected = np.sqrt(PER_MODE).sum() / 2.0  # d/da of sqrt(a) sum sqrt(C) at a = 1
    assert float(jax.jit(jax.grad(total))(jnp.asarray(1.0))) == pytest.approx(expected)
