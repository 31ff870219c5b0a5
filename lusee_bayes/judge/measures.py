"""Score tests, the sky's strength, and how near a map is to the truth.

Score tests estimate the amplitude a of a term t of the data that the model omits. With the
covariance K = A S A^T + N of data under the model and u = K^-1 (d - E[d]), the data prefer ::

    a = t^T u / F,    F = t^T K^-1 t = t^T N^-1 t - P^T C P,    P = A^T N^-1 t,

with the standard deviation F^(-1/2), where C is the covariance of the sky. Including it would
lower chi^2 of the data by (t^T u)^2 / F. A is not formed.

The strength of the sky relative to its prior is measured by Galactic latitude and by multipole. If
the model is correct, the posterior mean minus the prior mean is drawn from N(0, S - C), the prior
covariance minus the posterior covariance. Its square over that expectation is 1 on average, larger
where the prior is too narrow, and smaller where it is too wide.
"""

from collections.abc import Callable, Mapping

import numpy as np
from jaxtyping import Bool, Float

from lusee_bayes.core import lazy, linalg
from lusee_bayes.core.arrays import Ells, Modes, Pixels, Vector
from lusee_bayes.core.harmonics import lmax_of, mean_over_m, modes_to_map, sum_over_m
from lusee_bayes.instrument.observation import Observation
from lusee_bayes.judge.coverage import latitudes, multipoles
from lusee_bayes.linear.linear_gaussian import Solution
from lusee_bayes.linear.posterior import Posterior

# relative rounding of a difference of two quadratic forms
ROUNDING = 1e-10


def preferences(solution: Solution, templates: Float[np.ndarray, "data n"]) -> dict[str, Vector]:
    """Test templates one by one: the data's preferred amplitude of each, without all others.

    Parameters
    ----------
    solution : Solution
        Of the data and a model without the templates.
    templates : (data, n) array
        t, in K per unit of their amplitudes.

    Returns
    -------
    dict of (n,) arrays
        ``value`` and ``std`` of the amplitude in these units, NaN where the data do not constrain
        it, and ``chi2_gain``, by which chi^2 of the data would decrease.

    Raises
    ------
    InputError
        If N is not positive definite.
    """
    model, pull = solution.model, templates.T @ solution.weighted_residual()
    solved = np.asarray(solution.factor.solve(templates))
    # rows of P^T
    seen = np.asarray(model.coupling.transpose_mv(solved)).T
    precision = (templates * solved).sum(0) - ((seen @ solution.covariance) * seen).sum(1)
    # if the sky can absorb a template completely, only rounding remains
    determined = precision > ROUNDING * (templates * solved).sum(0)
    inverse = np.divide(1.0, precision, out=np.full(len(precision), np.nan), where=determined)
    return {"value": pull * inverse, "std": np.sqrt(inverse), "chi2_gain": pull**2 * inverse}


def strengths(deviation: Modes, of_modes: Modes, of_pixels: Pixels) -> dict[str, float]:
    """Compute the square of a sky's deviation over its expectation, part by part.

    The monopole, which priors barely constrain, is excluded.

    Parameters
    ----------
    deviation : (modes,) array
        Posterior mean minus prior mean, in K.
    of_modes, of_pixels : (modes,), (pixels,) array
        The diagonal of S - C, of the modes and of the pixels without the monopole, in K^2.

    Returns
    -------
    dict of str to float
        By name of the part; parts that the data do not constrain are omitted.
    """
    rest = np.where(np.arange(len(deviation)) > 0, deviation, 0.0)
    nside = lazy.healpy.npix2nside(len(of_pixels))
    seen, (*bands, _) = modes_to_map(rest, nside), latitudes(nside).items()
    _, *ells = multipoles(lmax_of(len(deviation))).items()
    parts = [(*band, seen, of_pixels) for band in bands] + [(*ell, rest, of_modes) for ell in ells]
    return {
        name: float((values[inside] ** 2).sum() / expected[inside].sum())
        for name, inside, values, expected in parts
        if expected[inside].sum() > 0
    }


