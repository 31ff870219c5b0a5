"""The posterior over sky maps: mean, covariance, standard deviations, draws.

The pixel variances of a map are diag(Y C Y^T), computed ring by ring; see
:mod:`lusee_bayes.core.harmonics`.
"""

from collections.abc import Sequence
from functools import lru_cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from lusee_bayes.core import checks, harmonics, lazy, linalg
from lusee_bayes.core.arrays import Array, ModesMatrix, Pixels, compiled, namespace
from lusee_bayes.core.errors import InputError
from lusee_bayes.sky.prior import Prior

Degrees = Sequence[float] | Float[np.ndarray, " n"]

# largest accepted relative error of standard deviations
PRECISION = 1e-3


class Posterior(checks.Described, eqx.Module):
    """N(mean, C) over the sky's unknowns m = G u, in K.

    Attributes
    ----------
    prior : Prior
        S = G G^T.
    white_mean : (white,) array
        Mean of u.
    lower : (rank, rank) array
        L of Lambda = L L^T, the precision of u, or of v = Q^T u if ``basis`` is given.
    basis : (white, rank) array or None
        Q. Outside its span, u keeps its prior, N(0, 1).
    log_evidence : () array
        ln p(d), for data in K.
    refinement : () array
        Last correction of the mean, in posterior standard deviations.
    """

    prior: Prior
    white_mean: Float[Array, " white"]
    lower: Float[Array, "rank rank"]
    basis: Float[Array, "white rank"] | None
    log_evidence: Float[Array, ""]
    refinement: Float[Array, ""]

    def description(self) -> tuple[str, ...]:
        form = "map" if self.basis is None else "data"
        return (
            f"{self.prior.size} unknowns of the sky, in K, {form}-space form",
            f"ln evidence {checks.number(self.log_evidence)}, "
            f"{checks.number(self.information_bits(), '.1f')} bits of information",
            "mean, std(), covariance(), sample(key, n), prior_fraction()",
        )

    @property
    def mean(self) -> Float[Array, " unknowns"]:
        """Posterior mean of m in K; harmonic coefficients are Galactic and real packed."""
        return self.prior.colour(self.white_mean)

    def pixel_covariance(self, lon_deg: Degrees, lat_deg: Degrees) -> Float[np.ndarray, "n n"]:
        """Compute the covariance of the sky's temperatures in given directions.

        Parameters
        ----------
        lon_deg, lat_deg : (n,) array
            Galactic longitudes and latitudes.

        Returns
        -------
        (n, n) array
            In K^2.
        """
        root = np.asarray(self.root())
        rows = harmonics.harmonics_at(lon_deg, lat_deg, harmonics.lmax_of(len(root))) @ root
        return rows @ rows.T

    def std(self) -> Float[Array, " unknowns"]:
        """Compute the standard deviation of every unknown.

        Returns
        -------
        (unknowns,) array
            In K.

        Raises
        ------
        InputError
            If rounding in the map-space form makes one of them wrong by more than ``PRECISION``.
        """
        return _checked(*_std(self))

    def covariance(self) -> Float[Array, "unknowns unknowns"]:
        """Compute C as a matrix.

        Returns
        -------
        (unknowns, unknowns) array
            In K^2.

        Raises
        ------
        InputError
            As :meth:`std`.
        """
        return _checked(*_covariance(self))

    def root(self) -> Float[Array, "unknowns white"]:
        """Compute R with C = R R^T: a draw is mean + R z, z ~ N(0, 1).

        Returns
        -------
        (unknowns, white) array
            In K.
        """
        return _times_root(self, namespace(self).eye(self.prior.size)).T

    def whiten(self, skies: Float[Array, "n unknowns"]) -> Float[Array, "n white"]:
        """Compute z = R^-1 (m - mean): standard normals, if the skies are draws of this posterior.

        Parameters
        ----------
        skies : (n, unknowns) array
            One m per row, in K.

        Returns
        -------
        (n, white) array
            One z per row.

        Raises
        ------
        InputError
            If the prior has C_ell = 0: then R has no inverse.
        """
        self.prior.require_density()
        return _whiten(self, namespace(self).asarray(skies))

    def sample(self, key: PRNGKeyArray, n: int | None = None) -> Float[Array, "..."]:
        """Draw from the posterior.

        Parameters
        ----------
        key : PRNGKeyArray
            Random key.
        n : int, optional
            Number of draws.

        Returns
        -------
        (unknowns,) or (n, unknowns) array
            One draw, or ``n`` draws, in K.
        """
        z = jax.random.normal(key, (1 if n is None else n, self.prior.size), dtype=jnp.float64)
        if namespace(self) is np:
            z = np.asarray(z)
        draws = self.mean[None] + _times_root(self, z)
        return draws[0] if n is None else draws

    def prior_fraction(self) -> Float[Array, " unknowns"]:
        """Compute the fraction of each unknown's prior variance that remains: diag(C) / diag(S).

        Returns
        -------
        (unknowns,) array
            1 where the data do not constrain the unknown, 0 where they leave no uncertainty or the
            prior variance is zero.

        Raises
        ------
        InputError
            As :meth:`std`.
        """
        xp, prior = namespace(self), self.prior.variance()
        return xp.where(prior > 0, self.std() ** 2 / xp.where(prior > 0, prior, 1.0), 0.0)

    def prior_chi2(self) -> Float[Array, ""]:
        """Compute the squared distance between the posterior mean and the prior mean.

        Added to chi^2 of the data at the posterior mean, it gives (d - A mu)^T (A S A^T + N)^-1
        (d - A mu), which follows a chi^2 distribution with N_data degrees of freedom.

        Returns
        -------
        () array
            In prior standard deviations, squared.
        """
        u = self.white_mean - self.prior.white_mean
        return namespace(self).asarray(u @ u)

    def rms_shift_from(self, sky: Float[Array, " mode"]) -> Float[Array, ""]:
        """Compute the distance of the mean from a sky.

        Parameters
        ----------
        sky : (modes,) array
            In K.

        Returns
        -------
        () array
            Rms over modes, in standard deviations of this posterior.
        """
        xp = namespace(self)
        return xp.asarray(xp.sqrt((_whiten(self, xp.asarray(sky)[None]) ** 2).mean()))

    def information_bits(self) -> Float[Array, ""]:
        """Compute the information about the sky gained from the data: ln|Lambda| / 2 in bits.

        Returns
        -------
        () array
            In bits.
        """
        xp = namespace(self)
        return xp.asarray(xp.log(xp.diagonal(self.lower)).sum() / np.log(2.0))


