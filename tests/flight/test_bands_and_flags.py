"""Polynomials over the channels of a band; and flags, which find what is injected and no noise."""

import numpy as np
import pytest

from lusee_bayes.flight import flags as fl
from lusee_bayes.flight.bands import FRAME, ChannelBand, impulse_response, shared_noise
from lusee_bayes.flight.session import AVERAGING, channel_mhz
from lusee_bayes.testing import assert_refused

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
    return fl.line_flags(band, here, np.full(len(here), FRAMES), good, fl.threshold(FALSE_ALARM, 4))


def test_noise_is_flagged_as_rarely_as_is_said():
    flagged, z = flags_of(band_of(), autos(np.random.default_rng(1), rows=2000))
    # 82,000 channels: 8.2 expected; 25 is beyond five standard deviations
    assert flagged.sum() < 25
    assert np.std(z) == pytest.approx(1.0, abs=0.01)


@pytest.mark.parametrize("strength", [8.0, 1e2, 1e5])
def test_lines_are_found_in_their_channel_alone(strength):
    rng = np.random.default_rng(2)
    spectra, band = autos(rng), band_of()
    channel, rows = rng.integers(band.first, band.last, ROWS), np.arange(ROWS)
    spectra[rows, :, channel] *= 1.0 + strength / np.sqrt(FRAMES)
    flagged, _ = flags_of(band, spectra)
    injected = np.zeros(flagged.shape, dtype=bool)
    injected[rows, channel - band.first] = True
    assert flagged[injected].mean() > 0.95 and flagged[~injected].mean() < 1e-3


def test_several_lines_hide_none():
    spectra, band = autos(np.random.default_rng(3)), band_of()
    for k in (2, 3, 17, 30):
        spectra[:, :, band.first + k] *= 1.0 + 10.0 ** (k / 10) * 20.0 / np.sqrt(FRAMES)
    flagged, _ = flags_of(band, spectra)
    assert flagged[:, [2, 3, 17, 30]].mean() > 0.95
    assert np.delete(flagged, [2, 3, 17, 30], axis=1).mean() < 1e-3


@pytest.mark.parametrize("navgf", [1, 2])
def test_a_comb_far_below_the_noise_of_a_channel_is_found(navgf):
    rng, averaging = np.random.default_rng(4), AVERAGING[navgf]
    spectra, frames = autos(rng, rows=40, navgf=navgf), np.full(40, FRAMES)
    # neighbours predict a channel to fourth order: at 5 MHz, 6e-8 of it
    assert np.abs(fl.comb_strength(spectra, frames, averaging, MHZ)).max() < fl.COMB_LIMIT / 1.5
    spectra[::2, :, fl.comb_bins(averaging)] *= 1.0 + 1.0 / np.sqrt(FRAMES)
    found = np.abs(fl.comb_strength(spectra, frames, averaging, MHZ)) > fl.COMB_LIMIT
    assert found[::2].all() and not found[1::2].any()


def test_a_notch_is_a_comb_below_and_a_strong_line_is_none():
    spectra, frames = autos(np.random.default_rng(5), rows=4), np.full(4, FRAMES)
    spectra[:2, :, fl.comb_bins(AVERAGING[1])] *= 1.0 - 5.0 / np.sqrt(FRAMES)
    spectra[2:, :, [835, 836]] *= 1e3
    strength = fl.comb_strength(spectra, frames, AVERAGING[1], MHZ)
    assert (strength[:2] < -fl.COMB_LIMIT).all() and (np.abs(strength[2:]) < fl.COMB_LIMIT).all()
    # where every bin has a channel of the comb nothing is told
    assert fl.comb_bins(AVERAGING[3]).all() and fl.comb_bins(AVERAGING[4]).all()
    spectra = autos(np.random.default_rng(7), rows=4, navgf=4)
    assert not fl.comb_strength(spectra, frames, AVERAGING[4], MHZ).any()


def test_known_lines_take_the_channels_about_them(write):
    lines = (20.8875,)
    # half-way between channels 835 and 836
    assert np.flatnonzero(fl.line_bins(lines, AVERAGING[1], MHZ)).tolist() == [834, 835, 836, 837]
    assert np.flatnonzero(fl.line_bins(lines, AVERAGING[4], MHZ)).tolist() == [208, 209]
    assert not fl.line_bins((), AVERAGING[1], MHZ).any()
    assert fl.read_lines(write("frequency_mhz,source\n20.8875,rover\n", "lines.csv")) == lines
    assert_refused(lambda: fl.read_lines(write("frequency,source\n20.8875,rover\n", "lines.csv")))


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
        found, scatter = fl.burst_flags(t, values, noise, np.ones(N, dtype=bool), FALSE_ALARM)
        flagged, total = flagged + found.sum(), total + N
        assert np.median(scatter) == pytest.approx(1.0, abs=0.05)
    assert flagged / total < 1e-3


