"""The command line: parsing, error messages and exit codes. The work is in ``runs``.

Exit codes: 0 success; 1 a validation failed, workers were lost, or memory or disk ran out; 2 bad
input (one sentence on standard error); 130 interrupted; 143 terminated.
"""

import atexit
import gc
import io
import os
import re
import shlex
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from os.path import expanduser
from threading import current_thread, main_thread

from cyclopts import CycloptsError, UnknownOptionError, UnusedCliTokensError

from lusee_bayes.cli.commands import app
from lusee_bayes.cli.options import say
from lusee_bayes.core.errors import InputError, WorkersLost
from lusee_bayes.core.version import COMMAND, printable

# the start of a path in the user's home folder, alone or after an option name
HOME = re.compile(r"^(--[a-z-]+=)?(~.*)$", re.DOTALL)

# how out-of-memory RuntimeErrors begin: those of XLA, and of Python's threads
NO_MEMORY = ("RESOURCE_EXHAUSTED", "can't start new thread")
HINTS = {
    UnknownOptionError: " Keys of a scenario are set with --set KEY=VALUE.",
    UnusedCliTokensError: " Values that contain spaces need quotes: --set 'KEY={a: 1}'.",
}
UNCHANGED = "results are complete or unchanged"


@contextmanager
def _heeding_termination() -> Iterator[list[int]]:
    """Treat SIGTERM and SIGHUP as Ctrl-C during the block; yields those that came."""
    came: list[int] = []

    def interrupt(number: int, _: object) -> None:
        came.append(number)
        raise KeyboardInterrupt

    numbers = [signal.SIGTERM, signal.SIGHUP] if current_thread() is main_thread() else []
    heeded = [number for number in numbers if signal.getsignal(number) is signal.SIG_DFL]
    for number in heeded:
        signal.signal(number, interrupt)
    try:
        yield came
    finally:
        for number in heeded:
            signal.signal(number, signal.SIG_DFL)


def main(arguments: list[str] | None = None) -> int:
    """Run one command; returns the exit code."""
    # imports and figures create millions of long-lived objects; searching them for cycles over and
    # over takes a fifth of their time
    gc.set_threshold(100_000, 20, 100)
    given = sys.argv[1:] if arguments is None else arguments
    # the shell does not expand ~ within an option, as in --data=~/a.nc
    expanded = [HOME.sub(lambda m: (m[1] or "") + expanduser(m[2]), one) for one in given]
    for stream in (sys.stdout, sys.stderr):
        # file names and reports may contain bytes or letters that the terminal's encoding lacks
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    before = COMMAND.set(printable(shlex.join(["lusee-bayes", *given])))
    try:
        with _heeding_termination() as came:
            code, sentence = _outcome(expanded, came)
    finally:
        COMMAND.reset(before)
    if sentence:
        say(f"lusee-bayes: {sentence}", stderr=True)
    return code


def program() -> None:
    """Run the command of this process, and end it with its exit code.

    The process ends without freeing its memory object by object, which takes half a second after a
    map. Handlers registered for the exit have run, and output is flushed.
    """
    code = main()
    atexit._run_exitfuncs()
    for stream in (sys.stdout, sys.stderr):
        stream.flush()
    os._exit(code)


def _outcome(arguments: list[str], came: list[int]) -> tuple[int, str]:
    """The exit code of a command, and the reason if it failed."""
    try:
        code = app(arguments, exit_on_error=False, print_error=False, result_action="return_value")
    except (InputError, CycloptsError) as error:
        return 2, " ".join(str(error).split()) + HINTS.get(type(error), "")
    except BrokenPipeError:
        # the reader closed the pipe, as head does when it has its lines
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1, ""
    except OSError as error:
        if error.errno is None:
            raise
        file = f" ('{error.filename}')" if error.filename else ""
        return 1, f"{error.strerror}{file}; {UNCHANGED}"
    except WorkersLost as error:
        return 1, str(error)
    except (MemoryError, RuntimeError) as error:
        if not isinstance(error, MemoryError) and not str(error).startswith(NO_MEMORY):
            raise
        why = " ".join(str(error).split())[:200]
        return 1, (
            f"not enough memory{f' ({why})' if why else ''}; {UNCHANGED}. Use a smaller lmax, "
            "fewer times or fewer draws, or a machine with more memory"
        )
    except KeyboardInterrupt as interrupt:
        # runs report the state of their folder
        held = str(interrupt) or "nothing was written"
        how = "terminated" if came else "interrupted"
        return 128 + (came or [signal.SIGINT])[0], f"{how}; {held}"
    return code if isinstance(code, int) else 0, ""
