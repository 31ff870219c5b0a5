"""Did you mean, for data: the usual mistakes, tried where no sky explains the data.

Each is undone, and its residual chi^2, what a prior wide enough for any sky leaves
(:mod:`lusee_bayes.linear.split`), tells whether the data would fit.

Changes of the data cost one matrix together (:mod:`.mixed_products`). A change of the model needs a
normal matrix of its own; these are compared up to ``SCREENED_LMAX`` first. The best of both are
computed as the scenario has it, with N for the changed data.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from lusee_bayes.core.errors import InputError
from lusee_bayes.experiment.any_sky import UnderAnySky
from lusee_bayes.experiment.experiment import Experiment
from lusee_bayes.experiment.mistakes import (
    ModelMistake,
    model_mistakes,
)
from lusee_bayes.experiment.mixed_products import MixedProducts
from lusee_bayes.experiment.rounds import Inference
from lusee_bayes.instrument.observation import Observation
from lusee_bayes.instrument.pointing import Pointing
from lusee_bayes.instrument.pointing_offsets import kind_of, offset_names, with_offsets
from lusee_bayes.instrument.visibilities import Visibilities
from lusee_bayes.linear.fit import ChiSquare, stands_out, two_sided
from lusee_bayes.linear.residuals import Residuals

# changes of the model are compared up to this ell
SCREENED_LMAX = 12
# computed as the scenario has it: so many of the data and of the model, the best first, that leave
# less than this share of what is too much
TRIED, PROMISING = 3, 0.1
# where nothing makes the data fit, those are listed that leave less than this share
EXPLAINED = 0.03
# two mistakes are one for these antennas if their chi^2 differ by less, relative
SAME = 1e-5
# lmax is tried with so many more
MORE_ELLS = 8
# offsets are solved for from so many degrees on either side, in steps that shrink
OFFSETS, REACHES = ("turntable_deg", "tilt_east_deg", "tilt_north_deg"), (4.0, 0.5)
# of white noise, sums over neighbouring times are within so many standard deviations
WHITE = 5.0


@dataclass(frozen=True)
class Proposal:
    """A usual mistake that would explain the data.

    Attributes
    ----------
    words, remedy : str
        What is wrong, and what to do.
    chi2 : ChiSquare
        Residual chi^2 of the data without the mistake.
    """

    words: str
    remedy: str
    chi2: ChiSquare

    @property
    def fits(self) -> bool:
        """Whether the data would fit."""
        return not stands_out(self.chi2.p, 1)

    @property
    def excess(self) -> float:
        """How far chi^2 is from what is expected."""
        return abs(self.chi2.chi2 - self.chi2.degrees)

    def row(self) -> dict[str, object]:
        """Of summary.json."""
        return {
            "mistake": self.words,
            "remedy": self.remedy,
            "chi2": self.chi2.chi2,
            "chi2_expected": self.chi2.degrees,
            "p": self.chi2.p,
            "fits": self.fits,
        }


@dataclass(frozen=True)
class Diagnosis:
    """The usual mistakes that would explain data.

    Attributes
    ----------
    chi2 : ChiSquare
        Residual chi^2 of the data as they are.
    proposals : tuple of Proposal
        The best first: those without which the data fit, or, if there are none, those that explain
        nearly all of what is too much.
    n_tried : int
        How many mistakes were tried.
    """

    chi2: ChiSquare
    proposals: tuple[Proposal, ...]
    n_tried: int

    @property
    def fits(self) -> bool:
        """Whether the data fit as they are."""
        return not stands_out(self.chi2.p, 1)

    def rows(self) -> list[dict[str, object]]:
        """The proposals as rows of a table."""
        return [proposal.row() for proposal in self.proposals]

    def sentences(self) -> list[str]:
        """The proposals in words, one each; or that there are none."""
        if self.fits:
            return [f"No usual mistake is needed: the data fit as they are ({self.chi2.words()})."]
        if not self.proposals:
            return [f"None of the usual mistakes explains it ({self.n_tried} tried)."]
        first = "Did you mean" if self.proposals[0].fits else "Closest, but not enough"
        return [f"{first}:"] + [
            f"({number}) {one.words}: {one.remedy} ({one.chi2.words()})."
            for number, one in enumerate(self.proposals, 1)
        ]


def diagnose(experiment: Experiment, inference: Inference, found: Residuals) -> Diagnosis:
    """Try the usual mistakes on the data of an experiment.

    Parameters
    ----------
    experiment : Experiment
    inference : Inference
        Of its data alone.
    found : Residuals
        Of the map.

    Returns
    -------
    Diagnosis
    """
    setup, data = experiment.setup, experiment.data
    here = UnderAnySky.of(setup, data, inference.model)
    base, posterior = here.wide(here.model.coupling)

    def best(tried: Sequence[tuple[float, object]], whole: ChiSquare) -> list:
        """The most promising, by chi^2."""
        most = whole.degrees + PROMISING * abs(whole.chi2 - whole.degrees)
        found = sorted((one for one in tried if one[0] < most), key=lambda one: one[0])
        return [one for _, one in found[:TRIED]]

    of_data = list(MixedProducts.of(here, posterior).tried())
    proposals = [Proposal(m.words, m.remedy, here.without(m)) for m in best(of_data, base)]
    low = Pointing.of(setup.observation, min(SCREENED_LMAX, setup.scenario.lmax))
    known = list(model_mistakes(setup))
    screened = [here.under(m.beams, m.observation, low).chi2 for m in known]
    whole = here.under(setup.beams, setup.observation, low)
    of_model = [*zip(screened, known, strict=True), *_offsets(here, low)]
    proposals += [
        Proposal(m.words, m.remedy, here.under(m.beams, m.observation, setup.pointing))
        for m in best(of_model, whole)
    ]
    excess = EXPLAINED * abs(base.chi2 - base.degrees)
    nearly = [one for one in proposals if one.excess < excess]
    # these always absorb some of what is wrong, and count only if they absorb all of it
    proposals += _noise_level(found, data)
    finer = [] if any(one.fits for one in proposals) else list(_finer(here))
    proposals += finer
    listed = [one for one in proposals if one.fits] or nearly
    listed.sort(key=lambda one: one.excess)
    return Diagnosis(base, tuple(_merged(listed)), len(of_data) + len(of_model) + 1 + len(finer))


def _merged(proposals: list[Proposal]) -> Iterator[Proposal]:
    """Those of one chi^2 as one: antennas that are alike do not distinguish them."""
    while proposals:
        first, *rest = proposals
        alike = [p for p in rest if abs(p.chi2.chi2 - first.chi2.chi2) < SAME * first.chi2.chi2]
        proposals = [p for p in rest if p not in alike]
        yield replace(first, words=", or ".join(p.words for p in (first, *alike)))


def _finer(here: UnderAnySky) -> Iterator[Proposal]:
    """A map of more ells."""
    setup, lmax = here.setup, here.setup.scenario.lmax + MORE_ELLS
    try:
        beams = setup.beam_source.beams(setup.scenario.frequency_mhz, lmax)
    except InputError:  # a file's beams end before
        return
    chi2 = here.under(beams, setup.observation, Pointing.of(setup.observation, lmax))
    yield Proposal("the sky has structure beyond lmax", f"use --set lmax={lmax}", chi2)


def _offsets(here: UnderAnySky, low: Pointing) -> Iterator[tuple[float, ModelMistake]]:
    """Angles that are off by what fits best: by parabolas through three values, ever closer."""
    setup = here.setup
    for name in offset_names(OFFSETS, setup.observation.n_runs):

        def shifted(value: float, name: str = name) -> Observation:
            return with_offsets(setup.observation, {name: value})

        value, chi2 = 0.0, np.inf
        for reach in REACHES:
            values = value + reach * np.array([-1.0, 0.0, 1.0])
            seen = [here.under(setup.beams, shifted(v), low).chi2 for v in values]
            curvature = seen[0] - 2.0 * seen[1] + seen[2]
            if curvature > 0.0:
                value += reach * np.clip(0.5 * (seen[0] - seen[2]) / curvature, -3.0, 3.0)
            chi2 = min(seen)
        section, kind = setup.scenario.noise.pointing, kind_of(name)
        remedy = f"give noise.pointing.{kind}"
        if section is not None and kind in section.kinds:
            remedy = f"widen its prior, noise.pointing.{kind}, or set treatment=sampled"
        words = f"{name} is off by {value:.3g}"
        yield chi2, ModelMistake(words, remedy, setup.beams, shifted(value))


def _noise_level(found: Residuals, data: Visibilities) -> Iterator[Proposal]:
    """Another noise level, if what is left is white: alike in all groups, and from time to time."""
    whole, groups = found.split.instrument, [g for _, g in found.compared() if g.degrees > 1.0]
    factor = whole.chi2 / whole.degrees
    if not groups or not factor > 0.0:
        return
    least = min(two_sided(group.chi2 / factor, group.degrees) for group in groups)
    z = np.where(data.layout.present, data.layout.scatter(found.z), np.nan) / np.sqrt(factor)
    pairs = (z[:, 1:] * z[:, :-1])[np.isfinite(z[:, 1:] * z[:, :-1])]
    if stands_out(least, len(groups)) or abs(pairs.sum()) > WHITE * np.sqrt(len(pairs)):
        return
    yield Proposal(
        f"the noise variance is {factor:.3g} times what is assumed",
        f"multiply noise.radiometer.factor by {factor:.3g}",
        ChiSquare(whole.degrees, whole.degrees),
    )
