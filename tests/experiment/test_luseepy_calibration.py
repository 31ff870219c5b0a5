"""Posteriors of Gaussian skies whose visibilities are luseepy's: its fields, its rule, its horizon.

The visibilities are made without the package: fields out of the file by astropy, directions from
lunarsky's LunarTopo, a sum over the file's grid. That this is what luseepy does is checked on its
own waterfall first.
"""

import astropy.units as u
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from astropy.io import fits
from astropy.time import Time
from reference import galactic_directions, real_harmonics
from reference_linear import assert_draws_follow
from scipy.stats import chi2, kstest

import lusee_bayes as lb
from lusee_bayes.experiment.model import base_model, set_up
from lusee_bayes.instrument import products, waterfalls

pytestmark = pytest.mark.long
SITE = {"lon_deg": 182.258, "lat_deg": -23.814}
FREQUENCY, STEP_S, N_DRAWS = 10.0, 7200.0, 4000
PAIRS = [(i, j) for i in range(4) for j in range(i, 4)]


class Naive:
    """Products of luseepy's four arms times solid angle, (16, points), at the file's directions."""

    def __init__(self, path):
        with fits.open(path) as hdus:
            channel = list(hdus["freq"].data).index(FREQUENCY)
            gain = hdus["gain_conv"].data[channel]
            names = [f"{field}_{part}" for field in ("Etheta", "EPhi") for part in ("real", "imag")]
            parts = {name: hdus[name].data[channel].astype(float)[:, :-1] for name in names}
        theta = np.radians(np.arange(91.0))[:, None]
        phi = np.radians(2.0 * np.arange(180))[None]
        taper = 1.0 - (np.arctan((theta - np.pi / 2) / 0.03) / np.pi + 0.5) ** 2
        e_theta = taper * (parts["Etheta_real"] + 1j * parts["Etheta_imag"])
        e_phi = taper * (parts["EPhi_real"] + 1j * parts["EPhi_imag"])
        # a quarter of the azimuths from port to port
        arms = [[np.roll(e, 45 * port, axis=1) for e in (e_theta, e_phi)] for port in range(4)]
        solid_angle = np.sin(theta) * np.radians(1.0) * np.radians(2.0) * gain / (4 * np.pi)
        rows = []
        for i, j in PAIRS:
            product = sum(a * b.conj() for a, b in zip(arms[i], arms[j], strict=True)) * solid_angle
            rows += [product.real] if i == j else [product.real, product.imag]
        self.response = np.array([row.ravel() for row in rows])
        shape = np.broadcast_shapes(theta.shape, phi.shape)
        self.theta, self.phi = (np.broadcast_to(a, shape).ravel() for a in (theta, phi))

    def rows(self, time, lmax) -> np.ndarray:
        """(16, modes) of the coupling matrix at one time."""
        directions = galactic_directions(self.theta, self.phi, time, **SITE)
        return self.response @ real_harmonics(*directions, lmax)


@pytest.fixture(scope="module")
def naive(test_data):
    return Naive(test_data / "luseepy" / "synthetic_monopole_beam.fits")


def test_the_naive_sum_is_luseepys(naive, test_data):
    """All products in the middle, to the rounding of sums over 16380 directions."""
    folder = test_data / "luseepy"
    with fits.open(folder / "waterfall_exact_engine.fits") as hdus:
        data = hdus["data"].data[:, :, list(hdus["freq"].data).index(FREQUENCY)]
    modes = lb.sky_from_file(folder / "sky_alm.npz", FREQUENCY, 47).modes
    got = naive.rows(Time("2025-02-01 00:00:00", scale="utc") + 150 * STEP_S * u.s, 47) @ modes
    assert np.abs(got - data[150]).max() < 1e-12 * np.abs(data).max()


@pytest.mark.parametrize(("quadrature", "calibrated"), [("luseepy", True), ("exact", False)])
def test_posteriors_of_gaussian_skies(naive, test_data, quadrature, calibrated):
    """4000 skies, noise of a 1e4 times longer integration, so that what the rules differ by counts:
    chi^2 follows its distribution with luseepy's rule, and does not with the exact quadrature."""
    lmax, every = 6, 10
    beam = test_data / "luseepy" / "synthetic_monopole_beam.fits"
    waterfall = waterfalls.read_waterfall(test_data / "luseepy" / "waterfall_exact_engine.fits")
    observation = waterfall.observation.select(np.arange(328) % every == 0)
    overrides = [f"frequency_mhz={FREQUENCY}", f"lmax={lmax}", f"beam.file={beam}"]
    overrides += [f"beam.quadrature={quadrature}", "noise.radiometer.factor=1e-4"]
    scenario = lb.load_scenario("fiducial", overrides)
    matrix = np.concatenate([naive.rows(time, lmax)[None] for time in observation.times])
    matrix = np.moveaxis(matrix, 0, 1).reshape(16 * len(matrix), -1)
    layout = products.DataLayout(16, observation.n_times)
    given = lb.Visibilities(jnp.zeros(layout.size), layout, observation, FREQUENCY)
    model = base_model(set_up(scenario, given))

    rng = np.random.default_rng(20250201)
    prior_std = np.sqrt(np.asarray(model.prior.variance()))
    skies = prior_std * rng.standard_normal((N_DRAWS, len(prior_std)))
    noise = np.sqrt(np.asarray(model.noise.diagonal()))
    data = skies @ matrix.T + noise * rng.standard_normal((N_DRAWS, len(noise)))
    solver = model.factorise()
    means = jax.jit(jax.vmap(lambda d: solver.condition(d).posterior.mean))(jnp.asarray(data))
    posterior = solver.condition(jnp.asarray(data[0])).posterior
    scale = np.asarray(posterior.std())
    root = np.linalg.cholesky(np.asarray(posterior.covariance()) / np.outer(scale, scale))
    white = np.linalg.solve(root, ((skies - np.asarray(means)) / scale).T).T
    p = kstest((white**2).sum(1), chi2(white.shape[1]).cdf).pvalue
    if calibrated:
        assert p > 0.01
        assert_draws_follow(white, np.zeros(white.shape[1]), np.eye(white.shape[1]))
    else:
        assert p < 1e-6
