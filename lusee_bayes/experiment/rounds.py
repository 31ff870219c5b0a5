"""Inference in rounds: update the prior, and N around the map, until neither moves.

N may be built around the inference, and the prior's parameters may be learned from the data. This
module also provides priors by name, to compare how probable the data are under each.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from lusee_bayes.core.arrays import DataVector, Grid, Modes, ModesMatrix, Vector
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.harmonics import lmax_of, n_modes
from lusee_bayes.core.section import is_modelled
from lusee_bayes.experiment import sky_sections
from lusee_bayes.experiment.model import base_model, model_about, moved, with_sky_above
from lusee_bayes.experiment.scenario import Scenario, load_scenario
from lusee_bayes.linear.amplitudes import Amplitudes, template_amplitudes, variance_factor
from lusee_bayes.linear.information import Information, integrated_out
from lusee_bayes.linear.linear_gaussian import FromInformation, LinearGaussian, Solution
from lusee_bayes.linear.posterior import Posterior
from lusee_bayes.noise.covariance import LowRankFactor, LowRankUpdate
from lusee_bayes.priors.families import PriorFamily
from lusee_bayes.priors.learning import Learned, averaged_beyond, learn_whatever_fits
from lusee_bayes.sky.prior import IndependentPrior, Prior
from lusee_bayes.systematics import noise_level, registered
from lusee_bayes.systematics.above_lmax import AboveLmax
from lusee_bayes.systematics.context import Around, Setup, Volume
from lusee_bayes.systematics.gain_drifts import GainDrifts, gains_about
from lusee_bayes.systematics.pointing_offsets import PointingOffsets
from lusee_bayes.systematics.systematic import Expanded, Marginalised, Systematic

# N is rebuilt until the map moves by less than this (rms, in standard deviations)
SETTLED, MAX_ROUNDS = 1e-2, 30
# largest move of an unknown in one round, in prior standard deviations: the first order behind a
# longer move is unreliable
FARTHEST = 2.0
# in the first rounds, while chi^2 at the expansion point exceeds TEMPERED per datum, radiometer
# noise is assumed larger to match
TEMPERED, MAX_TEMPERED_ROUNDS = 10.0, 20
# factors that widen the prior to allow any sky: the first under which rounding permits a solution
WIDE = 1e2, 1e1
# if, even then, chi^2 is too large by FAR_OFF of its standard deviations, up to OTHER_WAYS other
# starting points are tried
FAR_OFF, OTHER_WAYS = 10.0, 10
# each other way starts from the likeliest of CANDIDATES instruments; a round has stalled if more
# than this fraction of the excess chi^2 remains after it
CANDIDATES, STALLED = 8, 0.5
# stop after this number of stalled rounds in a row
IDLE = 3
# rounds with larger noise are stuck if it is not halved in PATIENCE rounds; after STUCK such ends,
# no other starting point is tried
PATIENCE, STUCK = 6, 3
# fraction of the current values that these instruments keep, alternating: one half is quickest if
# most values are right, none if all are wrong
KEPT = 0.5, 0.0
# an instrument is first found from some of the times, with this number of data per sky mode
ENOUGH = 8
# a prior is first learned when the map moves by less than NEARLY, and last when learning it again
# moves the map by less than PRIOR_SETTLED; a rejected step of learning moves it by 0.01
NEARLY, PRIOR_SETTLED, MAX_LEARNED = 0.5, 0.05, 8
# number of noise draws, always the same, that estimate the volume of skies that fit, the standard
# errors that the slope must exceed, and the largest modes x unknowns for the exact one
VOLUME_DRAWS, VOLUME_DOUBT, EXACT_VOLUME = 8, 3.0, 1500
# if field errors are larger than expected by these factors, mistakes are tried, and this is said
LARGER, LARGE = 1.25, 3.0
# relative rms by which the visibilities may be off around which drifts of the gains are inferred
SAME_VISIBILITIES = 0.1
# steps that oscillate are halved, down to this fraction of the full step
SHORTEST = 0.125
# prior standard deviation of ln of the variance of the sky above lmax, whose scale is extrapolated
LOG_LEVEL_STD = 0.5


@dataclass(frozen=True)
class Inference:
    """A model solved for the data, and how it was found.

    Attributes
    ----------
    solution : Solution
        For the model with every systematic in N that the scenario does not ignore.
    systematics : tuple of Marginalised
        These systematics as terms of N.
    rounds : int
        Number of times that N was built.
    around : Around
        Expansion point of N.
    unsettled : str
        A sentence if the map still moves from round to round, or there is another one; or empty.
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
        """Model of the solution."""
        return self.solution.model

    @property
    def posterior(self) -> Posterior:
        """Posterior of the solution."""
        return self.solution.posterior

    @property
    def expanded(self) -> tuple[Expanded, ...]:
        """Systematics that are expanded to first order, as terms of N."""
        return tuple(s for s in self.systematics if isinstance(s, Expanded))

    @property
    def moving(self) -> tuple[Expanded, ...]:
        """Systematics that are expanded around values that the data determine."""
        return tuple(s for s in self.expanded if s.systematic.moves)

    @property
    def drifts(self) -> tuple[GainDrifts, ...]:
        """Drifts of the gains in N, if any."""
        return tuple(s.systematic for s in self.systematics if isinstance(s.systematic, GainDrifts))

    @property
    def offsets(self) -> Expanded | None:
        """Clock and pointing offsets, as a term of N."""
        return next((s for s in self.expanded if isinstance(s.systematic, PointingOffsets)), None)

    def amplitudes(self, part: Expanded) -> Amplitudes:
        """Posterior of a systematic's unknowns from these data, in prior standard deviations."""
        return template_amplitudes(self.solution, part.columns)

    @property
    def size_of_fields(self) -> float:
        """Learned size of the fields' errors, over the expected one; 0 if it is not learned."""
        return max((s.systematic.size for s in self.moving if s.systematic.learns), default=0.0)

    def unused(self) -> float:
        """Degrees of freedom that errors of learned size leave unused if there are no errors."""
        learning = (part for part in self.moving if part.systematic.learns)
        return float(sum(np.sum(1.0 - self.amplitudes(part).std ** 2) for part in learning))

    def misfit(self) -> float:
        """Chi^2 per datum of the sky and the values at the expansion point, under the rest of N."""
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
        """Chi^2 minus its mean; NaN if the noise is larger, since chi^2 then means little."""
        tempered = self.around.tempered > 1.0
        return np.nan if tempered else self.solution.chi2 - len(self.solution.data)

    @property
    def remark(self) -> str:
        """Chi^2, for the progress of the rounds."""
        larger = " of larger noise" if self.around.tempered > 1.0 else ""
        return f"chi2 {self.solution.chi2:.0f} for {len(self.solution.data)} data{larger}"

    @property
    def fits(self) -> bool:
        """Whether chi^2 is acceptable, under the prior or one that allows any sky."""
        n, solution = len(self.solution.data), self.solution
        most = n + FAR_OFF * (2.0 * n) ** 0.5
        if solution.chi2 >= most:
            solution = self.under_any_sky()
        return solution.chi2 < most

    def under_any_sky(self) -> Solution:
        """The solution under a prior that allows any sky, as wide as rounding permits."""
        for factor in WIDE:
            with suppress(InputError):
                return self.under(self.model.prior.widened(factor)).solution
        return self.solution

    def moves_from(self, mean: Modes) -> float:
        """Distance of the map from ``mean``, or from the sky at the expansion point if larger.

        Rms, in standard deviations.
        """
        skies = [mean, *([self.around.sky] if self.moving else [])]
        return max(float(self.posterior.rms_shift_from(sky)) for sky in skies)

    def under(self, prior: Prior, learned: Learned | None = None) -> Inference:
        """The inference under another prior, with how it was learned."""
        solution = self.solution.under(prior)
        return replace(self, solution=less_moved(solution, self.systematics), learned=learned)


