"""Gain drifts: their covariance in N, or the drifts themselves, (1 + g_i)(1 + g_j) exactly."""

from __future__ import annotations

from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import numpyro
from jaxtyping import Array, Float
from numpyro import distributions as dist

from lusee_bayes.coupling import CouplingMatrix
from lusee_bayes.layout import DataLayout
from lusee_bayes.linear_gaussian import LinearGaussian
from lusee_bayes.noise import GainDrift, white_grid, with_gains
from lusee_bayes.systematics.base import Systematic, uncertain_scale

# how far, in standard deviations of ln, a correlation time that is not known can be off, and by
# which factor where a program of its own says how it is not known
CORRELATION_REACH, FACTOR = 3.0, 2.0
# the sites of the two
SCALES = ("gain_sigma", "gain_log_correlation")
# white noise that makes drifts: three times per correlation time are exact to exp(-9 pi^2 / 2),
# and beyond six correlation times it enters with exp(-36)
PER_CORRELATION, MARGIN = 3.0, 6.0


class GainDrifts(Systematic):
    """Drifts of every antenna's gain, of known or of uncertain strength and correlation time.

    drift : their standard deviation and correlation time (medians, where uncertain)
    around : (products, times) visibilities that the covariance is built around, in K
    hours : (times,) of the samples; grid : times of the white noise that drifts are made of
    width, widest : of the covariance's band in samples, for ``drift`` and for the longest
    log_sigma_std, log_correlation_std : prior standard deviations of ln of the two; None: known
    """

    drift: GainDrift
    around: Float[Array, "products times"]
    hours: tuple[float, ...] = eqx.field(static=True)
    grid: Float[Array, " grid"]
    layout: DataLayout
    width: int = eqx.field(static=True)
    widest: int = eqx.field(static=True)
    log_sigma_std: float | None = eqx.field(static=True, default=None)
    log_correlation_std: float | None = eqx.field(static=True, default=None)

    @classmethod
    def of(
        cls,
        drift: GainDrift,
        around: Float[Array, "products times"],
        hours: Float[np.ndarray, " times"],
        layout: DataLayout,
        log_sigma_std: float | None = None,
        log_correlation_std: float | None = None,
    ) -> GainDrifts:
        """With the grid and the bands that these drifts need."""
        middle, factor = float(drift.correlation_h), 1.0
        if log_correlation_std is not None:
            factor = float(np.exp(CORRELATION_REACH * log_correlation_std))
        longest = GainDrift(drift.sigma, middle * max(factor, FACTOR))
        grid = white_grid(
            hours,
            middle / factor,
            middle * factor,
            per_correlation=PER_CORRELATION,
            margin=MARGIN,
        )
        return cls(
            drift,
            around,
            tuple(float(t) for t in hours),
            jnp.asarray(grid),
            layout,
            drift.width(hours),
            longest.width(hours),
            log_sigma_std,
            log_correlation_std,
        )

    @property
    def needs_sky(self) -> bool:
        return True

    @property
    def n_antennas(self) -> int:
        """Number of antennas."""
        return round(np.sqrt(self.layout.n_products))

    def scales(self) -> GainDrift:
        """The drift with its uncertain scales drawn.

        Sites ``gain_sigma``, and ``gain_log_correlation``, of which ``gain_correlation_h`` is made.
        """
        sigma, correlation_h = self.drift.sigma, self.drift.correlation_h
        if self.log_sigma_std is not None:
            sigma = numpyro.sample("gain_sigma", uncertain_scale(sigma, self.log_sigma_std))
        if self.log_correlation_std is not None:
            reach = CORRELATION_REACH * self.log_correlation_std
            normal = dist.TruncatedNormal(0.0, self.log_correlation_std, low=-reach, high=reach)
            correlation_h = correlation_h * jnp.exp(numpyro.sample("gain_log_correlation", normal))
            correlation_h = numpyro.deterministic("gain_correlation_h", correlation_h)
        return GainDrift(sigma, correlation_h)

    def histories(self, drift: GainDrift) -> Float[Array, "antennas times"]:
        """g_i(t), made of the site ``gain_noise`` (antennas, grid); kept as ``gains``."""
        normal = dist.Normal(jnp.zeros((self.n_antennas, len(self.grid))), 1.0).to_event(2)
        gains = drift.history(
            numpyro.sample("gain_noise", normal), np.asarray(self.hours), self.grid
        )
        return numpyro.deterministic("gains", gains)

    def response(self, gains: Float[Array, "antennas times"]) -> Float[Array, " data"]:
        """(1 + g_i)(1 + g_j) of every datum."""
        ones = jnp.ones((self.layout.n_products, self.layout.n_times))
        return self.layout.gather(with_gains(ones, gains))

    def marginalised(self, model: LinearGaussian, drift: GainDrift | None = None) -> LinearGaussian:
        """N with the drifts' covariance, and the autos' mean response.

        ``drift``: of other scales, with a correlation time at most twice as long.
        """
        width = self.width if drift is None else self.widest
        drift = self.drift if drift is None else drift
        noise = drift.covariance(self.around, np.asarray(self.hours), self.layout, width)
        mean = drift.mean_response(self.layout.n_products)[:, None]
        grid = jnp.broadcast_to(mean, (self.layout.n_products, self.layout.n_times))
        return _multiplied(replace(model, noise=model.noise + noise), self.layout.gather(grid))

    def sampled(self, model: LinearGaussian) -> LinearGaussian:
        """The sites of :meth:`scales` and :meth:`histories`."""
        return _multiplied(model, self.response(self.histories(self.scales())))


def _multiplied(model: LinearGaussian, response: Float[Array, " data"]) -> LinearGaussian:
    offset = None if model.offset is None else model.offset * response
    if isinstance(model.coupling, CouplingMatrix):
        return replace(model, coupling=model.coupling.with_response(response), offset=offset)
    return replace(model, coupling=model.coupling * response[:, None], offset=offset)
