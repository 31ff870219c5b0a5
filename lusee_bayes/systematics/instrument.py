"""The antennas and the ground under them: parameters of the embedded beam that are not known."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpyro
from jaxtyping import Array, Float
from numpyro import distributions as dist

from lusee_bayes.beams import (
    Monopoles,
    ProductBeams,
    monopole_beams,
    parameter,
    placed,
)
from lusee_bayes.checks import InputError
from lusee_bayes.coupling import CouplingMatrix
from lusee_bayes.layout import DataLayout
from lusee_bayes.linear_gaussian import LinearGaussian
from lusee_bayes.noise import beam_error_noise, derivative
from lusee_bayes.pointing import Pointing
from lusee_bayes.systematics.base import Systematic, normal_within
from lusee_bayes.turns import Turns


class Instrument(eqx.Module):
    """Everything that A is made of, for antennas whose parameters are yet to be chosen.

    nodes : of the grid on which beams are worked out (``monopole_beams``); turns : the
    orientations, prepared for A to be made of many beams (:meth:`prepared`)
    """

    monopoles: Monopoles
    pointing: Pointing
    layout: DataLayout
    frequency_mhz: float = eqx.field(static=True)
    lmax: int = eqx.field(static=True)
    nodes: tuple[int, int] | None = eqx.field(static=True, default=None)
    turns: Turns | None = None

    def prepared(self) -> Instrument:
        """The same with its orientations worked out, for :meth:`dense`."""
        return replace(self, turns=Turns.of(self.pointing, self.layout))

    def value(self, name: str) -> Float[Array, ""]:
        """The present value of a parameter; InputError naming the nearest for unknown ones."""
        return parameter(name).where(self.monopoles)

    def beams(self, values: Mapping[str, Float[Array, ""]] | None = None) -> ProductBeams:
        """The beams with these values of parameters (see ``beams.PARAMETERS``)."""
        antennas = placed(self.monopoles, values or {})
        return monopole_beams(self.frequency_mhz, self.lmax, antennas, nodes=self.nodes)

    def coupling(self, values: Mapping[str, Float[Array, ""]] | None = None) -> CouplingMatrix:
        """A with these values of parameters; differentiable in them."""
        return self.coupling_of(self.beams(values))

    def dense(self, values: Mapping[str, Float[Array, ""]]) -> Float[Array, "data modes"]:
        """A as a matrix with these values of parameters, of a :meth:`prepared` instrument."""
        if self.turns is None:
            raise InputError("prepare the instrument first: instrument = instrument.prepared()")
        return self.turns.coupling(self.beams(values))

    def coupling_of(self, beams: ProductBeams) -> CouplingMatrix:
        """A, or dA, of given beams."""
        return CouplingMatrix.build(beams, self.pointing, self.layout)


class InstrumentParameters(Systematic):
    """Parameters of the antennas that are not known; their priors are Gaussian.

    means, stds : of the priors, by name, in the parameters' units
    """

    instrument: Instrument
    means: dict[str, float] = eqx.field(static=True)
    stds: dict[str, float] = eqx.field(static=True)

    @classmethod
    def about(cls, instrument: Instrument, stds: Mapping[str, float]) -> InstrumentParameters:
        """Priors about the instrument's present values.

        InputError for unknown names, and for a prior that reaches out of a parameter's domain.
        """
        means = {name: float(instrument.value(name)) for name in stds}
        made = cls(instrument, means, dict(stds))
        made.priors()
        return made

    def priors(self) -> dict[str, dist.Distribution]:
        """The prior of every parameter, cut off at the ends of its domain."""
        priors = {}
        for name, std in self.stds.items():
            domain = parameter(name)
            priors[name] = normal_within(name, self.means[name], std, domain.low, domain.high)
        return priors

    def marginalised(self, model: LinearGaussian) -> LinearGaussian:
        """N with dA S dA^T for every parameter, dA = std times the derivative of A."""
        noise, it = model.noise, self.instrument
        for name, std in self.stds.items():
            slope = derivative(name, it.frequency_mhz, it.lmax, it.monopoles)
            direction = ProductBeams(std * slope.modes, it.frequency_mhz)
            noise = noise + beam_error_noise(it.coupling_of(direction), model.prior)
        return replace(model, noise=noise)

    def sampled(self, model: LinearGaussian) -> LinearGaussian:
        """One site for each parameter, of its name; the instrument has to be prepared."""
        values = {name: numpyro.sample(name, prior) for name, prior in self.priors().items()}
        return replace(model, coupling=self.instrument.dense(values))


class BeamError(Systematic):
    """Beams that are off along one direction dA by an unknown amplitude, N(0, 1).

    direction : dA for an amplitude of one, such as the difference to another beam
    """

    direction: CouplingMatrix

    def marginalised(self, model: LinearGaussian) -> LinearGaussian:
        """N with dA S dA^T."""
        return replace(model, noise=model.noise + beam_error_noise(self.direction, model.prior))

    def sampled(self, model: LinearGaussian) -> LinearGaussian:
        """The site ``beam_amplitude``: A + amplitude dA."""
        amplitude = numpyro.sample("beam_amplitude", dist.Normal(jnp.zeros(()), 1.0))
        return replace(model, coupling=model.coupling.plus(amplitude, self.direction))