# learns a prior from an inference, starting at given parameters
Learning = Callable[[Inference, Vector | None], Learned]
# receives the number of rounds done, and a remark
Report = Callable[[int, str], None]


def settled(
    setup: Setup, start: Around, learn: Learning | None = None, report: Report | None = None
) -> Inference:
    """Condition the model on data, in as many rounds as its N needs.

    One round is enough, unless a term of N is built around the inference: the gains around the
    posterior's prediction, or the instrument around its inferred sky and values. Then N and the map
    are recomputed until the map moves by less than 0.01 standard deviations (rms).

    If values are far off, their second order may exceed, by orders of magnitude, the signal that
    distinguishes them. Rounds therefore start with larger radiometer noise, so that chi^2 at the
    expansion point is 10 per datum, and solve for the sky of each instrument (variable projection:
    the first order in values then has no product with a change of the sky). With many data, this is
    first done with a regular subset of the times. Values move only part of the way if the step is
    long or oscillates. If no sky fits at the end, under any prior, the rounds restart up to ten
    times, but not after three ends that are stuck far from any fit (of the subset only: if some
    data do not fit, neither do all): about half of the values, or all, are drawn again from their
    prior, and the likeliest of eight such instruments is the start. The result with the largest
    ln p counts.

    Parameters
    ----------
    setup : Setup
    start : Around
        The data, and the expansion point of N in the first round. If the instrument is inferred and
        no sky is given, the sky is solved for the given or else the expected values. If ``still``,
        the first round is the last.
    learn : callable, optional
        ``learn(inference, start)`` learns the prior during the rounds: first when they have
        nearly converged, last when it moves the map by less than 0.05 standard deviations.
    report : callable, optional
        ``report(rounds, remark)`` is called after every round.

    Returns
    -------
    Inference
        Result of the last round. ``unsettled`` explains if the map does not converge in 30 rounds,
        or if no instrument fits and further rounds do not help.

    Raises
    ------
    InputError
        If N is not positive definite.
    """
    # a start with a sky is the result of other rounds
    report, ways = report or (lambda rounds, remark: None), OTHER_WAYS * (start.sky is None)
    if start.sky is None:
        if not start.still and (few := _fewer(setup, start)) is not None:
            inference, step = _nearby(few[0], _beginning(*few), report, ways)
            # if some of the data do not fit, neither do all
            ways = OTHER_WAYS if inference.fits else 0
            terms = (s.systematic for s in inference.expanded)
            fixed = {name for one in terms if not one.moves for name in one.names}
            values = (inference.around.values or {}).items()
            start = replace(start, values={n: v for n, v in values if n not in fixed})
        start = _beginning(setup, start)
    inference, step = _nearby(setup, start, report, ways)
    in_rounds = rebuilds(setup) and not start.still
    moves, n_learned, learned, idle = np.inf, 0, None, 0
    while True:
        last = not in_rounds or inference.rounds >= MAX_ROUNDS or idle == IDLE
        at_rest = moves < SETTLED
        if learn is not None and n_learned < MAX_LEARNED and (at_rest or last or learned is None):
            before = None if learned is None or not learned.settled else learned.parameters
            learned, n_learned = learn(inference, before), n_learned + 1
            relearned = inference.under(learned.prior, learned)
            changed, inference = relearned.moves_from(inference.posterior.mean), relearned
            if in_rounds and changed > PRIOR_SETTLED:
                at_rest = False
                inference = replace(relearned, learned=replace(learned, still_moves=changed))
            setup = replace(setup, prior=learned.prior)
        if last or at_rest:
            break
        around, step, _ = _around(setup, inference, step)
        mean, n, as_learned = inference.posterior.mean, inference.rounds + 1, inference.learned
        excess = inference.excess
        del inference  # its N
        # with A^T N_0^-1 A anew: differences of such matrices lose digits
        inference = replace(_conditioned(setup, around, n, None), learned=as_learned)
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


