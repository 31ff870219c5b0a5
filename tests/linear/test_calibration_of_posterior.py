"""Data simulated from the prior: the posterior must cover the truth as often as it says.

Skies and noise are drawn by numpy with the dense matrices, so nothing of the solver's own square
roots enters. For the right model C^-1/2 (m - mean) are independent unit normals, and their summed
squares follow chi^2 with n_modes degrees of freedom. There are 4000 draws, so that leaving out
the correlations of one time of 32 (chi^2 per mode 1.018) is still seen.
"""

from functools import cache
from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from experiments import mapped
from reference_linear import assert_draws_follow
from scipy.stats import chi2, kstest

import lusee_bayes as lb
from lusee_bayes.experiment.model import full_model
from lusee_bayes.linear.linear_gaussian import InData, InMap, Whitened
from lusee_bayes.noise.covariance import Covariance, DenseCovariance
from lusee_bayes.noise.time_blocks import TimeBlockCovariance

LMAX, N_MODES, N_DRAWS, SEED = 8, 81, 4000, 20270115
SPECTRUM = 1e8 * (1.0 + np.arange(LMAX + 1.0)) ** -2.5  # K^2; the monopole is 20000 K below
PRIOR_STD = np.sqrt(np.repeat(SPECTRUM, 2 * np.arange(LMAX + 1) + 1))


class Setup:
    """A of a short run and the noise terms of a 20000 K sky."""

    def __init__(self, beams, cycles: float):
        observation = lb.Observation.from_runs([lb.Run(cycles)])
        self.coupling = lb.CouplingMatrix.observe(beams, observation)
        layout = self.coupling.layout
        fiducial = self.coupling @ jnp.zeros(N_MODES).at[0].set(2e4 * np.sqrt(4 * np.pi))
        grid = layout.scatter(fiducial)
        paper, exact = (lb.radiometer_noise(grid, layout, form=form) for form in ("paper", "exact"))
        # gains that drift together over 10 h, of the radiometer noise's own size
        hours = observation.hours[layout.time]
        kernel = np.exp(-((hours[:, None] - hours[None]) ** 2) / (2 * 10.0**2))
        signal = np.asarray(fiducial)
        gain = DenseCovariance(jnp.asarray(1e-10 * np.outer(signal, signal) * kernel), "gain")
        dense = DenseCovariance(exact.dense() + gain.dense())
        self.noise = {"paper": paper, "exact": exact, "dense": dense}
        self.noise["diagonal+dense"] = paper + gain

    def simulate(self, noise: Covariance):
        """(skies, data) of N_DRAWS skies from the prior and noise from N, by numpy."""
        rng = np.random.default_rng(SEED)
        skies = rng.normal(size=(N_DRAWS, N_MODES)) * PRIOR_STD
        root = np.linalg.cholesky(np.asarray(noise.dense()))
        added = rng.normal(size=(N_DRAWS, noise.size)) @ root.T
        return skies, skies @ np.asarray(self.coupling.dense()).T + added

    def standardised(
        self, truth: Covariance, assumed: Covariance, form: type[Whitened]
    ) -> np.ndarray:
        """C^-1/2 (m - mean), shape (draws, modes), of data with noise ``truth``."""
        skies, data = self.simulate(truth)
        prior = lb.HarmonicPrior(jnp.asarray(SPECTRUM))
        solver = lb.LinearGaussian(self.coupling, prior, assumed).factorise(form)
        means = jax.jit(jax.vmap(lambda d: solver.condition(d).posterior.mean))(jnp.asarray(data))
        covariance = np.asarray(solver.condition(jnp.asarray(data[0])).posterior.covariance())
        # in units of the prior: the monopole's variance is 1e-10 of it, the rest of order one
        root = np.linalg.cholesky(covariance / np.outer(PRIOR_STD, PRIOR_STD))
        return np.linalg.solve(root, ((skies - np.asarray(means)) / PRIOR_STD).T).T


def p_value(standardised: np.ndarray) -> float:
    """Kolmogorov-Smirnov of chi^2 = (m - mean)^T C^-1 (m - mean) against chi^2(n_modes)."""
    return kstest((standardised**2).sum(1), chi2(N_MODES).cdf).pvalue


@cache
def run_of(cycles: float) -> Setup:
    """512 data in 0.1 cycles; 64 in 0.015, fewer than modes."""
    return Setup(lb.monopole_beams(25.0, LMAX), cycles)


KINDS = ["paper", "exact", "dense", "diagonal+dense"]
SETTINGS = [*product([0.1], [InMap, InData], KINDS), (0.015, InMap, "exact")]
SETTINGS += product([0.015], [InData], ["exact", "diagonal+dense"])


@pytest.mark.essential
@pytest.mark.parametrize(("cycles", "form", "noise"), SETTINGS)
def test_the_posterior_covers_the_truth(cycles, form, noise):
    setup = run_of(cycles)
    z = setup.standardised(setup.noise[noise], setup.noise[noise], form)
    assert p_value(z) > 0.01
    # chi^2 per mode: 1 within five times its scatter sqrt(2 / (draws x modes)) = 0.0025
    assert abs((z**2).mean() - 1.0) < 5 * np.sqrt(2 / z.size)
    assert_draws_follow(z, np.zeros(N_MODES), np.eye(N_MODES))


def test_the_same_check_notices_wrong_posteriors():
    """Correlations that are missing at one time of 32, and a gain term that is missing."""
    setup = run_of(0.1)
    exact = setup.noise["exact"]
    blocks = np.array(exact.blocks)
    blocks[3] = np.diag(np.diag(blocks[3]))
    wrong = TimeBlockCovariance(jnp.asarray(blocks), exact.layout)
    assert p_value(setup.standardised(exact, wrong, InMap)) < 1e-4
    with_gains, paper = setup.noise["diagonal+dense"], setup.noise["paper"]
    assert p_value(setup.standardised(with_gains, paper, InMap)) < 1e-100


# --- the full size: 5232 data, 2304 modes ---------------------------------------------------------


@pytest.mark.long
@pytest.mark.parametrize("frequency", [5, 25, 45])
def test_one_word_changes_the_frequency(frequency):
    _, channel = mapped(lb.build(lb.load_scenario("fiducial", [f"frequency_mhz={frequency}"])))
    spectra = channel.spectra()
    assert spectra["rho"][1:11].min() > 0.9
    assert channel.ell_cross >= 20
    # N_data - rank + tr Lambda^-1, with the scatter of chi^2 and a sky that is no Gaussian draw
    assert channel.chi2 == pytest.approx(channel.chi2_expected, abs=6 * np.sqrt(2 * 5232))
    if frequency == 25:
        assert spectra["rho"][1:24].min() > 0.5


@pytest.mark.long
@pytest.mark.parametrize("form", ["paper", "exact"])
def test_both_forms_agree_at_the_fiducial_condition_number(form):
    experiment = lb.build(lb.load_scenario("fiducial", [f"noise.radiometer.form={form}"]))
    model, data = full_model(experiment.setup), experiment.data
    by_map, by_data = (model.condition(data.data, form=f).posterior for f in (InMap, InData))
    std = np.asarray(by_data.std())
    # the mean is refined to 1e-9 sigma in both; variances of the map form lose eps times their
    # inflation, about 1e-6 (Posterior.std)
    assert np.abs((by_map.mean - by_data.mean) / std).max() < 1e-7
    assert np.abs(np.asarray(by_map.std()) / std - 1.0).max() < 1e-5
    assert float(by_map.log_evidence - by_data.log_evidence) == pytest.approx(0.0, abs=1e-4)
