"""Sampling as a user meets it: killed, resumed, refused, its files, and its validation.

One run is killed with SIGKILL and resumed here, another is left alone; most tests look at these.
"""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import equinox as eqx
import healpy
import numpy as np
import pandas as pd
import pytest
from arviz_stats.base import array_stats
from assertions import raising, refuse
from commands import assert_drawn, content, refused, run, sets
from reference_linear import z_of

import lusee_bayes as lb
from lusee_bayes.core.files import LOCK
from lusee_bayes.core.harmonics import modes_to_map
from lusee_bayes.experiment.experiment import Experiment
from lusee_bayes.runs import sample_run
from lusee_bayes.runs.sample_run import sample_together
from lusee_bayes.sampling import datatree, hmc
from lusee_bayes.sampling.hmc import CHUNK

ROOT = Path(lb.__file__).resolve().parents[1]
OVERRIDES = ["lmax=6", "observation.runs.0.cycles=0.1"]
SMALL = ["fiducial", *sets(*OVERRIDES)]
# runs that are killed and resumed take a minute and more together
pytestmark = pytest.mark.long
# what SETTINGS make of a scenario with seed 1
SAMPLER = lb.Sampler(chains=4, warmup=100, draws=1000, seed=1)
SETTINGS = ["--chains", "4", "--warmup", "100", "--draws", "1000"]
N_MODES, NSIDE = 49, 8
GROUPS = {"posterior", "sample_stats", "observed_data", "constant_data"}
GROUPS |= {"prior", "prior_predictive", "posterior_predictive"}


def start(folder):
    """lusee-bayes sample in a process of its own, as a user starts it."""
    arguments = ["sample", *SMALL, *SETTINGS, "-q", "-o", str(folder)]
    command = [sys.executable, "-m", "lusee_bayes.cli", *arguments]
    env, pipe = os.environ | {"PYTHONPATH": str(ROOT), "MPLBACKEND": "agg"}, subprocess.PIPE
    return subprocess.Popen(command, env=env, cwd=folder.parent, stderr=pipe, text=True)


def chunks(folder) -> dict[int, Path]:
    """Files of draws by their iteration, warmup's included."""
    found = (folder / "chains").glob(hmc.CHUNK_GLOB)
    return {int(path.stem.removeprefix("chunk-")): path for path in sorted(found)}


def executioner(process, chunk):
    """A shell that kills ``process`` once the file ``chunk`` is there, whatever goes on here."""
    script = 'until [ -e "$0" ]; do sleep 0.01; done; kill -9 "$1"'
    return subprocess.Popen(["timeout", "300", "sh", "-c", script, str(chunk), str(process.pid)])


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """(whole, killed): folders of an undisturbed run and of one killed among its draws.

    The first runs in this process, with types and shapes enforced, the other in its own.
    """
    base = tmp_path_factory.mktemp("runs")
    whole, killed = base / "whole", base / "killed"
    process = start(killed)
    # three files of draws, out of forty
    killer = executioner(process, killed / "chains" / f"chunk-{SAMPLER.warmup + 3 * CHUNK:08d}.npz")
    try:
        assert run("sample", *SMALL, *SETTINGS, "-q", "-o", whole) == 0
        assert killer.wait() == 0, process.communicate()[1]
        assert process.wait() == -signal.SIGKILL, process.communicate()[1]
    finally:
        process.kill()
        killer.kill()
        process.communicate()
    return whole, killed


@pytest.fixture
def whole(runs, tmp_path):
    """A copy of the undisturbed run's folder."""
    return Path(shutil.copytree(runs[0], tmp_path / "whole"))


@pytest.fixture
def killed(runs, tmp_path):
    """A copy of the folder that the kill has left."""
    return Path(shutil.copytree(runs[1], tmp_path / "killed"))


@pytest.fixture(scope="module")
def experiment():
    """That of the runs."""
    return lb.build(lb.load_scenario("fiducial", OVERRIDES))


@pytest.fixture(scope="module")
def tree(runs):
    return datatree.read_datatree(runs[0] / "samples.nc")


