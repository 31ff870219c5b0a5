"""Point sources beside the map: in N, among the unknowns, sampled, and in simulated data.

The oracle takes A, N_0 and the responses as matrices and works in decimal arithmetic of 60 digits
(``exact_posterior``): K = A S A^T + N has condition 1e12 here. And what cannot be, said of sources,
antennas, priors and treatments: one clear sentence each.
"""

from dataclasses import replace
from functools import lru_cache

import jax.numpy as jnp
import numpy as np
import pytest
from assertions import refuse
from commands import run, sets, table_of
from experiments import density_of, program_arguments, small_experiment
from numpyro import handlers
from reference_linear import exact_posterior
from scipy.constants import Boltzmann, speed_of_light
from scipy.stats import chi2, norm
from tables import tables

import lusee_bayes as lb
from lusee_bayes.experiment import model as models
from lusee_bayes.experiment.experiment import Experiment
from lusee_bayes.experiment.unknowns import flux_table
from lusee_bayes.sampling.programs import latent_sites
from lusee_bayes.sky.galaxy import BRIGHT_SOURCES
from lusee_bayes.systematics.context import Setup
from lusee_bayes.systematics.prior_spectrum import PriorSpectrum
from lusee_bayes.systematics.systematic import Unknown
from lusee_bayes.testing import small_scenario

TABLES = tables(__file__)

# Cas A is up, For A has an amplitude for every two of the six samples, and the last lies near the
# north pole of the Moon, 24 degrees below the horizon for ever
LIST = (
    "sources.list=[{name: Cas A}, {name: For A, block_h: 4, relative_std: 0.2},"
    " {name: Polaris, ra_deg: 270, dec_deg: 66.5, flux_jy: 20000}]"
)
SITES = ["flux_Cas_A", "flux_For_A", "flux_Polaris"]


CAS_A = "sources.list=[{name: Cas A}]"


def setup_of(*overrides: str, sources: str = LIST) -> Setup:
    """Treatments and priors do not enter what is built (A, the beams, the responses)."""
    return replace(small_experiment(sources).setup, scenario=small_scenario(sources, *overrides))


@lru_cache
def experiment(*overrides: str, sources: str = LIST) -> Experiment:
    setup = setup_of(*overrides, sources=sources)
    return Experiment(setup, models.simulate(setup))


