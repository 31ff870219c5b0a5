"""A plan: forecasts of the information in observations, from the posterior covariance alone.

No data are needed. A plan compares variations of a scenario, by default of turntable, duration,
nights, duty cycle and lost antennas. Some turn the table within the same time, others last longer
at the same angles, so that a turn is compared with standing still for as long. Each forecast is
written to a file as soon as it is made.
"""

import json
import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from lusee_bayes.core import files, linalg, progress, reading
from lusee_bayes.core.engine import Engine, Tasks, ThisProcess
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.harmonics import sum_over_m
from lusee_bayes.experiment import rounds, validity
from lusee_bayes.experiment.instrument_sections import RunSection
from lusee_bayes.experiment.model import model_about, set_up
from lusee_bayes.experiment.scenario import Scenario, load_scenario
from lusee_bayes.instrument.products import DataLayout, all_products
from lusee_bayes.judge.measures import effective_resolution_deg, prior_fraction_per_ell
from lusee_bayes.linear.posterior import Posterior
from lusee_bayes.report.figures.plans import forecasts
from lusee_bayes.results.finished_runs import text_hash
from lusee_bayes.results.forecast import AS_GIVEN, Forecast, Variation, forecast_rows
from lusee_bayes.runs.cost import duration, posterior_cost, require_fits
from lusee_bayes.runs.folder import Output, RunKind, RunOutcome, identity_of, inputs_of, run_folder
from lusee_bayes.systematics.context import Around, Setup


def expected_snr_squared(posterior: Posterior) -> Float[np.ndarray, " ells"]:
    """sum_m (S - C) / sum_m C for each ell, for a posterior over harmonic coefficients.

    NaN at an ell where the prior has no power.
    """
    prior, left = sum_over_m(posterior.prior.variance()), sum_over_m(posterior.std() ** 2)
    return np.divide(prior, left, out=np.full_like(prior, np.nan), where=left > 0) - 1.0


def informed_modes(posterior: Posterior) -> int:
    """Number of eigenvectors of C relative to S with less than half of the prior's variance.

    They are counted on the covariance of the whitened sky, whose eigenvalues lie between 0 and 1.
    On Lambda, whose largest eigenvalue is 1e13, rounding would blur the threshold.
    """
    half = np.asarray(linalg.invert_lower(posterior.lower))
    return int((np.linalg.eigvalsh(half.T @ half) < 0.5).sum())


def without_ports(setup: Setup, lost: Sequence[int]) -> Setup:
    """The setup with every product of the ``lost`` ports flagged at all times.

    Raises
    ------
    InputError
        For a port that does not exist, or if no port remains.
    """
    layout = setup.layout
    n_ports = round(np.sqrt(layout.n_products))
    for port in lost:
        if not 0 <= port < n_ports:
            raise InputError(f"port {port} does not exist; ports are 0 to {n_ports - 1}")
    dead = np.array([p.i in lost or p.j in lost for p in all_products(n_ports)])
    return setup.with_layout(DataLayout.from_flags(~np.asarray(layout.present) | dead[:, None]))


def expected_inference(setup: Setup) -> rounds.Inference:
    """The model of a setup, and its posterior, which needs no data except for the mean.

    N is the model's, with marginalised systematics and noise levels from the modelled sky.
    """
    model, held = model_about(setup, Around())
    # the covariance does not depend on the data, so use zeros
    return rounds.Inference(model.condition(np.zeros(model.n_data)), held, 1, Around())


def turned(family: str) -> bool:
    """Whether to look for unnoticed errors, which turntable angles can reveal, in a variation."""
    return family in (AS_GIVEN, "turned, same time", "turned, more time") or "runs" in family


def unnoticed(setup: Setup, inference: rounds.Inference) -> str:
    """Errors that the residual chi^2 would not reveal, sorted by their effect on the map."""
    spots = validity.blind_spots(setup, inference, np.asarray(setup.sky.modes))
    shown = [s for s in spots if s.shown > validity.NOTHING * s.bias**2]
    shown.sort(key=lambda s: -s.unnoticed[1])
    return ", ".join(f"{s.name} {s.unnoticed[0]:.2g}{s.unit} ({s.unnoticed[1]:.2g})" for s in shown)


def forecast(variation: Variation) -> Forecast:
    """Build A, S and N of a variation, and compute the forecast from its posterior covariance.

    Raises
    ------
    InputError
        With the variation's name, if its scenario is invalid.
    """
    with reading.naming(f"{variation.source}, {variation.name}"):
        setup = set_up(variation.scenario)
        if variation.lost:
            setup = without_ports(setup, variation.lost)
        inference = expected_inference(setup)
        posterior, part = inference.posterior, inference.offsets
        # linearised about the scenario's sky and zero offsets
        offsets = {} if part is None else part.systematic.in_units(inference.amplitudes(part).std)
        return Forecast(
            variation=variation,
            days=float(setup.observation.live_s.sum()) / 86400.0,
            n_data=setup.layout.size,
            information_bits=float(posterior.information_bits()),
            modes=informed_modes(posterior),
            snr_squared=expected_snr_squared(posterior),
            resolution_deg=effective_resolution_deg(prior_fraction_per_ell(posterior)),
            offsets=offsets,
            unnoticed=unnoticed(setup, inference) if turned(variation.family) else "",
        )


