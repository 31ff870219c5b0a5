"""The guide's example works: its class, taken from the page, and the test that it asks for."""

from __future__ import annotations

import re
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lusee_bayes as lb
from lusee_bayes.sampling.evidence import estimate_evidence
from lusee_bayes.sampling.programs import load_program

GUIDE = Path(__file__).parents[2] / "docs" / "systematics.md"


@pytest.mark.long
@pytest.mark.essential
def test_both_faces_of_the_guides_systematic_have_one_evidence(tmp_path):
    (code,) = re.findall(r"```python\n(.*?)```", GUIDE.read_text(), flags=re.DOTALL)
    program = """

def model(gaussian, systematics, data=None):
    for systematic in systematics:
        gaussian = systematic.sampled(gaussian)
    numpyro.sample("data", lb.Marginal(gaussian), obs=data)
    return gaussian
"""
    path = tmp_path / "pickup.py"
    path.write_text("import jax\n" + code + program)
    loaded = load_program(path)
    pickup = loaded.model.__globals__["CablePickup"]
    rng = np.random.default_rng(1)
    gaussian = lb.LinearGaussian(
        jnp.asarray(rng.normal(size=(30, 9))),
        lb.HarmonicPrior(jnp.ones(3)),
        lb.DiagonalCovariance(jnp.full(30, 0.1)),
    )
    cable = pickup(jnp.asarray(rng.normal(size=30)), 0.7)
    data = gaussian.sample(jax.random.key(0))[1] + 0.5 * cable.pattern
    pieces = {"gaussian": lambda: gaussian, "systematics": lambda: (cable,)}
    found = estimate_evidence(loaded, loaded.arguments(gaussian, pieces), data)
    exact = float(cable.marginalised(gaussian).log_prob(data))
    # a Gaussian is what the proposal is about, so that nearly every draw counts
    assert found.effective > 200
    assert found.error < 0.05
    assert found.log_evidence == pytest.approx(exact, abs=5 * found.error)
    assert float(gaussian.log_prob(data)) < exact - 1.0
