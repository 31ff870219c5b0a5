"""Runs that are finished, read back from their folders to be set side by side.

Their provenance says which data they are of, of which site and dates, by which command and when.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel

from lusee_bayes.core.errors import InputError
from lusee_bayes.core.files import recover, require_files, user_path
from lusee_bayes.core.reading import read_model
from lusee_bayes.core.version import COMMAND, release
from lusee_bayes.experiment.data_files import Data, names_of_data
from lusee_bayes.experiment.experiment import Experiment
from lusee_bayes.experiment.scenario import Scenario
from lusee_bayes.instrument.observation import Observation
from lusee_bayes.results.channel import ChannelResult
from lusee_bayes.results.map_files import read_channels
from lusee_bayes.results.summaries import MapSummary

NAME = "provenance.json"


def taken(observation: Observation) -> dict[str, Any]:
    """When and where data were taken: first and last time, step, number of times, site."""
    return {
        "first": str(observation.times[0].isot)[:19],
        "last": str(observation.times[-1].isot)[:19],
        "step_s": float(observation.step_s),
        "n_times": int(observation.n_times),
        "lon_deg": float(observation.lon_deg),
        "lat_deg": float(observation.lat_deg),
    }


class Provenance(BaseModel, frozen=True):
    """Where the results of a run come from.

    Attributes
    ----------
    file : str
        Of the data; empty if the run has simulated them.
    known_sky : bool
        Whether the sky behind the data is known: they are simulated, by this run or another.
    seed : int
        Of the scenario.
    first, last : str
        Times of the first and the last sample, UTC.
    step_s : float
    n_times : int
    lon_deg, lat_deg : float
        Selenographic, of the site.
    lmax : int
    command : str
        The command line; empty for a call of the library.
    version : str
        Of the package, with its commit where that is known.
    made : str
        When, UTC.
    """

    file: str
    known_sky: bool
    seed: int
    first: str
    last: str
    step_s: float
    n_times: int
    lon_deg: float
    lat_deg: float
    lmax: int
    command: str
    version: str
    made: str

    @classmethod
    def of(
        cls, scenario: Scenario, times: Mapping[str, Any], data: Data | None, *, known_sky: bool
    ) -> Provenance:
        """Of a run that has used data of an observation (:func:`taken`), given or simulated."""
        return cls(
            file="" if data is None else ", ".join(names_of_data(data)),
            known_sky=known_sky,
            seed=scenario.seed,
            **times,
            lmax=scenario.lmax,
            command=COMMAND.get(),
            version=release(),
            made=datetime.now(UTC).isoformat(timespec="seconds").removesuffix("+00:00"),
        )

    @classmethod
    def of_experiment(cls, experiment: Experiment, data: Data | None) -> Provenance:
        """Of a run with an experiment's data."""
        times = taken(experiment.data.observation)
        return cls.of(experiment.scenario, times, data, known_sky=experiment.data.truth is not None)

    @classmethod
    def read(cls, folder: Path) -> Provenance | None:
        """What :meth:`write` wrote; None for a folder of an older version.

        InputError if the file cannot be read.
        """
        path = folder / NAME
        if not path.is_file():
            return None
        return read_model(path, cls, "the provenance of a run's results")

    def write(self, folder: Path) -> None:
        """Write provenance.json."""
        (folder / NAME).write_text(self.model_dump_json(indent=2) + "\n", encoding="utf-8")

    def data_line(self) -> str:
        """Whether the data are measured or simulated, and from where."""
        if not self.file:
            return f"simulated by this run, seed {self.seed}"
        if self.known_sky:
            return f"simulated: {self.file}, compared with its true sky"
        return f"measured: {self.file}"


NEEDED = ("summary.json", "diagnostics.nc")