def columns() -> np.ndarray:
    """T (data, 5): the responses of every source and block, from those of all products and times.

    The data are all products of all times, products outside.
    """
    cas, fornax, polaris = (np.asarray(r) for r in setup_of().responses)
    blocks = [np.where(np.arange(6) // 2 == block, fornax, 0.0) for block in range(3)]
    return np.stack([r.reshape(-1) for r in (cas, *blocks, polaris)], axis=1)


def kelvin_steradian(flux_jy: float, frequency_mhz: float = 25.0) -> float:
    """Rayleigh and Jeans: I = 2 k T nu^2 / c^2."""
    return flux_jy * 1e-26 / (2 * Boltzmann * (frequency_mhz * 1e6 / speed_of_light) ** 2)


def priors() -> tuple[np.ndarray, np.ndarray]:
    """Means and standard deviations of the five fluxes, in K sr."""
    known = {s.name: kelvin_steradian(float(s.flux_jy(25.0))) for s in BRIGHT_SOURCES}
    mean = np.array([known["Cas A"], *[known["For A"]] * 3, kelvin_steradian(20000.0)])
    return mean, mean * np.array([0.5, 0.2, 0.2, 0.2, 0.5])


@lru_cache
def answer():
    """Posterior of sky and fluxes (minus their means) as one Gaussian, in closed form."""
    e, (mean, std), t = setup_of(), priors(), columns()
    both = np.concatenate([np.asarray(e.coupling.dense()), t], axis=1)
    variance = np.concatenate([np.asarray(e.prior.variance()), std**2])
    noise = np.diag(np.asarray(models.radiometer(e).diagonal()))
    return exact_posterior(both, variance, noise, np.asarray(experiment().data.data) - t @ mean)


# --- marginalised ---------------------------------------------------------------------------------


@pytest.mark.essential
def test_the_sky_is_the_same_with_fluxes_in_the_noise_or_beside_it():
    """Both against the closed form: Lambda's condition of 1e10 costs 1e-6 of a variance; means are
    refined, to better than 1e-6 standard deviations."""
    expected, d = answer(), experiment().data.data
    marginal = models.full_model(setup_of()).condition(d).posterior
    sky = expected.std[:49]
    assert np.abs((np.asarray(marginal.mean) - expected.mean[:49]) / sky).max() < 1e-5
    np.testing.assert_allclose(np.asarray(marginal.std()), sky, rtol=1e-5)
    assert float(marginal.log_evidence) == pytest.approx(expected.log_prob, abs=1e-4)
    # the sources matter: with them in the data only, the sky is off by what can be seen
    wrong = models.full_model(setup_of("sources.treatment=ignored")).condition(d).posterior
    assert np.abs((np.asarray(wrong.mean) - expected.mean[:49]) / sky).max() > 1.0


# --- fluxes ---------------------------------------------------------------------------------------


def test_the_table_is_in_jansky():
    table = flux_table(experiment(), lb.infer(experiment()))
    expected, (mean, std), truth = answer(), priors(), models.true_values(setup_of())
    jansky = 1.0 / kelvin_steradian(1.0)
    assert list(table["source"]) == ["Cas A", "For A", "For A", "For A", "Polaris"]
    assert list(table["block"]) == [0, 0, 1, 2, 0]
    assert list(table["above_horizon"]) == [True, True, True, True, False]
    fluxes = mean + expected.mean[49:]
    np.testing.assert_allclose(table["flux_k_sr"], fluxes, rtol=1e-5)
    np.testing.assert_allclose(table["flux_jy"], fluxes * jansky, rtol=1e-5)
    np.testing.assert_allclose(table["std_k_sr"], expected.std[49:], rtol=1e-5)
    np.testing.assert_allclose(table["std_jy"], expected.std[49:] * jansky, rtol=1e-5)
    np.testing.assert_allclose(table["prior_jy"], mean * jansky, rtol=1e-12)
    np.testing.assert_allclose(table["prior_std_jy"], std * jansky, rtol=1e-12)
    true = np.concatenate([np.atleast_1d(truth[site]) for site in SITES])
    np.testing.assert_allclose(table["true_jy"], true * jansky, rtol=1e-12)
    # the data do tell something
    assert expected.std[49] < 0.9 * std[0]
    # and the truth is where the posterior says, five of them to 5 sigma
    assert np.abs((table["flux_jy"] - table["true_jy"]) / table["std_jy"]).max() < 5.0
    # data without a truth have no such column
    real = replace(experiment(), setup=replace(experiment().setup, measured=True))
    assert "true_jy" not in flux_table(real, lb.infer(real))


# --- sampled --------------------------------------------------------------------------------------


@pytest.mark.long
def test_the_program_given_its_fluxes():
    """d ~ N(T f, A S A^T + N_0). ln det K of 49 squeezed modes: 1e-6 each."""
    e = experiment("sources.treatment=sampled")
    setup, d = e.setup, np.asarray(e.data.data)
    t, (mean, std) = columns(), priors()
    a, s = np.asarray(setup.coupling.dense()), np.asarray(setup.prior.variance())
    noise = np.diag(np.asarray(models.radiometer(setup).diagonal()))
    for z in (np.zeros(5), np.array([0.3, -1.0, 0.5, 2.0, -0.7])):
        flux = mean + std * z
        expected = exact_posterior(a, s, noise, d - t @ flux).log_prob
        expected += norm.logpdf(flux, mean, std).sum()
        values = {"flux_Cas_A": flux[0], "flux_For_A": flux[1:4], "flux_Polaris": flux[4]}
        assert density_of(e, values, "sources") == pytest.approx(expected, rel=1e-9, abs=1e-4)


# --- simulated data -------------------------------------------------------------------------------


def test_simulated_data_hold_the_drawn_fluxes():
    setup = setup_of()
    flux = np.concatenate([np.atleast_1d(models.true_values(setup)[site]) for site in SITES])
    d = experiment().data
    t, a = columns(), np.asarray(setup.coupling.dense())
    sigma = np.sqrt(np.asarray(models.radiometer(setup).diagonal()))

    def misfit(flux):
        left = np.asarray(d.data) - a @ np.asarray(d.truth) - t @ flux
        return float(((left / sigma) ** 2).sum())

    # chi^2 of 96 data, beyond which it is once in a million
    low, high = chi2.ppf(5e-7, 96), chi2.isf(5e-7, 96)
    assert low < misfit(flux) < high
    # each of the four amplitudes of sources that are up is seen in it
    for k in range(4):
        other = flux.copy()
        other[k] = priors()[0][k]
        assert misfit(other) > high
    z = (flux - priors()[0]) / priors()[1]
    assert np.abs(z).max() < 5.0 and len(set(z)) == 5


# --- command --------------------------------------------------------------------------------------


@pytest.mark.long
def test_the_map_command_writes_the_fluxes(tmp_path, capsys):
    given = sets("lmax=6", "observation.runs.0.cycles=0.02", "sky.sources=false", LIST)
    assert run("map", "fiducial", "-v", "-o", tmp_path, *given) == 0
    assert "Polaris: 20000 +- 10000 Jy (prior: never above the horizon)" in capsys.readouterr().out
    rows = table_of(tmp_path / "sources.csv")
    table = flux_table(experiment(), lb.infer(experiment()))
    assert list(rows[0]) == ["frequency_mhz", *table.columns]
    assert [row["source"] for row in rows] == list(table["source"])
    # written in full
    for name in ("flux_jy", "std_jy", "true_jy"):
        np.testing.assert_allclose([float(r[name]) for r in rows], table[name], rtol=1e-9)


# --- sources --------------------------------------------------------------------------------------


@pytest.mark.parametrize(("source", "message"), TABLES["unknown sources"])
def test_sources_that_are_not_known(source, message):
    refuse(message, lb.build, small_scenario(f"sources.list=[{{name: {source}}}]"))


# --- antennas -------------------------------------------------------------------------------------


@pytest.mark.parametrize(("parameters", "message"), TABLES["bad antennas"])
def test_antennas_that_cannot_be_sampled(parameters, message):
    sampled = f"noise.beam.parameters={parameters}", "noise.beam.treatment=sampled"
    for ask in (models.true_values, models.systematics):
        refuse(message, ask, setup_of(*sampled, sources=CAS_A))


def test_the_nearer_end_is_named():
    refuse("at most 180", Unknown("angle", 170.0, 20.0, low=0.0, high=180.0).prior)
    # a quarter of a percent is allowed: 2.81 standard deviations
    Unknown("angle", 180.0 - 2.82, 1.0, low=0.0, high=180.0).prior()
    refuse("0.3% of its weight", Unknown("angle", 180.0 - 2.80, 1.0, low=0.0, high=180.0).prior)


def test_bands_beyond_the_highest_ell():
    e = experiment("prior.band_edges=[3, 7]", sources=CAS_A)
    program = lb.load_program("systematics")
    arguments = {n: v for n, v in program_arguments(program, e).items() if n != "data"}
    refuse("band.*ell = 7.*lmax = 6", latent_sites, program.model, arguments)
    # 6 is the highest ell itself
    base = replace(models.base_model(e.setup), prior=lb.HarmonicPrior(jnp.ones(7)))
    with handlers.seed(rng_seed=0):
        PriorSpectrum((Unknown("band_power", 1.0, 1.0, 3, log=True),), (3, 6)).sampled(base)


# --- programs that do not fit the scenario --------------------------------------------------------


@pytest.mark.parametrize(("program", "overrides", "section"), TABLES["counted twice"])
def test_nothing_is_counted_twice(program, overrides, section):
    """What a program samples must not be in N as well."""
    asked, e = lb.load_program(program), experiment(*overrides, sources=CAS_A)
    refuse(f"this unknown, too; set {section}.treatment=sampled", program_arguments, asked, e)
    # either of the other treatments will do
    for treatment in ("sampled", "ignored"):
        free = experiment(*overrides, f"{section}.treatment={treatment}", sources=CAS_A)
        assert program_arguments(asked, free)


def test_what_the_scenario_does_not_have():
    bare = small_experiment()
    for program, section in (("gains", "noise.gain"), ("sources", "sources")):
        refuse(f"the scenario has no {section}", program_arguments, lb.load_program(program), bare)
    asked = lb.load_program("systematics").arguments
    refuse("'gaussian'.*piece.*experiment", asked, models.base_model(bare.setup))
