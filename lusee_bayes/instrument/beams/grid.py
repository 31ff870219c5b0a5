"""Quadrature over the hemisphere above the horizon.

A beam ends at the horizon. Gauss-Legendre nodes in cos theta over [0, 1] never see the cut, so
harmonic coefficients converge exponentially where pixel sums ring. Azimuth is uniform: a Fourier
sum there is exact up to aliasing.
"""

from __future__ import annotations

import equinox as eqx
import numpy as np
from jaxtyping import Float
from scipy.special import roots_legendre

from lusee_bayes.core.arrays import Array, namespace
from lusee_bayes.core.checks import require_shape, require_whole
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.harmonics import LARGEST_LMAX, SQRT2, mode_numbers, polar_functions


class HemisphereGrid(eqx.Module):
    """Directions above the horizon and their quadrature weights.

    Frame: topocentric, theta from the zenith, phi from East towards North.

    Attributes
    ----------
    theta : (theta,) array
        In radians.
    weights : (theta,) array
        Such that sum_theta sum_phi weights * 2 pi / n_phi = 2 pi.
    n_phi : int
        Number of azimuths phi_k = 2 pi k / n_phi.
    """

    theta: Float[np.ndarray, " theta"]
    weights: Float[np.ndarray, " theta"]
    n_phi: int = eqx.field(static=True)

    @classmethod
    def gauss_legendre(cls, n_theta: int, n_phi: int) -> HemisphereGrid:
        """Return a grid, exact for polynomials in cos theta up to degree 2 n_theta - 1."""
        nodes, weights = roots_legendre(n_theta)
        return cls(np.arccos((nodes[::-1] + 1.0) / 2.0), weights[::-1] / 2.0, n_phi)

    @classmethod
    def for_lmax(cls, lmax: int) -> HemisphereGrid:
        """Return a grid that is fine enough for harmonics up to ``lmax`` of the embedded antennas.

        Their coefficients change by less than 1e-11 of the largest when the number of nodes
        doubles (tests/instrument/test_monopoles.py). A loss tangent below 0.001 needs more nodes,
        since echoes from deep layers then vary quickly with the angle.
        """
        require_whole("lmax", lmax, 0, LARGEST_LMAX)
        n = max(lmax, 63) + 1
        return cls.gauss_legendre(2 * n, 2 * n)

    @property
    def phi(self) -> Float[np.ndarray, " phi"]:
        """Azimuths in radians."""
        return 2.0 * np.pi * np.arange(self.n_phi) / self.n_phi

    def polar_weights(self, lmax: int) -> Float[np.ndarray, "theta modes"]:
        """Return the weight of the Fourier sum at each theta in every coefficient: w lambda_lm."""
        return polar_functions(self.theta, lmax) * self.weights[:, None]

    def integrate(self, f: Float[Array, "*batch theta phi"]) -> Float[Array, "*batch"]:
        """Integrate over the hemisphere; the result is in units of f times steradian."""
        return (f.sum(-1) @ self.weights) * (2.0 * np.pi / self.n_phi)

    def modes(self, f: Float[Array, "*batch theta phi"], lmax: int) -> Float[Array, "*batch modes"]:
        """Return the harmonic coefficients of a function that is zero below the horizon.

        a_lm = sum_theta w lambda_lm(theta) sum_phi f exp(-i m phi) 2 pi / n_phi.

        Parameters
        ----------
        f : (..., theta, phi) array
            The function on this grid.
        lmax : int

        Returns
        -------
        (..., modes) array
            Real packed coefficients.

        Raises
        ------
        InputError
            If ``f`` does not fit the grid, or its azimuths are too few for ``lmax``.
        """
        require_shape("the field", f, (*f.shape[:-2], len(self.theta), self.n_phi))
        if self.n_phi <= 2 * lmax:
            raise InputError(
                f"{self.n_phi} azimuths cannot resolve lmax = {lmax}; give more than {2 * lmax}"
            )
        ell, m = mode_numbers(lmax)
        xp = namespace(f)
        fourier = xp.fft.rfft(f, axis=-1)[..., : lmax + 1] * (2.0 * np.pi / self.n_phi)
        parts = xp.concatenate(
            [
                SQRT2 * fourier.imag[..., :0:-1],
                fourier.real[..., :1],
                SQRT2 * fourier.real[..., 1:],
            ],
            axis=-1,
        )
        # for every order a product with its functions of theta, zero where there is no mode
        polar = np.zeros((2 * lmax + 1, len(self.theta), lmax + 1))
        polar[m + lmax, :, ell] = self.polar_weights(lmax).T
        by_order = xp.moveaxis(parts, -1, 0).reshape(2 * lmax + 1, -1, len(self.theta)) @ polar
        return xp.moveaxis(by_order[m + lmax, :, ell], 0, -1).reshape(*f.shape[:-2], -1)
