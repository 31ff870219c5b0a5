"""Gain drifts: a term of N around found drifts or none, or exact factors (1 + g_i)(1 + g_j)."""

from __future__ import annotations

import threading
from dataclasses import replace
from typing import Annotated

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, PRNGKeyArray
from pydantic import Field

from lusee_bayes.core.arrays import Array, DataVector, Grid
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.lazy import dist, numpyro
from lusee_bayes.core.section import NOT_TINY, Positive, Section, Treatment, requires
from lusee_bayes.instrument.observation import Observation
from lusee_bayes.instrument.products import DataLayout
from lusee_bayes.linear.linear_gaussian import LinearGaussian, Solution
from lusee_bayes.noise import instrument_errors
from lusee_bayes.noise.instrument_errors import GainDrift, Gains, slopes_by_gains, with_gains
from lusee_bayes.systematics import systematic
from lusee_bayes.systematics.context import Around, NoiseAbout, Setup, Volume, noise_visibilities

# how far an unknown correlation time can be off, in standard deviations of its ln, and by which
# factor at least, for programs that set it themselves
CORRELATION_REACH, FACTOR = 3.0, 2.0
# the mean of four antennas' drifts is then above -1 by ten standard deviations
STRONGEST = 0.2
# the sites of the drifts' white noise, and of their two scales
GAIN_NOISE = "gain_noise"
SCALES = ("gain_sigma", "gain_log_correlation")
# white noise of the drifts: three samples per correlation time are exact to exp(-9 pi^2 / 2), and
# beyond six correlation times its weight is exp(-36)
PER_CORRELATION, MARGIN = 3.0, 6.0
# largest number of times of that noise
MOST_POINTS = 1e6
# number folded into the scenario's seed for the scales
SCALE_DRAW = 6
# standard deviation of the ln of a scale
LogStd = Annotated[float, Field(gt=0, le=1)]
# all threads, in which channels and cases are simulated, share NumPyro's handlers
_HANDLERS = threading.Lock()


class GainSection(Section):
    """Gain drifts: their covariance is added to N, or the drifts are ``sampled``.

    Attributes
    ----------
    sigma : float
        Standard deviation of the relative gains.
    correlation_h : float
        Correlation time.
    log_sigma_std : float
        Prior standard deviation of ln sigma, for an unknown sigma. Sigma is then sampled with the
        drifts; simulated data use one drawn from this prior.
    log_correlation_std : float
        The same for ln of the correlation time.
    treatment : {"marginalised", "sampled", "ignored"}
        Add their covariance to N, sample them with the map, or leave them out of the model.
    visibilities : {"model", "measured", "posterior"}, optional
        Visibilities from which the covariance is computed: those of the model sky, correct only for
        simulated data with an exactly known instrument; the data, whose own drifts shift the map by
        about one standard deviation; or, by default, the map's prediction, with the covariance of
        drifts about those that the data determine (iterative).
    """

    sigma: Annotated[float, Field(gt=0, le=STRONGEST), NOT_TINY] = 0.01
    correlation_h: Positive = 10.0
    log_sigma_std: LogStd | None = None
    log_correlation_std: LogStd | None = None
    treatment: Treatment = "marginalised"
    visibilities: NoiseAbout | None = None

    _scales_are_sampled = requires(
        lambda s: s.treatment != "marginalised" or not (s.log_sigma_std or s.log_correlation_std),
        "log_sigma_std and log_correlation_std need treatment 'sampled': a covariance is fixed",
    )


# longest window over which gains are as if constant, in correlation times
STEADY = 0.25


def drift_within(section: GainSection | None, observation: Observation) -> str:
    """A sentence if gains drift within windows, which N does not describe; empty otherwise."""
    if section is None or section.treatment == "ignored" or observation.windows is None:
        return ""
    longest, most_h = observation.step_s / 3600.0, STEADY * section.correlation_h
    if longest <= most_h:
        return ""
    return (
        f"gains drift during a mean over {longest:.3g} h (noise.gain.correlation_h is "
        f"{section.correlation_h:g}), which the model does not include; average over at most "
        f"{most_h:.3g} h"
    )


