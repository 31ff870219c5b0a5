"""Errors of the beams: along the direction to other beams, or in parameters of the antennas.

If marginalised, they are averaged over the skies of the prior: to first order, data contain dA m
besides A m, which adds dA (S + mu mu^T) dA^T to N. dA is the derivative of A by the unknown.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, ClassVar

import equinox as eqx
import jax
import numpy as np
from jaxtyping import PRNGKeyArray
from pydantic import Field

from lusee_bayes.core.arrays import DataVector
from lusee_bayes.core.section import Positive, Section, Treatment, requires
from lusee_bayes.instrument.beams.source import BeamSource
from lusee_bayes.instrument.coupling import BeamModes, CouplingMatrix, Instrument
from lusee_bayes.linear.linear_gaussian import LinearGaussian
from lusee_bayes.noise import instrument_errors
from lusee_bayes.systematics import systematic as kinds
from lusee_bayes.systematics.context import Around, Setup
from lusee_bayes.systematics.horizon import Horizon
from lusee_bayes.systematics.sources import source_responses


class BeamErrorSection(Section):
    """Beam errors: the data use other beams than the model; give one of the first three keys.

    Attributes
    ----------
    shift_mhz : float
        The data use the beams at frequency + shift. Like ``file``, as an unknown this changes A of
        the map's sky only: sources, polarisation, ground emission and the sky above lmax keep the
        model's beams.
    file : str
        The data use the beams in this file.
    parameters : dict
        Prior standard deviations, by name, of parameters of the embedded antennas or of a grid of
        files, about the values in ``beam``; simulated data draw true values from this prior.
    treatment : {"marginalised", "sampled", "ignored"}
        Add the covariance of the error to N, sample its amplitude or parameters with the map, or
        leave it out of the model.
    """

    shift_mhz: Annotated[float, Field(ge=-49, le=49)] | None = None
    file: str | None = None
    parameters: dict[str, Positive] = Field(default_factory=dict)
    treatment: Treatment = "marginalised"

    _one_direction = requires(
        lambda s: [s.shift_mhz, s.file, s.parameters or None].count(None) == 2,
        "give either shift_mhz, file or parameters",
    )


class BeamErrors(kinds.Systematic):
    """Errors of the beams, of either kind."""

    key, section, words, draw = "noise.beam", BeamErrorSection, "the beams", 3
    moves_setup = True

    @classmethod
    def in_rounds(cls, section: BeamErrorSection) -> bool:
        return bool(section.parameters)

    @classmethod
    def octaves(cls, section: BeamErrorSection) -> float:
        return np.inf if section.parameters else 0.0

    @classmethod
    def build(cls, section: BeamErrorSection, setup: Setup, around: Around) -> BeamErrors:
        """Use a direction, or parameters about the values of the instrument.

        Raises
        ------
        InputError
            For unknown names, and for a prior that exceeds a parameter's domain.
        """
        if not section.parameters:
            direction = difference_of_beams(section, setup, around.values or {})
            return BeamError(CouplingMatrix.of_modes(direction, setup.pointing, setup.layout))
        unknowns = []
        for name, std in section.parameters.items():
            p = setup.instrument.source.parameter(name)
            unknown = kinds.Unknown(name, float(p.value), std, low=float(p.low), high=float(p.high))
            unknown.prior()
            unknowns.append(unknown)
        return InstrumentParameters(tuple(unknowns), setup.instrument)

    @classmethod
    def truth(cls, section: BeamErrorSection, setup: Setup, key: PRNGKeyArray) -> kinds.Truth:
        if not section.parameters:
            return {"beam_amplitude": 1.0}
        unknowns = cls.build(section, setup, Around()).unknowns
        keys = jax.random.split(cls.own_key(key), len(unknowns))
        return {u.name: float(u.prior().sample(k)) for u, k in zip(unknowns, keys, strict=True)}

    @classmethod
    def moved(cls, section: BeamErrorSection, setup: Setup, values: kinds.Values) -> Setup:
        """Use the true beams, their ground emission, and their responses to sources."""
        if not {"beam_amplitude", *section.parameters} & set(values):
            return setup
        source, frequency_mhz = _true(section, setup, values)
        beams = source.beams(frequency_mhz, setup.beams.lmax)
        emitted = np.asarray(source.background(frequency_mhz))
        nominal = np.asarray(setup.beam_source.background(setup.frequency_mhz))
        return replace(
            setup,
            beam_source=source,
            beams=beams,
            coupling=CouplingMatrix.build(beams, setup.pointing, setup.layout),
            background=setup.background + (emitted - nominal)[:, None],
            responses=source_responses(setup.scenario, setup.observation, source, frequency_mhz),
        )


def _true(
    section: BeamErrorSection, setup: Setup, values: kinds.Values
) -> tuple[BeamSource, float]:
    """The antennas with these values, and the frequency at which they are used."""
    source, frequency_mhz = setup.beam_source, setup.frequency_mhz
    if section.shift_mhz is not None:
        return source, frequency_mhz + section.shift_mhz
    if section.file is not None:
        # with the same receivers, and turned like the scenario's
        other = setup.scenario.beam.of_file(section.file).source()
        return other.behind(setup.receiver), frequency_mhz
    return source.with_values({name: values[name] for name in section.parameters}), frequency_mhz


def difference_of_beams(section: BeamErrorSection, setup: Setup, values: kinds.Values) -> BeamModes:
    """Difference to the beams of a shift or a file; one for each run if there is a horizon.

    Parameters
    ----------
    section : BeamErrorSection
    setup : Setup
    values : mapping
        Of the horizon's unknowns; others are at their prior means.
    """
    source, frequency_mhz = _true(section, setup, {})
    other, horizon = source.beams(frequency_mhz, setup.beams.lmax), setup.scenario.noise.horizon
    modes = instrument_errors.difference(other, setup.instrument.beams()).modes
    if horizon is None:
        return modes
    theirs, ours = (
        Horizon.build(horizon, replace(setup, beam_source=one, beams=beams), Around())
        for one, beams in ((source, other), (setup.beam_source, setup.beams))
    )
    at = {name: values.get(name, 0.0) for name in ours.names}
    return modes + theirs.hidden(at) - ours.hidden(at)


class BeamError(BeamErrors):
    """Beams that deviate along one direction by an unknown amplitude, N(0, 1).

    Attributes
    ----------
    direction : CouplingMatrix
        dA for an amplitude of one, such as that of the difference to another beam.
    """

    unknowns: ClassVar[tuple[kinds.Unknown, ...]] = (kinds.Unknown("beam_amplitude"),)
    first_order = False

    direction: CouplingMatrix

    def behind(self, gains: DataVector) -> BeamError:
        return replace(self, direction=self.direction.with_response(np.asarray(gains)))

    def effect(self, model, values):
        """Use A of these beams."""
        modes = model.coupling.modes + values["beam_amplitude"] * self.direction.modes
        return replace(model, coupling=model.coupling.of(modes=modes))

    def marginalised(self, model: LinearGaussian) -> LinearGaussian:
        """Add dA (S + mu mu^T) dA^T to N."""
        noise = instrument_errors.beam_error_noise(self.direction, model.prior)
        return replace(model, noise=model.noise + noise)


class InstrumentParameters(kinds.ChangedBeams, BeamErrors):
    """Unknown parameters of the antennas, with Gaussian priors.

    Attributes
    ----------
    unknowns : tuple of Unknown
        As numbers: arrays would be traced, and the checks of the priors and the ends of their
        domains need values.
    instrument : Instrument
        The instrument with the prior means of its parameters.
    """

    unknowns: tuple[kinds.Unknown, ...] = eqx.field(static=True)
    instrument: Instrument

    def modes(self, modes, values):
        """Beams of antennas with these values; a horizon hides the same as without them."""
        made = self.instrument.beams(values).modes
        return made if modes.ndim == 2 else modes + (made - self.instrument.beams().modes)[None]

    def effect(self, model, values):
        """Use A of these beams, and the emission of ground and antennas with them."""
        return kinds.with_added(super().effect(model, values), self.emitted(values))

    def linearised(self, model, centre):
        """Differentiate :meth:`effect`."""
        of_sky = super().linearised(model, centre)
        emitted = np.stack(list(self.differences(self.emitted, centre)), axis=1)
        return lambda sky: of_sky(sky) + emitted

    def emitted(self, values: kinds.Values) -> DataVector:
        """Emission of ground and antennas beyond the background, in K."""
        source, frequency_mhz = self.instrument.source, self.instrument.frequency_mhz
        more = source.with_values(values).background(frequency_mhz)
        return (more - source.background(frequency_mhz))[self.instrument.layout.product]


def beam_rms_difference(setup: Setup) -> float | None:
    """RMS difference of the true and the model's beams, over the model's; None if unknown."""
    section = setup.scenario.noise.beam
    if section is None or setup.measured:
        return None
    key = jax.random.key(BeamErrors.true_seed(section, setup.scenario))
    true = BeamErrors.moved(section, setup, BeamErrors.truth(section, setup, key))
    return instrument_errors.rms_difference(true.beams, setup.beams)
