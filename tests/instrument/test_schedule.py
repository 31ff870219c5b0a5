from datetime import datetime, timedelta

import astropy.units as u
import numpy as np
import pytest
from assertions import refuse, within
from astropy.time import Time
from reference import is_dark
from tables import tables

import lusee_bayes as lb
from lusee_bayes.instrument.schedule import CYCLE_DAYS, Interval, Run, read_schedule

TABLES = tables(__file__)

# three lunar nights at half duty, the table turned in the middle of the first and of the last
NIGHTS = """\
# the Sun sets at the site on 14 January, 13 February and 15 March 2027
start, end, turntable_deg, duty_cycle, night_only
2027-01-14T00:00:00Z, 2027-01-22T12:00:00Z, 0, 0.5, true
2027-01-22T12:30:00, 2027-01-31T00:00:00, 30, 0.5, true   # turned within half an hour

2027-02-13T00:00:00, 2027-03-01T00:00:00, 30, , TRUE
2027-03-14T00:00:00, 2027-03-22T12:00:00, 30, 0.25, true
2027-03-22T13:00:00, 2027-03-23, -60.5, 1, false
"""


WRITTEN = "schedule.csv"


def schedule(seed, n=5, **options):
    """Intervals of whole seconds, with and without time between them, of several angles."""
    rng = np.random.default_rng(seed)
    at, intervals = datetime(2027, 1, 15), []
    for _ in range(n):
        at += timedelta(seconds=int(rng.choice([0, 1, 4000])))
        end = at + timedelta(seconds=int(rng.integers(2, 50000)))
        angle, duty = float(rng.choice([0.0, 30.0])), float(rng.choice([1.0, 0.5, 0.1]))
        intervals.append(Interval(at.isoformat(), end.isoformat(), angle, duty, **options))
        at = end
    return intervals


def naive(intervals, step_s):
    """Start, end, live time and run of every window, one by one."""
    windows, run = [], -1
    for number, one in enumerate(intervals):
        if number == 0 or one.turntable_deg != intervals[number - 1].turntable_deg:
            run += 1
        at, last = datetime.fromisoformat(one.start), datetime.fromisoformat(one.end)
        while at < last:
            end = min(at + timedelta(seconds=step_s), last)
            windows.append((at, end, one.duty_cycle * (end - at).total_seconds(), run))
            at = end
    return windows


def seconds(observation, origin):
    return (observation.times - Time(origin)).to_value(u.s)


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("step_s", [600.0, 7200.0, 1234.5])
def test_intervals_are_cut_as_by_a_loop(seed, step_s):
    intervals = schedule(seed)
    o = lb.Observation.from_schedule(intervals, step_s=step_s)
    expected = naive(intervals, step_s)
    origin = expected[0][0]
    start, end = (np.array([(w[k] - origin).total_seconds() for w in expected]) for k in (0, 1))
    at = seconds(o, origin)
    # dates in two doubles, and sums of days in seconds: a nanosecond
    within(at, (start + end) / 2.0, 1e-8)
    within(at[:, None] + o.windows.bounds_s, np.stack([start, end], 1), 1e-8)
    within(o.live_s, [w[2] for w in expected], 1e-8)
    np.testing.assert_array_equal(o.run, [w[3] for w in expected])
    angles = [one.turntable_deg for one in intervals for _ in range(one.n_samples(step_s))]
    assert [o.turntable_deg[w[3]] for w in expected] == angles


def test_instants_begin_before_the_end():
    intervals = [
        Interval("2027-01-15T00:00:00", "2027-01-15T04:00:00"),  # two steps: the end is no sample
        Interval("2027-01-15T05:00:00", "2027-01-15T09:00:01"),  # a second more: it is
    ]
    o = lb.Observation.from_schedule(intervals, window="instant")
    within(seconds(o, "2027-01-15"), 3600.0 * np.array([0.0, 2.0, 5.0, 7.0, 9.0]), 1e-8)
    assert o.windows is None and (o.live_s == 7200.0).all()
    half = [Interval("2027-01-15", "2027-01-16", duty_cycle=0.5)]
    words = r"no duty cycle; use windows \(observation.window=mean\)"
    refuse(words, lb.Observation.from_schedule, half, window="instant")


@pytest.mark.parametrize("window", ["instant", "mean"])
@pytest.mark.parametrize("step_s", [7200.0, 5400.0])
def test_runs_are_a_schedule(window, step_s):
    """Runs of so many steps and a half: their samples fill the steps, the next begins later."""
    counts, angles = (10, 7, 12), (0.0, 30.0, -15.0)
    month = CYCLE_DAYS * 86400.0
    runs = [Run((n + 0.5) * step_s / month, a) for n, a in zip(counts, angles, strict=True)]
    given = {"lon_deg": 10.0, "lat_deg": 20.0, "step_s": step_s, "window": window}
    expected = lb.Observation.from_runs(runs, start="2027-02-01T00:00:00", **given)
    at, intervals = datetime(2027, 2, 1), []
    for n, angle in zip(counts, angles, strict=True):
        end = at + timedelta(seconds=n * step_s)
        intervals.append(Interval(at.isoformat(), end.isoformat(), angle))
        at = end + timedelta(seconds=0.5 * step_s)
    got = lb.Observation.from_schedule(intervals, **given)
    # lengths in cycles are rounded, to 1e-16 of 1e5 seconds, and so are differences of dates
    within((got.times - expected.times).to_value(u.s), 0.0, 1e-8)
    np.testing.assert_array_equal(got.run, expected.run)
    assert got.turntable_deg == expected.turntable_deg
    assert (got.lon_deg, got.lat_deg) == (expected.lon_deg, expected.lat_deg)
    within(got.live_s, expected.live_s, 1e-8)
    if window == "mean":
        within(got.windows.bounds_s, expected.windows.bounds_s, 1e-8)


