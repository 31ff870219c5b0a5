"""Progress of a run: the current stage, the time of each stage, and memory."""

import os
import resource
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path

from rich import progress as bars
from rich.console import Console
from rich.markup import escape

from lusee_bayes.core.version import versions

# limits of the process's control group, of either version
CGROUPS = Path("/sys/fs/cgroup")
CGROUP_LIMITS = (CGROUPS / "memory.max", CGROUPS / "memory" / "memory.limit_in_bytes")
# address space that libraries and threads reserve without using it; XLA aborts with less
RESERVED = 1_500_000_000
# least seconds and fraction of a stage between lines of progress in a file
LINE_S, LINE_SHARE = 10.0, 0.05


@dataclass
class Stages:
    """Shows and times the stages of a run.

    Attributes
    ----------
    console : Console or None
        Where to print; None prints nothing.
    seconds : dict of str to float
        Wall-clock time of every finished stage, summed over repetitions.
    verbose : bool
        Also print the peak memory after every stage.
    """

    console: Console | None = None
    seconds: dict[str, float] = field(default_factory=dict)
    verbose: bool = False

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        """Run a ``with`` block as a stage: show a spinner, then print its time."""
        start = time.perf_counter()
        with nullcontext() if self.console is None else self.console.status(escape(f"{name} ...")):
            yield
        self._finish(name, start)

    @contextmanager
    def progress(
        self, name: str, total: int, rounds: bool = False
    ) -> Iterator[Callable[[int, str], None]]:
        """Run a ``with`` block as a stage with a progress bar, or with lines outside a terminal.

        Parameters
        ----------
        name : str
        total : int
            Number of steps.
        rounds : bool
            The steps are rounds until something settles, ``total`` at most: no share is known.

        Yields
        ------
        callable
            Updates the bar; its arguments are the number of steps done and a remark.
        """
        start = time.perf_counter()
        if self.console is None:
            yield lambda done, remark="": None
        elif not self.console.is_terminal:
            yield self._lines(name, total, rounds)
        else:
            of_rounds = bars.TextColumn("round {task.completed}, at most {task.total}")
            share = (bars.BarColumn(), bars.MofNCompleteColumn(), bars.TimeRemainingColumn())
            columns = (
                bars.TextColumn("{task.description}", markup=False),
                *([of_rounds] if rounds else share),
                bars.TimeElapsedColumn(),
                bars.TextColumn("{task.fields[remark]}", markup=False),
            )
            with bars.Progress(*columns, console=self.console, transient=True) as bar:
                task = bar.add_task(name, total=total, remark="")
                yield lambda done, remark="": bar.update(task, completed=done, remark=remark)
        self._finish(name, start)

    def _lines(self, name: str, total: int, rounds: bool) -> Callable[[int, str], None]:
        """Progress in a file: a line once 10 s and 5 % of the stage have passed since the last."""
        said, last = time.perf_counter(), 0
        counting = threading.Lock()

        def update(done: int, remark: str = "") -> None:
            nonlocal said, last
            now = time.perf_counter()
            with counting:
                if now - said < LINE_S or abs(done - last) < LINE_SHARE * total or done >= total:
                    return
                said, last = now, done
            share = f", at most {total};" if rounds else f" of {total} ({done / total:.0%})"
            self.say(f"  {name}: {'round ' * rounds}{done}{share} {remark}".rstrip())

        return update

    def say(self, text: str) -> None:
        """Print a line."""
        if self.console is not None:
            self.console.print(text, highlight=False, markup=False)

    def _finish(self, name: str, start: float) -> None:
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start
        memory = f"  {peak_memory_gb():6.2f} GB" if self.verbose else ""
        self.say(f"  {name:<28} {self.seconds[name]:7.2f} s{memory}")


def peak_memory_gb() -> float:
    """Return the largest resident size of this process so far, in GB (10^9 bytes)."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 1e9 if sys.platform == "darwin" else peak * 1024 / 1e9


def about_run(seconds: Mapping[str, float]) -> dict[str, object]:
    """Properties of a run to store with its results: seconds by stage, memory, versions."""
    return {
        "seconds": {name: round(s, 3) for name, s in seconds.items()},
        "peak_memory_gb": round(peak_memory_gb(), 3),
        "versions": versions(),
    }


@lru_cache(maxsize=1)
def memory_limit() -> int:
    """Memory of this machine in bytes, or the limit of this process if that is lower."""
    limits = [os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")]
    addresses, _ = resource.getrlimit(resource.RLIMIT_AS)
    if addresses != resource.RLIM_INFINITY:
        limits.append(max(0, addresses - RESERVED))
    for path in CGROUP_LIMITS:
        text = path.read_text(encoding="utf-8").strip() if path.is_file() else ""
        if text.isdigit():
            limits.append(int(text))
    return min(limits)


def gigabytes(n: float | int) -> str:
    """Format a number of bytes: 1.2 GB."""
    return f"{n / 1e9:.2g} GB" if n < 1e11 else f"{n / 1e9:,.0f} GB"
