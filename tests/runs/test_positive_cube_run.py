"""Joint runs with positive skies, from the command line to the files."""

import json

import numpy as np
import pytest
import xarray as xr

from lusee_bayes.cli.main import main
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.harmonics import n_modes
from lusee_bayes.experiment.scenario import load_scenario
from lusee_bayes.results.positive_components import lmax_of_fields, positive_skies

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


def test_bad_input_is_refused_in_a_sentence():
    with pytest.raises(InputError, match="positive skies are solved for directly"):
        scenario_of("spectral.solver=conjugate_gradients")
    with pytest.raises(InputError, match="2 fields of the logarithm need at least as many chan"):
        scenario_of(frequencies="[10]")
    with pytest.raises(InputError, match="spectral.fields"):
        scenario_of("spectral.fields=[levle]")
    with pytest.raises(InputError, match=r"lmax 80 have 13122 unknowns.*use lmax=69"):
        lmax_of_fields(scenario_of("lmax=80"))
    assert lmax_of_fields(scenario_of("lmax=60")) == 69
