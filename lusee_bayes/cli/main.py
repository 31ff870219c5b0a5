"""The command line: parsing, error messages and exit codes. The work is in ``runs``.

Exit codes: 0 success, 1 a validation failed, or workers, memory or disk gave out, 2 bad input (one
sentence on standard error), 130 interrupted, 143 terminated.
"""

from __future__ import annotations

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

from cyclopts import CycloptsError
from rich.console import Console

from lusee_bayes.cli.commands import app
from lusee_bayes.cli.options import say
from lusee_bayes.core.errors import InputError, WorkersLost
from lusee_bayes.core.version import COMMAND, printable

# the beginning of a path in the user's folder, by itself or after the name of an option
HOME = re.compile(r"^(--[a-z-]+=)?(~.*)$", re.DOTALL)

# beginnings of messages of RuntimeErrors for want of memory: of XLA, and of Python's threads
NO_MEMORY = ("RESOURCE_EXHAUSTED", "can't start new thread")
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
    # imports and figures make objects by the million that stay: to search them for cycles again
    # and again takes a fifth of their time
    gc.set_threshold(100_000, 20, 100)
    given = sys.argv[1:] if arguments is None else arguments
    # ~ within an option, as in --data=~/a.nc, is one that no shell has replaced
    expanded = [HOME.sub(lambda own: (own[1] or "") + expanduser(own[2]), one) for one in given]
    for stream in (sys.stdout, sys.stderr):
        # names of files may have bytes, and reports letters, that the terminal's encoding lacks
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    before = COMMAND.set(printable(shlex.join(["lusee-bayes", *given])))
    try:
        with _heeding_termination() as came:
            code, sentence = _outcome(expanded, came)
    finally:
        COMMAND.reset(before)
    if sentence:
        say(Console(stderr=True, soft_wrap=True), f"lusee-bayes: {sentence}")
    return code


def _outcome(arguments: list[str], came: list[int]) -> tuple[int, str]:
    """The exit code of a command, and why it has failed, if it has."""
    try:
        code = app(arguments, exit_on_error=False, print_error=False, result_action="return_value")
    except (InputError, CycloptsError) as error:
        return 2, " ".join(str(error).split())
    except BrokenPipeError:
        # whoever was to read the output has gone: head has its lines
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1, ""
    except OSError as error:
        if error.errno is None:
            raise
        at = f" ('{error.filename}')" if error.filename else ""
        return 1, f"{error.strerror}{at}; {UNCHANGED}"
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
        # runs say what their folder holds
        held = str(interrupt) or "nothing has been written"
        how = "terminated" if came else "interrupted"
        return 128 + (came or [signal.SIGINT])[0], f"{how}; {held}"
    return code if isinstance(code, int) else 0, ""