def _fewer(setup: Setup, start: Around) -> tuple[Setup, Around] | None:
    """The same at a regular subset of times that suffices to find the instrument, or None."""
    run, data = setup.observation.run, start.data
    stride = len(data.data) // (ENOUGH * setup.prior.size)
    if stride < 2 or not first_order(setup.scenario):
        return None
    keep = (np.arange(len(run)) - np.searchsorted(run, run)) % stride == 0
    return setup.select(keep), replace(start, data=data.select(keep))


def _nearby(setup: Setup, around: Around, report: Report, ways: int) -> tuple[Inference, _Step]:
    """Run rounds until the map has nearly converged; while it does not fit, restart elsewhere."""
    best, step = approached(setup, around, report)
    stuck = int(best.around.tempered > 1.0)
    for way in range(ways):
        if best.moving and not (around.still or best.fits) and stuck < STUCK:
            other = approached(setup, _elsewhere(setup, best, way), report)
            stuck += other[0].around.tempered > 1.0
            if other[0].posterior.log_evidence > best.posterior.log_evidence:
                best, step = other
    return best, step


def approached(setup: Setup, around: Around, report: Report) -> tuple[Inference, _Step]:
    """Run rounds until the map has nearly converged; also return the last step."""
    inference, step, factors = _conditioned(setup, around, 1, None), _Step(), []
    moves, stalled = np.inf if rebuilds(setup) and not around.still else 0.0, False
    while moves > NEARLY and not stalled and inference.rounds < MAX_TEMPERED_ROUNDS:
        around, step, exact = _around(setup, inference, step)
        mean, n, excess = inference.posterior.mean, inference.rounds + 1, inference.excess
        at_rest = step.whole is None or np.abs(step.whole).max() < NEARLY
        # at rest, a misfit that larger noise does not explain will not improve
        stalled = around.tempered > 1.0 and at_rest and not inference.fits
        del inference  # its N
        if around.tempered > 1.0:
            factors.append(around.tempered)
            stalled = stalled or factors[-1] > STALLED * min(factors[:-PATIENCE], default=np.inf)
            exact = solved_at(setup, around)
            around = exact.around
            if at_rest:
                around, exact = replace(around, tempered=1.0), None
        inference = _conditioned(setup, around, n, exact)
        report(inference.rounds, inference.remark)
        moved_by = float(inference.posterior.rms_shift_from(mean))
        moves = moved_by if around.tempered == 1.0 else np.inf
        stalled = stalled or (inference.excess > STALLED * excess and not inference.fits)
    return inference, step


