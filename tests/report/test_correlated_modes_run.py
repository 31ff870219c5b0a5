"""A run with a prior that correlates modes: files, page, new data."""

from __future__ import annotations

import json

import numpy as np
import pytest
import xarray as xr
from page_in_node import NODE, run_page
from reference_linear import resolution_rows

import lusee_bayes as lb
from lusee_bayes.core.harmonics import mode_numbers, pixel_matrix, synthesis_matrix
from lusee_bayes.report.explorer import KERNEL_NSIDE
from lusee_bayes.results.diagnostics import read_diagnostics
from lusee_bayes.results.updatable import read_updatable

LMAX = 8
SMALL = [
    f"lmax={LMAX}",
    "observation.runs=[{cycles: 0.1}, {cycles: 0.1, turntable_deg: 30}]",
    "prior.model=local_scales",
]
POINTS = [(0.0, 0.0), (280.0, -32.0), (123.4, 56.7), (180.0, 90.0)]


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    output = "output={draws: 20, covariance: true, updatable: true}"
    scenario = lb.load_scenario("fiducial", [*SMALL, output])
    return lb.run_map(scenario, tmp_path_factory.mktemp("correlated") / "map")


def test_its_files_agree(run):
    posterior = run.result.inference.posterior
    std = np.asarray(posterior.std())
    with xr.open_dataset(run.folder / "posterior.nc", engine="h5netcdf") as file:
        covariance = file["covariance"].values
        np.testing.assert_allclose(file["std"], std, rtol=1e-6)
        width = np.sqrt(np.asarray(posterior.prior.variance()))
        np.testing.assert_allclose(file["prior_std"], width, rtol=1e-12)
    np.testing.assert_allclose(np.sqrt(np.diag(covariance)), std, rtol=1e-6)
    saved = read_updatable(run.folder, run.result.scenario).posterior
    np.testing.assert_allclose(saved.std(), std, rtol=1e-8)
    summary = json.loads((run.folder / "summary.json").read_text())
    # chi^2 of 3,500 data scatters by 84
    assert summary["chi2"] == pytest.approx(summary["chi2_expected"], rel=0.1)
    scenario = lb.load_scenario(run.folder / "scenario.yaml")
    assert scenario == run.result.scenario


@pytest.mark.skipif(NODE is None, reason="no node on this machine")
def test_point_spread_functions_of_its_page(run, tmp_path):
    """Against y^T R from the posterior; bytes are wrong by half a step at most, at random."""
    page = (run.folder / "report.html").read_text()
    commands = f"told.kernels = {json.dumps(POINTS)}.map((p) => explorer.kernel(...p));"
    kernels = np.array(run_page(page, tmp_path, commands)["kernels"])
    lon, lat = np.radians(POINTS).T
    y, there = synthesis_matrix(np.pi / 2 - lat, lon, LMAX), pixel_matrix(KERNEL_NSIDE, LMAX)
    expected = np.asarray(resolution_rows(run.result.inference.posterior, y)) @ there.T
    found = read_diagnostics(run.folder / "diagnostics.nc")
    ell, _ = mode_numbers(LMAX)
    step, width = found["resolution_step"].values[np.ix_(ell, ell)], found["prior_std"].values
    variance = (y * width) ** 2 @ (step**2 / 12) @ ((there / width) ** 2).T
    assert (np.abs(kernels - expected) < 6 * np.sqrt(variance) + 1e-6 * expected.max()).all()
    assert np.abs(kernels - expected).max() < 0.03 * np.abs(expected).max()
