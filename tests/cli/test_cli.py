"""The commands as a user meets them: files, figures, exit codes, messages."""

import contextlib
import errno
import hashlib
import json
import os
import re
import shlex
import shutil
import signal
from dataclasses import replace
from pathlib import Path

import healpy
import jax
import numpy as np
import pytest
import xarray as xr
from assertions import raising, refuse
from astropy.io import fits
from astropy.table import Table
from commands import assert_drawn, content, posterior_of, python, refused, run, sky_draws_of
from rich.console import Console

import lusee_bayes
from lusee_bayes.cli.commands import app
from lusee_bayes.cli.options import ScenarioOptions
from lusee_bayes.cli.tables import checks_table, comparison_table
from lusee_bayes.core import arrays, harmonics, version
from lusee_bayes.experiment.scenario import OutputSection, load_scenario, scenario_names
from lusee_bayes.judge.chi2 import HEADLINES
from lusee_bayes.results.finished_runs import FinishedRun, comparison_rows, evidence_caveat
from lusee_bayes.results.map_result import MapResult
from lusee_bayes.runs import map_run as runs
from lusee_bayes.runs.folder import Output
from lusee_bayes.sampling.validation import Check

SMALL = ["--set", "lmax=6", "--set", "observation.runs.0.cycles=0.1"]


@pytest.fixture(scope="module")
def folder(small_map):
    """Of a finished map run, shared: to be read."""
    return small_map.folder


def test_map_writes_what_it_promises(folder):
    files = "posterior.nc map.fits mean_alm.fits power_spectra.ecsv summary.json scenario.yaml "
    files += "diagnostics.nc report.html figures manifest.json"
    assert {p.name for p in folder.iterdir()} == {*files.split(), "provenance.json"}
    names = ("data_vector", "beams", "spectra", "residuals", "maps_1_truth", "draws_4_draw_4")
    assert_drawn(*(folder / "figures" / f"{name}.png" for name in names))


def test_the_files_agree_with_each_other(folder):
    posterior = posterior_of(folder)
    mean, std = posterior["mean"].values[0], posterior["std"].values[0]
    ell, m = posterior["ell"].values, posterior["m"].values
    np.testing.assert_array_equal(ell**2 + ell + m, np.arange(81))
    covariance = posterior["covariance"].values[0]
    # rounding of products of numbers that span 1e10 in the covariance
    np.testing.assert_allclose(np.sqrt(np.diag(covariance)), std, rtol=1e-7)
    nside, columns = 8, healpy.read_map(folder / "map.fits", field=None, dtype=np.float64)
    kelvin, got, observed, truth, residual, *drawn = columns
    np.testing.assert_allclose(kelvin, harmonics.modes_to_map(mean, nside), rtol=1e-12)
    y = harmonics.pixel_matrix(nside, 8)
    np.testing.assert_allclose(got, np.sqrt(np.einsum("pi,ij,pj->p", y, covariance, y)), rtol=1e-6)
    np.testing.assert_allclose(kelvin - truth, residual, rtol=0, atol=1e-9 * kelvin.max())
    np.testing.assert_array_equal(observed, FinishedRun.read(folder).channel.highest_altitude >= 0)
    skies = sky_draws_of(folder)[0][:100]
    assert len(drawn) == 100
    np.testing.assert_allclose(drawn[7], harmonics.modes_to_map(skies[7], nside), rtol=1e-10)
    # 400 draws: each variance to 5 sigma of sqrt(2 / 400), 81 of them
    ratio = sky_draws_of(folder)[0].var(axis=0, ddof=1) / std**2
    assert np.abs(ratio - 1).max() < 5 * np.sqrt(2 / 400)
    # sqrt(2) there and back again
    alm = healpy.read_alm(folder / "mean_alm.fits")
    np.testing.assert_allclose(harmonics.from_healpy(alm), mean, rtol=4e-16)
    table = Table.read(folder / "power_spectra.ecsv")
    assert table["cl_mean"].unit == "K2"
    columns = "frequency_mhz ell rho snr cl_prior cl_mean cl_truth cl_posterior_variance"
    assert table.colnames[:8] == columns.split()
    assert table["cl_posterior_variance"][2] == pytest.approx(np.mean(std[4:9] ** 2))
    summary = json.loads((folder / "summary.json").read_text())
    assert (summary["n_data"], summary["n_modes"]) == (16 * 64, 81)


