"""Levels and spectra that are not known, noise of one's own kind, and the general program.

Small dense models against scipy; a scenario's own, of condition 1e12, against decimal arithmetic.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from assertions import within
from experiments import density, program_arguments, small_experiment
from numpyro import handlers
from reference_linear import random_covariance
from scipy.stats import lognorm, multivariate_normal, norm

import lusee_bayes as lb
from lusee_bayes.experiment.model import full_model, model_to_sample, radiometer, true_values
from lusee_bayes.instrument.products import DataLayout
from lusee_bayes.noise.covariance import Covariance, DenseCovariance, LowRankCovariance
from lusee_bayes.noise.instrument_errors import difference
from lusee_bayes.sampling.programs import numpyro_promotion
from lusee_bayes.systematics import prior_spectrum, systematic
from lusee_bayes.systematics.context import Around, Setup
from lusee_bayes.systematics.noise_level import NoiseLevel, RadiometerSection
from lusee_bayes.systematics.sources import PointSources

LMAX, N_DATA = 4, 40
ELLS = np.arange(LMAX + 1)
PER_ELL = 2 * ELLS + 1


class Case:
    """Data of 25 modes as dense matrices."""

    def __init__(self):
        rng = np.random.default_rng(4)
        self.a, self.spectrum = rng.normal(size=(N_DATA, 25)), 4.0 / (1.0 + ELLS)
        self.n = 3.0 * random_covariance(rng, N_DATA)
        self.data = 3.0 * rng.normal(size=N_DATA)
        prior, noise = lb.HarmonicPrior(self.spectrum), DenseCovariance(jnp.asarray(self.n))
        self.model = lb.LinearGaussian(jnp.asarray(self.a), prior, noise)

    def evidence(self, factors=1.0, level=1.0, more=0.0, mean=0.0) -> float:
        """ln N(d; mean, A S A^T + level N + more) with C_ell times ``factors``."""
        variance = np.repeat(self.spectrum * factors, PER_ELL)
        covariance = (self.a * variance) @ self.a.T + level * self.n + more
        return float(multivariate_normal.logpdf(self.data, np.zeros(N_DATA) + mean, covariance))


@pytest.fixture(scope="module")
def case():
    return Case()


def general(case, systematics, values) -> float:
    """By models/systematics.py; no site may be left to chance."""
    arguments = {"gaussian": case.model, "systematics": tuple(systematics)}
    arguments["data"] = jnp.asarray(case.data)
    got, trace = density(lb.load_program("systematics"), arguments, values)
    assert set(trace) == {*values, "data"}
    return got


# densities of order 100 of matrices with condition below 1e4: 1e-11 of them, as the others here
CLOSE = 1e-11


# --- one by one -----------------------------------------------------------------------------------


def steep(tilt):
    return ((ELLS + 1) / 10) ** tilt


# neither the spectrum nor the level depends on the setup
def spectrum(*edges, **options):
    section = prior_spectrum.SpectrumSection(band_edges=edges, log_band_std=0.8, **options)
    return prior_spectrum.PriorSpectrum.build(section, object.__new__(Setup), Around())


LEVEL = NoiseLevel.build(RadiometerSection(log_factor_std=0.7), object.__new__(Setup), Around())
BOTH = spectrum(log_amplitude_std=0.4, tilt_std=0.6)
FACTORS = [
    (LEVEL, {"noise_level": 0.2}, [0.7], 1.0),
    (LEVEL, {"noise_level": 7.0}, [0.7], 1.0),
    (spectrum(log_amplitude_std=0.4), {"amplitude": 5.0}, [0.4], 5.0),
    (spectrum(tilt_std=0.6), {"tilt": -1.0}, [0.6], steep(-1.0)),
    (BOTH, {"amplitude": 0.3, "tilt": 1.4}, [0.4, 0.6], 0.3 * steep(1.4)),
    # an edge is the first ell of its band; the lowest begins at 0, the highest ends it
    (spectrum(2), {"band_power": [0.5, 3.0]}, [0.8], [0.5, 0.5, 3.0, 3.0, 3.0]),
    (spectrum(1, 2, 4), {"band_power": [4.0, 0.3, 1.5, 0.7]}, [0.8], [4.0, 0.3, 1.5, 1.5, 0.7]),
]


@pytest.mark.parametrize(("systematic", "values", "stds", "factors"), FACTORS)
def test_levels_and_spectra_are_factors_of_n_and_c_ell(case, systematic, values, stds, factors):
    """A ratio of variances; C_ell A ((ell + 1) / 10)^tilt, and powers of bands."""
    expected = case.evidence(np.asarray(factors), level=values.get("noise_level", 1.0))
    for (name, value), std in zip(values.items(), stds, strict=True):
        expected += (norm(0.0, std) if name == "tilt" else lognorm(std)).logpdf(value).sum()
    assert general(case, [systematic], values) == pytest.approx(expected, rel=CLOSE)


def test_the_program_with_bands(case):
    """Its edges are 1, 3, 6, 12, 24, of which lmax = 4 leaves two."""
    power = np.array([2.0, 0.4, 1.7])
    expected = case.evidence(np.array([2.0, 0.4, 0.4, 1.7, 1.7]))
    expected += lognorm.logpdf(power, 1.0).sum()
    program = lb.load_program("spectrum_bands")
    arguments = program.arguments(case.model) | {"data": jnp.asarray(case.data)}
    got, trace = density(program, arguments, {"band_power": power})
    assert set(trace) == {"band_power", "data"}
    assert got == pytest.approx(expected, rel=CLOSE)


# --- several at once ------------------------------------------------------------------------------


def test_several_at_once(case):
    """Noise level, bands and a source with two amplitudes; what is marginalised keeps its place."""
    rng = np.random.default_rng(8)
    columns, other = rng.normal(size=(N_DATA, 2)), rng.normal(size=(N_DATA, 1))
    source = PointSources((systematic.Unknown("flux_Cas_A", 2.0, 0.5, 2),), jnp.asarray(columns))
    hidden = PointSources((systematic.Unknown("flux_Vir_A", 3.0, 4.0),), jnp.asarray(other))
    level, power, flux = 2.5, np.array([0.6, 1.9]), np.array([1.2, 2.9])
    values = {"noise_level": level, "band_power": power, "flux_Cas_A": flux}
    priors = lognorm.logpdf(level, 0.7) + lognorm.logpdf(power, 0.8).sum()
    priors += norm.logpdf(flux, 2.0, 0.5).sum()
    factors = np.array([0.6, 0.6, 0.6, 1.9, 1.9])
    mean, term = columns @ flux + 3.0 * other[:, 0], 16.0 * other @ other.T
    hidden = systematic.Marginalised(hidden)
    # the order of those that do not touch the noise is all the same
    for order in ([LEVEL, spectrum(3), source, hidden], [source, LEVEL, hidden, spectrum(3)]):
        expected = case.evidence(factors, level, term, mean) + priors
        assert general(case, order, values) == pytest.approx(expected, rel=CLOSE)
    # a level behind the marginalised source scales that, too
    expected = case.evidence(factors, level, level * term, mean) + priors
    got = general(case, [spectrum(3), hidden, LEVEL, source], values)
    assert got == pytest.approx(expected, rel=CLOSE)


# --- in a scenario --------------------------------------------------------------------------------
SOURCES = "sources.list=[{name: Cas A}, {name: For A, relative_std: 0.2}]"


def test_the_level_is_that_of_the_radiometer_only():
    """A sampled noise level leaves a marginalised beam error as it is, and marginalised sources."""
    e = small_experiment("noise.radiometer.log_factor_std=0.5", "noise.beam.shift_mhz=2", SOURCES)
    setup, data, program = e.setup, e.data, lb.load_program("systematics")
    base, rest = model_to_sample(setup, Around(data))
    assert isinstance(rest[0], NoiseLevel)
    assert all(isinstance(one, systematic.Marginalised) for one in rest[1:]) and len(rest) == 3
    np.testing.assert_array_equal(base.noise.diagonal(), radiometer(setup).diagonal())
    shift = difference(lb.monopole_beams(27.0, 6), setup.beams)
    da = np.asarray(lb.CouplingMatrix.build(shift, setup.pointing).dense())
    s, n = np.asarray(setup.prior.variance()), np.asarray(radiometer(setup).diagonal())
    t = np.stack([np.asarray(r).reshape(-1) for r in setup.responses], axis=1)
    std = PointSources.build(setup.scenario.sources, setup, Around()).stds
    arguments = program_arguments(program, e)
    with numpyro_promotion():
        given = handlers.substitute(program.model, {"noise_level": jnp.asarray(9.0)})(**arguments)
    term = (da * s) @ da.T + (t * std**2) @ t.T
    expected, got = np.diag(9.0 * n) + term, np.asarray(given.noise.dense())
    # the two terms hold up to 1e6 K^2 of which rounding leaves 1e-10 K^2, the radiometer 0.05
    within(got, expected, 1e-13 * term.max())
    assert np.abs(got - (np.diag(n) + term)).max() > 0.1
    # in the first-order model the level is one
    within(full_model(setup).noise.dense(), np.diag(n) + term, 1e-13 * term.max())
    # and in simulated data it is the drawn one
    assert set(true_values(setup)) == {"noise_level", "beam_amplitude", "flux_Cas_A", "flux_For_A"}


N_PRODUCTS, N_TIMES, N_MODES = 4, 20, 9


class Pickup(systematic.AdditiveNoise):
    """Known patterns with unknown amplitudes."""

    patterns: jax.Array

    def covariance(self) -> Covariance:
        return LowRankCovariance(self.patterns, "the pickup")


class Correlated(systematic.AdditiveNoise):
    """Noise that lasts a while, of every product by itself."""

    hours: jax.Array

    def covariance(self) -> Covariance:
        kernel = jnp.exp(-jnp.abs(self.hours[:, None] - self.hours[None]) / 3.0)
        return DenseCovariance(jnp.kron(jnp.eye(self.layout.n_products), kernel), "the hum")


def terms():
    layout = DataLayout(N_PRODUCTS, N_TIMES)
    patterns = np.random.default_rng(1).normal(size=(layout.size, 2))
    hum = Correlated("hum", layout, jnp.arange(float(N_TIMES)))
    return [Pickup("pickup", layout, jnp.asarray(patterns)), hum]


@pytest.mark.parametrize("term", terms(), ids=lambda term: term.name)
def test_marginalised_and_sampled_are_one_distribution(term):
    """What is added to the offset is linear in the site's normals, with the covariance in N."""
    n = N_PRODUCTS * N_TIMES
    a, noise = np.random.default_rng(0).normal(size=(n, N_MODES)), jnp.full(n, 0.1)
    prior, noise = lb.HarmonicPrior(jnp.ones(3)), lb.DiagonalCovariance(noise)
    model = lb.LinearGaussian(jnp.asarray(a), prior, noise, jnp.arange(float(n)))
    dense = np.asarray(term.covariance().dense())
    within(np.asarray(term.marginalised(model).noise.dense() - model.noise.dense()), dense, 1e-13)
    rank = term.covariance().rank

    def offset(z):
        with handlers.seed(rng_seed=0), handlers.substitute(data={f"{term.name}_noise": z}):
            return term.sampled(model).offset

    with handlers.seed(rng_seed=0), handlers.trace() as trace:
        term.sampled(model)
    fn, z = trace[f"{term.name}_noise"]["fn"], jnp.arange(float(rank))
    expected = -0.5 * (z**2).sum() - 0.5 * rank * np.log(2.0 * np.pi)
    assert float(fn.log_prob(z)) == pytest.approx(float(expected), rel=1e-13)
    root = np.asarray(jax.jit(jax.jacfwd(offset))(jnp.zeros(rank)))
    within(root @ root.T, dense, 1e-12)
    np.testing.assert_array_equal(offset(jnp.zeros(rank)), model.offset)
    assert systematic.sky_is_sampled((term,)) == (rank > systematic.MOST_COLLAPSED)
    assert not term.changes_coupling
