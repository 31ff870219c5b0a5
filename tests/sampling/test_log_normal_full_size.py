"""A log-normal sky at full size: weighted draws in straight coordinates against HMC.

289 modes; the paper's 2304 take a quarter of an hour. Before a release, run this file with
LUSEE_BAYES_TEST_LMAX=47 and pytest -o faulthandler_timeout=0 -s, which shows the figures.
"""

from __future__ import annotations

import os
import time

import jax
import numpy as np
import pytest
from arviz_stats.base import array_stats

import lusee_bayes as lb
from lusee_bayes.experiment.inference import infer
from lusee_bayes.experiment.pieces import program_pieces
from lusee_bayes.sampling.hmc import Sampler, sample
from lusee_bayes.sampling.log_normal.gauss_newton import find_mode
from lusee_bayes.sampling.log_normal.prior import AMPLITUDE, STRUCTURE, TILT
from lusee_bayes.sampling.programs import load_program

LMAX = int(os.environ.get("LUSEE_BAYES_TEST_LMAX", "16"))
PRIOR = "prior={model: lognormal, sources: false}"
# with draws of both kinds worth 1500 or more, in means and in squares, the largest of 2304 means is
# off by 0.1 standard deviations, and the largest standard deviation by 10 %, if nothing is wrong.
# 2000 of HMC are worth that where nine of ten are accepted and trajectories are a little longer
# than a quarter of a period
WEIGHTED, LONGER = 9600, 1.75


def said(what: str, since: float) -> None:
    print(f"{what}: {time.perf_counter() - since:.1f} s", flush=True)


@pytest.mark.long
def test_weighted_draws_have_the_moments_of_hmc():
    started = time.perf_counter()
    experiment = lb.build(lb.load_scenario("fiducial", [f"lmax={LMAX}", PRIOR]))
    model, posterior = infer(experiment).model, experiment.positive.posterior
    said("learning, mode and N", started)
    started = time.perf_counter()
    again = find_mode(posterior.mode.sky, posterior.mode.information)
    said("mode", started)
    # the search stops where a step would be 1e-3 standard deviations
    assert np.linalg.norm(posterior.mode.lower.T @ (again.white - posterior.mode.white)) < 3e-3
    started = time.perf_counter()
    drawn = posterior.sample(jax.random.key(1), WEIGHTED)
    said(f"{WEIGHTED} weighted draws, worth {drawn.effective:.0f}", started)

    program = load_program("log_normal")
    arguments = program.arguments(model, program_pieces(experiment))
    started = time.perf_counter()
    chains = sample(
        program.model,
        {**arguments, "data": experiment.data.data},
        Sampler(chains=4, draws=500, seed=2, algorithm="hmc", target_accept=0.9, trajectory=LONGER),
        posterior.coordinates,
    )
    said("4 x 500 draws", started)
    assert not chains.statistics["diverging"].any()
    sites = chains.sites
    skies, quantities = sites["sky"], np.stack([np.log(sites[AMPLITUDE]), sites[TILT]], axis=-1)
    assert skies.shape == (4, 500, (LMAX + 1) ** 2)
    values = np.concatenate([skies, quantities], axis=-1)
    rhat, ess = (
        np.asarray(of(values, chain_axis=0, draw_axis=1, method=method))
        for of, method in ((array_stats.rhat, "rank"), (array_stats.ess, "bulk"))
    )
    weighted = np.concatenate([drawn.skies, drawn.parameters], axis=1)
    flat = values.reshape(-1, values.shape[-1])
    std = flat.std(0, ddof=1)
    off = (drawn.mean(weighted) - flat.mean(0)) / std
    fast = np.sqrt(drawn.variance(weighted))
    fast[: skies.shape[-1]] = posterior.std(drawn)
    ratio = fast / std - 1.0
    print(
        f"R-hat {rhat.max():.4f}, least effective draws {ess.min():.0f}; means off by "
        f"{np.sqrt((off**2).mean()):.3f} (at most {np.abs(off).max():.3f}), standard deviations by "
        f"{np.sqrt((ratio**2).mean()):.3f} (at most {np.abs(ratio).max():.3f})",
        flush=True,
    )
    assert rhat.max() <= 1.01
    assert np.abs(off).max() < 0.1
    assert np.abs(ratio).max() < 0.1
    # every pixel of some draws
    sky, nside = posterior.mode.sky, 2 ** int(np.ceil(np.log2(LMAX)))
    for k in range(0, len(flat), 50):
        amplitude, tilt, white = (
            sites[name].reshape(len(flat), -1)[k] for name in (AMPLITUDE, TILT, STRUCTURE)
        )
        with_own = sky.with_power_law(float(amplitude[0]), float(tilt[0]))
        assert with_own.pixels(white[None], nside).min() > 0