class GainDrifts(systematic.Systematic):
    """Drifts of every antenna's gain, with known or uncertain strength and correlation time.

    Attributes
    ----------
    drift : GainDrift
        Their standard deviation and correlation time (medians, if uncertain).
    visibilities : (products, times) array
        Visibilities around which the covariance is built, in K.
    hours : (times,) array
        Sample times in hours.
    grid : (grid,) array
        Times in hours of the white noise from which drifts are computed.
    layout : DataLayout
        The data.
    width, widest : int
        Of the covariance's band in samples, for ``drift`` and for the longest correlation time.
    log_sigma_std, log_correlation_std : float, optional
        Prior standard deviations of the natural logarithms of the two; None if known.
    found : (antennas, times) array, optional
        Drifts about which the term of N is linear. None for a term about no drifts, with its
        quadratic part.
    slope : (antennas, times) array, optional
        Slope of ln p by them that is due to the volume of skies and drifts that fit.
    shift : (products, times) array, optional
        F (C_g slope - found): the mean of the data minus the response to the found drifts, in K.
    """

    key, section, draw = "noise.gain", GainSection, 2
    needs_sky, scales_sky, first_order = True, True, False

    drift: GainDrift
    visibilities: Float[Array, "products times"]
    hours: Float[Array, " times"]
    grid: Float[Array, " grid"]
    layout: DataLayout
    # shapes follow from them, so they are structure
    width: int = eqx.field(static=True)
    widest: int = eqx.field(static=True)
    log_sigma_std: float | None = eqx.field(default=None, static=True)
    log_correlation_std: float | None = eqx.field(default=None, static=True)
    found: Gains | None = None
    slope: Gains | None = None
    shift: Grid | None = None

    @classmethod
    def of(
        cls,
        drift: GainDrift,
        visibilities: Float[Array, "products times"],
        hours: Float[np.ndarray, " times"],
        layout: DataLayout,
        log_sigma_std: float | None = None,
        log_correlation_std: float | None = None,
    ) -> GainDrifts:
        """Compute the grid and the bands that these drifts need.

        Parameters
        ----------
        drift : GainDrift
            Standard deviation and correlation time (medians, if uncertain).
        visibilities : (products, times) array
            Visibilities around which the covariance is built, in K.
        hours : (times,) array
            Sample times in hours, increasing.
        layout : DataLayout
            The data.
        log_sigma_std, log_correlation_std : float, optional
            Prior standard deviations of the natural logarithms of the two; None if known.
        """
        middle, log_std = float(drift.correlation_h), log_correlation_std
        factor = 1.0 if log_std is None else float(np.exp(CORRELATION_REACH * log_std))
        longest = GainDrift(drift.sigma, middle * max(factor, FACTOR))
        ends = middle / factor, middle * factor
        if PER_CORRELATION * (hours[-1] - hours[0]) > MOST_POINTS * ends[0]:
            raise InputError(
                f"noise.gain.correlation_h is {ends[0]:.3g} h at least, too short for "
                f"{hours[-1] - hours[0]:.4g} h of data; use noise.radiometer.factor"
            )
        grid = instrument_errors.white_grid(hours, *ends, points=PER_CORRELATION, margin=MARGIN)
        widths, stds = (drift.width(hours), longest.width(hours)), (log_sigma_std, log_std)
        times = jnp.asarray(hours), jnp.asarray(grid)
        return cls(drift, visibilities, *times, layout, *widths, *stds)

    @classmethod
    def build(cls, section: GainSection, setup: Setup, around: Around) -> GainDrifts:
        drift = GainDrift(section.sigma, section.correlation_h)
        visibilities = noise_visibilities(setup, around, gains_about(setup))
        stds = section.log_sigma_std, section.log_correlation_std
        drifts = cls.of(drift, visibilities, setup.observation.hours, setup.layout, *stds)
        if gains_about(setup) != "posterior" or (around.data is not None and around.gains is None):
            return drifts
        found = drifts.about if around.gains is None else around.gains
        off = -found
        if (slope := around.gain_slope) is not None:
            off = off + drifts.drift.correlated(slope, setup.observation.hours)
        drifts = replace(drifts, found=found, slope=slope)
        return replace(drifts, shift=(drifts.slopes * off[:, None]).sum(0))

    @classmethod
    def truth(cls, section: GainSection, setup: Setup, key: PRNGKeyArray) -> systematic.Truth:
        """The scales: if unknown, drawn from the same prior as in programs."""
        with _HANDLERS, numpyro.handlers.seed(rng_seed=jax.random.fold_in(key, SCALE_DRAW)):
            drift = cls.build(section, setup, Around()).scales()
        return {"gain_sigma": float(drift.sigma), "gain_correlation_h": float(drift.correlation_h)}

    @classmethod
    def in_data(cls, section, setup, model, truth, key) -> LinearGaussian:
        """Multiply by one draw of the drifts."""
        drift = GainDrift(truth["gain_sigma"], truth["gain_correlation_h"])
        gains = drift.sample(cls.own_key(key), setup.observation.hours)
        response = cls.build(section, setup, Around()).response(gains)
        return systematic.multiplied(model, np.asarray(response))

    @property
    def n_antennas(self) -> int:
        """Number of antennas."""
        return round(np.sqrt(self.layout.n_products))

    def scales(self) -> GainDrift:
        """Sample the uncertain scales of the drift.

        The sites are ``gain_sigma`` and ``gain_log_correlation``, from which
        ``gain_correlation_h`` is computed.
        """
        sigma, correlation_h = self.drift.sigma, self.drift.correlation_h
        if self.log_sigma_std is not None:
            prior = systematic.Unknown("gain_sigma", sigma, self.log_sigma_std, log=True).prior()
            sigma = numpyro.sample("gain_sigma", prior)
        if self.log_correlation_std is not None:
            reach = CORRELATION_REACH * self.log_correlation_std
            normal = dist.TruncatedNormal(0.0, self.log_correlation_std, low=-reach, high=reach)
            correlation_h = correlation_h * jnp.exp(numpyro.sample("gain_log_correlation", normal))
            correlation_h = numpyro.deterministic("gain_correlation_h", correlation_h)
        return GainDrift(sigma, correlation_h)

    def histories(self, drift: GainDrift) -> Float[Array, "antennas times"]:
        """Sample g_i(t), (antennas, times).

        They are computed from the site ``gain_noise`` (antennas, grid) and recorded as ``gains``.

        Parameters
        ----------
        drift : GainDrift
            Their standard deviation and correlation time.
        """
        normal = dist.Normal(jnp.zeros((self.n_antennas, len(self.grid))), 1.0).to_event(2)
        gains = drift.history(numpyro.sample(GAIN_NOISE, normal), self.hours, self.grid)
        return numpyro.deterministic("gains", gains)

    def response(self, gains: Float[Array, "antennas times"]) -> Float[Array, " data"]:
        """Compute (1 + g_i)(1 + g_j) of every datum."""
        ones = jnp.ones((self.layout.n_products, self.layout.n_times))
        return self.layout.gather(with_gains(ones, gains))

    def chart(self, model: LinearGaussian) -> GainCoordinates | None:
        """Return coordinates in which the degeneracies of sky, gains and scales are straight.

        None for drifts so strong that their mean could be -1, which the coordinates exclude.
        """
        if float(self.drift.sigma) * np.exp(3.0 * (self.log_sigma_std or 0.0)) > STRONGEST:
            return None
        noise = self.layout.scatter(model.noise.diagonal())
        return GainCoordinates(self, noise.sum() / (self.visibilities**2).sum())

    def marginalised(self, model: LinearGaussian, drift: GainDrift | None = None) -> LinearGaussian:
        """Add the drifts' covariance to N, and multiply by the autos' mean response.

        Parameters
        ----------
        model : LinearGaussian
            The model without drifts.
        drift : GainDrift, optional
            With other scales than :attr:`drift`, and at most twice its correlation time.
        """
        width = self.width if drift is None else self.widest
        drift = self.drift if drift is None else drift
        about = self.visibilities, self.hours, self.layout, width, self.found
        return replace(self.averaged(model, drift), noise=model.noise + drift.covariance(*about))

    def averaged(self, model: LinearGaussian, drift: GainDrift | None = None) -> LinearGaussian:
        """Multiply by the mean response; parameters as for :meth:`marginalised`.

        About found drifts g^, multiply by their response and add F (C_g slope - g^).
        """
        drift = drift or self.drift
        if self.found is None:
            mean = drift.mean_response(self.layout.n_products)
            return systematic.multiplied(model, mean[self.layout.product])
        found = systematic.multiplied(model, self.response(self.found))
        return systematic.with_added(found, self.layout.gather(self.shift))

    @property
    def about(self) -> Gains:
        """The drifts about which the term of N is built."""
        if self.found is None:
            return np.zeros((self.n_antennas, self.layout.n_times))
        return self.found

    def inferred(self, solved: DataVector) -> tuple[Gains, float]:
        """Posterior mean of the drifts, and how much more it adds to chi^2 than the solution's.

        Parameters
        ----------
        solved : (data,) array
            N^-1 (d - A m), with the mean map.
        """
        pull, hours = (self.slopes * self.layout.scatter(solved)).sum(1), np.asarray(self.hours)
        whole = pull if self.slope is None else pull + self.slope
        gains = self.drift.correlated(whole, hours)
        less = float((pull * self.drift.correlated(pull, hours)).sum() - (whole * gains).sum())
        return gains, less

    @property
    def slopes(self) -> Float[np.ndarray, "antennas products times"]:
        """F: the derivatives of the visibilities by the gains."""
        return np.asarray(slopes_by_gains(self.visibilities, self.about))

    def volume_slope(self, solution: Solution, volume: Volume) -> Gains:
        """Slope of ln p by the drifts that is due to the volume of skies and drifts that fit.

        Fewer skies fit with larger gains; and with a smaller sky, more drifts do. With s and q the
        sky and the drifts that noise n alone would seem to be, w = N^-1 n, and F(s) for the signal
        of s, the slope is that of skies, and one of the sky that drifts make up for, whose
        amplitude only the drifts' prior limits::

            -E[F_a(s)^T w] + E[q_a F_a^T w] / (1 + g_a)

        Parameters
        ----------
        solution : Solution
            With this term in N.
        volume : Volume
            s = C A^T w, and w = N^-1 n, of draws of n.
        """
        slopes, about, total = self.slopes, self.about, 0.0
        response = with_gains(np.ones_like(slopes[0]), about)

        def pulled(slopes: Float[Array, "antennas products times"], data: DataVector) -> Gains:
            return (slopes * self.layout.scatter(data)).sum(1)

        for sky, weights in zip(*volume[:2], strict=True):
            signal = np.asarray(solution.model.coupling @ sky)
            left = weights - np.asarray(solution.factor.solve(signal))
            drifts = self.drift.correlated(pulled(slopes, left), np.asarray(self.hours))
            by_sky = slopes_by_gains(np.asarray(self.layout.scatter(signal)) / response, about)
            total = total - pulled(by_sky, weights)
            total = total + drifts / (1.0 + about) * pulled(slopes, weights)
        return total / len(volume[0])

    def effect(self, model, values):
        """Multiply by the response to ``gains``."""
        return systematic.multiplied(model, self.response(values["gains"]))

    def sampled(self, model: LinearGaussian) -> LinearGaussian:
        """Sample the sites of :meth:`scales` and :meth:`histories`."""
        return self.effect(model, {"gains": self.histories(self.scales())})


