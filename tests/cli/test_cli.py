"""The commands as a user meets them: files, figures, exit codes, messages."""

import contextlib
import errno
import hashlib
import json
import shutil
import signal
from dataclasses import replace
from pathlib import Path

import healpy
import jax
import matplotlib.image
import numpy as np
import pytest
import xarray as xr
from astropy.io import fits
from commands import content, posterior_of, refused, run, sky_draws_of, table_of

import lusee_bayes
from lusee_bayes.cli.options import ScenarioOptions
from lusee_bayes.core.harmonics import from_healpy, modes_to_map, pixel_matrix
from lusee_bayes.experiment.scenario import OutputSection
from lusee_bayes.results.map_result import MapResult
from lusee_bayes.runs import map_run as runs
from lusee_bayes.runs.folder import Output

SMALL = ["--set", "lmax=6", "--set", "observation.runs.0.cycles=0.1"]


@pytest.fixture(scope="module")
def folder(small_map):
    """Of a finished map run, shared: to be read."""
    return small_map.folder


def test_map_writes_what_it_promises(folder):
    assert {p.name for p in folder.iterdir()} == {
        "posterior.nc", "mean.fits", "mean_alm.fits", "std.fits", "truth.fits", "residual.fits",
        "spectra.csv", "summary.json", "scenario.yaml", "diagnostics.nc", "report.html", "figures",
        "manifest.json", "provenance.json",
    }  # fmt: skip
    for figure in ("maps", "data_vector", "beams", "fidelity", "spectra", "draws", "residuals"):
        image = matplotlib.image.imread(folder / "figures" / f"{figure}.png")
        assert image.std() > 0.01  # not blank


def test_the_files_agree_with_each_other(folder):
    posterior = posterior_of(folder)
    mean, std = posterior["mean"].values[0], posterior["std"].values[0]
    ell, m = posterior["ell"].values, posterior["m"].values
    np.testing.assert_array_equal(ell**2 + ell + m, np.arange(81))
    covariance = posterior["covariance"].values[0]
    # rounding of products of numbers that span 1e10 in the covariance
    np.testing.assert_allclose(np.sqrt(np.diag(covariance)), std, rtol=1e-7)
    nside = 8
    kelvin = healpy.read_map(folder / "mean.fits", dtype=np.float64)
    np.testing.assert_allclose(kelvin, modes_to_map(mean, nside), rtol=1e-12)
    y = pixel_matrix(nside, 8)
    expected = np.sqrt(np.einsum("pi,ij,pj->p", y, covariance, y))
    got = healpy.read_map(folder / "std.fits", dtype=np.float64)
    np.testing.assert_allclose(got, expected, rtol=1e-6)
    # 400 draws: each variance to 5 sigma of sqrt(2 / 400), 81 of them
    ratio = sky_draws_of(folder)[0].var(axis=0, ddof=1) / std**2
    assert np.abs(ratio - 1).max() < 5 * np.sqrt(2 / 400)
    # sqrt(2) there and back again
    alm = healpy.read_alm(folder / "mean_alm.fits")
    np.testing.assert_allclose(from_healpy(alm), mean, rtol=4e-16)
    rows = table_of(folder / "spectra.csv")
    assert list(rows[0])[:8] == [
        "frequency_mhz", "ell", "rho", "snr", "cl_prior", "cl_mean", "cl_truth",
        "cl_posterior_variance",
    ]  # fmt: skip
    assert float(rows[2]["cl_posterior_variance"]) == pytest.approx(np.mean(std[4:9] ** 2))
    summary = json.loads((folder / "summary.json").read_text())
    assert (summary["n_data"], summary["n_modes"]) == (16 * 64, 81)


def test_headers_say_where_the_numbers_come_from(folder):
    text = (folder / "scenario.yaml").read_text()
    for name in ("mean", "std", "truth", "residual", "mean_alm"):
        with fits.open(folder / f"{name}.fits") as hdus:
            header = hdus[1].header
        said = {key: header[key] for key in ("CONTENT", "FREQ", "LMAX", "FRAME", "BEAM")}
        content = name.removesuffix("_alm")
        assert list(said.values()) == [content, 25.0, 8, "galactic", "monopole"]
        assert (header["SITELON"], header["SITELAT"]) == (182.258, -23.814)
        assert header["SCENHASH"] == hashlib.sha256(text.encode()).hexdigest()
        assert header["CREATOR"] == f"lusee_bayes {lusee_bayes.__version__}"
        assert header["V_JAX"] == jax.__version__ and header["V_NUMPY"] == np.__version__
        if name != "mean_alm":
            assert (header["COORDSYS"], header["ORDERING"], header["TUNIT1"]) == ("G", "RING", "K")
            assert header["NSIDE"] == 8
            # every bit of the pixels
            assert healpy.read_map(folder / f"{name}.fits", dtype=None).dtype.itemsize == 8


