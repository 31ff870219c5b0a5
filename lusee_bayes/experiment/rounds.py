"""Inference in rounds: the prior, and N about the map, until neither moves.

N may be built around what the data tell, and the parameters of the prior be told by the data.
Priors also come by name, for a comparison under which of them data are most probable.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from lusee_bayes.core.arrays import DataVector, Grid, Modes, Vector
from lusee_bayes.core.errors import InputError, nearest
from lusee_bayes.core.harmonics import n_modes
from lusee_bayes.core.section import is_modelled
from lusee_bayes.experiment import sky_sections
from lusee_bayes.experiment.model import model_about, moved, with_sky_above
from lusee_bayes.experiment.scenario import Scenario
from lusee_bayes.instrument.visibilities import Visibilities
from lusee_bayes.linear.amplitudes import Amplitudes, template_amplitudes
from lusee_bayes.linear.information import Information, integrated_out
from lusee_bayes.linear.linear_gaussian import FromInformation, LinearGaussian, Solution
from lusee_bayes.linear.posterior import Posterior
from lusee_bayes.noise.covariance import LowRankFactor
from lusee_bayes.priors.families import PriorFamily
from lusee_bayes.priors.learning import Learned, learn_whatever_fits, most_probable
from lusee_bayes.sky.prior import Prior
from lusee_bayes.systematics.above_lmax import AboveLmax
from lusee_bayes.systematics.context import Around, Setup
from lusee_bayes.systematics.gain_drifts import gains_about
from lusee_bayes.systematics.noise_level import radiometer_about
from lusee_bayes.systematics.pointing_offsets import PointingOffsets
from lusee_bayes.systematics.registered import SYSTEMATICS
from lusee_bayes.systematics.systematic import Expanded, Marginalised, Systematic, present

# N is rebuilt until the map moves by less than this (rms, in standard deviations)
SETTLED, MAX_ROUNDS = 1e-2, 30
# no unknown moves further in a round, in prior standard deviations: beyond, the first order that
# the move comes from says little
FARTHEST = 2.0
# while chi^2 of what N is built around is more than TEMPERED per datum, in the first rounds,
# radiometer noise is taken for as much larger
TEMPERED, MAX_TEMPERED_ROUNDS = 10.0, 20
# how much wider than the prior the sky is where all of the data's skies are let in
WIDE = 1e2
# where chi^2 is too large by so many of its standard deviations, even so, as many other ways are
# tried
FAR_OFF, OTHER_WAYS = 10.0, 6
# of so many instruments each other way begins with the likeliest; rounds that leave more than this
# part of what chi^2 is too large by do not lead to one that fits
CANDIDATES, STALLED = 8, 0.5
# so many such rounds one after the other are the last
IDLE = 3
# the part of the values found that these keep, way after way: where most are right, half are the
# quickest, and where they all are wrong, none
KEPT = 0.5, 0.0
# an instrument is found with some of the times first, which have so many data a mode of the sky
ENOUGH = 8
# a prior is learned first when the map moves by less than this, and last when learning it again
# moves the map by less than PRIOR_SETTLED; a step of learning that is not taken moves it by 0.01
NEARLY, PRIOR_SETTLED, MAX_LEARNED = 0.5, 0.05, 8
# draws of noise that the volume of skies that fit is estimated with; always the same ones
VOLUME_DRAWS = 8
# steps that swing about where they lead to are halved, down to this part of the whole
SHORTEST = 0.125


@dataclass(frozen=True)
class Inference:
    """A model solved for the data, and how it was found.

    Attributes
    ----------
    solution : Solution
        Of the model with every systematic in N that the scenario does not ignore.
    systematics : tuple of Marginalised
        Those, as they are in N.
    rounds : int
        How often N was built.
    around : Around
        What it was built around.
    unsettled : str
        A sentence if the map still moves from round to round; empty otherwise.
    learned : Learned or None
        How the prior was learned in these rounds.
    """

    solution: Solution
    systematics: tuple[Marginalised, ...]
    rounds: int
    around: Around
    unsettled: str = ""
    learned: Learned | None = None

    @property
    def model(self) -> LinearGaussian:
        """Of the solution."""
        return self.solution.model

    @property
    def posterior(self) -> Posterior:
        """Of the solution."""
        return self.solution.posterior

    @property
    def expanded(self) -> tuple[Expanded, ...]:
        """What is to first order about values, as it is in N."""
        return tuple(s for s in self.systematics if isinstance(s, Expanded))

    @property
    def moving(self) -> tuple[Expanded, ...]:
        """What is so about values that the data determine."""
        return tuple(s for s in self.expanded if s.systematic.moves)

    @property
    def offsets(self) -> Expanded | None:
        """Of clock and pointing, as they are in N."""
        return next((s for s in self.expanded if isinstance(s.systematic, PointingOffsets)), None)

    def amplitudes(self, part: Expanded) -> Amplitudes:
        """What these data tell of a systematic's unknowns, in prior standard deviations."""
        return template_amplitudes(self.solution, part.columns)

    def misfit(self) -> float:
        """Chi^2 per datum of the sky and the values that N is built around, under the rest of N."""
        factor, solution, noise = self.solution.factor, self.solution, self.model.noise
        residual = solution.data - self.model.predict(self.around.sky)
        if isinstance(factor, LowRankFactor):
            solved = solution.weighted_residual()
            residual = residual - noise.update.root @ (noise.update.root.T @ solved)
            for part in self.expanded:
                shift = part.expected + part.columns.T @ solved - part.centre
                residual = residual + part.columns @ shift
            factor = factor.base
        white = np.asarray(factor.whiten(residual))
        return float(white @ white) / len(white)

    @property
    def excess(self) -> float:
        """How much chi^2 is above its mean; none of larger noise, which says little."""
        tempered = self.around.tempered > 1.0
        return np.nan if tempered else self.solution.chi2 - len(self.solution.data)

    @property
    def remark(self) -> str:
        """Chi^2, for a line on the rounds."""
        larger = " of larger noise" if self.around.tempered > 1.0 else ""
        return f"chi2 {self.solution.chi2:.0f} for {len(self.solution.data)} data{larger}"

    @property
    def fits(self) -> bool:
        """Whether chi^2 does not stand out by far, whatever the prior expects of the sky."""
        n, solution = len(self.solution.data), self.solution
        most = n + FAR_OFF * math.sqrt(2.0 * n)
        if solution.chi2 >= most:
            solution = self.under(self.model.prior.widened(WIDE)).solution
        return solution.chi2 < most

    def moves_from(self, mean: Modes) -> float:
        """By how much the map has moved, or is from the sky that N is built around if that is more.

        Rms, in standard deviations.
        """
        skies = [mean, *([self.around.sky] if self.moving else [])]
        return max(float(self.posterior.rms_shift_from(sky)) for sky in skies)

    def under(self, prior: Prior, learned: Learned | None = None) -> Inference:
        """The same under another prior, one that was learned."""
        solution = self.solution.under(prior)
        return replace(self, solution=_less_moved(solution, self.expanded), learned=learned)


