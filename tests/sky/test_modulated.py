"""A sky that departs from a template in proportion to it: S against sums over points; templates."""

from __future__ import annotations

from dataclasses import dataclass

import healpy
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lusee_bayes as lb
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.harmonics import (
    map_to_modes,
    n_modes,
    per_mode,
    pixel_matrix,
    synthesis_matrix,
    to_healpy,
)
from lusee_bayes.sky import BRIGHT_SOURCES, write_alms
from lusee_bayes.sky.galaxy import galaxy_map
from lusee_bayes.sky.modulated import Modulation, modulated_prior, relative_spectrum
from lusee_bayes.sky.template import EmbeddedTemplate, HarmonicTemplate, Template, read_template
from lusee_bayes.testing import check_prior

LMAX, HIGHEST, OF_TEMPLATE = 4, 6, 5
N = n_modes(LMAX)


PRIOR = "model: modulated, amplitude: 0.04"


def positive(lmax: int, seed: int) -> HarmonicTemplate:
    """A template with a mean of 10 and a scatter of about 1."""
    coefficients = np.random.default_rng(seed).normal(size=n_modes(lmax))
    coefficients[0] = 10.0 * np.sqrt(4.0 * np.pi)
    return HarmonicTemplate(coefficients)


TEMPLATE, SCALE = positive(OF_TEMPLATE, 1), positive(OF_TEMPLATE, 2)
SOURCES = np.random.default_rng(3).normal(size=(2, N))
SPECTRUM = relative_spectrum(HIGHEST, 0.5, -1.0)
OPTIONS = {"sources": SOURCES, "scale_std": 0.3, "monopole_std": 0.2}


def by_hand(scale: HarmonicTemplate) -> np.ndarray:
    """S from dense matrices over many points, whose sums are exact at these degrees."""
    x, weights = np.polynomial.legendre.leggauss(30)
    azimuth = 2.0 * np.pi * np.arange(61) / 61
    theta, phi = (a.ravel() for a in np.meshgrid(np.arccos(x), azimuth, indexing="ij"))
    area = np.repeat(weights, 61) * 2.0 * np.pi / 61
    d = synthesis_matrix(theta, phi, OF_TEMPLATE) @ scale.coefficients
    y = synthesis_matrix(theta, phi, HIGHEST)
    field = (d[:, None] * y) * per_mode(SPECTRUM) @ (d[:, None] * y).T
    projection = (y[:, :N] * area[:, None]).T
    t, monopole = TEMPLATE.coefficients[:N], np.zeros(N)
    monopole[0] = t[0]
    patterns = [0.3 * t, 0.2 * monopole, *SOURCES]
    return projection @ field @ projection.T + sum(np.outer(p, p) for p in patterns)


@pytest.mark.parametrize("scale", [None, SCALE], ids=["its own scale", "another scale"])
def test_s_is_that_of_dense_matrices(scale):
    found = modulated_prior(TEMPLATE, SPECTRUM, LMAX, scale=scale, **OPTIONS)
    expected = by_hand(TEMPLATE if scale is None else scale)
    # sums of 1830 points of numbers of order one to a hundred
    np.testing.assert_allclose(found.covariance(), expected, rtol=0, atol=1e-12 * expected.max())
    np.testing.assert_allclose(found.mean, TEMPLATE.coefficients[:N] + SOURCES.sum(0), rtol=1e-14)


def test_it_keeps_the_contract_of_priors():
    s = by_hand(TEMPLATE)
    prior = modulated_prior(TEMPLATE, SPECTRUM, LMAX, **OPTIONS)
    assert np.linalg.cond(s) < 1e4
    check_prior(prior, s, np.asarray(prior.mean))


def test_s_of_the_embedded_sky_is_that_of_pixels():
    """NSIDE 64: sums over its pixels are good to 5e-3, as the sky has sharp edges."""
    template, spectrum = EmbeddedTemplate(25.0), relative_spectrum(9, 0.04, -2.4)
    found = modulated_prior(template, spectrum, 6, scale_std=1e-6, monopole_std=1e-6)
    y = pixel_matrix(64, 9)
    area = 4.0 * np.pi / len(y)
    b = (y[:, : n_modes(6)] * (area * template.pixels(64))[:, None]).T @ y
    expected = b * per_mode(spectrum) @ b.T
    width = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(
        found.covariance() / width / width[:, None], expected / width / width[:, None], atol=8e-3
    )


