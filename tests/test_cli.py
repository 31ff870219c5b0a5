"""The commands as a user meets them: files, figures, exit codes, messages."""

import csv
import hashlib
import json
import subprocess
import sys

import healpy
import jax
import matplotlib.image
import numpy as np
import pytest
import xarray as xr
from astropy.io import fits

import lusee_bayes
from lusee_bayes import results
from lusee_bayes.cli import main
from lusee_bayes.harmonics import from_healpy, modes_to_map, pixel_matrix
from lusee_bayes.staging import staged

SMALL = [
    argument
    for override in ["lmax=6", "observation.runs.0.cycles=0.1"]
    for argument in ("--set", override)
]


def run(*arguments) -> int:
    return main([str(a) for a in arguments])


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    out = tmp_path_factory.mktemp("map")
    assert run("map", "fiducial", *SMALL, "-o", out, "--draws", 400, "--covariance", "-q") == 0
    return out


def test_map_writes_what_it_promises(folder):
    assert {p.name for p in folder.iterdir()} == {
        "posterior.nc", "mean.fits", "mean_alm.fits", "std.fits", "truth.fits", "residual.fits",
        "spectra.csv", "summary.json", "scenario.yaml", "diagnostics.nc", "report.html", "figures",
    }  # fmt: skip
    for figure in ("maps", "data_vector", "beams", "fidelity", "spectra", "draws", "residuals"):
        image = matplotlib.image.imread(folder / "figures" / f"{figure}.png")
        assert image.std() > 0.01  # not blank


def test_the_files_agree_with_each_other(folder):
    posterior = xr.open_dataset(folder / "posterior.nc", engine="h5netcdf")
    mean, std = posterior["mean"].values, posterior["std"].values
    np.testing.assert_array_equal(
        posterior["ell"].values ** 2 + posterior["ell"].values + posterior["m"].values,
        np.arange(49),
    )
    covariance = posterior["covariance"].values
    # rounding of products of numbers that span 1e10 in the covariance
    np.testing.assert_allclose(np.sqrt(np.diag(covariance)), std, rtol=1e-7)
    nside = 8
    kelvin = healpy.read_map(folder / "mean.fits", dtype=np.float64)
    np.testing.assert_allclose(kelvin, modes_to_map(mean, nside), rtol=1e-12)
    y = pixel_matrix(nside, 6)
    expected = np.sqrt(np.einsum("pi,ij,pj->p", y, covariance, y))
    got = healpy.read_map(folder / "std.fits", dtype=np.float64)
    np.testing.assert_allclose(got, expected, rtol=1e-6)
    # 400 draws: each variance to 5 sigma of sqrt(2 / 400), 49 of them
    ratio = posterior["draws"].values.var(axis=0, ddof=1) / std**2
    assert np.abs(ratio - 1).max() < 5 * np.sqrt(2 / 400)
    # sqrt(2) there and back again
    alm = healpy.read_alm(folder / "mean_alm.fits")
    np.testing.assert_allclose(from_healpy(alm), mean, rtol=4e-16)
    with (folder / "spectra.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0])[:7] == [
        "ell", "rho", "snr", "cl_prior", "cl_mean", "cl_truth", "cl_posterior_variance",
    ]  # fmt: skip
    assert float(rows[2]["cl_posterior_variance"]) == pytest.approx(np.mean(std[4:9] ** 2))
    summary = json.loads((folder / "summary.json").read_text())
    assert (summary["n_data"], summary["n_modes"]) == (16 * 32, 49)


def test_headers_say_where_the_numbers_come_from(folder):
    text = (folder / "scenario.yaml").read_text()
    for name in ("mean", "std", "truth", "residual", "mean_alm"):
        with fits.open(folder / f"{name}.fits") as hdus:
            header = hdus[1].header
        said = {key: header[key] for key in ("CONTENT", "FREQ", "LMAX", "FRAME", "BEAM")}
        content = name.removesuffix("_alm")
        assert list(said.values()) == [content, 25.0, 6, "galactic", "monopole"]
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
def test_the_resolved_scenario_gives_the_same_numbers(folder, tmp_path):
    assert run("map", folder / "scenario.yaml", "-o", tmp_path, "-q") == 0
    first, again = (
        xr.open_dataset(f / "posterior.nc", engine="h5netcdf")["mean"].values
        for f in (folder, tmp_path)
    )
    np.testing.assert_array_equal(first, again)


