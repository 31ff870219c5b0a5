"""Means of data over longer times, in a file, and what they cost."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from lusee_bayes.core.errors import InputError
from lusee_bayes.core.files import require_new, user_path
from lusee_bayes.core.progress import Stages
from lusee_bayes.core.reading import naming
from lusee_bayes.experiment.data_files import Data, files_of, names_of_data, read_data
from lusee_bayes.experiment.scenario import Scenario, load_scenario
from lusee_bayes.experiment.setup import require_fitting, set_up
from lusee_bayes.instrument.averaging import averaged, product_live_s
from lusee_bayes.instrument.visibilities import Visibilities
from lusee_bayes.results.cost import require_resources
from lusee_bayes.runs.forecasting import expected_posterior
from lusee_bayes.runs.origins import inputs_of


@dataclass(frozen=True)
class Averages:
    """Data, their averages, and what these cost.

    Attributes
    ----------
    data, averaged : Visibilities
        Before and after.
    bits : tuple of float, or None
        Information about the map in both, ``ln|1 + S^1/2 A^T N^-1 A S^1/2| / (2 ln 2)``; None if
        it was not asked for.
    """

    data: Visibilities
    averaged: Visibilities
    bits: tuple[float, float] | None

    @property
    def lost_share(self) -> float:
        """Share of the live time of all products that the rule for flags has left out."""
        return 1.0 - product_live_s(self.averaged) / product_live_s(self.data)

    @property
    def lost_bits(self) -> float | None:
        """Information about the map that the averages lack, in bits; None if it is not known."""
        return None if self.bits is None else self.bits[0] - self.bits[1]

    def lines(self) -> tuple[str, ...]:
        """Return what there is to say about it."""
        before, after = (d.observation for d in (self.data, self.averaged))
        said = [
            f"{before.n_times} samples of {before.step_s:g} s -> {after.n_times} of "
            f"{after.step_s:g} s",
            f"live time lost where products have different flags: {self.lost_share:.2%}",
        ]
        if self.bits is not None:
            fine, coarse = self.bits
            said.append(
                f"information about the map: {fine:.2f} bits -> {coarse:.2f} bits, "
                f"{self.lost_bits:.2g} lost"
            )
        return tuple(said)


def run_average(
    scenario: Scenario | str | Path,
    data: Data,
    to_s: float,
    path: str | Path,
    *,
    information: bool = True,
    replace: bool = False,
    stages: Stages | None = None,
) -> Averages:
    """Average data, write them whole or not at all, and work out what is lost.

    Parameters
    ----------
    scenario : Scenario, or its file or name
        How to read the data, and what the information is worked out with; ``average_s`` does not
        count.
    data : Visibilities or path
        With windows.
    to_s : float
        Length of the averages, in seconds.
    path : path
        The netCDF file to write.
    information : bool
        Work out the information about the map, in the data and in their averages.
    replace : bool
        Replace a file that is there.
    stages : Stages, optional
        Told what is being done.

    Raises
    ------
    InputError
        As :func:`.read_data` and :func:`.averaged`, for a scenario that the data do not fit or that
        needs more memory than there is, and if the file is there already, unless ``replace``.
    """
    scenario = load_scenario(scenario)
    stages, path = stages or Stages(), user_path(path)
    if path.suffix == ".fits":
        raise InputError(
            f"'{path}': averages have windows, for which luseepy's waterfalls have no room; give "
            "-o a name that does not end in .fits"
        )
    if path.resolve() in [file.resolve() for file in files_of(data)]:
        raise InputError(
            f"'{path}': the averages would replace the data that they are made of; give -o "
            "another name"
        )
    require_new(path, replace=replace, inputs=inputs_of(scenario, data))
    if scenario.frequencies_mhz:
        raise InputError(
            "averages are of one frequency; give a scenario with frequency_mhz and without "
            "frequencies_mhz"
        )
    section = scenario.observation.model_copy(update={"average_s": None})
    scenario = scenario.model_copy(update={"observation": section})
    with stages("data"):
        fine = read_data(data, scenario)
        with naming(names_of_data(data)[0]):
            coarse = averaged(fine, to_s)
    if information:
        require_fitting(fine, scenario)
        require_resources(scenario, fine, stages)
    coarse.write(path)
    bits = None
    if information:
        with stages("information of the data"):
            before = _bits(scenario, fine)
        with stages("and of the averages"):
            bits = (before, _bits(scenario, coarse))
    return Averages(fine, coarse, bits)


def _bits(scenario: Scenario, data: Visibilities) -> float:
    return float(expected_posterior(set_up(scenario, data)).information_bits())
