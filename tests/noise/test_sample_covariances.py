"""Sample covariances scatter as the radiometer noise of the package says."""

from __future__ import annotations

import numpy as np
import pytest

from lusee_bayes.core.errors import InputError
from lusee_bayes.instrument.products import to_matrix, to_real
from lusee_bayes.noise.radiometer import exact_blocks
from lusee_bayes.noise.sample_covariances import sample_covariances

DRAWS, AVERAGED = 20_000, 1e4


def test_their_covariance_is_that_of_the_exact_form():
    rng = np.random.default_rng(1)
    a = rng.normal(size=(4, 5)) + 1j * rng.normal(size=(4, 5))
    one = a @ a.conj().T
    t = np.broadcast_to(one[..., None], (4, 4, DRAWS)).copy()
    drawn = to_real(sample_covariances(t, AVERAGED, rng))
    true = to_real(one[..., None])
    block = np.asarray(exact_blocks(true))[0] / AVERAGED
    found = np.cov(drawn)
    # a sample covariance of Gaussians scatters by this
    std = np.sqrt((block**2 + np.outer(block.diagonal(), block.diagonal())) / DRAWS)
    assert np.abs((found - block) / std).max() < 4.5
    mean = (drawn.mean(axis=1) - true[:, 0]) / np.sqrt(block.diagonal() / DRAWS)
    assert np.abs(mean).max() < 4.0
    np.testing.assert_array_equal(t[..., 0], one)


def test_what_no_voltages_have_is_refused():
    t = to_matrix(np.ones((16, 3)))
    with pytest.raises(InputError, match="not positive definite"):
        sample_covariances(t, AVERAGED, np.random.default_rng(1))