def test_headers_say_where_the_numbers_come_from(folder):
    text = (folder / "scenario.yaml").read_text()
    for name, what in (("map", "maps"), ("mean_alm", "mean")):
        with fits.open(folder / f"{name}.fits") as hdus:
            header = hdus[1].header
        said = [header[key] for key in ("CONTENT", "FREQ", "LMAX", "FRAME", "BEAM")]
        assert said == [what, 25.0, 8, "galactic", "monopole"]
        assert (header["SITELON"], header["SITELAT"]) == (182.258, -23.814)
        assert header["SCENHASH"] == hashlib.sha256(text.encode()).hexdigest()
        assert header["CREATOR"] == f"lusee_bayes {lusee_bayes.__version__}"
        assert header["V_JAX"] == jax.__version__ and header["V_NUMPY"] == np.__version__
        if name != "mean_alm":
            assert (header["COORDSYS"], header["ORDERING"], header["TUNIT1"]) == ("G", "RING", "K")
            assert header["NSIDE"] == 8
            # every bit of the pixels
            assert healpy.read_map(folder / f"{name}.fits", dtype=None).dtype.itemsize == 8


@pytest.mark.essential
def test_simulate_then_map_equals_map(folder, tmp_path, capsys):
    data, scenario = tmp_path / "data.nc", folder / "scenario.yaml"
    assert run("simulate", scenario, "-o", data) == 0
    assert "1024 visibilities of 16 products" in capsys.readouterr().out
    options = ["--draws", 3, "--set", "output.covariance=false", "-o", tmp_path / "out", "-v"]
    # that of simulated data, which measured ones have not by default
    options += ["--set", "noise.radiometer.temperature=model"]
    assert run("map", scenario, "--data", data, *options) == 0
    said = capsys.readouterr().out
    for path in (tmp_path / "out").rglob("*"):
        assert path.is_dir() or path.name == "manifest.json" or str(path) in said
    verdict, numbers, page = said.strip().splitlines()[-3:]
    assert page == f"look at {tmp_path}/out/report.html" and "chi2" in numbers
    assert verdict in HEADLINES.values()
    first, again = posterior_of(folder), posterior_of(tmp_path / "out")
    np.testing.assert_array_equal(first["mean"].values, again["mean"].values)
    np.testing.assert_array_equal(first["truth"].values, again["truth"].values)
    drawn = lusee_bayes.read_draws(tmp_path / "out")
    np.testing.assert_array_equal(drawn, again["posterior"]["sky"].values[0, :, 0])
    refuse("channels of 25 MHz", lusee_bayes.read_draws, tmp_path / "out", 30.0)
    assert "covariance" in first and "covariance" not in again


@pytest.mark.parametrize("flag", ["covariance", "information"])
def test_options_of_the_output_reach_the_scenario(flag, monkeypatch):
    """What they make is tested beside run_map."""
    given, stop = [], raising(KeyboardInterrupt())
    monkeypatch.setattr(runs, "run_map", lambda *a, **_: given.append(a) or stop())
    assert run("map", f"--{flag}", "--draws", 7, "-q") == 130
    assert given[0][0].output == OutputSection(draws=7, **{flag: True})
    assert given[0][0].prior.model == "local_scales" and str(given[0][1]) == "output/first_map"


def test_a_scenario_to_begin_with(tmp_path, capsys):
    assert run("init", tmp_path / "mine.yaml", "--like", "fiducial") == 0
    assert load_scenario(tmp_path / "mine.yaml") == load_scenario("fiducial")
    assert "exists" in refused(capsys, "init", tmp_path / "mine.yaml")
    assert run("scenarios") == 0 and run("keys", "--schema") == 0
    listed, _, schema = capsys.readouterr().out.partition("{")
    assert all(f"{name}: " in listed for name in scenario_names()) and '"maximum": 383' in schema


