"""A scenario with its data, ready to be mapped or sampled.

An :class:`Experiment` is a setup with its data, measured or simulated. It provides the posterior
over the sky, and the pieces that programs can request.
"""

from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass, replace
from functools import cache
from operator import attrgetter
from typing import Any

import jax
import numpy as np
from jaxtyping import PRNGKeyArray

from lusee_bayes.core.arrays import Draws, Pixels
from lusee_bayes.core.checks import Described, counted
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.harmonics import n_modes
from lusee_bayes.core.progress import Stages
from lusee_bayes.experiment import diagnosis, rounds
from lusee_bayes.experiment.leave_out import Fitting, fitting, without
from lusee_bayes.experiment.model import model_to_sample, radiometer, set_up, simulate, systematics
from lusee_bayes.experiment.scenario import Scenario, load_scenario
from lusee_bayes.experiment.second_order import with_other_modes, with_second_order
from lusee_bayes.instrument.coupling import Instrument
from lusee_bayes.instrument.visibilities import Visibilities
from lusee_bayes.judge import measures, plausibility
from lusee_bayes.linear.information import Information
from lusee_bayes.linear.posterior import Posterior
from lusee_bayes.noise.radiometer import of_voltages
from lusee_bayes.priors.learning import Learned, draws_with_parameters
from lusee_bayes.sky.sky_source import SkySource
from lusee_bayes.systematics import beam, gain_drifts, noise_level, sources
from lusee_bayes.systematics.context import Around, Setup, noise_visibilities
from lusee_bayes.systematics.systematic import Systematic


