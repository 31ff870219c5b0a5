"""A plan: the information in observations, without data."""

from __future__ import annotations

from collections.abc import Sequence
from hashlib import sha256
from pathlib import Path

from lusee_bayes.core.engine import Engine, ThisProcess
from lusee_bayes.core.progress import Stages
from lusee_bayes.core.reading import naming
from lusee_bayes.report.figures.plans import forecasts
from lusee_bayes.results.forecast import Forecast, Variation, forecast_rows
from lusee_bayes.runs.cost import posterior_cost, require_fits
from lusee_bayes.runs.folder import RunKind, RunOutcome, inputs_of, origin_of, rows_file, run_folder
from lusee_bayes.runs.forecasting import forecasts_of

UNFINISHED = "unfinished-forecasts"


def run_plan(
    variations: Sequence[Variation],
    folder: str | Path,
    *,
    engine: Engine | None = None,
    replace: bool = False,
    stages: Stages | None = None,
) -> RunOutcome[list[Forecast]]:
    """Forecast the information in every variation, and write table and figure in one transaction.

    A plan that was stopped goes on with the same call.

    Parameters
    ----------
    variations : sequence of Variation
        Such as those of :func:`.default_variations`.
    folder : path
        Of the results.
    engine : Engine, optional
        What makes the forecasts; by default this process.
    replace, stages : bool and Stages, optional
        As in :func:`.run_map`.

    Raises
    ------
    InputError
        With the variation's name, for whatever is wrong with its scenario, and if its forecast
        does not fit into the memory.
    """
    engine, stages = engine or ThisProcess(), stages or Stages()
    for v in variations:
        with naming(f"{v.source}, {v.family}, {v.name}"):
            require_fits(posterior_cost(v.scenario), v.scenario)
    told = {f"{v.source}, {v.family}, {v.name}": v.scenario for v in variations}
    digests = {name: sha256(s.to_yaml().encode()).hexdigest()[:12] for name, s in told.items()}
    origin = origin_of(**digests)
    inputs = [path for v in variations for path in inputs_of(v.scenario)]
    with run_folder(folder, PLAN, origin, replace=replace, inputs=inputs) as run:
        engine.work_in(run.path)
        made = (run.path / UNFINISHED).resolve()
        return run.write(forecasts_of(variations, made, engine, stages), stages)


# what the folder of a plan holds; a new file is one line here
PLAN = RunKind(
    "plan",
    outputs=(rows_file("plan.csv", forecast_rows),),
    figures={"plan": forecasts},
    unfinished=UNFINISHED,
    resume="the same command continues from the finished forecasts",
)
