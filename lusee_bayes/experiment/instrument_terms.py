"""Terms of N from the instrument.

Beams that differ from the model's in the data: shifted, from another file, or other antennas; clock
and pointing that are off; drifts of the antennas' gains; and errors of the gain table.
"""

from __future__ import annotations

import threading
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from lusee_bayes.core.arrays import DataVector, Grid, Modes
from lusee_bayes.core.errors import InputError, nearest
from lusee_bayes.core.lazy import numpyro
from lusee_bayes.core.reading import naming
from lusee_bayes.experiment.instrument_sections import section_of_file
from lusee_bayes.experiment.scenario import Scenario
from lusee_bayes.experiment.section import is_modelled
from lusee_bayes.experiment.setup import Setup, expected_signal, mean_flux, source_responses
from lusee_bayes.experiment.term import Around, Term, Truth, gains_about, noise_visibilities
from lusee_bayes.instrument.beams.fields import ProductBeams
from lusee_bayes.instrument.beams.monopoles import with_values
from lusee_bayes.instrument.beams.source import BeamSource, EmbeddedBeams
from lusee_bayes.instrument.coupling import CouplingMatrix
from lusee_bayes.instrument.pointing import CLOCK, Pointing, offset_kind, offset_names, with_offsets
from lusee_bayes.instrument.products import DataLayout
from lusee_bayes.noise import instrument_errors
from lusee_bayes.systematics.gain_drifts import GainDrifts
from lusee_bayes.systematics.gain_table import GAIN_TABLE, GainTable, TableErrors
from lusee_bayes.systematics.instrument_unknowns import (
    BeamError,
    InstrumentParameters,
    PointingOffsets,
    parameter_directions,
)
from lusee_bayes.systematics.systematic import Systematic

# what the scenario's seed is folded with
BEAM_DRAW = 3


class BeamErrorTerm(Term):
    """``noise.beam``; simulated data are taken with the true beams (:func:`true_instrument`)."""

    key = "noise.beam"

    def systematics(self, setup: Setup, section: Any, around: Around) -> list[Systematic]:
        if section.treatment == "sampled" and section.parameters:
            return [InstrumentParameters.centred(setup.prepared, section.parameters)]
        coupling_of = setup.instrument.coupling_of
        return [BeamError(coupling_of(direction)) for direction in beam_directions(setup)]

    def drawn(self, setup: Setup, section: Any, key: PRNGKeyArray) -> Truth:
        if not section.parameters:
            return {"beam_amplitude": 1.0}
        priors = InstrumentParameters.centred(setup.instrument, section.parameters).priors()
        keys = jax.random.split(jax.random.fold_in(key, BEAM_DRAW), len(priors))
        return {
            name: float(prior.sample(k))
            for (name, prior), k in zip(priors.items(), keys, strict=True)
        }


class TrueInstrument(NamedTuple):
    """What simulated data are taken with: beams of a source at a frequency."""

    source: BeamSource
    frequency_mhz: float


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
    return TrueInstrument(EmbeddedBeams(with_values(source.monopoles, truth)), frequency)


def true_beams(setup: Setup) -> ProductBeams:
    """The beams that simulated data are taken with."""
    if setup.scenario.noise.beam is None:
        return setup.beams
    true = true_instrument(setup)
    return true.source.beams(true.frequency_mhz, setup.scenario.lmax)


def beam_directions(setup: Setup) -> list[ProductBeams]:
    """One-sigma errors of the beams that the scenario allows for."""
    beam = setup.scenario.noise.beam
    if beam is None:
        return []
    if not beam.parameters:
        return [instrument_errors.difference(true_beams(setup), setup.beams)]
    return parameter_directions(setup.instrument, beam.parameters)


def beam_rms_difference(setup: Setup) -> float | None:
    """RMS difference of the true beams and the model's, over the model's; None if the same."""
    if setup.scenario.noise.beam is None:
        return None
    return instrument_errors.rms_difference(true_beams(setup), setup.beams)


# what the scenario's seed is folded with
POINTING_DRAW = 7


