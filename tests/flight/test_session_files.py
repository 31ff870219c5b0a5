"""Sessions as luseepy's own writer has written them, and files that are damaged or foreign."""

import shutil

import h5py
import numpy as np
import pytest
from astropy.io import fits
from astropy.time import Time
from layout_4 import (
    GAINS,
    LANDING,
    NAMES,
    NOTCH,
    RAW_S,
    SPECTROMETER_S,
    WEIGHT,
    N,
    counts,
    metadata,
    telemetry,
    write_families,
    write_layout_4,
)

from lusee_bayes.cli.main import main
from lusee_bayes.core.errors import InputError
from lusee_bayes.flight.session import FLIGHT_PRODUCTS, OF_FLIGHT
from lusee_bayes.flight.session_files import is_session, read_session
from lusee_bayes.instrument.products import labels
from lusee_bayes.testing import assert_refused


@pytest.fixture(scope="module")
def flight(test_data):
    if not (test_data / "flight").is_dir():
        pytest.skip("no flight sessions")
    return test_data / "flight"


@pytest.fixture
def copy(flight, tmp_path):
    """A session that a test may damage."""
    path = tmp_path / "session.h5"
    shutil.copy(flight / "session_d.h5", path)
    path.chmod(0o644)
    return path


def test_products_are_in_the_spectrometers_order():
    assert FLIGHT_PRODUCTS[:6] == ("00R", "11R", "22R", "33R", "01R", "01I")
    assert [FLIGHT_PRODUCTS[k] for k in OF_FLIGHT] == list(labels())


def test_what_a_session_says(flight):
    session = read_session(flight / "session_b.h5")
    truth = np.load(flight / "truth.npz")
    mine = truth["session"] == "b"
    assert (session.n_rows, session.layout, session.kind) == (40, 3, "HDF5")
    utc = session.clock.utc(session.raw_s)
    # MJD in one number is exact to a microsecond
    np.testing.assert_allclose(utc.mjd, truth["mjd_utc"][mine], rtol=0, atol=1e-10)
    assert ["".join(row) for row in session.level[[0, 19, 20, 39]]] == ["MMMM"] * 2 + ["MMLL"] * 2
    np.testing.assert_array_equal(session.frames, float(truth["n_averages"]))
    np.testing.assert_allclose(session.window_s, float(truth["integration_s"]), rtol=1e-12)
    assert (session.lon_deg, session.lat_deg) == (float(truth["lon_deg"]), float(truth["lat_deg"]))


def test_spectra_are_read_piece_by_piece(flight):
    session = read_session(flight / "session_b.h5")
    with session.spectra() as read, h5py.File(session.path) as file:
        whole = file["spectra/data"][()]
        np.testing.assert_array_equal(read(3, 9), whole[3:9])
        np.testing.assert_array_equal(read(39, 40), whole[39:])
    assert np.isnan(whole[5, 4]).all()


