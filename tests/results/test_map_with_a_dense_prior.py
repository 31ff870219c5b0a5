"""A whole map under a prior that correlates modes: results, files, page, and new data."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from lusee_bayes.results.updatable import read_updatable
from lusee_bayes.runs.diagnostics import region_rows
from reference_linear import matrices, random_covariance

import lusee_bayes as lb
from lusee_bayes.core.harmonics import mode_numbers
from lusee_bayes.linear.posterior import pixel_std
from lusee_bayes.results.map_files import posterior_dataset
from lusee_bayes.results.map_result import MapResult
from lusee_bayes.runs.map_run import map_result
from lusee_bayes.testing.scenarios import small_scenario

LMAX = 6


def with_dense_prior(experiment: lb.Experiment) -> lb.Experiment:
    width = np.sqrt(np.asarray(experiment.setup.prior.variance()))
    rng = np.random.default_rng(0)
    covariance = random_covariance(rng, len(width)) * width * width[:, None]
    prior = lb.DensePrior.of_covariance(covariance, 0.2 * width * rng.normal(size=len(width)))
    return replace(experiment, setup=replace(experiment.setup, prior=prior))


@pytest.fixture(scope="module")
def mapped() -> MapResult:
    scenario = small_scenario("output.updatable=true", lmax=LMAX, cycles=0.1)
    return map_result(with_dense_prior(lb.build(scenario)))


def test_the_channel_is_that_of_matrices(mapped):
    model, data = mapped.inference.model, np.asarray(mapped.experiment.data.data)
    (a, s, n), mean = matrices(model), np.asarray(model.prior.mean)
    covariance = np.asarray(mapped.inference.posterior.covariance())
    channel = mapped.channel
    # chi^2 of residuals: N_data less what the sky takes, tr(A C A^T N^-1)
    taken = np.trace(np.linalg.solve(n, a @ covariance @ a.T))
    np.testing.assert_allclose(channel.chi2_expected, len(data) - taken, rtol=1e-6)
    np.testing.assert_allclose(channel.prior_std, np.sqrt(np.diag(s)), rtol=1e-12)
    centred = data - a @ mean
    centred = centred if model.offset is None else centred - np.asarray(model.offset)
    k = a @ s @ a.T + n
    # K spans ten orders of magnitude
    total = centred @ np.linalg.solve(k, centred)
    np.testing.assert_allclose(channel.chi2_model, total, rtol=1e-4)
    page = mapped.diagnostics
    parts = page.attrs["instrument_chi2"] + page.attrs["prior_chi2"]
    np.testing.assert_allclose(parts, channel.chi2_model, rtol=1e-6)
    # shares of the prior, the monopole taken for known
    rest, left = s.copy(), covariance.copy()
    for matrix in (rest, left):
        matrix[0] = matrix[:, 0] = 0.0
    share = (pixel_std(left, channel.nside) / pixel_std(rest, channel.nside)) ** 2
    np.testing.assert_allclose(page["prior_fraction"], share, rtol=1e-8)
    rows = region_rows(channel.nside, LMAX)
    share = ((rows @ left) * rows).sum(1) / ((rows @ rest) * rows).sum(1)
    np.testing.assert_allclose(page["region_prior_fraction"], share, rtol=1e-8)


def test_its_resolution_is_packed(mapped):
    page = mapped.diagnostics
    width = page["prior_std"].values
    ell, _ = mode_numbers(LMAX)
    steps = page["resolution_step"].values[np.ix_(ell, ell)]
    scale = width[:, None] / width[None]
    found = page["resolution"].values * steps * scale
    s = np.asarray(mapped.inference.model.prior.covariance())
    covariance = np.asarray(mapped.inference.posterior.covariance())
    exact = np.eye(len(s)) - covariance @ np.linalg.inv(s)
    assert (np.abs(found - exact) <= 0.51 * steps * scale).all()


def test_new_data_are_added_to_its_file(mapped, tmp_path):
    posterior_dataset(mapped).to_netcdf(tmp_path / "posterior.nc", engine="h5netcdf")
    saved = read_updatable(tmp_path, mapped.scenario).posterior
    full = mapped.inference.posterior
    np.testing.assert_array_equal(saved.prior.root, full.prior.root)
    np.testing.assert_allclose(saved.mean, full.mean, rtol=1e-12)
    np.testing.assert_allclose(saved.std(), full.std(), rtol=1e-12)
    later = small_scenario(
        "output.updatable=true", "observation.start=2027-02-20", "seed=5", lmax=LMAX
    )
    again = map_result(with_dense_prior(lb.build(later)), onto=tmp_path)
    assert (again.channel.std < mapped.channel.std * (1 + 1e-9)).all()
    more = again.channel.information_bits - mapped.channel.information_bits
    assert more > 10
