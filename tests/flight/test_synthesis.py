"""Sessions come back from their files as they were written; channels and counts are exact."""

from __future__ import annotations

from dataclasses import replace

import h5py
import numpy as np
import pytest

from lusee_bayes.core.errors import InputError
from lusee_bayes.flight.clock import Clock
from lusee_bayes.flight.gain_model import synthetic_gains
from lusee_bayes.flight.session import OF_FLIGHT, TELEMETRY, channel_mhz
from lusee_bayes.flight.session_files import (
    SessionRows,
    cache_for,
    guessed_chunks,
    is_session,
    read_session,
    write_session,
)
from lusee_bayes.flight.synthesis import ChannelSpectra, Counting, bit_slices, rounded
from lusee_bayes.instrument.products import to_matrix, to_real

N = 7
CLOCK = Clock("test", 2400000.5, 61192.0, "utc", 1000.0)
KINDS = ["hdf5", "fits"]


def some_rows(**changes):
    rng = np.random.default_rng(5)
    level = np.array([list("MMMM")] * 3 + [list("LMHL")] * 4)
    rows = SessionRows(
        raw_s=2.3e7 + 0.7 + 42.0 * np.arange(N),
        navgf=np.full(N, 2),
        navg_shift=np.full(N, 20),
        level=level,
        bitslice=rng.integers(0, 31, (N, 16)),
        adc_low=-rng.integers(100, 8000, (N, 4)),
        adc_high=rng.integers(100, 8000, (N, 4)),
        adc_invalid=rng.integers(0, 3, (N, 4)),
        adc_rms=rng.uniform(50.0, 300.0, (N, 4)),
        telemetry={name: rng.uniform(1.0, 30.0, N) for name in TELEMETRY},
        clock=CLOCK,
        lon_deg=182.258,
        lat_deg=-23.814,
        software=775,
    )
    return replace(rows, **changes)


def some_counts(bins=2048):
    return np.random.default_rng(6).normal(size=(N, 16, bins)).astype(np.float32)


def in_blocks(counts, *sizes):
    start = 0
    for size in sizes:
        yield counts[start : start + size]
        start += size


@pytest.mark.parametrize("kind", KINDS)
def test_a_session_comes_back_from_its_file(tmp_path, kind):
    rows, counts = some_rows(), some_counts()
    counts[2, 3] = np.nan
    path = write_session(tmp_path / "session", rows, in_blocks(counts, 4, 1, 2), kind=kind)
    assert is_session(path)
    found = read_session(path)
    assert (found.layout, found.kind) == (3, kind.upper())
    assert found.software == "0x307"
    assert (found.lon_deg, found.lat_deg) == (rows.lon_deg, rows.lat_deg)
    np.testing.assert_array_equal(found.raw_s, rows.raw_s)
    np.testing.assert_array_equal(found.navgf, rows.navgf)
    np.testing.assert_array_equal(found.navg_shift, rows.navg_shift)
    np.testing.assert_array_equal(found.level, rows.level)
    np.testing.assert_array_equal(found.adc_low, rows.adc_low)
    np.testing.assert_array_equal(found.adc_high, rows.adc_high)
    np.testing.assert_array_equal(found.adc_invalid, rows.adc_invalid)
    np.testing.assert_array_equal(found.share, 1.0)
    assert not found.errors.any()
    for name in TELEMETRY:
        np.testing.assert_array_equal(found.telemetry[name], rows.telemetry[name])
    assert found.clock.differs_s(CLOCK, rows.raw_s) < 1e-6
    with found.spectra() as read:
        np.testing.assert_array_equal(read(0, N), counts)
        np.testing.assert_array_equal(read(3, 5), counts[3:5])


@pytest.mark.parametrize("kind", ["hdf5", "fits"])
def test_bins_that_are_not_there_are_nan_and_a_clock_may_be_unknown(tmp_path, kind):
    path = write_session(tmp_path / "s", some_rows(clock=None), [some_counts(512)], kind=kind)
    found = read_session(path)
    assert found.clock is None
    with found.spectra() as read:
        counts = read(0, N)
    np.testing.assert_array_equal(counts[..., :512], some_counts(512))
    assert np.isnan(counts[..., 512:]).all()


@pytest.mark.parametrize(
    "blocks, text",
    [
        ([some_counts()[:4]], "there are counts of 4 spectra for 7 rows"),
        ([some_counts(), some_counts()[:1]], "expected at most 0 rows"),
        ([some_counts()[:, :15]], "16 products"),
    ],
)
@pytest.mark.parametrize("kind", ["hdf5", "fits"])
def test_what_is_no_session_leaves_nothing_behind(tmp_path, kind, blocks, text):
    with pytest.raises(InputError, match=text):
        write_session(tmp_path / "s", some_rows(), blocks, kind=kind)
    assert not list(tmp_path.iterdir())
    with pytest.raises(InputError, match="not as netcdf"):
        write_session(tmp_path / "s", some_rows(), [], kind="netcdf")


