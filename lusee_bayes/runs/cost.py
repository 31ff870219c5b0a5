"""The memory and time that a run needs, estimated from its scenario alone.

The largest arrays are those of the unknowns, 8 n^2 bytes each, and N and A themselves if noise
couples different times. A posterior with its diagnostics needs eight arrays of the unknowns at its
peak. Factorisations take nearly all of the time.
"""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from math import ceil

import numpy as np

from lusee_bayes.core.engine import Demand
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.progress import Stages, gigabytes, memory_limit
from lusee_bayes.experiment.data_files import Data, read_data
from lusee_bayes.experiment.experiment import Experiment, build
from lusee_bayes.experiment.leave_out import ARRAYS, MOST_MEMORY
from lusee_bayes.experiment.rounds import first_order
from lusee_bayes.experiment.scenario import Scenario
from lusee_bayes.instrument.pointing import CLOCK
from lusee_bayes.instrument.visibilities import Visibilities

# measured at lmax 12 to 80 and up to 3e5 data (docs/commands.md): memory before any computation,
# and memory per datum from reading to the report
BASE_BYTES, BYTES_A_DATUM = 0.75e9, 450
# n x n arrays at the peak of a posterior, for one channel or for a joint posterior, and
# floating-point operations in n^3
SQUARES, JOINT_SQUARES, OPERATIONS = 8, 4, 12
# rounds of positive joint skies, including those that learn the laws of their fields
ROUNDS = 8
# arrays and operations for learning a prior: about five steps with all modes
LEARNING_SQUARES, LEARNING_OPERATIONS = 4, 50
# rounds that infer an instrument: operations per datum and unknown, and arrays of data for each
# error of the fields
IN_ROUNDS, FIELD_ARRAYS = 3e5, 8
# operations for comparing times of flight data, in n_data n^2
COMPARING_OPERATIONS = 40
# the sky above lmax: arrays of data, and floating-point operations in n_data n^2 + n^3
ABOVE_ARRAYS, ABOVE_OPERATIONS = 1.5, 5
# with drifting gains, arrays of data by data: of one run, of several
GAIN_ARRAYS = 8.0, 12.5
# arrays of pixels for the maps of a report, intermediate results included
MAPS = 12
# arrays of data for each source in the model
SOURCE_ARRAYS = 3
# seconds of everything except linear algebra: per run, per channel, per datum
OVERHEAD_S, CHANNEL_S, DATUM_S = 8.0, 0.8, 4e-5


@dataclass(frozen=True)
class Cost:
    """Approximate resources of a run.

    Attributes
    ----------
    n_data, n_unknowns, n_channels : int
        Data and unknowns of one channel, and the number of channels.
    memory : float
        Peak memory in bytes.
    operations : float
        Total number of floating-point operations.
    """

    n_data: int
    n_unknowns: int
    n_channels: int
    memory: float
    operations: float

    @property
    def seconds(self) -> float:
        """Wall-clock time on this machine, within a factor of two or three."""
        each = CHANNEL_S + DATUM_S * self.n_data
        return OVERHEAD_S + self.n_channels * each + self.operations / _operations_a_second()


def demand_of(*scenarios: Scenario, n_draws: int = 0) -> Demand:
    """Resources for independent posteriors, or for the channels of a scenario."""
    alone = [one if one.single else one.channels()[0] for one in scenarios]
    task_bytes = max(posterior_cost(one, n_draws).memory for one in alone) - BASE_BYTES
    if scenarios[0].joint:
        # sums over channels for every pair of components, and a second set that is added to them
        count = scenarios[0].spectral.n_maps
        task_bytes += 16.0 * (count * (count + 1) / 2) * (scenarios[0].lmax + 1) ** 4
    return Demand(BASE_BYTES, task_bytes)


def duration(seconds: float) -> str:
    """Format a time with at most two significant digits: 20 s, 5 min, 3 h, 2 days."""
    for unit, length, limit in (("s", 1.0, 100.0), ("min", 60.0, 6000.0), ("h", 3600.0, 172800.0)):
        if seconds < limit:
            return f"{float(f'{seconds / length:.2g}'):g} {unit}"
    return f"{float(f'{seconds / 86400.0:.2g}'):,.0f} days"