def bursts_found(seed, offsets, length, strength):
    """Flags of data with bursts, and where these are."""
    t, values, noise = bands_in_time(np.random.default_rng(seed))
    burst = np.zeros(N, dtype=bool)
    for start in np.arange(100, N - 100, 340):
        for offset in offsets:
            burst[start + offset : start + offset + length] = True
    values[burst] += strength * noise[burst]
    found, _ = fl.burst_flags(t, values, noise, np.ones(N, dtype=bool), FALSE_ALARM)
    return found, burst


@pytest.mark.parametrize(("length", "strength"), [(1, 10.0), (4, 8.0), (20, 6.0), (60, 20.0)])
def test_bursts_are_found(length, strength):
    found, burst = bursts_found(11, (0,), length, strength)
    assert found[burst].mean() >= 0.95 and found[~burst].mean() <= 1e-3


def test_what_is_between_weak_bursts_stays():
    """Twelve of 8 spectra at 4.5 sigma, in pairs 8 spectra apart.

    A spectrum beside a burst goes with it where one auto's noise is beyond (3 - sqrt(8)) 4.5
    sqrt(8) = 2.2 sigma: one is expected in all, and more than five are rare.
    """
    found, burst = bursts_found(13, (0, 16), 8, 4.5)
    assert found[burst].mean() >= 0.95 and (found & ~burst).sum() <= 5


def test_noise_that_is_larger_than_expected_is_no_burst():
    t, values, noise = bands_in_time(np.random.default_rng(12), noise=6e-4)
    found, scatter = fl.burst_flags(t, values, noise / 3.0, np.ones(N, dtype=bool), FALSE_ALARM)
    assert found.mean() < 2e-3
    assert np.median(scatter) == pytest.approx(3.0, rel=0.05)


def test_with_few_spectra_nothing_is_told():
    t, values = 1800.0 * np.arange(40), np.random.default_rng(1).random((40, 4))
    found, scatter = fl.burst_flags(t, values, 1e-4 * values, np.ones(40, dtype=bool), FALSE_ALARM)
    assert not found.any()
    assert np.isnan(scatter).all()


def binned(averaging, per_channel):
    """What the flight software makes of channels, one bin after the other."""
    starts = averaging.stride * np.arange(averaging.n_bins)
    return np.array([per_channel[at : at + averaging.members].mean() for at in starts])


@pytest.mark.parametrize("origin", ["centre", "edge"])
@pytest.mark.parametrize("navgf", [1, 2, 3, 4])
@pytest.mark.parametrize("degree", [0, 1, 2, 4])
def test_polynomials_of_the_degree_are_exact_in_the_middle(navgf, degree, origin):
    averaging, mhz = AVERAGING[navgf], channel_mhz(origin)
    band = ChannelBand.of(10.0, 2.0, degree, averaging, mhz)
    coefficients = [3.0, 0.5, -0.2, 0.1, 0.05][: degree + 1]
    values = binned(averaging, sum(c * (mhz - 10.0) ** k for k, c in enumerate(coefficients)))
    here = values[band.first : band.last]
    good = np.random.default_rng(2).random((6, len(here))) > 0.15
    good[0] = True
    spectra = np.broadcast_to(here, (6, 2, len(here)))
    found, variance, further = band.values(spectra, np.broadcast_to(here, good.shape), good)
    np.testing.assert_allclose(found, 3.0, rtol=1e-12)
    np.testing.assert_allclose(further, 0.0, atol=1e-9)
    # of independent channels with noise in proportion to the spectrum, by the pseudo-inverse
    powers = [binned(averaging, (mhz - 10.0) ** k) for k in range(degree + 1)]
    powers = np.stack(powers, axis=1)[band.first : band.last]
    for row, kept in enumerate(good):
        weights = np.linalg.pinv(powers[kept])[0]
        expected = ((weights * here[kept] / 3.0) ** 2).sum() / averaging.members
        assert variance[row] == pytest.approx(expected, rel=1e-9)