def gains_about(setup: Setup) -> NoiseAbout:
    """Visibilities around which the covariance of gain drifts is built."""
    return setup.scenario.noise.gain.visibilities or "posterior"


class GainCoordinates(systematic.Chart):
    """Coordinates that remove the degeneracy of gains and sky.

    (1 + g_i)(1 + g_j) A m stays the same if all 1 + g grow by exp(k) and m shrinks by its square.
    The data do not constrain k, but tightly constrain the other directions, so that the posterior
    is a thin sheet along k, curved in g and m. With exp(k) - 1 the mean of g, it is straight in the
    coordinates k, exp(-k) (1 + g) and exp(2 k) m. Likewise if the drifts' strength and correlation
    time are sites: the gains at the samples, far better determined than their scales, do not change
    with these, except for parts lost in the noise.

    Attributes
    ----------
    drifts : GainDrifts
        Their white noise is changed, and their uncertain scales.
    floor : () array
        Variance of the noise, in units of the gains.
    """

    drifts: GainDrifts
    floor: Float[Array, ""]

    @property
    def names(self) -> tuple[str, ...]:
        stds = self.drifts.log_sigma_std, self.drifts.log_correlation_std
        sites = [name for name, std in zip(SCALES, stds, strict=True) if std is not None]
        return (systematic.SKY, GAIN_NOISE, *sites)

    @property
    def factorises(self) -> bool:
        return len(self.names) > 2

    def to_values(self, x):
        values, noise = dict(x), x[GAIN_NOISE]
        mean, constant = self._shared()
        scale = (mean * noise).sum()
        noise = jnp.exp(scale) * (noise + (1.0 - scale) * constant) - constant
        values[systematic.SKY] = x[systematic.SKY] * jnp.exp(-2.0 * scale)
        log_det = (noise.size - 2 * x[systematic.SKY].size) * scale
        if self.factorises:
            before, after = self._shapes(x)
            gains, mixed = self._covariances(before, after)
            noise = noise + jnp.linalg.solve(gains, (noise @ (before - after)).T).T @ after.T
            change = jnp.linalg.slogdet(mixed)[1] - jnp.linalg.slogdet(gains)[1]
            log_det = log_det + self.drifts.n_antennas * change
        return values | {GAIN_NOISE: noise}, log_det

    def from_values(self, values):
        x, noise = dict(values), values[GAIN_NOISE]
        if self.factorises:
            before, after = self._shapes(values)
            _, mixed = self._covariances(before, after)
            noise = noise - jnp.linalg.solve(mixed, (noise @ (before - after)).T).T @ after.T
        mean, constant = self._shared()
        scale = jnp.log1p((mean * noise).sum())
        x[GAIN_NOISE] = (noise + constant) * jnp.exp(-scale) - (1.0 - scale) * constant
        x[systematic.SKY] = values[systematic.SKY] * jnp.exp(2.0 * scale)
        return x

    def _shared(self) -> tuple[Float[Array, "1 grid"], Float[Array, "1 grid"]]:
        """Weights of white noise in the mean gain, and white noise whose gains are all one."""
        mean, n_antennas = self._shape(self.drifts.drift).mean(1)[None], self.drifts.n_antennas
        mean = mean / n_antennas
        # white noise constant in time gives constant gains, since the grid is wide enough
        return mean, jnp.ones_like(mean) / (n_antennas * mean.sum())

    def _shape(self, drift: GainDrift) -> Float[Array, "grid times"]:
        """Gains for unit white noise."""
        hours, grid = self.drifts.hours, self.drifts.grid
        return drift.history(jnp.eye(len(grid)), hours, grid)

    def _shapes(self, values) -> tuple[Array, Array]:
        """:meth:`_shape` of the drift, and with the scales at these values."""
        drift = self.drifts.drift
        sigma, correlation_h = drift.sigma, drift.correlation_h
        if SCALES[0] in self.names:
            sigma = jnp.exp(values[SCALES[0]])
        if SCALES[1] in self.names:
            reach = CORRELATION_REACH * self.drifts.log_correlation_std
            within = dist.biject_to(dist.constraints.interval(-reach, reach))
            correlation_h = correlation_h * jnp.exp(within(values[SCALES[1]]))
        return self._shape(drift), self._shape(GainDrift(sigma, correlation_h))

    def _covariances(self, before: Array, after: Array) -> tuple[Array, Array]:
        """Covariances of the gains after, and of those before with those after; plus the floor.

        Both have Gaussian kernels, so that neither is ever singular.
        """
        floor = self.floor * jnp.eye(after.shape[1])
        return after.T @ after + floor, before.T @ after + floor
