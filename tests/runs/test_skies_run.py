"""A validation on given skies: those of the prior hold, others do not; what it leaves and says."""

from __future__ import annotations

import csv
import json
from dataclasses import replace

import jax
import numpy as np
import pytest

from lusee_bayes.cli.main import main
from lusee_bayes.experiment.experiment import build, under_sky
from lusee_bayes.experiment.setup import set_up
from lusee_bayes.linear.levels import LEVELS
from lusee_bayes.results.map_result import map_result
from lusee_bayes.results.sky_coverage import SkyCoverage
from lusee_bayes.sky import FileSource, GalaxySource, write_alms
from lusee_bayes.testing import small_scenario

SIZES = {"lmax": 8, "cycles": 0.15}
SMALL = ["--set", "lmax=8", "--set", "observation.runs.0.cycles=0.15"]
FILES = ["coverage.csv", "coverage.json", "coverage.md", "provenance.json", "report.html"]


def run(*arguments):
    return main([str(argument) for argument in arguments])


def drawn(setup, path, seed):
    """A file with a sky drawn from the prior, but for its mean: antennas have to be warm."""
    sky = np.array(setup.prior.sample(jax.random.key(seed)))
    sky[0] = setup.sky.modes[0]
    return write_alms(path, sky, {})


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A run on three skies of the prior, its folder and exit code."""
    place = tmp_path_factory.mktemp("skies")
    setup = set_up(small_scenario(**SIZES))
    files = [drawn(setup, place / f"drawn_{k}.fits", 10 + k) for k in range(3)]
    folder = place / "out"
    return folder, run("validate", "fiducial", *SMALL, "--skies", *files, "-q", "-o", folder)


def test_skies_of_the_prior_hold(finished):
    folder, code = finished
    found = json.loads((folder / "coverage.json").read_text())
    assert code == 0 and found["passed"] and found["verdict"].startswith("passed: error bars hold")
    assert [sky["name"] for sky in found["skies"]] == ["drawn_0", "drawn_1", "drawn_2"]
    with (folder / "coverage.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    whole = [row for row in rows if row["name"] == "whole sky"]
    assert len(whole) == 3
    for row in whole:
        for level in LEVELS:
            name = f"{100 * level:.0f}"
            off = abs(float(row[f"held_{name}"]) - level)
            # by chance once in 10,000 for each of twelve shares
            assert off < 4.0 * float(row[f"scatter_{name}"])


def test_what_a_run_leaves(finished, capsys):
    folder, _ = finished
    names = {path.name for path in folder.iterdir() if path.is_file()}
    assert set(FILES) <= names
    assert {path.name for path in (folder / "figures").iterdir()} == {"coverage.png", "pulls.png"}
    page = (folder / "report.html").read_text()
    assert "passed: error bars hold for 3 of 3 skies" in page and "|b| &gt; 30 deg" in page
    table = (folder / "coverage.md").read_text()
    columns = {line.replace(r"\|", "").count("|") for line in table.splitlines() if "deg" in line}
    assert len(columns) == 2  # of the two tables
    (folder / "report.html").unlink()
    assert run("report", folder) == 0
    assert (folder / "report.html").read_text() == page
    assert run("info", folder) == 0
    assert "validate --skies" in capsys.readouterr().out


def test_a_sky_that_is_nothing_like_the_prior_fails(tmp_path, capsys):
    command = ["validate", "fiducial", *SMALL, "--set", "prior.scale=1e-4", "--skies"]
    assert run(*command, "smooth", "-o", tmp_path) == 1
    said = " ".join(capsys.readouterr().out.split())
    assert "smooth:1" in said and "NO" in said
    assert "FAILED: error bars hold for 0 of 1 skies" in said
    told = (tmp_path / "coverage.md").read_text()
    assert "smooth:1: error bars do not hold" in told and "too narrow" in told
    # the same skies may be mapped again, others need --force
    assert run(*command, "spotty", "-q", "-o", tmp_path) == 2
    assert "skies is smooth:1 there and spotty:1 here" in capsys.readouterr().err


@pytest.mark.long
@pytest.mark.essential
def test_skies_of_the_prior_are_covered_within_the_printed_errors(tmp_path):
    """Shares of four skies, the mean of their distances from the level in printed errors: 0 within
    1 / sqrt(4). With error bars that are 1.3 times too wide they are far from it."""
    setup = set_up(small_scenario(lmax=24, cycles=1.0))
    far = {1.0: [], 1.3: []}
    for seed in range(4):
        path = drawn(setup, tmp_path / f"{seed}.fits", seed)
        result = map_result(under_sky(setup, FileSource(path), seed))
        for factor, found in far.items():
            std, pixel_std = (factor * getattr(result.channel, k) for k in ("std", "pixel_std"))
            channel = replace(result.channel, std=std, pixel_std=pixel_std)
            sky = SkyCoverage.of("sky", replace(result, channel=channel), 300)
            parts = [part for part in sky.parts() if part.name in ("whole sky", "every ell")]
            found.append([(part.held[1] - LEVELS[1]) / part.scatter[1] for part in parts])
    right, wide = (np.mean(found, axis=0) * np.sqrt(4) for found in far.values())
    assert np.abs(right).max() < 4.0
    assert wide.min() > 4.0


def test_the_given_sky_is_in_the_data_alone():
    """Noise and data are those of the scenario with this sky; the prior is that of its own sky."""
    expected = build(small_scenario("sky.seed=4", "seed=9", **SIZES))
    found = under_sky(set_up(small_scenario(**SIZES)), GalaxySource(4, ()), seed=9)
    rounding = 1e-12 * np.abs(expected.data.data).max()
    np.testing.assert_allclose(found.data.data, expected.data.data, rtol=0, atol=rounding)
    np.testing.assert_allclose(found.setup.signal, expected.setup.signal, rtol=0, atol=rounding)
    np.testing.assert_array_equal(found.data.truth, expected.data.truth)
    usual = build(small_scenario(**SIZES)).setup.prior.variance()
    np.testing.assert_array_equal(found.setup.prior.variance(), usual)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["nothing"], "no sky 'nothing', neither a file nor a name"),
        (["embeded:2"], "did you mean 'embedded'?"),
        (["smooth:x"], "names 'smooth:x'; expected a whole number as the seed of smooth"),
        (["smooth", "smooth:1"], "names 'smooth:1' twice"),
        ([], "name at least one sky"),
        (["smooth", "--resume"], "leave out --data and --resume"),
        (["smooth", "--set", "frequencies_mhz=[10, 20]"], "--skies is for a single frequency"),
        (["smooth", "--set", "prior.tilt_std=0.1"], "something is to be sampled"),
    ],
    ids=str,
)
def test_bad_input_is_one_sentence(arguments, message, tmp_path, capsys):
    assert run("validate", "fiducial", *SMALL, "--skies", *arguments, "-o", tmp_path / "x") == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "x").exists()