# learns a prior from the information in data, from given parameters on
Learning = Callable[[Information, Float[np.ndarray, " parameters"] | None], Learned]
# is told how many rounds are done, and a remark
Report = Callable[[int, str], None]


def settled(
    setup: Setup,
    data: Visibilities,
    start: Around | None = None,
    learn: Learning | None = None,
    report: Report | None = None,
) -> Inference:
    """Condition the model on data, in as many rounds as its N needs.

    One round, unless a term of N is built around what the data tell: the gains around the
    posterior's own prediction, or the instrument around its sky and values of its own. Then N and
    the map are repeated until the map moves by less than 0.01 standard deviations (rms).

    What is second order in values that are far off may outweigh by orders of magnitude what tells
    two of them apart. Rounds therefore begin with radiometer noise that is larger, so that chi^2
    of what N is built around is 10 per datum, and the sky of each instrument is found anew
    (variable projection: first order in values then has no product with a change of the sky).
    Where data are many, this is done with every so many of the times first.
    Values go part of the way where they would go far, or swing. Where no sky fits at their end,
    whatever the prior expects of it, they begin again, up to six times: where about half of the
    values found, or all, are drawn anew from their prior, with the likeliest of eight such
    instruments. The end of the largest ln p counts.

    Parameters
    ----------
    setup : Setup
    data : Visibilities
    start : Around, optional
        What N is built around in the first round; by default the data and, where the instrument
        is found, the sky of one with these values, or as it is expected.
    learn : callable, optional
        ``learn(information, start)`` learns the prior, in the rounds: first when they have nearly
        settled, last when that moves the map by less than 0.05 standard deviations.
    report : callable, optional
        ``report(rounds, remark)`` is told of every round.

    Returns
    -------
    Inference
        Of the last round. Where the map does not settle in 30 rounds, or no instrument fits and
        rounds lead no nearer to one, ``unsettled`` says so.

    Raises
    ------
    InputError
        If N is not positive definite.
    """
    report = report or (lambda rounds, remark: None)
    start = start or Around(data)
    if start.sky is None:
        if (few := _fewer(setup, data)) is not None:
            inference, step = _nearby(*few, beginning(*few, start.values), report)
            fixed = {
                name
                for s in inference.expanded
                if not s.systematic.moves
                for name in s.systematic.names
            }
            values = (inference.around.values or {}).items()
            start = replace(start, values={n: v for n, v in values if n not in fixed})
        start = beginning(setup, data, start.values)
    inference, step = _nearby(setup, data, start, report)
    moves, n_learned, learned, in_rounds, idle = np.inf, 0, None, rebuilds(setup), 0
    while True:
        last = not in_rounds or inference.rounds >= MAX_ROUNDS or idle == IDLE
        at_rest = moves < SETTLED
        if learn is not None and n_learned < MAX_LEARNED and (at_rest or last or learned is None):
            before = None if learned is None or not learned.settled else learned.parameters
            learned, n_learned = learn(inference.solution.information, before), n_learned + 1
            relearned = inference.under(learned.prior, learned)
            changed, inference = relearned.moves_from(inference.posterior.mean), relearned
            if in_rounds and changed > PRIOR_SETTLED:
                at_rest = False
                inference = replace(relearned, learned=replace(learned, still_moves=changed))
            setup = replace(setup, prior=learned.prior)
        if last or at_rest:
            break
        around, step = _around(setup, inference, step)
        mean, n, as_learned = inference.posterior.mean, inference.rounds + 1, inference.learned
        excess = inference.excess
        del inference  # its N
        inference = replace(_conditioned(setup, data, around, n), learned=as_learned)
        report(inference.rounds, inference.remark)
        moves = inference.moves_from(mean) if around.tempered == 1.0 else np.inf
        hopeless = inference.moving and inference.excess > STALLED * excess and not inference.fits
        idle = idle + 1 if hopeless else 0
    if at_rest or not in_rounds:
        return inference
    keys = [f"{cls.key}.treatment=sampled" for cls in first_order(setup.scenario)]
    advice = f"; use {keys[0]}" if keys else "; use noise.gain.visibilities=model"
    return replace(
        inference,
        unsettled=f"The map did not converge: after {inference.rounds} rounds of updating N, it "
        f"still changes by {moves:.2g} standard deviations{advice}.",
    )


