"""A made of many beams, antennas placed by name, and beam errors of unknown amplitude."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from closeness import close
from numpyro import handlers
from scipy.stats import norm, truncnorm

import lusee_bayes as lb
from lusee_bayes.instrument.beam_operator import BeamOperator
from lusee_bayes.instrument.layout import DataLayout
from lusee_bayes.systematics import BeamError, InstrumentParameters

LMAX, FREQUENCY = 8, 25.0
STDS = {"surface_permittivity": 0.3, "zenith_angle_deg": 2.0, "turntable_offset_deg": 1.0}


@pytest.fixture(scope="module")
def pointing():
    """Two runs at two turntable angles: 18 samples."""
    observation = lb.Observation.from_runs([lb.Run(0.3, 0.0), lb.Run(0.4, 40.0)], step_s=86400.0)
    return lb.Pointing.of(observation, LMAX)


@pytest.fixture(scope="module")
def layout(pointing):
    flags = np.zeros((16, pointing.n_times), bool)
    flags[3, 2:5] = flags[:, 7] = True
    return DataLayout.from_flags(flags)


@pytest.fixture(scope="module")
def instrument(pointing, layout):
    return lb.Instrument(lb.Monopoles(), pointing, layout, FREQUENCY, LMAX).prepared()


def test_turned_blocks_are_the_coupling_matrix(pointing, layout):
    """For beams of every order, with flags and two runs; sums of 17 numbers in another order."""
    beams = lb.ProductBeams(jax.random.normal(jax.random.key(0), (16, 81)), FREQUENCY)
    expected = np.asarray(lb.CouplingMatrix.build(beams, pointing, layout).dense())
    got = BeamOperator.of(pointing, layout).coupling(beams)
    assert got.shape == (layout.size, 81)
    close(got, expected, 1e-13)


def test_a_of_placed_antennas_is_that_of_antennas_built_so(instrument, pointing, layout):
    values = {
        "length_m": 3.1,
        "height_m": 1.7,
        "zenith_angle_deg": 73.0,
        "turntable_offset_deg": 5.0,
        "surface_permittivity": 3.5,
        "deep_permittivity": 6.5,
        "loss_tangent": 0.02,
    }
    antennas = lb.Monopoles(
        lb.Regolith(3.5, 6.5, 0.02),
        length_m=3.1,
        height_m=1.7,
        zenith_angle_deg=73.0,
        azimuths_deg=np.array([90.0, 0.0, -90.0, 180.0]) + 5.0,
    )
    beams = lb.monopole_beams(FREQUENCY, LMAX, antennas)
    expected = np.asarray(lb.CouplingMatrix.build(beams, pointing, layout).dense())
    placed = {name: jnp.asarray(value) for name, value in values.items()}
    for got in (instrument.dense(placed), instrument.coupling(placed).dense()):
        close(got, expected, 1e-13)
    # and every one of them matters
    for name, value in values.items():
        others = placed | {name: instrument.value(name)}
        away = np.abs(np.asarray(instrument.dense(others)) - expected).max()
        assert away > 1e-4 * np.abs(expected).max(), (name, value)


def test_a_that_was_not_prepared(instrument):
    with pytest.raises(lb.InputError, match="prepare the instrument first"):
        replace(instrument, operator=None).dense({})


@pytest.fixture(scope="module")
def base(instrument):
    coupling = instrument.coupling()
    prior = lb.HarmonicPrior(1e6 / (1.0 + jnp.arange(LMAX + 1.0)) ** 2)
    noise = lb.DiagonalCovariance(jnp.full(coupling.shape[0], 4.0))
    return lb.LinearGaussian(coupling, prior, noise)


def test_sites_of_the_antennas_parameters(instrument, base):
    """Priors cut off at the ends of the domain; A is that of the values."""
    systematic = InstrumentParameters.centred(instrument, STDS)
    values = {"surface_permittivity": 3.2, "zenith_angle_deg": 76.0, "turntable_offset_deg": -0.4}
    arrays = {name: jnp.asarray(value) for name, value in values.items()}
    with (
        jax.numpy_dtype_promotion("standard"),
        handlers.trace() as trace,
        handlers.seed(rng_seed=0),
        handlers.substitute(data=arrays),
    ):
        model = systematic.sampled(base)
        got = {name: float(site["fn"].log_prob(site["value"])) for name, site in trace.items()}
    np.testing.assert_array_equal(model.coupling.dense(), instrument.dense(arrays))
    expected = {
        "surface_permittivity": truncnorm.logpdf(3.2, (1 - 3.7) / 0.3, np.inf, 3.7, 0.3),
        "zenith_angle_deg": truncnorm.logpdf(76.0, -75 / 2, 105 / 2, 75.0, 2.0),
        "turntable_offset_deg": norm.logpdf(-0.4, 0.0, 1.0),
    }
    assert got == pytest.approx(expected, rel=1e-10)


@pytest.mark.long
def test_marginalised_parameters_are_derivatives_of_a(instrument, base):
    """Central differences: h^2 f''' = 1e-8 of the slope, and rounding / h = 1e-11."""
    got = InstrumentParameters.centred(instrument, STDS).marginalised(base)
    expected = np.asarray(base.noise.dense())
    for name, std in STDS.items():
        at = instrument.value(name)
        up, down = (
            np.asarray(instrument.dense({name: jnp.asarray(at + h)})) for h in (1e-4, -1e-4)
        )
        direction = std * (up - down) / 2e-4
        expected = expected + (direction * np.asarray(base.prior.variance())) @ direction.T
    np.testing.assert_allclose(got.noise.dense(), expected, rtol=0, atol=1e-6 * expected.max())


def test_the_amplitude_of_a_beam_error(instrument, base):
    other = lb.monopole_beams(29.0, LMAX)
    own = instrument.beams()
    direction = lb.ProductBeams(other.modes - own.modes, FREQUENCY)
    error = BeamError(instrument.coupling_of(direction))
    sky = base.prior.sample(jax.random.key(3))
    for amplitude in (0.0, 0.7, 1.0):
        value = {"beam_amplitude": jnp.asarray(amplitude)}
        with handlers.trace() as trace, handlers.seed(rng_seed=0), handlers.substitute(data=value):
            model = error.sampled(base)
        mixed = lb.ProductBeams((1 - amplitude) * own.modes + amplitude * other.modes, FREQUENCY)
        expected = instrument.coupling_of(mixed)
        # linear in the beams, as a product and as a matrix
        scale = np.abs(np.asarray(expected @ sky)).max()
        np.testing.assert_allclose(model.coupling @ sky, expected @ sky, rtol=0, atol=1e-12 * scale)
        dense = np.asarray(expected.dense())
        close(model.coupling.dense(), dense, 1e-13)
        fn = trace["beam_amplitude"]["fn"]
        assert float(fn.log_prob(amplitude)) == pytest.approx(norm.logpdf(amplitude))
    term = np.asarray(error.marginalised(base).noise.dense() - base.noise.dense())
    root = np.asarray(instrument.coupling_of(direction).dense()) * np.sqrt(
        np.asarray(base.prior.variance())
    )
    np.testing.assert_allclose(term, root @ root.T, rtol=0, atol=1e-12 * np.abs(term).max())


def test_a_direction_has_no_gains_and_the_same_samples(instrument, base, pointing):
    error = instrument.coupling_of(instrument.beams())
    with pytest.raises(lb.InputError, match="no response of its own"):
        base.coupling.plus(jnp.ones(()), error.with_response(jnp.ones(error.shape[0])))
    complete = lb.CouplingMatrix.build(instrument.beams(), pointing)
    with pytest.raises(lb.InputError, match="hold different samples"):
        base.coupling.plus(jnp.ones(()), complete)


def test_a_response_multiplies_the_rows(base):
    factors = 1.0 + 0.1 * jax.random.normal(jax.random.key(1), (base.n_data,))
    twice = base.coupling.with_response(factors).with_response(2.0 * jnp.ones(base.n_data))
    sky = base.prior.sample(jax.random.key(2))
    expected = 2.0 * np.asarray(factors) * np.asarray(base.coupling @ sky)
    np.testing.assert_allclose(twice @ sky, expected, rtol=1e-13)
    rows = 2.0 * np.asarray(factors)[:, None] * np.asarray(base.coupling.dense())
    # an entry is a sum of terms of the size of the largest
    np.testing.assert_allclose(twice.dense(), rows, rtol=1e-13, atol=1e-15 * np.abs(rows).max())
    np.testing.assert_allclose(
        twice.transpose_mv(jnp.asarray(expected)), rows.T @ expected, rtol=1e-9
    )