def test_names_of_files_keep_their_capitals():
    loaded = ScenarioOptions(set_=("lmax=6",)).load("fiducial", flight__clock="Of/A Clock.JSON")
    assert (loaded.flight.clock, loaded.lmax) == ("Of/A Clock.JSON", 6)


def test_info_recognises_files_and_folders(small_map, folder, tmp_path, capsys):
    run("simulate", "fiducial", *SMALL, "-o", tmp_path / "data.nc", "-q")
    (days,) = {len(c.judged.of_kind("day")) for c in small_map.result.channels}
    simulated = "results of lusee-bayes map", "simulated by this run, seed 1"
    for path, words in [
        (tmp_path / "data.nc", ["Visibilities: 16 products x"]),
        (folder / "posterior.nc", ["posterior over 81 modes"]),
        (folder / "map.fits", ["HEALPix sky map, NSIDE 8", "maps of the posterior at 25 MHz up"]),
        (folder / "diagnostics.nc", [f"residuals by {days} days, 16 products, 2 turntable angles"]),
        (folder / "mean_alm.fits", ["coefficients of one sky up to ell = 8"]),
        (folder, [*simulated, small_map.result.verdict(), "mean_alm.fits"]),
    ]:
        assert run("info", path) == 0
        told = capsys.readouterr().out
        assert all(word in told for word in words), told
    assert "not the folder of a run" in refused(capsys, "info", tmp_path)


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
def test_data_without_truth(tmp_path):
    run("simulate", "fiducial", *SMALL, "-o", tmp_path / "sim.nc", "-q")
    data = xr.load_dataset(tmp_path / "sim.nc", engine="h5netcdf", decode_times=False)
    data.drop_vars("truth").to_netcdf(tmp_path / "real.nc", engine="h5netcdf")
    out = tmp_path / "out"
    assert run("map", "fiducial", *SMALL, "--data", tmp_path / "real.nc", "-o", out, "-q") == 0
    assert "TRUTH" not in fits.getdata(out / "map.fits", 1).names
    assert json.loads((out / "summary.json").read_text())["channels"][0]["ell_cross"] is None
    assert "rho" not in (out / "power_spectra.ecsv").read_text()


def test_an_interrupted_write_leaves_the_old_result_whole(small_map, tmp_path, monkeypatch, capsys):
    out = shutil.copytree(small_map.folder, tmp_path / "out")
    before = content(out)

    # the last file but the page
    monkeypatch.setattr(MapResult, "summary", raising(KeyboardInterrupt()))
    monkeypatch.setattr(runs, "map_channels", lambda *_, **__: small_map.result)
    monkeypatch.setattr(runs, "MAP", replace(runs.MAP, figures={}))
    assert run("map", "fiducial", *SMALL, "--set", "seed=2", "-o", out, "--force", "-q") == 130
    said = capsys.readouterr().err.strip()
    assert said == f"lusee-bayes: interrupted; the earlier results are unchanged in '{out}'"
    assert content(out) == before
    assert not list(out.glob(".*"))
    assert run("map", "fiducial", *SMALL, "-o", tmp_path / "new", "-q") == 130
    assert "interrupted; no results were written in" in capsys.readouterr().err
    assert content(tmp_path / "new") == {}


