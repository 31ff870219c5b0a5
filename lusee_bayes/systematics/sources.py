"""Point sources of known place and unknown flux: columns of A with a prior of their own."""

from __future__ import annotations

from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import numpyro
from jaxtyping import Array, Float
from numpyro import distributions as dist

from lusee_bayes.checks import require_finite, require_positive, require_shape
from lusee_bayes.coupling import CouplingMatrix
from lusee_bayes.covariance import LowRankCovariance
from lusee_bayes.linear_gaussian import LinearGaussian
from lusee_bayes.prior import IndependentPrior
from lusee_bayes.systematics.base import Systematic


class Source(eqx.Module):
    """One source: what it does to the data, and the prior of its flux, in K sr.

    columns : (data, blocks) response to 1 K sr in each block of time; mean, std : of the prior
    """

    columns: Float[Array, "data blocks"]
    mean: float = eqx.field(static=True)
    std: float = eqx.field(static=True)
    name: str = eqx.field(static=True)

    def __check_init__(self):
        require_finite(f"the response to {self.name}", self.columns)
        require_shape(f"the response to {self.name}", self.columns, (None, None))
        require_positive(f"the prior standard deviation of {self.name}'s flux", self.std)

    @property
    def n_blocks(self) -> int:
        """Number of amplitudes."""
        return self.columns.shape[1]

    @property
    def site(self) -> str:
        """Name of its site: ``flux_Cas_A``."""
        return f"flux_{self.name.replace(' ', '_')}"

    def seen(self) -> np.ndarray:
        """(blocks,) whether it is ever above the horizon: if not, its flux is known from the
        prior only."""
        return np.asarray(jnp.abs(self.columns).max(0) > 0)


class PointSources(Systematic):
    """Sources with independent Gaussian priors of their fluxes; the map is then the sky without
    them."""

    sources: tuple[Source, ...]

    @property
    def changes_coupling(self) -> bool:
        return False

    def columns(self) -> Float[Array, "data amplitudes"]:
        """Responses of all sources and blocks side by side, in K per K sr."""
        return jnp.concatenate([source.columns for source in self.sources], axis=1)

    def mean(self) -> Float[Array, " amplitudes"]:
        """Prior means in K sr."""
        return jnp.concatenate([jnp.full(s.n_blocks, s.mean) for s in self.sources])

    def std(self) -> Float[Array, " amplitudes"]:
        """Prior standard deviations in K sr."""
        return jnp.concatenate([jnp.full(s.n_blocks, s.std) for s in self.sources])

    def marginalised(self, model: LinearGaussian) -> LinearGaussian:
        """N with T P T^T, and the mean fluxes in the offset."""
        columns = self.columns()
        noise = model.noise + LowRankCovariance(columns * self.std()[None], "the sources")
        return _brighter(replace(model, noise=noise), columns @ self.mean())

    def sampled(self, model: LinearGaussian) -> LinearGaussian:
        """One site for each source, ``flux_NAME`` in K sr, (blocks,) or a number."""
        seen = jnp.zeros(model.n_data)
        for source in self.sources:
            prior = dist.Normal(jnp.full(source.n_blocks, source.mean), source.std)
            if source.n_blocks == 1:
                flux = numpyro.sample(source.site, dist.Normal(source.mean, source.std))
                seen = seen + source.columns[:, 0] * flux
            else:
                seen = seen + source.columns @ numpyro.sample(source.site, prior.to_event(1))
        return _brighter(model, seen)

    def joint(self, model: LinearGaussian) -> LinearGaussian:
        """Sky and fluxes as one vector of unknowns: d = [A, T] (m, f - mean) + ... .

        ``condition`` gives the posterior of both; the last unknowns are the fluxes minus their
        prior means, in K sr.
        """
        columns, dense = self.columns(), model.coupling
        if isinstance(model.coupling, CouplingMatrix):
            dense = model.coupling.dense()
            if model.coupling.response is not None:
                columns = columns * model.coupling.response[:, None]
        prior = IndependentPrior(jnp.concatenate([model.prior.diagonal_root(), self.std()]))
        both = replace(model, coupling=jnp.concatenate([dense, columns], axis=1), prior=prior)
        return _brighter(both, columns @ self.mean())


def _brighter(model: LinearGaussian, seen: Float[Array, " data"]) -> LinearGaussian:
    return replace(model, offset=seen if model.offset is None else model.offset + seen)
