"""Joint runs with positive skies, from the command line to the files."""

import json

import healpy
import numpy as np
import pytest
import xarray as xr

from lusee_bayes.cli.main import main
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.harmonics import modes_to_map, n_modes
from lusee_bayes.experiment.scenario import load_scenario
from lusee_bayes.runs.cube import cube_result, lmax_of_fields, positive_skies

SMALL = [
    *("lmax=4", "observation.runs.0.cycles=0.1", "spectral.model=positive"),
    *("spectral.fields=[level, index]", "joint=true"),
]


def scenario_of(*overrides, frequencies="[10, 20, 40]"):
    return load_scenario("fiducial", [*SMALL, f"frequencies_mhz={frequencies}", *overrides])


@pytest.mark.long
def test_files_of_a_run_agree_with_each_other(tmp_path, capsys):
    settings = [word for setting in SMALL[:-1] for word in ("--set", setting)]
    command = ["map", "fiducial", *settings, "--frequencies", "10,20,40", "--joint"]
    assert main([*command, "--draws", "3", "-o", str(tmp_path / "out")]) == 0
    said = capsys.readouterr().out
    assert "spectral.model=positive" in said and "prior.model=isotropic is not used" in said
    cube = xr.load_dataset(tmp_path / "out" / "posterior.nc", engine="h5netcdf")
    assert cube["component_mean"].attrs["units"] == "1" and cube["mean"].attrs["units"] == "K"
    assert cube["component_mean"].shape == (2, n_modes(6))  # 1.5 times the maps' lmax
    skies = positive_skies(scenario_of("spectral.sources=false"))
    exponents = cube["mixing"].values @ cube["component_mean"].values
    for k, draws in enumerate(cube["draws"].values):
        assert (skies.values(k, exponents[k]) > 0).all()
        # what residuals and point sources, which this sky has not, add is small
        common, mean = skies.modes(k, exponents[k]), cube["mean"].values[k]
        assert np.abs(common - mean).max() < 0.1 * np.abs(mean).max()
        # three draws of each mode are within five standard deviations of the mean
        assert (np.abs(draws - mean) < 5.0 * cube["std"].values[k]).all()
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["joint"]["components"] == ["level", "index"]
    assert "spectral.model=positive" in summary["joint"]["prior"]
    page = (tmp_path / "out" / "report.html").read_text()
    assert "component maps: level, index" in page and "is not used" in page
    assert main(["info", str(tmp_path / "out" / "posterior.nc")]) == 0
    assert "25 modes (lmax 4) at 3 frequencies" in capsys.readouterr().out


@pytest.mark.long
def test_joint_maps_of_low_frequencies_are_no_worse_than_independent_ones(tmp_path):
    """5 and 6 MHz, where absorption reddens the plane, and the errors towards the centre."""
    frequencies = [5.0, 6.0, 8.0, 12.0, 20.0, 40.0]
    scenario = load_scenario(
        "fiducial",
        ["lmax=10", "joint=true", "spectral.model=positive", f"frequencies_mhz={frequencies}"],
    )
    cube = cube_result(scenario, tmp_path)
    mean, truth, independent = (cube.stacked(n) for n in ("mean", "truth", "independent"))
    # but for the monopole, which all know well
    worse = np.linalg.norm((independent - truth)[:, 1:], axis=1)
    better = np.linalg.norm((mean - truth)[:, 1:], axis=1)
    assert (worse / better > 1.0).all()
    nside = scenario.map_nside
    lon, lat = healpy.pix2ang(nside, np.arange(healpy.nside2npix(nside)), lonlat=True)
    centre = (np.abs((lon + 180.0) % 360.0 - 180.0) < 10.0) & (np.abs(lat) < 10.0)
    for channel in cube.channels:
        z = (modes_to_map(channel.mean - channel.truth, nside) / channel.pixel_std)[centre]
        # lmax 10 resolves one or two places there: 3 sigma at most
        assert np.sqrt((z**2).mean()) < 3.0


def test_bad_input_is_refused_in_a_sentence():
    with pytest.raises(InputError, match=r"lmax 80 have 13122 unknowns.*use lmax=69"):
        lmax_of_fields(scenario_of("lmax=80"))
    assert lmax_of_fields(scenario_of("lmax=60")) == 69
