"""Comparisons: of finished map runs, and of one data set mapped under several priors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from lusee_bayes.core.engine import Engine, Tasks, ThisProcess
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.progress import Stages
from lusee_bayes.experiment.data_files import Data
from lusee_bayes.experiment.experiment import Experiment, infer, observed
from lusee_bayes.experiment.rounds import Inference, learned_prior, named_priors, rebuilds
from lusee_bayes.experiment.scenario import Scenario, load_scenario
from lusee_bayes.judge.residuals import held_out
from lusee_bayes.judge.split import Split
from lusee_bayes.report.figures.maps import map_fidelity, maps_of_runs
from lusee_bayes.report.figures.plans import priors
from lusee_bayes.report.pages import comparison_page
from lusee_bayes.report.rendering import render_text
from lusee_bayes.results.channel import ChannelResult
from lusee_bayes.results.channel_map import conditioned
from lusee_bayes.results.finished_runs import FinishedRun, Provenance, comparison_rows, read_runs
from lusee_bayes.results.prior_comparison import PriorComparison, PriorSummary
from lusee_bayes.runs.cost import measured_experiment
from lusee_bayes.runs.folder import SCENARIO, Output, RunKind, RunOutcome, run_folder
from lusee_bayes.systematics.context import Setup


def run_compare(
    folders: Sequence[str | Path],
    folder: str | Path,
    *,
    replace: bool = False,
    stages: Stages | None = None,
) -> RunOutcome[list[FinishedRun]]:
    """Compare finished map runs, and write page, table and figures in one transaction.

    Parameters
    ----------
    folders : sequence of paths
        Folders of two or more finished map runs.
    folder : path
        Folder of the results.
    replace, stages : bool and Stages, optional
        As in :func:`.run_map`.

    Raises
    ------
    InputError
        For fewer than two folders, or one that is not the folder of a finished map run.
    """
    with run_folder(folder, COMPARISON, None, None, *folders, replace=replace) as run:
        return run.write(read_runs(folders), stages or Stages())


def _write_page(runs: list[FinishedRun], folder: Path) -> None:
    (folder / "comparison.html").write_text(comparison_page(runs, folder), encoding="utf-8")


# contents of the folder of a comparison; a new file is one line here
COMPARISON = RunKind(
    "compare",
    outputs=(Output(_write_page), Output.rows("comparison.csv", comparison_rows)),
    figures={
        "maps": maps_of_runs,
        "curves": lambda runs: map_fidelity({run.name: run.channel for run in runs}),
    },
    dpi=100,
)


def run_compare_priors(
    scenario: Scenario | str | Path,
    folder: str | Path,
    priors: Sequence[str] | None = None,
    *,
    data: Data | None = None,
    truth: bool = False,
    name: str = "the scenario",
    engine: Engine | None = None,
    replace: bool = False,
    stages: Stages | None = None,
) -> RunOutcome[PriorComparison]:
    """Map one data set under several priors, and report which of them the data prefer.

    A, N and the data are the same for all; each result equals that of :func:`run_map`. The folder
    is written in one transaction.

    Parameters
    ----------
    scenario : Scenario, or its file or name
        With one frequency.
    folder : path
        Folder of the results.
    priors : sequence of str, optional
        Two or more names (:func:`.named_priors`); by default all possible ones.
    data : Visibilities, path, or sequence of them, optional
        Visibilities to map; if omitted, data are simulated from the scenario.
    truth : bool
        The given data were simulated from this scenario's sky.
    name : str
        Name of the scenario, for the title.
    engine : Engine, optional
        Where priors are computed; by default in this process, one after the other.
    replace, stages : bool and Stages, optional
        As in :func:`.run_map`.

    Raises
    ------
    InputError
        If the scenario has several frequencies or samples an unknown, and as
        :func:`.named_priors` and :func:`run_map`.
    """
    scenario = load_scenario(scenario)
    scenario = scenario if data is None else scenario.of_measured()
    engine, stages = engine or ThisProcess(side_by_side=1), stages or Stages()
    if not scenario.single:
        raise InputError("compare-priors works on a single frequency; remove frequencies_mhz")
    scenario.require_marginal("compare-priors", "set treatment=marginalised")
    sections = named_priors(priors, scenario, known_sky=data is None or truth)
    sections = {name: section.anchored() for name, section in sections.items()}
    origin = {"truth": truth or None, "priors": ",".join(sections)}
    with run_folder(folder, COMPARE_PRIORS, scenario, data, replace=replace, **origin) as run:
        experiment = measured_experiment(scenario, data, stages, truth=truth, make=observed)
        with stages("data"):
            inferred = infer(experiment)

        def under(prior: str) -> tuple[PriorSummary, ChannelResult]:
            return _under(prior, experiment.setup.with_prior(sections[prior]), experiment, inferred)

        engine.work_in(run.path)
        mapped = engine.each(Tasks(under, list(sections), list(sections)), stages, "priors")
        result = PriorComparison(name, scenario, *zip(*mapped, strict=True), stages.seconds)
        return run.write(result, stages, Provenance.of_experiment(experiment, data))


def _under(
    name: str, setup: Setup, experiment: Experiment, inferred: Inference
) -> tuple[PriorSummary, ChannelResult]:
    """Map the data under one prior or a family of priors, and predict held-out groups."""
    information = inferred.solution.information
    if setup.family is None:
        learned, evidence = None, float(information.posterior(setup.prior).log_evidence)
    else:
        learned = learned_prior(setup, information)
        setup, evidence = replace(setup, prior=learned.prior), learned.log_evidence
    solved = None if rebuilds(setup) else inferred.under(setup.prior)
    mapped = replace(experiment, setup=setup, learned=learned, inference=solved)
    made = conditioned(mapped)
    channel = made.result(made.channel_data(alone=False))
    solution, has_truth = made.from_data.solution, channel.truth is not None
    split = Split.of(solution.posterior, channel.chi2_model, solution.model.n_data)
    summary = PriorSummary(
        name=name,
        prior=channel.prior,
        parameters=0 if learned is None else len(learned.parameters),
        log_evidence=evidence,
        held_out=held_out(solution, mapped.data),
        instrument=split.instrument,
        rest=split.prior,
        coverage=channel.coverage,
        errors=channel.errors_by_latitude() if has_truth else (),
        snr=channel.snr_at_some_ell() if has_truth else {},
    )
    return summary, channel


# contents of the folder of a comparison of priors; a new file is one line here
COMPARE_PRIORS = RunKind(
    "compare-priors",
    outputs=(
        Output.model("priors.json", lambda result: result.summary()),
        Output.text("priors.md", lambda result: render_text("priors.md", result=result)),
        SCENARIO,
        Output.rows("priors.csv", lambda result: result.rows()),
    ),
    figures={"priors": priors},
)
