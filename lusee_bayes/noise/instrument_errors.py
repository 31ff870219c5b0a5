"""Errors of gains and beams as terms of N.

**Gain drifts** are Gaussian processes g_i(t), one per antenna, that multiply the visibilities, ::

    V_ij -> (1 + g_i)(1 + g_j) V_ij,    <g_i(t) g_j(t')> = delta_ij C_g(t, t'),
    C_g = sigma_g^2 exp(-(t - t')^2 / (2 sigma_t^2))

Marginalised over g, the error is a noise term with (paper, appendix A) ::

    Cov(e_ij(t), e_kl(t')) = d_ij(t) d_kl(t') C_g [ (dik + dil + djk + djl)
                                                    + C_g (dik djl + dil djk) ]

and with the mean sigma_g^2 d_ii in the autos. The quadratic part is not negligible: at sigma_g =
0.01 it is 1e-4 of the signal, ten times the radiometer noise. Nor is it Gaussian, or independent of
the linear part. About gains g^ that are found from the data, ::

    V_ij -> (1 + g^_i)(1 + g^_j) V_ij + sum_a F_ija (g_a - g^_a),
    F_ija = [dia (1 + g^_j) + dja (1 + g^_i)] V_ij,    Cov = sum_a F_ija(t) F_kla(t') C_g

there is none: what is left of it, (g - g^)^2, is far below the noise.

**Errors of the beams** in A: N_beam = dA (S + mu mu^T) dA^T along known directions dA. If the true
coupling matrix is A + dA, the data contain dA m besides A m; over skies from the prior, that is
noise of covariance dA S dA^T (paper, section on beam precision). Directions: the difference to
another beam (a frequency shift, another file), or the derivative with respect to a parameter of the
embedded beam times its standard deviation.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from lusee_bayes.core import checks
from lusee_bayes.core.arrays import Array, Grid, scalar
from lusee_bayes.core.errors import InputError
from lusee_bayes.instrument.beams.fields import ProductBeams
from lusee_bayes.instrument.coupling import Coupling
from lusee_bayes.instrument.products import DataLayout, ports
from lusee_bayes.noise.covariance import LowRankCovariance
from lusee_bayes.noise.time_blocks import TimeBandedCovariance
from lusee_bayes.sky.prior import Prior

Gains = Float[Array, "antennas times"]
Hours = Float[Array, " times"]


# C_g is dropped below double precision relative to sigma_g^2: exp(-x^2 / 2) = eps
REACH = float(np.sqrt(-2.0 * np.log(np.finfo(np.float64).eps)))


class GainDrift(eqx.Module):
    """Gain drifts, independent between antennas and of equal statistics.

    Differentiable in both parameters if the width of the band is given.

    Attributes
    ----------
    sigma : float
        Standard deviation sigma_g, relative.
    correlation_h : float
        Correlation time sigma_t in hours.

    Raises
    ------
    InputError
        If one of them is not positive.
    """

    sigma: Float[Array, ""] = eqx.field(converter=scalar)
    correlation_h: Float[Array, ""] = eqx.field(default=10.0, converter=scalar)

    def __check_init__(self):
        checks.require_shape("the gain drift's sigma", self.sigma, ())
        checks.require_positive("the gain drift's sigma", self.sigma)
        checks.require_positive("the gain drift's correlation time in hours", self.correlation_h)

    def kernel(self, lag_h: Float[Array, "..."]) -> Float[Array, "..."]:
        """Return C_g at lags in hours."""
        return self.sigma**2 * jnp.exp(-((lag_h / self.correlation_h) ** 2) / 2.0)

    def width(self, hours: Hours) -> int:
        """Return the largest distance in samples between times that are correlated."""
        first = np.searchsorted(hours, np.asarray(hours) - REACH * float(self.correlation_h))
        return int((np.arange(len(hours)) - first).max())

    def covariance(
        self,
        visibilities: Grid,
        hours: Hours,
        layout: DataLayout,
        width: int | None = None,
        gains: Gains | None = None,
    ) -> TimeBandedCovariance:
        """Return the noise term of the drifts around given visibilities d.

        It is semidefinite: add the radiometer noise before solving with it.

        Parameters
        ----------
        visibilities : (products, times) array
            d_k(t) on the full grid, in K.
        hours : (times,) array
            Increasing times of the samples.
        layout : DataLayout
        width : int, optional
            Width of the band in samples, by default the reach of C_g.
        gains : (antennas, times) array, optional
            Drifts about which the term is linear; by default it is about none, with its quadratic
            part.

        Returns
        -------
        TimeBandedCovariance
            In K^2.

        Raises
        ------
        InputError
            If shapes do not match, visibilities are not finite or times do not increase.
        """
        checks.require_array("the visibilities", visibilities, (layout.n_products, layout.n_times))
        checks.require_shape("hours", hours, (layout.n_times,))
        if not checks.is_traced(hours) and not (np.diff(hours) > 0).all():
            raise InputError("the sample times (hours) must increase")
        width = self.width(hours) if width is None else width
        earlier = np.arange(layout.n_times)[:, None] - np.arange(width + 1)[None]
        lag = jnp.asarray(hours)[:, None] - jnp.asarray(hours)[np.maximum(earlier, 0)]
        kernel = jnp.where(jnp.asarray(earlier >= 0), self.kernel(lag), 0.0)
        n = round(np.sqrt(layout.n_products))
        about = np.zeros((n, layout.n_times)) if gains is None else gains
        slopes = slopes_by_gains(visibilities, about)
        i, j, _ = ports(n)
        # number of ways in which two products share two antennas
        ii, ij, ji, jj = (np.equal.outer(a, b).astype(np.float64) for a in (i, j) for b in (i, j))
        quadratic = None if gains is not None else jnp.asarray(ii * jj + ij * ji)
        band = _band(jnp.asarray(slopes), visibilities, kernel, jnp.asarray(earlier), quadratic)
        return TimeBandedCovariance(band, layout, "the gain-drift covariance")

    def correlated(self, x: Gains, hours: Hours) -> Gains:
        """Return C_g x of every antenna, (antennas, times)."""
        total = float(self.sigma) ** 2 * x
        for lag in range(1, self.width(hours) + 1):
            kernel = np.asarray(self.kernel(hours[lag:] - hours[:-lag]))
            total[:, lag:] += kernel * x[:, :-lag]
            total[:, :-lag] += kernel * x[:, lag:]
        return total

    def mean_response(self, n_products: int) -> Float[Array, " products"]:
        """Return the mean factor of each product: 1 + sigma_g^2 for autos, 1 for crosses."""
        i, j, _ = ports(round(np.sqrt(n_products)))
        return 1.0 + self.sigma**2 * jnp.asarray(i == j, dtype=jnp.float64)

    def sample(self, key: PRNGKeyArray, hours: Hours, n_antennas: int = 4) -> Gains:
        """Draw g_i(t), (antennas, times), with exactly this covariance."""
        grid = white_grid(hours, *[float(self.correlation_h)] * 2)
        white = jax.random.normal(key, (n_antennas, len(grid)), dtype=jnp.float64)
        return self.history(white, hours, grid)

    def history(
        self, white: Float[Array, "antennas grid"], hours: Hours, grid: Float[Array, " grid"]
    ) -> Gains:
        """Return the gains from white noise on an even grid of times.

        The noise is convolved with a Gaussian of width sigma_t / sqrt(2); a sum over a spacing of
        sigma_t / 3 or less equals the integral to exp(-9 pi^2 / 2). Differentiable in everything.

        Parameters
        ----------
        white : (antennas, grid) array
            Independent unit normals.
        hours : (times,) array
        grid : (grid,) array
            Even times in hours, as from :func:`white_grid`.

        Returns
        -------
        (antennas, times) array
            g_i(t).
        """
        spacing = (grid[1] - grid[0]) / self.correlation_h
        lag = jnp.asarray(hours)[None] - jnp.asarray(grid)[:, None]
        shape = jnp.sqrt(spacing * np.sqrt(2.0 / np.pi))
        return self.sigma * shape * white @ jnp.exp(-((lag / self.correlation_h) ** 2))


def white_grid(
    hours: Hours, shortest_h: float, longest_h: float, *, points: float = 4.0, margin: float = REACH
) -> Float[np.ndarray, " grid"]:
    """Return a grid of times for :meth:`GainDrift.history`.

    Parameters
    ----------
    hours : (times,) array
        Times of the samples.
    shortest_h, longest_h : float
        Range of correlation times in hours that the grid serves.
    points : float
        Number of grid times in the shortest correlation time.
    margin : float
        Reach of the grid beyond the samples, in longest correlation times.

    Returns
    -------
    (grid,) array
        In hours.
    """
    hours = np.asarray(hours)
    first, end = hours.min() - margin * longest_h, hours.max() + margin * longest_h
    return np.arange(first, end, shortest_h / points)


def with_gains(visibilities: Grid, gains: Gains) -> Grid:
    """Return (1 + g_i)(1 + g_j) V_ij, exactly, for every product."""
    i, j, _ = ports(gains.shape[0])
    return (1.0 + gains[i]) * (1.0 + gains[j]) * visibilities


def slopes_by_gains(visibilities: Grid, gains: Gains) -> Float[Array, "antennas products times"]:
    """Return F_ija, the derivatives of :func:`with_gains` by the gain of every antenna."""
    i, j, _ = ports(gains.shape[0])
    antenna = np.arange(gains.shape[0])[:, None]
    first, second = (np.equal(antenna, k).astype(np.float64)[..., None] for k in (i, j))
    return (first * (1.0 + gains[j])[None] + second * (1.0 + gains[i])[None]) * visibilities[None]


@eqx.filter_jit
def _band(
    slopes: Array, visibilities: Array, kernel: Array, earlier: Array, quadratic: Array | None
) -> Float[Array, "times widths products products"]:
    earlier = jnp.maximum(earlier, 0)

    def products(row: Array) -> Array:  # (products, times), at both times
        return row.T[:, None, :, None] * row.T[earlier][:, :, None, :]

    weight, band = kernel[:, :, None, None], sum(products(row) for row in slopes)
    if quadratic is not None:
        band = band + products(visibilities) * weight * quadratic[None, None]
    return band * weight


def beam_error_noise(direction: Coupling, prior: Prior) -> LowRankCovariance:
    """Return the covariance dA (S + mu mu^T) dA^T of a beam error, mu being the prior's mean.

    Parameters
    ----------
    direction : Coupling
        dA: the coupling matrix of a difference of beams.
    prior : Prior
        S and mu.

    Returns
    -------
    LowRankCovariance
        In K^2.
    """
    columns = prior.colour_columns(direction.dense())
    if prior.mean is not None:
        columns = jnp.concatenate([columns, (columns @ prior.white_mean)[:, None]], axis=1)
    return LowRankCovariance(columns, "the beam-error covariance")


def difference(true: ProductBeams, model: ProductBeams) -> ProductBeams:
    """Return the difference true - model of two beams, the direction of a beam error.

    Raises
    ------
    InputError
        If their shapes differ.
    """
    checks.require_shape("the other beam's coefficients", true.modes, model.modes.shape)
    return ProductBeams(true.modes - model.modes, model.frequency_mhz)


def rms_difference(true: ProductBeams, model: ProductBeams) -> float:
    """Return the RMS difference of two beams, relative to the RMS of ``model``.

    Computed over products and directions, by Parseval's theorem from the coefficients up to lmax.
    """
    return float(jnp.sqrt((difference(true, model).modes ** 2).sum() / (model.modes**2).sum()))
