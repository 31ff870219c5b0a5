"""The antennas and the ground under them: parameters of the embedded beam that are not known."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import jax.numpy as jnp

from lusee_bayes.core.lazy import dist, numpyro
from lusee_bayes.instrument.beams import ProductBeams, parameter
from lusee_bayes.instrument.coupling import Coupling
from lusee_bayes.instrument.instrument import Instrument
from lusee_bayes.linear.model import LinearGaussian
from lusee_bayes.noise import beam_error_noise, derivative
from lusee_bayes.systematics.base import Systematic, normal_within


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
        noise, instrument = model.noise, self.instrument
        for name, std in self.stds.items():
            slope = derivative(
                name, instrument.frequency_mhz, instrument.lmax, instrument.monopoles
            )
            direction = ProductBeams(std * slope.modes, instrument.frequency_mhz)
            noise = noise + beam_error_noise(instrument.coupling_of(direction), model.prior)
        return replace(model, noise=noise)

    def sampled(self, model: LinearGaussian) -> LinearGaussian:
        """Sample one site for each parameter, of its name."""
        values = {name: numpyro.sample(name, prior) for name, prior in self.priors().items()}
        return replace(model, coupling=self.instrument.dense(values))


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
