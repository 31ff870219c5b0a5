"""Flags: what is injected is found, and what is noise is not."""

import numpy as np
import pytest

from lusee_bayes.flight.bands import ChannelBand
from lusee_bayes.flight.flags import (
    COMB_LIMIT,
    NO_LINES,
    KnownLines,
    burst_flags,
    comb_bins,
    comb_strength,
    line_flags,
    read_lines,
    threshold,
)
from lusee_bayes.flight.session import AVERAGING, channel_mhz
from lusee_bayes.testing.checks import assert_refused

MHZ = channel_mhz("centre")
FRAMES, ROWS = 2.0**20, 400
FALSE_ALARM = 1e-4


def autos(rng, rows=ROWS, frames=FRAMES, navgf=1):
    """Power laws of four ports with radiometer noise."""
    averaging = AVERAGING[navgf]
    mhz = np.maximum(MHZ, 0.5)[averaging.channels()].mean(axis=1)
    law = np.array([1.0, 1.1, 0.9, 1.3])[:, None] * (mhz / 10.0) ** -2.5
    noise = rng.standard_normal((rows, 4, averaging.n_bins))
    return law * (1.0 + noise / np.sqrt(frames * averaging.members))


def band_of(f=10.0, navgf=1):
    return ChannelBand.of(f, 1.0, 2, AVERAGING[navgf], MHZ)


def flags_of(band, spectra):
    here = spectra[:, :, band.first : band.last]
    good = np.ones((len(here), here.shape[2]), dtype=bool)
    frames = np.full(len(here), FRAMES)
    return line_flags(band, here, frames, good, threshold(FALSE_ALARM, 4))


def test_noise_is_flagged_as_rarely_as_is_said():
    flagged, z = flags_of(band_of(), autos(np.random.default_rng(1), rows=2000))
    # 82,000 channels: 8.2 expected; 25 is beyond five standard deviations
    assert flagged.sum() < 25
    assert np.std(z) == pytest.approx(1.0, abs=0.01)


@pytest.mark.parametrize("strength", [8.0, 1e2, 1e5])
def test_lines_are_found_in_their_channel_alone(strength):
    rng = np.random.default_rng(2)
    spectra, band = autos(rng), band_of()
    channel = rng.integers(band.first, band.last, ROWS)
    rows = np.arange(ROWS)
    spectra[rows, :, channel] *= 1.0 + strength / np.sqrt(FRAMES)
    flagged, _ = flags_of(band, spectra)
    injected = np.zeros(flagged.shape, dtype=bool)
    injected[rows, channel - band.first] = True
    assert flagged[injected].mean() > 0.95
    assert flagged[~injected].mean() < 1e-3


def test_several_lines_hide_none():
    rng = np.random.default_rng(3)
    spectra, band = autos(rng), band_of()
    for k in (2, 3, 17, 30):
        spectra[:, :, band.first + k] *= 1.0 + 10.0 ** (k / 10) * 20.0 / np.sqrt(FRAMES)
    flagged, _ = flags_of(band, spectra)
    assert flagged[:, [2, 3, 17, 30]].mean() > 0.95
    assert np.delete(flagged, [2, 3, 17, 30], axis=1).mean() < 1e-3


@pytest.mark.parametrize("navgf", [1, 2])
def test_a_comb_far_below_the_noise_of_a_channel_is_found(navgf):
    rng = np.random.default_rng(4)
    averaging = AVERAGING[navgf]
    spectra = autos(rng, rows=40, navgf=navgf)
    frames = np.full(40, FRAMES)
    before = comb_strength(spectra, frames, averaging, MHZ)
    # neighbours predict a channel to fourth order: at 5 MHz, 6e-8 of it
    assert np.abs(before).max() < COMB_LIMIT / 1.5
    spectra[::2, :, comb_bins(averaging)] *= 1.0 + 1.0 / np.sqrt(FRAMES)
    found = np.abs(comb_strength(spectra, frames, averaging, MHZ)) > COMB_LIMIT
    assert found[::2].all()
    assert not found[1::2].any()


