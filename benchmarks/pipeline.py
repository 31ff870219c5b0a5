"""Seconds and memory of every step at the fiducial size, as ratios to LAPACK's own time.

The unavoidable work is dsyrk of the whitened A (5232 x 2304) and dpotrf of Lambda (2304), timed
with SciPy in the same run. Steady state: the median of several calls after a first one, which is
shown apart because it includes compilation. Ratios carry over between machines; seconds do not.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import jax
import numpy as np
from rich.console import Console
from rich.table import Table
from scipy.linalg.blas import dsyrk
from scipy.linalg.lapack import dpotrf

import lusee_bayes as lb
from lusee_bayes.core.progress import peak_memory_gb
from lusee_bayes.experiment.model import full_model
from lusee_bayes.instrument.pointing import Pointing


def timed(work: Callable[[], object], repeats: int) -> tuple[float, float]:
    """Seconds of the first call and the median of ``repeats`` later ones."""
    seconds = []
    for _ in range(repeats + 1):
        start = time.perf_counter()
        jax.block_until_ready(work())
        seconds.append(time.perf_counter() - start)
    return seconds[0], float(np.median(seconds[1:]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--set", action="append", default=[], help="override of the scenario")
    options = parser.parse_args()
    scenario = lb.load_scenario("fiducial", options.set)

    rows = []

    def measure(name: str, work: Callable[[], object], per: int = 1) -> None:
        first, steady = timed(work, options.repeats)
        rows.append((name, first, steady / per, peak_memory_gb()))

    section, source = scenario.observation, scenario.beam.source()
    measure("rotations (lunarsky)", lambda: section.observation().mcmf_from_galactic)
    observation = section.observation()
    measure("pointing", lambda: Pointing.of(observation, scenario.lmax))
    pointing = Pointing.of(observation, scenario.lmax)
    measure("b_lm", lambda: source.beams(scenario.frequency_mhz, scenario.lmax).modes)
    experiment = lb.build(scenario)
    setup, data = experiment.setup, experiment.data
    beams = setup.beams
    measure("A", lambda: lb.CouplingMatrix.build(beams, pointing).dense())
    measure("A times a sky", lambda: setup.coupling @ setup.sky.modes)
    model = full_model(setup)

    def to_posterior():
        coupling = lb.CouplingMatrix.build(beams, pointing)
        return lb.LinearGaussian(coupling, model.prior, model.noise).condition(data.data).posterior

    measure("b_lm and pointings to posterior", to_posterior)
    posterior = to_posterior()
    measure("std of every mode", posterior.std)
    measure("100 draws", lambda: posterior.sample(jax.random.key(0), 100))

    n_data, n_modes = model.coupling.shape
    white = np.asfortranarray(np.random.default_rng(0).standard_normal((n_data, n_modes)))
    _, syrk = timed(lambda: dsyrk(1.0, white, trans=1, lower=1), options.repeats)
    normal = dsyrk(1.0, white, trans=1, lower=1) + np.eye(n_modes)
    _, potrf = timed(lambda: dpotrf(normal, lower=1), options.repeats)
    lapack = syrk + potrf

    table = Table(title=f"{n_data} data, {n_modes} modes, {jax.devices()[0].device_kind}")
    for heading in ("step", "first call [s]", "steady [s]", "ratio to LAPACK", "peak so far [GB]"):
        table.add_column(heading, justify="left" if heading == "step" else "right")
    for name, first, steady, memory in rows:
        table.add_row(
            name, f"{first:.3f}", f"{steady:.4f}", f"{steady / lapack:.3f}", f"{memory:.2f}"
        )
    table.add_row("LAPACK: dsyrk", "", f"{syrk:.4f}", f"{syrk / lapack:.3f}", "")
    table.add_row("LAPACK: dpotrf", "", f"{potrf:.4f}", f"{potrf / lapack:.3f}", "")
    Console(width=100).print(table)


if __name__ == "__main__":
    main()