def _elsewhere(setup: Setup, inference: Inference, way: int) -> Around:
    """Another starting point: the likeliest of several draws, which may keep half of the values."""
    rng, best = np.random.default_rng(way), None
    parts = [part for part in inference.expanded if not part.systematic.learns]
    for _ in range(CANDIDATES):
        values, log_prior = {}, 0.0
        for part in parts:
            drawn = rng.standard_normal(len(part.centre))
            z = np.where(rng.random(len(drawn)) < KEPT[way % len(KEPT)], part.centre, drawn)
            z = part.systematic.inside(z)
            values |= part.systematic.in_units(z)
            log_prior -= 0.5 * float(z @ z)
        exact = solved_at(setup, Around(inference.around.data, values=values))
        likely = float(exact.posterior.log_evidence) + log_prior
        if best is None or likely > best[0]:
            best = likely, replace(exact.around, tempered=_tempered(exact.misfit(), 0))
    return best[1]


def _conditioned(setup: Setup, around: Around, rounds: int, exact: Inference | None) -> Inference:
    """Solve one round; ``exact``, the solution at these values, supplies A^T N_0^-1 A for reuse."""
    model, held = model_about(setup, around)
    if exact is None or exact.solution.matrix is None:
        solution = model.condition(around.data.data)
    else:
        solution = FromInformation.beside(exact.solution, model).condition(around.data.data)
    return Inference(less_moved(solution, held), held, rounds, around)


