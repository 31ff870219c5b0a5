"""lusee-bayes paper: the reference paper's figures and claims."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter
from rich.console import Console

from lusee_bayes.cli.options import Force, Quiet, say
from lusee_bayes.core.progress import Stages


def paper_command(
    *,
    output: Annotated[Path, Parameter(name=["--output", "-o"])] = Path("output/paper"),
    sky: Annotated[list[Path] | None, Parameter(consume_multiple=True, negative="")] = None,
    force: Force = False,
    quiet: Quiet = False,
) -> None:
    """Reproduce the figures of the reference paper and judge its claims.

    Cases that were computed before with the same scenario and version are kept, so that an
    interrupted run continues where it stopped.

    Parameters
    ----------
    output
        Folder for the cases, figures and tables.
    sky
        ULSA HDF5 files with the frequency in their names, as exp10.0MHz_sky.hdf5; each case scales
        the one nearest in log frequency.
        Without them the embedded sky is used.
    force
        Replace results of another run in the folder.
    quiet
        Print nothing but errors.
    """
    from lusee_bayes.runs.paper_run import run_paper

    console = Console(quiet=quiet, soft_wrap=True)
    run = run_paper(output, skies=sky or [], replace=force, stages=Stages(console))
    say(console, *(f"  {path}" for path in run.files if path.suffix != ".nc"))
    say(console, (run.folder / "claims.md").read_text().splitlines()[0])
    say(console, f"look at {run.folder}/claims.md")
