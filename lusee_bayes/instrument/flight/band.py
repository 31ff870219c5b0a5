"""One number for a band of channels: the spectrum at its middle, by a polynomial.

Spectra are steep: the mean of f^-2.5 over 1 MHz about 10 MHz is 0.4 % above its middle, hundreds
of times the noise. So a polynomial is fitted to the channels of every spectrum, and its value at
the middle is taken: for degree 2, what is left out is of fourth order. A value is sum_k w_k x_k
with weights that depend on the flags alone; its variance is that of n independent samples of
voltages, n = frames / sum_kl w_k s_k C_kl s_l w_l, C the noise that channels share and s the shape
of the spectrum.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from lusee_bayes.core.errors import InputError
from lusee_bayes.instrument.flight.spectrometer import Averaging

# a spectrum with so many flags that its value has this many times the variance is not used
MOST_VARIANCE = 4.0
ROUNDING_MHZ = 1e-9


@dataclass(frozen=True, eq=False)
class Band:
    """The bins of a band, and the polynomials over them.

    Attributes
    ----------
    frequency_mhz : float
        The middle.
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

    frequency_mhz: float
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
        middles_mhz: Float[np.ndarray, " channels"],
        shared_noise: tuple[float, ...] = (1.0,),
    ) -> Band:
        """Find the bins of a band.

        Parameters
        ----------
        frequency_mhz, bandwidth_mhz : float
            Channels with their middles within the bandwidth, ends included.
        degree : int
            Of the polynomial.
        averaging : Averaging
            Which channels the bins hold.
        middles_mhz : (channels,) array
        shared_noise : tuple of float
            :func:`.shared_noise`.

        Raises
        ------
        InputError
            If there are too few of them for the polynomial.
        """
        channels = averaging.channels()
        x = (middles_mhz[channels] - frequency_mhz) / (bandwidth_mhz / 2.0)
        within = np.flatnonzero((np.abs(x) <= 1.0 + ROUNDING_MHZ).all(axis=1))
        # two further powers are fitted to find lines
        if len(within) < degree + 4:
            raise InputError(
                f"the band of {bandwidth_mhz:g} MHz about {frequency_mhz:g} MHz has {len(within)} "
                f"bins, and a polynomial of degree {degree} needs {degree + 4} to be checked; "
                "use a larger flight.bandwidth_hz or a lower flight.degree"
            )
        first, last = int(within[0]), int(within[-1]) + 1
        powers = np.arange(degree + 3)
        finer = (x[first:last, :, None] ** powers).mean(axis=1)
        apart = np.abs(channels[first:last, :, None, None] - channels[None, None, first:last])
        known = np.array([*shared_noise, 0.0])
        shared = known[np.minimum(apart, len(known) - 1)].mean(axis=(1, 3))
        return cls(frequency_mhz, first, last, finer[:, : degree + 1], finer, shared)

    def values(
        self,
        spectra: Float[np.ndarray, "rows products bins"],
        autos: Float[np.ndarray, "rows bins"],
        good: Bool[np.ndarray, "rows bins"],
    ) -> tuple[
        Float[np.ndarray, "rows products"],
        Float[np.ndarray, " rows"],
        Float[np.ndarray, "rows products"],
    ]:
        """Return the spectrum at the middle.

        Parameters
        ----------
        spectra : (rows, products, bins) array
            Of the band's bins.
        autos : (rows, bins) array
            Mean of the autos, which shape the noise.
        good : (rows, bins) array of bool
            Which bins to use.

        Returns
        -------
        (rows, products) array
            In the unit of the spectra.
        (rows,) array
            Variance in units of the value's own square, for one frame; infinite where too many bins
            are flagged.
        (rows, products) array
            What two further powers would add.
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
        variance = np.where(usable, variance, np.inf)
        clean = np.where(good[:, None], spectra, 0.0)
        values = np.einsum("rpk,rk->rp", clean, weights)
        return values, variance, np.einsum("rpk,rk->rp", clean, finer) - values


def point_weights(
    basis: Float[np.ndarray, "points terms"], good: Bool[np.ndarray, "rows points"]
) -> tuple[Float[np.ndarray, "rows points"], Bool[np.ndarray, " rows"]]:
    """Return the weights by which a least-squares polynomial is evaluated in the middle.

    Parameters
    ----------
    basis : (points, terms) array
        Powers, of which the middle has the first alone.
    good : (rows, points) array of bool

    Returns
    -------
    (rows, points) array
        Zero where not good.
    (rows,) array of bool
        Whether there are enough points.
    """
    terms = basis.shape[1]
    normal = np.einsum("rk,ka,kb->rab", good.astype(float), basis, basis, optimize=True)
    possible = good.sum(axis=1) > terms
    normal[~possible] = np.eye(terms)
    unit = np.zeros((terms, 1))
    unit[0] = 1.0
    solved = np.linalg.solve(normal, np.broadcast_to(unit, (len(good), terms, 1)))[..., 0]
    return np.where(good & possible[:, None], solved @ basis.T, 0.0), possible