def test_c_ell_is_changed_in_numpy_and_in_jax():
    modulation = Modulation.of(TEMPLATE, LMAX, lmax_deviations=HIGHEST, **OPTIONS)
    one = modulation.prior(SPECTRUM)
    patterns = modulation.patterns.T @ modulation.patterns
    twice = modulation.prior(2.0 * SPECTRUM).covariance()
    np.testing.assert_allclose(twice, 2.0 * one.covariance() - patterns, atol=1e-10)

    @jax.jit
    def log_det(amplitude):
        return modulation.prior(relative_spectrum(HIGHEST, amplitude, -1.0)).log_det()

    half = jnp.asarray(0.5)
    np.testing.assert_allclose(log_det(half), one.log_det(), rtol=1e-12)
    step = 1e-4
    slope = (log_det(half + step) - log_det(half - step)) / (2.0 * step)
    np.testing.assert_allclose(jax.jit(jax.grad(log_det))(half), slope, rtol=1e-6)


def test_what_is_left_out_of_the_deviations_is_little():
    """1.5 times the map's lmax against 3 times: variances, and the least of all directions."""
    template = EmbeddedTemplate(10.0)
    s, less = (
        np.asarray(modulated_prior(template, relative_spectrum(h, 0.04, -2.4), 15).covariance())
        for h in (45, round(1.5 * 15))
    )
    np.testing.assert_allclose(np.diag(less), np.diag(s), rtol=1e-2)
    half = np.linalg.inv(np.linalg.cholesky(s))
    eigenvalues = np.linalg.eigvalsh(half @ less @ half.T)
    assert 0.9 < eigenvalues[0] < 1.0
    assert eigenvalues[-1] < 1.0 + 1e-9


@dataclass(frozen=True)
class Constant(Template):
    value: float

    def at(self, theta, phi):
        return np.where(np.asarray(theta) < 1.0, self.value, max(self.value, 0.0))

    def modes(self, lmax):
        return np.zeros(n_modes(lmax))


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"scale": Constant(0.0)}, "the scale of the deviations is zero everywhere"),
        ({"scale": Constant(-1.0)}, "the scale of the deviations must be positive, fails at"),
        ({"lmax_deviations": 3}, "the deviations' lmax is 3, that of the map 4"),
    ],
)
def test_what_cannot_scale_deviations_is_refused(change, match):
    with pytest.raises(InputError, match=match):
        Modulation.of(TEMPLATE, LMAX, **change)


def test_templates_that_are_not_positive_are_refused():
    low = HarmonicTemplate(np.append(1.0, 9.0 * np.ones(n_modes(3) - 1)))
    with pytest.raises(InputError, match=r"the template must be positive, .*smooth it"):
        Modulation.of(low, 3)
    with pytest.raises(InputError, match="the template is zero everywhere"):
        Modulation.of(HarmonicTemplate(np.zeros(16)), 3)


def test_spectra_without_power_are_refused():
    modulation = Modulation.of(TEMPLATE, LMAX)
    bad = np.ones(7)
    bad[3] = 0.0
    for spectrum, match in (
        (bad, r"no power at ell = 3: C_ell = 0"),
        (-np.ones(7), r"no power at ell = 0: C_ell = -1"),
        (np.full(7, np.nan), "holds NaN"),
        (np.ones(6), r"has shape \(6,\), expected \(7,\)"),
    ):
        with pytest.raises(InputError, match=match):
            modulation.prior(spectrum)


# --- templates ------------------------------------------------------------------------------------


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


def test_the_prior_of_the_embedded_sky_holds_it():
    """A sky of the embedded model is likely, and a source's flux is its own unknown."""
    scenario = lb.load_scenario("fiducial", ["lmax=8", f"prior={{{PRIOR}}}"])
    sky = lb.galaxy_sky(25.0, 8)
    prior = scenario.prior.prior(sky)
    assert ((np.asarray(prior.whiten(sky.modes)) - prior.white_mean) ** 2).sum() < 81
    cyg = BRIGHT_SOURCES[1].modes(25.0, 8)
    without = lb.load_scenario(
        "fiducial", ["lmax=8", f"prior={{{PRIOR}, sources: false}}"]
    ).prior.prior(sky)
    difference = np.asarray(prior.covariance() - without.covariance())
    np.testing.assert_allclose(
        np.asarray(prior.mean - without.mean),
        sum(s.modes(25.0, 8) for s in BRIGHT_SOURCES),
        rtol=1e-9,
        atol=1e-6,
    )
    assert cyg @ difference @ cyg > (cyg @ cyg) ** 2