def strengths_in_words(ratios: Mapping[str, float]) -> str:
    """A sentence that lists the ratios; empty if there are none."""
    if not ratios:
        return ""
    listed = ", ".join(f"{value:.2g} at {name}" for name, value in ratios.items())
    return f"Sky power relative to the prior: {listed}."


def correlation(mean: Modes, truth: Modes) -> Ells:
    """Compute rho_ell = sum_m a a_true / sqrt(sum_m a^2 sum_m a_true^2), as in the paper.

    Parameters
    ----------
    mean, truth : (modes,) arrays
        Real packed coefficients of the two maps, in K.

    Returns
    -------
    (ells,) array
        rho_ell; NaN where either map has no power.
    """
    return _ratio(sum_over_m(mean * truth), np.sqrt(sum_over_m(mean**2) * sum_over_m(truth**2)))


def signal_to_noise(mean: Modes, truth: Modes) -> Ells:
    """Compute SNR_ell = sqrt( sum_m a^2 / sum_m (a - a_true)^2 ), as in the paper.

    Parameters
    ----------
    mean, truth : (modes,) arrays
        Real packed coefficients of the two maps, in K.

    Returns
    -------
    (ells,) array
        SNR_ell; NaN where the maps are equal.
    """
    return np.sqrt(_ratio(sum_over_m(mean**2), sum_over_m((mean - truth) ** 2)))


def _ratio(top: np.ndarray, bottom: np.ndarray) -> np.ndarray:
    """NaN where ``bottom`` is not positive."""
    return np.divide(top, bottom, out=np.full_like(top, np.nan), where=bottom > 0)


def ell_cross(snr: Ells) -> int | None:
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


def prior_fraction_per_ell(posterior: Posterior) -> Ells:
    """Average over m the fraction of the prior variance that remains.

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


def effective_resolution_deg(prior_fraction: Ells) -> float | None:
    """Compute 180 degrees over the first ell >= 1 that keeps more than half its prior variance.

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


def expected_chi2(posterior: Posterior, n_data: int, variance: Modes | None = None) -> float:
    """Compute the expectation of ``|L^-1 (d - A mean - offset)|^2``, N = L L^T, under the model.

    Parameters
    ----------
    posterior : Posterior
        Of the data.
    n_data : int
        Number of data.
    variance : (unknowns,) array, optional
        Of the posterior, if it has been computed: with a prior of independent unknowns, no inverse
        is needed then.

    Returns
    -------
    float
        N_data - rank + tr Lambda^-1.
    """
    prior = posterior.prior
    if variance is not None and prior.independent and posterior.basis is None:
        power = np.asarray(prior.variance())
        return float(n_data - (1.0 - variance[power > 0] / power[power > 0]).sum())
    inverse = linalg.invert_lower(np.asarray(posterior.lower))
    return n_data - len(inverse) + float(np.vdot(inverse, inverse))


def highest_altitude(
    observation: Observation,
    nside: int,
    seen: Bool[np.ndarray, " times"] | slice = np.s_[:],
    terrain: Callable[[np.ndarray], np.ndarray] | None = None,
) -> Pixels:
    """Compute the highest altitude that each pixel of the sky reached.

    Parameters
    ----------
    observation : Observation
        Place and times.
    nside : int
        HEALPix resolution.
    seen : (times,) array, optional
        Whether a time has data; by default all have.
    terrain : callable, optional
        Altitude of the horizon at azimuths from North towards East, in radians; by default zero.

    Returns
    -------
    (pixels,) array
        Sine of the altitude above the horizon, of Galactic pixels in RING order. Negative where the
        sky never rose: there the map comes from the prior alone.
    """
    directions = np.array(lazy.healpy.pix2vec(nside, np.arange(lazy.healpy.nside2npix(nside))))
    turns = observation.topocentric_from_mcmf() @ observation.mcmf_from_galactic[seen]
    highest = np.full(directions.shape[1], -1.0)
    for chunk in np.array_split(turns, max(1, len(turns) // 64)):
        up = chunk[:, 2] @ directions
        if terrain is not None:
            above = terrain(np.arctan2(chunk[:, 0] @ directions, chunk[:, 1] @ directions))
            up = np.sin(np.arcsin(np.clip(up, -1.0, 1.0)) - above)
        np.maximum(highest, up.max(axis=0), out=highest)
    return highest
