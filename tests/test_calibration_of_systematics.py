"""Sampled systematics know how well they know: ranks of known truths over many data sets.

Truths are drawn from a program's own priors, data from the truths (by the program without data),
draws from the posterior by Hamiltonian Monte Carlo about the mode found for each data set.
"""

from __future__ import annotations

from functools import lru_cache

import equinox as eqx
import jax
import pytest
from numpyro import handlers
from scipy import stats

import lusee_bayes as lb
from lusee_bayes.calibration import FALSE_ALARM, LEVELS, N_DRAWS, Ranks, calibrate
from lusee_bayes.experiment import Experiment
from lusee_bayes.inference import Sampler, draw_within
from lusee_bayes.laplace import laplace
from lusee_bayes.programs import load_program

TINY = ("lmax=6", "observation.runs.0.cycles=0.02")  # 96 data, 49 modes
MONTH = ("lmax=6", "observation.step_s=172800")  # a sample every other day: all sources rise
LEVELS_UNKNOWN = (
    "noise.radiometer.log_factor_std=0.5",
    "prior.log_amplitude_std=0.5",
    "prior.tilt_std=0.5",
)
SOURCES = (
    "sources.treatment=sampled",
    "sources.list=[{name: Cas A}, {name: Cyg A}, {name: For A}, "
    "{name: Jupiter, flux_jy: 100000, stokes_v: 0.3}]",
)


@lru_cache
def experiment(*overrides: str) -> Experiment:
    return Experiment.from_scenario(lb.load_scenario("fiducial", overrides))


def pieces(name: str, *overrides: str):
    """(program, its arguments without the data) of a scenario."""
    e = experiment(*overrides)
    data = e.simulate()
    program = load_program(name)
    return program, program.arguments(e.model(), e.pieces(data))


class Truth(eqx.Module):
    """Values of all sites, and data, drawn by the program itself."""

    program: object = eqx.field(static=True)
    arguments: dict

    def __call__(self, key):
        trace = handlers.trace(handlers.seed(self.program.model, key)).get_trace(**self.arguments)
        data = trace.pop("data")["value"]
        return {name: site["value"] for name, site in trace.items()}, data


class Draws(eqx.Module):
    """Draws of one chain in the coordinates about the mode of each data set."""

    program: object = eqx.field(static=True)
    arguments: dict
    sampler: Sampler = eqx.field(static=True)

    def __call__(self, key, data):
        arguments = {**self.arguments, "data": data}
        about = laplace(self.program.model, arguments)
        return draw_within(self.program.model, arguments, key, self.sampler, about.whitening)


class Sites(eqx.Module):
    """What is ranked: the sites of these names."""

    names: tuple[str, ...] = eqx.field(static=True)

    def __call__(self, unknowns, data):
        return {name: unknowns[name] for name in self.names}


def ranks_of(program, arguments, names, *, n=100, seed=1) -> Ranks:
    """One data set after the other: in a batch, each would wait for the slowest."""
    sampler = Sampler(warmup=60, draws=N_DRAWS, algorithm="hmc")
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        return calibrate(
            Truth(program, arguments),
            Draws(program, arguments, sampler),
            Sites(tuple(names)),
            n_simulations=n,
            seed=seed,
            one_by_one=True,
        )


def assert_calibrated(ranks: Ranks):
    """Even ranks, and intervals that hold the truth as often as they say, binomially."""
    assert ranks.passed, dict(zip(ranks.names, ranks.p_values(), strict=True))
    for level in LEVELS:
        chance = 1 - FALSE_ALARM / (len(LEVELS) * len(ranks.names))
        least, most = stats.binom.interval(chance, ranks.n_simulations, level)
        for name, coverage in ranks.coverage().items():
            assert least <= coverage[level] * ranks.n_simulations <= most, (name, level)


@pytest.mark.long
def test_noise_level_amplitude_and_tilt():
    program, arguments = pieces("systematics", *TINY, *LEVELS_UNKNOWN)
    found = ranks_of(program, arguments, ["noise_level", "amplitude", "tilt"])
    assert_calibrated(found)


@pytest.mark.long
def test_fluxes_of_sources_at_rest_and_of_jupiter():
    program, arguments = pieces("systematics", *MONTH, *SOURCES)
    names = [f"flux_{name}" for name in ("Cas_A", "Cyg_A", "For_A", "Jupiter")]
    assert_calibrated(ranks_of(program, arguments, names))
