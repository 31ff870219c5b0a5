"""A sampling run: draws from the posterior of a NumPyro program."""

from __future__ import annotations

from contextlib import AbstractContextManager
from pathlib import Path

import numpy as np

from lusee_bayes.core.errors import InputError
from lusee_bayes.core.files import user_path
from lusee_bayes.core.progress import Stages
from lusee_bayes.experiment.data_files import Data
from lusee_bayes.experiment.scenario import Scenario, load_scenario
from lusee_bayes.report.figures import sampling as figures
from lusee_bayes.results.finished_runs import Provenance
from lusee_bayes.results.map_files import write_cube, write_map
from lusee_bayes.results.sample_result import CHAINS, SAMPLES, SampleResult
from lusee_bayes.runs.cost import measured_experiment
from lusee_bayes.runs.folder import (
    Output,
    Run,
    RunFolder,
    RunKind,
    json_file,
    scenario_run,
    text_file,
)
from lusee_bayes.runs.sampling import sample_result
from lusee_bayes.sampling.datatree import write_datatree
from lusee_bayes.sampling.hmc import Sampler
from lusee_bayes.sampling.programs import Program, load_program

RESUME = "go on with --resume"


def default_program(scenario: Scenario) -> Program:
    """``systematics`` where something is sampled, or ``sky``."""
    return load_program("systematics" if scenario.samples else "sky")


def run_sample(
    scenario: Scenario | str | Path,
    folder: str | Path,
    *,
    program: Program | None = None,
    sampler: Sampler | None = None,
    data: Data | None = None,
    resume: bool = False,
    replace: bool = False,
    stages: Stages | None = None,
) -> Run[tuple[SampleResult, ...]]:
    """Sample the posterior of a program, and write the folder in one transaction.

    Several frequencies are sampled one after the other, each in a folder of its own, and their maps
    are put together in cubes.

    Parameters
    ----------
    scenario : Scenario, or its file or name
    folder : path
        Of the results; draws are kept in it as they come.
    program : Program, optional
        By default :func:`default_program`.
    sampler : Sampler, optional
        By default with the scenario's seed.
    data : Visibilities, path, or sequence of them, optional
        Visibilities to use; without them the scenario's own are simulated.
    resume : bool
        Go on with the unfinished run in the folder, or take over a finished one.
    replace, stages : bool and Stages, optional
        As in :func:`.run_map`.

    Raises
    ------
    InputError
        For a joint scenario, an unfinished run in the folder that is not to be resumed, and for
        whatever is wrong with scenario, program, data or folder.
    """
    scenario = load_scenario(scenario)
    if scenario.joint:
        raise InputError(
            "channels are sampled one by one; the joint posterior is Gaussian, and lusee-bayes map "
            "--joint --draws N draws from it exactly"
        )
    program = program or default_program(scenario)
    sampler = sampler or Sampler(seed=scenario.seed)

    def one(scenario: Scenario, folder: Path, stages: Stages) -> Run[tuple[SampleResult, ...]]:
        with sample_folder(folder, SAMPLE, scenario, data, program, replace) as run:
            n_draws = sampler.chains * sampler.draws
            experiment = measured_experiment(scenario, data, stages, n_draws=n_draws)
            options = {"resume": resume, "stages": stages}
            result = sample_result(experiment, program, sampler, run.path, **options)
            written = run.write(result, stages, Provenance.of_experiment(experiment, data))
            return Run((result,), run.path, written.files)

    folder, stages = user_path(folder), stages or Stages()
    if not scenario.frequencies_mhz:
        return one(scenario, folder, stages)
    with sample_folder(folder, CUBES, scenario, data, program, replace) as run:
        runs = []
        for channel in scenario.channels():
            where = run.path / f"{channel.frequency_mhz:.15g}MHz"
            runs.append(one(channel, where, Stages(stages.console, verbose=stages.verbose)))
        results = tuple(result for each in runs for result in each.result)
        cubes = run.write((scenario, results), stages)
        return Run(results, run.path, [*(f for each in runs for f in each.files), *cubes.files])


def sample_folder(
    folder: str | Path,
    kind: RunKind,
    scenario: Scenario,
    data: Data | None,
    program: Program,
    replace: bool,
) -> AbstractContextManager[RunFolder]:
    """Open the folder of a run whose draws are those of a program (:func:`.scenario_run`)."""
    named = f"{program.name} ({program.digest[:12]})"
    given = {"replace": replace, "program": named}
    return scenario_run(folder, kind, scenario, data, program.path, **given)


def _write_cubes(sampled: tuple[Scenario, tuple[SampleResult, ...]], folder: Path) -> None:
    scenario, results = sampled
    frequencies = np.array(scenario.frequencies_mhz)
    for name in ("mean", "std"):
        pixels = np.stack([result.maps[name] for result in results])
        write_cube(folder / f"{name}.fits", name, pixels, frequencies, scenario)


def _write_maps(result: SampleResult, folder: Path) -> None:
    for name, pixels in result.maps.items():
        write_map(folder / f"{name}.fits", name, pixels, result.experiment.scenario)


SAMPLE_OUTPUTS = (
    Output(lambda result, folder: write_datatree(result.tree, folder / SAMPLES)),
    Output(_write_maps),
    text_file("summary.csv", lambda run: run.summary_table().to_csv(index_label="quantity")),
    text_file("scenario.yaml", lambda run: run.experiment.scenario.to_yaml()),
    json_file("sampling.json", lambda run: run.figures()),
)

# what the folder of a sampled program holds; a new file is one line here
SAMPLE = RunKind(
    "sample",
    outputs=SAMPLE_OUTPUTS,
    figures={
        "uncertainty": figures.uncertainty,
        "traces": figures.traces,
        "ranks": lambda result: figures.ranks(result.quantities()),
        "energy": lambda result: figures.energy(result.tree["sample_stats"].dataset),
        "pairs": lambda result: figures.pairs(result.quantities()),
        "against_analytic": lambda result: figures.against_analytic(result.tree),
    },
    unfinished=CHAINS,
    resume=RESUME,
)

# what the folder of several channels holds, besides a folder of each
CUBES = RunKind(
    "sampled cubes",
    outputs=(
        Output(_write_cubes),
        text_file("scenario.yaml", lambda sampled: sampled[0].to_yaml()),
    ),
    figures={},
)
