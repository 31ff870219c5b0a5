"""Finished runs side by side."""

import json

import jax
import numpy as np
import pytest
from astropy.io import fits
from commands import assert_drawn, refused, run, table_of

import lusee_bayes as lb
from lusee_bayes.core.harmonics import modes_to_map
from lusee_bayes.experiment.model import set_up
from lusee_bayes.experiment.sky_sections import IsotropicPriorSection, LocalScalesPriorSection
from lusee_bayes.sky.sky_source import write_alms
from lusee_bayes.testing import small_scenario

pytestmark = pytest.mark.long
SMALL = ["lmax=4", "observation.runs.0.cycles=0.1"]


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Data with gain drifts, mapped with the gain term and without; and those of another seed."""
    folder = tmp_path_factory.mktemp("runs")
    data = folder / "data.nc"
    lb.run_simulate(lb.load_scenario("gain_1e-2", SMALL), data)
    for name in ("gain_1e-2", "fiducial"):
        lb.run_map(lb.load_scenario(name, SMALL), folder / name, data=data)
    lb.run_map(lb.load_scenario("fiducial", [*SMALL, "seed=5"]), folder / "other")
    return folder


def test_the_right_model_wins(runs, tmp_path, capsys):
    out = tmp_path / "out"
    assert run("compare", runs / "fiducial", runs / "gain_1e-2", "-o", out) == 0
    told = capsys.readouterr().out
    assert "look at" in told and "Do not compare the evidences" not in told
    rows = {row["run"]: row for row in table_of(out / "comparison.csv")}
    for name, row in rows.items():
        summary = json.loads((runs / name / "summary.json").read_text())
        assert float(row["log_evidence"]) == summary["log_evidence"]
        assert float(row["instrument_p"]) == summary["channels"][0]["instrument"]["p"]
    assert float(rows["gain_1e-2"]["log_evidence_less_best"]) == 0.0
    difference = float(rows["fiducial"]["log_evidence"]) - float(rows["gain_1e-2"]["log_evidence"])
    assert float(rows["fiducial"]["log_evidence_less_best"]) == difference < -100.0
    page = (out / "comparison.html").read_text()
    assert "All runs map the same data" in page and "gain_1e-2" in page
    assert page.count("a library call") == page.count("with its true sky") == 2
    assert page.count("data:image/png;base64,") == 2 * 2 + 3 and "://" not in page
    assert_drawn(*(out / "figures").iterdir())


PRIORS = {"sky": IsotropicPriorSection(spectrum="sky"), "local": LocalScalesPriorSection()}


@pytest.mark.parametrize("best", PRIORS)
def test_data_of_a_prior_prefer_it(best, tmp_path):
    """A sky drawn from a prior; its mean is the model's, since antennas are warm. Errors and
    coverage are those of the files of the maps."""
    sizes = {"lmax": 8, "cycles": 0.15}
    setup = set_up(small_scenario(**sizes)).with_prior(PRIORS[best])
    sky = np.array(setup.prior.sample(jax.random.key(11)))
    sky[0] = setup.sky.modes[0]
    path = write_alms(tmp_path / "sky.fits", sky, {})
    drawn = small_scenario(f"sky={{model: file, file: {path}}}", "sky.sources=null", **sizes)
    for name, prior in PRIORS.items():
        lb.run_map(drawn.model_copy(update={"prior": prior}), tmp_path / name)
    lb.run_compare([tmp_path / name for name in PRIORS], tmp_path / "out")
    rows = {row["run"]: row for row in table_of(tmp_path / "out" / "comparison.csv")}
    assert max(rows, key=lambda name: float(rows[name]["log_evidence"])) == best
    for name, row in rows.items():
        (channel,) = json.loads((tmp_path / name / "summary.json").read_text())["channels"]
        learned = channel["log_evidence_learned"]
        assert (learned is None) == (name == "sky")
        assert float(row["log_evidence"]) == (learned or channel["log_evidence"])
        with fits.open(tmp_path / name / "map.fits") as hdus:
            mean, std = (np.ravel(hdus[1].data[column]) for column in ("MEAN", "STD"))
        error = mean - modes_to_map(sky, round(np.sqrt(len(mean) / 12)))
        # files have single precision
        assert float(row["rms_error_k"]) == pytest.approx(np.sqrt((error**2).mean()), rel=1e-4)
        pulls = np.abs(error / std)
        assert float(row["held_68"]) == pytest.approx((pulls < 0.9945).mean(), abs=2e-3)
        assert float(row["largest_pull"]) == pytest.approx(pulls.max(), rel=1e-3)


def test_different_data_are_told_apart(runs, tmp_path, capsys):
    assert run("compare", runs / "fiducial", runs / "other", "-o", tmp_path / "out") == 0
    told = " ".join(capsys.readouterr().out.split())
    assert "Do not compare the evidences" in told and "different values at the same times" in told


def test_what_cannot_be_compared(runs, small_cube, tmp_path, capsys, numbers_alone):
    for folders, message in (
        ([runs / "fiducial", small_cube.folder], "'cube' has several frequencies"),
        ([runs / "fiducial"], "give at least two folders to compare, got 1"),
        ([runs / "fiducial", tmp_path], "has no summary.json"),
        ([runs / "fiducial", runs / "fiducial"], "two of the folders are named 'fiducial'"),
    ):
        assert message in refused(capsys, "compare", *folders, "-o", tmp_path / "out")
    assert not (tmp_path / "out").exists()