@pytest.fixture
def no_sampling(runs, monkeypatch):
    """Any attempt to draw fails."""
    monkeypatch.setattr(sample_run, "sample", raising(AssertionError("it began to sample")))


def assert_same_trees(found, expected):
    """Every variable and coordinate of every group, bit by bit."""
    assert set(found.children) == set(expected.children) == GROUPS
    for name, group in expected.children.items():
        assert set(found[name].variables) == set(group.variables), name
        for variable, values in group.variables.items():
            got = found[name].variables[variable]
            assert got.dims == values.dims
            assert got.dtype == values.dtype
            np.testing.assert_array_equal(got.values, values.values, err_msg=f"{name}/{variable}")


# ---- a run that is killed


def test_a_killed_run_leaves_its_draws_and_nothing_half_made(runs):
    whole, killed = runs
    assert not (whole / "chains").exists()
    # the lock is no longer held, and the next run removes its file
    assert {path.name for path in killed.iterdir()} == {"chains", LOCK}
    done = chunks(killed)
    assert list(done) == list(range(CHUNK, max(done) + 1, CHUNK))
    assert SAMPLER.warmup + 3 * CHUNK <= max(done) < SAMPLER.warmup + SAMPLER.draws


def test_a_killed_run_resumes_to_the_draws_of_an_undisturbed_one(killed, tree, monkeypatch):
    """Bit by bit, in another process, with nothing done twice."""

    def files():
        return {i: (p.stat().st_ino, p.stat().st_mtime_ns) for i, p in chunks(killed).items()}

    before, written, untouched = files(), [], []
    append = hmc.Checkpoints.append

    def spy(checkpoints, chunk):
        written.append(chunk.iteration)
        append(checkpoints, chunk)
        untouched.append(before.items() <= files().items())

    monkeypatch.setattr(hmc.Checkpoints, "append", spy)
    assert run("sample", *SMALL, *SETTINGS, "-q", "-o", killed, "--resume") == 0
    assert written == list(range(max(before) + CHUNK, SAMPLER.warmup + SAMPLER.draws + 1, CHUNK))
    assert all(untouched)
    assert_same_trees(datatree.read_datatree(killed / "samples.nc"), tree)
    assert not (killed / "chains").exists()
    assert not list(killed.glob(".partial*"))


def test_starting_again_without_resume_is_refused_and_touches_nothing(killed, no_sampling, capsys):
    before = content(killed)
    said = refused(capsys, "sample", *SMALL, *SETTINGS, "-q", "-o", killed)
    assert f"unfinished run ({max(chunks(killed))} iterations done)" in said and "--resume" in said
    assert content(killed) == before


ANOTHER_RUN = [
    ({"sampler": replace(SAMPLER, seed=7)}, "another sampler's seed: 1, now 7"),
    ({"program": "sky_marginal"}, "another program: sky, now sky_marginal"),
    ({"digest": "0"}, "another program text: "),
    ({"nside": 4}, "another scenario: "),
    ({"factor": 1.0 + 1e-9}, "another data: "),
]


@pytest.mark.parametrize(("change", "message"), ANOTHER_RUN, ids=str)
def test_resuming_another_run_is_refused(experiment, killed, no_sampling, change, message):
    """And the difference is named."""
    program = lb.load_program(change.get("program", "sky"))
    program = replace(program, digest=change.get("digest", program.digest))
    more = [f"nside={change['nside']}"] if "nside" in change else []
    scenario = lb.load_scenario("fiducial", [*OVERRIDES, *more])
    setup, data = replace(experiment.setup, scenario=scenario), experiment.data
    data = replace(data, data=data.data * change.get("factor", 1.0))
    before = content(killed)
    given = {"": Experiment(setup, data)}, program, change.get("sampler", SAMPLER), killed
    refuse(message, sample_together, *given, resume=True)
    assert content(killed) == before


def test_resuming_a_finished_run_takes_it_over(whole, tree, no_sampling):
    before = content(whole)
    summary = pd.read_csv(whole / "summary.csv", index_col="quantity")
    assert run("sample", *SMALL, *SETTINGS, "-q", "-o", whole, "--resume") == 0
    assert_same_trees(datatree.read_datatree(whole / "samples.nc"), tree)
    assert set(content(whole)) == set(before)
    # draws that lie in memory in another order are summed in another order
    again = pd.read_csv(whole / "summary.csv", index_col="quantity")
    pd.testing.assert_frame_equal(again, summary, check_exact=False, rtol=1e-6)
    assert not (whole / "chains").exists()


