"""The paper's size: all 2304 modes by NUTS against the analytic posterior, with full N."""

import equinox as eqx
import pytest

import lusee_bayes as lb
from lusee_bayes.coordinates import Whitening
from lusee_bayes.inference import Sampler, sample
from lusee_bayes.programs import load_program
from lusee_bayes.validation import compare


@pytest.mark.long
@pytest.mark.parametrize("name", ["fiducial", "gain_1e-2"])
def test_nuts_agrees_with_every_mean_every_variance_and_the_covariance(name):
    experiment = lb.Experiment.from_scenario(lb.load_scenario(name))
    data = experiment.simulate()
    model, posterior, _ = experiment.infer(data)
    program = load_program("sky")
    chains = sample(
        program.model,
        {**program.arguments(model), "data": data.data},
        Sampler(chains=4, draws=1000, seed=2),
        Whitening.of(posterior),
    )
    draws = chains.sites["sky"]
    assert draws.shape == (4, 1000, 2304)
    found = compare(draws, posterior, chains.statistics["diverging"], chains.statistics["energy"])
    assert found.passed, [check for check in found.checks if not check.passed]
    assert found.ess_bulk.min() > 2000
    # standard deviations 2 % off do not pass: total variance: 4 % off, 0.7 % allowed
    wrong = eqx.tree_at(lambda p: p.lower, posterior, 1.02 * posterior.lower)
    again = compare(draws, wrong, chains.statistics["diverging"], chains.statistics["energy"])
    assert not again.passed
