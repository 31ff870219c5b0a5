"""The report of a sampled run, or of a validation, out of what it has left in its folder."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lusee_bayes.core.files import require_files
from lusee_bayes.core.reading import entries, read_json, read_table
from lusee_bayes.judge.convergence import FAR, FEW, warnings_of
from lusee_bayes.report.rendering import render_run
from lusee_bayes.results.saved import CHECK, SAMPLING, SUMMARY_TABLE, VALIDATION


def sample_page(folder: Path, name: str) -> str:
    """The page as text, of the folder and the name of a run. InputError as :func:`.map_page`."""
    require_files(folder, ("summary.csv", "sampling.json", "scenario.yaml"), "sample")
    path, validation = folder / "sampling.json", folder / "validation.json"
    sampling = read_json(path, SAMPLING)
    quantities = read_table(folder / "summary.csv", SUMMARY_TABLE)
    worst = float(np.nanmax(quantities["r_hat"], initial=-np.inf))
    many = FEW * sampling["chains"] * sampling["draws"]
    checks = None
    if validation.is_file():
        checks = entries(validation, read_json(validation, VALIDATION), "checks", CHECK)
        checks = [check | {"failed": not check["passed"]} for check in checks]
    return render_run(
        "sample.html",
        path,
        sampling,
        name=name,
        quantities=quantities,
        worst=worst if np.isfinite(worst) else None,
        reasons=warnings_of(quantities, sampling),
        bad=worst > FAR or sampling["divergences"] > many,
        checks=checks,
    )