def _checked(errors: Float[Array, "..."], rounding: Float[Array, ""]) -> Float[Array, "..."]:
    """Standard deviations or covariance, unless rounding makes them wrong by too much."""
    if not checks.is_traced(rounding) and float(rounding) > PRECISION:
        raise InputError(
            f"rounding would make standard deviations wrong by {rounding:.1g} (accepted: "
            f"{PRECISION:g}): the data are too precise for normal equations; use form=InData"
        )
    return errors


def _rounding(posterior: Posterior, variance: Float[Array, " white"]) -> Float[Array, ""]:
    """Relative error of standard deviations from rounding of Lambda.

    Lambda_jj (Lambda^-1)_jj, the inflation of a mode's variance by all others, is the relevant
    condition number: rescaling modes does not change it. Multiplied by eps, it predicts the
    difference between the two forms to within a factor of 1.5 (fiducial: 1e-6).
    """
    xp = namespace(posterior)
    if posterior.basis is not None:
        return xp.zeros(())
    lower = posterior.lower if xp is np else xp.tril(posterior.lower)  # LAPACK's is triangular
    inflation = xp.einsum("ij,ij->i", lower, lower) * variance
    return xp.asarray(np.finfo(np.float64).eps * inflation.max())


@compiled
def _std(posterior: Posterior) -> tuple[Float[Array, " unknowns"], Float[Array, ""]]:
    """Standard deviations of m, and :func:`_rounding` in those of u."""
    xp = namespace(posterior)
    # the rows of H, where H^T H is the covariance of u
    rows = _white_times_root(posterior, xp.eye(posterior.prior.size))
    rounding = _rounding(posterior, (rows**2).sum(0))
    return xp.sqrt((posterior.prior.colour(rows) ** 2).sum(0)), rounding


