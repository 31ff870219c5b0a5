"""Inference in rounds: the prior, and N about the map, until neither moves.

N may be built around what the data tell, and the parameters of the prior be told by the data.
Priors also come by name, for a comparison under which of them data are most probable.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from lusee_bayes.core.arrays import DataVector, Grid, Vector
from lusee_bayes.core.errors import InputError, nearest
from lusee_bayes.core.harmonics import n_modes
from lusee_bayes.core.section import is_modelled
from lusee_bayes.experiment import sky_sections
from lusee_bayes.experiment.model import full_model, model_about, moved
from lusee_bayes.experiment.scenario import Scenario
from lusee_bayes.instrument.visibilities import Visibilities
from lusee_bayes.linear.amplitudes import Amplitudes, template_amplitudes
from lusee_bayes.linear.information import Information, integrated_out
from lusee_bayes.linear.linear_gaussian import FromInformation, LinearGaussian, Solution
from lusee_bayes.linear.posterior import Posterior
from lusee_bayes.priors.families import PriorFamily
from lusee_bayes.priors.learning import Learned, learn_whatever_fits
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
    """

    solution: Solution
    systematics: tuple[Marginalised, ...]
    rounds: int
    around: Around
    unsettled: str = ""

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


def settled(
    setup: Setup, data: Visibilities, start: Around | None = None, known: Solution | None = None
) -> Inference:
    """Condition the model on data, in as many rounds as its N needs.

    One round, unless a term of N is built around what the data tell: the gains around the
    posterior's own prediction, or clock, pointing and gain table around its sky and their own
    values. Then N and the map are repeated until the map moves by less than 0.01 standard
    deviations (rms). Those values go part of the way where they would go far, or swing: what is
    second order in them may outweigh what tells two of them apart.

    Parameters
    ----------
    setup : Setup
    data : Visibilities
    start : Around, optional
        What N is built around in the first round; by default the data.
    known : Solution, optional
        Of the data under another prior, where N is built once.

    Returns
    -------
    Inference
        Of the last round. Where the map does not settle in 30 rounds, ``unsettled`` says so.

    Raises
    ------
    InputError
        If N is not positive definite.
    """

    def conditioned(around: Around, rounds: int) -> Inference:
        model, found = model_about(setup, around)
        solution = model.condition(data.data) if known is None else known.under(model.prior)
        solved, excess = solution.weighted_residual(), 0.0
        for part in found:
            if isinstance(part, Expanded):
                off = part.columns.T @ solved
                excess += float(off @ off - (off + part.expected) @ (off + part.expected))
        return Inference(solution.less(excess), found, rounds, around)

    found = conditioned(start or _start(setup, data), 1)
    if not rebuilds(setup):
        return found
    step = _Step()
    for rounds in range(2, MAX_ROUNDS + 1):
        around, step = _around(setup, found, step)
        before, found = found, conditioned(around, rounds)
        if float(found.posterior.rms_shift_from(before.posterior)) < SETTLED * step.size:
            return found
    moves = float(found.posterior.rms_shift_from(before.posterior))
    remedies = [cls.remedy for cls in first_order(setup)]
    remedies += ["noise.gain.visibilities=model"] * rebuilds_gains(setup)
    unsettled = (
        f"The map still moves by {moves:.2g} of its standard deviations after {MAX_ROUNDS} rounds "
        "of rebuilding N around it"
    )
    return replace(found, unsettled=f"{'; use '.join([unsettled, *remedies[:1]])}.")


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


def _around(setup: Setup, found: Inference, step: _Step) -> tuple[Around, _Step]:
    """What the terms of N are built around next, given a posterior, and the step there."""
    visibilities, sky, values, volume = None, None, None, None
    solution = found.solution
    solved = solution.weighted_residual()
    if found.moving:
        ways = [s.expected + s.columns.T @ solved - s.centre for s in found.expanded]
        # where the prior is learned, its widths say nothing of how far the first order reaches
        far = [
            way
            for s, way in zip(found.expanded, ways, strict=True)
            if s.systematic.moves and not s.systematic.learns
        ]
        step = step.after(np.concatenate(far)) if far else step
        values = {}
        for s, way in zip(found.expanded, ways, strict=True):
            values |= s.systematic.in_units(s.centre + step.size * way)
            if s.systematic.learns:
                told = found.amplitudes(s)
                values |= s.systematic.relearned(s.expected + told.mean, told.std**2)
        here = np.asarray(setup.sky.modes if found.around.sky is None else found.around.sky)
        sky = here + step.size * (found.posterior.mean - here)
        white = np.random.default_rng(0).standard_normal((found.model.n_data, VOLUME_DRAWS))
        weighted = np.asarray(solution.factor.whiten_transpose(white))
        skies = solution.covariance @ np.asarray(found.model.coupling.transpose_mv(weighted))
        volume = skies.T, weighted.T
    if rebuilds_visibilities(setup):
        visibilities = prediction(moved(setup, values), found, solved)
    around = replace(found.around, visibilities=visibilities, sky=sky, values=values)
    return replace(around, volume=volume), step


def _start(setup: Setup, data: Visibilities) -> Around:
    """What N is built around first: the data and, with a gain table, the sky of one that is exact.

    About a sky that is far from the data's, what one table does looks like what skies do.
    """
    around = Around(data)
    if not setup.measured or not any(cls.scales_sky for cls in first_order(setup)):
        return around
    model, _ = model_about(setup, around, scaling=False)
    return Around(data, sky=model.condition(data.data).posterior.mean)


