"""simulate --flight, and map its sessions: the whole chain, and what a report says of it."""

import json
import shlex
import shutil
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from commands import posterior_of, refused, run, sets
from matplotlib.figure import Figure

import lusee_bayes as lb
from lusee_bayes.core.reading import parse_yaml
from lusee_bayes.experiment.data_files import read_data, reduce_files
from lusee_bayes.flight.reduced import read_reduced, write_reduced
from lusee_bayes.flight.session_files import read_session
from lusee_bayes.report import pages, rendering
from lusee_bayes.report.figures.judgement import calibration
from lusee_bayes.runs.data_run import reduced_lines, run_simulate_flight
from lusee_bayes.sky.sky_source import read_sky_file

SET = ["lmax=3", "frequency_mhz=20", "observation.step_s=900", "observation.runs=[{cycles: 0.003}]"]
SET += ["noise.radiometer.form=exact", "flight={per_kelvin_v2_hz: 1e-21}"]


def simulate(folder, *more, force=False):
    options = ["--force"] if force else []
    return run("simulate", "fiducial", "--flight", "-q", "-o", folder, *given(*more), *options)


def given(*more):
    return sets(*SET, *more)


def files_of(folder):
    return sorted(p.name for p in folder.iterdir())


@pytest.mark.essential
def test_a_map_of_simulated_sessions_has_the_sky_that_was_simulated(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(Figure, "savefig", lambda self, target, **_: Path(target).touch())
    folder = tmp_path / "flight"
    more = ["observation.step_s=3600", "observation.runs=[{cycles: 0.06}]"]
    more += ["flight.simulated={session_h: 12, clock: unknown, switch_h: 20, navgf: 2}"]
    assert run("simulate", "fiducial", "--flight", "-o", folder, *given(*more)) == 0
    names = [f"session_{k:03d}.h5" for k in range(4)]
    known = ["clock.json", "gains.nc", "manifest.json", "scenario.yaml", *names, "truth.npz"]
    assert files_of(folder) == known
    # the last line is the command that maps them
    line = capsys.readouterr().out.strip().splitlines()[-1]
    program, *arguments = shlex.split(line)
    assert program == "lusee-bayes"
    assert run(*arguments, "--covariance", "--truth", "-o", tmp_path / "map") == 0
    lines = capsys.readouterr().out.splitlines()
    assert sum(line.startswith("Flagged ") and "% of the values" in line for line in lines) == 1
    assert any("times compared at lmax=3, round 1" in line for line in lines)
    found = posterior_of(tmp_path / "map")
    off = (found["mean"] - found["truth"]).values[0]
    chi2 = off @ np.linalg.solve(found["covariance"].values[0], off)
    assert abs(chi2 / len(off) - 1.0) < 4.0 * np.sqrt(2.0 / len(off))


@pytest.mark.long
@pytest.mark.parametrize("lmax", [14, 20])
def test_a_map_of_written_sessions_covers_a_smooth_sky_that_they_hardly_show(
    flight, test_data, tmp_path, lmax
):
    """Data of a sky without the texture of the prior, whose strength they only limit."""
    beam = {"model": "response", "receiver": {"model": "jfet"}, "moon_temperature_k": 250}
    beam |= {"file": str(test_data / "luseepy" / "synthetic_response_v3.fits"), "exact": True}
    said = {"frequency_mhz": 10, "lmax": lmax, "observation": {"timestamp": "middle"}, "beam": beam}
    said["noise"] = {"receiver": {"power_v2_hz": 4.0e-20, "relative_std": 0.3}}
    said["flight"] = {"gain_table": str(flight / "gain"), "bin_origin": "centre"}
    (tmp_path / "scenario.yaml").write_text(json.dumps(said))
    scenario = lb.load_scenario(tmp_path / "scenario.yaml").of_measured()
    data = read_data([flight / f"session_{name}.h5" for name in "abcd"], scenario)
    posterior = lb.infer(lb.build(scenario, data)).posterior
    truth = read_sky_file(test_data / "luseepy" / "sky_alm.npz").modes_at(10.0, lmax)
    assert (posterior.whiten(truth[None]) ** 2).mean() < 6.0
    assert abs(truth - posterior.mean)[0] < 4.0 * posterior.std()[0]


def test_fits_and_a_gain_table_of_ones_own(tmp_path):
    first, second = tmp_path / "a", tmp_path / "b"
    assert simulate(first) == 0
    assert files_of(first)[0] == "gains.nc"
    table = f"flight.gain_table={first / 'gains.nc'}"
    assert simulate(second, table, "flight.simulated={kind: fits}") == 0
    assert "gains.nc" not in files_of(second) and "clock.json" not in files_of(second)
    scenario = parse_yaml((second / "scenario.yaml").read_text(), "the file")
    assert scenario["flight"]["gain_table"] == str(first / "gains.nc")
    assert scenario["flight"]["bin_origin"] == "centre"
    assert scenario["observation"]["timestamp"] == "middle"
    sessions = [read_session(first / "session_000.h5"), read_session(second / "session_000.fits")]
    counts = []
    for session in sessions:
        with session.spectra() as read:
            counts.append(read(0, 5))
    np.testing.assert_array_equal(*counts)
    # files of an earlier simulation do not stay
    assert simulate(second, "flight.simulated={session_h: 1, clock: unknown}", force=True) == 0
    names = files_of(second)
    assert "session_000.fits" not in names and {"clock.json", "gains.nc"} <= set(names)


@pytest.fixture(scope="module")
def simulated(tmp_path_factory):
    """The folder of a session; to be read only."""
    folder = tmp_path_factory.mktemp("flight") / "sessions"
    assert simulate(folder) == 0
    return folder


def test_files_are_replaced_only_if_it_is_asked_for(simulated, tmp_path, capsys):
    out, session = tmp_path / "out.nc", simulated / "session_000.h5"
    before = session.read_bytes()
    again = ("simulate", "fiducial", "--flight", "-q", "-o", simulated, *given())
    told = f"'{simulated}' already contains sessions (session_000.h5); give another -o, or"
    assert told in refused(capsys, *again)
    assert session.read_bytes() == before
    for command in (
        ["simulate", "fiducial", "-q", "--set", "lmax=3"],
        ["reduce", "-q", simulated / "scenario.yaml", session],
    ):
        out.write_bytes(b"mine")
        there = refused(capsys, *command, "-o", out)
        assert "exists already; remove it, give another name, or --force" in there
        assert out.read_bytes() == b"mine"
        assert run(*command, "-o", out, "--force") == 0
        assert out.read_bytes() != b"mine"
    # and what is reduced is not reduced again
    told = refused(capsys, *command[:3], out, "-o", tmp_path / "x.nc")
    assert f"'{out}' is reduced already; give it to lusee-bayes map --data" in told


@pytest.mark.parametrize("name", ["gains.nc", "truth.npz", "scenario.yaml"])
def test_what_can_be_mapped_is_said_of_a_file_that_cannot(simulated, tmp_path, capsys, name):
    given = ["--data", simulated / name, "-q", "-o", tmp_path / "map"]
    error = refused(capsys, "map", simulated / "scenario.yaml", *given)
    assert f"{name} contains no data to map" in error
    assert all(kind in error for kind in ("visibilities", "waterfall", "sessions", "reduce"))


def test_sessions_without_a_number_are_refused(simulated, tmp_path, capsys):
    empty, out = tmp_path / "empty.h5", tmp_path / "out.nc"
    shutil.copy(simulated / "session_000.h5", empty)
    with h5py.File(empty, "a") as file:
        file["spectra/data"][...] = np.nan
    said = refused(capsys, "reduce", "-q", simulated / "scenario.yaml", empty, "-o", out)
    assert "NaN" in said and not out.exists()


def test_info_of_several_files_names_the_bad_one_and_shows_the_others(simulated, write, capsys):
    bad = write("nothing", "bad.h5")
    good = [simulated / "session_000.h5", simulated / "gains.nc"]
    assert run("info", good[0], bad, good[1]) == 2
    told = capsys.readouterr()
    parts = zip(told.out.split("\n\n"), good, strict=True)
    assert all(part.startswith(f"{path}: ") for part, path in parts)
    assert told.err.startswith(f"lusee-bayes: {bad} ") and told.err.count("\n") == 1
    assert run("info", *good) == 0


TWO_BANDS = [*SET, "flight={per_kelvin_v2_hz: 1e-21, gain_std: 0.01, simulated: {clock: unknown}}"]


@pytest.fixture(scope="module")
def of_two_bands(tmp_path_factory):
    """Two bands of a session whose clock is known from outside."""
    scenario = lb.load_scenario("fiducial", TWO_BANDS)
    made = run_simulate_flight(scenario, tmp_path_factory.mktemp("flight"))
    return lb.load_scenario(str(made.scenario)), list(made.sessions)


@pytest.fixture(scope="module")
def reduced(of_two_bands):
    scenario, sessions = of_two_bands
    return reduce_files(sessions, scenario)


def page_of(reduced, folder):
    write_reduced(folder / "reduced.nc", reduced)
    return rendering.render("flight.html", folder, flight=pages.flight_section(folder))


def test_the_section_says_how_spectra_were_reduced(reduced, tmp_path):
    page = page_of(reduced, tmp_path)
    for told in (
        "gains.nc (netCDF)", "the centre of channel k is at k times 25 kHz",
        "middle of integrations", "polynomial of degree 2 over 1 MHz",
        "longitude 182.258°, latitude -23.814°, of the sessions", "0x307",
        "UTC, from the clock file",
    ):  # fmt: skip
        assert told in page, told


def test_files_of_older_versions_are_described_as_far_as_they_say_it(reduced, tmp_path):
    new = ("scale", "rate", "clock_file")
    (session,) = reduced.sessions
    session = {name: value for name, value in session.items() if name not in new}
    page = page_of(replace(reduced, sessions=(session,), recipe={}), tmp_path)
    assert "longitude 182.258°, latitude -23.814°<" in page
    assert "from the clock file" in page and "0x307" in page
    assert read_reduced(tmp_path / "reduced.nc").notes() == ()


def test_a_clock_that_the_sessions_do_not_say_is_told_in_one_line(of_two_bands, reduced, tmp_path):
    (told,) = [line for line in reduced_lines(reduced) if "clock file" in line]
    assert told.startswith("session_000.h5 ") and told.endswith("from the clock file clock.json.")
    # nothing to say where the session says it itself
    known = lb.load_scenario("fiducial", [*TWO_BANDS, "flight.simulated.clock=known"])
    made = run_simulate_flight(known, tmp_path)
    for given in ((), (f"flight.clock={of_two_bands[0].flight.clock}",)):
        both = reduce_files(list(made.sessions), lb.load_scenario(str(made.scenario), given))
        assert both.notes() == ()


def test_of_one_frequency_gains_are_points_with_error_bars(reduced):
    """Their places are those of the gains in the band, their lengths one standard deviation."""
    left, right = calibration(reduced).axes
    assert len(left.containers) == 4
    for port, container in enumerate(left.containers):
        points, _, (bars,) = container.lines
        assert points.get_xdata() == [20.0]
        # the curve is that of the mean telemetry; a band's mean gain differs a little
        gain = np.nanmean(reduced.gain[0, port])
        assert points.get_ydata()[0] == pytest.approx(gain, rel=5e-3)
        ((_, low), (_, high)) = bars.get_segments()[0]
        assert (high - low) / 2.0 == pytest.approx(0.01 * gain, rel=5e-3)
    # a point for what is known, words for what is not
    marks = [line for line in right.lines if line.get_marker() in ("o", "s")]
    scatter = np.concatenate([reduced.line_scatter, reduced.scatter])
    np.testing.assert_array_equal([line.get_ydata()[0] for line in marks], scatter)
    texts = [text.get_text() for text in right.get_legend().get_texts()]
    assert [text.endswith(": unknown") for text in texts] == np.isnan(scatter).tolist()
    assert np.isnan(scatter).any() and np.isfinite(scatter).any()


def test_of_several_frequencies_noise_is_drawn_by_frequency(of_two_bands):
    scenario, sessions = of_two_bands
    several = reduce_files(sessions, scenario.model_copy(update={"frequencies_mhz": (15.0, 20.0)}))
    left, right = calibration(several).axes
    assert not left.containers
    (marks,) = [line for line in right.lines if line.get_marker() == "o"]
    np.testing.assert_array_equal(marks.get_xdata(), [15.0, 20.0])
    np.testing.assert_array_equal(marks.get_ydata(), several.line_scatter)
