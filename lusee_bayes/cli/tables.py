"""Tables that commands print."""

from collections.abc import Iterable, Sequence

from rich.box import SIMPLE
from rich.markup import escape
from rich.table import Table

from lusee_bayes.results import finished_runs, sample_result
from lusee_bayes.results.forecast import AS_GIVEN, Forecast, forecast_rows
from lusee_bayes.sampling.validation import Check


def forecast_table(forecasts: list[Forecast]) -> Table:
    """The forecasts of one scenario as a table for the terminal."""
    source = forecasts[0].variation.source
    text = Table(title=escape(source), title_justify="left", title_style="bold")
    text.caption = "expected values; modes: SNR > 1; ell: first with SNR < 1; deg: resolution"
    text.add_column("variation", overflow="fold")
    for name in ("days", "data", "bits", "+bits", "modes", "ell", "deg"):
        text.add_column(name, justify="right", no_wrap=True)
    family = ""
    for row, forecast in zip(forecast_rows(forecasts), forecasts, strict=True):
        if row["family"] != family:
            family = str(row["family"])
            text.add_section()
            if family != AS_GIVEN:
                text.add_row(f"[italic]{escape(family)}")
        text.add_row(
            escape(str(row["variation"])),
            f"{forecast.days:.1f}",
            str(row["n_data"]),
            f"{forecast.information_bits:.0f}",
            f"{float(str(row['difference_bits'])):+.0f}",
            str(row["modes_snr_above_1"]),
            str(row["ell_cross"]),
            "none" if forecast.resolution_deg is None else f"{forecast.resolution_deg:.1f}",
        )
    return text


def checks_table(checks: list[Check]) -> Table:
    """The checks of a validation as a table."""
    table = Table("check", "value", "allowed", "", "meaning")
    for check in checks:
        verdict = "ok" if check.passed else "FAILED"
        value, allowed = f"{check.value:.4g}", sample_result.ValidationResult.allowed(check)
        table.add_row(escape(check.name), value, allowed, verdict, escape(check.meaning))
    return table


def table_of_numbers(header: Sequence[str], rows: Iterable[Sequence[str]]) -> Table:
    """A table with a column of names and columns of numbers."""
    table = Table(box=SIMPLE, padding=(0, 1, 0, 0))  # ten columns fit a terminal of 80
    for number, name in enumerate(header):
        table.add_column(escape(name), justify="right" if number else "left", overflow="fold")
    for row in rows:
        table.add_row(*map(escape, row))
    return table


def comparison_table(runs: Sequence[finished_runs.FinishedRun]) -> Table:
    """A comparison of finished runs."""
    header = "run", "MHz", "verdict", "SNR<1\nat ell", "bits", "ln\nevidence", "-\nbest"
    rows = [
        (
            run.name,
            f"{row['frequency_mhz']:g}",
            str(row["level"]),
            run.cross_in_words(),
            f"{row['information_bits']:.0f}",
            f"{row['log_evidence']:.1f}",
            "-" if (less := row["log_evidence_less_best"]) is None else f"{less:.1f}",
            f"{row['instrument_p']:.2g}",
            f"{row['prior_p']:.2g}",
        )
        for run, row in zip(runs, finished_runs.comparison_rows(runs), strict=True)
    ]
    return table_of_numbers((*header, "p\ninstr.", "p\nprior"), rows)