@lru_cache(maxsize=1)
def _operations_a_second() -> float:
    """Floating-point operations per second in matrix products on this machine."""
    matrix = np.ones((1024, 1024))
    matrix @ matrix
    start = time.perf_counter()
    matrix @ matrix
    return 2.0 * 1024.0**3 / (time.perf_counter() - start)


def simulation_cost(scenario: Scenario, n_channels: int = 1) -> Cost:
    """Estimate the resources for simulating a scenario's visibilities."""
    n_data, n_modes = 16 * scenario.observation.n_samples(), (scenario.lmax + 1) ** 2
    memory = BASE_BYTES + n_channels * n_data * BYTES_A_DATUM + 64.0 * n_modes
    return Cost(n_data, n_modes, n_channels, memory, 100.0 * n_channels * (n_data + n_modes))


def posterior_cost(scenario: Scenario, n_draws: int = 0, n_data: int | None = None) -> Cost:
    """Estimate the resources for the posterior of a scenario, with its report.

    Parameters
    ----------
    scenario : Scenario
        With one or several frequencies.
    n_draws : int
        Draws of the sky in memory, in addition to those of the scenario's output.
    n_data : int, optional
        Number of given data; by default that of the scenario's observation.
    """
    n_channels = max(1, len(scenario.frequencies_mhz))
    n_data = 16 * scenario.observation.n_samples() if n_data is None else n_data
    n_modes = (scenario.lmax + 1) ** 2
    n, rounds, squares = n_modes, 1, SQUARES
    if scenario.joint:
        n, squares = scenario.spectral.n_maps * n_modes, JOINT_SQUARES
        if scenario.spectral.model == "positive":
            lmax = scenario.spectral.lmax_of_fields(scenario.lmax)
            n, rounds = len(scenario.spectral.fields) * (lmax + 1) ** 2, ROUNDS
    squares = float(squares) * float(n) ** 2
    if scenario.joint:
        # the normal matrix of every channel is kept
        squares += n_channels * n_modes**2 / 2.0
    operations = rounds * OPERATIONS * (float(n) ** 3 + n_channels * float(n_modes) ** 3)
    if scenario.prior.is_learned and not scenario.joint:
        squares += LEARNING_SQUARES * float(n_modes) ** 2
        operations += LEARNING_OPERATIONS * n_channels * float(n_modes) ** 3
    if first_order(scenario):
        fields = scenario.noise.fields
        n_errors = 0 if fields is None else 16 * (fields.lmax + 1) ** 2
        kinds = () if scenario.noise.pointing is None else scenario.noise.pointing.kinds
        searches = 3 if len({*kinds}.difference(CLOCK)) > 1 else 1
        operations += searches * IN_ROUNDS * n_channels * float(n_data) * (n_modes + n_errors)
        squares += FIELD_ARRAYS * float(n_data) * n_errors
    if (above := scenario.noise.above_lmax) is not None:
        n_above = float(above.top(scenario.lmax) + 1) ** 2
        squares += ABOVE_ARRAYS * n_data * n_above + 2.0 * n_above**2
        operations += ABOVE_OPERATIONS * n_channels * (n_data * n_above**2 + n_above**3)
    if scenario.flight is not None and scenario.flight.leave_out:
        operations += n_channels * COMPARING_OPERATIONS * float(n_data) * float(n_modes) ** 2
        # times are not compared if memory is too small
        squares += min(ARRAYS * float(n_data) * n_modes, MOST_MEMORY * memory_limit() / 8.0)
    gain = scenario.noise.gain
    if gain is not None and gain.treatment == "marginalised":
        # N couples all times, so A is formed
        runs = len(scenario.observation.runs)
        squares += GAIN_ARRAYS[runs > 1] * n_data**2 + 3.0 * n_data * n_modes
        operations += n_channels * (float(n_data) ** 3 + 2.0 * n_data * float(n_modes) ** 2)
    if scenario.sources.treatment != "ignored":
        n_sources = len(scenario.sources.list)
        squares += float(SOURCE_ARRAYS * n_data * n_sources)
        operations += 2.0 * n_channels * n_data * n_sources * (n_modes + n_sources)
    pixels = 12.0 * scenario.map_nside**2
    if not scenario.joint:
        # means, errors and spectra of finished channels
        squares += (n_channels - 1) * (3.0 * pixels + 4.0 * n_modes)
    kept = 3.0 * (n_draws + scenario.output.draws) * n_modes
    memory = BASE_BYTES + BYTES_A_DATUM * n_data + 8.0 * (squares + MAPS * pixels + kept)
    return Cost(n_data, n, n_channels, memory, operations)


