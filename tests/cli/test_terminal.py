"""What the terminal shows: tables that fit, options that are checked first, what a folder is."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from rich.console import Console

from lusee_bayes.cli.main import main
from lusee_bayes.cli.options import show
from lusee_bayes.cli.tables import checks_table, comparison_table
from lusee_bayes.core.version import COMMAND
from lusee_bayes.results.finished_runs import FinishedRun, comparison_rows, evidence_caveat
from lusee_bayes.sampling.validation import Check


@pytest.fixture
def finished(small_map):
    return FinishedRun.read(small_map.folder)


def printed(table) -> list[str]:
    console = Console(width=80, soft_wrap=True, record=True, quiet=False, force_terminal=False)
    with console.capture() as captured:
        show(console, table)
    return captured.get().splitlines()


def with_data(run, name, change):
    """The same run with other data."""
    diagnostics = run.diagnostics.copy(deep=True)
    diagnostics["data"] = change(diagnostics["data"])
    return replace(run, name=name, diagnostics=diagnostics)


@pytest.mark.parametrize(("arguments", "code"), [(["keys"], 0), (["map", "no.yaml"], 2)])
def test_what_a_program_calls_next_is_not_said_to_be_of_a_command_before(arguments, code, capsys):
    assert main(arguments) == code
    assert COMMAND.get() == ""


def test_tables_fit_eighty_columns(finished):
    others = [
        replace(finished, name="a run with a name that is longer than it had better be " * 2),
        replace(finished, name="unknown", summary=finished.summary | {"ell_cross": None}),
    ]
    lines = printed(comparison_table([finished, *others]))
    assert max(map(len, lines)) <= 80
    assert "None" not in "".join(lines) and "> 8" in "".join(lines)
    check = Check("a check", 1.0, 0.0, 2.0, "what it is, in a long sentence " * 6)
    assert max(map(len, printed(checks_table([check])))) <= 80


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda d: d + 1.0, "other values at the same times"),
        (lambda d: 4e-24 * d, "the same data in another unit (times 4e-24)"),
        (lambda d: d.where(np.arange(d.sizes["time"]) > 3), "samples instead of"),
    ],
)
def test_evidences_of_other_data_are_not_compared(finished, change, reason):
    same = with_data(finished, "same", lambda d: d)
    assert evidence_caveat([finished, same]) is None
    assert comparison_rows([finished, same])[0]["log_evidence_less_best"] == 0.0
    other = with_data(finished, "other", change)
    assert reason in evidence_caveat([finished, same, other])
    assert "same has" not in evidence_caveat([finished, same, other])
    assert comparison_rows([finished, other])[0]["log_evidence_less_best"] is None


def test_other_frequencies_are_said(finished):
    other = replace(finished, name="ten", summary=finished.summary | {"frequency_mhz": 10.0})
    assert "ten is at 10 MHz instead of 25" in evidence_caveat([finished, other])


@pytest.mark.parametrize(
    ("option", "message"),
    [("--simulations=50", "at least 100 simulations"), ("--draws=20", "100 draws of each chain")],
)
def test_options_are_checked_before_anything_is_loaded(option, message, tmp_path):
    """Not even a scenario that does not exist is looked for, nor JAX imported."""
    code = (
        "import sys; from lusee_bayes.cli.main import main; "
        f"code = main(['validate', 'no such scenario', '{option}']); "
        "print('jax' in sys.modules); raise SystemExit(code)"
    )
    found = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=tmp_path, check=False
    )
    assert found.returncode == 2 and message in found.stderr
    assert found.stdout.strip() == "False"
    assert not list(tmp_path.iterdir())


def test_info_of_a_folder(small_map, tmp_path, capsys):
    assert main(["info", str(small_map.folder)]) == 0
    told = capsys.readouterr().out
    assert "results of lusee-bayes map" in told and "simulated by this run, seed 1" in told
    assert small_map.result.verdict() in told and "mean_alm.fits" in told
    assert main(["info", str(tmp_path)]) == 2
    assert "a folder that no run has written" in capsys.readouterr().err


def test_info_of_coefficients_says_their_frequency_once(small_map, capsys):
    assert main(["info", str(small_map.folder / "mean_alm.fits")]) == 0
    told = capsys.readouterr().out
    assert "at 25 MHz" in told and "not said" not in told and "one sky" in told
