"""One data set under several priors: which one the data prefer, and how well each fits.

Evidence judges all data at once. Held-out groups test the predictions of the other data, with the
prior learned from all. If the sky is known, so is how often error bars cover it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated

from pydantic import BaseModel, Field, model_validator

from lusee_bayes.core.progress import about_run
from lusee_bayes.experiment.scenario import Scenario
from lusee_bayes.judge.chi2 import ChiSquare
from lusee_bayes.judge.coverage import LEVELS, Coverage
from lusee_bayes.judge.residuals import HeldOut
from lusee_bayes.results.channel import ChannelResult, SkyErrors

# a clear difference of two ln evidences, each of which is accurate to one or two
CLEAR = 3.0
HELD_OUT = (
    "Left out: each product, or each day, is predicted from all other data with the prior learned "
    "from all data; ln p and chi2 are sums over them."
)


class PriorSummary(BaseModel):
    """The data under a prior, in priors.json.

    Attributes
    ----------
    name : str
    prior : str
        The prior's model, the source of its C_ell, and its parameters.
    parameters : int
        Number of learned parameters.
    log_evidence : float
        ln p(d), with the sky and the prior's parameters, if it has any, integrated out (Laplace).
    held_out : tuple of HeldOut
        Empty if groups are not judged.
    instrument, rest : ChiSquare
        The parts of chi^2 that test instrument and noise, and the prior.
    coverage, errors, snr
        By part of the sky, latitude and multipole; empty unless the sky is known.
    """

    name: str
    prior: str
    parameters: int
    log_evidence: float
    held_out: tuple[HeldOut, ...]
    instrument: ChiSquare
    rest: ChiSquare
    coverage: tuple[Coverage, ...]
    errors: tuple[SkyErrors, ...]
    snr: dict[int, float]

    def tells(self) -> tuple[object, ...]:
        """Entries that differ from run to run: kinds of groups, parts of the sky, multipoles."""
        kinds, parts = ([held.kind for held in self.held_out], [c.name for c in self.coverage])
        return kinds, parts, [error.name for error in self.errors], list(self.snr)


class PriorsSummary(BaseModel):
    """Contents of priors.json."""

    verdict: str
    notes: list[str]
    best: str
    frequency_mhz: float
    n_data: int
    priors: Annotated[list[PriorSummary], Field(min_length=1)]
    seconds: dict[str, float]
    peak_memory_gb: float
    versions: dict[str, str]

    @model_validator(mode="after")
    def _tell_the_same(self) -> PriorsSummary:
        if any(one.tells() != self.priors[0].tells() for one in self.priors):
            raise ValueError("its priors have different entries; make the results again")
        return self


@dataclass(frozen=True)
class PriorComparison:
    """One data set under several priors.

    Attributes
    ----------
    name : str
        Name of the scenario.
    scenario : Scenario
    priors : tuple of PriorSummary
        Two or more.
    channels : tuple of ChannelResult
        The map under each prior.
    seconds : dict
        By stage.
    """

    name: str
    scenario: Scenario
    priors: tuple[PriorSummary, ...]
    channels: tuple[ChannelResult, ...]
    seconds: dict[str, float] = field(default_factory=dict)

    @property
    def best(self) -> PriorSummary:
        """The prior with the highest evidence."""
        return max(self.priors, key=lambda one: one.log_evidence)

    @property
    def known_sky(self) -> bool:
        """Whether the sky behind the data is known."""
        return self.channels[0].truth is not None

    def headline(self) -> str:
        """Which prior the data prefer, and by how much."""
        first, second = sorted(self.priors, key=lambda one: -one.log_evidence)[:2]
        margin = first.log_evidence - second.log_evidence
        if margin < CLEAR:
            differ = f"their ln evidences differ by {margin:.1f}"
            within = f"within the error of Laplace's approximation ({CLEAR:g})"
            return f"The data do not favour {first.name} over {second.name}: {differ}, {within}"
        return f"The data prefer {first.name}: its ln evidence is {margin:.1f} above {second.name}"

    def lines(self) -> list[str]:
        """Lines for a terminal, below the table."""
        sentences = [f"{self.headline()}."]
        for k, kind in enumerate(held.kind for held in self.best.held_out):
            best = max(self.priors, key=lambda one, k=k: one.held_out[k].log_density)
            if best is not self.best:
                sentences.append(f"{best.name} predicts each {kind} best from the others.")
        return [*sentences, HELD_OUT]

    def table(self) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
        """Header and rows, a column for each prior."""
        return prior_table(self.priors)

    def rows(self) -> list[dict[str, object]]:
        """Rows of priors.csv, one for each prior."""
        return [_row(one, self.best.log_evidence) for one in self.priors]

    def summary(self) -> PriorsSummary:
        """Contents of priors.json."""
        return PriorsSummary(
            verdict=f"{self.headline()}.",
            notes=self.lines()[1:],
            best=self.best.name,
            frequency_mhz=self.scenario.frequency_mhz,
            n_data=self.channels[0].n_data,
            priors=list(self.priors),
            **about_run(self.seconds),
        )


def _row(one: PriorSummary, best: float) -> dict[str, object]:
    row: dict[str, object] = {
        "prior": one.name,
        "parameters": one.parameters,
        "log_evidence": one.log_evidence,
        "log_evidence_less_best": one.log_evidence - best,
    }
    for held in one.held_out:
        row |= {f"{held.kind}_{key}": getattr(held, key) for key in ("n", "chi2", "log_density")}
    for name, part in (("instrument", one.instrument), ("prior", one.rest)):
        row |= {f"chi2_{name}": part.chi2, f"degrees_{name}": part.degrees}
    for part, error in zip(one.coverage, one.errors, strict=True):
        errors = {"rms_error_k": error.rms_error_k, "std_over_sky": error.std_over_sky}
        row |= {f"{part.name}: {key}": x for key, x in (part.row() | errors).items()}
    return row | {f"snr_{ell}": value for ell, value in one.snr.items()}


def prior_table(priors: Sequence[PriorSummary]) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """Header and rows: a column for each prior."""
    header, first = ("", *(one.name for one in priors)), priors[0]
    rows: dict[str, list[str]] = {}

    def less_best(values: list[float]) -> list[str]:
        return [f"{value - max(values):.1f}" for value in values]

    rows["ln evidence"] = [f"{one.log_evidence:.1f}" for one in priors]
    rows["minus the best"] = less_best([one.log_evidence for one in priors])
    rows["parameters learned"] = [str(one.parameters) for one in priors]
    for k, held in enumerate(first.held_out):
        left_out, parts = f"{held.kind}s left out", [one.held_out[k] for one in priors]
        rows[f"{left_out}: ln p minus the best"] = less_best([x.log_density for x in parts])
        rows[f"{left_out}: chi2 of {held.n}"] = [f"{x.chi2:.0f}" for x in parts]
    for key, words in (("instrument", "instrument + noise"), ("rest", "prior")):
        parts = [getattr(one, key) for one in priors]
        rows[f"chi2 {words}"] = [f"{x.chi2:.0f} of {x.degrees:.0f}" for x in parts]
    for k, part in enumerate(first.coverage):
        parts = [one.coverage[k] for one in priors]
        for level in (0.68, 0.95):
            n = LEVELS.index(level)
            rows[f"{level:.0%} coverage, {part.name}"] = [f"{x.held[n]:.1%}" for x in parts]
        rows[f"rms pull, {part.name}"] = [f"{x.rms:.2f}" for x in parts]
    if first.coverage:
        rows["largest pull"] = [f"{one.coverage[-1].largest:.1f}" for one in priors]
        rows["rms error [K]"] = [f"{one.errors[-1].rms_error_k:,.0f}" for one in priors]
    for ell in first.snr:
        rows[f"SNR at ell {ell}"] = [f"{one.snr[ell]:.1f}" for one in priors]
    return header, [(name, *cells) for name, cells in rows.items()]
