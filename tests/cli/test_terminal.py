"""What the terminal shows, help, and what a command waits for: libraries, programs to compile."""

import os
import re
import shlex
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from commands import refused, run
from rich.console import Console

from lusee_bayes.cli.commands import app
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
    channel = replace(run.channel, data=change(run.channel.data))
    return replace(run, name=name, channels=(channel,))


@pytest.mark.parametrize(("arguments", "code"), [(["keys"], 0), (["map", "no.yaml"], 2)])
def test_what_a_program_calls_next_is_not_said_to_be_of_a_command_before(arguments, code, capsys):
    assert main(arguments) == code
    assert COMMAND.get() == ""


def test_tables_fit_eighty_columns(finished):
    others = [
        replace(finished, name="a run with a name that is longer than it had better be " * 2),
        replace(finished, name="unknown", channels=(replace(finished.channel, truth=None),)),
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
        (lambda d: np.where(np.arange(d.shape[1]) > 3, d, np.nan), "samples instead of"),
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
    ten = replace(finished, name="ten", channels=(replace(finished.channel, frequency_mhz=10.0),))
    assert "ten is at 10 MHz instead of 25" in evidence_caveat([finished, ten])


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
    assert run("info", small_map.folder) == 0
    told = capsys.readouterr().out
    assert "results of lusee-bayes map" in told and "simulated by this run, seed 1" in told
    assert small_map.result.verdict() in told and "mean_alm.fits" in told
    assert run("info", small_map.folder / "diagnostics.nc") == 0
    (days,) = {len(c.judged.of_kind("day")) for c in small_map.result.channels}
    assert f"residuals by {days} days, 16 products" in capsys.readouterr().out
    assert "a folder that no run has written" in refused(capsys, "info", tmp_path)


COMMANDS = [name for name in app if not name.startswith("-")]
EXAMPLES = [
    (name, line)
    for name in COMMANDS
    for line in re.findall(r"^ *- ``(.*)``$", app[name].default_command.__doc__, re.MULTILINE)
]


@pytest.mark.parametrize("name", COMMANDS)
def test_help_shows_the_examples(name, capsys):
    assert main([name, "--help"]) == 0
    shown = " ".join(capsys.readouterr().out.split())
    examples = [line for its, line in EXAMPLES if its == name]
    assert "Examples" in shown and examples
    assert all(example in shown for example in examples)


@pytest.mark.parametrize(("name", "line"), EXAMPLES, ids=[line for _, line in EXAMPLES])
def test_examples_are_of_the_command_and_can_be_parsed(name, line):
    program, *arguments = shlex.split(line)
    assert (program, arguments[0]) == ("lusee-bayes", name)
    # an unknown option or a value of the wrong type raises
    command, *_ = app.parse_args(arguments, exit_on_error=False, print_error=False)
    assert command.__name__ == f"{name.replace('-', '_')}_command"


def test_keys_are_listed(capsys):
    assert main(["keys", "noise.gain"]) == 0
    shown = capsys.readouterr().out
    assert "noise.gain.correlation_h = 10.0\n    Correlation time\n" in shown
    assert "number, > 0 [h]" in shown
    assert main(["keys", "--markdown", "lmax"]) == 0
    assert "| `lmax` |" in capsys.readouterr().out
    assert "no key 'lmx'; did you mean 'lmax'?" in refused(capsys, "keys", "lmx")


# as without the extra "cluster": xarray imports Dask where it is there, and Dask SciPy
PROGRAM = """
import sys
sys.modules["dask"] = None
from lusee_bayes.cli.main import main
counted = []
if {count}:
    import jax
    jax.monitoring.register_event_duration_secs_listener(
        lambda name, *_, **__: counted.append(name)
    )
assert main({arguments!r}) == 0
print(len([name for name in counted if "backend_compile" in name]), *sys.modules)
"""


def outcome(*arguments, count=False):
    """The number of programs compiled, and the modules imported."""
    program = PROGRAM.format(count=count, arguments=[str(a) for a in arguments])
    environment = {name: v for name, v in os.environ.items() if not name.startswith("JAX")}
    environment["LUSEE_BAYES_CACHE"] = "off"
    command = [sys.executable, "-c", program]
    found = subprocess.run(command, capture_output=True, text=True, check=True, env=environment)
    n, *modules = found.stdout.splitlines()[-1].split()
    return int(n), set(modules)


@pytest.mark.parametrize("arguments", [["--help"], ["map", "--help"], ["--version"]])
def test_help_waits_for_no_library(arguments):
    _, modules = outcome(*arguments)
    assert not modules & {"jax", "numpy", "astropy", "healpy", "matplotlib", "xarray", "pydantic"}


@pytest.mark.parametrize(
    ("name", "spared"),
    [
        ("posterior.nc", {"jax", "healpy", "matplotlib", "scipy"}),
        ("diagnostics.nc", {"jax", "healpy", "matplotlib", "scipy"}),
        ("mean.fits", {"numpyro", "xarray", "lunarsky", "scipy.stats", "healpy", "matplotlib"}),
    ],
)
def test_info_waits_for_no_more_than_its_file(name, spared, small_map):
    _, modules = outcome("info", small_map.folder / name)
    assert not modules & spared


def test_a_map_compiles_little_and_imports_no_sampler(tmp_path):
    small = ("--set", "lmax=8", "--set", "observation.runs.0.cycles=0.2")
    n, modules = outcome("map", "fiducial", *small, "-o", tmp_path / "map", "-q", count=True)
    # single random numbers, most of them; none of it grows with the map
    assert 0 < n <= 60
    assert not modules & {"numpyro", "arviz_stats", "scipy.stats", "scipy.optimize"}
