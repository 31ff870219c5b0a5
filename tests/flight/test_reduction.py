"""Reduced spectra against the sums written out, one spectrum after the other."""

import shutil
from dataclasses import replace

import h5py
import numpy as np
import pytest
from assertions import assert_same, refuse
from astropy import units as u
from naive_flight import FLIGHT_ORDER, naive_band

from lusee_bayes.flight import gain_model, reduction
from lusee_bayes.flight import reduced as rd
from lusee_bayes.flight.recipe import FlightSection, Recipe, timeline
from lusee_bayes.flight.reduction import reduce_sessions
from lusee_bayes.flight.session_files import read_session
from lusee_bayes.instrument.averaging import averaged
from lusee_bayes.instrument.products import auto_indices, labels
from lusee_bayes.instrument.times import seconds_from
from lusee_bayes.instrument.visibilities import read_visibilities
from lusee_bayes.testing import assert_refused

F = (10.0, 25.0)


@pytest.fixture(scope="module")
def truth(flight):
    """V^2/Hz at the receivers' inputs, receiver noise with it, in the package's order."""
    found = dict(np.load(flight / "truth.npz"))
    rows = zip(found["session"], found["row"], strict=True)
    found["name"] = np.array([f"{session}{row}" for session, row in rows])
    found["total"] = found["visibility_v2_hz"].copy()
    found["total"][:, auto_indices()] += found["receiver_noise_v2_hz"]
    return found


@pytest.fixture(scope="module")
def table(flight):
    return gain_model.read_gain_table(flight / "gain")


def sessions(flight, names="abcd"):
    return [read_session(flight / f"session_{name}.h5") for name in names]


def recipe(table, timestamp="instant", average_s=None, lines=(), **section):
    section = FlightSection(bin_origin="centre", **section)
    return Recipe(section, table, timestamp, F, average_s, lines)


@pytest.fixture(scope="module")
def reduced(flight, table):
    return reduce_sessions(sessions(flight), recipe(table))


@pytest.mark.parametrize(("name", "row"), [("a", 3), ("b", 30), ("c", 15)])
def test_values_are_those_of_sums_written_out(flight, reduced, name, row):
    at = {"a": 0, "b": 40, "c": 80}[name] + row
    for band, f in enumerate(F):
        expected, _ = naive_band(flight, name, row, f)
        scale, found = np.abs(expected[auto_indices()]).max(), reduced.values[band, :, at]
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-12 * scale)


def test_the_known_sky_comes_out_within_the_noise(reduced, truth):
    """Every auto of every spectrum that is not flagged or disturbed, in standard deviations."""
    good = ~np.isin(truth["name"], [f"{s}{r}" for s, r in truth["comb"] if s == "c"])
    for band in range(2):
        values, total = reduced.values[band], truth["total"][band]
        autos = auto_indices()
        z = (values - total)[autos] / total[autos] * np.sqrt(reduced.n_averaged[band])
        z = z[:, good & (reduced.reason[band] == rd.USED)]
        z = z[np.isfinite(z)]
        assert len(z) > 480
        # autos of four ports under one sky are correlated: fewer independent ones
        assert np.sqrt(np.mean(z**2)) == pytest.approx(1.0, abs=0.15)
        assert np.abs(z).max() < 5.0


def test_noise_is_that_of_independent_samples(reduced, truth):
    """A parabola over n channels has 9/4 of the variance of their mean, for large n."""
    n = 41
    exact = (9.0 * n**2 - 21.0) / (4.0 * n**2 - 16.0)  # sum of squares of the smoothing weights
    expected = float(truth["n_averages"]) * n / exact
    # steep spectra and their noise change it by less than 1e-3
    np.testing.assert_allclose(reduced.n_averaged[:, :40], expected, rtol=2e-3)


def test_flags_are_those_of_what_was_injected(reduced, truth):
    name = truth["name"]
    saturated = np.isin(name, [f"{s}{r}" for s, r in truth["saturated"]])
    for band in range(2):
        np.testing.assert_array_equal(reduced.reason[band] == rd.SATURATED, saturated)
        # of native channels, a comb costs every fourth
        comb = np.isin(name, [f"{s}{r}" for s, r in truth["comb"] if s == "d"])
        np.testing.assert_array_equal(reduced.lines[band] > 0.2, comb | saturated)
    expected = np.zeros(reduced.values.shape[1:], dtype=bool)
    for session, row, product in truth["missing"]:
        at = int(np.flatnonzero(name == f"{session}{row}")[0])
        expected[labels().index(FLIGHT_ORDER[int(product)]), at] = True
    expected[:, saturated] = True
    np.testing.assert_array_equal(np.isnan(reduced.values[0]), expected)