@pytest.mark.parametrize("change", [{"draws": 500}, {"draws": 2000}, {"seed": 7}], ids=str)
def test_a_finished_run_of_other_settings_is_not_taken_over(experiment, whole, no_sampling, change):
    before, other = content(whole), replace(SAMPLER, **change)
    given = {"": experiment}, lb.load_program("sky"), other, whole
    refuse("finished run.*other settings.*--force", sample_together, *given, resume=True)
    refuse("sampler's .* was .*, now", lb.run_sample, experiment.scenario, whole, sampler=other)
    assert content(whole) == before


# ---- the files


def test_sample_writes_what_it_promises(runs):
    whole = runs[0]
    files = "samples.nc summary.csv map.fits scenario.yaml sampling.json report.html figures "
    files += "manifest.json provenance.json"
    assert {p.name for p in whole.iterdir()} == set(files.split())
    figures = {"uncertainty", "traces", "ranks", "pairs"}
    drawn = list((whole / "figures").iterdir())
    assert {re.sub("uncertainty_[1-4]_.*", "uncertainty", p.stem) for p in drawn} == figures
    assert_drawn(*drawn)
    assert lb.load_scenario(whole / "scenario.yaml") == lb.load_scenario("fiducial", OVERRIDES)


def test_the_maps_are_those_of_the_draws(runs, tree):
    """Mean, standard deviation and central 90 % of every pixel, by healpy and numpy."""
    skies = tree["posterior"]["sky"].values.reshape(-1, N_MODES)
    assert len(skies) == SAMPLER.chains * SAMPLER.draws
    columns, header = healpy.read_map(runs[0] / "map.fits", field=None, dtype=np.float64, h=True)
    mean, std, _, lower, upper = columns
    values = skies @ np.stack([modes_to_map(mode, NSIDE) for mode in np.eye(N_MODES)])
    # rounding of sums of 49 terms that cancel in part
    np.testing.assert_allclose(mean, values.mean(0), rtol=1e-9)
    np.testing.assert_allclose(std, values.std(0, ddof=1), rtol=1e-8)
    low, high = np.quantile(values, [0.05, 0.95], axis=0)
    np.testing.assert_allclose(lower, low, rtol=1e-8)
    np.testing.assert_allclose(upper, high, rtol=1e-8)
    header = dict(header)
    assert (header["COORDSYS"], header["ORDERING"], header["TUNIT1"]) == ("G", "RING", "K")


def test_the_samples_hold_the_analytic_posterior_and_what_they_are(runs, tree, experiment, capsys):
    data, posterior = experiment.data, lb.infer(experiment).posterior
    constants = tree["constant_data"]
    np.testing.assert_array_equal(constants["analytic_mean"], posterior.mean)
    np.testing.assert_array_equal(constants["analytic_std"], posterior.std())
    np.testing.assert_array_equal(constants["truth"], data.truth)
    np.testing.assert_array_equal(tree["observed_data"]["data"], data.data)
    assert tree.attrs["program"] == "sky"
    assert tree.attrs["scenario"] == experiment.scenario.to_yaml()
    assert run("info", runs[0] / "samples.nc") == 0
    assert "4 x 1000 draws from the program sky at 25 MHz" in capsys.readouterr().out