def _fewer(setup: Setup, data: Visibilities) -> tuple[Setup, Visibilities] | None:
    """Every so many of the times, where an instrument is to be found and these are enough."""
    run = setup.observation.run
    stride = len(data.data) // (ENOUGH * setup.prior.size)
    if stride < 2 or not first_order(setup.scenario):
        return None
    keep = (np.arange(len(run)) - np.searchsorted(run, run)) % stride == 0
    return setup.select(keep), data.select(keep)


def _nearby(
    setup: Setup, data: Visibilities, around: Around, report: Report
) -> tuple[Inference, _Step]:
    """Rounds until the map has nearly settled, and where it does not fit, from elsewhere."""
    best, step = _approached(setup, data, around, report)
    for way in range(OTHER_WAYS):
        if best.moving and not best.fits:
            begin = _elsewhere(setup, data, best, way)
            other = _approached(setup, data, begin, report)
            if other[0].posterior.log_evidence > best.posterior.log_evidence:
                best, step = other
    return best, step


def _approached(
    setup: Setup, data: Visibilities, around: Around, report: Report
) -> tuple[Inference, _Step]:
    """Rounds until the map has nearly settled, and the step there."""
    inference, step = _conditioned(setup, data, around, 1), _Step()
    moves, stalled = np.inf if rebuilds(setup) else 0.0, False
    while moves > NEARLY and not stalled and inference.rounds < MAX_TEMPERED_ROUNDS:
        (around, step), exact = _around(setup, inference, step), None
        mean, n, excess = inference.posterior.mean, inference.rounds + 1, inference.excess
        at_rest = step.whole is None or np.abs(step.whole).max() < NEARLY
        if around.tempered > 1.0:
            # what larger noise does not explain leads nowhere from where nothing moves
            stalled = at_rest and not inference.fits
        del inference  # its N
        if around.tempered > 1.0:
            exact = _exact(setup, around)
            around = exact.around
            if at_rest:
                around, exact = replace(around, tempered=1.0), None
        inference = _conditioned(setup, data, around, n, exact)
        report(inference.rounds, inference.remark)
        moved_by = float(inference.posterior.rms_shift_from(mean))
        moves = moved_by if around.tempered == 1.0 else np.inf
        stalled = stalled or (inference.excess > STALLED * excess and not inference.fits)
    return inference, step