@pytest.mark.long
@pytest.mark.essential
def test_simulate_then_map_equals_map(folder, tmp_path, capsys):
    data, scenario = tmp_path / "data.nc", folder / "scenario.yaml"
    assert run("simulate", scenario, "-o", data) == 0
    assert "1024 visibilities of 16 products" in capsys.readouterr().out
    options = ["--draws", 3, "--set", "output.covariance=false", "-o", tmp_path / "out"]
    # that of simulated data, which measured ones have not by default
    options += ["--set", "noise.radiometer.temperature=model"]
    assert run("map", scenario, "--data", data, *options) == 0
    said = capsys.readouterr().out
    for path in (tmp_path / "out").rglob("*"):
        assert path.is_dir() or path.name == "manifest.json" or str(path) in said
    assert said.strip().splitlines()[-1] == f"look at {tmp_path}/out/report.html"
    first, again = posterior_of(folder), posterior_of(tmp_path / "out")
    np.testing.assert_array_equal(first["mean"].values, again["mean"].values)
    np.testing.assert_array_equal(first["truth"].values, again["truth"].values)
    assert again["posterior"].sizes["draw"] == 3
    assert "covariance" in first and "covariance" not in again


@pytest.mark.parametrize("flag", ["covariance", "information"])
def test_options_of_the_output_reach_the_scenario(flag, monkeypatch):
    """What they make is tested beside run_map."""
    given, stop = [], raises(KeyboardInterrupt())
    monkeypatch.setattr(runs, "run_map", lambda *a, **_: given.append(a) or stop())
    assert run("map", "fiducial", f"--{flag}", "--draws", 7, "-o", "x", "-q") == 130
    assert given[0][0].output == OutputSection(draws=7, **{flag: True})


def test_names_of_files_keep_their_capitals():
    loaded = ScenarioOptions(set_=("lmax=6",)).load("fiducial", flight__clock="Of/A Clock.JSON")
    assert (loaded.flight.clock, loaded.lmax) == ("Of/A Clock.JSON", 6)


def test_info_recognises_its_files(folder, tmp_path, capsys):
    run("simulate", "fiducial", *SMALL, "-o", tmp_path / "data.nc", "-q")
    for path, words in [
        (tmp_path / "data.nc", "Visibilities: 16 products x"),
        (folder / "posterior.nc", "posterior over 81 modes"),
        (folder / "mean.fits", "HEALPix sky map, NSIDE 8"),
        (folder / "mean.fits", "mean of the posterior at 25 MHz up to ell = 8"),
        (folder / "diagnostics.nc", "residuals by 6 days, 16 products, 2 turntable angles"),
        (folder / "mean_alm.fits", "coefficients of one sky up to ell = 8"),
    ]:
        assert run("info", path) == 0
        assert words in capsys.readouterr().out


def test_the_users_folder_stands_for_a_tilde_everywhere(tmp_path, monkeypatch, capsys):
    """In an option with =, which no shell replaces, in --set and in a scenario."""
    monkeypatch.setenv("HOME", str(tmp_path))
    assert run("simulate", "fiducial", *SMALL, "--output=~/sim.nc", "-q") == 0
    assert (tmp_path / "sim.nc").is_file()
    assert run("info", "~/sim.nc") == 0
    (tmp_path / "own.yaml").write_text("sky: {model: file, file: ~/gone.fits}")
    assert f"'{tmp_path / 'gone.fits'}'" in refused(capsys, "map", "~/own.yaml", "-o", "~/out")
    other = ("--set", "beam.file=~/gone.nc", "-o", "~/out")
    assert f"'{tmp_path / 'gone.nc'}'" in refused(capsys, "map", "fiducial", *other)


@pytest.mark.long
def test_data_without_truth(folder, tmp_path):
    run("simulate", "fiducial", *SMALL, "-o", tmp_path / "sim.nc", "-q")
    data = xr.load_dataset(tmp_path / "sim.nc", engine="h5netcdf", decode_times=False)
    data.drop_vars("truth").to_netcdf(tmp_path / "real.nc", engine="h5netcdf")
    out = tmp_path / "out"
    assert run("map", "fiducial", *SMALL, "--data", tmp_path / "real.nc", "-o", out, "-q") == 0
    assert not (out / "truth.fits").exists()
    assert json.loads((out / "summary.json").read_text())["channels"][0]["ell_cross"] is None
    assert "rho" not in (out / "spectra.csv").read_text()


