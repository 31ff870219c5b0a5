"""A scenario with its data, ready to be mapped or sampled.

An :class:`Experiment` is a setup and the data that were taken with it, measured or simulated. It
gives the posterior over its sky, and the pieces that programs can ask for.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from functools import cache
from operator import attrgetter
from typing import Any

import jax
import numpy as np
from jaxtyping import PRNGKeyArray

from lusee_bayes.core.arrays import Draws, on_device
from lusee_bayes.core.checks import Described
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.harmonics import n_modes
from lusee_bayes.core.progress import Stages
from lusee_bayes.experiment.leave_out import Fitting, fitting, without
from lusee_bayes.experiment.model import model_to_sample, radiometer, set_up, simulate, systematics
from lusee_bayes.experiment.rounds import (
    MAX_ROUNDS,
    Inference,
    Report,
    rebuilds,
    settled,
    with_learned_prior,
)
from lusee_bayes.experiment.scenario import Scenario
from lusee_bayes.instrument.coupling import Instrument
from lusee_bayes.instrument.visibilities import Visibilities
from lusee_bayes.judge.plausibility import require_plausible
from lusee_bayes.linear.information import Information
from lusee_bayes.linear.posterior import Posterior
from lusee_bayes.priors.learning import Learned, draws_with_parameters
from lusee_bayes.sky.sky_source import SkySource
from lusee_bayes.systematics.beam import BeamErrors
from lusee_bayes.systematics.context import Around, Setup
from lusee_bayes.systematics.gain_drifts import GainDrifts
from lusee_bayes.systematics.sources import PointSources
from lusee_bayes.systematics.systematic import Systematic


@dataclass(frozen=True, repr=False)
class Experiment(Described):
    """The pieces of d = A m + n, with d. :func:`build` makes one of a scenario.

    Attributes
    ----------
    setup : Setup
        A, S, the model sky and what N is made of.
    data : Visibilities
        d, measured or simulated.
    doubts : tuple of str
        What is doubtful about measured data, a sentence each.
    learned : Learned or None
        How the setup's prior was learned; None for one that was given.
    fitting : Fitting or None
        Of flight data: the times that did not fit and are left out; None for other data.
    inference : Inference or None
        Where the prior was learned: the data under it.
    """

    setup: Setup
    data: Visibilities
    doubts: tuple[str, ...] = ()
    learned: Learned | None = None
    fitting: Fitting | None = None
    inference: Inference | None = None

    def description(self) -> tuple[str, ...]:
        scenario = self.scenario
        return (
            f"{scenario.frequency_mhz:g} MHz, lmax = {scenario.lmax}, beams {scenario.beam.label}",
            *self.data.description(),
        )

    @property
    def scenario(self) -> Scenario:
        """What the experiment was built of."""
        return self.setup.scenario


# numbers of the largest matrix of data and modes above lmax that is made: 4 GB
MOST_ABOVE = 5e8
GAIN_ERRORS = (
    "The stated errors of the gains (flight.gain_std, or the gain table's) are not part of N: give "
    "noise.gain_table={}."
)


def build(
    scenario: Scenario,
    data: Visibilities | None = None,
    stages: Stages | None = None,
    *,
    earlier: Information | None = None,
    values: Mapping[str, float] | None = None,
) -> Experiment:
    """Build the experiment of a scenario, with the prior learned from its data.

    Parameters
    ----------
    scenario : Scenario
        Of one frequency.
    data : Visibilities, optional
        Measured data; if omitted, data are simulated from the scenario. A truth of another lmax is
        truncated, or padded with zeros.
    stages : Stages, optional
        Told what is being done.
    earlier : Information, optional
        Of earlier data, from which the prior is also learned.
    values : mapping of float, optional
        Starting values of the instrument's unknowns, by name.

    Raises
    ------
    InputError
        If the data have another frequency, site or number of ports, if they are implausible
        (:func:`.require_plausible`), and if the prior's parameters do not converge.
    """
    stages = stages or Stages()
    return _learned(_fitting(observed(scenario, data, stages), stages), stages, earlier, values)


def observed(
    scenario: Scenario, data: Visibilities | None = None, stages: Stages | None = None
) -> Experiment:
    """Build the experiment of a scenario; what its prior could learn of the data is left out.

    Parameters and errors are those of :func:`build`, but that no prior has to settle.
    """
    stages = stages or Stages()
    doubts, above = [], scenario.noise.above_lmax
    if data is not None and data.truth is not None:
        if len(data.truth) <= n_modes(scenario.lmax):  # of a sky that ends there
            above = None
        data = data.with_truth_up_to(scenario.lmax)
    scenario = scenario.with_section("noise", above_lmax=above)
    try:
        if above is not None and data is not None:
            _require_room(data.layout.size, above.top(scenario.lmax))
        setup = set_up(scenario, data, stages)
    except InputError as error:
        if above is None or data is None:
            raise
        # what is wrong without the sky above lmax, too, is raised here
        setup = set_up(scenario.with_section("noise", above_lmax=None), data, stages)
        doubts.append(f"The model ends at lmax = {scenario.lmax}, but the sky does not: {error}.")
    if data is None:
        with stages("noise"):
            return Experiment(setup, simulate(setup).with_truth_up_to(scenario.lmax))
    std = np.sqrt(np.asarray(radiometer(setup).diagonal()))
    doubts += require_plausible(data, setup.signal, std)
    gains_known = data.calibration is not None and data.calibration.gain_names
    if gains_known and scenario.noise.gain_table is None:
        doubts.append(GAIN_ERRORS)
    for doubt in doubts:
        stages.say(f"  doubtful: {doubt}")
    return Experiment(setup, data, tuple(doubts))


def _require_room(n_data: int, lmax: int) -> None:
    """InputError if a matrix of data and modes is too large."""
    if n_data * n_modes(lmax) > MOST_ABOVE:
        raise InputError(
            f"with {n_data:,} data, the sky up to lmax = {lmax} takes too much memory; average the "
            "data, or raise lmax"
        )


def _fitting(experiment: Experiment, stages: Stages) -> Experiment:
    """Without times that do not fit, where the data are flight data."""
    section, data = experiment.scenario.flight, experiment.data
    if section is None or not section.leave_out or data.calibration is None:
        return experiment
    with stages("inconsistent times"):
        fit = fitting(experiment.setup, data, section.false_alarm, stages)
        setup, kept = without(experiment.setup, data, fit.flagged)
    doubts = experiment.doubts
    if fit.remark:
        stages.say(f"  {fit.remark}")
        doubts = (*doubts, fit.remark)
    return replace(experiment, setup=setup, data=kept, doubts=doubts, fitting=fit)


def _learned(
    experiment: Experiment,
    stages: Stages,
    earlier: Information | None = None,
    values: Mapping[str, float] | None = None,
) -> Experiment:
    setup, data = experiment.setup, experiment.data
    start = None if values is None else Around(data, values=values)
    if setup.family is None:
        if start is not None:
            experiment = replace(experiment, inference=settled(setup, data, start))
        return experiment
    with rounds_of(experiment, stages, "prior") as report:
        setup, inference = with_learned_prior(setup, data, earlier, start, report)
    return replace(experiment, setup=setup, learned=inference.learned, inference=inference)


def with_truth(experiment: Experiment) -> Experiment:
    """The same, its data being of the scenario's own sky."""
    data = replace(experiment.data, truth=experiment.setup.sky.modes)
    return replace(experiment, data=data)