@dataclass(frozen=True)
class FinishedRun:
    """What a map run has left: the name of its folder, its figures, and its channels.

    ``provenance`` is None for a folder of an earlier version, which did not record it.
    """

    name: str
    summary: MapSummary
    channels: tuple[ChannelResult, ...]
    provenance: Provenance | None

    @property
    def channel(self) -> ChannelResult:
        """The first channel: of a map of one frequency, the only one."""
        return self.channels[0]

    def cross_in_words(self) -> str:
        """First ell with SNR < 1: above the last one, or unknown without a truth."""
        cross = self.channel.ell_cross
        if cross is not None:
            return str(cross)
        lmax = len(self.channel.prior_fraction) - 1
        return "no truth" if self.channel.truth is None else f"> {lmax}"

    @classmethod
    def read(cls, folder: str | Path) -> FinishedRun:
        """InputError if the folder is not one of a finished map run."""
        folder = user_path(folder)
        recover(folder)
        require_files(folder, NEEDED, "map")
        summary = read_model(folder / "summary.json", MapSummary, "the figures of a map run")
        channels = read_channels(folder / "diagnostics.nc")
        found = [channel.frequency_mhz for channel in channels]
        if found != summary.frequencies_mhz:
            raise InputError(
                f"'{folder}' holds files of different runs: summary.json is of "
                f"{_in_mhz(summary.frequencies_mhz)}, diagnostics.nc of {_in_mhz(found)}; make the "
                "map again"
            )
        return cls(folder.resolve().name, summary, channels, Provenance.read(folder))


def _in_mhz(frequencies: Sequence[float]) -> str:
    return f"{', '.join(f'{f:g}' for f in frequencies)} MHz"


def read_runs(folders: Sequence[str | Path]) -> list[FinishedRun]:
    """Two runs or more, with names that tell them apart. InputError for fewer."""
    if len(folders) < 2:
        raise InputError(f"give two folders or more to compare, got {len(folders)}")
    runs = [FinishedRun.read(folder) for folder in folders]
    names = [run.name for run in runs]
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise InputError(f"two of the folders are named '{twice}'; rename one of them")
    for run in runs:
        if len(run.channels) > 1 or run.channel.judged is None:
            raise InputError(
                f"'{run.name}' is a run of frequencies_mhz; give folders of maps of one frequency"
            )
    return runs


def evidence_caveat(runs: Sequence[FinishedRun]) -> str | None:
    """Say why the evidences of runs must not be compared: their data differ.

    Returns
    -------
    str or None
        None if all runs map the very same data.
    """
    first, *others = runs
    reasons = [f"{run.name} {why}" for run in others if (why := _difference(first, run))]
    if not reasons:
        return None
    return (
        f"Do not compare the evidences: they are of different data. Against {first.name}, "
        f"{'; '.join(reasons)}."
    )


def _difference(first: FinishedRun, run: FinishedRun) -> str | None:
    """How the data of a run differ from those of the first, in words; None if they do not."""
    here, there = (one.channel.data for one in (first, run))
    frequencies = [one.channel.frequency_mhz for one in (first, run)]
    if frequencies[0] != frequencies[1]:
        return f"is at {frequencies[1]:g} MHz instead of {frequencies[0]:g}"
    if here.shape != there.shape:
        sizes = [f"{a.shape[0]} products at {a.shape[1]} times" for a in (here, there)]
        return f"has {sizes[1]} instead of {sizes[0]}"
    if (np.isnan(here) != np.isnan(there)).any():
        counts = [int(np.isfinite(a).sum()) for a in (here, there)]
        return f"uses {counts[1]} samples instead of {counts[0]}, or others"
    known = np.isfinite(here)
    if np.array_equal(here[known], there[known]):
        return None
    scale = float(np.vdot(here[known], there[known]) / np.vdot(here[known], here[known]))
    if np.allclose(there[known], scale * here[known], rtol=1e-6, atol=0.0):
        return f"has the same data in another unit (times {scale:.6g})"
    if not np.array_equal(first.channel.hours, run.channel.hours):
        return "was observed at other times"
    return "has other values at the same times (another file, noise, sky or seed)"


# figures of channels that are set side by side
COMPARED = (
    *("frequency_mhz", "n_data", "ell_cross", "resolution_deg", "information_bits"),
    *("log_evidence", "chi2", "chi2_expected"),
)


def comparison_rows(runs: Sequence[FinishedRun]) -> list[dict[str, object]]:
    """One row for each run: the figures that say which map is better.

    The difference of ln evidence is None where data differ.
    """
    best = max(run.channel.log_evidence for run in runs)
    comparable = evidence_caveat(runs) is None
    return [
        {
            "run": run.name,
            "level": run.summary.level,
            **{key: getattr(run.channel, key) for key in COMPARED},
            "log_evidence_less_best": run.channel.log_evidence - best if comparable else None,
            "instrument_p": run.channel.instrument.p,
            "prior_p": run.channel.judged.prior.p,
            "mean_std_k": float(run.channel.pixel_std.mean()),
        }
        for run in runs
    ]
