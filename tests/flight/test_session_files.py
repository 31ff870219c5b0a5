"""Sessions of luseepy, of layout 4 made by hand, and our own; files that are damaged or foreign."""

import json
import re
import shutil
from dataclasses import replace
from datetime import datetime
from pathlib import Path

import h5py
import layout_4
import numpy as np
import pytest
from assertions import assert_same, refuse
from astropy.io import fits
from astropy.time import Time
from layout_4 import NAMES, RAW_S, write_families, write_layout_4
from tables import tables

from lusee_bayes.cli.main import main
from lusee_bayes.core.formats import is_session
from lusee_bayes.flight.clock import Clock, clock_of, read_clock
from lusee_bayes.flight.session import FLIGHT_PRODUCTS, OF_FLIGHT, TELEMETRY
from lusee_bayes.flight.session_files import SessionRows, read_session, write_session
from lusee_bayes.instrument.products import labels
from lusee_bayes.testing import assert_refused

KEPT = "raw_s", "navgf", "navg_shift", "level", "adc_low", "adc_high"


@pytest.fixture
def copy(flight, tmp_path):
    """A session that a test may damage."""
    path = tmp_path / "session.h5"
    shutil.copy(flight / "session_d.h5", path)
    path.chmod(0o644)
    return path


@pytest.fixture
def newer(tmp_path):
    """A session of layout 4 that a test may change."""
    return write_layout_4(tmp_path / "session_4.h5")


def test_what_a_session_says(flight):
    assert FLIGHT_PRODUCTS[:6] == ("00R", "11R", "22R", "33R", "01R", "01I")
    assert [FLIGHT_PRODUCTS[k] for k in OF_FLIGHT] == list(labels())
    session, truth = read_session(flight / "session_b.h5"), np.load(flight / "truth.npz")
    mine = truth["session"] == "b"
    assert (session.n_rows, session.layout, session.kind) == (40, 3, "HDF5")
    utc = session.clock.utc(session.raw_s)
    # MJD in one number is exact to a microsecond
    np.testing.assert_allclose(utc.mjd, truth["mjd_utc"][mine], rtol=0, atol=1e-10)
    assert ["".join(row) for row in session.level[[0, 19, 20, 39]]] == ["MMMM"] * 2 + ["MMLL"] * 2
    np.testing.assert_array_equal(session.frames, float(truth["n_averages"]))
    np.testing.assert_allclose(session.window_s, float(truth["integration_s"]), rtol=1e-12)
    assert (session.lon_deg, session.lat_deg) == (float(truth["lon_deg"]), float(truth["lat_deg"]))


def test_fits_and_hdf5_hold_the_same(flight):
    a, b = (read_session(flight / f"session_a.{kind}") for kind in ("h5", "fits"))
    assert b.kind == "FITS"
    assert_same(a, b, *KEPT, "errors")
    assert a.telemetry.keys() == b.telemetry.keys()
    for name, values in a.telemetry.items():
        np.testing.assert_array_equal(values, b.telemetry[name])
    np.testing.assert_array_equal(a.clock.utc(a.raw_s).jd, b.clock.utc(b.raw_s).jd)
    with a.spectra() as one, b.spectra() as other:
        np.testing.assert_array_equal(one(7, 12), other(7, 12))


def test_sessions_are_told_from_other_files(flight, tmp_path):
    assert is_session(flight / "session_a.h5")
    assert is_session(flight / "session_a.fits")
    other = tmp_path / "other.h5"
    with h5py.File(other, "w") as file:
        file["data"] = np.zeros(3)
    assert not is_session(other)
    fits.PrimaryHDU(np.zeros(3)).writeto(tmp_path / "other.fits")
    assert not is_session(tmp_path / "other.fits")
    assert_refused(lambda: read_session(other))
    (tmp_path / "text.h5").write_text("no")
    assert_refused(lambda: read_session(tmp_path / "text.h5"))


def change(file, name, value):
    shape = file[name][()]
    del file[name]
    file[name] = value(shape)


def test_gains_in_letters_are_the_same(copy):
    numbers = read_session(copy).level
    with h5py.File(copy, "a") as file:
        change(file, "spectra/metadata/actual_gain", lambda x: np.full(x.shape, b"M"))
    np.testing.assert_array_equal(read_session(copy).level, numbers)


