"""models/instrument.py and models/gain_scales.py: their densities, made by hand with scipy."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest
from experiments import program_arguments, small_experiment
from numpyro.infer.util import log_density
from reference_linear import exact_posterior
from scipy.stats import lognorm, loguniform, norm, truncnorm, uniform

import lusee_bayes as lb
from lusee_bayes.experiment.model import radiometer
from lusee_bayes.experiment.terms import Around, gain_drifts
from lusee_bayes.instrument.products import all_products
from lusee_bayes.sampling.promotion import numpyro_promotion


def density(name: str, e: lb.Experiment, values: dict) -> tuple[float, dict]:
    """ln p of everything at these values, and the trace."""
    program = lb.load_program(name)
    arguments = program_arguments(program, e)
    sites = {name: jnp.asarray(value) for name, value in values.items()}
    with numpyro_promotion():
        got, trace = log_density(program.model, (), arguments, sites)
    return float(got), trace


@pytest.mark.long
@pytest.mark.essential
def test_the_instruments_program():
    """Beams of antennas built so, the evidence in decimal arithmetic, and the priors by scipy."""
    e = small_experiment(lmax=4)
    setup, data = e.setup, e.data
    values = {
        "surface_permittivity": 3.4,
        "deep_permittivity": 6.6,
        "loss_tangent": 0.02,
        "zenith_angle_deg": 76.5,
        "noise_level": 1.7,
    }
    antennas = lb.Monopoles(lb.Regolith(3.4, 6.6, 0.02), zenith_angle_deg=76.5)
    a = lb.CouplingMatrix.build(lb.monopole_beams(25.0, 4, antennas), setup.pointing).dense()
    noise = np.diag(1.7 * np.asarray(radiometer(setup).diagonal()))
    s = np.asarray(setup.prior.variance())
    expected = exact_posterior(np.asarray(a), s, noise, np.asarray(data.data)).log_prob
    expected += uniform.logpdf(3.4, 2.5, 2.5) + uniform.logpdf(6.6, 5.0, 3.0)
    expected += loguniform.logpdf(0.02, 1e-3, 1e-1) + lognorm.logpdf(1.7, 0.5)
    expected += norm.logpdf(76.5, 75.0, 2.0)
    got, trace = density("instrument", e, values)
    assert set(trace) == {*values, "data"}
    # chi^2 of 1e8, of which A by two routes leaves 1e-13 of 2e4 K against 0.2 K, twice
    assert abs(expected) > 1e4
    assert got == pytest.approx(expected, rel=1e-7)


@pytest.mark.long
@pytest.mark.essential
def test_the_program_of_gain_scales():
    """N with the drifts' covariance entry by entry, the mean of the autos, and the priors."""
    gain = "noise.gain={sigma: 0.01, correlation_h: 8, treatment: sampled}"
    e = small_experiment(gain, lmax=4)
    setup, data = e.setup, e.data
    sigma, octaves = 0.013, 0.4
    correlation_h = 8.0 * 2.0**octaves
    hours, products = np.asarray(data.observation.hours), all_products(4)
    around = np.asarray(gain_drifts(setup, Around(data)).visibilities)
    lag = hours[:, None] - hours[None]
    c = sigma**2 * np.exp(-(lag**2) / (2 * correlation_h**2))
    n_times = len(hours)
    noise = np.diag(np.asarray(radiometer(setup).diagonal()))
    for x, p in enumerate(products):
        for y, q in enumerate(products):
            shared = [(p.i == q.i) + (p.i == q.j) + (p.j == q.i) + (p.j == q.j)]
            both = (p.i == q.i) * (p.j == q.j) + (p.i == q.j) * (p.j == q.i)
            rows = slice(x * n_times, (x + 1) * n_times)
            columns = slice(y * n_times, (y + 1) * n_times)
            signal = around[x][:, None] * around[y][None]
            noise[rows, columns] += signal * c * (shared[0] + c * both)
    mean = np.repeat([1.0 + sigma**2 * (p.i == p.j) for p in products], n_times)
    a = mean[:, None] * np.asarray(setup.coupling.dense())
    s = np.asarray(setup.prior.variance())
    expected = exact_posterior(a, s, noise, np.asarray(data.data)).log_prob
    expected += lognorm.logpdf(sigma, 0.5, scale=0.01)
    expected += truncnorm.logpdf(octaves, -1 / 0.7, 1 / 0.7, 0.0, 0.7)
    values = {"gain_sigma": sigma, "gain_octaves": octaves}
    got, trace = density("gain_scales", e, values)
    assert set(trace) == {*values, "gain_correlation_h", "data"}
    assert float(trace["gain_correlation_h"]["value"]) == pytest.approx(correlation_h, rel=1e-14)
    # logarithms of 49 squeezed modes, each to 1e-6
    assert got == pytest.approx(expected, rel=1e-8, abs=1e-4)
