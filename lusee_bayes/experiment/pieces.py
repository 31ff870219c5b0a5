"""What programs can ask an experiment for."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

from lusee_bayes.core.arrays import on_device
from lusee_bayes.core.errors import InputError
from lusee_bayes.experiment.experiment import Experiment
from lusee_bayes.experiment.model import model_to_sample
from lusee_bayes.experiment.rounds import rebuilds, settled
from lusee_bayes.experiment.setup import Setup
from lusee_bayes.experiment.terms import TERMS, Around, gain_drifts, point_sources
from lusee_bayes.instrument.instrument import Instrument


def program_pieces(experiment: Experiment) -> dict[str, Callable[[], Any]]:
    """What makes the pieces of an experiment that programs can ask for, by name.

    A piece raises InputError, once made, for a systematic that the scenario marginalises as well.
    """
    setup, data, log_normal = experiment.setup, experiment.data, experiment.scenario.log_normal

    def free(key: str, made: Callable[[], Any]) -> Callable[[], Any]:
        def make():
            piece = made()
            term = next(term for term in TERMS if term.key == key)
            if any(t == "marginalised" for t, _ in term.build(setup, Around())):
                raise InputError(
                    "the program samples what the scenario marginalises, so that it would count "
                    f"twice; set {key}.treatment=sampled"
                )
            return piece

        return make

    @cache
    def around() -> Around:
        # about none, large offsets are not described, and gains are those of other antennas
        if not rebuilds(setup):
            return Around(data)
        return settled(setup, data, experiment.around).around

    to_sample = cache(lambda: model_to_sample(setup, around()))
    return {
        "gaussian": lambda: to_sample()[0],
        "systematics": lambda: to_sample()[1],
        "gain_drifts": free("noise.gain", lambda: gain_drifts(setup, around())),
        "instrument": free("noise.beam", lambda: embedded_instrument(setup)),
        "sources": free("sources", lambda: point_sources(setup)),
        "log_normal": lambda: on_device(log_normal.prior(setup.sky.frequency_mhz, setup.sky.lmax)),
        "layout": lambda: data.layout,
    }


def embedded_instrument(setup: Setup) -> Instrument:
    """The embedded antennas, prepared. InputError where the beams are those of a file."""
    if setup.scenario.beam.is_file:
        raise InputError(
            "the program asks for the embedded antennas, which beam.file replaces; leave out "
            "beam.file"
        )
    return setup.prepared