class PointingTerm(Term):
    """``noise.pointing``; simulated data are taken with drawn offsets (:func:`true_setup`)."""

    key = "noise.pointing"
    remedy = "smaller standard deviations in noise.pointing, or its treatment=sampled"

    def moves(self, scenario: Scenario) -> bool:
        section = self.section(scenario)
        return is_modelled(section) and section.around == "posterior"

    def systematics(self, setup: Setup, section: Any, around: Around) -> list[Systematic]:
        beam = setup.scenario.noise.beam
        makes_a = beam is not None and bool(beam.parameters) and beam.treatment == "sampled"
        if section.treatment == "sampled" and makes_a:
            raise InputError(
                "noise.pointing and the parameters of noise.beam cannot both be sampled: each of "
                "them makes A anew; set the treatment of one to marginalised"
            )
        return [pointing_offsets(setup, around)]

    def drawn(self, setup: Setup, section: Any, key: PRNGKeyArray) -> Truth:
        names = offset_names(section.kinds, setup.observation.n_runs)
        for name in section.true_values:
            if name not in names:
                raise InputError(
                    f"noise.pointing.true_values has '{name}', which is not among the offsets "
                    f"that have a prior; {nearest(name, names)}"
                )
        z = np.asarray(jax.random.normal(jax.random.fold_in(key, POINTING_DRAW), (len(names),)))
        drawn = dict(zip(names, (z * _stds(setup, names)).tolist(), strict=True))
        return {name: float(section.true_values.get(name, drawn[name])) for name in names}


def true_setup(setup: Setup, truth: Truth) -> Setup:
    """The setup with the times and the pointing that simulated data were taken with."""
    if setup.scenario.noise.pointing is None:
        return setup
    names = offset_names(setup.scenario.noise.pointing.kinds, setup.observation.n_runs)
    return shifted(setup, {name: truth[name] for name in names})


def shifted(setup: Setup, values: Mapping[str, float]) -> Setup:
    """The setup with another observation, coupling and responses to sources; else as it is."""
    given = ", ".join(f"{name} = {value:g}" for name, value in values.items() if value)
    with naming(f"noise.pointing, with {given or 'no offsets'}"):
        observation = with_offsets(setup.observation, values)
    if any(values.get(name) for name in CLOCK):
        frame = np.asarray(setup.pointing.pole_frame)
        pointing = Pointing.of(observation, setup.scenario.lmax, pole_frame=frame)
    else:  # the sky turns as before
        pointing = setup.pointing.placed(observation)
    return replace(
        setup,
        observation=observation,
        instrument=replace(setup.instrument, pointing=pointing),
        coupling=CouplingMatrix.build(setup.beams, pointing, setup.layout),
        responses=source_responses(setup.scenario, observation, setup.beam_source),
    )


def pointed(setup: Setup, values: Mapping[str, float] | None) -> Setup:
    """The setup as the other terms are built about: shifted, its signal with it."""
    section = setup.scenario.noise.pointing
    names = () if section is None else offset_names(section.kinds, setup.observation.n_runs)
    offsets = {name: value for name, value in (values or {}).items() if name in names}
    if not offsets:
        return setup
    there = shifted(setup, offsets)
    complete = CouplingMatrix.build(there.beams, there.pointing)
    signal = expected_signal(there.scenario, complete, there.sky, there.background, there.responses)
    return replace(there, signal=signal)


def pointing_offsets(setup: Setup, around: Around) -> PointingOffsets:
    """The offsets, with templates about a sky and values. InputError if the scenario has none."""
    section = setup.scenario.noise.pointing
    if section is None:
        raise InputError("the scenario has no noise.pointing that could be fitted")
    names = offset_names(section.kinds, setup.observation.n_runs)
    sky = setup.sky.modes if around.sky is None else np.asarray(around.sky)
    values = around.values or {}
    centre = {name: float(values.get(name, 0.0)) for name in names}
    stds = dict(zip(names, _stds(setup, names), strict=True))
    offsets = offsets_about(setup, stds, sky, centre)
    return replace(offsets, moves=section.around == "posterior")


