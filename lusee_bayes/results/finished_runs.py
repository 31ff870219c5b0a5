"""Map runs that are finished, read back from their folders to be set side by side."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import xarray as xr
from jaxtyping import Float

from lusee_bayes.core.errors import InputError
from lusee_bayes.core.files import recover, require_files
from lusee_bayes.core.reading import read_json, read_table
from lusee_bayes.results.diagnostics_file import read_diagnostics
from lusee_bayes.results.saved import MAP_SUMMARY, SPECTRA
from lusee_bayes.sky import SkyMap

NEEDED = ("summary.json", "spectra.csv", "diagnostics.nc", "mean.fits", "std.fits")


@dataclass(frozen=True)
class FinishedRun:
    """What a map run has left: name of its folder, figures of summary.json, spectra, maps in K."""

    name: str
    summary: dict
    spectra: dict[str, Float[np.ndarray, " ells"]]
    mean: Float[np.ndarray, " pixels"]
    std: Float[np.ndarray, " pixels"]
    diagnostics: xr.Dataset

    @classmethod
    def read(cls, folder: str | Path) -> FinishedRun:
        """InputError if the folder is not one of a finished map run."""
        folder = Path(folder)
        recover(folder)
        require_files(folder, NEEDED, "map")
        summary = read_json(folder / "summary.json", MAP_SUMMARY)
        diagnostics = read_diagnostics(folder / "diagnostics.nc")
        if diagnostics.attrs["frequency_mhz"] != summary["frequency_mhz"]:
            raise InputError(
                f"'{folder}' holds files of different runs: summary.json is of "
                f"{summary['frequency_mhz']:g} MHz, diagnostics.nc of "
                f"{diagnostics.attrs['frequency_mhz']:g} MHz; make the map again"
            )
        maps = {name: SkyMap.read(folder / f"{name}.fits").pixels for name in ("mean", "std")}
        if maps["mean"].size != maps["std"].size:
            raise InputError(f"'{folder}': mean.fits and std.fits are of different NSIDE")
        return cls(
            folder.resolve().name,
            summary,
            read_table(folder / "spectra.csv", SPECTRA),
            maps["mean"],
            maps["std"],
            diagnostics,
        )


def read_runs(folders: Sequence[str | Path]) -> list[FinishedRun]:
    """Two runs or more, with names that tell them apart. InputError for fewer."""
    if len(folders) < 2:
        raise InputError(f"give two folders or more to compare, got {len(folders)}")
    runs = [FinishedRun.read(folder) for folder in folders]
    names = [run.name for run in runs]
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise InputError(f"two of the folders are named '{twice}'; rename one of them")
    return runs


def same_data(runs: Sequence[FinishedRun]) -> bool:
    """Whether all runs map the very same data, so that their evidences may be compared."""
    first = runs[0].diagnostics["data"].values
    return all(
        run.diagnostics["data"].shape == first.shape
        and np.array_equal(run.diagnostics["data"].values, first, equal_nan=True)
        for run in runs[1:]
    )


def comparison_rows(runs: Sequence[FinishedRun]) -> list[dict[str, object]]:
    """One row for each run: the figures that say which map is better."""
    keys = (
        "frequency_mhz",
        "n_data",
        "ell_cross",
        "effective_resolution_deg",
        "information_bits",
        "log_evidence",
        "chi2",
        "chi2_expected",
    )
    best = max(run.summary["log_evidence"] for run in runs)
    return [
        {
            "run": run.name,
            **{key: run.summary[key] for key in keys},
            "log_evidence_less_best": run.summary["log_evidence"] - best,
            "p": float(run.diagnostics.attrs["p"]),
            "mean_std_k": float(run.std.mean()),
        }
        for run in runs
    ]
