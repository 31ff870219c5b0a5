"""Many modes at once by NUTS against the analytic posterior, with full N.

1024 of them; the paper's 2304 take three quarters of an hour. Before a release, run this file with
LUSEE_BAYES_TEST_LMAX=47 and pytest -o faulthandler_timeout=0.
"""

import os

import equinox as eqx
import pytest

import lusee_bayes as lb
from lusee_bayes.sampling.validation import validate_draws

LMAX = int(os.environ.get("LUSEE_BAYES_TEST_LMAX", "31"))


SCENARIOS = [("gain_1e-2",), ("fiducial", "prior.model=local_scales")]


@pytest.mark.long
@pytest.mark.parametrize("scenario", SCENARIOS, ids=["gains", "correlated modes"])
def test_nuts_agrees_with_every_mean_every_variance_and_the_covariance(scenario):
    name, *overrides = scenario
    experiment = lb.build(lb.load_scenario(name, [f"lmax={LMAX}", *overrides]))
    inference, data = lb.infer(experiment), experiment.data
    model, posterior = inference.model, inference.posterior
    program = lb.load_program("sky")
    arguments = {**program.arguments(model), "data": data.data}
    sampler = lb.Sampler(chains=4, draws=500, seed=2)
    chains = lb.sample(program.model, arguments, sampler, lb.Whitening.of(posterior))
    draws = chains.sites["sky"]
    assert draws.shape == (4, 500, (LMAX + 1) ** 2)
    statistics = [chains.statistics[name] for name in ("diverging", "energy")]
    found = validate_draws(draws, posterior, *statistics)
    assert found.passed, [check for check in found.checks if not check.passed]
    assert found.ess_bulk.min() > 1000
    # standard deviations 2 % off do not pass: total variance: 4 % off, 1 % allowed
    wrong = eqx.tree_at(lambda p: p.lower, posterior, 1.02 * posterior.lower)
    assert not validate_draws(draws, wrong, *statistics).passed
