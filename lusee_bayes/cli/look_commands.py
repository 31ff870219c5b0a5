"""Commands that look at what there is.

``compare`` sets finished maps side by side, ``compare-priors`` maps of one data set under several
priors; ``report`` makes the page of a run again; ``info`` says what is in files and folders,
``keys`` what can be in a scenario; ``paper`` reproduces the reference paper.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter
from rich.console import Console

from lusee_bayes.cli.options import DataOptions, EngineOptions, Flag, Many, Options, Output, say
from lusee_bayes.core.errors import InputError


def compare_command(
    *folders: Path, output: Output = Path("output/comparison"), options: Options = Options()
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

    run = run_compare(folders, output, **options.running())
    lines = [f"look at {output / 'comparison.html'}"]
    if (caveat := evidence_caveat(run.result)) is not None:
        lines.insert(0, caveat)
    options.tell(run.files, *lines, table=comparison_table(run.result))


def compare_priors_command(
    scenario: str,
    *,
    truth: Flag = False,
    priors: str | None = None,
    options: DataOptions = DataOptions(),
    engine: EngineOptions = EngineOptions(),
) -> None:
    """Map one data set under several priors, and say which of them it prefers.

    Parameters
    ----------
    scenario
        A YAML file, or the name of a scenario of the package (fiducial, ...).
    truth
        The given data are of the scenario's own sky: count how often error bars hold it.
    priors
        Two or more, with commas: isotropic, isotropic-sky (C_ell of the scenario's sky; simulated
        data only), local_scales. By default all that can be. The scenario's
        own section counts for the prior of its kind.
    """
    from lusee_bayes.cli.tables import priors_table
    from lusee_bayes.report.pages import REPORT
    from lusee_bayes.runs.compare_run import run_compare_priors
    from lusee_bayes.runs.cost import demand_of, posterior_cost

    resolved = options.loaded(scenario)
    names = None if priors is None else [n.strip() for n in priors.split(",") if n.strip()]
    with engine.open(demand_of([posterior_cost(resolved)])) as opened:
        run = run_compare_priors(
            resolved,
            options.folder(scenario, "-priors"),
            names,
            data=options.data,
            truth=truth,
            name=Path(scenario).stem,
            engine=opened,
            **options.running(),
        )
    lines = [*run.result.lines(), f"look at {run.folder / REPORT}"]
    options.tell(run.files, *lines, table=priors_table(run.result))


def report_command(
    folder: Path, *, quiet: Annotated[Flag, Parameter(name=["--quiet", "-q"])] = False
) -> None:
    """Write report.html again from the results in the folder of a run.

    Parameters
    ----------
    folder
        Results of map, sample or validate.
    quiet
        Print nothing but errors.
    """
    from lusee_bayes.report.pages import write_report

    say(Console(quiet=quiet, soft_wrap=True), f"look at {write_report(folder)}")


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
            say(errors, f"lusee-bayes: {error}")
            refused += 1
        else:
            # a part for each
            say(console, f"\n{told}" if number else told)
    return 2 if refused else 0


def keys_command(key: str = "", *, markdown: Flag = False) -> None:
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
        say(console, f"    {found.meaning}", f"    {found.choices}{unit}")


def paper_command(
    *,
    output: Output = Path("output/paper"),
    sky: Annotated[tuple[Path, ...], Many] = (),
    options: Options = Options(),
    engine: EngineOptions = EngineOptions(),
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
    """
    from lusee_bayes.paper.cases import paper_scenarios
    from lusee_bayes.runs.cost import demand_of, posterior_cost
    from lusee_bayes.runs.paper_run import run_paper

    demand = demand_of([posterior_cost(s) for s in paper_scenarios(skies=sky).values()])
    with engine.open(demand) as opened:
        run = run_paper(output, skies=sky, engine=opened, **options.running())
    verdict = (run.folder / "claims.md").read_text(encoding="utf-8").splitlines()[0]
    files = [path for path in run.files if path.suffix != ".nc"]
    options.tell(files, verdict, f"look at {run.folder}/claims.md")