ENDINGS = [
    (lambda: signal.raise_signal(signal.SIGTERM), 143, "terminated; no results"),
    (lambda: signal.raise_signal(signal.SIGHUP), 129, "terminated; no results"),
    (raising(MemoryError("Unable to allocate 8 TiB")), 1, "not enough memory (Unable to alloc"),
    (raising(RuntimeError("RESOURCE_EXHAUSTED: Out of memory")), 1, "not enough memory (RES"),
    (raising(RuntimeError("can't start new thread")), 1, "not enough memory (can't start"),
    (raising(OSError(errno.ENOSPC, "No space left on device")), 1, "mean.fits'); results"),
    (raising(OSError(errno.ENOSPC, "", ".partial-a/mean.fits")), 1, "red]/mean.fits')"),
    (raising(OSError("Can't write data (errno = 28, error message = ..)")), 1, "mean.fits')"),
    (raising(OSError("Not enough space on disk: requested 839168")), 1, "mean.fits'); results"),
]


@pytest.mark.parametrize(("fail", "code", "words"), ENDINGS)
def test_what_ends_a_run(small_map, tmp_path, monkeypatch, capsys, fail, code, words):
    """It is one sentence, and leaves nothing."""

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
    survey = f"{{model: local_scales, surveys: [{{file: {out}/map.fits, frequency_mhz: 25}}]}}"
    for command in (
        ["map", out / "scenario.yaml", "-o", out],
        ["map", "fiducial", *SMALL, "--set", f"sky.file={out}/map.fits", "-o", out],
        ["map", "fiducial", *SMALL, "--data", out / "diagnostics.nc", "-o", out],
        ["map", "fiducial", *SMALL, "--add", out, "-o", out],
        ["compare", out, small_map.folder, "-o", out],
        ["simulate", out / "scenario.yaml", "-o", out / "scenario.yaml"],
        ["simulate", "fiducial", *SMALL, "--set", f"prior={survey}", "-o", out / "map.fits"],
    ):
        assert "is an input of this run" in refused(capsys, *command, "--force", "-q")
        assert content(out) == before


def test_names_that_are_no_text_are_shown_by_their_escapes(small_map, tmp_path, capsys):
    """In figures, pages, tables and the terminal."""
    for name in ("a\udcff", "b[red]"):
        shutil.copytree(small_map.folder, tmp_path / name)
    with contextlib.chdir(tmp_path):
        assert run("info", "a\udcff/map.fits") == 0
        assert run("compare", "a\udcff", "b[red]", "-o", "c\udcff") == 0
    shown = capsys.readouterr().out
    assert r"a\udcff" in shown and "b[red]" in shown
    assert r"a\udcff" in (tmp_path / "c\udcff" / "comparison.html").read_bytes().decode("utf-8")


# --- the terminal, help, and what a command waits for ---------------------------------------------


@pytest.fixture
def finished(small_map):
    return FinishedRun.read(small_map.folder)


def printed(table) -> list[str]:
    console = Console(width=80, soft_wrap=True, record=True, quiet=False, force_terminal=False)
    with console.capture() as captured:
        console.print(table, soft_wrap=False)
    return captured.get().splitlines()


def with_data(run, name, change):
    """The same run with other data."""
    return replace(run, name=name, channels=(replace(run.channel, data=change(run.channel.data)),))


CALLS = [
    ("keys", 0, ""),
    ("map no.yaml", 2, "no.yaml"),
    ("plan fiducial --set frequencies_mhz=[10,20] --vary lmax=3", 2, "a forecast has one freq"),
    ("validate fiducial --set frequencies_mhz=[10,20]", 2, "a validation has one frequency"),
    ("map fiducial --clock=c.json", 2, "--clock is for session files"),
    ("map --lmax 8", 2, "Unknown option: --lmax. Keys of a scenario are set with --set KEY=VALUE"),
    ("map fiducial --set a={b: 0.01}", 2, "['0.01}']. Values that contain spaces need quotes"),
]


@pytest.mark.parametrize(("line", "code", "words"), CALLS)
def test_a_call_ends_with_a_code_and_leaves_no_trace_of_its_command(line, code, words, capsys):
    assert run(*line.split()) == code
    assert words in capsys.readouterr().err
    assert version.COMMAND.get() == ""