@dataclass(frozen=True, repr=False)
class Experiment(Described):
    """The pieces of d = A m + n, including d; :func:`build` builds one from a scenario.

    Attributes
    ----------
    setup : Setup
        A, S, the model sky and the ingredients of N.
    data : Visibilities
        d, measured or simulated.
    doubts : tuple of str
        Doubts about measured data, one sentence each.
    learned : Learned or None
        How the setup's prior was learned; None for a given prior.
    fitting : Fitting or None
        For flight data: the inconsistent data that are left out; None for other data.
    inference : Inference or None
        Inference under a learned prior, or from given starting values; None otherwise.
    """

    setup: Setup
    data: Visibilities
    doubts: tuple[str, ...] = ()
    learned: Learned | None = None
    fitting: Fitting | None = None
    inference: rounds.Inference | None = None

    def description(self) -> tuple[str, ...]:
        scenario = self.scenario
        return (
            f"{scenario.frequency_mhz:g} MHz, lmax = {scenario.lmax}, beams {scenario.beam.label}",
            *self.data.description(),
        )

    @property
    def scenario(self) -> Scenario:
        """The scenario of the experiment."""
        return self.setup.scenario

    @property
    def highest_altitude(self) -> Pixels:
        """The sine of the highest altitude of every pixel above the known terrain, at all data."""
        horizon, observation = self.scenario.noise.horizon, self.data.observation
        seen = np.asarray(self.data.layout.present).any(axis=0)
        terrain = None if horizon is None else horizon.altitude_at
        return measures.highest_altitude(observation, self.scenario.map_nside, seen, terrain)


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
        With one frequency, or its file or name. For data without a truth it has the defaults of
        measured data (:meth:`.Scenario.of_measured`).
    data : Visibilities, optional
        Measured data; if omitted, data are simulated from the scenario. A truth with another lmax
        is truncated, or padded with zeros.
    stages : Stages, optional
        Shows the progress.
    earlier : Information, optional
        Information in earlier data, from which the prior is also learned.
    values : mapping of float, optional
        Starting values of the instrument's unknowns, by name.

    Raises
    ------
    InputError
        If the data have another frequency, site or number of ports, if they are implausible
        (:func:`.require_plausible`), or if the prior's parameters do not converge.
    """
    stages = stages or Stages()
    experiment = _fitting(observed(scenario, data, stages), stages)
    start = Around(experiment.data, values=values)
    return _learned(*_searchable(experiment, start, stages), stages, earlier)


def observed(
    scenario: Scenario, data: Visibilities | None = None, stages: Stages | None = None
) -> Experiment:
    """Build the experiment of a scenario without learning its prior.

    Parameters and errors are as in :func:`build`, except that no prior has to converge.
    """
    scenario, stages = load_scenario(scenario), stages or Stages()
    if data is None:
        setup = set_up(scenario, stages=stages)
        with stages("noise"):
            return Experiment(setup, simulate(setup).with_truth_up_to(scenario.lmax))
    if data.truth is None:
        scenario = scenario.of_measured()
    doubts, above = [], scenario.noise.above_lmax
    if data.truth is not None:
        if len(data.truth) <= n_modes(scenario.lmax):  # the true sky ends at lmax
            above = None
        data = data.with_truth_up_to(scenario.lmax)
    scenario = scenario.with_section("noise", above_lmax=above)
    try:
        setup = set_up(scenario, data, stages)
    except InputError as error:
        if above is None:
            raise
        # this raises any error that does not come from the sky above lmax
        setup = set_up(scenario.with_section("noise", above_lmax=None), data, stages)
        doubts.append(f"The sky above lmax = {scenario.lmax} is not in the model: {error}.")
    std = np.sqrt(np.asarray(radiometer(setup).diagonal()))
    doubts += plausibility.require_plausible(data, setup.signal, std)
    gains_known = data.calibration is not None and data.calibration.gain_names
    if gains_known and scenario.noise.gain_table is None:
        doubts.append("The stated errors of the gains are not part of N: give noise.gain_table={}.")
    for doubt in doubts:
        stages.say(f"  doubtful: {doubt}")
    return Experiment(setup, data, tuple(doubts))


def _fitting(experiment: Experiment, stages: Stages) -> Experiment:
    """Remove inconsistent data from an experiment with flight data."""
    section, data = experiment.scenario.flight, experiment.data
    if section is None or not section.leave_out or data.calibration is None:
        return experiment
    with stages("inconsistent times"):
        fit = fitting(experiment.setup, data, section.false_alarm, stages)
        setup, kept = without(experiment.setup, data, fit.flagged)
    if fit.remark:
        stages.say(f"  {fit.remark}")
    doubts = (*experiment.doubts, fit.remark) if fit.remark else experiment.doubts
    return replace(experiment, setup=setup, data=kept, doubts=doubts, fitting=fit)


def _searchable(experiment: Experiment, start: Around, stages: Stages) -> tuple[Experiment, Around]:
    """Keep the instrument as expected if the data contain a mistake that it could absorb."""
    setup, sampled = experiment.setup, experiment.scenario.samples
    if sampled or not (setup.measured and rounds.first_order(setup.scenario)):
        return experiment, start
    words = "A mistake explains most of the misfit, and the instrument's unknowns stay as expected."
    # numbers that rounding rules are no reason to end
    with stages("usual mistakes"), suppress(InputError):
        if diagnosis.is_mistaken(setup, start):
            said = *experiment.doubts, words
            return replace(experiment, doubts=said), replace(start, still=True)
    return experiment, start


def _learned(
    experiment: Experiment, start: Around, stages: Stages, earlier: Information | None = None
) -> Experiment:
    setup = experiment.setup
    if setup.family is None:
        if start.values is None and not start.still:
            return experiment
        return replace(experiment, inference=rounds.settled(setup, start))
    with rounds_of(experiment, stages, "prior") as report:
        setup, inference = rounds.with_learned_prior(setup, start, earlier, report)
    return replace(experiment, setup=setup, learned=inference.learned, inference=inference)


def under_sky(setup: Setup, source: SkySource, seed: int) -> Experiment:
    """Simulate data of a given sky, to be mapped with the scenario's prior.

    The noise, both in the data and in N, follows from the given sky; the prior does not.

    Parameters
    ----------
    setup : Setup
        Setup of the scenario.
    source : SkySource
        The sky; modes above the scenario's lmax are dropped, unless the model includes them.
    seed : int
        Seed of the noise and the systematics.

    Raises
    ------
    InputError
        If the source has no sky at this frequency, or not up to the scenario's lmax.
    """
    scenario = setup.scenario.model_copy(update={"seed": seed})
    seen = replace(setup.under(source.at(scenario.frequency_mhz, scenario.lmax)), scenario=scenario)
    if seen.above is not None:
        whole = source.at(scenario.frequency_mhz, scenario.noise.above_lmax.top(scenario.lmax))
        modes = np.asarray(whole.modes)[seen.prior.size :]
        seen = replace(seen, above=replace(seen.above, modes=modes))
    data = simulate(seen).with_truth_up_to(scenario.lmax)
    return _learned(Experiment(seen, data), Around(data), Stages())


def rounds_of(experiment: Experiment, stages: Stages, name: str) -> AbstractContextManager:
    """A stage; it shows the progress of rounds if the inference still needs them."""
    in_rounds = experiment.inference is None and rounds.rebuilds(experiment.setup)
    return stages.progress(name, rounds.MAX_ROUNDS, rounds=True) if in_rounds else stages(name)


def infer(experiment: Experiment, report: rounds.Report | None = None) -> rounds.Inference:
    """Condition the experiment's model on its data (:func:`.settled`, :func:`.with_second_order`).

    Parameters
    ----------
    experiment : Experiment
    report : callable, optional
        Called after every round.

    Raises
    ------
    InputError
        As in :func:`.settled`.
    """
    start = Around(experiment.data)
    found = experiment.inference or rounds.settled(experiment.setup, start, report=report)
    return with_second_order(experiment.setup, with_other_modes(experiment.setup, found))


def program_pieces(experiment: Experiment) -> dict[str, Callable[[], Any]]:
    """Functions that build the pieces of an experiment that programs can request, by name.

    When called, a function raises InputError for a systematic that the scenario also marginalises.
    """
    setup, data = experiment.setup, experiment.data

    def require_free(cls: type[Systematic]) -> None:
        if cls.treatment(experiment.scenario) == "marginalised":
            wrong = f"the scenario marginalises this unknown, too; set {cls.key}.treatment=sampled"
            raise InputError(wrong)

    def built(cls: type[Systematic]) -> Systematic:
        if cls.treatment(experiment.scenario) is None:
            raise InputError(f"the scenario has no {cls.key} to sample")
        require_free(cls)
        return cls.build(attrgetter(cls.key)(experiment.scenario), setup, around())

    def instrument() -> Instrument:
        require_free(beam.BeamErrors)
        if not setup.beam_source.parameters():
            raise InputError("the program needs the embedded antennas; remove beam.file")
        return setup.instrument

    @cache
    def around() -> Around:
        # without such values, large offsets are not described, and gains belong to other antennas
        return infer(experiment).around if rounds.rebuilds(setup) else Around(data)

    to_sample = cache(lambda: model_to_sample(setup, around()))
    return {
        "gaussian": lambda: to_sample()[0],
        "systematics": lambda: to_sample()[1],
        "gain_drifts": lambda: built(gain_drifts.GainDrifts),
        "instrument": instrument,
        "sources": lambda: built(sources.PointSources),
        "layout": lambda: data.layout,
    }


def sampled_together(experiment: Experiment) -> dict[str, float]:
    """Octaves over which channels share each sampled site (:meth:`.Systematic.octaves`)."""
    parts = [part for treatment, part in systematics(experiment.setup) if treatment == "sampled"]
    each = [(x.unknowns, x.octaves(attrgetter(x.key)(experiment.scenario))) for x in parts]
    return {unknown.name: octaves for unknowns, octaves in each if octaves for unknown in unknowns}


# number to fold into the seed for posterior draws
DRAWS = 1


def draw_key(scenario: Scenario) -> PRNGKeyArray:
    """The key of a scenario's posterior draws."""
    return jax.random.fold_in(jax.random.key(scenario.seed), DRAWS)


