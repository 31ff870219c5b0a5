"""A validation on given skies: do error bars hold for skies that the prior does not draw?"""

from __future__ import annotations

import json
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from lusee_bayes.core.engine import Engine, Tasks, ThisProcess
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.progress import Stages
from lusee_bayes.core.tables import write_csv
from lusee_bayes.experiment.experiment import under_sky
from lusee_bayes.experiment.scenario import Scenario, load_scenario
from lusee_bayes.experiment.setup import set_up
from lusee_bayes.report.figures import coverage as coverage_figures
from lusee_bayes.results.cost import require_resources
from lusee_bayes.results.map_result import map_result
from lusee_bayes.results.provenance import Provenance
from lusee_bayes.results.sky_coverage import SkiesResult, SkyCoverage, draws_needed
from lusee_bayes.runs.folder import (
    Output,
    RunKind,
    require_marginal,
    require_single_frequency,
    run_folder,
    write_run,
)
from lusee_bayes.runs.given_skies import GivenSky, given_skies
from lusee_bayes.runs.origins import inputs_of, origin_of


@dataclass(frozen=True)
class SkiesRun:
    """A finished validation on given skies: its result, its folder and the files in it."""

    result: SkiesResult
    folder: Path
    files: list[Path]


def run_skies(
    scenario: Scenario | str | Path,
    folder: str | Path,
    skies: Sequence[str | Path],
    *,
    name: str = "the scenario",
    engine: Engine | None = None,
    replace: bool = False,
    stages: Stages | None = None,
) -> SkiesRun:
    """Map given skies with the prior of a scenario, and count how often error bars hold them.

    Data of each sky are simulated with the scenario's instrument and noise; its name adds to the
    seed. The folder is written in one transaction.

    Parameters
    ----------
    scenario : Scenario, or its file or name
        Of one frequency.
    folder : path
        Of the results.
    skies : sequence of str or Path
        Names or files (:func:`.given_skies`), one or more.
    name : str
        Of the scenario, for the title.
    engine : Engine, optional
        What maps the skies; by default this process, one after the other.
    replace : bool
        Replace results of another run in the folder.
    stages : Stages, optional
        Told what is being done.

    Raises
    ------
    InputError
        For no sky, one that there is not, a scenario of several frequencies or one that samples
        something, and as :func:`run_map`.
    """
    scenario = load_scenario(scenario)
    engine, stages = engine or ThisProcess(side_by_side=1), stages or Stages()
    require_single_frequency("--skies", bool(scenario.frequencies_mhz))
    require_marginal("--skies", "set treatment=marginalised", scenario.samples)
    given = given_skies(skies)
    if not given:
        raise InputError("--skies: name at least one sky, such as embedded:2, smooth or a file")
    names = ", ".join(f"{sky.name} {sky.digest}".strip() for sky in given)
    origin = origin_of(scenario, skies=names)
    inputs = inputs_of(scenario)
    with run_folder(folder, SKIES, origin, replace=replace, inputs=inputs) as place:
        n_draws = draws_needed(len(given))
        require_resources(scenario, None, stages, n_draws)
        setup = set_up(scenario, None, stages)

        def cover(sky: GivenSky) -> SkyCoverage:
            # noise of its own for each sky, whatever the others are
            seed = scenario.seed + zlib.crc32(sky.name.encode())
            result = map_result(under_sky(setup, sky.source, seed))
            return SkyCoverage.of(sky.name, result, n_draws)

        engine.work_in(place)
        tasks = Tasks(cover, given, [sky.name for sky in given])
        found = engine.each(tasks, stages, "skies")
        result = SkiesResult(name, scenario, tuple(found), n_draws, stages.seconds)
        provenance = Provenance.of(scenario, setup.observation, None, known_sky=True)
        return SkiesRun(result, place, write_run(place, result, SKIES, origin, stages, provenance))


def _write_texts(result: SkiesResult, folder: Path) -> None:
    (folder / "coverage.json").write_text(
        json.dumps(result.as_json(), indent=2) + "\n", encoding="utf-8"
    )
    (folder / "coverage.md").write_text(result.as_markdown(), encoding="utf-8")
    (folder / "scenario.yaml").write_text(result.scenario.to_yaml(), encoding="utf-8")


# what the folder of a validation on given skies holds; a new file is one line here
SKIES = RunKind(
    "validate --skies",
    outputs=(
        Output(_write_texts),
        Output(lambda result, folder: write_csv(folder / "coverage.csv", result.rows())),
    ),
    figures={"coverage": coverage_figures.coverage, "pulls": coverage_figures.pulls},
)