def offsets_about(
    setup: Setup, stds: Mapping[str, float], sky: Modes, centre: Mapping[str, float]
) -> PointingOffsets:
    """Offsets with templates about a sky and values: half the difference at +-1 standard deviation.

    Parameters
    ----------
    setup : Setup
    stds : mapping of float
        Prior standard deviations by name.
    sky : (modes,) array
        In K.
    centre : mapping of float
        The values.
    """
    templates, sources = [], []
    for name, std in stds.items():
        up, down = (
            _seen(shifted(setup, {**centre, name: centre[name] + sign * std}), sky)
            for sign in (1.0, -1.0)
        )
        templates.append((up[0] + up[1] - down[0] - down[1]) / 2.0)
        sources.append((up[1] - down[1]) / 2.0)
    here = np.array(list(stds.values()))
    at = np.array([centre[name] for name in stds])
    coupling = setup.coupling if not at.any() else shifted(setup, centre).coupling
    return PointingOffsets(
        names=tuple(stds),
        stds=here,
        templates=np.stack(templates, axis=1),
        centre=at / here,
        coupling=coupling,
        nominal=setup.coupling,
        modes=setup.beams.modes,
        hours=setup.observation.hours,
        sources=np.stack(sources, axis=1),
    )


def second_order(setup: Setup, stds: Mapping[str, float], sky: Modes) -> dict[str, DataVector]:
    """What offsets of one standard deviation do to the data beyond first order, in K."""
    middle = sum(_seen(setup, sky))
    return {
        name: sum(sum(_seen(shifted(setup, {name: sign * std}), sky)) for sign in (1.0, -1.0)) / 2.0
        - middle
        for name, std in stds.items()
    }


def _seen(setup: Setup, sky: Modes) -> tuple[DataVector, DataVector]:
    """What the data are of the sky, and of the sources with their mean fluxes."""
    sources = np.zeros(setup.layout.size)
    for section, response in zip(setup.scenario.sources.list, setup.responses, strict=True):
        flux = mean_flux(section, setup.scenario.frequency_mhz)
        sources = sources + flux * np.asarray(setup.layout.gather(np.asarray(response)))
    return np.asarray(setup.coupling @ sky), sources


def _stds(setup: Setup, names: tuple[str, ...]) -> Float[np.ndarray, " offsets"]:
    section = setup.scenario.noise.pointing
    return np.array([float(getattr(section, offset_kind(name))) for name in names])


# what the scenario's seed is folded with: for the drifts, and for their scales
GAIN_DRAW, SCALE_DRAW = 2, 6


# NumPyro's handlers are those of all threads, in which channels and cases are simulated
_HANDLERS = threading.Lock()


class GainTerm(Term):
    """``noise.gain``; simulated data hold drawn drifts."""

    key = "noise.gain"

    def systematics(self, setup: Setup, section: Any, around: Around) -> list[Systematic]:
        return [gain_drifts(setup, around)]

    def drawn(self, setup: Setup, section: Any, key: PRNGKeyArray) -> Truth:
        # the scales where they are not known; the prior is the program's own
        with _HANDLERS, numpyro.handlers.seed(rng_seed=jax.random.fold_in(key, SCALE_DRAW)):
            drift = gain_drifts(setup, Around()).scales()
        return {"gain_sigma": float(drift.sigma), "gain_correlation_h": float(drift.correlation_h)}

    def distorted(self, visibilities: Grid, setup: Setup, truth: Truth, key: PRNGKeyArray) -> Grid:
        drift = instrument_errors.GainDrift(truth["gain_sigma"], truth["gain_correlation_h"])
        gains = drift.sample(jax.random.fold_in(key, GAIN_DRAW), setup.observation.hours)
        return instrument_errors.with_gains(visibilities, gains)


def gain_drifts(setup: Setup, around: Around) -> GainDrifts:
    """The gain drifts. InputError if the scenario has none."""
    gain = setup.scenario.noise.gain
    if gain is None:
        raise InputError("the scenario has no noise.gain that could be sampled")
    return GainDrifts.of(
        instrument_errors.GainDrift(gain.sigma, gain.correlation_h),
        noise_visibilities(setup, around, gains_about(setup)),
        setup.observation.hours,
        setup.layout,
        gain.log_sigma_std,
        gain.log_correlation_std,
    )


