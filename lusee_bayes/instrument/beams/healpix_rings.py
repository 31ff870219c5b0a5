"""Functions on HEALPix pixels in other directions above the horizon.

A ring of pixels is a Fourier series in phi. Order m of a smooth function passes the zenith as
f_m(-theta) = (-1)^m f_m(theta), and is zero there unless m is: splines in theta need no end at the
zenith, and no rings that have too few pixels for an order (4 i in ring number i). The error is that
of cubic splines with the distance h = 1 / NSIDE of rings at most, 5/384 (h l)^4 of a pattern of
degree l, and in the last step to the horizon, which is extrapolated, up to 35 times that. Orders 3
pass for orders 1 in the first ring, by (h l)^3 / 43 of the pattern there.
"""

from __future__ import annotations

import numpy as np
import scipy
from jaxtyping import Float, Inexact

from lusee_bayes.core.lazy import healpy


def from_rings(
    pixels: Inexact[np.ndarray, "*batch pixels"],
    theta: Float[np.ndarray, " theta"],
    phi: Float[np.ndarray, " phi"],
) -> Inexact[np.ndarray, "*batch theta phi"]:
    """Interpolate scalar functions from HEALPix RING pixels to a grid above the horizon.

    Only pixels with theta < 90 degrees are used.

    Parameters
    ----------
    pixels : (..., pixels) array
    theta : (theta,) array
        In radians, from the zenith, up to pi / 2.
    phi : (phi,) array
        In radians.

    Returns
    -------
    (..., theta, phi) array
        Complex if the pixels are.
    """
    nside = healpy.npix2nside(pixels.shape[-1])
    sizes = 4 * np.minimum(np.arange(1, 2 * nside), nside)
    starts = np.concatenate([[0], np.cumsum(sizes)[:-1]])
    ring_theta, first_phi = healpy.pix2ang(nside, starts)
    orders = np.arange(1 - 2 * nside, 2 * nside)
    # f_m of every ring; orders that a ring has too few pixels for are not looked at
    series = np.zeros((*pixels.shape[:-1], len(sizes), len(orders)), dtype=np.complex128)
    for ring, (n, start) in enumerate(zip(sizes, starts, strict=True)):
        spectrum = np.fft.fft(pixels[..., start : start + n], axis=-1) / n
        series[..., ring, :] = spectrum[..., orders % n] * np.exp(-1j * orders * first_phi[ring])
    spread = np.empty((*pixels.shape[:-1], len(theta), len(orders)), dtype=np.complex128)
    for m in range(2 * nside):
        enough = np.flatnonzero(sizes > 2 * m)
        both = 2 * nside - 1 + np.unique([-m, m])
        known = series[..., enough, :][..., both]
        parts = [(-1.0) ** m * known[..., ::-1, :], known]
        nodes = [-ring_theta[enough][::-1], ring_theta[enough]]
        if m:
            parts.insert(1, np.zeros_like(known[..., :1, :]))
            nodes.insert(1, np.zeros(1))
        spline = scipy.interpolate.CubicSpline(
            np.concatenate(nodes), np.concatenate(parts, axis=-2), axis=-2
        )
        spread[..., both] = spline(theta)
    values = spread @ np.exp(1j * orders[:, None] * phi[None])
    return values if np.iscomplexobj(pixels) else values.real
