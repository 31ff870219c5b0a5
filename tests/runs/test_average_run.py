"""Averages of a file, and what they cost: as a user meets them, and against closed forms."""

import numpy as np
import pytest
from assertions import refuse
from commands import refused, run
from experiments import flagged
from tables import tables

import lusee_bayes as lb
from lusee_bayes.cli.options import parse_duration
from lusee_bayes.experiment.experiment import doubts
from lusee_bayes.instrument.averaging import averaged
from lusee_bayes.instrument.visibilities import read_visibilities
from lusee_bayes.testing import small_scenario

TABLES = tables(__file__)

LMAX = 5
MEANS = ("observation.window=mean", "observation.step_s=1800")


def scenario(*more):
    return small_scenario(*MEANS, *more, lmax=LMAX, cycles=0.03)


@pytest.fixture(scope="module")
def data():
    """39 samples of half an hour."""
    return lb.build(scenario()).data


@pytest.fixture
def path(data, tmp_path):
    return data.write(tmp_path / "data.nc")


def test_what_is_lost_is_small_and_grows_with_the_square_of_the_length(path, tmp_path):
    """The signal within a window is lost: a twelfth of its length squared, times the slopes."""
    lost = []
    for hours in (2, 4):
        made = lb.run_average(scenario(), path, 3600.0 * hours, tmp_path / f"{hours}.nc")
        fine, coarse = made.bits
        assert 0.0 < fine - coarse < 0.01 * fine
        lost.append((fine - coarse) / (hours**2 - 0.5**2))
        assert made.lost_share == pytest.approx(0.0, abs=1e-12)
    # higher orders are a few per cent over 4 h at this lmax
    assert lost[1] == pytest.approx(lost[0], rel=0.1)


def test_the_command_writes_averages_and_says_what_they_cost(path, tmp_path, capsys):
    out, given = tmp_path / "averaged.nc", ["--set", f"lmax={LMAX}"]
    assert run("average", path, "--to", "2h", "-o", out, *given) == 0
    said = capsys.readouterr().out
    assert "39 samples of 1800 s -> 10 of 7200 s" in said
    assert "live time lost where products have different flags: 0.00%" in said
    assert "information about the map: " in said and " lost" in said
    assert f"160 visibilities -> {out}" in said
    found = read_visibilities(out)
    assert found.digest() == averaged(read_visibilities(path), 7200.0).digest()
    there = refused(capsys, "average", path, "--to", "4h", "-o", out, *given)
    assert "exists already; remove it, give another name, or --force" in there
    long, again = tmp_path / "long.nc", tmp_path / "again.nc"
    assert "days" in refused(capsys, "average", path, "--to", "1e9d", "-o", long, *given)
    assert not long.exists()
    command = ["average", path, "-o", again, "--no-information", "--to"]
    assert run(*command, "120min") == 0
    assert "information" not in capsys.readouterr().out
    assert read_visibilities(again).digest() == found.digest()
    assert read_visibilities(out).digest() == found.digest()
    assert run(*command, "4h", "--force") == 0
    assert read_visibilities(again).digest() != found.digest()


def test_what_flags_cost_is_said(data, tmp_path):
    """A product that is there in one sample of four is lost; samples without any do not count."""
    flags = np.zeros((16, data.layout.n_times), dtype=bool)
    flags[3] = np.arange(data.layout.n_times) % 4 != 0
    flags[:, -3:] = True
    less, out = flagged(data, flags).write(tmp_path / "d.nc"), tmp_path / "a.nc"
    made = lb.run_average(scenario(), less, 7200.0, out, information=False)
    assert made.bits is None
    assert made.lost_share == pytest.approx(9 / (15 * 36 + 9))
    assert made.lines()[1] == "live time lost where products have different flags: 1.64%"


def test_average_s_of_the_scenario_does_not_count(path, data, tmp_path):
    given = scenario("observation.average_s=3600")
    refuse("simulate a file", lb.run_map, given, tmp_path / "map")
    made = lb.run_average(given, path, 7200.0, tmp_path / "a.nc", information=False)
    assert made.data.observation.n_times == data.observation.n_times


def test_gains_that_drift_within_samples_are_doubted(data):
    """Means over half an hour; the gains are steady for a quarter of their correlation time."""
    for hours, drift in ((1, True), (3, False)):
        experiment = lb.build(scenario(f"noise.gain={{sigma: 1e-4, correlation_h: {hours}}}"), data)
        assert drift == any("Gains drift" in x for x in doubts(experiment, lb.infer(experiment)))


@pytest.mark.parametrize(("arguments", "words"), TABLES["bad input"])
def test_bad_input_is_a_sentence(path, tmp_path, monkeypatch, capsys, arguments, words):
    monkeypatch.chdir(tmp_path)
    assert words in refused(capsys, "average", path, *arguments)
    assert [p.name for p in tmp_path.iterdir()] == ["data.nc"]


def test_lengths_of_time():
    lengths = {"30s": 30.0, "10min": 600.0, "2h": 7200.0, "1d": 86400.0, " 1.5 h": 5400.0}
    for text, seconds in (lengths | {".5min": 30.0, "1e3s": 1000.0}).items():
        assert parse_duration(text) == seconds
    for text in ("", "h", "2", "0s", "-2h", "2 hours", "1e999d", "nan s", "٣s", "2h 30min"):
        with pytest.raises(lb.InputError, match="is not a duration; .* 30s, 10min, 2h or 1d"):
            parse_duration(text)