def _elsewhere(setup: Setup, data: Visibilities, inference: Inference, way: int) -> Around:
    """Where else rounds may begin: the likeliest of draws, which may keep half of the values."""
    rng, best = np.random.default_rng(way), None
    parts = [part for part in inference.expanded if not part.systematic.learns]
    for _ in range(CANDIDATES):
        values, log_prior = {}, 0.0
        for part in parts:
            drawn = rng.standard_normal(len(part.centre))
            kept = rng.random(len(drawn)) < KEPT[way % len(KEPT)]
            z = np.where(kept, part.centre, drawn)
            values |= part.systematic.in_units(z)
            log_prior -= 0.5 * float(z @ z)
        exact = _exact(setup, Around(data, values=values))
        likely = float(exact.posterior.log_evidence) + log_prior
        if best is None or likely > best[0]:
            best = likely, replace(exact.around, tempered=_tempered(exact.misfit(), 0))
    return best[1]


def _conditioned(
    setup: Setup, data: Visibilities, around: Around, rounds: int, exact: Inference | None = None
) -> Inference:
    """``exact``: the sky if values are these, whose A^T N_0^-1 A serves here, too."""
    model, held = model_about(setup, around)
    if exact is None or exact.solution.matrix is None:
        solution = model.condition(data.data)
    else:
        solution = FromInformation.beside(exact.solution, model).condition(data.data)
    solution = _less_moved(solution, held)
    return Inference(solution, held, rounds, around)


def _less_moved(solution: Solution, held: Sequence[Marginalised]) -> Solution:
    """With chi^2 and evidence as if the prior means of unknowns had not been moved."""
    solved, excess = solution.weighted_residual(), 0.0
    for part in held:
        if isinstance(part, Expanded):
            off = part.columns.T @ solved
            excess += float(off @ off - (off + part.expected) @ (off + part.expected))
    return solution.less(excess)


@dataclass(frozen=True)
class _Step:
    """Of all that moves, from what N is built around to what the data then tell.

    whole : (n,) array, the way there in prior standard deviations, None before the first;
    swing : how much of it is gone unless it is far; size : how much of it is gone
    """

    whole: Vector | None = None
    swing: float = 1.0
    size: float = 1.0

    def after(self, whole: Vector) -> _Step:
        """The next step: a smaller part if it turns back without becoming short."""
        back = (
            self.whole is not None
            and whole @ self.whole < 0.0
            and np.linalg.norm(whole) > np.linalg.norm(self.whole) / 2.0
        )
        swing = max(self.swing / 2.0, SHORTEST) if back else min(2.0 * self.swing, 1.0)
        size = min(swing, FARTHEST / max(float(np.abs(whole).max()), FARTHEST))
        return _Step(whole, swing, size)