def test_what_a_session_of_layout_4_says(newer):
    session, rows = read_session(newer), layout_4.metadata()
    assert is_session(newer)
    assert (session.n_rows, session.layout, session.kind) == (layout_4.N, 4, "HDF5")
    assert (session.lon_deg, session.lat_deg, session.software) == (182.258, -23.814, "0x307")
    expected = {
        "raw_s": RAW_S,
        "navgf": 2,
        "frames": 2.0**14 * layout_4.WEIGHT,
        "level": np.array(list("LMH"))[layout_4.GAINS],
        "adc_low": rows["adc_min"],
        "adc_high": rows["adc_max"],
        "adc_invalid": rows["adc_invalid_count_max"],
        "errors": rows["errors"],
        "notch": layout_4.NOTCH,
    }
    for name, values in expected.items():
        np.testing.assert_array_equal(getattr(session, name), values)
    np.testing.assert_allclose(session.window_s, 2**20 * 40e-6, rtol=1e-12)
    assert session.telemetry.keys() == set(NAMES[1:])
    for name, values in session.telemetry.items():
        np.testing.assert_allclose(values, layout_4.telemetry(name, RAW_S), rtol=1e-9)
    utc, elapsed = session.clock.utc(RAW_S), RAW_S - layout_4.SPECTROMETER_S
    np.testing.assert_allclose((utc - Time(layout_4.LANDING)).sec, elapsed, atol=1e-5)
    with session.spectra() as read:
        np.testing.assert_array_equal(read(1, 4), layout_4.counts()[1:4])


def test_telemetry_that_is_marked_as_invalid_is_not_used(newer):
    with h5py.File(newer, "a") as file:
        k = NAMES.index("THERM_FPGA")
        file["telemetry/values"][5:9, k] = -999.0
        file["telemetry/valid"][5:9, k] = False
    found = read_session(newer).telemetry["THERM_FPGA"]
    np.testing.assert_allclose(found, layout_4.telemetry("THERM_FPGA", RAW_S), rtol=1e-9)


def test_families_that_are_not_used_are_named(newer, capsys):
    def not_used():
        assert main(["info", str(newer)]) == 0
        return [line for line in capsys.readouterr().out.splitlines() if "not used" in line]

    assert not not_used()
    rows = {"calibrator__zoom_spectra": 12, "tr_spectra": 2, "calibrator__data": 3}
    write_families(newer, **rows, grimm_spectra=1, housekeeping=4)
    (line,) = not_used()
    for name, n in (("time-resolved spectra", 2), ("zoom spectra", 12), ("calibrator data", 3)):
        assert f"{name} ({n} rows)" in line
    assert "Grimm's spectra (1 row)" in line and "housekeeping (4 rows)" in line


def test_without_a_clock_reference_the_telemetry_of_layout_4_is_not_known(newer):
    with h5py.File(newer, "a") as file:
        file["clock_reference"].attrs["available"] = np.bool_(False)
    session = read_session(newer)
    assert session.clock is None and not session.telemetry


ROWS = 7
CLOCK = Clock("test", 2400000.5, 61192.0, "utc", 1000.0)
KINDS = ["hdf5", "fits"]


def some_rows(**changes):
    rng = np.random.default_rng(5)
    rows = SessionRows(
        raw_s=2.3e7 + 0.7 + 42.0 * np.arange(ROWS),
        navgf=np.full(ROWS, 2),
        navg_shift=np.full(ROWS, 20),
        level=np.array([list("MMMM")] * 3 + [list("LMHL")] * 4),
        bitslice=rng.integers(0, 31, (ROWS, 16)),
        adc_low=-rng.integers(100, 8000, (ROWS, 4)),
        adc_high=rng.integers(100, 8000, (ROWS, 4)),
        adc_invalid=rng.integers(0, 3, (ROWS, 4)),
        adc_rms=rng.uniform(50.0, 300.0, (ROWS, 4)),
        telemetry={name: rng.uniform(1.0, 30.0, ROWS) for name in TELEMETRY},
        clock=CLOCK,
        lon_deg=182.258,
        lat_deg=-23.814,
        software=775,
    )
    return replace(rows, **changes)


def written_counts(bins=2048):
    return np.random.default_rng(6).normal(size=(ROWS, 16, bins)).astype(np.float32)


def in_blocks(counts, *sizes):
    start = 0
    for size in sizes:
        yield counts[start : start + size]
        start += size


@pytest.mark.parametrize("kind", KINDS)
def test_a_session_comes_back_from_its_file(tmp_path, kind):
    rows, counts = some_rows(), written_counts()
    counts[2, 3] = np.nan
    path = write_session(tmp_path / "session", rows, in_blocks(counts, 4, 1, 2), kind=kind)
    assert is_session(path)
    found = read_session(path)
    assert (found.layout, found.kind) == (3, kind.upper())
    assert found.software == "0x307"
    assert (found.lon_deg, found.lat_deg) == (rows.lon_deg, rows.lat_deg)
    assert_same(found, rows, *KEPT, "adc_invalid")
    np.testing.assert_array_equal(found.share, 1.0)
    assert not found.errors.any()
    for name in TELEMETRY:
        np.testing.assert_array_equal(found.telemetry[name], rows.telemetry[name])
    assert found.clock.differs_s(CLOCK, rows.raw_s) < 1e-6
    with found.spectra() as read:
        np.testing.assert_array_equal(read(0, ROWS), counts)
        np.testing.assert_array_equal(read(3, 5), counts[3:5])


