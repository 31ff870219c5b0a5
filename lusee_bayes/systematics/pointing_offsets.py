"""Clock and pointing that are not known: templates of first order, or A as it is with offsets.

About the values z_0 of the offsets (in prior standard deviations) and a sky m_0, the data are ::

    d = A(z) m + n = A(z_0) m + T (z - z_0) + n,    T = dA/dz m_0,    z ~ N(0, 1),

to first order in z - z_0 and in their product with m - m_0: N gets T T^T and the mean -T z_0. Where
z_0 and m_0 are those that the data tell, this is the Gaussian about the joint mode of sky and
offsets (Gauss and Newton), with the term that couples z - z_0 and m - m_0 left out.
"""

from __future__ import annotations

from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Float

from lusee_bayes.core.arrays import Array
from lusee_bayes.core.lazy import dist, numpyro
from lusee_bayes.instrument.coupling import CouplingMatrix
from lusee_bayes.instrument.pointing_offsets import turned_by_offsets
from lusee_bayes.linear.model import LinearGaussian
from lusee_bayes.noise.covariance import LowRankCovariance
from lusee_bayes.systematics.base import with_added
from lusee_bayes.systematics.templated import Expanded


class PointingOffsets(Expanded):
    """Offsets of clock and pointing with independent Gaussian priors about zero.

    Attributes
    ----------
    names : tuple of str
        Of the offsets (:mod:`.instrument.pointing_offsets`).
    stds : (offsets,) array
        Prior standard deviations, in the units that the names end with.
    templates : (data, offsets) array
        T: what one prior standard deviation of each does to the data, in K.
    centre : (offsets,) array
        z_0, in prior standard deviations.
    coupling : CouplingMatrix
        A(z_0).
    nominal : CouplingMatrix
        A(0).
    modes : (products, modes) array
        The beams in the frame of the lander.
    hours : (times,) array
        Since the first sample.
    sources : (data, offsets) array
        The part of the templates that is the point sources', in K.
    moves : bool
        Whether z_0 and m_0 are those that the data tell, found in rounds.
    response : (data,) array or None
        Gains that the templates are seen through in N; None for ones.
    """

    names: tuple[str, ...] = eqx.field(static=True)
    stds: Float[Array, " offsets"]
    templates: Float[Array, "data offsets"]
    centre: Float[Array, " offsets"]
    coupling: CouplingMatrix
    nominal: CouplingMatrix
    modes: Float[Array, "products modes"]
    hours: Float[Array, " times"]
    sources: Float[Array, "data offsets"]
    moves: bool = eqx.field(static=True, default=True)
    response: Float[Array, " data"] | None = None

    def marginalised(self, model: LinearGaussian) -> LinearGaussian:
        """Take A(z_0), add T T^T to N and -T z_0 to the mean."""
        noise = model.noise + LowRankCovariance(self.columns, "clock and pointing")
        return with_added(
            replace(model, coupling=self.coupling, noise=noise), -self.templates @ self.centre
        )

    def sampled(self, model: LinearGaussian) -> LinearGaussian:
        """Sample one site for each offset, of its name; sources move to first order about z_0."""
        values = {
            name: numpyro.sample(name, dist.Normal(0.0, std))
            for name, std in zip(self.names, self.stds, strict=True)
        }
        pointing = turned_by_offsets(self.nominal.pointing, self.hours, values)
        coupling = CouplingMatrix.of_modes(self.modes, pointing, self.nominal.layout)
        z = jnp.stack([jnp.asarray(value) for value in values.values()]) / self.stds
        return with_added(replace(model, coupling=coupling), self.sources @ (z - self.centre))