def under_sky(setup: Setup, source: SkySource, seed: int) -> Experiment:
    """Simulate data of a given sky, to be mapped with the prior of the scenario.

    The noise, in the data as in N, is that of the given sky; the prior knows nothing of it.

    Parameters
    ----------
    setup : Setup
        Of the scenario.
    source : SkySource
        The sky; what it has above the scenario's lmax is left out, but for what the model knows of.
    seed : int
        Of the noise and of the systematics.

    Raises
    ------
    InputError
        If the source has no sky at this frequency, or not up to the scenario's lmax.
    """
    scenario = setup.scenario.model_copy(update={"seed": seed})
    sky = source.at(scenario.frequency_mhz, scenario.lmax)
    seen = replace(setup.under(sky), scenario=scenario)
    if seen.above is not None:
        whole = source.at(scenario.frequency_mhz, scenario.noise.above_lmax.top(scenario.lmax))
        modes = np.asarray(whole.modes)[seen.prior.size :]
        seen = replace(seen, above=replace(seen.above, modes=modes))
    data = simulate(seen).with_truth_up_to(scenario.lmax)
    return _learned(Experiment(seen, data), Stages())


def rounds_of(experiment: Experiment, stages: Stages, name: str) -> AbstractContextManager:
    """A stage, whose progress is that of the rounds where there are some to come."""
    in_rounds = experiment.inference is None and rebuilds(experiment.setup)
    return stages.progress(name, MAX_ROUNDS) if in_rounds else stages(name)


def infer(experiment: Experiment, report: Report | None = None) -> Inference:
    """Condition the experiment's model on its data (:func:`.settled`).

    Parameters
    ----------
    experiment : Experiment
    report : callable, optional
        Told of every round.

    Raises
    ------
    InputError
        As :func:`.settled`.
    """
    return experiment.inference or settled(experiment.setup, experiment.data, report=report)


