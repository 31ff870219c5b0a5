"""The paper's claims and their verdicts, as rows and as Markdown."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from lusee_bayes.paper.claims import CLAIMS, Cases


def claim_table(cases: Cases) -> list[dict[str, object]]:
    """Rows of claims.csv, in the order of the paper."""
    rows = []
    for claim in CLAIMS:
        verdict = claim.judge(cases)
        rows.append(
            {
                "section": claim.section,
                "paper": claim.statement,
                "obtained": verdict.obtained,
                "agrees": verdict.agrees,
                "reason": "it holds" if verdict.agrees == "yes" else claim.otherwise,
            }
        )
    return rows


def claims_as_markdown(rows: Sequence[Mapping[str, object]]) -> str:
    """The claims as a table, with a count of the verdicts above it."""
    verdicts = [row["agrees"] for row in rows]
    counts = ", ".join(f"{verdicts.count(v)} {v}" for v in ("yes", "partly", "no"))
    head = "| section | the paper says | obtained | agrees | if not, why |\n" + "| --- " * 5 + "|\n"
    lines = []
    for row in rows:
        cells = [str(value).replace("|", "\\|") for value in row.values()]
        cells[-1] = "" if row["agrees"] == "yes" else cells[-1]
        lines.append(f"| {' | '.join(cells)} |\n")
    return f"{len(rows)} claims: {counts}.\n\n{head}{''.join(lines)}"