# what the scenario's seed is folded with
TABLE_DRAW = 10
# standard deviation of a port's power gain: 1 + eps is then positive by ten of them
LARGEST = 0.1


class GainTableTerm(Term):
    """``noise.gain_table``; simulated data hold drawn errors, in prior standard deviations."""

    key = "noise.gain_table"
    remedy = "noise.gain_table.treatment=sampled"

    def moves(self, scenario: Scenario) -> bool:
        return is_modelled(self.section(scenario))

    def systematics(self, setup: Setup, section: Any, around: Around) -> list[Systematic]:
        errors = table_errors(setup)
        centre = _centre(errors, around)
        seen = around.seen
        if seen is None:
            # those of some sky: what gains make of the data is none, and to first order would be
            # explained by gains that take all of the data away
            seen = setup.layout.gather(setup.signal)
        return [GainTable(errors, centre, np.asarray(seen), around.freedom)]

    def drawn(self, setup: Setup, section: Any, key: PRNGKeyArray) -> Truth:
        own, shape = jax.random.fold_in(key, TABLE_DRAW), (len(table_errors(setup).names),)
        return {GAIN_TABLE: np.asarray(jax.random.normal(own, shape))}

    def distorted(self, visibilities: Grid, setup: Setup, truth: Truth, key: PRNGKeyArray) -> Grid:
        whole = DataLayout(setup.layout.n_products, setup.layout.n_times)
        errors = replace(table_errors(setup), layout=whole)
        return visibilities * whole.scatter(errors.factors(np.asarray(truth[GAIN_TABLE])))


def table_errors(setup: Setup) -> TableErrors:
    """The errors that the data name, or one for each port.

    Raises
    ------
    InputError
        If the scenario and the data both say how large they are, or none of them, and for errors
        of more than 10 %.
    """
    std, calibration = setup.scenario.noise.gain_table.std, setup.calibration
    named = calibration is not None and calibration.gain_slope is not None
    if named and std is not None:
        raise InputError(
            "the data say the errors of their gain table themselves; leave out noise.gain_table.std"
        )
    if not named:
        if std is None and setup.scenario.flight is not None:
            # what it says of every level of every port: these data have one
            std = setup.scenario.flight.gain_std
            if std is not None and std > LARGEST:
                raise InputError(
                    f"flight.gain_std is {std:g}, and power gains that are off by more than "
                    f"{LARGEST:g} of themselves are not modelled; give a smaller "
                    "noise.gain_table.std for simulated data"
                )
        if std is None:
            raise InputError(
                "the data say nothing of a gain table; give noise.gain_table.std, the relative "
                "error of every port's power gain"
            )
        ports = tuple(range(setup.beam_source.n_ports))
        slope = np.full((len(ports), setup.layout.n_times), std)
        return TableErrors(tuple(f"gain_{port}" for port in ports), ports, slope, setup.layout)
    # of levels that no port has at these times the data say nothing
    used = np.flatnonzero(calibration.gain_slope.any(1))
    port, slope = calibration.gain_port[used], calibration.gain_slope[used]
    for number in np.unique(port):
        total = float(np.sqrt((slope[port == number] ** 2).sum(0)).max())
        if total > LARGEST:
            raise InputError(
                f"the data say that the power gain of port {number} is known to {total:.2g} of "
                f"itself, expected at most {LARGEST:g}; noise.gain_table.treatment=ignored takes "
                "it as it is"
            )
    names = tuple(f"gain_{calibration.gain_names[k].replace(' ', '_')}" for k in used)
    return TableErrors(names, tuple(port.tolist()), slope, setup.layout)


def table_factors(setup: Setup, around: Around) -> DataVector | None:
    """Gains of the errors that terms of N are built around; None where these are none."""
    if not around.values or not GainTableTerm().moves(setup.scenario):
        return None
    errors = table_errors(setup)
    centre = _centre(errors, around)
    return np.asarray(errors.factors(centre)) if centre.any() else None


def _centre(errors: TableErrors, around: Around) -> Float[np.ndarray, " errors"]:
    values = around.values or {}
    return np.array([values.get(name, 0.0) for name in errors.names]) / errors.stds