def test_a_notch_is_a_comb_below_and_a_strong_line_is_none():
    spectra, frames = autos(np.random.default_rng(5), rows=4), np.full(4, FRAMES)
    spectra[:2, :, comb_bins(AVERAGING[1])] *= 1.0 - 5.0 / np.sqrt(FRAMES)
    spectra[2:, :, [835, 836]] *= 1e3
    strength = comb_strength(spectra, frames, AVERAGING[1], MHZ)
    assert (strength[:2] < -COMB_LIMIT).all() and (np.abs(strength[2:]) < COMB_LIMIT).all()
    # where every bin has a channel of the comb nothing is told
    assert comb_bins(AVERAGING[3]).all() and comb_bins(AVERAGING[4]).all()
    spectra = autos(np.random.default_rng(7), rows=4, navgf=4)
    assert not comb_strength(spectra, frames, AVERAGING[4], MHZ).any()


def test_known_lines_take_the_channels_about_them(tmp_path):
    lines = KnownLines(np.array([20.8875]), ("rover",))
    # half-way between channels 835 and 836
    assert np.flatnonzero(lines.bins(AVERAGING[1], MHZ)).tolist() == [834, 835, 836, 837]
    assert np.flatnonzero(lines.bins(AVERAGING[4], MHZ)).tolist() == [208, 209]
    assert not NO_LINES.bins(AVERAGING[1], MHZ).any()
    path = tmp_path / "lines.csv"
    path.write_text("frequency_mhz,source\n20.8875,rover\n")
    np.testing.assert_array_equal(read_lines(path).frequency_mhz, [20.8875])
    path.write_text("frequency,source\n20.8875,rover\n")
    assert_refused(lambda: read_lines(path))


# one day at 42 s
N, STEP = 2057, 42.0


def bands_in_time(rng, noise=2e-4):
    """Autos that change as the sky does: by a few per cent in hours."""
    t = STEP * np.arange(N)
    smooth = 1.0 + 0.05 * np.sin(2.0 * np.pi * t / 30_000.0)[:, None] * np.array([1, 0.8, -1, 0.5])
    return t, smooth * (1.0 + noise * rng.standard_normal((N, 4))), noise * smooth


def test_smooth_skies_are_flagged_as_rarely_as_is_said():
    flagged, total = 0, 0
    for seed in range(10):
        t, values, noise = bands_in_time(np.random.default_rng(seed))
        found, scatter = burst_flags(t, values, noise, np.ones(N, dtype=bool), FALSE_ALARM)
        flagged, total = flagged + found.sum(), total + N
        assert np.median(scatter) == pytest.approx(1.0, abs=0.05)
    assert flagged / total < 1e-3


@pytest.mark.parametrize(("length", "strength"), [(1, 10.0), (4, 8.0), (20, 6.0), (60, 20.0)])
def test_bursts_are_found(length, strength):
    rng = np.random.default_rng(11)
    t, values, noise = bands_in_time(rng)
    starts = np.arange(100, N - 100, 340)
    burst = np.zeros(N, dtype=bool)
    for start in starts:
        burst[start : start + length] = True
    values[burst] += strength * noise[burst]
    found, _ = burst_flags(t, values, noise, np.ones(N, dtype=bool), FALSE_ALARM)
    assert found[burst].mean() >= 0.95
    assert found[~burst].mean() <= 1e-3


def test_what_is_between_weak_bursts_stays():
    """Twelve of 8 spectra at 4.5 sigma, in pairs 8 spectra apart.

    A spectrum beside a burst goes with it where one auto's noise is beyond (3 - sqrt(8)) 4.5
    sqrt(8) = 2.2 sigma: one is expected in all, and more than five are rare.
    """
    rng = np.random.default_rng(13)
    t, values, noise = bands_in_time(rng)
    burst = np.zeros(N, dtype=bool)
    for start in np.arange(100, N - 100, 340):
        burst[start : start + 8] = burst[start + 16 : start + 24] = True
    values[burst] += 4.5 * noise[burst]
    found, _ = burst_flags(t, values, noise, np.ones(N, dtype=bool), FALSE_ALARM)
    assert found[burst].mean() >= 0.95
    assert (found & ~burst).sum() <= 5


def test_noise_that_is_larger_than_expected_is_no_burst():
    t, values, noise = bands_in_time(np.random.default_rng(12), noise=6e-4)
    found, scatter = burst_flags(t, values, noise / 3.0, np.ones(N, dtype=bool), FALSE_ALARM)
    assert found.mean() < 2e-3
    assert np.median(scatter) == pytest.approx(3.0, rel=0.05)


def test_with_few_spectra_nothing_is_told():
    t = 1800.0 * np.arange(40)
    values = np.random.default_rng(1).random((40, 4))
    found, scatter = burst_flags(t, values, 1e-4 * values, np.ones(40, dtype=bool), FALSE_ALARM)
    assert not found.any()
    assert np.isnan(scatter).all()
