"""One data set under several priors: which of them it prefers, and what each says of it.

Evidence judges all data at once. Groups that are left out judge what the others predict of them,
with the prior that was learned from all. Where the sky is known, so is how often error bars hold.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import reduce
from operator import getitem
from typing import Any

from lusee_bayes.core.progress import about_run
from lusee_bayes.experiment.scenario import Scenario
from lusee_bayes.judge.residuals import HeldOut
from lusee_bayes.judge.split import Split
from lusee_bayes.results.channel import (
    ChannelResult,
    errors_by_latitude,
    snr_at_some_ell,
)

# a difference of two evidences of which each is good to one or two
CLEAR = 3.0
HELD_OUT = (
    "Left out: every product, or every day, predicted from all other data, with the prior that was "
    "learned from all; ln p and chi^2 are summed over them."
)


@dataclass(frozen=True)
class UnderPrior:
    """The data under one prior.

    Attributes
    ----------
    name : str
    words : str
        The prior's model, where its C_ell comes from and its parameters.
    channel : ChannelResult
    log_evidence : float
        ln p(d), with the sky and the prior's parameters, if it has any, integrated out (Laplace).
    n_parameters : int
        That were learned.
    held_out : tuple of HeldOut
        Empty where groups are not judged.
    split : Split
        chi^2 of what no sky explains, and of what the prior does not expect.
    """

    name: str
    words: str
    channel: ChannelResult
    log_evidence: float
    n_parameters: int
    held_out: tuple[HeldOut, ...]
    split: Split

    def as_json(self) -> dict[str, object]:
        """Its entry of priors.json; null where the sky is not known."""
        channel, known = self.channel, self.channel.truth is not None
        snr = snr_at_some_ell(channel) if known else {}
        return {
            "name": self.name,
            "prior": self.words,
            "parameters": self.n_parameters,
            "log_evidence": self.log_evidence,
            "held_out": [vars(one) for one in self.held_out],
            "chi2_instrument": self.split.instrument.chi2,
            "degrees_instrument": self.split.instrument.degrees,
            "chi2_prior": self.split.prior.chi2,
            "degrees_prior": self.split.prior.degrees,
            "coverage": channel.coverage_rows(),
            "errors": errors_by_latitude(channel) if known else None,
            "snr": [{"ell": ell, "snr": value} for ell, value in snr.items()],
        }


@dataclass(frozen=True)
class PriorComparison:
    """One data set under several priors.

    Attributes
    ----------
    name : str
        Of the scenario.
    scenario : Scenario
    priors : tuple of UnderPrior
        Two or more.
    seconds : dict
        By stage.
    """

    name: str
    scenario: Scenario
    priors: tuple[UnderPrior, ...]
    seconds: dict[str, float] = field(default_factory=dict)

    @property
    def best(self) -> UnderPrior:
        """The prior of the highest evidence."""
        return max(self.priors, key=lambda one: one.log_evidence)

    @property
    def known_sky(self) -> bool:
        """Whether the sky behind the data is known."""
        return self.best.channel.truth is not None

    def headline(self) -> str:
        """Which prior the data prefer, and by how much."""
        first, second = sorted(self.priors, key=lambda one: -one.log_evidence)[:2]
        margin = first.log_evidence - second.log_evidence
        if margin < CLEAR:
            return (
                f"The data do not tell {first.name} from {second.name}: their ln evidences differ "
                f"by {margin:.1f}, and less than {CLEAR:g} is within what Laplace's approximation "
                "misses"
            )
        return f"The data prefer {first.name}: its ln evidence is {margin:.1f} above {second.name}"

    def lines(self) -> list[str]:
        """What a terminal shows below the table."""
        found = [f"{self.headline()}."]
        for k, kind in enumerate(held.kind for held in self.best.held_out):
            best = max(self.priors, key=lambda one, k=k: one.held_out[k].log_density)
            if best is not self.best:
                found.append(f"Each {kind} is predicted best from the others under {best.name}.")
        return [*found, HELD_OUT]

    def table(self) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
        """Header and rows, a column for each prior."""
        return prior_table(self.as_json()["priors"])

    def rows(self) -> list[dict[str, object]]:
        """Rows of priors.csv, one for each prior; empty where something is not known."""
        return [_row(one, self.best.log_evidence) for one in self.priors]

    def as_json(self) -> dict[str, object]:
        """priors.json."""
        return {
            "verdict": f"{self.headline()}.",
            "notes": self.lines()[1:],
            "best": self.best.name,
            "frequency_mhz": self.scenario.frequency_mhz,
            "n_data": self.best.channel.n_data,
            "priors": [one.as_json() for one in self.priors],
            **about_run(self.seconds),
        }

    def as_markdown(self) -> str:
        """priors.md."""
        header, rows = self.table()
        cells = [" | ".join(cell.replace("|", "\\|") for cell in row) for row in (header, *rows)]
        rule = " | ".join(["---"] * len(header))
        table = [f"| {line} |" for line in (cells[0], rule, *cells[1:])]
        first, *others = self.lines()
        notes = [f"- {one.name}: {one.words}" for one in self.priors]
        lines = [f"# {self.name} under several priors", "", first, "", *table, ""]
        return "\n".join([*lines, *others, "", *notes]) + "\n"


def _row(one: UnderPrior, best: float) -> dict[str, object]:
    channel, known = one.channel, one.channel.truth is not None
    row: dict[str, object] = {
        "prior": one.name,
        "parameters": one.n_parameters,
        "log_evidence": one.log_evidence,
        "log_evidence_less_best": one.log_evidence - best,
    }
    for held in one.held_out:
        row |= {f"{held.kind}_{key}": getattr(held, key) for key in ("n", "chi2", "log_density")}
    for name, part in (("instrument", one.split.instrument), ("prior", one.split.prior)):
        row |= {f"chi2_{name}": part.chi2, f"degrees_{name}": part.degrees}
    if known:
        for part, error in zip(channel.coverage, errors_by_latitude(channel), strict=True):
            told = part.row() | error
            row |= {f"{part.name}: {key}": x for key, x in told.items() if key not in ("name", "n")}
        row |= {f"snr_{ell}": value for ell, value in snr_at_some_ell(channel).items()}
    return row


def prior_table(
    priors: Sequence[Mapping[str, Any]],
) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """Header and rows: a column for each prior.

    Parameters
    ----------
    priors : sequence of mappings
        Entries of priors.json.
    """
    header = ("", *(str(one["name"]) for one in priors))

    def each(form: str, *path: str | int) -> list[str]:
        """A cell for each prior, of the entry at this place."""
        return [format(reduce(getitem, path, one), form) for one in priors]

    def less_best(*path: str | int) -> list[str]:
        values = [reduce(getitem, path, one) for one in priors]
        return [f"{value - max(values):.1f}" for value in values]

    rows = [
        ("ln evidence", *each(".1f", "log_evidence")),
        ("less the best", *less_best("log_evidence")),
        ("parameters learned", *each("", "parameters")),
    ]
    for k, held in enumerate(priors[0]["held_out"]):
        kind = f"{held['kind']}s left out"
        rows += [
            (f"{kind}: ln p less the best", *less_best("held_out", k, "log_density")),
            (f"{kind}: chi2 of {held['n']}", *each(".0f", "held_out", k, "chi2")),
        ]
    for key, words in (("instrument", "no sky explains"), ("prior", "of the sky")):
        pairs = zip(each(".0f", f"chi2_{key}"), each(".0f", f"degrees_{key}"), strict=True)
        rows.append((f"chi2 {words}", *(f"{chi2} of {degrees}" for chi2, degrees in pairs)))
    if not all(one["coverage"] for one in priors):
        return header, rows
    held = (("68% hold", "held_68", ".1%"), ("95% hold", "held_95", ".1%"))
    for k, part in enumerate(priors[0]["coverage"]):
        rows += [
            (f"{w}, {part['name']}", *each(f, "coverage", k, key))
            for w, key, f in (*held, ("rms pull", "rms", ".2f"))
        ]
    rows.append(("largest pull", *each(".1f", "coverage", -1, "largest")))
    rows.append(("rms error [K]", *each(",.0f", "errors", -1, "rms_error_k")))
    for k, found in enumerate(priors[0]["snr"]):
        rows.append((f"SNR at ell {found['ell']}", *each(".1f", "snr", k, "snr")))
    return header, rows
