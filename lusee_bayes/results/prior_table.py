"""The table that sets priors side by side: the same on a terminal, in Markdown and on a page."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any


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
    evidence = [one["log_evidence"] for one in priors]
    rows = [
        ("ln evidence", *_numbers(evidence)),
        ("less the best", *_less_best(evidence)),
        ("parameters learned", *(str(one["parameters"]) for one in priors)),
    ]
    for k, held in enumerate(priors[0]["held_out"]):
        found = [one["held_out"][k] for one in priors]
        kind = f"{held['kind']}s left out"
        rows += [
            (f"{kind}: ln p less the best", *_less_best([one["log_density"] for one in found])),
            (f"{kind}: chi2 of {held['n']}", *(f"{one['chi2']:.0f}" for one in found)),
        ]
    rows += [
        (f"chi2 {words}", *(_of(one[f"chi2_{key}"], one[f"degrees_{key}"]) for one in priors))
        for key, words in (("instrument", "no sky explains"), ("prior", "of the sky"))
    ]
    if all(one["coverage"] for one in priors):
        rows += _known(priors)
    return header, rows


def _known(priors: Sequence[Mapping[str, Any]]) -> list[tuple[str, ...]]:
    """What can be told where the sky is known."""

    def each(cell: Callable[[Mapping[str, Any]], str]) -> list[str]:
        return [cell(one) for one in priors]

    rows = []
    for k, part in enumerate(priors[0]["coverage"]):
        name = str(part["name"])
        rows += [
            (f"68% hold, {name}", *each(lambda one, k=k: f"{one['coverage'][k]['held_68']:.1%}")),
            (f"95% hold, {name}", *each(lambda one, k=k: f"{one['coverage'][k]['held_95']:.1%}")),
            (f"rms pull, {name}", *each(lambda one, k=k: f"{one['coverage'][k]['rms']:.2f}")),
        ]
    rows += [
        ("largest pull", *each(lambda one: f"{one['coverage'][-1]['largest']:.1f}")),
        ("rms error [K]", *each(lambda one: f"{one['errors'][-1]['rms_error_k']:,.0f}")),
    ]
    for k, found in enumerate(priors[0]["snr"]):
        name = f"SNR at ell {found['ell']}"
        rows.append((name, *each(lambda one, k=k: f"{one['snr'][k]['snr']:.1f}")))
    return rows


def _numbers(values: Sequence[float]) -> list[str]:
    return [f"{value:.1f}" for value in values]


def _less_best(values: Sequence[float]) -> list[str]:
    return [f"{value - max(values):.1f}" for value in values]


def _of(chi2: float, degrees: float) -> str:
    return f"{chi2:.0f} of {degrees:.0f}"