def test_windows_at_night_are_dark_from_end_to_end():
    step_s, lon, lat = 40000.0, 182.258, -23.814
    dates = [("2027-01-14T00:00:00", "2027-01-31T00:00:00"), ("2027-02-01", "2027-02-16")]
    intervals = [Interval(*pair, night_only=True) for pair in dates]
    given = {"step_s": step_s, "lon_deg": lon, "lat_deg": lat}
    o = lb.Observation.from_schedule(intervals, **given)
    start, end = (Time([w[k] for w in naive(intervals, step_s)]) for k in (0, 1))
    middle = start + (end - start) / 2.0
    dark = np.array([is_dark(times, lon, lat) for times in (start, middle, end)])
    expected = dark.all(axis=0)
    # each of the two sunsets and the sunrise lies within a window
    assert (dark.any(axis=0) & ~expected).sum() == 3
    within((o.times - middle[expected]).to_value(u.s), 0.0, 1e-8)
    by_day = [Interval(*dates[0], night_only=True), Interval(*dates[1])]
    mixed = lb.Observation.from_schedule(by_day, **given)
    assert mixed.n_times == (expected | (start >= Time("2027-02-01"))).sum()
    instants = lb.Observation.from_schedule(intervals, window="instant", **given)
    assert instants.n_times == dark[0].sum()


def test_a_table_in_csv(write):
    intervals = read_schedule(write(NIGHTS))
    assert intervals == (
        Interval("2027-01-14T00:00:00Z", "2027-01-22T12:00:00Z", 0.0, 0.5, True),
        Interval("2027-01-22T12:30:00", "2027-01-31T00:00:00", 30.0, 0.5, True),
        Interval("2027-02-13T00:00:00", "2027-03-01T00:00:00", 30.0, 1.0, True),
        Interval("2027-03-14T00:00:00", "2027-03-22T12:00:00", 30.0, 0.25, True),
        Interval("2027-03-22T13:00:00", "2027-03-23", -60.5, 1.0, False),
    )
    assert intervals[2].where.endswith("schedule.csv, row 3")
    o = lb.Observation.from_schedule(intervals, step_s=7200.0)
    assert o.turntable_deg == (0.0, 30.0, -60.5)
    assert o.times[0].isot[:16] == "2027-01-15T03:00"  # sunset is late on the 14th
    columns = "turntable_deg,end,start\n7,2027-01-02,2027-01-01\n"
    assert read_schedule(write(columns)) == (Interval("2027-01-01", "2027-01-02", 7.0),)


HEADER = "start,end,turntable_deg,duty_cycle,night_only\n"


@pytest.mark.parametrize(("text", "message"), TABLES["bad tables"])
def test_bad_tables_are_refused(write, text, message):
    refuse(message, read_schedule, write(text.replace("HEADER", HEADER.strip())))


def test_an_interval_without_a_night_is_refused(write):
    # the Sun is up for two weeks from 1 February 2027 at this site
    text = f"{HEADER}2027-01-16,2027-01-17,0,1,true\n2027-02-05,2027-02-07,0,1,true\n"
    observe = lb.Observation.from_schedule
    words = "schedule.csv, row 2 contains no lunar night; lengthen it"
    refuse(words, observe, read_schedule(write(text)))
    unnamed = [Interval("2027-02-05", "2027-02-07", night_only=True)]
    refuse("interval 0.*no lunar night", observe, unnamed)


# a table as those of OpSim, with the states that its simulator adds
COMMANDS = """\
1:
  start:  61050.8 # first full day
  mode:   maint

2:
  start:  61065.7 # sunset
  mode:   science
  battery_expected_fill: 0.75
3:
  start:  61080.5
  mode:   powersave
4: {mode: science, start: 61095.25}
5: {mode: science, start: 61095.75}
6: {mode: powersave, start: 61096}
"""


def test_a_command_table_of_opsim(write):
    intervals = read_schedule(write(COMMANDS, "comtable.yml"))
    mjd = [(61065.7, 61080.5), (61095.25, 61095.75), (61095.75, 61096.0)]
    assert len(intervals) == 3
    for one, (start, end) in zip(intervals, mjd, strict=True):
        for text, days in ((one.start, start), (one.end, end)):
            expected = datetime(1858, 11, 17) + timedelta(days=days)
            # both to a microsecond; the day of an MJD is a double of 0.6
            assert abs((datetime.fromisoformat(text) - expected).total_seconds()) < 3e-6
        assert (one.turntable_deg, one.duty_cycle, one.night_only) == (0.0, 1.0, False)
    assert intervals[0].where.endswith("comtable.yml, entry 2")
    assert lb.Observation.from_schedule(intervals).n_runs == 1


@pytest.mark.parametrize(("text", "message"), TABLES["bad commands"])
def test_bad_command_tables_are_refused(write, text, message):
    refuse(message, read_schedule, write(text, "comtable.yml"))


def test_a_file_that_has_changed_is_read_again(write):
    path = write("start,end,turntable_deg\n2027-01-01,2027-01-02,0\n")
    assert read_schedule(path)[0].turntable_deg == 0.0
    write("start,end,turntable_deg\n2027-01-01,2027-01-02,30\n")
    assert read_schedule(path)[0].turntable_deg == 30.0
