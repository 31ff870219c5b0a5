"""Bands: polynomials over channels, and the noise that they have."""

import numpy as np
import pytest

from lusee_bayes.flight.bands import FRAME, ChannelBand, impulse_response, shared_noise
from lusee_bayes.flight.session import AVERAGING, channel_mhz
from lusee_bayes.testing.checks import assert_refused


def spectrum(mhz, coefficients):
    """A polynomial about 10 MHz."""
    return sum(c * (mhz - 10.0) ** k for k, c in enumerate(coefficients))


def binned(averaging, per_channel):
    """What the flight software makes of channels, one bin after the other."""
    return np.array(
        [
            sum(per_channel[averaging.stride * i + k] for k in range(averaging.members))
            / averaging.members
            for i in range(averaging.n_bins)
        ]
    )


@pytest.mark.parametrize("origin", ["centre", "edge"])
@pytest.mark.parametrize("navgf", [1, 2, 3, 4])
@pytest.mark.parametrize("degree", [0, 1, 2, 4])
def test_polynomials_of_the_degree_are_exact_in_the_middle(navgf, degree, origin):
    averaging, mhz = AVERAGING[navgf], channel_mhz(origin)
    band = ChannelBand.of(10.0, 2.0, degree, averaging, mhz)
    values = binned(averaging, spectrum(mhz, [3.0, 0.5, -0.2, 0.1, 0.05][: degree + 1]))
    here = values[band.first : band.last]
    rng = np.random.default_rng(2)
    good = rng.random((6, len(here))) > 0.15
    good[0] = True
    spectra = np.broadcast_to(here, (6, 2, len(here)))
    found, variance, further = band.values(spectra, np.broadcast_to(here, good.shape), good)
    np.testing.assert_allclose(found, 3.0, rtol=1e-12)
    np.testing.assert_allclose(further, 0.0, atol=1e-9)
    # of independent channels with noise in proportion to the spectrum, by the pseudo-inverse
    powers = [
        binned(averaging, (mhz - 10.0) ** k)[band.first : band.last] for k in range(degree + 1)
    ]
    for row, kept in enumerate(good):
        weights = np.linalg.pinv(np.stack(powers, axis=1)[kept])[0]
        expected = ((weights * here[kept] / 3.0) ** 2).sum() / averaging.members
        assert variance[row] == pytest.approx(expected, rel=1e-9)


def test_what_the_degree_leaves_out_is_told_by_two_more_powers():
    """A power law about 10 MHz: a mean over 1 MHz is 0.4 % off, a parabola 5e-6."""
    mhz = channel_mhz("centre")
    law = (mhz[1:] / 10.0) ** -2.5
    law = np.append(law[0], law)
    off = {}
    for degree in (0, 2):
        band = ChannelBand.of(10.0, 1.0, degree, AVERAGING[1], mhz)
        here = law[None, band.first : band.last]
        good = np.ones(here.shape, dtype=bool)
        found, _, further = band.values(here[:, None], here, good)
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
    shape = np.linspace(1.3, 0.7, n)[None]
    good = np.ones((1, n), dtype=bool)
    good[0, 3:6] = False
    _, variance, _ = band.values(shape[:, None], shape, good)
    rng = np.random.default_rng(5)
    root = np.linalg.cholesky(band.shared)
    drawn = shape * (root @ rng.standard_normal((n, 20_000))).T
    values, _, _ = band.values(
        drawn[:, None], np.broadcast_to(shape, drawn.shape), np.broadcast_to(good, drawn.shape)
    )
    middle, _, _ = band.values(shape[:, None], shape, good)
    # the scatter of a variance of 20000 draws is 1 %
    assert np.var(values) / middle[0, 0] ** 2 == pytest.approx(variance[0], rel=0.04)


def test_too_many_flags_leave_nothing():
    band = ChannelBand.of(10.0, 1.0, 2, AVERAGING[1], channel_mhz("centre"))
    n = band.last - band.first
    good = np.zeros((3, n), dtype=bool)
    good[1, :3] = True  # no more than terms
    good[2, :15] = True  # to be extrapolated
    flat = np.ones((3, n))
    _, variance, _ = band.values(flat[:, None], flat, good)
    assert np.isinf(variance).all()


def test_bands_with_too_few_bins_are_refused():
    assert_refused(lambda: ChannelBand.of(10.0, 0.1, 2, AVERAGING[1], channel_mhz("centre")))
    assert_refused(lambda: ChannelBand.of(70.0, 1.0, 2, AVERAGING[1], channel_mhz("centre")))


def test_windows_share_noise_as_their_transforms_say():
    """A Hann window's transform is (1, -1/2, 0) of its mean: c_1 = 2/3, c_2 = 1/6 (Harris 1978)."""
    found = shared_noise(1, "hann")
    np.testing.assert_allclose(found[:4], [1.0, 4.0 / 9.0, 1.0 / 36.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(shared_noise(1, "rectangular")[:3], [1.0, 0.0, 0.0], atol=1e-12)
    assert shared_noise(0, "hann") == (1.0,)
    assert_refused(lambda: shared_noise(-1, "hann"))


@pytest.mark.parametrize(("taps", "taper"), [(4, "hann"), (4, "hamming"), (2, "rectangular")])
def test_filter_banks_share_noise_as_noise_through_them_does(taps, taper):
    """White noise through the bank, as a sum over samples: covariances of mean powers."""
    n, frames, sets = 32, 64, 3000
    h = impulse_response(taps, taper)[FRAME // n // 2 :: FRAME // n]
    rng = np.random.default_rng(8)
    power = np.zeros((sets, n // 2))
    for start in range(0, sets, 500):
        x = rng.standard_normal((500, (frames + taps - 1) * n))
        for t in range(frames):
            y = np.fft.fft((x[:, t * n : (t + taps) * n] * h).reshape(500, taps, n).sum(axis=1))
            power[start : start + 500] += np.abs(y[:, : n // 2]) ** 2 / frames
    power /= power.mean(axis=0)
    inner = np.arange(3, n // 2 - 5)
    covariance = np.cov(power.T) * frames
    expected = shared_noise(taps, taper)
    for apart in range(3):
        found = np.mean(covariance[inner, inner + apart])
        # of 3000 sets a variance scatters by 2.6 %, of the mean over channels by less; frames at
        # the ends have fewer neighbours: a share of taps / frames; h of 32 samples is coarse
        assert found == pytest.approx(expected[apart], abs=0.06)