def less_moved(solution: Solution, held: Sequence[Marginalised]) -> Solution:
    """Correct chi^2 and evidence for the moved prior means of unknowns."""
    solved, excess = solution.weighted_residual(), 0.0
    for part in held:
        if isinstance(part, Expanded):
            off = part.columns.T @ solved
            excess += float(off @ off - (off + part.expected) @ (off + part.expected))
        elif isinstance(part.systematic, GainDrifts):
            excess += part.systematic.inferred(solved)[1]
    return solution.less(excess)


@dataclass(frozen=True)
class _Step:
    """The step of all moving values, from the expansion point towards the new posterior.

    whole : (n,) array, the full step in prior standard deviations, None before the first;
    swing : the fraction to move unless the step is long; size : the fraction to move
    """

    whole: Vector | None = None
    swing: float = 1.0
    size: float = 1.0

    def after(self, whole: Vector) -> _Step:
        """The next step: a smaller fraction if it reverses without getting much shorter."""
        back = (
            self.whole is not None
            and whole @ self.whole < 0.0
            and np.linalg.norm(whole) > np.linalg.norm(self.whole) / 2.0
        )
        swing = max(self.swing / 2.0, SHORTEST) if back else min(2.0 * self.swing, 1.0)
        return _Step(whole, swing, min(swing, FARTHEST / max(float(np.abs(whole).max()), FARTHEST)))


def _around(
    setup: Setup, inference: Inference, step: _Step
) -> tuple[Around, _Step, Inference | None]:
    """The next expansion point of N, the step to it, and the sky of its instrument if computed."""
    around, solution = inference.around, inference.solution
    solved = solution.weighted_residual()
    if inference.moving:
        ends = [(s, s.expected + s.columns.T @ solved) for s in inference.expanded]
        ways = [(s, s.systematic.inside(end) - s.centre) for s, end in ends]
        # learned prior widths indicate least how far the first order is valid
        moving = [(s.systematic.learns, way) for s, way in ways if s.systematic.moves]
        far = [way for learns, way in moving if not learns] or [way for _, way in moving]
        step, values = step.after(np.concatenate(far)), {}
        for s, way in ways:
            values |= s.systematic.in_units(s.centre + step.size * way)
            if s.systematic.learns and around.tempered == 1.0:
                amplitudes = inference.amplitudes(s)
                values |= s.systematic.relearned(s.expected + amplitudes.mean, amplitudes.std**2)
        sky = around.sky + step.size * (inference.posterior.mean - around.sky)
        ok = around.tempered == 1.0 and inference.fits
        tempered = 1.0 if ok else _tempered(around.tempered * inference.misfit(), inference.rounds)
        around = replace(around, sky=sky, values=values, tempered=tempered)
    if rebuilds_visibilities(setup):
        seen = prediction(moved(setup, around.values), inference, solved)
        around = replace(around, visibilities=seen)
        for drifts in inference.drifts:
            off = np.linalg.norm(seen - drifts.visibilities) / np.linalg.norm(seen)
            gains = slope = None
            if off < SAME_VISIBILITIES:
                gains = drifts.inferred(solved)[0]
                slope = drifts.volume_slope(solution, _volume(solution))
            around = replace(around, gains=gains, gain_slope=slope)
    if around.tempered > 1.0 or not inference.moving:
        return around, step, None
    # with the unknowns at these values: the sky that they would hide scatters without bound
    exact = solved_at(setup, around)
    n_unknowns = sum(len(part.centre) for part in inference.expanded)
    return replace(around, volume=_volume(exact.solution, n_unknowns)), step, exact


def _beginning(setup: Setup, around: Around) -> Around:
    """The first expansion point of N: the data and, if the instrument is inferred, a sky.

    The sky is solved for the instrument with these values (default: the expected ones). The noise
    is increased if it does not fit.
    """
    if not first_order(setup.scenario):
        return around
    exact, rounds = solved_at(setup, around), MAX_TEMPERED_ROUNDS * around.still
    return replace(exact.around, tempered=_tempered(exact.misfit(), rounds))


