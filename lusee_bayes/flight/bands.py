"""One number for a band of channels: the spectrum at its middle, from a polynomial.

Spectra are steep: the mean of f^-2.5 over 1 MHz around 10 MHz is 0.4 % above its middle, hundreds
of times the noise. So a polynomial is fitted to the channels of every spectrum and evaluated at the
middle: for degree 2, the error is of fourth order. A value is sum_k w_k x_k with weights that
depend only on the flags; its variance is that of n independent samples of voltages,
n = frames / sum_kl w_k s_k C_kl s_l w_l, C the noise that channels share and s the shape of the
spectrum.

C describes a polyphase filter bank. With T taps it multiplies T frames of N samples by h, a window
times the impulse response of a channel, before the Fourier transform:
y_k(t) = sum_n h(n) x(n + N t) exp(-2 pi i k n / N). For white noise, ::

    <y_k(t) conj(y_k+d(t + s))> ~ c_d(s) = sum_n h(n) h(n - s N) exp(2 pi i d n / N),

and the powers of two channels, averaged over many frames, have the covariance ::

    sum_s |c_d(s)|^2.

Independent frames would give c_0(0)^2.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float

from lusee_bayes.core.arrays import RowFlags, Rows
from lusee_bayes.core.errors import InputError
from lusee_bayes.flight.session import Averaging, Middles

# spectra in bands: rows at the points of a curve, the curve's terms, and values of a band
Points = Bool[np.ndarray, "rows points"]
PointValues = Float[np.ndarray, "rows points"]
Basis = Float[np.ndarray, "points terms"]
Values = Float[np.ndarray, "rows products"]
Normals = Float[np.ndarray, "rows terms terms"]
# a spectrum is not used if its flags raise the variance of its value by more than this factor
MOST_VARIANCE = 4.0
ROUNDING_MHZ = 1e-9


@dataclass(frozen=True, eq=False)
class ChannelBand:
    """The bins of a band, and the polynomials over them.

    Attributes
    ----------
    first, last : int
        Bins first to last - 1 lie within the band, with all their channels.
    basis : (bins, terms) array
        Powers of the distance from the middle in half bandwidths, averaged over the channels of
        each bin.
    finer : (bins, more) array
        The same with two further powers.
    shared : (bins, bins) array
        Covariance of the noise of the bins for a flat spectrum of 1 and one frame.
    """

    first: int
    last: int
    basis: Float[np.ndarray, "bins terms"]
    finer: Float[np.ndarray, "bins more"]
    shared: Float[np.ndarray, "bins bins"]

    @classmethod
    def of(
        cls,
        frequency_mhz: float,
        bandwidth_mhz: float,
        degree: int,
        averaging: Averaging,
        middles_mhz: Middles,
        shared_noise: tuple[float, ...] = (1.0,),
    ) -> "ChannelBand":
        """Return the bins of a band.

        Parameters
        ----------
        frequency_mhz, bandwidth_mhz : float
            Middle and width of the band; channels with their middle at its ends are included.
        degree : int
            Degree of the polynomial.
        averaging : Averaging
            The channels in each bin.
        middles_mhz : (channels,) array
        shared_noise : tuple of float
            :func:`.shared_noise`.

        Raises
        ------
        InputError
            If there are too few bins for the polynomial.
        """
        channels = averaging.channels()
        x = (middles_mhz[channels] - frequency_mhz) / (bandwidth_mhz / 2.0)
        within = np.flatnonzero((np.abs(x) <= 1.0 + ROUNDING_MHZ).all(axis=1))
        # two further powers are fitted to find lines
        if len(within) < degree + 4:
            raise InputError(
                f"the band of {bandwidth_mhz:g} MHz around {frequency_mhz:g} MHz has {len(within)} "
                f"bins, but testing a polynomial of degree {degree} takes {degree + 4}; use a "
                "larger flight.bandwidth_hz or a lower flight.degree"
            )
        first, last = int(within[0]), int(within[-1]) + 1
        finer = (x[first:last, :, None] ** np.arange(degree + 3)).mean(axis=1)
        apart = np.abs(channels[first:last, :, None, None] - channels[None, None, first:last])
        correlation = np.array([*shared_noise, 0.0])
        shared = correlation[np.minimum(apart, len(correlation) - 1)].mean(axis=(1, 3))
        return cls(first, last, finer[:, : degree + 1], finer, shared)

    def values(
        self, spectra: Float[np.ndarray, "rows products points"], autos: PointValues, good: Points
    ) -> tuple[Values, Rows, Values]:
        """Return the values of spectra at the middle.

        Parameters
        ----------
        spectra : (rows, products, bins) array
            Spectra in the band's bins.
        autos : (rows, bins) array
            Mean of the autos, which gives the shape of the noise.
        good : (rows, bins) array of bool
            Bins to use.

        Returns
        -------
        (rows, products) array
            In the unit of the spectra.
        (rows,) array
            Variance in units of the value's own square, for one frame; infinite if too many bins
            are flagged.
        (rows, products) array
            Change of the values by two further powers.
        """
        weights, possible = point_weights(self.basis, good)
        finer, _ = point_weights(self.finer, good)
        shape = np.where(good, autos, 0.0)
        middle = np.einsum("rk,rk->r", weights, shape)
        with np.errstate(divide="ignore", invalid="ignore"):
            scaled = weights * shape / middle[:, None]
        variance = np.einsum("rk,kl,rl->r", scaled, self.shared, scaled)
        whole, _ = point_weights(self.basis, np.ones((1, len(self.basis)), dtype=bool))
        at_best = float((whole @ self.shared @ whole.T)[0, 0])
        usable = possible & (middle > 0.0) & (variance <= MOST_VARIANCE * at_best)
        clean = np.where(good[:, None], spectra, 0.0)
        values = np.einsum("rpk,rk->rp", clean, weights)
        further = np.einsum("rpk,rk->rp", clean, finer) - values
        return values, np.where(usable, variance, np.inf), further


def point_weights(basis: Basis, good: Points) -> tuple[PointValues, RowFlags]:
    """Return the weights that evaluate a least-squares polynomial at the middle.

    Parameters
    ----------
    basis : (points, terms) array
        Powers, of which only the first is not zero at the middle.
    good : (rows, points) array of bool

    Returns
    -------
    (rows, points) array
        Zero where not good.
    (rows,) array of bool
        Whether there are enough points.
    """
    inverse, possible = inverse_normals(basis, good)
    return np.where(good & possible[:, None], inverse[:, 0] @ basis.T, 0.0), possible


def inverse_normals(basis: Basis, good: Points) -> tuple[Normals, RowFlags]:
    """Return the inverse normal matrix of the curve through the good points of every row.

    Also whether there are enough points; if not, the unit matrix is returned.
    """
    normal = np.einsum("rk,ka,kb->rab", good.astype(float), basis, basis, optimize=True)
    possible = good.sum(axis=1) > basis.shape[1]
    normal[~possible] = np.eye(basis.shape[1])
    return np.linalg.inv(normal), possible


Taper = Literal["rectangular", "hann", "hamming", "blackman"]
# length of a frame in samples; covariances do not depend on it if it is long
FRAME = 512
# channels further apart share nothing
REACH = 6
# coefficients of cos(2 pi j n / N T) of each window
WINDOWS: dict[Taper, tuple[float, ...]] = {
    "rectangular": (1.0,),
    "hann": (0.5, -0.5),
    "hamming": (0.54, -0.46),
    "blackman": (0.42, -0.5, 0.08),
}


@lru_cache(maxsize=16)
def shared_noise(taps: int, taper: Taper) -> tuple[float, ...]:
    """Return the covariance of the powers of channels 0, 1, ... apart.

    Parameters
    ----------
    taps : int
        Number of frames that form a spectrum: 1 is a windowed Fourier transform; 0 is for channels
        that share nothing.
    taper : {"rectangular", "hann", "hamming", "blackman"}

    Returns
    -------
    tuple of float
        In units of the variance of independent frames in independent channels; the first exceeds
        one if frames overlap.
    """
    if taps == 0:
        return (1.0,)
    h = impulse_response(taps, taper)
    covariance, padded = np.zeros(REACH + 1), np.pad(h, len(h))
    for start in range(FRAME, 2 * len(h), FRAME):
        # frames fold onto one: exp(2 pi i d n / N) has their period
        folded = (h * padded[start : start + len(h)]).reshape(taps, FRAME).sum(axis=0)
        covariance += np.abs(np.fft.fft(folded)[: REACH + 1]) ** 2
    return tuple((covariance / (h @ h) ** 2).tolist())


def impulse_response(taps: int, taper: Taper) -> Float[np.ndarray, " samples"]:
    """Return h: a window, times the sinc of one channel if there are several taps."""
    n = taps * FRAME
    t = (np.arange(n) + 0.5) / n
    window = sum(c * np.cos(2.0 * np.pi * j * t) for j, c in enumerate(WINDOWS[taper]))
    return window * np.sinc((t - 0.5) * taps) if taps > 1 else window
