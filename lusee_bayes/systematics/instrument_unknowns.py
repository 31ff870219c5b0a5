"""Unknowns of the instrument: its beams, its pointing, the level of its noise.

**Clock and pointing** are templates of first order, or A as it is with offsets. About the values
z_0 of the offsets (in prior standard deviations) and a sky m_0, the data are ::

    d = A(z) m + n = A(z_0) m + T (z - z_0) + n,    T = dA/dz m_0,    z ~ N(0, 1),

to first order in z - z_0 and in their product with m - m_0: N gets T T^T and the mean -T z_0. Where
z_0 and m_0 are those that the data tell, this is the Gaussian about the joint mode of sky and
offsets (Gauss and Newton), with the term that couples z - z_0 and m - m_0 left out.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Float

from lusee_bayes.core.arrays import Array, scalar
from lusee_bayes.core.lazy import dist, numpyro
from lusee_bayes.instrument.beams.fields import ProductBeams
from lusee_bayes.instrument.beams.monopoles import parameter
from lusee_bayes.instrument.coupling import Coupling, CouplingMatrix
from lusee_bayes.instrument.instrument import Instrument
from lusee_bayes.instrument.pointing import turned_by_offsets
from lusee_bayes.linear.linear_gaussian import LinearGaussian
from lusee_bayes.noise.covariance import LowRankCovariance
from lusee_bayes.noise.instrument_errors import beam_error_noise, derivative
from lusee_bayes.systematics.systematic import (
    Expanded,
    Scale,
    Systematic,
    normal_within,
    uncertain_scale,
    with_added,
)


class InstrumentParameters(Systematic):
    """Parameters of the antennas that are not known; their priors are Gaussian.

    Attributes
    ----------
    instrument : Instrument
        The instrument with its present parameters. :meth:`sampled` needs it prepared.
    means, stds : dict of float
        Of the priors, by the parameters' names and in their units.
    """

    instrument: Instrument
    # numbers, not arrays: equinox's jit then keeps them known, and the checks of the priors and
    # the ends of their domains need their values
    means: dict[str, float]
    stds: dict[str, float]

    @classmethod
    def centred(cls, instrument: Instrument, stds: Mapping[str, float]) -> InstrumentParameters:
        """Put the priors' means at the instrument's present values.

        Parameters
        ----------
        instrument : Instrument
            The instrument.
        stds : mapping of float
            Prior standard deviations by the parameters' names, in their units.

        Raises
        ------
        InputError
            For unknown names, and for a prior that reaches out of a parameter's domain.
        """
        means = {name: float(instrument.value(name)) for name in stds}
        made = cls(instrument, means, {name: float(std) for name, std in stds.items()})
        made.priors()
        return made

    def priors(self) -> dict[str, dist.Distribution]:
        """Return the prior of every parameter by its name, cut off at the ends of its domain."""
        priors = {}
        for name, std in self.stds.items():
            domain = parameter(name)
            priors[name] = normal_within(name, self.means[name], std, domain.low, domain.high)
        return priors

    def marginalised(self, model: LinearGaussian) -> LinearGaussian:
        """Add dA S dA^T for every parameter to N, dA = std times the derivative of A."""
        noise = model.noise
        for direction in parameter_directions(self.instrument, self.stds):
            noise = noise + beam_error_noise(self.instrument.coupling_of(direction), model.prior)
        return replace(model, noise=noise)

    def sampled(self, model: LinearGaussian) -> LinearGaussian:
        """Sample one site for each parameter, of its name."""
        values = {name: numpyro.sample(name, prior) for name, prior in self.priors().items()}
        return replace(model, coupling=self.instrument.dense(values))


def parameter_directions(instrument: Instrument, stds: Mapping[str, float]) -> list[ProductBeams]:
    """What one prior standard deviation of each parameter does to the beams, to first order."""
    known = instrument.frequency_mhz, instrument.lmax, instrument.monopoles
    slopes = {name: derivative(name, *known).modes for name in stds}
    return [ProductBeams(std * slopes[name], known[0]) for name, std in stds.items()]


class BeamError(Systematic):
    """Beams that are off along one direction dA by an unknown amplitude, N(0, 1).

    Attributes
    ----------
    direction : Coupling
        dA for an amplitude of one, such as the difference to another beam.
    """

    direction: Coupling

    def marginalised(self, model: LinearGaussian) -> LinearGaussian:
        """Add dA S dA^T to N."""
        return replace(model, noise=model.noise + beam_error_noise(self.direction, model.prior))

    def sampled(self, model: LinearGaussian) -> LinearGaussian:
        """Sample the site ``beam_amplitude``: A + amplitude dA."""
        amplitude = numpyro.sample("beam_amplitude", dist.Normal(jnp.zeros(()), 1.0))
        return replace(model, coupling=model.coupling.plus(amplitude, self.direction))


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


class NoiseLevel(Scale):
    """A factor of the variance of all noise that the model holds so far.

    There is no Gaussian term for it: marginalised, the level stays at one.

    Attributes
    ----------
    log_std : () array
        Prior standard deviation of the natural logarithm of the factor, whose median is one.
    """

    log_std: Float[Array, ""] = eqx.field(converter=scalar)

    def sampled(self, model: LinearGaussian) -> LinearGaussian:
        """Sample the site ``noise_level``, a ratio of variances."""
        level = numpyro.sample("noise_level", uncertain_scale(1.0, self.log_std))
        return replace(model, noise=model.noise.scaled(level))
