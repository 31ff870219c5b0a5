"""The command line: parsing, error messages and exit codes. The work is in ``runs``.

Exit codes: 0 success, 1 a validation that failed or workers that were lost, 2 bad input (one
sentence on standard error), 130 interrupted.
"""

from __future__ import annotations

import gc
import os
import re
import shlex
import sys

from cyclopts import App, CycloptsError
from rich.console import Console

from lusee_bayes.cli.commands import COMMANDS, help_of
from lusee_bayes.core.command_line import COMMAND
from lusee_bayes.core.errors import InputError, WorkersLost
from lusee_bayes.core.paths import user_path
from lusee_bayes.core.version import __version__

# the beginning of a path in the user's folder, by itself or after the name of an option
HOME = re.compile(r"^(--[a-z-]+=)?(~.*)$", re.DOTALL)

app = App(
    name="lusee-bayes",
    version=__version__,
    suppress_keyboard_interrupt=False,
    help=(
        "Bayesian maps of the low-frequency sky from LuSEE-Night's visibilities.\n\n"
        "Exit codes: 0 success, 1 a validation that failed or workers that were lost, 2 bad input "
        "(one sentence on standard error), 130 interrupted. lusee-bayes COMMAND --help shows "
        "examples."
    ),
)
app.register_install_completion_command()
# named by path: each is imported when called, so that --help and completion answer at once
for _name in COMMANDS:
    _command = f"{_name.replace('-', '_')}_command"
    app.command(f"lusee_bayes.cli.{_command}:{_command}", name=_name, help=help_of(_name))


def main(arguments: list[str] | None = None) -> int:
    """Run one command; returns the exit code."""
    # imports and figures make objects by the million that stay: to search them for cycles again
    # and again takes a fifth of their time
    gc.set_threshold(100_000, 20, 100)
    given = sys.argv[1:] if arguments is None else arguments
    # ~ within an option, as in --data=~/a.nc, is one that no shell has replaced
    expanded = [HOME.sub(lambda own: (own[1] or "") + str(user_path(own[2])), one) for one in given]
    before = COMMAND.set(shlex.join(["lusee-bayes", *given]))
    errors = Console(stderr=True, soft_wrap=True, highlight=False)
    try:
        code = app(expanded, exit_on_error=False, print_error=False, result_action="return_value")
    except InputError as error:
        errors.print(f"lusee-bayes: {error}", markup=False)
        return 2
    except CycloptsError as error:
        errors.print(f"lusee-bayes: {' '.join(str(error).split())}", markup=False)
        return 2
    except BrokenPipeError:
        # whoever was to read the output has gone: head has its lines
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except OSError as error:
        if error.errno is None:
            raise
        at = f" ('{error.filename}')" if error.filename else ""
        errors.print(f"lusee-bayes: {error.strerror}{at}; results are whole or as they were")
        return 1
    except WorkersLost as error:
        errors.print(f"lusee-bayes: {error}", markup=False)
        return 1
    except KeyboardInterrupt as interrupt:
        # runs say what their folder holds
        held = str(interrupt) or "nothing has been written"
        errors.print(f"lusee-bayes: interrupted; {held}", markup=False)
        return 130
    finally:
        COMMAND.reset(before)
    return code if isinstance(code, int) else 0
