"""The table of usual mistakes at the fiducial size, against LAPACK's dsyrk and dpotrf of a dense A.

python benchmarks/diagnosis.py [lmax]
"""

from __future__ import annotations

import sys
import time
from dataclasses import replace

import numpy as np
from scipy.linalg import blas, lapack

import lusee_bayes as lb
from lusee_bayes.experiment.diagnosis import diagnose
from lusee_bayes.experiment.experiment import infer, observed
from lusee_bayes.instrument.products import all_products
from lusee_bayes.judge.residuals import residuals


def unit() -> float:
    """Seconds of dsyrk and dpotrf at 5232 x 2304."""
    a = np.asfortranarray(np.random.default_rng(1).standard_normal((5232, 2304)))
    start = time.perf_counter()
    normal = blas.dsyrk(1.0, a, trans=1)
    normal[np.diag_indices(2304)] += 1.0
    lapack.dpotrf(normal, overwrite_a=1)
    return time.perf_counter() - start


def main(lmax: int = 47) -> None:
    scenario = lb.load_scenario("fiducial", [f"lmax={lmax}"])
    good = observed(scenario).data
    conjugated = np.array([p.part == "I" for p in all_products()])[good.layout.product]
    rising = 1.0 + 1e-3 * np.linspace(-1.0, 1.0, good.layout.n_times)[good.layout.time]
    for name, factor in (("conjugated", np.where(conjugated, -1.0, 1.0)), ("rising gain", rising)):
        data = replace(good, data=factor * np.asarray(good.data))
        experiment = observed(scenario, data)
        found = infer(experiment)
        left = residuals(found.solution, data)
        for run in ("first", "again"):
            before = unit()
            start = time.perf_counter()
            diagnosis = diagnose(experiment.setup, found, left)
            seconds = time.perf_counter() - start
            ratio = 2.0 * seconds / (before + unit())
            print(f"{name}, {run}: {diagnosis.n_tried} tried, {seconds:.1f} s, {ratio:.1f} units")
        print(*diagnosis.sentences())


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
