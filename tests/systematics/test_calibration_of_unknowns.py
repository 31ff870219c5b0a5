"""Simulation-based calibration of receivers, ground, gain table and sky, and their null direction.

Each of 100 data sets has a sky, four receivers, a temperature and four gain errors of its own; the
model is to first order about what its data tell, found in rounds.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from experiments import four_ports
from scipy import stats

import lusee_bayes as lb
from lusee_bayes.experiment.rounds import settled
from lusee_bayes.experiment.setup import Setup, set_up
from lusee_bayes.experiment.simulate import simulate, true_values
from lusee_bayes.linear.templates import template_amplitudes
from lusee_bayes.results.unknowns import GAIN, SKY, unknowns_report
from lusee_bayes.sampling.calibration import N_DRAWS, Ranks

N = 100
UNKNOWN = (
    "noise.receiver={power_k: 2000}",
    "noise.regolith={std_k: 30}",
    "noise.gain_table={std: 0.01}",
)
# modes of the sky whose ranks are taken: one of every ell, and some with m != 0
MODES = (0, 2, 3, 6, 8, 12)


def drawn(first: Setup, seed: int) -> tuple[Setup, lb.Experiment]:
    """The setup with a sky drawn from its prior, and data of it; N is that of the model sky."""
    z = np.random.default_rng(seed).standard_normal(first.prior.size)
    sky = replace(first.sky, modes=np.asarray(first.prior.colour(z)) + first.prior.mean)
    scenario = first.scenario.model_copy(update={"seed": seed})
    setup = replace(first, sky=sky, scenario=scenario)
    return setup, lb.Experiment(setup, simulate(setup))


@pytest.mark.long
@pytest.mark.essential
def test_simulation_based_calibration(response_file):
    first = set_up(four_ports(response_file, *UNKNOWN))
    # known to a fifth, so that no sky is without a signal
    spectrum = 0.04 * np.asarray(first.prior.spectrum)
    first = replace(first, prior=lb.HarmonicPrior(spectrum, mean=first.sky.modes))
    sky_std = np.sqrt(np.asarray(first.prior.variance()))
    ranks, null, shares = [], [], []
    for seed in range(N):
        setup, experiment = drawn(first, seed)
        found, truth = settled(setup, experiment.data), true_values(setup)
        columns = np.concatenate([np.asarray(s.columns) for s in found.systematics], axis=1)
        told = template_amplitudes(found.model, found.posterior, experiment.data.data, columns)
        sky_covariance = np.asarray(found.posterior.covariance())
        expected = np.concatenate([s.expected for s in found.systematics])
        mean = np.concatenate([np.asarray(found.posterior.mean), expected + told.mean])
        covariance = np.block([[sky_covariance, told.with_sky], [told.with_sky.T, told.covariance]])
        rng = np.random.default_rng((seed, 1))
        draws = rng.multivariate_normal(mean, covariance, N_DRAWS, method="cholesky")
        z = [(truth[f"receiver_{port}_k"] - 2000.0) / 200.0 for port in range(4)]
        z += [(truth["regolith_k"] - 250.0) / 30.0, *truth["gain_table"]]
        true = np.concatenate([setup.sky.modes, z])
        picked = [*MODES, *range(16, 25)]
        ranks.append((draws < true).sum(0)[picked])
        # along the null direction, in prior standard deviations
        report = unknowns_report(experiment, found)
        assert report.null.names[0] == SKY
        assert report.null.names[-1] == GAIN
        off = true - mean
        parts = np.concatenate([off[:1] / sky_std[0], off[16:21], [off[21:].sum() / 2.0]])
        null.append(report.null.weights @ parts)
        shares.append(report.null.share)
    names = [f"mode {k}" for k in MODES] + [f"receiver {port}" for port in range(4)]
    names += ["regolith", *(f"gain {port}" for port in range(4))]
    table = Ranks(np.array(ranks), N_DRAWS, tuple(names))
    assert table.passed, dict(zip(names, table.p_values(), strict=True))
    # the direction that the data do not tell scatters as its share of the prior says
    assert min(shares) > 0.9
    low, high = stats.chi2(N).interval(1 - 1e-3)
    assert low < np.sum(np.array(null) ** 2 / shares) < high
