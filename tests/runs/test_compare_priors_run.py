"""One data set under several priors: which it prefers, what the run leaves, and bad input."""

import json

import jax
import numpy as np
import pytest
from commands import run, table_of
from experiments import mapped

import lusee_bayes as lb
from lusee_bayes.experiment.model import set_up
from lusee_bayes.experiment.rounds import NAMED
from lusee_bayes.sky.sky_source import write_alms
from lusee_bayes.testing import small_scenario

SIZES = {"lmax": 8, "cycles": 0.15}
SMALL = ["--set", "lmax=8", "--set", "observation.runs.0.cycles=0.15"]
PRIORS = list(NAMED)
RECORDS = {"provenance.json", "report.html", "scenario.yaml", "manifest.json"}
FILES = {"priors.csv", "priors.json", "priors.md", *RECORDS}


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    folder = tmp_path_factory.mktemp("priors") / "out"
    assert run("compare-priors", "fiducial", *SMALL, "-q", "-o", folder) == 0
    return folder


@pytest.mark.essential
def test_what_a_run_leaves(finished, capsys):
    assert {path.name for path in finished.iterdir() if path.is_file()} == FILES
    found = json.loads((finished / "priors.json").read_text())
    assert [one["name"] for one in found["priors"]] == PRIORS
    best = max(found["priors"], key=lambda one: one["log_evidence"])
    assert found["best"] == best["name"] and best["name"] in found["verdict"]
    for row, one in zip(table_of(finished / "priors.csv"), found["priors"], strict=True):
        assert row["prior"] == one["name"]
        assert float(row["log_evidence"]) == one["log_evidence"]
        assert float(row["day_log_density"]) == one["held_out"][1]["log_density"]
    page = (finished / "report.html").read_text()
    assert found["verdict"] in page and "68% coverage, |b| &gt; 30 deg" in page
    assert found["verdict"] in (finished / "priors.md").read_text()
    (finished / "report.html").unlink()
    assert run("report", finished) == 0
    assert (finished / "report.html").read_text() == page
    assert run("info", finished) == 0
    assert found["verdict"] in capsys.readouterr().out


@pytest.mark.essential
def test_it_is_what_separate_maps_find(finished):
    """Each in a scenario of its own, from the simulation to the map."""
    found = json.loads((finished / "priors.json").read_text())["priors"]
    for one in found[:2]:  # learned, and given
        scenario = small_scenario(**SIZES).model_copy(update={"prior": NAMED[one["name"]]})
        experiment = lb.build(scenario)
        _, channel = mapped(experiment)
        learned = experiment.learned
        expected = channel.log_evidence if learned is None else learned.log_evidence
        # the reference sky of the quadratic form differs: rounding of sums of 1e10
        assert one["log_evidence"] == pytest.approx(expected, abs=1e-3)
        assert [row["name"] for row in one["coverage"]] == [c.name for c in channel.coverage]
        for row, other in zip(one["coverage"], channel.coverage, strict=True):
            assert row["rms"] == pytest.approx(other.rms, rel=1e-3)


@pytest.mark.parametrize("name", ["isotropic-sky", "local_scales"])
@pytest.mark.long
def test_data_of_a_prior_prefer_it(name, tmp_path):
    """A sky drawn from a prior; its mean is the model's, since antennas are warm."""
    setup = set_up(small_scenario(**SIZES)).with_prior(NAMED[name])
    sky = np.array(setup.prior.sample(jax.random.key(11)))
    sky[0] = setup.sky.modes[0]
    path = write_alms(tmp_path / "sky.fits", sky, {})
    drawn = small_scenario(f"sky={{model: file, file: {path}}}", "sky.sources=null", **SIZES)
    two = ["isotropic-sky", "local_scales"]
    result = lb.run_compare_priors(drawn, tmp_path / "out", two).result
    assert result.best.name == name
    assert f"The data prefer {name}" in result.headline()
    if name == "local_scales":  # it has seen what it predicts, with parameters enough to gain by it
        products = {one.name: one.held_out[0].log_density for one in result.priors}
        assert max(products, key=products.get) == name