def test_an_interrupted_write_leaves_the_previous_result_whole(
    small_map, tmp_path, monkeypatch, capsys
):
    out = shutil.copytree(small_map.folder, tmp_path / "out")
    before = content(out)

    # the last file but the page
    monkeypatch.setattr(MapResult, "summary", raises(KeyboardInterrupt()))
    monkeypatch.setattr(runs, "map_channels", lambda *_, **__: small_map.result)
    monkeypatch.setattr(runs, "MAP", replace(runs.MAP, figures={}))
    assert run("map", "fiducial", *SMALL, "--set", "seed=2", "-o", out, "--force", "-q") == 130
    said = capsys.readouterr().err.strip()
    assert said == f"lusee-bayes: interrupted; the earlier results are as they were in '{out}'"
    assert content(out) == before
    assert not list(out.glob(".*"))
    assert run("map", "fiducial", *SMALL, "-o", tmp_path / "new", "-q") == 130
    assert "interrupted; no results are written in" in capsys.readouterr().err
    assert content(tmp_path / "new") == {}


def raises(error):
    def fail(*_, **__):
        raise error

    return fail


@pytest.mark.parametrize(
    ("fail", "code", "words"),
    [
        (lambda: signal.raise_signal(signal.SIGTERM), 143, "terminated; no results"),
        (lambda: signal.raise_signal(signal.SIGHUP), 129, "terminated; no results"),
        (raises(MemoryError("Unable to allocate 8 TiB")), 1, "not enough memory (Unable to alloc"),
        (raises(RuntimeError("RESOURCE_EXHAUSTED: Out of memory")), 1, "not enough memory (RES"),
        (raises(RuntimeError("can't start new thread")), 1, "not enough memory (can't start"),
        (raises(OSError(errno.ENOSPC, "No space left on device")), 1, "mean.fits'); results"),
        (raises(OSError("Can't write data (errno = 28, error message = ..)")), 1, "mean.fits')"),
        (raises(OSError("Not enough space on disk: requested 839168")), 1, "mean.fits'); results"),
    ],
)
def test_what_ends_a_run_is_one_sentence_and_leaves_nothing(
    small_map, tmp_path, monkeypatch, capsys, fail, code, words
):
    def write(result, folder):
        (folder / "mean.fits").write_text("half")
        fail()

    monkeypatch.setattr(runs, "map_channels", lambda *_, **__: small_map.result)
    monkeypatch.setattr(runs, "MAP", replace(runs.MAP, figures={}, outputs=[Output(write)]))
    out = tmp_path / "out [red]"
    assert run("map", "fiducial", *SMALL, "-o", out, "-q") == code
    error = capsys.readouterr().err.strip()
    assert words in error and "\n" not in error
    assert not out.exists()
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL


def test_force_does_not_replace_what_the_run_reads(small_map, tmp_path, capsys):
    out = Path(shutil.copytree(small_map.folder, tmp_path / "out"))
    before = content(out)
    for command in (
        ["map", out / "scenario.yaml", "-o", out],
        ["map", "fiducial", *SMALL, "--set", f"sky.file={out}/mean.fits", "-o", out],
        ["map", "fiducial", *SMALL, "--data", out / "diagnostics.nc", "-o", out],
        ["map", "fiducial", *SMALL, "--add", out, "-o", out],
        ["compare", out, small_map.folder, "-o", out],
        ["simulate", out / "scenario.yaml", "-o", out / "scenario.yaml"],
    ):
        assert "is an input of this run" in refused(capsys, *command, "--force", "-q")
        assert content(out) == before


def test_names_that_are_no_text_are_shown_by_their_escapes(small_map, tmp_path, capsys):
    """In figures, pages, tables and the terminal."""
    for name in ("a\udcff", "b[red]"):
        shutil.copytree(small_map.folder, tmp_path / name)
    with contextlib.chdir(tmp_path):
        assert run("info", "a\udcff/mean.fits") == 0
        assert run("compare", "a\udcff", "b[red]", "-o", "c\udcff") == 0
    shown = capsys.readouterr().out
    assert r"a\udcff" in shown and "b[red]" in shown
    page = (tmp_path / "c\udcff" / "comparison.html").read_bytes().decode("utf-8")
    assert r"a\udcff" in page
