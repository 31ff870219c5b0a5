"""Part of the times: the model is that of the whole, without the others."""

import numpy as np
import pytest

import lusee_bayes as lb
from lusee_bayes.experiment import leave_out, model

SCENARIO = (
    "lmax=4",
    "observation={runs: [{cycles: 0.1}, {cycles: 0.12, turntable_deg: 30}], step_s: 14400}",
    "noise={gain: {sigma: 0.005, correlation_h: 12}, receiver: {power_k: 2.0e4}, "
    "polarisation: {linear: 0.01}, pointing: {clock_s: 20, turntable_deg: 0.2}, "
    "above_lmax: {margin: 3, least_lmax: 0}}",
    "sky.sources=false", "sources.list=[{name: Cas A}]",
)  # fmt: skip


@pytest.mark.essential
def test_the_model_of_some_times_is_that_of_all_without_the_others():
    setup = model.set_up(lb.load_scenario("fiducial", SCENARIO))
    data = model.simulate(setup)
    flags = np.zeros((data.layout.n_products, data.layout.n_times), dtype=bool)
    flags[3, 5], flags[:, 7] = True, True
    setup, data = leave_out.without(setup, data, flags)
    keep = np.arange(data.layout.n_times) % 3 != 1
    some, few, rows = setup.select(keep), data.select(keep), keep[np.asarray(data.layout.time)]
    np.testing.assert_array_equal(few.data, data.data[rows])
    whole, part = model.full_model(setup), model.full_model(some)
    expected = np.asarray(whole.coupling.dense())[rows]
    np.testing.assert_allclose(part.coupling.dense(), expected, atol=1e-14 * np.abs(expected).max())
    np.testing.assert_allclose(part.offset, whole.offset[rows], rtol=1e-12)
    noise = np.asarray(whole.noise.dense())[np.ix_(rows, rows)]
    np.testing.assert_allclose(part.noise.dense(), noise, atol=1e-12 * noise.max())