def variations_of(
    sources: Sequence[str], overrides: Sequence[str], vary: Sequence[str], stages: progress.Stages
) -> list[Variation]:
    """List the variations to forecast: every scenario as it is, then its variations.

    All are of measured data (:meth:`.Scenario.of_measured`).

    Parameters
    ----------
    sources : sequence of str
        Files or names of scenarios.
    overrides : sequence of str
        ``key.path=value``, for all of them.
    vary : sequence of str
        ``key.path=value,value,...``; if empty, :func:`default_variations`.
    stages : Stages
        Reports default variations that are left out because they cannot be observed.

    Raises
    ------
    InputError
        If a scenario is given twice, and as :func:`given_variations`.
    """
    variations: list[Variation] = []
    for number, source in enumerate(sources):
        if source in sources[:number]:
            raise InputError(f"the scenario '{source}' is listed twice; list each once")
        if vary:
            variations += given_variations(source, vary, overrides)
            continue
        first, *others = default_variations(source, load_scenario(source, overrides).of_measured())
        variations.append(first)
        for one in others:
            try:
                one.scenario.observation.observation()
                variations.append(one)
            except InputError as why:  # cannot be observed: a run without any night, ...
                stages.say(f"  left out: {source}, {one.family}, {one.name}: {why}")
    return variations


def given_variations(source: str, vary: Sequence[str], overrides: Sequence[str]) -> list[Variation]:
    """The scenario as baseline, and with every value of every ``key.path=value,value,...``.

    InputError if one of them does not have that form, or a value is invalid for the scenario.
    """
    given = load_scenario(source, overrides).of_measured()
    variations = [Variation(source, AS_GIVEN, AS_GIVEN, given)]
    for text in vary:
        key, _, listed = text.partition("=")
        values = reading.parse_yaml(f"[{listed}]", f"--vary {text}")
        if not key or not isinstance(values, list) or not values:
            raise InputError(f"--vary expects key.path=value,value (as seed=1,2), got '{text}'")
        for value in values:
            change = f"{key}={json.dumps(value, default=str)}"
            scenario = load_scenario(source, [*overrides, change]).of_measured()
            variations.append(Variation(source, key, f"{value}", scenario))
    return variations


# one turn of the table
TURN_DEG = 30.0
# numbers of parts of each run, or of repetitions of all runs
PARTS = (1, 2, 3)
CYCLES = (0.25, 0.5, 1.0, 2.0, 3.0)
DUTY_CYCLES = (0.25, 0.5, 1.0)


def default_variations(source: str, scenario: Scenario) -> list[Variation]:
    """The scenario as it is, then with other turntable, duration, nights, duty cycle and antennas.

    A schedule keeps its dates and angles.
    """
    observation, radiometer = scenario.observation, scenario.noise.radiometer
    scenarios, runs = {(AS_GIVEN, AS_GIVEN): scenario}, observation.runs
    if observation.schedule is None:
        total = sum(run.cycles for run in runs)
        parted = [changed(runs, 1.0 / n, n, TURN_DEG) for n in PARTS]
        turned = [changed(runs, times=n, turn_deg=TURN_DEG) for n in PARTS[1:]]
        lasting = [changed(runs, cycles / total) for cycles in CYCLES]
        nights = [changed(runs, times=n, night_only=True) for n in PARTS[:2]]
        families = {
            "turned, same time": [(angles(r), r) for r in parted],
            "turned, more time": [(f"{length(r)}: {angles(r)}", r) for r in turned],
            "duration": [(length(r), r) for r in lasting],
            "nights only": [(length(r), r) for r in nights],
        }
        for family, members in families.items():
            for name, varied in members:
                scenarios[family, name] = scenario.with_section("observation", runs=varied)
    for duty in DUTY_CYCLES:
        section = radiometer.model_copy(update={"duty_cycle": duty})
        scenarios["duty cycle", f"{duty:g}"] = scenario.with_section("noise", radiometer=section)
    n_ports = scenario.beam.source().n_ports
    ports = range(n_ports if n_ports > 1 else 0)
    lost = [Variation(source, "antenna lost", f"port {k}", scenario, (k,)) for k in ports]
    return [Variation(source, *named, varied) for named, varied in scenarios.items()] + lost


def changed(
    runs: Sequence[RunSection],
    factor: float = 1.0,
    times: int = 1,
    turn_deg: float = 0.0,
    **values: Any,
) -> tuple[RunSection, ...]:
    """Scale the length of runs by ``factor``, and repeat all of them ``times`` times.

    Each repetition adds ``turn_deg`` to the angles. ``values`` replace other keys of every run.
    """

    def one(run: RunSection, number: int) -> RunSection:
        turned = run.turntable_deg + number * turn_deg
        scaled = {"cycles": run.cycles * factor, "turntable_deg": turned}
        return RunSection(**run.model_dump() | values | scaled)

    return tuple(one(run, number) for number in range(times) for run in runs)


