"""Sessions of the spectrometer, reduced to bands and bins of time, in a file."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from lusee_bayes.core.errors import InputError
from lusee_bayes.core.files import require_new, user_path
from lusee_bayes.core.progress import Stages
from lusee_bayes.experiment.flight_data import reduce_files
from lusee_bayes.experiment.scenario import Scenario, load_scenario
from lusee_bayes.flight.reduced import Reduced, write_reduced
from lusee_bayes.runs.origins import inputs_of


def reduced_lines(reduced: Reduced) -> list[str]:
    """What was flagged in each band, and how its noise compares with the radiometer's."""
    lines = [reduced.description()[0], *reduced.notes()]
    for band, frequency in enumerate(reduced.frequencies_mhz):
        noise = reduced.scatter[band]
        told = "" if np.isnan(noise) else f"; scatter {noise:.2f} times the radiometer's"
        lines.append(f"{frequency:g} MHz: {reduced.flag_line(band)}{told}")
        lines += [f"  {text}" for text in reduced.doubts(band)]
    return lines


def run_reduce(
    scenario: Scenario | str | Path,
    files: Sequence[str | Path],
    path: str | Path,
    *,
    replace: bool = False,
    stages: Stages | None = None,
) -> Reduced:
    """Reduce sessions to the scenario's frequencies, and write them whole or not at all.

    Parameters
    ----------
    scenario : Scenario, or its file or name
    files : sequence of paths
        Sessions, in any order.
    path : path
        The netCDF file to write.
    replace : bool
        Replace a file that is there.
    stages : Stages, optional
        Told what is being done.

    Raises
    ------
    InputError
        As :func:`.reduce_files`, if the file would replace a session, if it is there already,
        unless ``replace``, and if the sessions have no number in any band.
    """
    scenario = load_scenario(scenario)
    stages, path = stages or Stages(), user_path(path)
    require_new(path, replace=replace, inputs=inputs_of(scenario, files))
    reduced = reduce_files(files, scenario, stages)
    if np.isnan(reduced.before).all():
        raise InputError(
            f"nothing to reduce: all {len(reduced.bin_of)} spectra of {', '.join(map(str, files))} "
            "are NaN in every band; check the sessions, and the frequencies of the scenario"
        )
    with stages("file"):
        write_reduced(path, reduced, scenario.to_yaml())
    return reduced
