"""Coordinates for sky and gains together: one to one, and straight where the data say nothing."""

from __future__ import annotations

from functools import lru_cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from experiments import small_experiment
from jax.flatten_util import ravel_pytree

import lusee_bayes as lb
from lusee_bayes.experiment.pieces import program_pieces

SCALES = {"log_sigma_std": 0.5, "log_correlation_std": 0.2}


@lru_cache
def pieces(*scales: str):
    """(gaussian, drifts, chart) with these scales as sites."""
    stds = "".join(f", {name}: {SCALES[name]}" for name in scales)
    gain = f"noise.gain={{sigma: 0.03, correlation_h: 10, treatment: sampled{stds}}}"
    parts = program_pieces(small_experiment(gain, lmax=2))
    gaussian, drifts = parts["gaussian"](), parts["gain_drifts"]()
    return gaussian, drifts, drifts.chart(gaussian)


def values_of(chart, seed=0) -> dict:
    """Unconstrained values of the chart's sites, and of one that it does not know."""
    rng = np.random.default_rng(seed)
    values = {
        "sky": jnp.asarray(1e4 * rng.normal(size=9)),
        "gain_noise": jnp.asarray(rng.normal(size=(4, chart.grid.shape[0]))),
        "other": jnp.asarray(rng.normal(size=3)),
    }
    if chart.sigma_is_site:
        values["gain_sigma"] = jnp.log(0.03) + jnp.asarray(0.4 * rng.normal())
    if chart.log_correlation_reach is not None:
        values["gain_log_correlation"] = jnp.asarray(rng.normal())
    return values


def gains_of(drifts, values):
    """Gains at the samples, from the sites, by hand."""
    sigma, correlation_h = 0.03, 10.0
    if "gain_sigma" in values:
        sigma = jnp.exp(values["gain_sigma"])
    if "gain_log_correlation" in values:
        reach = 3.0 * SCALES["log_correlation_std"]
        u = 1.0 / (1.0 + jnp.exp(-values["gain_log_correlation"]))
        correlation_h = 10.0 * jnp.exp(-reach + 2.0 * reach * u)
    drift = lb.GainDrift(sigma, correlation_h)
    return drift.history(values["gain_noise"], np.asarray(drifts.hours), drifts.grid)


CASES = [(), ("log_sigma_std",), ("log_correlation_std",), tuple(SCALES)]


@pytest.mark.long
@pytest.mark.essential
@pytest.mark.parametrize("scales", CASES)
def test_there_and_back_with_the_determinant_of_the_derivative(scales):
    """Rounding of the solves: the smallest covariance is the floor, 3e-10 over 4e-3 of the drifts'.

    So the way back is good to 1e-16 * 1e7, and the determinant likewise.
    """
    _, _, chart = pieces(*scales)
    values = values_of(chart)
    x = chart.from_values(values)
    back, log_det = chart.to_values(x)
    assert set(back) == set(values)
    for name in values:
        size = np.abs(np.asarray(values[name])).max()
        np.testing.assert_allclose(back[name], values[name], rtol=0, atol=1e-9 * size)
    assert (np.asarray(x["other"]) == np.asarray(values["other"])).all()
    flat, split = ravel_pytree(x)
    jacobian = jax.jit(jax.jacfwd(lambda f: ravel_pytree(chart.to_values(split(f))[0])[0]))(flat)
    expected = np.linalg.slogdet(np.asarray(jacobian))[1]
    assert float(log_det) == pytest.approx(expected, abs=1e-6)
    assert abs(expected) > 1e-2


@pytest.mark.long
@pytest.mark.essential
@pytest.mark.parametrize("scales", CASES)
def test_the_data_do_not_change_along_the_shared_scale(scales):
    """Nor with strength and correlation time, by more than the noise."""
    gaussian, drifts, chart = pieces(*scales)

    def seen(x):
        values, _ = chart.to_values(x)
        gains = gains_of(drifts, values)
        return np.asarray(drifts.response(gains) * gaussian.predict(values["sky"])), gains

    x = chart.from_values(values_of(chart))
    before, gains = seen(x)
    scale, constant = chart._shared()
    assert float((scale * jnp.ones((4, 1)) * constant).sum()) == pytest.approx(1.0, rel=1e-14)
    moved, other = seen(x | {"gain_noise": x["gain_noise"] + 0.1 * constant})
    noise = np.sqrt(np.asarray(chart.floor) * before.size)
    # the gains of constant noise are constant to what lies outside the grid, exp(-36); with other
    # scales to a fraction of the noise
    exact = 1e-12 if not scales else noise
    assert np.linalg.norm(moved - before) < exact * np.abs(before).max()
    assert np.linalg.norm(np.asarray(1 + other - np.exp(0.1) * (1 + gains))) < exact
    for name, step in [("gain_sigma", 0.2), ("gain_log_correlation", 0.5)]:
        if name not in x:
            continue
        turned, other = seen(x | {name: x[name] + step})
        # each of the gains' modes to floor / (floor + variance) of itself: half the noise at most
        assert np.linalg.norm(np.asarray(other - gains)) < noise
        assert np.linalg.norm(turned - before) < 2 * noise * np.abs(before).max()
        # while the same change of the site alone changes them altogether
        values, _ = chart.to_values(x)
        plain = gains_of(drifts, values | {name: values[name] + step})
        assert np.linalg.norm(np.asarray(plain - gains)) > 10 * noise


def test_drifts_too_strong_for_the_coordinates_have_none():
    """Where the mean gain may be -1 the scale has no logarithm: 0.1 exp(3 x 0.5) > 0.2."""
    gaussian, drifts, chart = pieces("log_sigma_std")
    assert chart is not None
    strong = lb.GainDrift(0.1, 10.0)
    kinder = lb.systematics.GainDrifts(**{**vars(drifts), "drift": strong})
    assert kinder.chart(gaussian) is None