def posterior_draws(
    experiment: Experiment, posterior: Posterior, information: Callable[[], Information], n: int
) -> Draws:
    """Draw skies from the posterior.

    If the prior was learned, its parameters are also drawn (:mod:`.learning`), unless the data do
    not fit: these would make the parameters too certain.

    Parameters
    ----------
    experiment : Experiment
    posterior : Posterior
        The Gaussian posterior.
    information : callable
        ``information()`` of the data, called only if parameters are drawn.
    n : int

    Returns
    -------
    (draws, modes) array
        In K.
    """
    key, learned = draw_key(experiment.scenario), experiment.learned
    if learned is not None and learned.settled and learned.noise_factor == 1.0:
        return draws_with_parameters(experiment.setup.family, learned, information(), key, n)
    return posterior.sample(key, n)


# rms error of interpolated beams in the data, over radiometer noise, above which to warn
MOST_OFF = 0.1
# largest part of a lunar rotation without data, beyond which a learned prior may be too narrow
MOST_MISSING = 0.3


def interpolation_error(setup: Setup) -> dict[str, float]:
    """RMS error of interpolated beams in the model sky's data, over the radiometer noise.

    Returns the largest error at each place, such as "zenith_angle_deg 75"
    (:meth:`.BeamSource.interpolation_errors`); empty if beams are not interpolated in parameters.
    """
    std = np.sqrt(np.asarray(radiometer(setup).diagonal()))
    off = setup.beam_source.interpolation_errors(setup.frequency_mhz, setup.scenario.lmax)

    def rms(modes: np.ndarray) -> float:
        seen = setup.coupling.of(modes=modes) @ setup.sky.modes
        return float(np.sqrt(np.mean((seen / std) ** 2)))

    return {where: max(map(rms, lines)) for where, lines in off.items()}