def angles(runs: Sequence[RunSection]) -> str:
    """Turntable angles of runs, in words."""
    return ", ".join(f"{run.turntable_deg:g}°" for run in runs)


def length(runs: Sequence[RunSection]) -> str:
    """Total length of runs, in words."""
    cycles = sum(run.cycles for run in runs)
    return f"{cycles:g} cycle{'' if cycles == 1.0 else 's'}"


def kept_forecast(folder: Path, variation: Variation) -> Forecast:
    """Read the forecast of a variation from its JSON file in a folder, or make and write it."""
    v = variation
    path = folder / f"{identity_of(v.scenario, v.lost, turned(v.family))}.json"
    if path.is_file():
        kept = json.loads(path.read_text(encoding="utf-8"))
        return Forecast(variation, **kept | {"snr_squared": np.array(kept["snr_squared"])})
    made = forecast(variation)
    kept = vars(made) | {"snr_squared": made.snr_squared.tolist()}
    del kept["variation"]
    with files.replacing(path) as scratch:
        scratch.write_text(json.dumps(kept), encoding="utf-8")
    return made


def forecasts_of(
    variations: Sequence[Variation], folder: Path, engine: Engine, stages: progress.Stages
) -> list[Forecast]:
    """Make a forecast of every variation; duplicates are computed once.

    Parameters
    ----------
    variations : sequence of Variation
    folder : Path
        Folder of unfinished work: forecasts of an interrupted plan are read from it.
    engine : Engine
    stages : Stages
        Reports the number of variations and, after the first, an estimate of the remaining time.

    Returns
    -------
    list of Forecast
        In the order of the variations.

    Raises
    ------
    InputError
        As :func:`.forecast`.
    """
    # workers may have another working directory
    anchored = [replace(v, scenario=v.scenario.anchored()) for v in variations]
    digests = [identity_of(v.scenario, v.lost, turned(v.family)) for v in anchored]
    different: dict[str, Variation] = {}
    for digest, variation in zip(digests, anchored, strict=True):
        different.setdefault(digest, variation)
    stages.say(f"  {len(variations)} variations, {len(different)} of them different")
    first, *others = different.values()
    start = time.perf_counter()
    with stages("first forecast"):
        made = [kept_forecast(folder, first)]
    if others:
        longest = len(others) * (time.perf_counter() - start)
        stages.say(f"  the other {len(others)} take about {duration(longest)}, or less")
        names = [f"{other.source}, {other.name}" for other in others]
        tasks = Tasks(partial(kept_forecast, folder), others, names)
        made += engine.each(tasks, stages, "planning")
    by_digest = dict(zip(different, made, strict=True))
    return [replace(by_digest[d], variation=v) for d, v in zip(digests, variations, strict=True)]


UNFINISHED = "unfinished-forecasts"


def run_plan(
    variations: Sequence[Variation],
    folder: str | Path,
    *,
    engine: Engine | None = None,
    replace: bool = False,
    stages: progress.Stages | None = None,
) -> RunOutcome[list[Forecast]]:
    """Forecast the information in every variation, and write table and figure in one transaction.

    The same call resumes a plan that was stopped.

    Parameters
    ----------
    variations : sequence of Variation
        E.g. from :func:`.default_variations`.
    folder : path
        Folder of the results.
    engine : Engine, optional
        Where forecasts are computed; by default in this process.
    replace, stages : bool and Stages, optional
        As in :func:`.run_map`.

    Raises
    ------
    InputError
        With the variation's name, if its scenario is invalid, or its forecast does not fit into
        memory.
    """
    engine, stages = engine or ThisProcess(), stages or progress.Stages()
    scenarios = {f"{v.source}, {v.family}, {v.name}": v.scenario for v in variations}
    for name, scenario in scenarios.items():
        with reading.naming(name):
            scenario.require_single("a forecast has")
            if scenario.observation.average_s is not None:
                raise InputError("a plan does not average: set observation.step_s, window=mean")
            require_fits(posterior_cost(scenario), scenario)
    digests = {name: text_hash(s.to_yaml())[:12] for name, s in scenarios.items()}
    inputs = [path for scenario in scenarios.values() for path in inputs_of(scenario)]
    with run_folder(folder, PLAN, None, None, *inputs, replace=replace, **digests) as run:
        engine.work_in(run.path)
        made = (run.path / UNFINISHED).resolve()
        return run.write(forecasts_of(variations, made, engine, stages), stages)


# contents of the folder of a plan; a new file is one line here
PLAN = RunKind(
    "plan",
    outputs=(Output.rows("plan.csv", forecast_rows),),
    figures={"plan": forecasts},
    unfinished=UNFINISHED,
    resume="the same command continues from the finished forecasts",
)