@pytest.mark.parametrize("kind", KINDS)
def test_bins_that_are_not_there_are_nan_and_a_clock_may_be_unknown(tmp_path, kind):
    path = write_session(tmp_path / "s", some_rows(clock=None), [written_counts(512)], kind=kind)
    found = read_session(path)
    assert found.clock is None
    with found.spectra() as read:
        counts = read(0, ROWS)
    np.testing.assert_array_equal(counts[..., :512], written_counts(512))
    assert np.isnan(counts[..., 512:]).all()


@pytest.mark.parametrize("kind", KINDS)
def test_what_is_no_session_leaves_nothing_behind(tmp_path, kind):
    few, text = [written_counts()[:4]], "counts of 4 spectra for 7 rows"
    refuse(text, write_session, tmp_path / "s", some_rows(), few, kind=kind)
    assert not list(tmp_path.iterdir())


# --- what cannot be -------------------------------------------------------------------------------


def versioned(version):
    return lambda file: file.attrs.__setitem__("layout_version", version)


def of_data(name, value):
    return lambda file: file["spectra/data"].attrs.__setitem__(name, value)


def replaced(name, value):
    return lambda file: change(file, name, value)


def filled(name, value):
    return lambda file: file[name].__setitem__(..., value)


def lacking(*names):
    """Without each of these, which is named; luseepy's names of both layouts are those of one."""
    told = (name.split("/")[-1].replace("raw_seconds", "raw_times") for name in names)
    return [(word, lambda file, name=name: file.__delitem__(name))
            for word, name in zip(told, names, strict=True)]  # fmt: skip


FIELDS, RAW, GAIN = "spectra/metadata/fields", "spectra/raw_times", "spectra/metadata/actual_gain"
DAMAGE = {
    3: [
        ("ingest the session again", versioned(2)),
        ("reads 3 and 4", versioned(5)),
        ("no layout_version", lambda file: file.attrs.__delitem__("layout_version")),
        ("", replaced(RAW, lambda x: x[::-1])),
        ("", replaced(RAW, lambda x: np.append(x[:-1], np.nan))),
        ("", replaced(RAW, lambda x: x[:-1])),
        ("", replaced("spectra/mjd_times", lambda x: x + 1.0)),
        ("", replaced("spectra/metadata/Navgf", lambda x: x + 6)),
        ("", replaced(GAIN, lambda x: x[:, :3])),
        ("", replaced(GAIN, lambda x: x.astype(float))),
        ("", replaced("spectra/data", lambda x: x[:, :12])),
        ("", replaced("spectra_interpolated_telemetry/time", lambda x: x + 1.0)),
        ("", of_data("bitslice_restored", 0)),
        ("", of_data("units", "counts")),
        ("", of_data("normalization_version", 2)),
        *lacking("spectra", "spectra/data", RAW, "constants", GAIN),
        *lacking(*(f"spectra/metadata/{name}" for name in ("Navgf", "Navg2_shift", "adc_min"))),
        *lacking("spectra/metadata/actual_bitslice"),
    ],
    4: [
        ("raw_time_valid", filled("spectra/raw_time_valid", False)),
        ("row_indices", filled(f"{FIELDS}/adc_min/variant_000/row_indices", 10**6)),
        ("navgf", filled(f"{FIELDS}/navgf/variant_000/data", 1)),
        ("does not cover the spectra", filled("telemetry/mission_seconds", 7)),
        *lacking("spectra", "spectra/raw_seconds", "constants", "telemetry/values"),
        *lacking(f"{FIELDS}/adc_min", f"{FIELDS}/actual_gain"),
    ],
}


DAMAGED = [(k, *one) for k, damages in DAMAGE.items() for one in damages]


@pytest.mark.parametrize(("layout", "words", "damage"), DAMAGED)
def test_damaged_and_foreign_sessions_are_refused(request, layout, words, damage):
    path = request.getfixturevalue({3: "copy", 4: "newer"}[layout])
    with h5py.File(path, "a") as file:
        damage(file)
    refuse(words, read_session, path)


def test_layout_4_in_fits_is_refused(tmp_path):
    primary = fits.PrimaryHDU()
    primary.header["LAYOUTV"] = 4
    primary.writeto(tmp_path / "s.fits")
    refuse("as HDF5", read_session, tmp_path / "s.fits")


# --- mission clocks: which UTC they stand for, and what contradicts them --------------------------


