"""An isotropic Gaussian sky in HEALPix pixels: S = Y diag(C_ell) Y^T."""

from __future__ import annotations

from typing import NoReturn

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from lusee_bayes.core.arrays import Array
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.harmonics import n_modes, per_mode, pixel_matrix
from lusee_bayes.sky.priors.base import Prior
from lusee_bayes.sky.priors.harmonic import HarmonicPrior, require_spectrum


class PixelPrior(Prior):
    """The same isotropic sky in HEALPix RING pixels: m = Y a, S = Y diag(C_ell) Y^T.

    S has rank (lmax + 1)^2 at most. Use it with :meth:`coupling`, which turns a harmonic A into
    one that acts on pixels.

    Parameters
    ----------
    spectrum : (ells,) array
        C_ell in K^2 for ell = 0..lmax.
    nside : int
        NSIDE of the pixels.

    Attributes
    ----------
    spectrum : (ells,) array
        C_ell in K^2.
    synthesis : (pixels, modes) array
        Y.

    Raises
    ------
    InputError
        If the pixels are fewer than the modes, or the spectrum cannot be one.
    """

    spectrum: Float[Array, " ells"]
    synthesis: Float[Array, "pixels modes"]

    def __init__(self, spectrum: Float[Array, " ells"], nside: int):
        require_spectrum(spectrum)
        lmax = spectrum.shape[0] - 1
        if 12 * nside**2 < n_modes(lmax):
            raise InputError(
                f"NSIDE {nside} has {12 * nside**2} pixels, too few for the {n_modes(lmax)} modes "
                f"of lmax = {lmax}; raise NSIDE or lower lmax"
            )
        self.spectrum = spectrum
        self.synthesis = jnp.asarray(pixel_matrix(nside, lmax))

    @property
    def size(self) -> int:
        return self.synthesis.shape[0]

    @property
    def rank(self) -> int:
        return self.synthesis.shape[1]

    @property
    def invertible(self) -> bool:
        return False

    @property
    def independent(self) -> bool:
        return False

    def colour(self, u):
        return HarmonicPrior(self.spectrum).colour(u) @ self.synthesis.T

    def colour_columns(self, a):
        return HarmonicPrior(self.spectrum).colour_columns(a @ self.synthesis)

    def whiten(self, m):
        self._refuse()

    def whiten_columns(self, a):
        self._refuse()

    def sandwich(self, matrix):
        return self.colour_columns(self.colour_columns(matrix).T)

    def widened(self, factor):
        return eqx.tree_at(lambda prior: prior.spectrum, self, self.spectrum * factor**2)

    def variance(self):
        return self.synthesis**2 @ per_mode(self.spectrum)

    def covariance(self):
        root = self.colour(jnp.eye(self.rank))
        return root.T @ root

    def log_det(self):
        self.require_density()

    def require_density(self) -> None:
        self._refuse()

    def _refuse(self) -> NoReturn:
        raise InputError(
            "a prior over pixels is singular: it has no density, and pixels do not tell their "
            "coefficients; use a prior over harmonic coefficients"
        )

    def coupling(self, harmonic: Float[Array, "data modes"]) -> Float[Array, "data pixels"]:
        """Turn A into one that acts on pixels.

        A_pix = A Y^+, so that A_pix Y a = A a for every band-limited sky.

        Parameters
        ----------
        harmonic : (data, modes) array
            A.
        """
        return harmonic @ jnp.asarray(np.linalg.pinv(np.asarray(self.synthesis)))