def _around(setup: Setup, inference: Inference, step: _Step) -> tuple[Around, _Step]:
    """What the terms of N are built around next, given a posterior, and the step there."""
    around, solution = inference.around, inference.solution
    solved = solution.weighted_residual()
    if inference.moving:
        ways = [s.expected + s.columns.T @ solved - s.centre for s in inference.expanded]
        # where the prior is learned, its widths say nothing of how far the first order reaches
        far = [
            way
            for s, way in zip(inference.expanded, ways, strict=True)
            if s.systematic.moves and not s.systematic.learns
        ]
        step = step.after(np.concatenate(far)) if far else step
        values = {}
        for s, way in zip(inference.expanded, ways, strict=True):
            values |= s.systematic.in_units(s.centre + step.size * way)
            if s.systematic.learns and around.tempered == 1.0:
                amplitudes = inference.amplitudes(s)
                values |= s.systematic.relearned(s.expected + amplitudes.mean, amplitudes.std**2)
        sky = around.sky + step.size * (inference.posterior.mean - around.sky)
        ok = around.tempered == 1.0 and inference.fits
        tempered = 1.0 if ok else _tempered(around.tempered * inference.misfit(), inference.rounds)
        around = replace(around, sky=sky, values=values, tempered=tempered)
        if tempered == 1.0:
            around = replace(around, volume=_volume(solution))
    if rebuilds_visibilities(setup):
        seen = prediction(moved(setup, around.values), inference, solved)
        around = replace(around, visibilities=seen)
    return around, step


def beginning(
    setup: Setup, data: Visibilities, values: Mapping[str, float] | None = None
) -> Around:
    """What N is built around first: the data and, where the instrument is found, a sky.

    That of the instrument with these values, by default as it is expected, with larger noise where
    it does not fit.
    """
    around = Around(data, values=values)
    if not first_order(setup.scenario):
        return around
    exact = _exact(setup, around)
    return replace(exact.around, tempered=_tempered(exact.misfit(), 0))


def _exact(setup: Setup, around: Around) -> Inference:
    """What data tell of the sky if values are these, about that sky."""
    moved_setup = moved(setup, around.values)
    model, held = model_about(moved_setup, replace(around, values=None), moving=False)
    solution = model.condition(around.data.data)
    return Inference(solution, held, 0, replace(around, sky=solution.posterior.mean))


def _tempered(misfit: float, rounds: int) -> float:
    """What radiometer noise is multiplied by; little more than one is not worth a round."""
    tempered = misfit / TEMPERED
    return 1.0 if tempered < 2.0 or rounds >= MAX_TEMPERED_ROUNDS else tempered


def _volume(solution: Solution) -> tuple[Float[np.ndarray, "..."], Float[np.ndarray, "..."]]:
    """:attr:`.Around.volume`."""
    white = np.random.default_rng(0).standard_normal((solution.model.n_data, VOLUME_DRAWS))
    weighted = np.asarray(solution.factor.whiten_transpose(white))
    pulls = np.asarray(solution.model.coupling.transpose_mv(weighted))
    return (solution.covariance @ pulls).T, weighted.T


def rebuilds(setup: Setup) -> bool:
    """Whether some term of N is built around what the data tell."""
    return rebuilds_visibilities(setup) or bool(first_order(setup.scenario))


def first_order(scenario: Scenario) -> tuple[type[Systematic], ...]:
    """Those that are to first order about values that the data tell."""
    return tuple(
        cls
        for cls, section in present(SYSTEMATICS, scenario)
        if cls.treatment(scenario) != "ignored" and cls.in_rounds(section)
    )


def rebuilds_visibilities(setup: Setup) -> bool:
    """Whether gains or radiometer noise are built around the posterior's own prediction."""
    gains = is_modelled(setup.scenario.noise.gain) and gains_about(setup) == "posterior"
    return gains or radiometer_about(setup) == "posterior"


def prediction(setup: Setup, inference: Inference, solved: DataVector) -> Grid:
    """Visibilities of the mean map, with all else that N holds but drifts and noise, in K.

    Parameters
    ----------
    setup : Setup
        Pointed as the data tell.
    inference : Inference
    solved : (data,) array
        N^-1 (d - A m), of the mean map.
    """
    mean = replace(setup.sky, modes=inference.posterior.mean)
    besides = np.zeros(len(solved))
    for part in inference.expanded:
        if not part.changes_coupling:
            besides = besides + part.columns @ (part.columns.T @ solved)
    return setup.under(mean).signal + setup.layout.scatter(besides)


# parameters are learned up to this ell first, in a tenth of the time, where there are more
COARSE_LMAX = 24