def test_what_the_degree_leaves_out_is_told_by_two_more_powers():
    """A power law about 10 MHz: a mean over 1 MHz is 0.4 % off, a parabola 5e-6."""
    mhz = channel_mhz("centre")
    law = (mhz[1:] / 10.0) ** -2.5
    law, off = np.append(law[0], law), {}
    for degree in (0, 2):
        band = ChannelBand.of(10.0, 1.0, degree, AVERAGING[1], mhz)
        here = law[None, band.first : band.last]
        found, _, further = band.values(here[:, None], here, np.ones(here.shape, dtype=bool))
        off[degree] = found[0, 0] - 1.0
        # two more powers take nearly all of it away
        assert further[0, 0] == pytest.approx(-off[degree], rel=0.01)
    # f'' h^2 / 6 with h the half width, for 41 channels
    assert off[0] == pytest.approx(2.5 * 3.5 / 100.0 / 6.0 * 0.5**2, rel=0.07)
    assert abs(off[2]) < 6e-6


def test_noise_of_steep_spectra_and_shared_channels_by_drawing_it():
    shared = shared_noise(1, "hann")
    band = ChannelBand.of(10.0, 1.0, 1, AVERAGING[2], channel_mhz("centre"), shared)
    n = band.last - band.first
    shape, good = np.linspace(1.3, 0.7, n)[None], np.ones((1, n), dtype=bool)
    good[0, 3:6] = False
    _, variance, _ = band.values(shape[:, None], shape, good)
    rng = np.random.default_rng(5)
    drawn = shape * (np.linalg.cholesky(band.shared) @ rng.standard_normal((n, 20_000))).T
    shapes, flags = (np.broadcast_to(x, drawn.shape) for x in (shape, good))
    values, _, _ = band.values(drawn[:, None], shapes, flags)
    middle, _, _ = band.values(shape[:, None], shape, good)
    # the scatter of a variance of 20000 draws is 1 %
    assert np.var(values) / middle[0, 0] ** 2 == pytest.approx(variance[0], rel=0.04)


def test_too_many_flags_leave_nothing():
    band = band_of()
    n = band.last - band.first
    good = np.zeros((3, n), dtype=bool)
    good[1, :3] = True  # no more than terms
    good[2, :15] = True  # to be extrapolated
    flat = np.ones((3, n))
    _, variance, _ = band.values(flat[:, None], flat, good)
    assert np.isinf(variance).all()


@pytest.mark.parametrize(("f", "width"), [(10.0, 0.1), (70.0, 1.0)])
def test_bands_with_too_few_bins_are_refused(f, width):
    assert_refused(lambda: ChannelBand.of(f, width, 2, AVERAGING[1], MHZ))


def test_windows_share_noise_as_their_transforms_say():
    """A Hann window's transform is (1, -1/2, 0) of its mean: c_1 = 2/3, c_2 = 1/6 (Harris 1978)."""
    found = shared_noise(1, "hann")
    np.testing.assert_allclose(found[:4], [1.0, 4.0 / 9.0, 1.0 / 36.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(shared_noise(1, "rectangular")[:3], [1.0, 0.0, 0.0], atol=1e-12)
    assert shared_noise(0, "hann") == (1.0,)


@pytest.mark.parametrize(("taps", "taper"), [(4, "hann"), (4, "hamming"), (2, "rectangular")])
def test_filter_banks_share_noise_as_noise_through_them_does(taps, taper):
    """White noise through the bank, as a sum over samples: covariances of mean powers."""
    n, frames, sets = 32, 64, 3000
    h = impulse_response(taps, taper)[FRAME // n // 2 :: FRAME // n]
    rng, power = np.random.default_rng(8), np.zeros((sets, n // 2))
    for start in range(0, sets, 500):
        x = rng.standard_normal((500, (frames + taps - 1) * n))
        for t in range(frames):
            y = np.fft.fft((x[:, t * n : (t + taps) * n] * h).reshape(500, taps, n).sum(axis=1))
            power[start : start + 500] += np.abs(y[:, : n // 2]) ** 2 / frames
    power /= power.mean(axis=0)
    inner, covariance = np.arange(3, n // 2 - 5), np.cov(power.T) * frames
    expected = shared_noise(taps, taper)
    for apart in range(3):
        # of 3000 sets a variance scatters by 2.6 %, of the mean over channels by less; frames at
        # the ends have fewer neighbours: a share of taps / frames; h of 32 samples is coarse
        assert np.mean(covariance[inner, inner + apart]) == pytest.approx(expected[apart], abs=0.06)
