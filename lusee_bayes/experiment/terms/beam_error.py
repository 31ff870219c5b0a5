"""Beams that differ from the model's in the data: shifted, from another file, or other antennas."""

from __future__ import annotations

from dataclasses import dataclass

import jax
from jaxtyping import Float, PRNGKeyArray

from lusee_bayes.core.arrays import Array
from lusee_bayes.experiment.schema import section_of_file
from lusee_bayes.experiment.setup import Setup
from lusee_bayes.experiment.terms.term import Around, Term, Truth
from lusee_bayes.instrument.beams import BeamSource, EmbeddedBeams, ProductBeams, placed
from lusee_bayes.noise import derivative, difference, rms_difference
from lusee_bayes.systematics import BeamError, InstrumentParameters, Systematic

# what the scenario's seed is folded with
DRAW = 3


class BeamErrorTerm(Term):
    """``noise.beam``; simulated data are taken with the true beams (:func:`true_instrument`)."""

    key = "noise.beam"

    def build(self, setup: Setup, around: Around) -> list[tuple[str, Systematic]]:
        beam = setup.scenario.noise.beam
        if beam is None or beam.treatment == "ignored":
            return []
        if beam.treatment == "sampled" and beam.parameters:
            return [("sampled", InstrumentParameters.centred(setup.prepared, beam.parameters))]
        return [
            (beam.treatment, BeamError(setup.instrument.coupling_of(direction)))
            for direction in beam_directions(setup)
        ]

    def truth(self, setup: Setup, key: PRNGKeyArray) -> Truth:
        beam = setup.scenario.noise.beam
        if beam is None:
            return {}
        if not beam.parameters:
            return {"beam_amplitude": 1.0}
        priors = InstrumentParameters.centred(setup.instrument, beam.parameters).priors()
        keys = jax.random.split(jax.random.fold_in(key, DRAW), len(priors))
        return {
            name: float(prior.sample(k))
            for (name, prior), k in zip(priors.items(), keys, strict=True)
        }


@dataclass(frozen=True)
class TrueInstrument:
    """What simulated data are taken with: beams of a source at a frequency."""

    source: BeamSource
    frequency_mhz: float

    def beams(self, lmax: int) -> ProductBeams:
        """Beams of all products."""
        return self.source.beams(self.frequency_mhz, lmax)

    def background(self) -> Float[Array, " products"]:
        """Visibilities without any sky, in K."""
        return self.source.background(self.frequency_mhz)


def true_instrument(setup: Setup) -> TrueInstrument:
    """The instrument that simulated data are taken with."""
    scenario, error = setup.scenario, setup.scenario.noise.beam
    source, frequency = setup.beam_source, scenario.frequency_mhz
    if error is None:
        return TrueInstrument(source, frequency)
    if error.shift_mhz is not None:
        return TrueInstrument(source, frequency + error.shift_mhz)
    if error.file is not None:
        other = section_of_file(error.file, scenario.beam).source().behind(setup.receiver)
        return TrueInstrument(other, frequency)
    truth = BeamErrorTerm().truth(setup, jax.random.key(scenario.seed))
    return TrueInstrument(EmbeddedBeams(placed(source.monopoles, truth)), frequency)


def true_beams(setup: Setup) -> ProductBeams:
    """The beams that simulated data are taken with."""
    if setup.scenario.noise.beam is None:
        return setup.beams
    return true_instrument(setup).beams(setup.scenario.lmax)


def beam_directions(setup: Setup) -> list[ProductBeams]:
    """One-sigma errors of the beams that the scenario allows for."""
    beam = setup.scenario.noise.beam
    if beam is None:
        return []
    if not beam.parameters:
        return [difference(true_beams(setup), setup.beams)]
    frequency, lmax = setup.scenario.frequency_mhz, setup.scenario.lmax
    directions = []
    for name, sigma in beam.parameters.items():
        slope = derivative(name, frequency, lmax, setup.instrument.monopoles)
        directions.append(ProductBeams(sigma * slope.modes, frequency))
    return directions


def beam_rms_difference(setup: Setup) -> float | None:
    """RMS difference of the true beams and the model's, over the model's; None if the same."""
    if setup.scenario.noise.beam is None:
        return None
    return rms_difference(true_beams(setup), setup.beams)
