"""What a report says of flight data: how they were reduced, and the figure of gains and noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import lusee_bayes as lb
from lusee_bayes.experiment.flight_data import reduce_files
from lusee_bayes.flight.reduced import read_reduced, write_reduced
from lusee_bayes.report.figures.judgement import calibration
from lusee_bayes.report.sections import flight_section
from lusee_bayes.runs.data_run import reduced_lines, run_simulate_flight

SET = [
    "lmax=3",
    "frequency_mhz=20",
    "observation.step_s=900",
    "observation.runs=[{cycles: 0.003}]",
    "noise.radiometer.form=exact",
    "flight={per_kelvin_v2_hz: 1e-21, gain_std: 0.01, simulated: {clock: unknown}}",
]


@pytest.fixture(scope="module")
def simulated(tmp_path_factory):
    """Two bands of a session whose clock is known from outside."""
    made = run_simulate_flight(lb.load_scenario("fiducial", SET), tmp_path_factory.mktemp("flight"))
    scenario = lb.load_scenario(str(made.scenario))
    return scenario, list(made.sessions)


@pytest.fixture(scope="module")
def reduced(simulated):
    scenario, sessions = simulated
    return reduce_files(sessions, scenario)


def test_the_section_says_how_spectra_were_reduced(reduced, tmp_path):
    write_reduced(tmp_path / "reduced.nc", reduced)
    page = "\n".join(*flight_section(tmp_path).values())
    for told in (
        "gains.nc (netCDF)",
        "the centre of channel k is at k times 25 kHz",
        "middle of integrations",
        "polynomial of degree 2 over 1 MHz",
        "longitude 182.258°, latitude -23.814°, of the sessions",
        "0x307",
        "UTC, of the clock file",
    ):
        assert told in page, told


def test_files_of_older_versions_are_described_as_far_as_they_say_it(reduced, tmp_path):
    new = ("scale", "rate", "clock_file")
    (session,) = reduced.sessions
    session = {name: value for name, value in session.items() if name not in new}
    older = replace(reduced, sessions=(session,), recipe={})
    write_reduced(tmp_path / "reduced.nc", older)
    page = "\n".join(*flight_section(tmp_path).values())
    assert "longitude 182.258°, latitude -23.814°<" in page
    assert "of the clock file" in page and "0x307" in page
    assert read_reduced(tmp_path / "reduced.nc").notes() == ()


def test_a_clock_that_the_sessions_do_not_say_is_told_in_one_line(simulated, reduced, tmp_path):
    (told,) = [line for line in reduced_lines(reduced) if "clock file" in line]
    assert told == (
        "session_000.h5 does not say which UTC the clock stands for: its scale (UTC) and epoch are "
        "those of the clock file clock.json."
    )
    # nothing to say where the session says it itself
    known = lb.load_scenario("fiducial", [*SET, "flight.simulated.clock=known"])
    made = run_simulate_flight(known, tmp_path)
    clock = f"flight.clock={simulated[0].flight.clock}"
    for given in ((), (clock,)):
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
    known = [x for x in (*reduced.line_scatter, *reduced.scatter) if np.isfinite(x)]
    assert [line.get_ydata()[0] for line in marks] == known and 0 < len(known) < 2
    assert [text.get_text() for text in right.texts] == [f"{known[0]:.3f}", "not known"]


def test_of_several_frequencies_noise_is_drawn_by_frequency(simulated):
    scenario, sessions = simulated
    several = reduce_files(sessions, scenario.model_copy(update={"frequencies_mhz": (15.0, 20.0)}))
    left, right = calibration(several).axes
    assert not left.containers
    (marks,) = [line for line in right.lines if line.get_marker() == "o"]
    np.testing.assert_array_equal(marks.get_xdata(), [15.0, 20.0])
    np.testing.assert_array_equal(marks.get_ydata(), several.line_scatter)
