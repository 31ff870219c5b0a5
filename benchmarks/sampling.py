"""Gradients and effective draws per second of NUTS and HMC at the fiducial size.

The density is the program models/sky.py's own; the analytic posterior serves as coordinates only.
A short run: warmup, then as many draws as asked for; effective sample sizes are those of the means
(bulk) and of the squares, which a covariance is made of. Seconds are those of the draws; "of two
products": those of a gradient over those of the two products with A that it cannot avoid.
"""

from __future__ import annotations

import argparse
import time

import jax
import numpy as np
from arviz_stats.base import array_stats
from numpyro.infer.hmc import HMCState
from rich.console import Console
from rich.table import Table

import lusee_bayes as lb
from lusee_bayes.sampling.hmc import ALGORITHMS, Sampler, Whitening, sample
from lusee_bayes.sampling.programs import load_program

CHAINS = 4


def seconds_of_two_products(a: np.ndarray) -> float:
    """Of A u and A^T r for one chain of four side by side: no gradient can do without them."""
    both = jax.jit(lambda a, u: a.T @ (a @ u))
    matrix, sky = jax.numpy.asarray(a), jax.numpy.ones((a.shape[1], CHAINS))
    jax.block_until_ready(both(matrix, sky))
    start = time.perf_counter()
    for _ in range(10):
        jax.block_until_ready(both(matrix, sky))
    return (time.perf_counter() - start) / 10 / CHAINS


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=200)
    parser.add_argument("--scenario", default="fiducial")
    parser.add_argument("--set", action="append", default=[], help="override of the scenario")
    options = parser.parse_args()
    experiment = lb.build(lb.load_scenario(options.scenario, options.set))
    data, found = experiment.data, lb.infer(experiment)
    model, posterior = found.model, found.posterior
    program = load_program("sky")
    arguments = {**program.arguments(model), "data": data.data}
    whitening = Whitening.of(posterior)

    table = Table(
        title=f"{model.n_data} data, {model.prior.size} modes, 4 chains of {options.draws}"
    )
    for heading in (
        "",
        "steps",
        "gradients/s",
        "of two products",
        "draws/s",
        "bulk ESS/s",
        "ESS of squares/s",
    ):
        table.add_column(heading, justify="left" if not heading else "right")
    products = seconds_of_two_products(np.asarray(model.coupling.dense()))
    for algorithm in ALGORITHMS:
        times = []

        def note(iteration: int, state: HMCState, times=times) -> None:
            jax.block_until_ready(state.z)
            times.append((time.perf_counter(), iteration))

        sampler = Sampler(draws=options.draws, algorithm=algorithm)
        chains = sample(program.model, arguments, sampler, whitening, report=note)
        drawn = [(at, done) for at, done in times if done >= sampler.warmup]
        seconds = drawn[-1][0] - drawn[0][0]
        white = (chains.sites["sky"] - np.asarray(posterior.mean)) / np.asarray(posterior.std())
        bulk = array_stats.ess(white, chain_axis=0, draw_axis=1, method="bulk")
        squares = array_stats.ess(white**2, chain_axis=0, draw_axis=1, method="mean")
        steps = chains.statistics["n_steps"]
        table.add_row(
            algorithm,
            f"{steps.mean():.1f}",
            f"{steps.sum() / seconds:.0f}",
            f"{seconds / steps.sum() / products:.2f}",
            f"{steps.size / seconds:.1f}",
            f"{np.median(bulk) / seconds:.0f}",
            f"{np.median(squares) / seconds:.0f}",
        )
    Console(width=100).print(table)


if __name__ == "__main__":
    main()