def program_pieces(experiment: Experiment) -> dict[str, Callable[[], Any]]:
    """What makes the pieces of an experiment that programs can ask for, by name.

    A piece raises InputError, once made, for a systematic that the scenario marginalises as well.
    """
    setup, data, log_normal = experiment.setup, experiment.data, experiment.scenario.log_normal

    def require_free(cls: type[Systematic]) -> None:
        if cls.treatment(experiment.scenario) == "marginalised":
            raise InputError(
                "the program samples an unknown that the scenario marginalises, too; set "
                f"{cls.key}.treatment=sampled"
            )

    def built(cls: type[Systematic]) -> Systematic:
        if cls.treatment(experiment.scenario) is None:
            raise InputError(f"the scenario has no {cls.key} to sample")
        require_free(cls)
        return cls.build(attrgetter(cls.key)(experiment.scenario), setup, around())

    def instrument() -> Instrument:
        require_free(BeamErrors)
        if not setup.beam_source.parameters():
            raise InputError(
                "the program needs the embedded antennas, which beam.file replaces; remove "
                "beam.file"
            )
        return setup.instrument

    @cache
    def around() -> Around:
        # about none, large offsets are not described, and gains are those of other antennas
        if not rebuilds(setup):
            return Around(data)
        return infer(experiment).around

    to_sample = cache(lambda: model_to_sample(setup, around()))
    return {
        "gaussian": lambda: to_sample()[0],
        "systematics": lambda: to_sample()[1],
        "gain_drifts": lambda: built(GainDrifts),
        "instrument": instrument,
        "sources": lambda: built(PointSources),
        "log_normal": lambda: on_device(log_normal.prior(setup.sky.frequency_mhz, setup.sky.lmax)),
        "layout": lambda: data.layout,
    }


def sampled_together(experiment: Experiment) -> dict[str, float]:
    """Over how many octaves channels share each sampled site (:meth:`.Systematic.octaves`)."""
    scenario, octaves_of = experiment.scenario, {}
    for treatment, systematic in systematics(experiment.setup):
        octaves = systematic.octaves(attrgetter(systematic.key)(scenario))
        if treatment == "sampled" and octaves:
            octaves_of |= {unknown.name: octaves for unknown in systematic.unknowns}
    return octaves_of


# what the seed is folded with for posterior draws
DRAWS = 1


def draw_key(scenario: Scenario) -> PRNGKeyArray:
    """The key of a scenario's posterior draws."""
    return jax.random.fold_in(jax.random.key(scenario.seed), DRAWS)


def posterior_draws(
    experiment: Experiment, posterior: Posterior, information: Callable[[], Information], n: int
) -> Draws:
    """Draw the sky.

    Where the prior was learned, its parameters are drawn, too (:mod:`.learning`); not for
    data that do not fit, which would not let them be uncertain.

    Parameters
    ----------
    experiment : Experiment
    posterior : Posterior
        The Gaussian posterior.
    information : callable
        ``information()`` of the data behind it, asked for where parameters are drawn.
    n : int

    Returns
    -------
    (draws, modes) array
        In K.
    """
    key, learned = draw_key(experiment.scenario), experiment.learned
    if learned is not None and learned.fits:
        family = experiment.setup.family
        return draws_with_parameters(family, learned, information(), key, n)
    return posterior.sample(key, n)


# rms error of interpolated beams in the data, in radiometer noise, above which it is doubtful
MOST_OFF = 0.1


def interpolation_error(setup: Setup) -> dict[str, float]:
    """RMS error of interpolated beams in the model sky's data, over the radiometer noise.

    By where it is found, such as "zenith_angle_deg 75" (:meth:`.BeamSource.interpolation_errors`),
    the largest of each; nothing where beams are not interpolated in parameters.
    """
    std = np.sqrt(np.asarray(radiometer(setup).diagonal()))
    off = setup.beam_source.interpolation_errors(setup.frequency_mhz, setup.scenario.lmax)

    def rms(modes: np.ndarray) -> float:
        seen = setup.coupling.of(modes=modes) @ setup.sky.modes
        return float(np.sqrt(np.mean((seen / std) ** 2)))

    return {where: max(map(rms, lines)) for where, lines in off.items()}


def doubts(experiment: Experiment, inference: Inference) -> tuple[str, ...]:
    """What is doubtful about an experiment's data, its prior and its rounds."""
    learned, notes = experiment.learned, list(experiment.doubts)
    errors = interpolation_error(experiment.setup)
    worst = max(errors, key=errors.__getitem__, default="")
    if worst and errors[worst] > MOST_OFF:
        notes.append(
            f"Beams interpolated between the files of {experiment.scenario.beam.label} may be "
            f"wrong by up to {errors[worst]:.2g} radiometer standard deviations (rms), tested by "
            f"omitting the files of {worst}; use more files, in smaller steps."
        )
    if learned is not None and not learned.settled:
        notes.append("The prior is fixed and wide: its parameters do not converge for any noise.")
    elif learned is not None and learned.noise_factor > 1.0:
        notes.append(
            f"The prior was learned with N times {learned.noise_factor:.2g}, to match residual "
            "chi2; the map uses the scenario's N."
        )
    if learned is not None and learned.still_moves > 0.0:
        notes.append(
            "Learning the prior did not converge: the map still changes by "
            f"{learned.still_moves:.2g} standard deviations per round."
        )
    if inference.unsettled:
        notes.append(inference.unsettled)
    return tuple(notes)
