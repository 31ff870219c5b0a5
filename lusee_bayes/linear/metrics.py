"""Quality of a map: its fidelity to a known truth, and measures that need no truth."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from lusee_bayes.core.arrays import Array
from lusee_bayes.core.harmonics import mean_over_m, sum_over_m
from lusee_bayes.core.lazy import healpy
from lusee_bayes.core.linalg import invert_lower
from lusee_bayes.instrument.observation import Observation
from lusee_bayes.linear.posterior import Posterior


def correlation(
    mean: Float[Array, " modes"], truth: Float[Array, " modes"]
) -> Float[np.ndarray, " ells"]:
    """Compute rho_ell = sum_m a a_true / sqrt(sum_m a^2 sum_m a_true^2), as the paper does.

    Parameters
    ----------
    mean, truth : (modes,) arrays
        Real packed coefficients of the two maps, in K.

    Returns
    -------
    (ells,) array
        rho_ell; NaN where either map has no power.
    """
    mean, truth = np.asarray(mean), np.asarray(truth)
    power = np.sqrt(sum_over_m(mean**2) * sum_over_m(truth**2))
    return _ratio(sum_over_m(mean * truth), power)


def signal_to_noise(
    mean: Float[Array, " modes"], truth: Float[Array, " modes"]
) -> Float[np.ndarray, " ells"]:
    """Compute SNR_ell = sqrt( sum_m a^2 / sum_m (a - a_true)^2 ), as the paper does.

    Parameters
    ----------
    mean, truth : (modes,) arrays
        Real packed coefficients of the two maps, in K.

    Returns
    -------
    (ells,) array
        SNR_ell; NaN where the maps are equal.
    """
    mean, truth = np.asarray(mean), np.asarray(truth)
    return np.sqrt(_ratio(sum_over_m(mean**2), sum_over_m((mean - truth) ** 2)))


def _ratio(top: np.ndarray, bottom: np.ndarray) -> np.ndarray:
    """NaN where ``bottom`` is not positive."""
    return np.divide(top, bottom, out=np.full_like(top, np.nan), where=bottom > 0)


def ell_cross(snr: Float[np.ndarray, " ells"]) -> int | None:
    """Find the first ell >= 1 with SNR_ell < 1.

    Parameters
    ----------
    snr : (ells,) array
        From :func:`signal_to_noise`.

    Returns
    -------
    int or None
        The ell; None if there is none.
    """
    below = np.flatnonzero(np.asarray(snr)[1:] < 1.0)
    return int(below[0]) + 1 if below.size else None


def prior_fraction_per_ell(posterior: Posterior) -> Float[np.ndarray, " ells"]:
    """Average the share of the prior variance that is left over m.

    Parameters
    ----------
    posterior : Posterior
        Over harmonic coefficients.

    Returns
    -------
    (ells,) array
        Mean over m of :meth:`Posterior.prior_fraction`.

    Raises
    ------
    InputError
        As :meth:`Posterior.std`.
    """
    return mean_over_m(posterior.prior_fraction())


def effective_resolution_deg(prior_fraction: Float[np.ndarray, " ells"]) -> float | None:
    """Compute 180 degrees over the first ell >= 1 with more than half of the prior variance left.

    Parameters
    ----------
    prior_fraction : (ells,) array
        From :func:`prior_fraction_per_ell`.

    Returns
    -------
    float or None
        In degrees; None if the data dominate up to lmax.
    """
    beyond = np.flatnonzero(np.asarray(prior_fraction)[1:] > 0.5)
    return 180.0 / (int(beyond[0]) + 1) if beyond.size else None


def expected_chi2(posterior: Posterior, n_data: int) -> float:
    """Compute the expectation of ``|L^-1 (d - A mean - offset)|^2``, N = L L^T, if the model holds.

    Parameters
    ----------
    posterior : Posterior
        Of the data.
    n_data : int
        Number of data.

    Returns
    -------
    float
        N_data - rank + tr Lambda^-1.
    """
    inverse = invert_lower(np.asarray(posterior.lower))
    return float(n_data - len(inverse) + (inverse**2).sum())


def highest_altitude(observation: Observation, nside: int) -> Float[np.ndarray, " pixels"]:
    """Compute the highest altitude that every pixel of the sky reached.

    Parameters
    ----------
    observation : Observation
        Place and times.
    nside : int
        HEALPix resolution.

    Returns
    -------
    (pixels,) array
        Sine of the altitude, of Galactic pixels in RING order. Negative where the sky was never
        above the horizon: there the map is prior alone.
    """
    directions = np.array(healpy.pix2vec(nside, np.arange(healpy.nside2npix(nside))))
    zeniths = observation.zenith_galactic()
    highest = np.full(directions.shape[1], -1.0)
    for chunk in np.array_split(zeniths, max(1, len(zeniths) // 256)):
        np.maximum(highest, (chunk @ directions).max(axis=0), out=highest)
    return highest
