"""Joint error bars on skies drawn from the joint prior, seen by the telescope's own beams."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from lusee_bayes.experiment.model import full_model
from lusee_bayes.experiment.scenario import load_scenario
from lusee_bayes.experiment.setup import set_up
from lusee_bayes.linear.joint import channel_sky, paired, solve_directly
from lusee_bayes.sky.spectral_prior import SpectralPrior

FREQUENCIES = [10, 16, 22, 28, 34, 40]
DATA_SETS = 60


@pytest.mark.long
def test_chi2_of_data_and_of_skies_is_chi2():
    scenario = load_scenario(
        "fiducial", ["lmax=6", "observation.step_s=40000", f"frequencies_mhz={FREQUENCIES}"]
    )
    setups = [set_up(s) for s in scenario.channels()]
    models = [full_model(s) for s in setups]
    skies = np.stack([np.asarray(s.sky.modes) for s in setups])
    prior = SpectralPrior.components(np.array(scenario.frequencies_mhz), skies)
    k, n = prior.n_components, skies.shape[1]
    none = jnp.zeros((0, k, n))
    of_data, of_skies = [], []
    for number in range(DATA_SETS):
        sky_key, noise_key, residual_key = jax.random.split(jax.random.key(1000 + number), 3)
        truth = prior.sample(sky_key)
        channels = [
            m.inform(m.predict(sky) + m.noise.sample(jax.random.fold_in(noise_key, f)))[0]
            for f, (m, sky) in enumerate(zip(models, truth, strict=True))
        ]
        reference = np.stack([np.asarray(t.reference) for t in channels])
        posterior = solve_directly(prior, channels, reference)
        maps, spread = posterior.mean.reshape(k, n), paired(posterior.covariance(), prior)
        evidence = float(posterior.log_evidence)
        found = [
            channel_sky(prior, f, t, maps, spread, none, residual_key)
            for f, t in enumerate(channels)
        ]
        of_skies.append(
            [
                float((c.mean - t) @ jnp.linalg.solve(c.covariance, c.mean - t))
                for c, t in zip(found, truth, strict=True)
            ]
        )
        of_data.append(evidence)
    n_data = sum(m.n_data for m in models)
    # -2 ln p(d) is chi^2 plus a constant: that of data which are all zero
    silent = [m.inform(jnp.zeros(m.n_data))[0] for m in models]
    highest = float(solve_directly(prior, silent, np.zeros_like(skies)).log_evidence)
    chi2 = 2.0 * (highest - np.array(of_data))
    assert stats.kstest(chi2, stats.chi2(n_data).cdf).pvalue > 1e-3
    # channels share their skies: one test for each of them
    for channel in np.array(of_skies).T:
        assert stats.kstest(channel, stats.chi2(n).cdf).pvalue > 1e-4
