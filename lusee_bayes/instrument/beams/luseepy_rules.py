"""luseepy's quadrature over the directions of a file, for data that luseepy has made."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.special import roots_legendre

from lusee_bayes.core.harmonics import mode_numbers, polar_functions
from lusee_bayes.instrument.beams.grid import HemisphereGrid


def rectangle_rule(theta: Float[np.ndarray, " theta"], n_phi: int) -> HemisphereGrid:
    """Return luseepy's rule for scalar beams: sin(theta) dtheta dphi, equal steps up to pi / 2."""
    return HemisphereGrid(theta, np.sin(theta) * theta[1], n_phi)


class BandLimitedGrid(HemisphereGrid):
    """luseepy's rule for responses: the pattern as a band-limited function on the whole sphere.

    The samples above the horizon are continued by zeros below it, those on it count half, and the
    trigonometric polynomial in theta through all of them is integrated exactly.

    References
    ----------
    McEwen and Wiaux 2011, IEEE Trans. Signal Process. 59, 5876 (symmetric sampling).
    """

    @classmethod
    def of(cls, theta: Float[np.ndarray, " theta"], n_phi: int) -> BandLimitedGrid:
        """Return the rule for ``theta`` in equal steps from 0 to pi / 2, both included."""
        n = len(theta)
        nodes, weights = roots_legendre(4 * n)
        even = weights @ cardinal_functions(np.arccos(nodes), 2 * n - 2, 0)[:, :n]
        even[-1] /= 2.0
        return cls(theta, even, n_phi)

    def polar_weights(self, lmax: int) -> Float[np.ndarray, "theta modes"]:
        """Return the integrals of each sample's cardinal function times lambda_lm(theta)."""
        n = len(self.theta)
        # exact: the product has degree 2 n + lmax in theta
        nodes, weights = roots_legendre(4 * n + lmax)
        fine = np.arccos(nodes)
        polar = polar_functions(fine, lmax) * weights[:, None]
        _, m = mode_numbers(lmax)
        summed = np.empty((n, polar.shape[1]))
        for parity in (0, 1):
            same = m % 2 == parity
            cardinal = cardinal_functions(fine, 2 * n - 2, parity)[:, :n]
            summed[:, same] = cardinal.T @ polar[:, same]
        summed[-1] /= 2.0
        return summed


def cardinal_functions(
    theta: Float[np.ndarray, " theta"], intervals: int, parity: int
) -> Float[np.ndarray, "theta samples"]:
    """Return trigonometric polynomials that are 1 at one sample and 0 at the others.

    The samples are pi k / intervals, k = 0 .. intervals.

    Parameters
    ----------
    theta : (theta,) array
        Where to evaluate them, in radians.
    intervals : int
    parity : {0, 1}
        Whether they continue beyond the poles evenly (0) or oddly (1), as the Fourier coefficients
        of a smooth function on the sphere do for even and odd m.

    Returns
    -------
    (theta, samples) array
    """
    samples = np.pi * np.arange(2 * intervals) / intervals
    difference = theta[:, None] - samples[None]
    orders = np.arange(1, intervals)
    kernel = 1.0 + np.cos(intervals * difference)
    kernel = (kernel + 2.0 * np.cos(orders[:, None, None] * difference).sum(0)) / (2 * intervals)
    cardinal = kernel[:, : intervals + 1].copy()
    mirrored = kernel[:, :intervals:-1]
    cardinal[:, 1:-1] += mirrored if parity == 0 else -mirrored
    if parity:
        cardinal[:, [0, -1]] = 0.0
    return cardinal
