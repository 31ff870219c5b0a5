"""Help: every command shows examples, and these can be parsed."""

from __future__ import annotations

import shlex

import pytest

from lusee_bayes.cli.commands import COMMANDS
from lusee_bayes.cli.main import app, main

EXAMPLES = [(name, line) for name, (_, _, lines) in COMMANDS.items() for line in lines]


@pytest.mark.parametrize("name", COMMANDS)
def test_help_shows_the_examples(name, capsys):
    assert main([name, "--help"]) == 0
    shown = " ".join(capsys.readouterr().out.split())
    for example in COMMANDS[name][2]:
        assert example in shown
    assert "Examples" in shown


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
    assert main(["keys", "lmx"]) == 2
    assert capsys.readouterr().err == (
        "lusee-bayes: a scenario has no key 'lmx'; did you mean 'lmax'?\n"
    )