def test_tables_fit_eighty_columns(finished):
    others = [
        replace(finished, name="a run with a name that is longer than it had better be " * 2),
        replace(finished, name="unknown", channels=(replace(finished.channel, truth=None),)),
    ]
    lines = printed(comparison_table([finished, *others]))
    assert max(map(len, lines)) <= 80
    assert "None" not in "".join(lines) and "> 8" in "".join(lines)
    check = Check("a check", 1.0, 0.0, 2.0, "what it is, in a long sentence " * 6)
    assert max(map(len, printed(checks_table([check])))) <= 80


OTHER_DATA = [
    (lambda d: d + 1.0, "different values at the same times"),
    (lambda d: 4e-24 * d, "the same data in a different unit (factor 4e-24)"),
    (lambda d: np.where(np.arange(d.shape[1]) > 3, d, np.nan), "samples instead of"),
]


@pytest.mark.parametrize(("change", "reason"), OTHER_DATA)
def test_evidences_of_other_data_are_not_compared(finished, change, reason):
    same = with_data(finished, "same", lambda d: d)
    assert evidence_caveat([finished, same]) is None
    assert comparison_rows([finished, same])[0]["log_evidence_less_best"] == 0.0
    other = with_data(finished, "other", change)
    assert reason in evidence_caveat([finished, same, other])
    assert "same has" not in evidence_caveat([finished, same, other])
    assert comparison_rows([finished, other])[0]["log_evidence_less_best"] is None
    added = replace(finished.channel, digests=("earlier", *finished.channel.digests))
    added = replace(finished, name="sum", channels=(added,))
    assert "sum was added to other earlier data" in evidence_caveat([finished, added])
    ten = replace(finished, name="ten", channels=(replace(finished.channel, frequency_mhz=10.0),))
    assert "ten is at 10 MHz instead of 25" in evidence_caveat([finished, ten])


FEW = [("--simulations=50", "at least 100 simulations"), ("--draws=20", "300 draws of each chain")]


@pytest.mark.parametrize(("option", "message"), FEW)
def test_options_are_checked_before_anything_is_loaded(option, message, tmp_path):
    """Not even a scenario that does not exist is looked for, nor JAX imported."""
    code = "import sys; from lusee_bayes.cli.main import main; code = main(sys.argv[1:]); "
    code += "print('jax' in sys.modules); raise SystemExit(code)"
    found = python("-c", code, "validate", "no such scenario", option, cwd=tmp_path, check=False)
    assert found.returncode == 2 and message in found.stderr
    assert found.stdout.strip() == "False"
    assert not list(tmp_path.iterdir())


COMMANDS = [name for name in app if not name.startswith("-")]
EXAMPLES = [
    (name, line)
    for name in COMMANDS
    for line in re.findall(r"^ *- ``(.*)``$", app[name].default_command.__doc__, re.MULTILINE)
]


@pytest.mark.parametrize("name", COMMANDS)
def test_help_shows_the_examples(name, capsys):
    assert run(name, "--help") == 0
    shown = " ".join(capsys.readouterr().out.split())
    examples = [line for its, line in EXAMPLES if its == name]
    assert "Examples" in shown and examples
    assert all(example in shown for example in examples)


@pytest.mark.parametrize(("name", "line"), EXAMPLES, ids=[line for _, line in EXAMPLES])
def test_examples_are_of_the_command_and_can_be_parsed(name, line):
    program, *arguments = shlex.split(line)
    assert (program, arguments[0]) == ("lusee-bayes", name)
    # an unknown option or a value of the wrong type raises
    command, *_ = app.parse_args(arguments, exit_on_error=False, print_error=False)
    assert command.__name__ == f"{name.replace('-', '_')}_command"


def test_keys_are_listed(capsys):
    assert run("keys", "noise.gain") == 0
    shown = capsys.readouterr().out
    assert "noise.gain.correlation_h = 10.0\n    Correlation time\n" in shown
    assert "number, > 0 [h]" in shown
    assert run("keys", "--markdown", "lmax") == 0
    assert "| `lmax` |" in capsys.readouterr().out
    assert "no key 'lmx'; did you mean 'lmax'?" in refused(capsys, "keys", "lmx")


