"""The share of each datum that the model follows, against matrices."""

import numpy as np
import pytest

import lusee_bayes as lb
from lusee_bayes.linear.freedom import data_freedom


@pytest.mark.parametrize("dense", [0, 10**8])
def test_it_is_the_diagonal_of_a_product_of_matrices(monkeypatch, dense):
    """K_s K^-1 with templates and another low-rank term, five directions at once."""
    monkeypatch.setattr("lusee_bayes.linear.freedom.CHUNK", 5)
    monkeypatch.setattr("lusee_bayes.linear.freedom.DENSE", dense)
    rng = np.random.default_rng(0)
    a, v, other = rng.normal(size=(30, 9)), rng.normal(size=(30, 2)), rng.normal(size=(30, 1))
    spectrum, n = np.array([4.0, 1.0, 0.3]), rng.uniform(0.5, 2.0, 30)
    noise = lb.DiagonalCovariance(n) + lb.LowRankCovariance(v) + lb.LowRankCovariance(other)
    model = lb.LinearGaussian(lb.DenseCoupling(a), lb.HarmonicPrior(spectrum), noise)
    signal = a @ np.diag(np.repeat(spectrum, [1, 3, 5])) @ a.T + v @ v.T
    whole = signal + np.diag(n) + other @ other.T
    expected = np.diag(signal @ np.linalg.inv(whole))
    got = data_freedom(model, model.condition(np.zeros(30)), v)
    np.testing.assert_allclose(got, expected, rtol=0, atol=1e-10)
    # without templates the sky's alone
    bare = a @ np.diag(np.repeat(spectrum, [1, 3, 5])) @ a.T
    got = data_freedom(model, model.condition(np.zeros(30)), np.zeros((30, 0)))
    np.testing.assert_allclose(got, np.diag(bare @ np.linalg.inv(whole)), rtol=0, atol=1e-10)
