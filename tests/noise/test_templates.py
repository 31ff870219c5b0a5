"""Templates: T P T^T by hand, and what amplitudes drawn from P do."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest
from reference_linear import random_covariance

import lusee_bayes as lb
from lusee_bayes.instrument.layout import DataLayout

FLAGS = np.zeros((4, 5), dtype=bool)
FLAGS[:, 2] = FLAGS[1, 0] = True
LAYOUT = DataLayout.from_flags(FLAGS)
RNG = np.random.default_rng(4)
T = RNG.normal(size=(15, 3))
P = random_covariance(RNG, 3)
VARIANCES = np.array([0.5, 2.0, 1e4])


def by_hand(t, p):
    total = np.zeros((len(t), len(t)))
    for a in range(t.shape[1]):
        for b in range(t.shape[1]):
            total += p[a, b] * np.outer(t[:, a], t[:, b])
    return total


@pytest.mark.parametrize(("prior", "matrix"), [(VARIANCES, np.diag(VARIANCES)), (P, P)])
def test_the_term_is_t_p_t(prior, matrix):
    expected = by_hand(T, matrix)
    got = lb.template_noise(jnp.asarray(T), jnp.asarray(prior), LAYOUT)
    # products of a few numbers of order one
    atol = 1e-14 * np.abs(expected).max()
    np.testing.assert_allclose(got.dense(), expected, rtol=0, atol=atol)
    np.testing.assert_allclose(got.diagonal(), np.diag(expected), rtol=0, atol=atol)
    assert got.root.shape == (15, 3)


@pytest.mark.parametrize(
    ("templates", "prior", "message"),
    [
        (T[:14], VARIANCES, r"the templates has shape \(14, 3\), expected \(15, any\)"),
        (np.ones((20, 3)), VARIANCES, r"the templates has shape \(20, 3\), expected \(15, any\)"),
        (np.where(np.arange(15)[:, None] == 4, np.nan, T), VARIANCES, r"the templates holds NaN"),
        (T.astype(np.float32), VARIANCES, "the templates must be a float64 array"),
        (T, np.array([1.0, 0.0, 2.0]), r"prior variance must be positive, .* first at \(1,\)"),
        (T, np.array([1.0, 3.0, -2.0]), r"prior variance must be positive, .* first at \(2,\)"),
        (T, np.array([1.0, np.nan, 2.0]), r"prior variance must be positive, .* first at \(1,\)"),
        (T, np.diag([1.0, -0.5, 2.0]), "prior is not positive definite: .* eigenvalue is -0.5 "),
        (T, P + np.eye(3, k=1), "the templates' prior is not symmetric: .* up to 1 "),
        (T, np.full((3, 3), np.inf), "the templates' prior holds NaN or infinity"),
        (T, VARIANCES.astype(np.float32), "the templates' prior must be a float64 array"),
    ],
)
def test_bad_input_is_refused(templates, prior, message):
    with pytest.raises(lb.InputError, match=message):
        lb.template_noise(jnp.asarray(templates), jnp.asarray(prior), LAYOUT)
