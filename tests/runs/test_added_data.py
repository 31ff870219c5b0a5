"""Data that are added to those of an earlier run: the map is that of all of them."""

import re
from dataclasses import replace

import numpy as np
import pytest
from assertions import assert_same_map
from commands import posterior_of, refused, run
from experiments import channels_of, of_run

import lusee_bayes as lb
from lusee_bayes.results.finished_runs import information_file, read_information
from lusee_bayes.runs import map_run
from lusee_bayes.systematics import above_lmax

# N of the parts is that of the whole: about the model, and not about each one's data
SIZES = ["lmax=4", "observation.runs=[{cycles: 0.1}, {cycles: 0.1, turntable_deg: 30}]"]
SIZES += ["noise.radiometer.temperature=model", "output.information=true"]
GIVEN, LEARNED = "prior={model: isotropic, spectrum: sky}", "prior={model: isotropic}"
ABOVE, CUBE = "noise.above_lmax={margin: 8, least_lmax: 0}", "frequencies_mhz=[20, 25, 30]"
JOINT = ["joint=true", "spectral.components=[power_law]"]


pytestmark = pytest.mark.usefixtures("numbers_alone")


def in_parts(scenario, folder):
    """The run of all data, that of the first part, and that of the second added to the first."""
    whole = channels_of(scenario)
    if scenario.noise.above_lmax is not None:  # a truth that ends at lmax says that the sky does
        whole = [replace(data, truth=None) for data in whole]
    first, second = ([of_run(data, k) for data in whole] for k in (0, 1))
    earlier = {"whole": None, "first": None, "both": folder / "first"}
    return [
        lb.run_map(scenario, folder / name, data=data, truth=True, earlier=earlier[name]).result
        for name, data in (("whole", whole), ("first", first), ("both", second))
    ]


# means are known to 1e-6 standard deviations, and the sum loses a digit (test_information.py)
SIGMA, EVIDENCE = 1e-4, 1e-3


MAPS = [
    pytest.param([GIVEN], id="map", marks=pytest.mark.long),
    pytest.param([GIVEN, ABOVE], id="sky above lmax"),
    pytest.param([LEARNED], id="learned map"),
    pytest.param([CUBE, GIVEN], id="independent", marks=pytest.mark.long),
    pytest.param([CUBE, LEARNED], id="learned", marks=pytest.mark.long),
    pytest.param([CUBE, *JOINT], id="joint", marks=pytest.mark.essential),
]


@pytest.mark.parametrize("kind", MAPS)
def test_a_map_is_that_of_all_data(kind, tmp_path, exact_tilt, monkeypatch):
    """A prior that is learned is learned anew, from all of them."""
    monkeypatch.setattr(above_lmax, "LEFT_OUT", 1e-9)
    scenario = lb.load_scenario("fiducial", [*SIZES, *kind])
    whole, first, both = in_parts(scenario, tmp_path)
    joint = "joint=true" in kind
    for here, there, alone in zip(both.channels, whole.channels, first.channels, strict=True):
        assert_same_map(here, there, SIGMA)
        # the first part alone would be seen
        assert (np.abs(alone.mean - there.mean) / there.std).max() > 0.5
        # residuals are those of the new data, or of one posterior of all data
        assert here.n_data == there.n_data - (0 if joint else alone.n_data)
        if joint:
            assert (np.abs(here.independent - there.independent) / there.std).max() < SIGMA
    assert both.log_evidence == pytest.approx(whole.log_evidence, abs=EVIDENCE)
    assert both.fit.level == whole.fit.level == "consistent"
    if kind == [LEARNED]:
        for here, there in zip(both.channel.parameters, whole.channel.parameters, strict=True):
            assert here["value"] == pytest.approx(there["value"], abs=1e-3 * there["std"])
        assert both.channel.parameters != first.channel.parameters
    # the prior is judged by all data
    here, there = (r.channel.judged.prior if r.single else r.fits().prior for r in (both, whole))
    assert here.chi2 == pytest.approx(there.chi2, rel=1e-3)
    assert here.degrees == pytest.approx(there.degrees, rel=1e-3)
    if joint:
        for one, other in zip(both.fits().channels, whole.fits().channels, strict=True):
            assert one.chi2 == pytest.approx(other.chi2, rel=1e-4)
    # and it can go on
    for channel in scenario.channels() or (scenario,):
        kept = read_information(information_file(tmp_path / "both"), channel)
        assert len(kept.digests) == 2
        assert kept.information.n_data == 2 * first.channels[0].n_data


