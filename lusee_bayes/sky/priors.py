"""The prior on the sky, m ~ N(mu, S), through a square root S = G G^T; mu is zero by default.

Everything downstream works with the whitened sky u = G^-1 m ~ N(G^-1 mu, 1). S itself is never
inverted, so an ell without power (C_ell = 0) is a mode that is known to be zero, not an error.
"""

from __future__ import annotations

from abc import abstractmethod

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from lusee_bayes.core.arrays import Array, namespace
from lusee_bayes.core.checks import is_traced, require_finite, require_float64, require_shape
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.harmonics import n_modes, per_mode, pixel_matrix
from lusee_bayes.core.representation import Described, extent


class Prior(Described, eqx.Module):
    """N(mu, S) over the sky's unknowns, as m = G u of independent normals u of unit variance."""

    def description(self) -> tuple[str, ...]:
        return (f"{self.size} unknowns of {self.rank} independent normals",)

    @property
    @abstractmethod
    def size(self) -> int:
        """Number of unknowns in m."""

    @property
    @abstractmethod
    def rank(self) -> int:
        """Number of independent normals behind them."""

    @abstractmethod
    def colour(self, u: Float[Array, "*batch white"]) -> Float[Array, "*batch unknowns"]:
        """Compute G u, on the last axis."""

    @abstractmethod
    def colour_columns(self, a: Float[Array, "rows unknowns"]) -> Float[Array, "rows white"]:
        """Compute A G: the columns of A in units of the prior."""

    @abstractmethod
    def diagonal_root(self) -> Float[Array, " unknowns"] | None:
        """Return the diagonal of G if G is diagonal, else None."""

    @abstractmethod
    def variance(self) -> Float[Array, " unknowns"]:
        """Return the diagonal of S, in K^2."""

    @property
    def white_mean(self) -> Float[Array, " white"] | None:
        """Mean of u; None for zero."""
        return None

    def covariance(self) -> Float[Array, "unknowns unknowns"]:
        """Return S as a matrix, in K^2."""
        root = self.colour(jnp.eye(self.rank))
        return root.T @ root

    def sample(self, key: PRNGKeyArray, n: int | None = None) -> Float[Array, "..."]:
        """Draw skies from the prior.

        Parameters
        ----------
        key : PRNG key
            For the draw.
        n : int, optional
            How many; by default one.

        Returns
        -------
        (unknowns,) or (n, unknowns) array
            In K.
        """
        shape = (self.rank,) if n is None else (n, self.rank)
        u = jax.random.normal(key, shape, dtype=jnp.float64)
        if self.white_mean is not None:
            u = u + self.white_mean.reshape(*(1,) * (u.ndim - 1), -1)
        return self.colour(u)


def _require_spectrum(spectrum: Float[Array, " ells"]) -> None:
    require_float64("the prior spectrum", spectrum)
    require_finite("the prior spectrum", spectrum)
    if is_traced(spectrum):
        return
    negative = np.asarray(spectrum) < 0
    if negative.any():
        ell = int(np.argmax(negative))
        raise InputError(
            f"the prior spectrum is negative at ell = {ell}: C_ell = {float(spectrum[ell]):.3g}; "
            "a variance cannot be"
        )


class HarmonicPrior(Prior):
    """S = diag(C_ell): an isotropic Gaussian sky in real harmonic coefficients, about a mean sky.

    Attributes
    ----------
    spectrum : (ells,) array
        C_ell in K^2 for ell = 0..lmax; C_0 is the prior variance of the monopole.
    mean : (modes,) array or None
        The prior mean, in K, Galactic, real packed; None for zero.

    Raises
    ------
    InputError
        If the spectrum or the mean is not float64 or not finite, the spectrum is negative, or the
        mean has another lmax, or power at an ell where the spectrum has none.
    """

    spectrum: Float[Array, " ells"]
    mean: Float[Array, " modes"] | None = eqx.field(default=None, kw_only=True)

    def __check_init__(self):
        _require_spectrum(self.spectrum)
        if self.mean is None:
            return
        require_float64("the prior mean", self.mean)
        require_shape("the prior mean", self.mean, (self.size,))
        require_finite("the prior mean", self.mean)
        if is_traced(self.spectrum, self.mean):
            return
        fixed = np.flatnonzero((np.asarray(self.mean) != 0.0) & ~(np.asarray(self.variance()) > 0))
        if fixed.size:
            raise InputError(
                f"the prior mean has power at ell = {int(np.sqrt(fixed[0]))}, where C_ell is zero; "
                "give that ell a variance"
            )

    def description(self) -> tuple[str, ...]:
        about = "zero" if self.mean is None else "a mean sky"
        return (
            f"independent coefficients about {about}, lmax = {self.spectrum.shape[0] - 1}",
            f"{self.size} real coefficients, Galactic; C_ell {extent(self.spectrum, 'K^2')}",
        )

    @property
    def white_mean(self) -> Float[Array, " white"] | None:
        if self.mean is None:
            return None
        xp, root = namespace(self.mean, self.spectrum), self.diagonal_root()
        return xp.where(root > 0, self.mean / xp.where(root > 0, root, 1.0), 0.0)

    @property
    def size(self) -> int:
        return n_modes(self.spectrum.shape[0] - 1)

    @property
    def rank(self) -> int:
        return self.size

    def diagonal_root(self):
        # the derivative of sqrt at an ell without power is zero here, not infinite
        xp, power = namespace(self.spectrum), self.spectrum > 0
        root = xp.sqrt(xp.where(power, self.spectrum, 1.0))
        return per_mode(xp.where(power, root, 0.0))

    def colour(self, u):
        return u * self.diagonal_root().reshape(*(1,) * (u.ndim - 1), -1)

    def colour_columns(self, a):
        return a * self.diagonal_root()[None]

    def variance(self):
        return per_mode(self.spectrum)


class IndependentPrior(Prior):
    """Independent unknowns of any kind, such as sky modes and source fluxes: S = diag(root^2).

    Attributes
    ----------
    root : (unknowns,) array
        Prior standard deviations, each in its unknown's unit.

    Raises
    ------
    InputError
        If they are not float64 or not finite.
    """

    root: Float[Array, " unknowns"]

    def __check_init__(self):
        require_float64("the prior's standard deviations", self.root)
        require_finite("the prior's standard deviations", self.root)

    @property
    def size(self) -> int:
        return self.root.shape[0]

    @property
    def rank(self) -> int:
        return self.size

    def diagonal_root(self):
        return self.root

    def colour(self, u):
        return u * self.root.reshape(*(1,) * (u.ndim - 1), -1)

    def colour_columns(self, a):
        return a * self.root[None]

    def variance(self):
        return self.root**2


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
        _require_spectrum(spectrum)
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

    def colour(self, u):
        return HarmonicPrior(self.spectrum).colour(u) @ self.synthesis.T

    def colour_columns(self, a):
        return HarmonicPrior(self.spectrum).colour_columns(a @ self.synthesis)

    def diagonal_root(self):
        return None

    def variance(self):
        return self.synthesis**2 @ per_mode(self.spectrum)

    def coupling(self, harmonic: Float[Array, "data modes"]) -> Float[Array, "data pixels"]:
        """Turn A into one that acts on pixels.

        A_pix = A Y^+, so that A_pix Y a = A a for every band-limited sky.

        Parameters
        ----------
        harmonic : (data, modes) array
            A.
        """
        return harmonic @ jnp.asarray(np.linalg.pinv(np.asarray(self.synthesis)))