def solved_at(setup: Setup, around: Around) -> Inference:
    """Infer the sky with the instrument fixed at these values, and expand around that sky."""
    moved_setup = moved(setup, around.values)
    model, held = model_about(moved_setup, replace(around, values=None), moving=False)
    solution = model.condition(around.data.data)
    return Inference(solution, held, 0, replace(around, sky=solution.posterior.mean))


def _tempered(misfit: float, rounds: int) -> float:
    """Factor of radiometer noise; a factor below two is not worth a round."""
    tempered = misfit / TEMPERED
    return 1.0 if tempered < 2.0 or rounds >= MAX_TEMPERED_ROUNDS else tempered


def _volume(solution: Solution, n_unknowns: float | int = np.inf) -> Volume:
    """:attr:`.Around.volume`: exact for a small problem."""
    if (n := solution.model.prior.size) * n_unknowns <= EXACT_VOLUME:
        root = np.asarray(solution.posterior.root())
        seen = np.asarray(solution.factor.solve(solution.model.coupling.dense() @ root))
        return root.T, n * seen.T, 0.0
    white = np.random.default_rng(0).standard_normal((solution.model.n_data, VOLUME_DRAWS))
    weighted = np.asarray(solution.factor.whiten_transpose(white))
    pulls = np.asarray(solution.model.coupling.transpose_mv(weighted))
    return (solution.covariance @ pulls).T, weighted.T, VOLUME_DOUBT


def rebuilds(setup: Setup) -> bool:
    """Whether any term of N is built around the inference, or of a prior that is learned."""
    error = setup.scenario.noise.beam
    of_prior = setup.family is not None and is_modelled(error) and not error.parameters
    return rebuilds_visibilities(setup) or bool(first_order(setup.scenario)) or of_prior


def first_order(scenario: Scenario) -> tuple[type[Systematic], ...]:
    """Systematics that are expanded to first order around values inferred from the data."""
    return tuple(
        cls
        for cls, section in registered.present(scenario)
        if cls.treatment(scenario) != "ignored" and cls.in_rounds(section)
    )


def as_expected(setup: Setup) -> Setup:
    """The same with these systematics ignored: the instrument keeps its expected values."""
    ignored = [f"{cls.key}.treatment=ignored" for cls in first_order(setup.scenario)]
    return replace(setup, scenario=load_scenario(setup.scenario, ignored))


def rebuilds_visibilities(setup: Setup) -> bool:
    """Whether gains or radiometer noise are built around the posterior's prediction."""
    gains = is_modelled(setup.scenario.noise.gain) and gains_about(setup) == "posterior"
    return gains or noise_level.radiometer_about(setup) == "posterior"


def prediction(setup: Setup, inference: Inference, solved: DataVector) -> Grid:
    """Visibilities of the mean map and of all terms of N except drifts and noise, in K.

    Parameters
    ----------
    setup : Setup
        With the inferred pointing.
    inference : Inference
    solved : (data,) array
        N^-1 (d - A m) of the mean map.
    """
    mean = replace(setup.sky, modes=inference.posterior.mean)
    noise, besides = inference.model.noise, np.zeros(len(solved))
    if isinstance(noise, LowRankUpdate):
        # without the values that are part of the setup
        signed = [(1.0, np.asarray(noise.update.root))]
        signed += [(-1.0, part.columns) for part in inference.expanded if part.changes_coupling]
        besides = sum((sign * (t @ (t.T @ solved)) for sign, t in signed), start=besides)
    for drifts in inference.drifts:
        besides = besides / np.asarray(drifts.response(drifts.about))
    return setup.under(mean).signal + setup.layout.scatter(besides)


# largest factor of N under which the sky above lmax is learned
MOST_RAISED = 10.0
# a learned sky above lmax is not used if it makes ln p(d) lower by more than this
LEAST_WORSE = 5.0
# a larger problem first learns its parameters up to this ell, in a tenth of the time
COARSE_LMAX = 24