# as without the extra "cluster": xarray imports Dask where it is there, and Dask SciPy
PROGRAM = """
import sys
sys.modules["dask"] = None
from lusee_bayes.cli.main import main
counted = []
if {count}:
    import jax
    jax.monitoring.register_event_duration_secs_listener(
        lambda name, *_, **__: counted.append(name)
    )
assert main({arguments!r}) == 0
print(len([name for name in counted if "backend_compile" in name]), *sys.modules)
"""


def outcome(*arguments, count=False):
    """The number of programs compiled, and the modules imported."""
    program = PROGRAM.format(count=count, arguments=[str(a) for a in arguments])
    environment = {name: v for name, v in os.environ.items() if not name.startswith("JAX")}
    environment["LUSEE_BAYES_CACHE"] = "off"
    n, *modules = python("-c", program, env=environment).stdout.splitlines()[-1].split()
    return int(n), set(modules)


@pytest.mark.parametrize("arguments", [["--help"], ["map", "--help"], ["--version"]])
def test_help_waits_for_no_library(arguments):
    _, modules = outcome(*arguments)
    assert not modules & {"jax", "numpy", "astropy", "healpy", "matplotlib", "xarray", "pydantic"}


SPARED = [
    ("posterior.nc", {"jax", "healpy", "matplotlib", "scipy"}),
    ("diagnostics.nc", {"jax", "healpy", "matplotlib", "scipy"}),
    ("map.fits", {"numpyro", "xarray", "lunarsky", "scipy.stats", "healpy", "matplotlib"}),
]


@pytest.mark.parametrize(("name", "spared"), SPARED)
def test_info_waits_for_no_more_than_its_file(name, spared, small_map):
    _, modules = outcome("info", small_map.folder / name)
    assert not modules & spared


def test_a_map_compiles_little_and_imports_no_sampler(tmp_path):
    small = ("--set", "lmax=8", "--set", "observation.runs.0.cycles=0.2")
    n, modules = outcome("map", "fiducial", *small, "-o", tmp_path / "map", "-q", count=True)
    # single random numbers, most of them; none of it grows with the map
    assert 0 < n <= 60
    assert not modules & {"numpyro", "arviz_stats", "scipy.stats", "scipy.optimize"}


# --- the cache of compiled programs: shared, and switched off -------------------------------------

# one program, compiled anew or found; says which
COMPILING = """
import jax
from lusee_bayes.core.arrays import use_compilation_cache
found = []
jax.monitoring.register_event_listener(lambda name, **_: found.append(name))
use_compilation_cache()
x = jax.jit(lambda x: (x * 2.0 + 1.0).sum())(jax.numpy.arange(7.0))
print(sum("cache_hits" in name for name in found), flush=True)
"""


def compiled(cache, *without):
    """What the program says, in an environment without variables that begin so."""
    own = {k: v for k, v in os.environ.items() if not k.startswith(("JAX", *without))}
    done = python("-c", COMPILING, env=own | {arrays.SWITCH: str(cache)})
    return done.stdout, done.stderr


def kept(cache):
    return sorted(path.name for path in cache.rglob("*-cache"))


def test_what_one_process_compiles_the_next_one_finds(tmp_path):
    assert compiled(tmp_path)[0] == "0\n"
    programs = kept(tmp_path)
    assert programs
    assert int(compiled(tmp_path)[0]) >= 1
    assert kept(tmp_path) == programs
    # JAX sets a level of messages at which XLA warns of every program that it finds: a program
    # that imports JAX first sees no such warnings
    assert compiled(tmp_path, "TF_CPP") == ("0\n", "")


@pytest.mark.long
def test_it_can_be_switched_off_and_do_without(write):
    assert compiled("off")[0] == "0\n"
    # a place that cannot be written to: programs are compiled anew, and nothing is said
    blocked = write("not a folder", "file")
    assert compiled(blocked)[0] == "0\n"
    assert blocked.read_text() == "not a folder"