def require_fits(
    cost: Cost, scenario: Scenario, n_draws: int = 0, n_data: int | None = None
) -> None:
    """Check that a run fits into memory.

    Parameters
    ----------
    cost : Cost
    scenario : Scenario
        The scenario with this cost.
    n_draws, n_data : int
        As in :func:`posterior_cost`.

    Raises
    ------
    InputError
        If it does not; the message suggests a setting that would fit.
    """
    limit = memory_limit()
    if cost.memory <= limit:
        return
    advice = ""
    if n_draws and posterior_cost(scenario, 0, n_data).memory <= limit:
        advice = "; fewer draws would fit"
    for name, value, smaller in () if advice else _smaller(scenario):
        if posterior_cost(smaller, n_draws, n_data).memory <= limit:
            advice = f"; {name}={value} would fit"
            break
    raise InputError(
        f"the run would need about {gigabytes(cost.memory)} of memory for {cost.n_data:,} data and "
        f"{cost.n_unknowns:,} unknowns; this process is limited to {gigabytes(limit)}{advice}"
    )


def require_resources(
    scenario: Scenario, data: Visibilities | None, stages: Stages, n_draws: int = 0
) -> None:
    """Report the resources for a posterior. InputError as :func:`require_fits`.

    Parameters
    ----------
    scenario : Scenario
    data : Visibilities or None
        Given data.
    stages : Stages
        Shows the estimate.
    n_draws : int
        As in :func:`posterior_cost`.
    """
    n_data = None if data is None else data.layout.size
    cost = posterior_cost(scenario, n_draws, n_data)
    require_fits(cost, scenario, n_draws, n_data)
    if stages.console is not None:
        channels = f"{cost.n_channels} channels of " if cost.n_channels > 1 else ""
        size = f"{channels}{cost.n_data:,} data, {cost.n_unknowns:,} unknowns"
        # the estimated time does not include sampling
        time_too = "" if n_draws else f" and {duration(cost.seconds)}"
        stages.say(f"  {size}: about {gigabytes(cost.memory)} of memory{time_too}")


def measured_experiment(
    scenario: Scenario,
    data: Data | None,
    stages: Stages,
    *,
    n_draws: int = 0,
    truth: bool = False,
    make: Callable[..., Experiment] = build,
) -> Experiment:
    """Read data, report the resources for their posterior, and make the experiment.

    Parameters
    ----------
    scenario : Scenario
    data : Visibilities, path, or sequence of them, or None
        Given data; if None, data are simulated from the scenario.
    stages : Stages
        Shows the estimate.
    n_draws : int
        As in :func:`posterior_cost`.
    truth : bool
        The data were simulated from this scenario's sky.
    make : callable
        ``make(scenario, data, stages)``.

    Raises
    ------
    InputError
        As :func:`.read_data` and :func:`require_fits`; if simulated data are to be averaged.
    """
    if data is None and scenario.observation.average_s is not None:
        raise InputError("observation.average_s is for given data: simulate a file, then map it")
    measured = None if data is None else read_data(data, scenario)
    require_resources(scenario, measured, stages, n_draws)
    experiment = make(scenario, measured, stages)
    if not truth:
        return experiment
    return replace(experiment, data=replace(experiment.data, truth=experiment.setup.sky.modes))


def _smaller(scenario: Scenario) -> Iterator[tuple[str, float | str, Scenario]]:
    """Yield key, value and scenario for smaller settings, one key at a time."""

    if scenario.nside is not None:
        yield "nside", 64, scenario.model_copy(update={"nside": 64})
    for draws in (1000, 100, 0):
        yield "output.draws", draws, scenario.with_section("output", draws=draws)
    if scenario.joint:
        yield "joint", "false", scenario.model_copy(update={"joint": False})
    for lmax in range(scenario.lmax - 1, 0, -1):
        yield "lmax", lmax, scenario.model_copy(update={"lmax": lmax})
    for times in range(1, 40):
        step_s = float(ceil(scenario.observation.step_s)) * 2.0**times
        yield "observation.step_s", step_s, scenario.with_section("observation", step_s=step_s)