def rebuilds(setup: Setup) -> bool:
    """Whether some term of N is built around what the data tell."""
    return rebuilds_visibilities(setup) or bool(first_order(setup))


def first_order(setup: Setup) -> tuple[type[Systematic], ...]:
    """Those that are to first order about values that the data tell."""
    return tuple(
        cls
        for cls, section in present(SYSTEMATICS, setup.scenario)
        if cls.treatment(setup.scenario) != "ignored" and cls.in_rounds(section)
    )


def rebuilds_gains(setup: Setup) -> bool:
    """Whether the gain term is built around the posterior's own prediction."""
    return is_modelled(setup.scenario.noise.gain) and gains_about(setup) == "posterior"


def rebuilds_visibilities(setup: Setup) -> bool:
    """Whether gains or radiometer noise are built around the posterior's own prediction."""
    return rebuilds_gains(setup) or radiometer_about(setup) == "posterior"


def prediction(setup: Setup, found: Inference, solved: DataVector) -> Grid:
    """Visibilities of the mean map, with all else that N holds but drifts and noise, in K.

    Parameters
    ----------
    setup : Setup
        Pointed as the data tell.
    found : Inference
    solved : (data,) array
        N^-1 (d - A m), of the mean map.
    """
    mean = replace(setup.sky, modes=found.posterior.mean)
    besides = np.zeros(len(solved))
    for part in found.expanded:
        if not part.changes_coupling:
            besides = besides + part.columns @ (part.columns.T @ solved)
    return setup.under(mean).signal + setup.layout.scatter(besides)


# the map and its prior are found together when the map moves by less than this, rms; a step of
# learning that is not taken moves it by a hundredth
PRIOR_SETTLED, MAX_PRIOR_ROUNDS = 0.05, 8
# parameters are learned up to this ell first, in a tenth of the time, where there are more
COARSE_LMAX = 24


def with_learned_prior(
    setup: Setup, data: Visibilities, earlier: Information | None = None
) -> tuple[Setup, Learned, Around | None, Solution | None]:
    """Learn the prior from data.

    Systematics are in N as far as they are marginalised. Where N is built around what the data
    tell, learning takes part in the rounds: N under the prior so far, the prior under this N, and
    so on, until the map moves by less than 0.05 standard deviations (rms).

    Parameters
    ----------
    setup : Setup
        With a family of priors.
    data : Visibilities
    earlier : Information, optional
        Of earlier data, which are learned from, too.

    Returns
    -------
    Setup
        With the prior.
    Learned
        How it was learned.
    Around or None
        What N was built around in the last round; None where that is the data alone.
    Solution or None
        Of these data under the prior before them, where N is built once.
    """
    if not rebuilds(setup):
        solution = about_sky(setup, data)
        learned = learned_prior(setup, setup.family, _with_more(solution.information, earlier))
        return replace(setup, prior=learned.prior), learned, None, solution
    learned, before, found = None, None, settled(setup, data)
    for _ in range(MAX_PRIOR_ROUNDS):
        information = found.solution.information
        start = None if learned is None or not learned.settled else learned.parameters
        learned = learned_prior(setup, setup.family, _with_more(information, earlier), start)
        setup = replace(setup, prior=learned.prior)
        before, found = found, settled(setup, data, found.around)
        moved = float(found.posterior.rms_shift_from(before.posterior))
        if moved < PRIOR_SETTLED:
            return setup, learned, found.around, None
    return setup, replace(learned, still_moves=moved), found.around, None


def about_sky(setup: Setup, data: Visibilities) -> Solution:
    """Solve for the sky under the setup's prior, through what data say of it.

    Where N is built around what data tell, it is about that of the prior before them.
    """
    around = settled(setup, data).around if rebuilds(setup) else Around(data)
    return full_model(setup, around).condition(data.data, FromInformation)


def _with_more(information: Information, earlier: Information | None) -> Information:
    return information if earlier is None else information + earlier


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
        What the data say of the sky (:func:`about_sky`).
    start : (parameters,) array, optional
        Where to begin.
    """
    scenario, seed = setup.scenario, setup.scenario.seed
    if start is not None or scenario.lmax <= COARSE_LMAX:
        return learn_whatever_fits(family, information, start, seed)
    coarse = scenario.prior.family(scenario.frequency_mhz, COARSE_LMAX)
    n = n_modes(COARSE_LMAX)
    variance = np.asarray(setup.prior.variance())[n:]
    first = learn_whatever_fits(coarse, integrated_out(information, n, variance), seed=seed)
    start = family.start_from(coarse, first.parameters) if first.settled else None
    return learn_whatever_fits(family, information, start=start, seed=seed)


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
            f"--priors {','.join(names)}: a comparison needs two or more different ones of "
            f"{', '.join(NAMED)}"
        )
    if OF_TRUE_SKY in names and not known_sky:
        raise InputError(
            f"--priors: {OF_TRUE_SKY} takes C_ell of the scenario's sky, which nobody knows of "
            "measured data; leave it out, or give --truth if the data are of that sky"
        )
    own, named = scenario.prior, {name: NAMED[name] for name in names}
    # isotropic priors differ in where C_ell comes from
    return {
        name: own if (own.model, own.origin) == (one.model, one.origin) else one
        for name, one in named.items()
    }
