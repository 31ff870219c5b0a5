"""Start, watch and end several processes of one command on this machine."""

from __future__ import annotations

import os
import queue
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import IO

from rich.console import Console

from lusee_bayes.core.errors import InputError
from lusee_bayes.core.rendezvous import COORDINATOR, LEASH, PROCESS, PROCESSES

# seconds that processes have to end by themselves, when another has failed or a signal asks them to
GRACE = 3.0


class _Signalled(BaseException):
    """Raised when a signal asks this process to end."""


def run_processes(n: int, arguments: list[str], module: str = "lusee_bayes.cli") -> int:
    """Run ``python -m module arguments`` in several processes, which make up one run.

    They meet in :func:`lusee_bayes.core.rendezvous.join`. Only the first one writes to the
    terminal. When one fails the others are ended, and a sentence on standard error says which one
    it was. None of them outlives this process.

    Parameters
    ----------
    n : int
        Number of processes.
    arguments : list of str
        Of the command line.
    module : str

    Returns
    -------
    int
        The exit code: that of all processes if it is the same for all; 2 if one found bad input,
        whose sentence is shown once; 130 if interrupted; otherwise 1.

    Raises
    ------
    InputError
        If ``n`` is less than 1.
    """
    if n < 1:
        raise InputError(f"the number of processes must be at least 1, got {n}")
    children: list[subprocess.Popen] = []
    number = signal.SIGTERM
    with ExitStack() as stack:
        notes = [stack.enter_context(tempfile.TemporaryFile()) for _ in range(n)]
        leash, end = os.pipe()
        stack.callback(os.close, end)
        try:
            with _signals_raised():
                try:
                    address = f"127.0.0.1:{_free_port()}"
                    for k in range(n):
                        environment = _environment(address, n, k, leash)
                        children.append(_start(module, arguments, environment, leash, notes[k]))
                finally:
                    os.close(leash)
                return _watch(children, notes)
        except KeyboardInterrupt:
            _end(children, signal.SIGINT)
            if not children or children[0].returncode != 130:
                _say("interrupted; the same command continues from what is finished")
            return 130
        except _Signalled as signalled:
            number = signalled.args[0]
        finally:
            _end(children, signal.SIGTERM)
    # now let the signal end this process, as it would have done without a handler
    signal.signal(number, signal.SIG_DFL)
    os.kill(os.getpid(), number)
    return 128 + number


def _environment(address: str, n: int, k: int, leash: int) -> dict[str, str]:
    added = {COORDINATOR: address, PROCESSES: str(n), PROCESS: str(k), LEASH: str(leash)}
    # the same modules as here, and no proxy between processes of one machine
    added["PYTHONPATH"] = os.pathsep.join(path or os.getcwd() for path in sys.path)
    for name in ("no_proxy", "NO_PROXY"):
        added[name] = ",".join(filter(None, [os.environ.get(name), "127.0.0.1"]))
    return os.environ | added


def _start(
    module: str, arguments: list[str], environment: dict[str, str], leash: int, note: IO[bytes]
) -> subprocess.Popen:
    first = environment[PROCESS] == "0"
    return subprocess.Popen(
        [sys.executable, "-P", "-m", module, *arguments],
        env=environment,
        stdin=subprocess.DEVNULL,
        stdout=None if first else subprocess.DEVNULL,
        stderr=None if first else note,
        pass_fds=(leash,),
        # Ctrl-C comes to the launcher alone, which passes it on
        start_new_session=True,
    )


def _watch(children: list[subprocess.Popen], notes: list[IO[bytes]]) -> int:
    """Wait until all have ended, or one of them badly; returns the exit code of the run."""
    ended: queue.SimpleQueue[tuple[int, int]] = queue.SimpleQueue()
    for k, child in enumerate(children):
        # with a thread for each, the queue has processes in the order in which they end
        wait = threading.Thread(target=lambda k=k, child=child: ended.put((k, child.wait())))
        wait.daemon = True
        wait.start()
    codes: dict[int, int] = {}
    failed, deadline = None, None
    while len(codes) < len(children):
        try:
            left = None if deadline is None else max(0.0, deadline - time.monotonic())
            k, codes[k] = ended.get(timeout=left)
        except queue.Empty:
            break
        if codes[k] != 0 and failed is None:
            # an error that all of them find comes from all at nearly the same time
            failed, deadline = k, time.monotonic() + (GRACE if codes[k] > 0 else 0.0)
    if failed is None:
        return 0
    if codes[failed] > 0 and list(codes.values()) == [codes[failed]] * len(children):
        return codes[failed]
    # those that miss a killed process may be seen to end before it
    failed = next((k for k, code in codes.items() if code < 0), failed)
    _end(children, signal.SIGTERM)
    # a spinner may have hidden the cursor
    Console().show_cursor()
    if 2 in codes.values():
        if codes.get(0) != 2:
            _show(notes[next(k for k, code in codes.items() if code == 2)])
        return 2
    _show(notes[failed])
    code = codes[failed]
    how = f"ended with exit code {code}" if code > 0 else f"was ended by {_signal_name(-code)}"
    _say(
        f"process {failed} of 0..{len(children) - 1} {how}, and the others were stopped; the same "
        "command continues from what is finished"
    )
    return 1


def _end(children: list[subprocess.Popen], how: signal.Signals) -> None:
    """End every process that is still running, and wait for it."""
    for child in children:
        if child.poll() is None:
            child.send_signal(how)
    deadline = time.monotonic() + GRACE
    for child in children:
        try:
            child.wait(max(0.0, deadline - time.monotonic()))
        except subprocess.TimeoutExpired:
            child.kill()
            child.wait()


@contextmanager
def _signals_raised() -> Iterator[None]:
    """Raise _Signalled where a signal would end this process but not its children."""

    def stop(number, frame):
        raise _Signalled(number)

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGHUP)}
    for number, handler in before.items():
        # under nohup SIGHUP is ignored, and stays so
        if handler is not signal.SIG_IGN:
            signal.signal(number, stop)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def _signal_name(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"


def _show(note: IO[bytes]) -> None:
    """Copy the standard error of a silent process to that of this one."""
    note.seek(0)
    sys.stderr.write(note.read().decode(errors="replace"))
    sys.stderr.flush()


def _say(sentence: str) -> None:
    console = Console(stderr=True, soft_wrap=True, highlight=False)
    console.print(f"lusee-bayes: {sentence}", markup=False)
