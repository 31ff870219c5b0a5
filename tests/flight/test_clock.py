"""Mission clocks: which UTC they stand for, and what contradicts them."""

import json
import re
from datetime import datetime
from pathlib import Path

import numpy as np
import pytest
from assertions import refuse

from lusee_bayes.flight.clock import Clock, clock_of, read_clock
from lusee_bayes.testing.contracts import assert_refused

RECORD = {
    "format_version": 1,
    "reference_event": "landing",
    "clock_reference_isot": "2027-01-10T00:00:00",
    "time_scale": "utc",
    "clocks": {"spectrometer": {"clock_reference_raw_seconds": 100.0}},
    "source": "a record",
    "assumed": False,
}
RAW = np.array([100.0, 1e5, 3.0e7])


def written(tmp_path, **changes):
    path = tmp_path / "clock.json"
    record = {key: value for key, value in (RECORD | changes).items() if value is not None}
    path.write_text(json.dumps(record))
    return path


def seconds_after(time, text):
    """Since a date, by the standard library, which knows no leap seconds (there are none here)."""
    at = datetime.fromisoformat(time.isot[:23])
    return (at - datetime.fromisoformat(text)).total_seconds()


# TAI - UTC is 37 s since 2017, TT - TAI 32.184 s: a reading in TT is 69.184 s earlier in UTC. In a
# second of a clock that runs slow more than a second passes
@pytest.mark.parametrize(
    ("scale", "offset", "rate"),
    [("utc", 0.0, None), ("tai", -37.0, None), ("tt", -69.184, None), ("utc", 0.0, 1.0 + 1e-5)],
)
def test_seconds_since_the_reference_in_each_scale(tmp_path, scale, offset, rate):
    clock = read_clock(written(tmp_path, time_scale=scale, rate=rate))
    utc = clock.utc(RAW)
    for k, raw in enumerate(RAW):
        expected = (raw - 100.0) * (rate or 1.0) + offset
        # isot has milliseconds
        found = seconds_after(utc[k], "2027-01-10T00:00:00")
        assert found == pytest.approx(expected, abs=2e-3)


def test_times_are_exact_to_a_microsecond_over_a_year():
    clock = Clock("here", 2461550.5, 0.0, "utc", 0.0)
    raw = np.array([0.0, 3.0e7, 3.0e7 + 1e-3])
    utc = clock.utc(raw)
    assert (utc[2] - utc[1]).sec == pytest.approx(1e-3, abs=1e-6)


def test_a_clock_has_to_be_known_and_two_must_not_differ():
    said = Clock("file", 2461550.5, 0.0, "utc", 0.0)
    assert clock_of("session", said, None, RAW) is said
    assert clock_of("session", None, said, RAW) is said
    refuse(r"give --clock clock\.json \(epoch, scale, rate\)", clock_of, "session", None, None, RAW)
    other = Clock("clock.json", 2461550.5, 0.0, "tt", 0.0)
    refuse(r"differ by 69\.184 s", clock_of, "session", said, other, RAW)
    # the same said in another way
    same = Clock("clock.json", 2461550.5, 100.0 / 86400.0, "utc", 100.0)
    assert clock_of("session", said, same, RAW) is same


BAD = [
    {"format_version": 2},
    {"time_scale": "lunar"},
    {"clock_reference_isot": "yesterday"},
    {"clock_reference_isot": "2027-13-10T00:00:00"},
    {"clocks": {}},
    {"clocks": {"spectrometer": {"clock_reference_raw_seconds": "100"}}},
    {"clocks": {"spectrometer": {"clock_reference_raw_seconds": True}}},
    {"rate": 2.0},
    {"source": 3},
    {"drift": 1.0},
    {"clocks": {"spectrometer": {"clock_reference_raw_seconds": 100.0}, "spectrometre": {}}},
    {"clocks": {"spectrometer": {"clock_reference_raw_seconds": 100.0}, "dcb": 3}},
    {"clocks": {"spectrometer": {"clock_reference_raw_seconds": 10**400}}},
    {"rate": 10**400},
    {"stated_utc_isot": "2027-01-10T00:00:00"},
    {"stated_utc_isot": "then", "clocks": None},
]


def test_a_clock_file_that_cannot_be_is_refused(tmp_path):
    for changes in BAD:
        assert_refused(lambda changes=changes: read_clock(written(tmp_path, **changes)))
    clocks = {"spectrometer": {"clock_reference_raw_seconds": 100.0, "rate": 1.000001}}
    refuse("'rate'; write rate beside clocks", read_clock, written(tmp_path, clocks=clocks))
    path = tmp_path / "clock.json"
    path.write_text("{")
    assert_refused(lambda: read_clock(path))
    assert_refused(lambda: read_clock(tmp_path / "absent.json"))


def test_the_utc_that_a_session_states_is_corrected(tmp_path):
    """It moves by the offset at the reference, and by the rate times what has elapsed since."""
    stated, true = "2027-01-10T00:00:00", "2027-01-10T00:00:46"
    changes = {"clocks": None, "stated_utc_isot": stated, "clock_reference_isot": true}
    given = read_clock(written(tmp_path, rate=1.0 + 1e-6, **changes))
    # a session whose own clock has a rate and an epoch of its own
    said = Clock("session", 2461540.5, 0.0, "tt", 77.0, 1.0 - 1e-5)
    before, after = said.utc(RAW), clock_of("session", said, given, RAW).utc(RAW)
    elapsed = np.array([seconds_after(time, "2027-01-10T00:00:00") for time in before])
    np.testing.assert_allclose((after - before).sec, 46.0 + 1e-6 * elapsed, rtol=0, atol=1e-6)
    refuse("states no UTC", clock_of, "session", None, given, RAW)


def test_the_clock_files_of_the_documentation_are_read(tmp_path):
    page = Path(__file__).parents[2] / "docs" / "howto" / "first_light.md"
    known, corrected = re.findall(r"```json\n(.*?)```", page.read_text(), flags=re.DOTALL)
    for text in (known, corrected):
        (tmp_path / "clock.json").write_text(text)
        assert read_clock(tmp_path / "clock.json").rate == 1.000001
