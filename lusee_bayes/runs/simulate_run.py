"""A simulation: visibilities of a scenario in a file."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from lusee_bayes.core.errors import InputError
from lusee_bayes.core.files import require_new, user_path
from lusee_bayes.core.progress import Stages
from lusee_bayes.experiment.experiment import Experiment, simulated
from lusee_bayes.experiment.scenario import Scenario, load_scenario
from lusee_bayes.instrument.visibilities import Visibilities
from lusee_bayes.instrument.waterfalls import write_four_port, write_waterfall
from lusee_bayes.instrument.waterfalls.writing import NO_ROOM
from lusee_bayes.results.cost import require_fits, simulation_cost
from lusee_bayes.runs.origins import inputs_of


def run_simulate(
    scenario: Scenario | str | Path,
    path: str | Path,
    *,
    frequencies_mhz: Sequence[float] = (),
    replace: bool = False,
    stages: Stages | None = None,
) -> list[Visibilities]:
    """Simulate the visibilities of a scenario, and write them whole or not at all.

    Parameters
    ----------
    scenario : Scenario, or its file or name
    path : path
        The file: netCDF, or luseepy's waterfall if the name ends in ``.fits``.
    frequencies_mhz : sequence of float
        Channels of a waterfall; the noise of each has a seed of its own, one more than that of the
        channel before. None for the scenario's frequency alone.
    replace : bool
        Replace the file if it is there already.
    stages : Stages, optional
        Told what is being done.

    Returns
    -------
    list of Visibilities
        One for each channel.

    Raises
    ------
    InputError
        If the file is there already, for several channels in a netCDF file, and for what a
        waterfall cannot hold.
    """
    scenario = load_scenario(scenario)
    path, channels = user_path(path), (scenario,)
    stages = stages or Stages()
    require_new(path, replace=replace, inputs=inputs_of(scenario))
    if path.suffix == ".fits" and scenario.observation.window != "instant":
        raise InputError(f"{path}: {NO_ROOM}")
    require_fits(simulation_cost(scenario, max(1, len(frequencies_mhz))), scenario)
    if frequencies_mhz:
        if path.suffix != ".fits":
            raise InputError(
                f"'{path}': netCDF files hold one frequency; with --frequencies, give -o a name "
                "that ends in .fits"
            )
        several = scenario.model_copy(update={"frequencies_mhz": tuple(frequencies_mhz)})
        channels = several.channels()
    experiments = [
        simulated(channel, stages=Stages(stages.console, verbose=stages.verbose))
        for channel in channels
    ]
    data = [experiment.data for experiment in experiments]
    if path.suffix != ".fits":
        data[0].write(path, {"scenario": scenario.to_yaml()})
        return data
    _write_waterfall(path, experiments, scenario)
    return data


def _write_waterfall(path: Path, experiments: Sequence[Experiment], scenario: Scenario) -> None:
    """In luseepy's layout of four ports where the beams know volts, else in its scalar one."""
    data = [experiment.data for experiment in experiments]
    sources = [(e.setup.beam_source, e.scenario.frequency_mhz) for e in experiments]
    circuits = [circuit for source, f in sources if (circuit := source.circuit(f)) is not None]
    if circuits:
        section = scenario.beam
        write_four_port(
            path,
            data,
            circuits,
            moon_k=section.moon_temperature_k,
            antenna_k=section.antenna_temperature_k,
            interpolation=section.interpolation,
            response=section.file,
            scenario=scenario.to_yaml(),
        )
        return
    unknown = complex(np.nan, np.nan)
    impedance = [source.impedance(f) for source, f in sources]
    ohm = np.array([unknown if z is None else z for z in impedance])
    write_waterfall(path, data, ohm, scenario.to_yaml())