def test_simulate_then_map_equals_map(folder, tmp_path, capsys):
    data = tmp_path / "data.nc"
    assert run("simulate", "fiducial", *SMALL, "-o", data) == 0
    assert "512 visibilities of 16 products" in capsys.readouterr().out
    assert run("map", "fiducial", *SMALL, "--data", data, "-o", tmp_path / "out", "-q") == 0
    first, again = (
        xr.open_dataset(f / "posterior.nc", engine="h5netcdf") for f in (folder, tmp_path / "out")
    )
    np.testing.assert_array_equal(first["mean"].values, again["mean"].values)
    np.testing.assert_array_equal(first["truth"].values, again["truth"].values)


def test_info_recognises_its_files(folder, tmp_path, capsys):
    run("simulate", "fiducial", *SMALL, "-o", tmp_path / "data.nc", "-q")
    for path, words in [
        (tmp_path / "data.nc", "visibilities at 25 MHz"),
        (folder / "posterior.nc", "posterior over 49 modes"),
        (folder / "mean.fits", "HEALPix sky map, NSIDE 8"),
        (folder / "mean.fits", "mean at 25 MHz up to ell = 6, beam monopole, site 182.258"),
        (folder / "diagnostics.nc", "residuals by 16 products, 3 days, 1 angles"),
        (folder / "mean_alm.fits", "coefficients of 1 skies up to ell = 6"),
    ]:
        assert run("info", path) == 0
        assert words in capsys.readouterr().out


@pytest.mark.long
def test_data_without_truth(folder, tmp_path):
    run("simulate", "fiducial", *SMALL, "-o", tmp_path / "sim.nc", "-q")
    xr.load_dataset(tmp_path / "sim.nc", engine="h5netcdf", decode_times=False).drop_vars(
        "truth"
    ).to_netcdf(tmp_path / "real.nc", engine="h5netcdf")
    out = tmp_path / "out"
    assert run("map", "fiducial", *SMALL, "--data", tmp_path / "real.nc", "-o", out, "-q") == 0
    assert not (out / "truth.fits").exists()
    assert json.loads((out / "summary.json").read_text())["ell_cross"] is None
    assert "rho" not in (out / "spectra.csv").read_text()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["map", "nonsense"], "no scenario 'nonsense'"),
        (["map", "fiducial", "--set", "sky.file=gone.fits"], "no sky map at 'gone.fits'"),
        (["map", "fiducial", "--set", "sky.fil=x"], "unknown key 'sky.fil'; did you mean 'file'?"),
        (["map", "fiducial", "--data", "gone.nc"], "no data at 'gone.nc'"),
        (["map", "fiducial", "--set", "observation.start=2051-01-01"], "outside the ephemeris"),
        (["map", "fiducial", "--set", "observation.start=soon"], "'soon' is not a date"),
        (["map", "fiducial", "--set", "noise.radiometer.factor=-1"], "greater than 0"),
        (["map", "fiducial", "--set", "observation.runs.0.cycles=0.0001"], "holds no sample"),
        (["info", "gone.fits"], "no file at 'gone.fits'"),
        (["mapp", "fiducial"], "mapp"),
        (["map"], "scenario"),
        (["map", "fiducial", "--draws", "many"], "many"),
    ],
)
def test_bad_input_is_one_sentence_and_exit_code_2(tmp_path, capsys, arguments, message):
    out = tmp_path / "out"
    if arguments[0] == "map" and len(arguments) > 1:
        arguments = [*arguments, "-o", str(out)]
    assert run(*arguments) == 2
    error = capsys.readouterr().err.strip()
    assert message in error
    assert error.startswith("lusee-bayes: ")
    assert "\n" not in error
    assert not out.exists()


def test_an_interrupted_write_leaves_the_previous_result_whole(tmp_path, monkeypatch):
    out = tmp_path / "out"
    assert run("map", "fiducial", *SMALL, "-o", out, "-q") == 0
    before = {p.name: p.read_bytes() for p in out.iterdir() if p.is_file()}

    def interrupt(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(results.MapResult, "summary", interrupt)
    assert run("map", "fiducial", *SMALL, "--set", "seed=2", "-o", out, "-q") == 130
    assert {p.name: p.read_bytes() for p in out.iterdir() if p.is_file()} == before
    assert not list(out.glob(".partial*"))


def test_staged_refuses_a_file_as_folder(tmp_path):
    (tmp_path / "x").write_text("")
    assert run("map", "fiducial", *SMALL, "-o", tmp_path / "x", "-q") == 2
    with staged(tmp_path / "new") as stage:
        (stage / "a").write_text("1")
    assert (tmp_path / "new" / "a").read_text() == "1"


def test_help_and_version_do_not_load_the_heavy_libraries():
    code = (
        "import sys; from lusee_bayes.cli import main; main(['--help']); "
        "sys.exit(any(m in sys.modules for m in ('healpy', 'lunarsky', 'xarray', 'matplotlib')))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "map" in done.stdout
