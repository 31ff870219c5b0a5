"""chi^2 of data and maps: tests at one rate of false alarms, and what no sky explains.

If a model holds, chi^2 of n degrees of freedom has ::

    p = 2 min(P(chi^2_n > chi^2), P(chi^2_n < chi^2)),

uniform from 0 to 1: too large a chi^2 counts as much as too small a one. The best of k such
probabilities is judged by k p, which is below any bound at most that often, however they depend on
one another (Bonferroni). A report makes all of its tests at one rate, so that a report of data that
fit says otherwise at most once in 1 / ``FALSE_ALARM``.

Maps are judged by their fidelity to a known truth, and by measures that need none.

chi^2 of all data under the model, (d - A mu)^T (A S A^T + N)^-1 (d - A mu), mixes up instrument and
prior. Give the sky a prior k times as wide, and ::

    q = (d - A mu)^T (k^2 A S A^T + N)^-1 (d - A mu)

is left: noise alone, since the wide prior explains any sky. In units of the prior, with Lambda =
1 + W the precision of the whitened sky and W = sum_i lambda_i e_i e_i^T, noise enters q along e_i
with the weight 1 / (1 + k^2 lambda_i), and sky of variance v with v lambda_i / (1 + k^2 lambda_i),
so that ::

    E q = N_data - (1 - v / k^2) (p - tr Lambda_k^-1),    Lambda_k = 1 + k^2 W  (p x p).

With k^2 = 100 v the sky hardly matters. v is 1, or, where the sky is stronger than its prior, what
it is found to be. The rest, chi^2 - q, tests the prior. Weights lie between 0 and 1: both parts
scatter like a chi^2 with their means as degrees of freedom, or less.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from lusee_bayes.core.arrays import Ells, Modes, Pixels, Square, on_host
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.harmonics import mean_over_m, sum_over_m
from lusee_bayes.core.lazy import healpy, special
from lusee_bayes.core.linalg import cholesky, invert_lower, solve_lower, times_lower
from lusee_bayes.instrument.observation import Observation
from lusee_bayes.linear.posterior import Posterior

Level = Literal["consistent", "unlike the prior", "does not fit"]
LEVELS: tuple[Level, ...] = ("consistent", "unlike the prior", "does not fit")
# of a report of data that fit: a mission makes some hundred of them
FALSE_ALARM = 1e-3
RULE = (
    f"A test stands out if its p times the number of tests is below {FALSE_ALARM:g}: by chance "
    f"once in {1.0 / FALSE_ALARM:.0f} reports"
)


@dataclass(frozen=True)
class ChiSquare:
    """A chi^2 with its degrees of freedom, which need not be whole.

    Attributes
    ----------
    chi2, degrees : float
    """

    chi2: float
    degrees: float

    @property
    def p(self) -> float:
        """Probability of a chi^2 as far out on its side, if the model holds."""
        return two_sided(self.chi2, self.degrees)

    @property
    def too_small(self) -> bool:
        """Whether it is below what is expected, where it stands out."""
        return bool(self.chi2 < self.degrees)

    def words(self) -> str:
        """p, and chi^2 with what is expected of it."""
        return f"p {probability(self.p)}, {self.found()}"

    def found(self) -> str:
        """chi^2 with what is expected of it."""
        expected = f"{self.degrees:.0f} +- {np.sqrt(2.0 * self.degrees):.0f}"
        return f"chi^2 {self.chi2:.0f}, expected {expected}"


@dataclass(frozen=True)
class Fit:
    """A verdict.

    Attributes
    ----------
    level : {"consistent", "unlike the prior", "does not fit"}
    text : str
        The verdict in sentences: what stands out, and what to do.
    """

    level: Level
    text: str


def two_sided(chi2: float, n: float | int) -> float:
    """Compute how probable it is that chi^2 of n degrees of freedom is as far out on its side.

    Parameters
    ----------
    chi2 : float
    n : float
        Degrees of freedom.

    Returns
    -------
    float
        From 0 to 1, uniform if the model holds.
    """
    # both tails are one half at the median, up to rounding
    return float(min(1.0, 2.0 * min(special.chdtr(n, chi2), special.chdtrc(n, chi2))))


def stands_out(p: float, among: int) -> bool:
    """Whether a probability, one of ``among`` of a report, is too small for chance."""
    return among * p < FALSE_ALARM


def worst(levels: Sequence[Level]) -> Level:
    """The worst of several levels."""
    return max(levels, key=LEVELS.index)


def probability(p: float) -> str:
    """Format a probability.

    Parameters
    ----------
    p : float
        The probability.

    Returns
    -------
    str
        Such as "= 0.62", or "< 1e-300" where it is too small for a float.
    """
    return f"= {p:.2g}" if p > 0 else "< 1e-300"


def correlation(mean: Modes, truth: Modes) -> Ells:
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


def signal_to_noise(mean: Modes, truth: Modes) -> Ells:
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


def effective_resolution_deg(prior_fraction: Ells) -> float | None:
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


def highest_altitude(observation: Observation, nside: int) -> Pixels:
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


# k over the sky's own size, in units of the prior
WIDER = 10.0


@dataclass(frozen=True)
class Split:
    """chi^2 of data in its two parts.

    Attributes
    ----------
    instrument : ChiSquare
        What no sky explains: tests A and N.
    prior : ChiSquare
        The rest: tests the prior, if A and N are right.
    wide : Posterior
        Given the same data under the wide prior.
    """

    instrument: ChiSquare
    prior: ChiSquare
    wide: Posterior

    @classmethod
    def of(cls, posterior: Posterior, chi2: float, n_data: int) -> Split:
        """Split chi^2 of the data behind a posterior.

        Parameters
        ----------
        posterior : Posterior
            In any form.
        chi2 : float
            Of the data under the model, sky included.
        n_data : int

        Raises
        ------
        InputError
            As :func:`widened`.
        """
        posterior = on_host(posterior)
        known = n_data - expected_chi2(posterior, n_data)
        size = max(1.0, np.sqrt(float(posterior.prior_chi2()) / known)) if known > 0 else 1.0
        try:
            wide, less = widened(posterior, WIDER * size)
        except InputError:
            # data that do not fit ask for a sky that is stronger by orders of magnitude, under
            # which numbers of 64 bits do not tell noise from sky; they stand out under this, too
            wide, less = widened(posterior, WIDER)
        degrees = n_data - with_sky(n_data - expected_chi2(wide, n_data))
        instrument = ChiSquare(chi2 - less, float(degrees))
        return cls(instrument, ChiSquare(less, float(n_data - degrees)), wide)


def with_sky(directions: float) -> float:
    """Degrees of freedom that measured directions of the sky take: a little is left of each."""
    return (1.0 - 1.0 / WIDER**2) * directions


def widened(posterior: Posterior, factor: float) -> tuple[Posterior, float]:
    """Compute the posterior given the same data under a prior with wider standard deviations.

    Parameters
    ----------
    posterior : Posterior
        With NumPy's arrays.
    factor : float
        By which the prior's standard deviations are multiplied, about the same mean.

    Returns
    -------
    Posterior
        Under the wider prior.
    float
        By how much chi^2 of the data under the model is smaller than before.

    Raises
    ------
    InputError
        If Lambda_k cannot be factorised.
    """
    prior, lower = posterior.prior, np.tril(posterior.lower)
    off = posterior.white_mean - (0.0 if prior.white_mean is None else prior.white_mean)
    # with a basis, outside of its span the posterior is the prior
    inside = off if posterior.basis is None else posterior.basis.T @ off
    precision = factor**2 * times_lower(lower, lower, transpose=True)
    precision[np.diag_indices(len(precision))] -= factor**2 - 1.0
    root = cholesky(precision, overwrite=True)
    if not np.isfinite(np.diagonal(root)).all():
        raise InputError(
            "the data are too precise for the normal equations to tell noise from sky; use fewer "
            "data at once"
        )
    half = solve_lower(root, inside[:, None], transpose=False)
    step = (factor**2 - 1.0) * solve_lower(root, half, transpose=True)[:, 0]
    less = (1.0 - factor**-2) * float(inside @ (inside + step))
    moved = step if posterior.basis is None else posterior.basis @ step
    log_evidence = posterior.log_evidence + 0.5 * less + _log_diagonal(lower) - _log_diagonal(root)
    wide = Posterior(
        prior.widened(factor),
        (posterior.white_mean + moved) / factor,
        root,
        posterior.basis,
        np.asarray(log_evidence),
        posterior.refinement,
    )
    return wide, less


def _log_diagonal(lower: Square) -> float:
    return float(np.log(np.diagonal(lower)).sum())