def test_chunks_of_a_long_session_stay_in_memory_until_they_are_read():
    chunks = guessed_chunks(57_000)
    assert chunks[0] > 256
    needed = chunks[0] * 16 * 2048 * 4
    assert needed <= cache_for(chunks)["rdcc_nbytes"] < 2 * needed
    assert cache_for(None) == {}


def test_a_file_has_the_chunks_that_luseepy_makes(tmp_path):
    path = write_session(tmp_path / "s", some_rows(), [some_counts()])
    with h5py.File(path) as file:
        cube = file["spectra/data"]
        assert (cube.compression, cube.compression_opts) == ("gzip", 1)
        assert cube.chunks == guessed_chunks(N)


def covariances(nodes, rows, rng):
    a = rng.normal(size=(2, 4, 6, 1, rows)) + 0.1 * rng.normal(size=(2, 4, 6, nodes, rows))
    a = a[0] + 1j * a[1]
    return np.moveaxis(to_real(np.einsum("ianr,janr->ijnr", a, a.conj())), 0, 1)


@pytest.mark.parametrize("nodes", [[10.0], [10.0, 25.0], [8.0, 10.0, 12.0, 14.0, 30.0]])
def test_channels_go_through_the_known_frequencies_and_are_covariances(nodes):
    known = covariances(len(nodes), 3, np.random.default_rng(1))
    mhz = channel_mhz("centre")
    spectra = ChannelSpectra.of(np.array(nodes), mhz)(known)
    for number, f in enumerate(nodes):
        at = int(np.rint(f / 0.025))
        np.testing.assert_allclose(spectra[:, :, at], known[number], rtol=1e-11, atol=1e-12)
    t = np.moveaxis(to_matrix(spectra), (0, 1), (-2, -1))
    t /= np.trace(t, axis1=-2, axis2=-1)[..., None, None]
    assert np.linalg.eigvalsh(t).min() > 0.0
    # smooth across the known frequencies, within a band and at its ends
    third = np.diff(np.log(spectra[0, 0]), 3)
    for f in nodes:
        at = int(np.rint(f / 0.025))
        assert np.abs(third[at - 20 : at + 20]).max() < 1e-4


def test_one_frequency_makes_a_power_law():
    known = covariances(1, 2, np.random.default_rng(2))
    spectra = ChannelSpectra.of(np.array([20.0]), channel_mhz("edge"))(known)
    f = channel_mhz("edge")[400]
    np.testing.assert_allclose(spectra[:, :, 400], known[0] * (f / 20.0) ** -2.5, rtol=1e-12)


def test_visibilities_that_voltages_cannot_have_are_refused():
    known = covariances(1, 2, np.random.default_rng(2))
    known[0, 1] *= 10.0
    with pytest.raises(InputError, match="positive definite"):
        ChannelSpectra.of(np.array([20.0]), channel_mhz("edge"))(known)


def test_counts_are_gains_times_power_in_the_order_of_the_spectrometer():
    table, n = synthetic_gains(), 2
    telemetry = {name: np.array([20.0, 31.0]) for name in TELEMETRY}
    spectra = covariances(1, n, np.random.default_rng(3))[0][..., None] * np.ones(2048) * 1e-17
    one = Counting(table, "LMHM", 1, "centre")(spectra, telemetry)
    at = 800  # 20 MHz
    gain = [
        (np.array([1.0, *table.strengths(level, port, telemetry)[1]])
         @ table.basis(level, port, np.array([20.0]))[:, 0])
        for port, level in enumerate("LMHM")
    ]  # fmt: skip
    assert gain[2] / gain[0] > 500.0
    expected = spectra[:, 1, at] / 1e-18
    np.testing.assert_allclose(one[1, 0, at], expected[0] * gain[0], rtol=1e-12)
    # the first cross of both orders
    np.testing.assert_allclose(one[1, 4, at], expected[1] * np.sqrt(gain[0] * gain[1]), rtol=1e-12)
    minus = Counting(table, "LMHM", 1, "centre", -1)(spectra, telemetry)
    np.testing.assert_array_equal(minus[:, 5], -one[:, 5])
    np.testing.assert_array_equal(minus[:, 4], one[:, 4])
    # three of four channels, divided by four
    three = Counting(table, "LMHM", 3, "centre")(spectra, telemetry)
    np.testing.assert_allclose(three[..., 200], one[..., 800:803].sum(axis=2) / 4.0, rtol=1e-12)
    assert three.shape == (n, 16, 512)


def test_counts_are_whole_numbers_of_few_enough_bits():
    spectra = np.abs(np.random.default_rng(4).normal(size=(3, 16, 100))) * 0.7
    slices = bit_slices(spectra)
    autos = OF_FLIGHT[[0, 7, 12, 15]]
    found = rounded(spectra, np.broadcast_to(slices, (3, 16)))
    step = 2.0 ** (slices - 31)
    np.testing.assert_allclose(found, spectra, rtol=1e-6, atol=step.max())
    whole = spectra[0, autos] / step[autos, None]
    assert 2**25 < np.rint(whole).max() < 2**28
