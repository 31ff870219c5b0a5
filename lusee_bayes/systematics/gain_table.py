"""Errors of a gain table: exact factors of the visibilities, or templates of first order.

With eps_i(t) = sum_e z_e s_e(t) over the errors e of port i, z ~ N(0, 1), the relative error of
port i's power gain, the data are ::

    d = F(z) v + n,    F_ij = sqrt((1 + eps_i)(1 + eps_j)),    v = A m + all that adds to it,

and about z_0 and v_0, to first order, ::

    d = F(z_0) v + T (z - z_0) + n,    T = dF/dz v_0.

With errors of 1 % what this leaves out, 1e-4, is ten times the radiometer noise, unless z_0 and
v_0 are those that the data tell: then it is the Gaussian about the joint mode of all unknowns.

That mode is not where the bulk is: a larger gain and a smaller sky fit as well, and of n modes that
the data determine, each gains by being smaller. With the sky integrated out, ln|K| makes up for it,
K(z) = F (A S A^T + ...) F + N_0, whose derivative is ::

    d(-ln|K| / 2)/dz_e = -sum_k h_k dln F_k/dz_e,    h = diag(1 - N_0 K^-1),

h_k the share of datum k that the model follows (:mod:`.linear.freedom`). It is that of a prior mean
of -dln F/dz^T h in place of 0, with which rounds lead to the mode of p(z | d).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from lusee_bayes.core.arrays import Array, namespace
from lusee_bayes.core.lazy import dist, numpyro
from lusee_bayes.instrument.products import DataLayout, ports
from lusee_bayes.linear.linear_gaussian import LinearGaussian
from lusee_bayes.noise.covariance import LowRankCovariance
from lusee_bayes.systematics.systematic import Expanded, Systematic, multiplied, with_added

# the site of the errors, in prior standard deviations
GAIN_TABLE = "gain_table"


class TableErrors(eqx.Module):
    """Slopes of the errors, and what values of them make of the data.

    Attributes
    ----------
    names : tuple of str
        Of the errors.
    port : tuple of int
        The port of each.
    slope : (errors, times) array
        Relative change of the port's power gain per prior standard deviation.
    layout : DataLayout
        The data.
    """

    names: tuple[str, ...] = eqx.field(static=True)
    port: tuple[int, ...] = eqx.field(static=True)
    slope: Float[Array, "errors times"]
    layout: DataLayout

    def factors(self, z: Float[Array, " errors"]) -> Float[Array, " data"]:
        """Compute F of every datum, of values in prior standard deviations."""
        first, second, gains = self._gains(z)
        return self.layout.gather(namespace(gains).sqrt(gains[first] * gains[second]))

    def slopes(self, z: Float[np.ndarray, " errors"]) -> Float[np.ndarray, "data errors"]:
        """Compute dF/dz of every datum."""
        first, second, gains = self._gains(z)
        own = self._own.astype(np.float64)
        share = own[first][:, None] / gains[first][..., None]
        share = share + own[second][:, None] / gains[second][..., None]
        log_slope = share * np.asarray(self.slope).T[None] / 2.0
        factors = np.sqrt(gains[first] * gains[second])
        return np.asarray(self.layout.gather(factors[..., None] * log_slope))

    @property
    def stds(self) -> Float[np.ndarray, " errors"]:
        """Prior standard deviations of the power gains, relative: rms over the times of each."""
        slope = np.asarray(self.slope)
        return np.sqrt((slope**2).sum(1) / (slope != 0).sum(1))

    @property
    def _own(self) -> np.ndarray:
        """Whether an error is a port's: (ports, errors)."""
        n_ports = round(np.sqrt(self.layout.n_products))
        return np.arange(n_ports)[:, None] == np.array(self.port)[None]

    def _gains(self, z: Float[Array, " errors"]) -> tuple[np.ndarray, np.ndarray, Array]:
        """The two ports of every product, and the power gains (ports, times)."""
        own = self._own.astype(np.float64)
        first, second, _ = ports(len(own))
        return first, second, 1.0 + own @ (z[:, None] * self.slope)


class GainTable(Expanded):
    """Errors of the gain table with independent Gaussian priors, in prior standard deviations.

    Attributes
    ----------
    errors : TableErrors
    centre : (errors,) array
        z_0, in prior standard deviations.
    seen : (data,) array
        v_0: the visibilities before these gains, in K.
    freedom : (data,) array or None
        h: the share of each datum that sky and others follow; None for zeros.
    moves : bool
        Whether z_0 and v_0 are those that the data tell, found in rounds.
    """

    changes_coupling: ClassVar[bool] = False

    errors: TableErrors
    centre: Float[Array, " errors"]
    seen: Float[Array, " data"]
    freedom: Float[Array, " data"] | None = None
    moves: bool = eqx.field(static=True, default=True)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the errors."""
        return self.errors.names

    @property
    def stds(self) -> Float[np.ndarray, " errors"]:
        """Prior standard deviations of the power gains, relative."""
        return self.errors.stds

    @property
    def common(self) -> Float[np.ndarray, " errors"]:
        """Unit vector of errors along the mean power gain of all ports and times."""
        along = np.asarray(self.errors.slope).mean(1)
        return along / max(float(np.linalg.norm(along)), np.finfo(np.float64).tiny)

    @property
    def templates(self) -> Float[np.ndarray, "data errors"]:
        """T, in K."""
        return self.errors.slopes(np.asarray(self.centre)) * np.asarray(self.seen)[:, None]

    @property
    def expected(self) -> Float[np.ndarray, " errors"]:
        """What makes up for the volume of skies that fit: -dln F/dz^T h."""
        if self.freedom is None:
            return np.zeros(len(self.names))
        centre = np.asarray(self.centre)
        log_slopes = self.errors.slopes(centre) / np.asarray(self.errors.factors(centre))[:, None]
        return -log_slopes.T @ np.asarray(self.freedom)

    @property
    def response(self) -> None:
        """T has the gains in it."""
        return

    def behind(self, response: Float[Array, " data"]) -> Systematic:
        return self

    def marginalised(self, model: LinearGaussian) -> LinearGaussian:
        """Multiply by F(z_0), add T T^T to N and T (expected - z_0) to the mean."""
        columns = self.templates
        model = multiplied(model, self.errors.factors(self.centre))
        noise = model.noise + LowRankCovariance(columns, "the gain table")
        return with_added(
            replace(model, noise=noise), columns @ (self.expected - np.asarray(self.centre))
        )

    def sampled(self, model: LinearGaussian) -> LinearGaussian:
        """Sample the site ``gain_table`` (errors,), in prior standard deviations."""
        normal = dist.Normal(jnp.zeros(len(self.names)), 1.0).to_event(1)
        return multiplied(model, self.errors.factors(numpyro.sample(GAIN_TABLE, normal)))

    def true(self, truth: Mapping[str, float | np.ndarray]) -> dict[str, float]:
        return self.in_units(np.asarray(truth[GAIN_TABLE]))
