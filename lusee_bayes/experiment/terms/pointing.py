"""Clock and pointing that are off."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import jax
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from lusee_bayes.core.errors import InputError, nearest
from lusee_bayes.core.reading import naming
from lusee_bayes.experiment.scenario import Scenario
from lusee_bayes.experiment.setup import Setup, expected_signal, mean_flux, source_responses
from lusee_bayes.experiment.terms.term import Around, Term, Truth
from lusee_bayes.instrument.coupling import CouplingMatrix
from lusee_bayes.instrument.pointing import Pointing
from lusee_bayes.instrument.pointing_offsets import CLOCK, kind_of, offset_names, with_offsets
from lusee_bayes.systematics import PointingOffsets, Systematic

# what the scenario's seed is folded with
DRAW = 7


class PointingTerm(Term):
    """``noise.pointing``; simulated data are taken with drawn offsets (:func:`true_setup`)."""

    key = "noise.pointing"
    remedy = "smaller standard deviations in noise.pointing, or its treatment=sampled"

    def moves(self, scenario: Scenario) -> bool:
        section = scenario.noise.pointing
        return (
            section is not None and section.treatment != "ignored" and section.around == "posterior"
        )

    def build(self, setup: Setup, around: Around) -> list[tuple[str, Systematic]]:
        section = setup.scenario.noise.pointing
        if section is None or section.treatment == "ignored":
            return []
        beam = setup.scenario.noise.beam
        makes_a = beam is not None and bool(beam.parameters) and beam.treatment == "sampled"
        if section.treatment == "sampled" and makes_a:
            raise InputError(
                "noise.pointing and the parameters of noise.beam cannot both be sampled: each of "
                "them makes A anew; set the treatment of one to marginalised"
            )
        return [(section.treatment, pointing_offsets(setup, around))]

    def truth(self, setup: Setup, key: PRNGKeyArray) -> Truth:
        section = setup.scenario.noise.pointing
        if section is None:
            return {}
        names = offset_names(section.kinds, setup.observation.n_runs)
        for name in section.true_values:
            if name not in names:
                raise InputError(
                    f"noise.pointing.true_values has '{name}', which is not among the offsets "
                    f"that have a prior; {nearest(name, names)}"
                )
        z = np.asarray(jax.random.normal(jax.random.fold_in(key, DRAW), (len(names),)))
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
    coupling = CouplingMatrix.build(setup.beams, pointing, setup.layout)
    responses = setup.responses
    if responses:
        responses = source_responses(
            setup.scenario, observation, setup.beam_source.monopoles, setup.scenario.frequency_mhz
        )
    instrument = replace(setup.instrument, pointing=pointing)
    return replace(
        setup,
        observation=observation,
        instrument=instrument,
        coupling=coupling,
        responses=responses,
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
    setup: Setup,
    stds: Mapping[str, float],
    sky: Float[np.ndarray, " modes"],
    centre: Mapping[str, float],
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


def second_order(
    setup: Setup, stds: Mapping[str, float], sky: Float[np.ndarray, " modes"]
) -> dict[str, Float[np.ndarray, " data"]]:
    """What offsets of one standard deviation do to the data beyond first order, in K."""
    middle = sum(_seen(setup, sky))
    return {
        name: sum(sum(_seen(shifted(setup, {name: sign * std}), sky)) for sign in (1.0, -1.0)) / 2.0
        - middle
        for name, std in stds.items()
    }


def _seen(
    setup: Setup, sky: Float[np.ndarray, " modes"]
) -> tuple[Float[np.ndarray, " data"], Float[np.ndarray, " data"]]:
    """What the data are of the sky, and of the sources with their mean fluxes."""
    sources = np.zeros(setup.layout.size)
    for section, response in zip(setup.scenario.sources.list, setup.responses, strict=True):
        flux = mean_flux(section, setup.scenario.frequency_mhz)
        sources = sources + flux * np.asarray(setup.layout.gather(np.asarray(response)))
    return np.asarray(setup.coupling @ sky), sources


def _stds(setup: Setup, names: tuple[str, ...]) -> Float[np.ndarray, " offsets"]:
    section = setup.scenario.noise.pointing
    return np.array([float(getattr(section, kind_of(name))) for name in names])