def test_the_notch_and_the_comb_take_whole_spectra_where_they_are_known(flight, table):
    found = reduce_sessions(sessions(flight, "c"), recipe(table, comb="always"))
    assert (found.reason[0][[0, 1]] == rd.COMB).all()
    found = reduce_sessions(sessions(flight, "d"), recipe(table, comb="never"))
    assert (found.reason == rd.USED).all()


def test_known_lines_are_left_out(flight, table):
    clean = reduce_sessions(sessions(flight, "a"), recipe(table))
    found = reduce_sessions(sessions(flight, "a"), recipe(table, lines=(10.0,)))
    np.testing.assert_allclose(found.lines[0], 3.0 / 41.0, rtol=1e-6)
    assert not found.lines[1].any()
    assert (found.n_averaged[0] < clean.n_averaged[0]).all()


def test_pieces_make_no_difference(flight, table, monkeypatch):
    given = {"timestamp": "middle", "average_s": 4 * 3600.0}
    whole = reduce_sessions(sessions(flight), recipe(table, **given))
    monkeypatch.setattr(reduction, "SLAB", 3)
    monkeypatch.setattr(reduction, "PIECE", 1)
    pieces = reduce_sessions(sessions(flight)[::-1], recipe(table, **given))
    np.testing.assert_allclose(pieces.values, whole.values, rtol=1e-12)
    np.testing.assert_array_equal(pieces.reason, whole.reason)
    np.testing.assert_allclose(pieces.n_averaged, whole.n_averaged, rtol=1e-12)


def test_averages_are_means_of_the_spectra(flight, table, reduced):
    """Bins of 4 h end where gains change, and have the samples of all of their spectra."""
    given = recipe(table, timestamp="middle", average_s=4 * 3600.0)
    found = reduce_sessions(sessions(flight), given)
    states = np.array(["".join(row) for row in found.level])
    assert (states[found.bin_of[40:60]] == "MMMM").all()
    assert (states[found.bin_of[60:80]] == "MMLL").all()
    for bin_ in np.unique(found.bin_of[:40]):
        rows = np.flatnonzero(found.bin_of == bin_)
        assert len(rows) <= 8
        expected = reduced.values[1][:, rows].mean(axis=1)
        np.testing.assert_allclose(found.values[1][:, bin_], expected, rtol=1e-12)
        averaged = reduced.n_averaged[1, rows].sum()
        assert found.n_averaged[1, bin_] == pytest.approx(averaged, rel=1e-6)
    # the windows of a bin are those of its spectra
    live = found.at(25.0, np.ones(4)).observation.live_s[0]
    assert live == pytest.approx((found.bin_of == 0).sum() * 2.0**25 * 4e-5, rel=1e-9)


def test_kelvin_are_what_an_enclosure_makes(reduced):
    data = reduced.at(10.0, np.array([1.0, 4.0, 9.0, 16.0]) * 1e-22)
    at = labels().index("12I")
    kelvin = np.asarray(data.grid())[at, :40]
    np.testing.assert_allclose(kelvin * 6e-22, reduced.values[0, at, :40], rtol=1e-12)
    assert data.calibration.n_averaged.shape == (data.layout.n_times,)


def test_gain_errors_are_those_of_the_levels(flight, table):
    given = recipe(table, gain_std=0.02)
    found = reduce_sessions(sessions(flight, "b"), given).at(10.0, np.ones(4) * 1e-22)
    calibration = found.calibration
    assert calibration.gain_names == ("L2", "L3", "M0", "M1", "M2", "M3")
    assert calibration.gain_port.tolist() == [2, 3, 0, 1, 2, 3]
    slope = calibration.gain_slope
    np.testing.assert_array_equal(slope[0] > 0, np.arange(40) >= 20)
    np.testing.assert_array_equal(slope[4] > 0, np.arange(40) < 20)
    np.testing.assert_allclose(slope[2], 0.02)