def doubts(experiment: Experiment, inference: rounds.Inference) -> tuple[str, ...]:
    """Doubts about an experiment's data, its prior and its rounds."""
    learned, notes = experiment.learned, list(experiment.doubts)
    errors = interpolation_error(experiment.setup)
    worst = max(errors, key=errors.__getitem__, default="")
    if worst and errors[worst] > MOST_OFF:
        notes.append(
            f"Beams interpolated between the files of {experiment.scenario.beam.label} may be "
            f"wrong by up to {errors[worst]:.2g} radiometer standard deviations (rms), tested by "
            f"omitting the files of {worst}; use more files, in smaller steps."
        )
    setup = experiment.setup
    if (size := inference.size_of_fields) > rounds.LARGE:
        percent = 100.0 * size * setup.scenario.noise.fields.std
        notes.append(
            f"The data require field errors of {percent:.2g} %, {size:.2g} times noise.fields.std. "
            "Mistakes look alike: the usual ones were tried."
        )
    for part in inference.moving:
        wider = 1.001 * part.centre
        for k in np.flatnonzero(wider != part.systematic.inside(wider)):
            notes.append(
                f"{part.systematic.names[k]} is held at the end of its range, but data are more "
                "probable beyond it: the errors of the map may not hold. Mistakes can look alike."
            )
    if said := gain_drifts.drift_within(setup.scenario.noise.gain, setup.observation):
        notes.append(f"{said[0].upper()}{said[1:]}.")
    if setup.scenario.noise.radiometer.form == "exact":
        seen = noise_visibilities(setup, inference.around, noise_level.radiometer_about(setup))
        if not (known := np.asarray(of_voltages(seen))).all():
            notes.append(
                f"At {(~known).sum()} of {counted(len(known), 'time')} no voltages of independent "
                "ports have these visibilities; the noise of the products is taken as independent. "
                "Products may be exchanged or wrong, or ports depend on each other (ideal dipoles)."
            )
    if learned is not None and not learned.settled:
        notes.append("The prior is fixed and wide: its parameters do not converge for any noise.")
    elif learned is not None and learned.noise_factor > 1.0:
        factor = f"{learned.noise_factor:.2g}"
        notes.append(f"The prior, but not the map, uses N times {factor}, to match chi2.")
    if learned is not None and not learned.averaged:
        notes.append("The prior has its most probable parameters, too uncertain to be averaged.")
    notes += [
        f"{name} does not agree with the data: ln p(d) is {-gain:.3g} higher without it."
        for name, gain in (() if learned is None else learned.survey_gains)
        if gain < 0.0
    ]
    turned = np.sort(np.asarray(setup.coupling.pointing.azimuth) / (2.0 * np.pi) % 1.0)
    missing = np.diff(turned, append=turned[0] + 1.0).max()
    if learned is not None and not learned.survey_gains and missing > MOST_MISSING:
        notes.append(
            f"{missing:.0%} of a lunar rotation has no data. In tests with 67%, error bars under a "
            "learned prior were 2 times too small at lmax 14, at most 1.4 at lmax 47: raise lmax."
        )
    if learned is not None and learned.still_moves > 0.0:
        moves = f"{learned.still_moves:.2g} of their errors"
        notes.append(f"The prior did not converge: maps move by {moves}.")
    return (*notes, inference.unsettled) if inference.unsettled else tuple(notes)
