"""Point-spread functions against sources that are put into the sky one by one."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

import lusee_bayes as lb
from lusee_bayes.core.harmonics import pixel_matrix
from lusee_bayes.experiment.model import base_model
from lusee_bayes.linear.resolution import resolution_rows


@pytest.mark.long
@pytest.mark.parametrize(("cycles", "form"), [(0.3, "map"), (0.1, "map"), (0.1, "data")])
def test_a_row_is_what_the_map_shows_there_of_each_source(cycles, form):
    # the best mode's signal-to-noise squared times 1e-16 is what is lost: 1e-9
    given = ["lmax=12", f"observation.runs.0.cycles={cycles}", "noise.radiometer.factor=1e5"]
    experiment = lb.build(lb.load_scenario("fiducial", given))
    model = base_model(experiment.setup)
    solver = model.factorise(form)
    posterior = solver.condition(experiment.data.data)
    y = pixel_matrix(4, 12)
    pixels = [0, 60, 131]
    rows = np.asarray(resolution_rows(posterior, y[pixels]))
    for source in (3, 60, 100):
        # noiseless data of a source of 1 K sr, mapped
        mapped = solver.condition(model.coupling @ jnp.asarray(y[source])).mean
        expected = y[pixels] @ np.asarray(mapped)
        peak = np.abs(rows @ y.T).max()
        np.testing.assert_allclose(rows @ y[source], expected, rtol=0, atol=1e-8 * peak)


def test_perfect_data_resolve_everything_and_none_nothing():
    prior = lb.HarmonicPrior(jnp.full(4, 2.0))
    for noise, share in ((1e-9, 1.0), (1e9, 0.0)):
        n = lb.DiagonalCovariance(jnp.full(16, noise))
        posterior = lb.LinearGaussian(jnp.eye(16), prior, n).condition(jnp.ones(16))
        rows = np.asarray(resolution_rows(posterior, jnp.eye(16)))
        np.testing.assert_allclose(rows, share * np.eye(16), atol=1e-8)