def test_shares_of_flags_are_those_of_the_values_that_there_were(reduced):
    """Of 20 spectra 2 hold no data, 3 are bursts, 2 saturated; half of the rest does not fit."""
    reason = np.full(reduced.reason.shape, rd.NO_DATA, dtype=np.uint8)
    reason[0, :20] = rd.USED
    burst, saturated = 3 * [rd.BURST], 2 * [rd.SATURATED]
    reason[0, :7] = [rd.NO_DATA, rd.NO_DATA, *burst, *saturated]
    some = replace(reduced, reason=reason)
    assert some.flagged(0) == pytest.approx({"saturated": 2 / 18, "burst": 3 / 18})
    line = some.flag_line(0, 0.5)
    assert line.startswith("flagged 63.89% of the values: ")
    assert "does not fit the map 36.11%" in line and "burst 16.67%" in line
    told = [text for text in some.doubts(0) if "more than 20 %" in text]
    assert len(told) == 1 and "burst 16.67%" in told[0]
    assert not any("20 %" in text for text in reduced.doubts(0))


def test_files_of_reduced_spectra_hold_all(reduced, tmp_path):
    found = rd.read_reduced(rd.write_reduced(tmp_path / "reduced.nc", reduced))
    assert_same(found, reduced, "values", "n_averaged", "reason", "gain", "gain_slope", "bin_of")
    assert_same(found, reduced, "level", "lines")
    a, b = (one.at(25.0, np.ones(4)) for one in (found, reduced))
    assert a.digest() == b.digest()
    assert_refused(lambda: found.at(11.0, np.ones(4)))


def test_bins_that_do_not_fit_are_taken_out(reduced):
    gone = np.zeros(reduced.values.shape[1:], dtype=bool)
    gone[:, [3, 108]] = True
    gone[5, 7] = True
    less = reduced.without(0, gone)
    assert np.isnan(less.values[0, 5, 7])
    n_before, n_after = (one.at(10.0, np.ones(4)).layout.n_times for one in (reduced, less))
    assert n_after == n_before - 2
    assert (less.reason[0][[3, 108]] == rd.NO_FIT).all()
    assert less.shares(0)[rd.REASONS[rd.NO_FIT]] > 0
    np.testing.assert_array_equal(less.values[1], reduced.values[1])


def test_spectra_of_fewer_frames_are_as_bright(flight, table, reduced, tmp_path):
    """The flight software sends the sum of the accepted frames over the number of all."""
    path = shutil.copy(flight / "session_a.h5", tmp_path)
    with h5py.File(path, "a") as file:
        frames = 2.0 ** file["spectra/metadata/Navg2_shift"][...]
        weight = np.rint(np.linspace(0.25, 1.0, 40) * frames).astype(int)
        weight[5] = 0
        share = weight / frames
        file["spectra/data"][...] = file["spectra/data"][...] * share[:, None, None]
        file["spectra/metadata/weight"] = weight
    found = reduce_sessions([read_session(path)], recipe(table, timestamp="middle"))
    kept = np.arange(40) != 5
    for band in range(2):
        assert found.reason[band, 5] == rd.NO_DATA
        expected = reduced.values[band][:, :40][:, kept]
        # counts have single precision
        np.testing.assert_allclose(found.values[band][:, kept], expected, rtol=1e-5, atol=1e-22)
        n = share * reduced.n_averaged[band, :40]
        np.testing.assert_allclose(found.n_averaged[band][kept], n[kept], rtol=1e-5)


@pytest.mark.parametrize("ticks", [4096.0, 65536.0])
def test_spectra_without_gaps_have_windows_without_overlaps(flight, table, ticks):
    """A spectrum is no whole number of ticks of the clock that its time is told by."""
    (one,) = sessions(flight, "a")
    length = float(one.window_s[0])
    raw_s = one.raw_s[0] + length * np.arange(one.n_rows)
    one = replace(one, raw_s=np.floor(raw_s * ticks) / ticks)
    seen = timeline([one], recipe(table, timestamp="end")).observation
    start, end = seen.windows.bounds_s.T
    gaps = np.diff(seconds_from(seen.times[0], seen.times)) + start[1:] - end[:-1]
    assert gaps.min() > -1e-6 and gaps.max() < 1.5 / ticks
    np.testing.assert_allclose(end - start, length, atol=1.5 / ticks)


