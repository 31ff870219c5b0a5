"""Seconds of a posterior under a prior that correlates modes, over those of independent modes.

Both of the fiducial scenario (or --set lmax=..., noise...), in steady state: medians of several
calls after a first one. What makes the prior is shown apart: B of a template, and S of each C_ell.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import replace

import jax
import numpy as np
from rich.console import Console
from rich.table import Table

import lusee_bayes as lb
from lusee_bayes.experiment.model import full_model
from lusee_bayes.priors.local_scales import embedded_local_scales


def steady(work: Callable[[], object], repeats: int) -> float:
    """Median seconds after a first call."""
    seconds = []
    for _ in range(repeats + 1):
        start = time.perf_counter()
        jax.block_until_ready(work())
        seconds.append(time.perf_counter() - start)
    return float(np.median(seconds[1:]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--set", action="append", default=[], help="override of the scenario")
    options = parser.parse_args()
    scenario = lb.load_scenario("fiducial", options.set)
    experiment = lb.build(scenario)
    data, independent = experiment.data.data, full_model(experiment.setup)
    family = embedded_local_scales(scenario.frequency_mhz, scenario.lmax)
    correlated = replace(independent, prior=family.expected())
    posteriors = [model.condition(data).posterior for model in (independent, correlated)]
    steps = {
        "data to posterior": [
            lambda m=m: m.condition(data).posterior for m in (independent, correlated)
        ],
        "covariance": [p.covariance for p in posteriors],
        "std of every mode": [p.std for p in posteriors],
        "100 draws": [lambda p=p: p.sample(jax.random.key(0), 100) for p in posteriors],
    }
    table = Table(title=f"{independent.n_data} data, {independent.prior.size} modes")
    for heading in ("step", "independent [s]", "correlated [s]", "ratio"):
        table.add_column(heading, justify="left" if heading == "step" else "right")
    for name, work in steps.items():
        one, other = (steady(call, options.repeats) for call in work)
        table.add_row(name, f"{one:.3f}", f"{other:.3f}", f"{other / one:.2f}")
    making = {
        "family about the template": lambda: (
            embedded_local_scales(scenario.frequency_mhz, scenario.lmax).mean
        ),
        "S = G G^T of parameters": lambda: family.expected().root,
    }
    for name, call in making.items():
        table.add_row(name, "", f"{steady(call, options.repeats):.3f}", "")
    Console(width=100).print(table)


if __name__ == "__main__":
    main()