def test_the_summary_tells_of_landmarks_powers_and_lowest_modes(runs, tree):
    table = pd.read_csv(runs[0] / "summary.csv", index_col="quantity")
    skies = tree["posterior"]["sky"].values
    names = ["Galactic centre", "anticentre", "north Galactic pole", "south Galactic pole"]
    # a map so fine that its own interpolation is good to 1e-4 of a smooth sky
    fine = modes_to_map(skies.mean((0, 1)), 128)
    places = [0.0, 180.0, 0.0, 0.0], [0.0, 0.0, 90.0, -90.0]
    there = healpy.get_interp_val(fine, *places, lonlat=True)
    found = table.loc[[f"T({name}) [K]" for name in names], "mean"]
    np.testing.assert_allclose(found, there, rtol=1e-3)
    for ell in (0, 1, 2, 5, 6):
        powers = (skies[..., ell**2 : (ell + 1) ** 2] ** 2).mean(-1)
        row = table.loc[f"C_{ell} [K2]"]
        assert row["mean"] == pytest.approx(powers.mean(), rel=1e-10)
        assert row["sd"] == pytest.approx(powers.std(), rel=1e-3)
    assert len(table) == 4 + 5 + 9
    assert (table["r_hat"] < 1.02).all()
    assert table["ess_bulk"].min() > 100 * SAMPLER.chains


def test_sampling_json_tells_of_the_very_run(runs, tree):
    figures = json.loads((runs[0] / "sampling.json").read_text())
    statistics = tree["sample_stats"]
    assert (figures["program"], figures["chains"], figures["draws"]) == ("sky", 4, 1000)
    assert figures["divergences"] == int(statistics["diverging"].sum()) == 0
    assert figures["step_size"] == statistics["step_size"].values[:, -1].tolist()
    assert figures["mean_steps"] == pytest.approx(statistics["n_steps"].values.mean())
    assert figures["mean_acceptance"] == pytest.approx(statistics["acceptance_rate"].values.mean())
    # speed times the sampling's time is no more than all gradients but the first file's
    drawn = statistics["n_steps"].values[:, CHUNK:].sum()
    assert 0 < drawn / figures["steps_per_second"] < figures["seconds"]["sampling"]
    assert set(figures["seconds"]) >= {"posterior", "sampling", "data tree", "figures"}
    assert {"lusee_bayes", "jax", "numpyro", "arviz-stats"} <= set(figures["versions"])


# data tell nothing of its two sites
PLATED = """
import numpyro, lusee_bayes as lb
def model(coupling, offset, prior, noise, data=None):
    with numpyro.plate("two", 2):
        numpyro.sample("x", numpyro.distributions.Normal())
    gaussian = lb.LinearGaussian(coupling, prior, noise, offset)
    numpyro.sample("data", lb.Marginal(gaussian), obs=data)
    return gaussian
"""


@pytest.mark.parametrize("program", ["sky_marginal", "prior_amplitude", "plated"])
def test_programs_without_the_sky_get_their_maps_too(program, tmp_path, write):
    out = tmp_path / "out"
    given = write(PLATED, "plated.py") if program == "plated" else program
    arguments = ["--model", given, "--draws", "150", "--warmup", "100", "--chains", "2"]
    assert run("sample", *SMALL, *arguments, "-q", "-o", out) == 0
    tree = datatree.read_datatree(out / "samples.nc")
    assert set(tree.children) == GROUPS
    others = set(tree["posterior"].data_vars) - {"sky"}
    expected = {"sky_marginal": {"noise_level"}, "prior_amplitude": {"amplitude", "tilt"}}
    expected["plated"] = {"x"}
    assert others == expected[program]
    table = pd.read_csv(out / "summary.csv", index_col="quantity")
    if program == "plated":
        np.testing.assert_allclose(table.loc[["x[0]", "x[1]"], "sd"], 1.0, atol=0.3)
    else:
        assert expected[program] <= set(table.index)
    skies = tree["posterior"]["sky"].values.reshape(-1, N_MODES)
    mean = healpy.read_map(out / "map.fits", dtype=np.float64)
    np.testing.assert_allclose(mean, modes_to_map(skies.mean(0), NSIDE), rtol=1e-9)
    # the truth within six posterior deviations in every mode
    assert np.abs((skies.mean(0) - tree["constant_data"]["truth"].values) / skies.std(0)).max() < 6


# ---- validation of the same draws


@pytest.fixture(scope="module")
def validated(runs, tmp_path_factory):
    """(exit code, folder): the undisturbed run judged, with a hundred simulations."""
    folder = Path(shutil.copytree(runs[0], tmp_path_factory.mktemp("validated") / "out"))
    arguments = [*SMALL, *SETTINGS, "--simulations", "100", "-q", "-o", folder, "--resume"]
    return run("validate", *arguments), folder