def test_fits_and_hdf5_hold_the_same(flight):
    a, b = (read_session(flight / f"session_a.{kind}") for kind in ("h5", "fits"))
    assert b.kind == "FITS"
    for name in ("raw_s", "navgf", "navg_shift", "level", "adc_low", "adc_high", "errors"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
    assert a.telemetry.keys() == b.telemetry.keys()
    for name, values in a.telemetry.items():
        np.testing.assert_array_equal(values, b.telemetry[name])
    np.testing.assert_array_equal(a.clock.utc(a.raw_s).jd, b.clock.utc(b.raw_s).jd)
    with a.spectra() as one, b.spectra() as other:
        np.testing.assert_array_equal(one(7, 12), other(7, 12))


def test_saturated_spectra_are_those_that_were_made_so(flight):
    truth = np.load(flight / "truth.npz")
    rows = [int(row) for name, row in truth["saturated"] if name == "c"]
    session = read_session(flight / "session_c.h5")
    assert np.flatnonzero(session.saturated).tolist() == rows
    assert not read_session(flight / "session_a.h5").saturated.any()


def test_a_clock_that_nobody_has_established_is_none(flight):
    assert read_session(flight / "session_a_unknown_time_scale.h5").clock is None


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


VERSIONS = [(2, "ingest the session again"), (5, "reads 3 and 4"), (None, "no layout_version")]


@pytest.mark.parametrize(("version", "told"), VERSIONS)
def test_older_and_newer_layouts_are_named(copy, version, told):
    with h5py.File(copy, "a") as file:
        if version is None:
            del file.attrs["layout_version"]
        else:
            file.attrs["layout_version"] = version
    with pytest.raises(InputError, match=told):
        read_session(copy)


LACKING = [
    "spectra",
    "spectra/data",
    "spectra/raw_times",
    "spectra/metadata/Navgf",
    "spectra/metadata/Navg2_shift",
    "spectra/metadata/actual_gain",
    "spectra/metadata/actual_bitslice",
    "spectra/metadata/adc_min",
    "constants",
]


@pytest.mark.parametrize("name", LACKING)
def test_what_is_missing_is_named(copy, name):
    with h5py.File(copy, "a") as file:
        del file[name]
    with pytest.raises(InputError) as refused:
        read_session(copy)
    assert name.split("/")[-1] in str(refused.value)
    assert "\n" not in str(refused.value)


def change(file, name, value):
    shape = file[name][()]
    del file[name]
    file[name] = value(shape)


WRONG = [
    ("spectra/raw_times", lambda x: x[::-1]),
    ("spectra/raw_times", lambda x: np.append(x[:-1], np.nan)),
    ("spectra/raw_times", lambda x: x[:-1]),
    ("spectra/mjd_times", lambda x: x + 1.0),
    ("spectra/metadata/Navgf", lambda x: x + 6),
    ("spectra/metadata/actual_gain", lambda x: x[:, :3]),
    ("spectra/metadata/actual_gain", lambda x: x.astype(float)),
    ("spectra/data", lambda x: x[:, :12]),
    ("spectra_interpolated_telemetry/time", lambda x: x + 1.0),
]


@pytest.mark.parametrize(("name", "value"), WRONG)
def test_what_does_not_fit_is_refused(copy, name, value):
    with h5py.File(copy, "a") as file:
        change(file, name, value)
    assert_refused(lambda: read_session(copy))


@pytest.mark.parametrize(
    ("name", "value"), [("bitslice_restored", 0), ("units", "counts"), ("normalization_version", 2)]
)
def test_counts_of_another_kind_are_refused(copy, name, value):
    with h5py.File(copy, "a") as file:
        file["spectra/data"].attrs[name] = value
    assert_refused(lambda: read_session(copy))


def test_files_that_are_cut_short_are_refused(flight, tmp_path):
    for kind in ("h5", "fits"):
        whole = (flight / f"session_a.{kind}").read_bytes()
        for share in (0.1, 0.6, 0.95):
            path = tmp_path / f"cut.{kind}"
            path.write_bytes(whole[: int(share * len(whole))])

            def use(path=path):
                session = read_session(path)
                with session.spectra() as read:
                    read(0, session.n_rows)

            assert_refused(use)


def test_gains_in_letters_are_the_same(copy):
    numbers = read_session(copy).level
    with h5py.File(copy, "a") as file:
        change(file, "spectra/metadata/actual_gain", lambda x: np.full(x.shape, b"M"))
    np.testing.assert_array_equal(read_session(copy).level, numbers)


@pytest.fixture
def newer(tmp_path):
    """A session of layout 4 that a test may change."""
    return write_layout_4(tmp_path / "session_4.h5")


def test_what_a_session_of_layout_4_says(newer):
    session, rows = read_session(newer), metadata()
    assert is_session(newer)
    assert (session.n_rows, session.layout, session.kind) == (N, 4, "HDF5")
    assert (session.lon_deg, session.lat_deg, session.software) == (182.258, -23.814, "0x307")
    np.testing.assert_array_equal(session.raw_s, RAW_S)
    np.testing.assert_array_equal(session.navgf, 2)
    np.testing.assert_array_equal(session.frames, 2.0**14 * WEIGHT)
    np.testing.assert_allclose(session.window_s, 2**20 * 40e-6, rtol=1e-12)
    np.testing.assert_array_equal(session.level, np.array(list("LMH"))[GAINS])
    np.testing.assert_array_equal(session.adc_low, rows["adc_min"])
    np.testing.assert_array_equal(session.adc_high, rows["adc_max"])
    np.testing.assert_array_equal(session.adc_invalid, rows["adc_invalid_count_max"])
    np.testing.assert_array_equal(session.errors, rows["errors"])
    np.testing.assert_array_equal(session.notch, NOTCH)
    assert session.telemetry.keys() == set(NAMES[1:])
    for name, values in session.telemetry.items():
        np.testing.assert_allclose(values, telemetry(name, RAW_S), rtol=1e-9)
    utc = session.clock.utc(RAW_S)
    np.testing.assert_allclose((utc - Time(LANDING)).sec, RAW_S - SPECTROMETER_S, atol=1e-5)
    with session.spectra() as read:
        np.testing.assert_array_equal(read(1, 4), counts()[1:4])


def test_families_that_are_not_used_are_named(newer, capsys):
    def told():
        assert main(["info", str(newer)]) == 0
        return [line for line in capsys.readouterr().out.splitlines() if "not used" in line]

    assert not told()
    rows = {"calibrator__zoom_spectra": 12, "tr_spectra": 2, "calibrator__data": 3}
    write_families(newer, **rows, grimm_spectra=1, housekeeping=4)
    (line,) = told()
    assert line.split("not used: ")[1] == (
        "time-resolved spectra (2 rows), zoom spectra (12 rows), Grimm's spectra (1 row), "
        "calibrator data (3 rows), housekeeping (4 rows)"
    )


FIELDS = "spectra/metadata/fields"
CONTRADICTIONS = {
    "spectra/raw_time_valid": (False, "raw_time_valid"),
    f"{FIELDS}/adc_min/variant_000/row_indices": (10**6, "row_indices"),
    f"{FIELDS}/navgf/variant_000/data": (1, "navgf"),
    "telemetry/mission_seconds": (7, "does not cover the spectra"),
}


@pytest.mark.parametrize("name", CONTRADICTIONS)
def test_layout_4_that_contradicts_itself_is_refused(newer, name):
    value, told = CONTRADICTIONS[name]
    with h5py.File(newer, "a") as file:
        file[name][...] = value
    with pytest.raises(InputError, match=told):
        read_session(newer)


LACKING_4 = {
    "spectra": "has no spectra/data",
    "spectra/raw_seconds": "has no spectra/raw_times",
    "constants": "has no constants.lun_lat_deg",
    f"{FIELDS}/adc_min": "has no spectra/metadata/adc_min",
    f"{FIELDS}/actual_gain": "has no spectra/metadata/actual_gain",
    "telemetry/values": "telemetry has no values",
}


@pytest.mark.parametrize("name", LACKING_4)
def test_what_layout_4_lacks_is_named(newer, name):
    with h5py.File(newer, "a") as file:
        del file[name]
    with pytest.raises(InputError, match=LACKING_4[name]) as refused:
        read_session(newer)
    assert "\n" not in str(refused.value)


def test_without_a_clock_reference_the_telemetry_of_layout_4_is_not_known(newer):
    with h5py.File(newer, "a") as file:
        file["clock_reference"].attrs["available"] = np.bool_(False)
    session = read_session(newer)
    assert session.clock is None and not session.telemetry


def test_layout_4_in_fits_is_refused(tmp_path):
    primary = fits.PrimaryHDU()
    primary.header["LAYOUTV"] = 4
    primary.writeto(tmp_path / "s.fits")
    with pytest.raises(InputError, match="as HDF5"):
        read_session(tmp_path / "s.fits")
