"""A validation: HMC and simulated data sets against the analytic posterior."""

from __future__ import annotations

from dataclasses import replace as replace_fields
from pathlib import Path

from lusee_bayes.core.engine import Demand, Engine
from lusee_bayes.core.progress import Stages
from lusee_bayes.experiment.data_files import Data
from lusee_bayes.experiment.scenario import Scenario, load_scenario
from lusee_bayes.judge.coverage import LEVELS
from lusee_bayes.report.figures.sampling import comparison, rank_statistics
from lusee_bayes.report.rendering import render_text
from lusee_bayes.results.finished_runs import Provenance
from lusee_bayes.results.sample_result import CHAINS
from lusee_bayes.results.validation_result import ValidationResult, allowed
from lusee_bayes.runs.cost import demand_of, measured_experiment
from lusee_bayes.runs.folder import Output, RunKind, RunOutcome, run_folder
from lusee_bayes.runs.sample_run import RESUME, SAMPLE_OUTPUTS, named, sample_result
from lusee_bayes.sampling.hmc import Sampler
from lusee_bayes.sampling.least import require_draws, require_simulations
from lusee_bayes.sampling.programs import load_program
from lusee_bayes.sampling.validation import BATCH, N_DRAWS, calibrate_sky, validate_draws


def demand_of_calibration(scenario: Scenario) -> Demand:
    """What simulation-based calibration takes, in batches that use all processors."""
    return replace_fields(demand_of(scenario, n_draws=BATCH * N_DRAWS), side_by_side=1)


def run_validate(
    scenario: Scenario | str | Path,
    folder: str | Path,
    *,
    name: str = "the scenario",
    sampler: Sampler | None = None,
    simulations: int = 500,
    data: Data | None = None,
    resume: bool = False,
    engine: Engine | None = None,
    replace: bool = False,
    stages: Stages | None = None,
) -> RunOutcome[ValidationResult]:
    """Check the analytic posterior of a scenario by HMC and by simulated data sets.

    The folder is written in one transaction.

    Parameters
    ----------
    scenario : Scenario, or its file or name
    folder : path
        Of the results; draws are kept in it as they come.
    name : str
        Of the scenario, for the title.
    sampler : Sampler, optional
        By default with the scenario's seed.
    simulations : int
        Data sets for simulation-based calibration.
    data : Visibilities, path, or sequence of them, optional
        Visibilities to use; without them the scenario's own are simulated.
    resume : bool
        Go on with the unfinished run in the folder, or judge the finished one again.
    engine : Engine, optional
        What works on the simulated data sets; by default this process.
    replace, stages : bool and Stages, optional
        As in :func:`.run_map`.

    Raises
    ------
    InputError
        For too few draws or simulations, and as :func:`run_sample`.
    """
    scenario = load_scenario(scenario)
    stages = stages or Stages()
    sampler = sampler or Sampler(seed=scenario.seed)
    program = load_program("sky")
    require_simulations(simulations)
    require_draws(sampler.draws)
    given = {"replace": replace, "program": named(program)}
    with run_folder(folder, VALIDATION, scenario, data, program.path, **given) as run:
        n = sampler.chains * sampler.draws
        experiment = measured_experiment(scenario, data, stages, n_draws=n)
        drawn = sample_result(experiment, program, sampler, run.path, resume=resume, stages=stages)
        posterior, model = drawn.inference.posterior, drawn.inference.model
        with stages("comparison"):
            stats = drawn.tree["sample_stats"]
            told = stats["diverging"].values, stats["energy"].values
            found = validate_draws(drawn.skies, posterior, *told)
        if engine is not None:
            engine.work_in(run.path)
        more = {"seed": scenario.seed, "engine": engine, "stages": stages}
        ranks = calibrate_sky(model, model, n_simulations=simulations, **more)
        result = ValidationResult(name, drawn, found, ranks)
        return run.write(result, stages, Provenance.of_experiment(experiment, data))


def _as_markdown(result: ValidationResult) -> str:
    return render_text("validation.md", result=result, allowed=allowed, levels=LEVELS)


# what the folder of a validation holds; a new file is one line here
VALIDATION = RunKind(
    "validate",
    outputs=(
        *(Output(lambda r, folder, o=o: o.write(r.sampled, folder)) for o in SAMPLE_OUTPUTS),
        Output.model("validation.json", lambda result: result.summary()),
        Output.text("validation.md", _as_markdown),
    ),
    figures={
        "comparison": lambda result: comparison(result.comparison),
        "calibration": lambda result: rank_statistics(result.ranks),
    },
    unfinished=CHAINS,
    after=("sample",),
    resume=RESUME,
)