def test_validation_of_the_true_posterior_passes(validated):
    code, folder = validated
    report = json.loads((folder / "validation.json").read_text())
    assert report["passed"], [c for c in report["checks"] if not c["passed"]]
    assert code == 0
    assert_drawn(*(folder / "figures" / f"{name}.png" for name in ("comparison", "calibration")))


def consistent(folder):
    """validation.json, once it and validation.md are found to say the same."""
    report = json.loads((folder / "validation.json").read_text())
    lines = (folder / "validation.md").read_text().splitlines()
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines if "|" in line]
    said = {row[0]: row[3] for row in rows if len(row) == 5}
    assert len(report["checks"]) >= 10
    for check in report["checks"]:
        lower = -np.inf if check["lower"] is None else check["lower"]
        upper = np.inf if check["upper"] is None else check["upper"]
        assert check["passed"] == (lower <= check["value"] <= upper)
        assert said[check["name"]] == ("ok" if check["passed"] else "**failed**")
    assert report["passed"] == all(check["passed"] for check in report["checks"])
    return report


def test_validation_json_and_md_agree_with_each_other_and_the_draws(validated, tree):
    _, folder = validated
    report = consistent(folder)
    skies, constants = tree["posterior"]["sky"].values, tree["constant_data"]
    scaled = (skies - constants["analytic_mean"].values) / constants["analytic_std"].values
    ratio = report["modes"]["variance_ratio"]
    np.testing.assert_allclose(ratio, (scaled**2).mean((0, 1)), rtol=1e-9)
    ess = array_stats.ess(scaled, chain_axis=0, draw_axis=1, method="mean")
    expected = scaled.mean((0, 1)) * np.sqrt(ess)
    # ESS by the same library: rounding, of numbers that may be near zero
    np.testing.assert_allclose(report["modes"]["mean_z"], expected, rtol=1e-6, atol=1e-6)
    values = {check["name"]: check["value"] for check in report["checks"]}
    assert abs(values["mean"]) == pytest.approx(np.abs(expected).max(), rel=1e-6)
    assert values["divergences"] == tree["sample_stats"]["diverging"].values.sum()
    assert values["calibration"] == pytest.approx(min(report["p_values"].values()))
    assert len(report["modes"]["eigenvalues"]) == N_MODES
    for levels in report["coverage"].values():
        for level, share in levels.items():
            # binomial of 100 simulations; about a hundred shares
            error = np.sqrt(float(level) * (1 - float(level)) / 100)
            assert abs(share - float(level)) < 1.1 * z_of(100) * error


def test_half_the_covariance_is_found_out_with_exit_code_1(validated, tmp_path, monkeypatch):
    folder = Path(shutil.copytree(validated[1], tmp_path / "out"))

    def with_half_the_covariance(*args, **options):
        (found,) = sample_together(*args, **options)
        posterior = found.inference.posterior
        half = eqx.tree_at(lambda p: p.lower, posterior, np.sqrt(2) * posterior.lower)
        np.testing.assert_allclose(half.covariance() / posterior.covariance(), 0.5, rtol=1e-6)
        solution = replace(found.inference.solution, posterior=half)
        return (replace(found, inference=replace(found.inference, solution=solution)),)

    monkeypatch.setattr(sample_run, "sample_together", with_half_the_covariance)
    arguments = [*SMALL, *SETTINGS, "--simulations", "100", "-q", "-o", folder, "--resume"]
    assert run("validate", *arguments) == 1
    report = consistent(folder)
    assert not report["passed"]
    failed = {check["name"] for check in report["checks"] if not check["passed"]}
    # every variance is off by a factor of two; deviations of the means grow by the root of that,
    # which may or may not be seen; nothing else knows of the covariance
    assert {"variance", "covariance, largest"} <= failed
    assert all(name.startswith(("variance", "covariance", "mean")) for name in failed)
    before = json.loads((validated[1] / "validation.json").read_text())
    ratios = [np.array(one["modes"]["variance_ratio"]) for one in (report, before)]
    np.testing.assert_allclose(ratios[0], 2 * ratios[1], rtol=1e-6)
