"""How good a map is: fidelity against a known truth, and what the posterior says by itself."""

from __future__ import annotations

import equinox as eqx
import healpy
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lusee_bayes.checks import AnyArray
from lusee_bayes.covariance.base import solve_lower
from lusee_bayes.harmonics import lmax_of, sum_over_m
from lusee_bayes.linear_gaussian import LinearGaussian
from lusee_bayes.observation import Observation
from lusee_bayes.posterior import Posterior


def correlation(
    mean: Float[AnyArray, " modes"], truth: Float[AnyArray, " modes"]
) -> Float[np.ndarray, " ells"]:
    """rho_ell = sum_m a a_true / sqrt(sum_m a^2 sum_m a_true^2); the paper's eq. for rho_ell.

    NaN at an ell where either map has no power at all.
    """
    mean, truth = np.asarray(mean), np.asarray(truth)
    power = np.sqrt(sum_over_m(mean**2) * sum_over_m(truth**2))
    return _ratio(sum_over_m(mean * truth), power)


def signal_to_noise(
    mean: Float[AnyArray, " modes"], truth: Float[AnyArray, " modes"]
) -> Float[np.ndarray, " ells"]:
    """SNR_ell = sqrt( sum_m a^2 / sum_m (a - a_true)^2 ); the paper's eq. for SNR_ell."""
    mean, truth = np.asarray(mean), np.asarray(truth)
    return np.sqrt(_ratio(sum_over_m(mean**2), sum_over_m((mean - truth) ** 2)))


def _ratio(top: np.ndarray, bottom: np.ndarray) -> np.ndarray:
    return np.divide(top, bottom, out=np.full_like(top, np.nan), where=bottom > 0)


def ell_cross(snr: Float[np.ndarray, " ells"]) -> int | None:
    """The first ell >= 1 with SNR_ell < 1; None if there is none."""
    below = np.flatnonzero(np.asarray(snr)[1:] < 1.0)
    return int(below[0]) + 1 if below.size else None


def prior_fraction_per_ell(posterior: Posterior) -> Float[np.ndarray, " ells"]:
    """Mean over m of the share of each mode's variance that the prior supplies."""
    fraction = np.asarray(posterior.prior_fraction())
    return sum_over_m(fraction) / (2.0 * np.arange(lmax_of(fraction.size) + 1) + 1.0)


def effective_resolution_deg(prior_fraction: Float[np.ndarray, " ells"]) -> float | None:
    """180 degrees over the first ell >= 1 of which the prior supplies more than half.

    Needs no truth. None if the data dominate up to lmax.
    """
    beyond = np.flatnonzero(np.asarray(prior_fraction)[1:] > 0.5)
    return 180.0 / (int(beyond[0]) + 1) if beyond.size else None


@eqx.filter_jit
def whitened_residuals(
    model: LinearGaussian, posterior: Posterior, data: Float[Array, " data"]
) -> Float[Array, " data"]:
    """L^-1 (d - A mean), in standard deviations of the noise."""
    residual = data - model.coupling @ posterior.mean
    return model.noise.factor().whiten(
        residual if model.offset is None else residual - model.offset
    )


def expected_chi2(posterior: Posterior, n_data: int) -> float:
    """Mean of |whitened residual|^2 if the model holds: N_data - rank + tr Lambda^-1."""
    inverse = solve_lower(posterior.lower, jnp.eye(posterior.lower.shape[0]), transpose=False)
    return float(n_data - posterior.lower.shape[0] + (inverse**2).sum())


def highest_altitude(observation: Observation, nside: int) -> Float[np.ndarray, " pixels"]:
    """sin of the highest altitude that each Galactic HEALPix pixel ever reached.

    Negative where the sky was never above the horizon: there the map is prior alone.
    """
    directions = np.array(healpy.pix2vec(nside, np.arange(healpy.nside2npix(nside))))
    zeniths = observation.zenith_galactic()
    highest = np.full(directions.shape[1], -1.0)
    for chunk in np.array_split(zeniths, max(1, len(zeniths) // 256)):
        np.maximum(highest, (chunk @ directions).max(axis=0), out=highest)
    return highest