def test_the_turntable_turns_when_the_scenario_says(flight, table, reduced):
    """Between spectra 29 and 30, in the middle of a bin."""
    times = reduced.observation.times
    turned = times[29] + 0.5 * (times[30] - times[29])
    turns = {"2049-01-01": 90.0, turned.isot: 30.0}
    given = {"timestamp": "middle", "average_s": 4 * 3600.0, "turntable_deg": -5.0}
    given = recipe(table, **given, turns=turns)
    seen = reduce_sessions(sessions(flight), given).at(25.0, np.ones(4)).observation
    assert seen.turntable_deg == (-5.0, 30.0)
    start, end = seconds_from(turned, seen.times) + seen.windows.bounds_s.T
    assert (end[seen.run == 0] < 0.0).all() and (start[seen.run == 1] > 0.0).all()
    assert end[seen.run == 0].max() > -1800.0 and start[seen.run == 1].min() < 1800.0
    # a spectrum that sees the turn is of no use
    at = read_session(flight / "session_a.h5")
    given = recipe(table, timestamp="start", turns={(times[3] + 60.0 * u.s).isot: 30.0})
    one = reduce_sessions([at, *sessions(flight, "bcd")], given)
    np.testing.assert_array_equal(one.reason[:, 2:5] == rd.NO_DATA, [[False, True, False]] * 2)
    # turns are stated to a millisecond: here 0.4 ms into a spectrum
    given = recipe(table, timestamp="start", turns={(times[3] + 4e-4 * u.s).isot: 30.0})
    one = reduce_sessions([at, *sessions(flight, "bcd")], given)
    assert not (one.reason[:, 2:5] == rd.NO_DATA).any()
    given = recipe(table, turns={"noon": 3})
    refuse("flight.turns.*noon", reduce_sessions, sessions(flight), given)


def test_an_auto_of_zero_takes_its_port_along(flight, table, tmp_path):
    path = shutil.copy(flight / "session_a.h5", tmp_path)
    with h5py.File(path, "r+") as file:
        file["spectra/data"][3, 0] = 0
    values = reduce_sessions([read_session(path)], recipe(table)).values[:, :, 3]
    np.testing.assert_array_equal(np.isnan(values), [["0" in name for name in labels()]] * 2)


def test_averages_of_files_are_those_of_the_reduction(flight, table, tmp_path):
    """The samples and the gain errors behind a time, through a file and into averages."""
    given = {"timestamp": "middle", "gain_std": 0.02}
    fine = reduce_sessions(sessions(flight, "b"), recipe(table, **given)).at(10.0, np.ones(4))
    read = read_visibilities(fine.write(tmp_path / "fine.nc"))
    assert read.calibration.gain_names == fine.calibration.gain_names
    told = "n_averaged", "gain_port", "gain_slope", "lost"
    assert_same(read.calibration, fine.calibration, *told)
    # bins of 2 h, none of which holds the change of gains after 10 h
    coarse = averaged(read, 7200.0)
    expected = reduce_sessions(sessions(flight, "b"), recipe(table, average_s=7200.0, **given))
    expected = expected.at(10.0, np.ones(4))
    np.testing.assert_allclose(coarse.data, expected.data, rtol=1e-12)
    for name in ("n_averaged", "gain_slope"):
        found = getattr(coarse.calibration, name)
        np.testing.assert_allclose(found, getattr(expected.calibration, name), rtol=1e-12)


def test_what_contradicts_itself_is_refused(flight, table):
    a, unknown = sessions(flight, "a")[0], read_session(flight / "session_a_unknown_time_scale.h5")
    refuse("does not specify the UTC", reduce_sessions, [unknown], recipe(table))
    refuse("overlap in time", reduce_sessions, [a, a], recipe(table))
    refuse("cannot be averaged", reduce_sessions, [a], recipe(table, average_s=7200.0))
    refuse("shorter", reduce_sessions, [a], recipe(table, timestamp="middle", average_s=60.0))
    refuse("lacks", reduce_sessions, [replace(a, telemetry={})], recipe(table))