def with_learned_prior(
    setup: Setup, start: Around, earlier: Information | None, report: Report | None
) -> tuple[Setup, Inference]:
    """Learn the prior from data, with all terms of N (:func:`settled`).

    Parameters
    ----------
    setup : Setup
        With a family of priors.
    start : Around
        As in :func:`settled`, with the data.
    earlier : Information or None
        Information in earlier data, from which the prior is also learned (:func:`of_whole_sky`).
    report : callable or None
        As in :func:`settled`.

    Returns
    -------
    Setup
        With the learned prior.
    Inference
        Under that prior, with how it was learned.
    """

    first, surveys = None, setup.scenario.prior.surveys

    def whole(inference: Inference) -> Information:
        if earlier is None:
            return inference.solution.information
        return of_map(setup, of_whole_sky(setup, inference) + earlier)

    def learn(inference: Inference, at: Vector | None) -> Learned:
        return learned_prior(setup, whole(inference), first if at is None else at)

    if AboveLmax.treatment(setup.scenario) in ("marginalised", "sampled"):
        # the expected sky above lmax follows from the prior learned below
        result = settled(setup, start, report=report)
        # a survey's resolution ends somewhere: what is above it is as strong as without surveys
        plain = _with_surveys(setup, ()) if surveys else setup
        coarse, learned = first_learned(plain, whole(result))
        start = result.around
        # data that do not fit say nothing about the sky above lmax
        if learned.settled and learned.noise_factor < MOST_RAISED and not start.still:
            family = setup.above.family
            if surveys:
                top = setup.scenario.noise.above_lmax.top(setup.scenario.lmax)
                as_strong = plain.scenario.prior.family(setup.frequency_mhz, top)
                family = replace(as_strong, mean=family.mean, wide=family.wide)
            else:
                first = setup.family.start_from(coarse, learned.parameters)
            covariance = averaged_beyond(family, coarse, learned.scores)
            setup = _with_learned_sky_above(setup, covariance, start)
    result = settled(setup, start, learn, report)
    if surveys:
        result = replace(result, learned=_compared_surveys(setup, whole(result), result.learned))
    return replace(setup, prior=result.learned.prior), result


def _with_learned_sky_above(setup: Setup, covariance: ModesMatrix, around: Around) -> Setup:
    """Set the expected sky above lmax, at the level that the data themselves suggest.

    It stays as it was if the data are less probable with the learned one: what scales above lmax
    need not follow from those below.
    """
    n = setup.prior.size
    prior = setup.family.prior(covariance[:n, :n])

    def under(setup: Setup) -> Inference:
        return _conditioned(replace(setup, prior=prior), around, 1, None)

    new = with_sky_above(setup, covariance, around.values)
    found = under(new)
    (term,) = (s.systematic for s in found.systematics if isinstance(s.systematic, AboveLmax))
    level = variance_factor(template_amplitudes(found.solution, term.root), LOG_LEVEL_STD)
    above, root = new.above, new.above.root * np.sqrt(level)
    more = {"covariance": above.covariance * level, "power": above.power * level}
    new = replace(new, above=replace(above, root=root, **more))
    before, after = (float(under(one).posterior.log_evidence) for one in (setup, new))
    return new if after > before - LEAST_WORSE else setup


def model_of_whole_sky(setup: Setup, inference: Inference) -> LinearGaussian | None:
    """The model with the sky above lmax among its unknowns; None if it is not in N.

    They are skies minus :func:`expected_sky`, independent a priori.
    """
    parts = inference.systematics
    held = [part for part in parts if not isinstance(part.systematic, AboveLmax)]
    if len(held) == len(parts):
        return None
    above = moved(setup, inference.around.values, above=True).above
    model = base_model(setup, inference.around)
    for part in held:
        model = part.marginalised(model)
    std = np.sqrt(np.append(setup.prior.variance(), np.diagonal(above.covariance)))
    coupling = replace(above.coupling, response=inference.model.coupling.response)
    offset = coupling @ expected_sky(setup) + (0.0 if model.offset is None else model.offset)
    return LinearGaussian(coupling, IndependentPrior(std), model.noise, offset)