def with_learned_prior(
    setup: Setup,
    data: Visibilities,
    earlier: Information | None = None,
    start: Around | None = None,
    report: Report | None = None,
) -> tuple[Setup, Inference]:
    """Learn the prior from data, with all that is in N (:func:`settled`).

    Parameters
    ----------
    setup : Setup
        With a family of priors.
    data : Visibilities
    earlier : Information, optional
        Of earlier data, which are learned from, too.
    start, report : Around and callable, optional
        As of :func:`settled`.

    Returns
    -------
    Setup
        With the prior.
    Inference
        Under that prior, with how it was learned.
    """

    first = None

    def whole(information: Information) -> Information:
        return information if earlier is None else information + earlier

    def learn(information: Information, at: Vector | None) -> Learned:
        return learned_prior(setup, setup.family, whole(information), first if at is None else at)

    if AboveLmax.treatment(setup.scenario) == "marginalised":
        # what is expected above lmax follows from what is learned below
        result = settled(setup, data, start, report=report)
        first, start = first_parameters(setup, whole(result.solution.information)), result.around
        setup = with_sky_above(setup, first)
    result = settled(setup, data, start, learn, report)
    return replace(setup, prior=result.learned.prior), result


def first_parameters(setup: Setup, information: Information) -> Vector | None:
    """Parameters of the setup's family that are learned up to a lower ell, if there are some."""
    scenario, family, seed = setup.scenario, setup.family, setup.scenario.seed
    coarse = family
    if scenario.lmax > COARSE_LMAX:
        coarse = scenario.prior.family(scenario.frequency_mhz, COARSE_LMAX)
        n = n_modes(COARSE_LMAX)
        information = integrated_out(information, n, np.asarray(setup.prior.variance())[n:])
    parameters = most_probable(coarse, information, seed)
    return None if parameters is None else family.start_from(coarse, parameters)


def learned_prior(
    setup: Setup,
    family: PriorFamily,
    information: Information,
    start: Float[np.ndarray, " parameters"] | None = None,
) -> Learned:
    """Learn the prior of a family, up to a lower ell first where there are many.

    Parameters
    ----------
    setup : Setup
        Of the scenario that the family is of.
    family : PriorFamily
    information : Information
        What the data say of the sky.
    start : (parameters,) array, optional
        Where to begin.
    """
    if start is None and setup.scenario.lmax > COARSE_LMAX:
        start = first_parameters(setup, information)
    return learn_whatever_fits(family, information, start, setup.scenario.seed)


# takes C_ell of the scenario's sky, which only simulations know
OF_TRUE_SKY = "isotropic-sky"
NAMED: dict[str, sky_sections.PriorSection] = {
    "isotropic": sky_sections.IsotropicPriorSection(),
    OF_TRUE_SKY: sky_sections.IsotropicPriorSection(spectrum="sky"),
    "local_scales": sky_sections.LocalScalesPriorSection(),
}


def named_priors(
    names: Sequence[str] | None, scenario: Scenario, *, known_sky: bool
) -> dict[str, sky_sections.PriorSection]:
    """Find the sections of priors.

    The scenario's own section is taken where it is of the kind that is named, so that a template
    or an amplitude of its own counts.

    Parameters
    ----------
    names : sequence of str or None
        Two or more of ``isotropic`` (C_ell learned), ``isotropic-sky`` (that of the scenario's
        sky) and ``local_scales``; None for all that can be.
    scenario : Scenario
    known_sky : bool
        Whether the data are of the scenario's sky.

    Raises
    ------
    InputError
        For an unknown name, one that is given twice, fewer than two, and ``isotropic-sky`` where
        the sky is not known.
    """
    if names is None:
        names = [name for name in NAMED if known_sky or name != OF_TRUE_SKY]
    for name in names:
        if name not in NAMED:
            raise InputError(f"--priors: no prior '{name}'; {nearest(name, NAMED)}")
    if len(names) < 2 or len(set(names)) < len(names):
        raise InputError(
            f"--priors {','.join(names)}: give at least two different ones of {', '.join(NAMED)}"
        )
    if OF_TRUE_SKY in names and not known_sky:
        raise InputError(
            f"--priors: {OF_TRUE_SKY} needs C_ell of the scenario's sky, which is unknown for "
            "measured data; omit it, or give --truth if the data were simulated from that sky"
        )
    given, named = scenario.prior, {name: NAMED[name] for name in names}
    # isotropic priors differ in where C_ell comes from
    return {
        name: given if (given.model, given.origin) == (one.model, one.origin) else one
        for name, one in named.items()
    }
