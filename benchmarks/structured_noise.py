"""Radiometer + gain noise: the time-banded route, the dense route and LAPACK, in one run.

LAPACK's work for the dense route is dpotrf of N (5232), dtrsm of A (5232 x 2304), dsyrk and dpotrf
of Lambda (2304). Then the cost of factorising N from a quarter of a cycle to twelve cycles, which
grows linearly. ``--memory`` runs the banded route alone and prints its peak memory.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import time
from collections.abc import Callable

import equinox as eqx
import jax
import numpy as np
from rich.console import Console
from rich.table import Table
from scipy.linalg.blas import dsyrk, dtrsm
from scipy.linalg.lapack import dpotrf

import lusee_bayes as lb
from lusee_bayes.core.progress import peak_memory_gb
from lusee_bayes.experiment.model import full_model, set_up
from lusee_bayes.noise.covariance import DenseCovariance

console = Console(width=100)


def median_seconds(work: Callable[[], object], repeats: int) -> float:
    """Steady state: the median after a first call."""
    jax.block_until_ready(work())
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        jax.block_until_ready(work())
        seconds.append(time.perf_counter() - start)
    return float(np.median(seconds))


def fiducial() -> tuple[lb.LinearGaussian, jax.Array]:
    """The model with radiometer and gain noise, its A dense, and data."""
    experiment = lb.build(lb.load_scenario("gain_1e-2"))
    model = full_model(experiment.setup)
    dense = lb.LinearGaussian(model.coupling.dense(), model.prior, model.noise)
    return dense, experiment.data.data


def routes(repeats: int) -> None:
    """From A, N and d to the posterior, against LAPACK."""
    model, data = fiducial()
    banded = median_seconds(lambda: model.condition(data).posterior.white_mean, repeats)
    matrix = model.noise.dense()
    full = lb.LinearGaussian(model.coupling, model.prior, DenseCovariance(matrix))
    dense = median_seconds(lambda: full.condition(data).posterior.white_mean, repeats)
    n = np.asfortranarray(matrix)
    lower = np.asfortranarray(dpotrf(n, lower=1)[0])
    a = np.asfortranarray(model.coupling.dense())
    normal = dsyrk(1.0, a, trans=1, lower=1) + 1e12 * np.eye(a.shape[1])
    parts = {
        "dpotrf N": lambda: dpotrf(n, lower=1)[0],
        "dtrsm A": lambda: dtrsm(1.0, lower, a, lower=1),
        "dsyrk": lambda: dsyrk(1.0, a, trans=1, lower=1),
        "dpotrf Lambda": lambda: dpotrf(normal, lower=1)[0],
    }
    seconds = {name: median_seconds(work, repeats) for name, work in parts.items()}
    lapack = sum(seconds.values())
    table = Table(title=f"radiometer + gain noise, {a.shape[0]} data, {a.shape[1]} modes")
    for heading in ("route", "seconds", "ratio to LAPACK's dense route"):
        table.add_column(heading, justify="left" if heading == "route" else "right")
    for name, value in [("time-banded", banded), ("dense", dense), *seconds.items()]:
        table.add_row(name, f"{value:.3f}", f"{value / lapack:.2f}")
    console.print(table)


def scaling(repeats: int) -> None:
    """Seconds to factorise N for longer and longer observations."""
    table = Table(title="factorising radiometer + gain noise")
    for heading in ("cycles", "samples", "visibilities", "seconds", "microseconds per visibility"):
        table.add_column(heading, justify="right")
    factor = eqx.filter_jit(lambda noise: noise.factor())
    for cycles in (0.25, 0.5, 1, 2, 4, 8, 12):
        setup = set_up(
            lb.load_scenario("gain_1e-2", [f"observation.runs.0.cycles={cycles}", "lmax=8"])
        )
        noise = full_model(setup).noise
        seconds = median_seconds(lambda noise=noise: factor(noise).diagonal, repeats)
        table.add_row(
            f"{cycles:g}",
            str(setup.observation.n_times),
            str(noise.size),
            f"{seconds:.3f}",
            f"{1e6 * seconds / noise.size:.1f}",
        )
    console.print(table)


def memory() -> None:
    """Peak memory of a process that does nothing but the banded route."""
    model, data = fiducial()
    jax.block_until_ready(model.condition(data).posterior.white_mean)
    console.print(f"peak memory of the time-banded route: {peak_memory_gb():.2f} GB")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--memory", action="store_true")
    options = parser.parse_args()
    if options.memory:
        memory()
    else:
        # first: a child's peak as Linux counts it begins with what its parent holds
        subprocess.run([sys.executable, __file__, "--memory"], check=True)
        routes(options.repeats)
        scaling(options.repeats)
