"""Sessions of the spectrometer, reduced to bands and bins of time, in a file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lusee_bayes.core.destinations import require_new
from lusee_bayes.core.progress import Stages
from lusee_bayes.experiment.flight_data import reduce_files
from lusee_bayes.experiment.scenario import Scenario
from lusee_bayes.instrument.flight.reduced import Reduced
from lusee_bayes.instrument.flight.reduced_file import write_reduced
from lusee_bayes.runs.origins import inputs_of


@dataclass(frozen=True)
class ReduceRun:
    """Reduced spectra, and the file that they are in.

    Attributes
    ----------
    reduced : Reduced
    path : Path
    """

    reduced: Reduced
    path: Path

    def lines(self) -> list[str]:
        """Return what there is to say about it."""
        return reduced_lines(self.reduced)


def reduced_lines(reduced: Reduced) -> list[str]:
    """What was flagged in each band, and how its noise compares with the radiometer's."""
    lines = [reduced.description()[0], *reduced.notes()]
    for band, frequency in enumerate(reduced.frequencies_mhz):
        parts = [f"{name} {share:.2%}" for name, share in reduced.shares(band).items()]
        noise = reduced.scatter[band]
        told = "" if np.isnan(noise) else f"; scatter {noise:.2f} times the radiometer's"
        lines.append(f"{frequency:g} MHz: {', '.join(parts)}{told}")
        lines += [f"  {text}" for text in reduced.doubts(band)]
    return lines


def run_reduce(
    scenario: Scenario,
    files: Sequence[Path],
    path: str | Path,
    *,
    replace: bool = False,
    stages: Stages | None = None,
) -> ReduceRun:
    """Reduce sessions to the scenario's frequencies, and write them whole or not at all.

    Parameters
    ----------
    scenario : Scenario
    files : sequence of Path
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
        As :func:`.reduce_files`, if the file would replace a session, and if it is there already,
        unless ``replace``.
    """
    stages, path = stages or Stages(), Path(path)
    require_new(path, replace=replace, inputs=inputs_of(scenario, files))
    reduced = reduce_files(files, scenario, stages)
    with stages("file"):
        write_reduced(path, reduced, scenario.to_yaml())
    return ReduceRun(reduced, path)