@compiled
def _covariance(posterior: Posterior) -> tuple[Float[Array, "unknowns unknowns"], Float[Array, ""]]:
    """C, and :func:`_rounding` in its diagonal."""
    xp, rank = namespace(posterior), posterior.prior.size
    if posterior.basis is None:
        white = linalg.inverse_from_cholesky(posterior.lower)
    else:
        half = linalg.solve_lower(posterior.lower, posterior.basis.T, transpose=False)
        white = half.T @ half + xp.eye(rank) - posterior.basis @ posterior.basis.T
    # colouring overwrites
    rounding = _rounding(posterior, xp.diagonal(white))
    return posterior.prior.colour_covariance(white), rounding


@compiled
def _times_root(posterior: Posterior, z: Float[Array, "n white"]) -> Float[Array, "n unknowns"]:
    """R z = G (L^-T z)."""
    return posterior.prior.colour(_white_times_root(posterior, z))


def _white_times_root(posterior: Posterior, z: Float[Array, "n white"]) -> Float[Array, "n white"]:
    """L^-T z, or with a basis: z outside its span, L^-T Q^T z inside."""
    inside = z if posterior.basis is None else z @ posterior.basis
    drawn = linalg.solve_lower(posterior.lower, inside.T, transpose=True).T
    return drawn if posterior.basis is None else z + (drawn - inside) @ posterior.basis.T


@compiled
def _whiten(posterior: Posterior, skies: Float[Array, "n unknowns"]) -> Float[Array, "n white"]:
    """Inverse of :func:`_times_root`, for skies minus the mean."""
    u = posterior.prior.whiten(skies) - posterior.white_mean[None]
    inside = u if posterior.basis is None else u @ posterior.basis
    white = inside @ namespace(posterior).tril(posterior.lower)
    return white if posterior.basis is None else u + (white - inside) @ posterior.basis.T


def pixel_std(covariance: ModesMatrix, nside: int) -> Pixels:
    """Compute the standard deviation of a map at the centre of every pixel.

    Parameters
    ----------
    covariance : (modes, modes) array
        Of the real harmonic coefficients, in K^2.
    nside : int
        HEALPix resolution.

    Returns
    -------
    (pixels,) array
        In K, in RING order.
    """
    covariance = np.asarray(covariance)
    heights, place, azimuth = _rings(nside, harmonics.lmax_of(covariance.shape[0]))
    between = harmonics.order_products(covariance, heights)
    return np.sqrt(_on_pixels(((azimuth @ between) * azimuth).sum(2), place))


def prior_pixel_std(prior: Prior, nside: int) -> Pixels:
    """Compute :func:`pixel_std` of a prior with a known monopole.

    Parameters
    ----------
    prior : Prior
        Over harmonic coefficients.
    nside : int
        HEALPix resolution.

    Returns
    -------
    (pixels,) array
        In K, in RING order.
    """
    if not prior.independent:
        covariance = np.array(prior.covariance())
        covariance[0] = covariance[:, 0] = 0.0
        return pixel_std(covariance, nside)
    variance = np.array(prior.variance())
    variance[0] = 0.0
    lmax = harmonics.lmax_of(len(variance))
    heights, place, azimuth = _rings(nside, lmax)
    by_order, first = harmonics.modes_by_order(lmax)
    weighted = harmonics.polar_functions(heights, lmax) ** 2 * variance
    of_orders = np.add.reduceat(weighted[:, by_order], first, axis=1)
    return np.sqrt(_on_pixels((azimuth**2 @ of_orders[:, :, None])[:, :, 0], place))


@lru_cache(maxsize=2)
def _rings(nside: int, lmax: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Colatitudes of the rings, and the pixels of each with their azimuthal functions.

    Rings are padded to the longest one, with their last pixel.
    """
    theta, phi = lazy.healpy.pix2ang(nside, np.arange(lazy.healpy.nside2npix(nside)))
    heights, first, count = np.unique(theta, return_index=True, return_counts=True)
    place = np.minimum(np.arange(count.max())[None], count[:, None] - 1) + first[:, None]
    return heights, place, harmonics.azimuth_functions(phi, lmax)[place]


def _on_pixels(values: Float[np.ndarray, "rings longest"], place: np.ndarray) -> Pixels:
    pixels = np.empty(place.max() + 1)
    pixels[place] = values
    return pixels
