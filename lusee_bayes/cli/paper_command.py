"""lusee-bayes paper: the reference paper's figures and claims."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter
from rich.console import Console

from lusee_bayes.cli.options import Cluster, Force, Quiet, Verbose, Workers, say
from lusee_bayes.core.progress import Stages


def paper_command(
    *,
    output: Annotated[Path, Parameter(name=["--output", "-o"])] = Path("output/paper"),
    sky: Annotated[list[Path] | None, Parameter(consume_multiple=True, negative="")] = None,
    workers: Workers = None,
    cluster: Cluster = None,
    force: Force = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
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
    workers
        Processes of this machine that share out the cases; by default one.
    cluster
        Address of a Dask scheduler, as tcp://host:8786, whose workers share out the cases; by
        default DASK_SCHEDULER_ADDRESS.
    """
    from lusee_bayes.core.engine import open_engine
    from lusee_bayes.paper.cases import paper_scenarios
    from lusee_bayes.results.cost import demand_of, posterior_cost
    from lusee_bayes.runs.paper_run import run_paper

    console, skies = Console(quiet=quiet, soft_wrap=True), sky or []
    demand = demand_of([posterior_cost(s) for s in paper_scenarios(skies=skies).values()])
    stages = Stages(console, verbose=verbose)
    with open_engine(demand, workers, cluster) as engine:
        run = run_paper(output, skies=skies, engine=engine, replace=force, stages=stages)
    say(console, *(f"  {path}" for path in run.files if path.suffix != ".nc"))
    say(console, (run.folder / "claims.md").read_text(encoding="utf-8").splitlines()[0])
    say(console, f"look at {run.folder}/claims.md")