def expected_sky(setup: Setup) -> Modes:
    """The prior mean of the map's modes and, if the model has them, of those above lmax, in K."""
    prior, above = setup.prior, setup.above
    mean = np.zeros(prior.size) if prior.mean is None else np.asarray(prior.mean)
    return mean if above is None else np.append(mean, above.mean[prior.size :])


def of_whole_sky(setup: Setup, inference: Inference) -> Information:
    """Information in the data about the map's modes and those above lmax, if these are in N."""
    model, solution = model_of_whole_sky(setup, inference), inference.solution
    if model is None:
        return solution.information
    sky = expected_sky(setup)
    departure = np.append(solution.posterior.mean, sky[setup.prior.size :]) - sky
    information = FromInformation.of(model).about(solution.data, departure)
    misfit = np.asarray(information.misfit - solution.excess)
    return replace(information, misfit=misfit, reference=sky + departure)


def of_map(setup: Setup, information: Information) -> Information:
    """The same about the map's modes alone; those above lmax have the setup's covariance."""
    if information.n_modes == (n := setup.prior.size):
        return information
    return integrated_out(information, n, setup.above.covariance, setup.above.mean[n:])


def _compared_surveys(setup: Setup, information: Information, learned: Learned) -> Learned:
    """Add scale and zero level of every survey, and how much it alone increases ln p(d)."""
    n = information.n_modes

    def under(*surveys: sky_sections.SurveySection) -> tuple[PriorFamily, Learned]:
        changed = _with_surveys(setup, surveys)
        return changed.family, learned_prior(changed, information)

    _, alone = under()
    fitting = information.raised(alone.noise_factor)
    others = fitting.posterior(alone.prior)
    rows, gains = [], []
    for one in setup.scenario.prior.surveys:
        family, known = under(one)
        start = known.parameters if known.settled else family.hyperprior.start()
        survey = one.at(setup.frequency_mhz, lmax_of(n))
        # all by which the sky may depart from the survey, but its scale and its zero level
        errors = family.at(start).covariance - family.wide[:, :2] @ family.wide[:, :2].T
        rows += survey.calibrated(others.mean, others.covariance(), errors)
        gained = fitting.posterior(known.prior).log_evidence - others.log_evidence
        gains.append((survey.name, float(gained)))
    return replace(learned, survey_rows=tuple(rows), survey_gains=tuple(gains))


def _with_surveys(setup: Setup, surveys: Sequence[sky_sections.SurveySection]) -> Setup:
    """Change the surveys of a setup's prior, before anything is learned."""
    return setup.with_prior(setup.scenario.prior.model_copy(update={"surveys": tuple(surveys)}))


def first_learned(setup: Setup, information: Information) -> tuple[PriorFamily, Learned]:
    """Learn the parameters of the setup's family up to a lower ell; also return that family."""
    scenario, prior, family = setup.scenario, setup.prior, setup.family
    if scenario.lmax > COARSE_LMAX:
        family = scenario.prior.family(scenario.frequency_mhz, COARSE_LMAX)
        n = n_modes(COARSE_LMAX)
        mean = None if prior.mean is None else np.asarray(prior.mean)[n:]
        information = integrated_out(information, n, np.asarray(prior.variance())[n:], mean)
    return family, learn_whatever_fits(family, information, None, scenario.seed)


def learned_prior(setup: Setup, information: Information, start: Vector | None = None) -> Learned:
    """Learn the prior of the setup's family; if lmax is high, first up to a lower ell.

    Parameters
    ----------
    setup : Setup
        With a family of priors.
    information : Information
        The data's information about the sky.
    start : (parameters,) array, optional
        Starting point.
    """
    if start is None and setup.scenario.lmax > COARSE_LMAX:
        coarse, learned = first_learned(setup, information)
        start = setup.family.start_from(coarse, learned.parameters) if learned.settled else None
    return learn_whatever_fits(setup.family, information, start, setup.scenario.seed)
