"""Commands that look at what there is: runs, files, keys, the paper.

lusee-bayes compare: finished map runs side by side.

lusee-bayes compare-priors: one data set under several priors.

lusee-bayes report: the page of a finished run, made again.

lusee-bayes info: what is in files, or in the folders of runs.

lusee-bayes keys: the keys of a scenario.

lusee-bayes paper: the reference paper's figures and claims.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter
from rich.console import Console

from lusee_bayes.cli.options import (
    Clock,
    Cluster,
    DataFiles,
    Flag,
    Force,
    Output,
    Overrides,
    Quiet,
    Verbose,
    Workers,
    default_folder,
    load,
    say,
    show,
)
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.progress import Stages


def compare_command(
    *folders: Path,
    output: Annotated[Path, Parameter(name=["--output", "-o"])] = Path("output/comparison"),
    force: Force = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Set finished map runs side by side: maps, spectra, evidence.

    Parameters
    ----------
    folders
        Results of map, two or more.
    output
        Folder for comparison.html, comparison.csv and the figures.
    """
    from lusee_bayes.cli.tables import comparison_table
    from lusee_bayes.results.finished_runs import evidence_caveat
    from lusee_bayes.runs.compare_run import run_compare

    console = Console(quiet=quiet, soft_wrap=True)
    run = run_compare(folders, output, replace=force, stages=Stages(console, verbose=verbose))
    say(console, *(f"  {path}" for path in run.files))
    show(console, comparison_table(run.result))
    caveat = evidence_caveat(run.result)
    say(console, *([] if caveat is None else [caveat]), f"look at {output / 'comparison.html'}")


def compare_priors_command(
    scenario: str,
    *,
    data: DataFiles = None,
    clock: Clock = None,
    truth: Flag = False,
    priors: str | None = None,
    output: Output = None,
    set_: Overrides | None = None,
    workers: Workers = None,
    cluster: Cluster = None,
    force: Force = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Map one data set under several priors, and say which of them it prefers.

    Parameters
    ----------
    scenario
        A YAML file, or the name of a scenario of the package (fiducial, ...).
    data
        Visibilities to map: a file, or sessions of the spectrometer, one or many; without them the
        scenario's own are simulated.
    truth
        The given data are of the scenario's own sky: count how often error bars hold it.
    priors
        Two or more, with commas: isotropic, isotropic-sky (C_ell of the scenario's sky; simulated
        data only), local_scales. By default all that can be. The scenario's
        own section counts for the prior of its kind.
    output
        Folder for the results; by default output/NAME-priors.
    set_
        key.path=value; overrides an entry of the scenario, as often as needed.
    workers
        Processes of this machine that share out the priors; by default as many
        as pay.
    cluster
        Address of a Dask scheduler, as tcp://host:8786, whose workers share out the priors;
        by default DASK_SCHEDULER_ADDRESS.
    """
    from lusee_bayes.cli.tables import priors_table
    from lusee_bayes.core.engines import open_engine
    from lusee_bayes.report.pages import REPORT
    from lusee_bayes.runs.compare_run import run_compare_priors
    from lusee_bayes.runs.cost import demand_of, posterior_cost

    console = Console(quiet=quiet, soft_wrap=True)
    resolved, stages = (
        load(scenario, set_, replaces=output if force else None, flight__clock=clock),
        Stages(console, verbose=verbose),
    )
    names = None if priors is None else [n.strip() for n in priors.split(",") if n.strip()]
    demand = demand_of([posterior_cost(resolved)])
    with open_engine(demand, workers, cluster) as engine:
        run = run_compare_priors(
            resolved,
            output or default_folder(scenario, "-priors"),
            names,
            data=data,
            truth=truth,
            name=Path(scenario).stem,
            engine=engine,
            replace=force,
            stages=stages,
        )
    say(console, *(f"  {path}" for path in run.files))
    show(console, priors_table(run.result))
    say(console, *run.result.lines(), f"look at {run.folder / REPORT}")


def report_command(folder: Path, *, quiet: Quiet = False) -> None:
    """Write report.html again from the results in the folder of a run.

    Parameters
    ----------
    folder
        Results of map, sample or validate.
    """
    from lusee_bayes.report.pages import write_report

    path = write_report(folder)
    Console(quiet=quiet, soft_wrap=True).print(f"look at {path}", highlight=False, markup=False)


def info_command(files: Annotated[list[Path], Parameter(required=True)], /) -> int:
    """Say what is in files (visibilities, sessions, a posterior, samples, a sky) or runs' folders.

    Parameters
    ----------
    files
        One or several; one that cannot be read is named, and the others are shown.
    """
    from lusee_bayes.report.describe import describe

    console, errors = Console(soft_wrap=True), Console(stderr=True, soft_wrap=True)
    refused = 0
    for number, file in enumerate(files):
        try:
            told = describe(file)
        except InputError as error:
            errors.print(f"lusee-bayes: {error}", highlight=False, markup=False)
            refused += 1
        else:
            # a part for each
            console.print(f"\n{told}" if number else told, highlight=False, markup=False)
    return 2 if refused else 0


def keys_command(
    key: str = "", *, markdown: Annotated[bool, Parameter(negative="")] = False
) -> None:
    """List the keys of a scenario: meaning, unit, choices, default.

    Parameters
    ----------
    key
        A key, or a section (noise, noise.gain, ...): list only what is in it.
    markdown
        Write a table of Markdown.
    """
    from lusee_bayes.experiment.keys import keys_as_markdown, scenario_keys

    console, keys = Console(soft_wrap=True), scenario_keys(key)
    if markdown:
        say(console, keys_as_markdown(keys).rstrip())
        return
    for found in keys:
        model = f"  (model {found.kind})" if found.kind else ""
        unit = f" [{found.unit}]" if found.unit else ""
        say(console, f"{found.path} = {found.default}{model}")
        say(console, f"    {found.meaning}")
        say(console, f"    {found.choices}{unit}")


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
    from lusee_bayes.core.engines import open_engine
    from lusee_bayes.paper.cases import paper_scenarios
    from lusee_bayes.runs.cost import demand_of, posterior_cost
    from lusee_bayes.runs.paper_run import run_paper

    console, skies = Console(quiet=quiet, soft_wrap=True), sky or []
    demand = demand_of([posterior_cost(s) for s in paper_scenarios(skies=skies).values()])
    stages = Stages(console, verbose=verbose)
    with open_engine(demand, workers, cluster) as engine:
        run = run_paper(output, skies=skies, engine=engine, replace=force, stages=stages)
    say(console, *(f"  {path}" for path in run.files if path.suffix != ".nc"))
    say(console, (run.folder / "claims.md").read_text(encoding="utf-8").splitlines()[0])
    say(console, f"look at {run.folder}/claims.md")