@pytest.mark.essential
def test_a_stopped_run_does_not_go_on_with_other_earlier_data(tmp_path):
    """The folder is the same, its content is not."""
    scenario = lb.load_scenario("fiducial", [*SIZES, "frequencies_mhz=[20, 25]"])
    first, second = ([of_run(data, k) for data in channels_of(scenario)] for k in (0, 1))
    lb.run_map(scenario, tmp_path / "a", data=first)
    with pytest.MonkeyPatch.context() as patch:
        # the channels' files stay, as if the run had been stopped
        patch.setattr(map_run, "MAP", replace(map_run.MAP, unfinished=""))
        lb.run_map(scenario, tmp_path / "b", data=second, earlier=tmp_path / "a")
    other = [replace(data, data=1.01 * data.data) for data in first]
    lb.run_map(scenario, tmp_path / "a", data=other, replace=True)
    given = {"data": second, "earlier": tmp_path / "a"}
    found = lb.run_map(scenario, tmp_path / "b", replace=True, **given).result
    expected = lb.run_map(scenario, tmp_path / "c", **given).result
    for here, there in zip(found.channels, expected.channels, strict=True):
        np.testing.assert_array_equal(here.mean, there.mean)


SMALL = ("--set", "lmax=5", "--set", "observation.runs.0.cycles=0.1")


def test_from_the_command_line(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    second = ("--set", "observation.start=2027-02-15", "--set", "seed=2")
    assert run("simulate", "fiducial", *SMALL, "-o", "a.nc", "-q") == 0
    assert run("simulate", "fiducial", *SMALL, *second, "-o", "b.nc", "-q") == 0
    during = ("--set", "observation.start=2027-01-16", "--set", "seed=3")
    assert run("simulate", "fiducial", *SMALL, *during, "-o", "c.nc", "-q") == 0
    mapped = ("map", "fiducial", *SMALL, "-q")
    assert run(*mapped, "--data", "a.nc", "--information", "-o", "first") == 0
    assert run(*mapped, "--data", "b.nc", *("--add", "first", "--information", "-o", "both")) == 0
    assert run(*mapped, "--data", "a.nc", "-o", "plain") == 0
    assert run(*mapped, "--data", "c.nc", "--add", "both", "-o", "twice") == 0
    said = [(tmp_path / name / "summary.json").read_text() for name in ("both", "twice")]
    assert "overlap in time" not in said[0]
    assert "overlap in time with earlier ones (2027-01-15" in said[1]
    scenario = lb.load_scenario("fiducial", list(SMALL[1::2]))
    files = (information_file(tmp_path / name) for name in ("both", "first"))
    saved, before = (read_information(file, scenario) for file in files)
    assert len(saved.digests) == 2 and saved.digests[0] == before.digests[0]
    first, both = (posterior_of(tmp_path / name) for name in ("first", "both"))
    assert (both["std"].values <= first["std"].values * (1 + 1e-12)).all()
    prior = lb.build(scenario).setup.prior
    bits = [float(one.information.posterior(prior).information_bits()) for one in (saved, before)]
    assert bits[0] > bits[1] + 10
    for arguments, message in (
        (("--data", "b.nc", "--add", "both"), "already includes these data; give only new ones"),
        (("--add", "none"), "no posterior of lusee-bayes map --information at"),
        (("--add", "plain"), "lacks the information of its data; make that map again"),
        (("--add", "both", "--set", "frequency_mhz=10"), "is for 25 MHz, the scenario for 10 MHz"),
        (("--add", "both", "--set", "lmax=4"), "has lmax = 5, the scenario lmax = 4; use"),
        (("--add", "both", "--frequencies", "10,20"), "no channel .*: 10 MHz: .* is for 25 MHz"),
    ):
        assert re.search(message, refused(capsys, *mapped, *arguments, "-o", "third"))
    assert not (tmp_path / "third").exists()
