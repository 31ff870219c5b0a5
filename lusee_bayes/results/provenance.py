"""Where results come from: which data, of which site and dates, by which command and when."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path

from lusee_bayes.core.reading import read_json
from lusee_bayes.core.version import COMMAND, release
from lusee_bayes.experiment.data_files import Data, names_of_data
from lusee_bayes.experiment.experiment import Experiment
from lusee_bayes.experiment.scenario import Scenario
from lusee_bayes.instrument.observation import Observation
from lusee_bayes.results.saved import PROVENANCE

NAME = "provenance.json"


@dataclass(frozen=True)
class Provenance:
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
        cls, scenario: Scenario, observation: Observation, data: Data | None, *, known_sky: bool
    ) -> Provenance:
        """Of a run that has used data of an observation, read from files or simulated."""
        return cls(
            file="" if data is None else ", ".join(names_of_data(data)),
            known_sky=known_sky,
            seed=scenario.seed,
            first=str(observation.times[0].isot)[:19],
            last=str(observation.times[-1].isot)[:19],
            step_s=float(observation.step_s),
            n_times=int(observation.n_times),
            lon_deg=float(observation.lon_deg),
            lat_deg=float(observation.lat_deg),
            lmax=scenario.lmax,
            command=COMMAND.get(),
            version=release(),
            made=datetime.now(UTC).isoformat(timespec="seconds").removesuffix("+00:00"),
        )

    @classmethod
    def of_experiment(cls, experiment: Experiment, data: Data | None) -> Provenance:
        """Of a run with an experiment's data."""
        known = experiment.data.truth is not None
        return cls.of(experiment.scenario, experiment.data.observation, data, known_sky=known)

    @classmethod
    def read(cls, folder: Path) -> Provenance | None:
        """What :meth:`write` wrote; None for a folder of an older version.

        InputError if the file cannot be read.
        """
        path = folder / NAME
        if not path.is_file():
            return None
        found = read_json(path, PROVENANCE)
        return cls(**{name: found[name] for name in cls.__dataclass_fields__})

    def write(self, folder: Path) -> None:
        """Write provenance.json."""
        (folder / NAME).write_text(json.dumps(asdict(self), indent=2) + "\n", encoding="utf-8")

    def data_line(self) -> str:
        """Whether the data are measured or simulated, and from where."""
        if not self.file:
            return f"simulated by this run, seed {self.seed}"
        if self.known_sky:
            return f"simulated: {self.file}, compared with its true sky"
        return f"measured: {self.file}"