TABLES = tables(__file__)
SECONDS = np.array([100.0, 1e5, 3.0e7])


def clock_file(tmp_path, **changes):
    path = tmp_path / "clock.json"
    record = {
        key: value for key, value in (TABLES["record"] | changes).items() if value is not None
    }
    path.write_text(json.dumps(record))
    return path


def seconds_after(time, text):
    """Since a date, by the standard library, which knows no leap seconds (there are none here)."""
    return (datetime.fromisoformat(time.isot[:23]) - datetime.fromisoformat(text)).total_seconds()


# TAI - UTC is 37 s since 2017, TT - TAI 32.184 s: a reading in TT is 69.184 s earlier in UTC. In a
# second of a clock that runs slow more than a second passes
SCALES = [("utc", 0.0, None), ("tai", -37.0, None), ("tt", -69.184, None), ("utc", 0.0, 1.0 + 1e-5)]


@pytest.mark.parametrize(("scale", "offset", "rate"), SCALES)
def test_seconds_since_the_reference_in_each_scale(tmp_path, scale, offset, rate):
    utc = read_clock(clock_file(tmp_path, time_scale=scale, rate=rate)).utc(SECONDS)
    for k, raw in enumerate(SECONDS):
        expected = (raw - 100.0) * (rate or 1.0) + offset
        # isot has milliseconds
        assert seconds_after(utc[k], "2027-01-10T00:00:00") == pytest.approx(expected, abs=2e-3)


def test_times_are_exact_to_a_microsecond_over_a_year():
    utc = Clock("here", 2461550.5, 0.0, "utc", 0.0).utc(np.array([0.0, 3.0e7, 3.0e7 + 1e-3]))
    assert (utc[2] - utc[1]).sec == pytest.approx(1e-3, abs=1e-6)


def test_a_clock_has_to_be_known_and_two_must_not_differ():
    said = Clock("file", 2461550.5, 0.0, "utc", 0.0)
    assert clock_of("session", said, None, SECONDS) is said
    assert clock_of("session", None, said, SECONDS) is said
    words = r"give --clock clock\.json \(epoch, scale, rate\)"
    refuse(words, clock_of, "session", None, None, SECONDS)
    other = Clock("clock.json", 2461550.5, 0.0, "tt", 0.0)
    refuse(r"differ by 69\.184 s", clock_of, "session", said, other, SECONDS)
    # the same said in another way
    same = Clock("clock.json", 2461550.5, 100.0 / 86400.0, "utc", 100.0)
    assert clock_of("session", said, same, SECONDS) is same


def test_a_clock_file_that_cannot_be_is_refused(tmp_path, write):
    # whole numbers that no float can be
    huge = {"clocks": {"spectrometer": {"clock_reference_raw_seconds": 10**400}}}
    for changes in (*TABLES["bad clocks"], huge, {"rate": 10**400}):
        assert_refused(lambda changes=changes: read_clock(clock_file(tmp_path, **changes)))
    clocks = {"spectrometer": {"clock_reference_raw_seconds": 100.0, "rate": 1.000001}}
    refuse("clocks.spectrometer.rate", read_clock, clock_file(tmp_path, clocks=clocks))
    assert_refused(lambda: read_clock(write("{", "clock.json")))
    assert_refused(lambda: read_clock(tmp_path / "absent.json"))


def test_the_utc_that_a_session_states_is_corrected(tmp_path):
    """It moves by the offset at the reference, and by the rate times what has elapsed since."""
    stated, true = "2027-01-10T00:00:00", "2027-01-10T00:00:46"
    changes = {"clocks": None, "stated_utc_isot": stated, "clock_reference_isot": true}
    given = read_clock(clock_file(tmp_path, rate=1.0 + 1e-6, **changes))
    # a session whose own clock has a rate and an epoch of its own
    said = Clock("session", 2461540.5, 0.0, "tt", 77.0, 1.0 - 1e-5)
    before, after = said.utc(SECONDS), clock_of("session", said, given, SECONDS).utc(SECONDS)
    elapsed = np.array([seconds_after(time, "2027-01-10T00:00:00") for time in before])
    np.testing.assert_allclose((after - before).sec, 46.0 + 1e-6 * elapsed, rtol=0, atol=1e-6)
    refuse("contains no UTC", clock_of, "session", None, given, SECONDS)


def test_the_clock_files_of_the_documentation_are_read(tmp_path):
    page = Path(__file__).parents[2] / "docs" / "howto" / "first_light.md"
    known, corrected = re.findall(r"```json\n(.*?)```", page.read_text(), flags=re.DOTALL)
    for text in (known, corrected):
        (tmp_path / "clock.json").write_text(text)
        assert read_clock(tmp_path / "clock.json").rate == 1.000001
