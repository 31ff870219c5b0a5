"""Small experiments that the tests share: what was built once is there for all."""

from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from numpyro.infer.util import log_density
from reference_linear import random_covariance

import lusee_bayes as lb
from lusee_bayes.experiment.experiment import Experiment, program_pieces
from lusee_bayes.experiment.model import full_model, radiometer, simulate, true_values
from lusee_bayes.experiment.rounds import Inference
from lusee_bayes.experiment.scenario import Scenario
from lusee_bayes.experiment.unknowns import Unknowns, UnknownsReport
from lusee_bayes.instrument.products import DataLayout
from lusee_bayes.linear.amplitudes import template_amplitudes
from lusee_bayes.results.channel import ChannelResult
from lusee_bayes.results.channel_map import Conditioned, conditioned
from lusee_bayes.results.finished_runs import SavedInformation
from lusee_bayes.sampling.hmc import whitened
from lusee_bayes.sampling.programs import WHITE_SUFFIX, Program, latent_sites, numpyro_promotion
from lusee_bayes.sky.prior import DensePrior, Prior
from lusee_bayes.systematics.context import Around, Setup
from lusee_bayes.testing import small_scenario

# nothing of these enters a setup (test_experiment.py checks it), only the data and N; the mean of
# noise.receiver does
NOT_IN_SETUP = ("noise.gain", "noise.radiometer", "noise.beam", "noise.pointing", "seed=")


@lru_cache
def small_experiment(*overrides: str, lmax: int = 6, cycles: float = 0.02) -> Experiment:
    """The experiment of :func:`small_scenario`, with simulated data."""
    scenario = small_scenario(*overrides, lmax=lmax, cycles=cycles)
    in_setup = tuple(o for o in overrides if not o.startswith(NOT_IN_SETUP))
    if in_setup == overrides:
        return lb.build(scenario)
    setup = replace(small_experiment(*in_setup, lmax=lmax, cycles=cycles).setup, scenario=scenario)
    return Experiment(setup, simulate(setup))


def four_ports(response: Path, *overrides: str) -> Scenario:
    """A cycle in 23 samples of four ports over warm ground: 16 modes, noise of 1e-5."""
    plain = ["lmax=3", "frequency_mhz=20", "observation.step_s=1e5"]
    noise = ["noise.radiometer.bandwidth_hz=1e5", "prior={model: isotropic, spectrum: sky}"]
    beam = [f"beam.file={response}", "beam.moon_temperature_k=250"]
    return lb.load_scenario("fiducial", [*plain, *noise, *beam, *overrides])


def mapped(
    experiment: Experiment, earlier: SavedInformation | None = None, *, thorough: bool = False
) -> tuple[Conditioned, ChannelResult]:
    """What a map run finds of one frequency, without its folder."""
    made = conditioned(experiment, earlier)
    return made, made.result(made.channel_data(thorough=thorough))


def channels_of(scenario: Scenario) -> list[lb.Visibilities]:
    """The data of every channel."""
    return [lb.build(channel).data for channel in scenario.channels() or (scenario,)]


def unknowns_report(experiment: Experiment, found: Inference) -> UnknownsReport | None:
    """What data alone tell of receivers, ground and gain table."""
    unknowns, posterior = Unknowns.of(experiment, found), found.posterior
    return None if unknowns is None else unknowns.report(posterior.mean, posterior.covariance())


def offset_posterior(found: Inference) -> tuple[dict[str, float], np.ndarray]:
    """Mean of every offset of clock and pointing by name, and their covariance in these units."""
    offsets, told = found.offsets, found.amplitudes(found.offsets)
    stds = offsets.systematic.stds
    mean = offsets.systematic.in_units(offsets.expected + told.mean)
    return mean, told.covariance * np.outer(stds, stds)


def of_run(data: lb.Visibilities, run: int) -> lb.Visibilities:
    """The data of one run by themselves."""
    return data.select(data.observation.run == run)


def correlated(prior: Prior) -> DensePrior:
    """A prior with a mean and about this one's widths, whose modes are correlated."""
    width, rng = np.sqrt(np.asarray(prior.variance())), np.random.default_rng(6)
    covariance = random_covariance(rng, len(width)) * width * width[:, None]
    mean = 0.3 * width * rng.normal(size=len(width))
    return DensePrior(jnp.linalg.cholesky(covariance), mean=jnp.asarray(mean))


def flagged(data: lb.Visibilities, flags: np.ndarray) -> lb.Visibilities:
    """The data without those of the flags, a (products, times) array."""
    layout = DataLayout.from_flags(flags)
    return replace(data, layout=layout, data=layout.gather(data.grid()))


def scaled_product(data: lb.Visibilities, product: int, factor: float) -> lb.Visibilities:
    """Data in which one product is too large."""
    grid = np.array(data.grid())
    grid[product] *= factor
    return replace(data, data=data.layout.gather(jnp.asarray(grid)))


def program_arguments(program: Program, experiment: Experiment) -> dict[str, Any]:
    """All that a program asks for, and the data."""
    model = full_model(experiment.setup, Around(experiment.data))
    return program.arguments(model, program_pieces(experiment)) | {"data": experiment.data.data}


def density(
    program: Program, arguments: dict[str, Any], values: dict[str, Any]
) -> tuple[float, dict[str, Any]]:
    """ln p of everything at these values of the sites, and the trace."""
    values = {name: jnp.asarray(value) for name, value in values.items()}
    with numpyro_promotion():
        got, trace = log_density(program.model, (), arguments, values)
    return float(got), trace


def density_of(e: Experiment, values: dict[str, Any], program: str = "systematics") -> float:
    """ln p of everything by a program of an experiment; no site may be left to chance."""
    asked = lb.load_program(program)
    got, trace = density(asked, program_arguments(asked, e), values)
    assert set(trace) == {*values, "data"}
    return got


def differences(systematic, model, sky, centre, steps) -> np.ndarray:
    """Central ones of data of this sky, one column for each step of the systematic's unknowns."""

    def seen(z):
        return np.asarray(systematic.effect(model, systematic.values(z)).predict(sky))

    over = [(seen(centre + s) - seen(centre - s)) / (2.0 * np.linalg.norm(s)) for s in steps]
    return np.stack(over, axis=1)


def rms_of_directions(found: Inference, sky: np.ndarray) -> float:
    """How far the map is off a sky, RMS over all directions, each in its own standard deviation."""
    posterior = found.posterior
    away = posterior.prior.whiten(sky) - posterior.white_mean
    return float(np.sqrt(np.mean((np.asarray(posterior.lower).T @ away) ** 2)))


def pulls(truth: Setup, found: Inference) -> dict[str, float]:
    """How far every parameter is off, in its standard deviations."""
    values, off = true_values(truth), {}
    for part in found.expanded:
        own, told = part.systematic, found.amplitudes(part)
        z = (np.array([own.true(values)[name] for name in own.names]) - own.means) / own.stds
        away = (np.asarray(part.expected) + told.mean - z) / told.std
        off |= dict(zip(own.names, away.tolist(), strict=True))
    return off


def with_known_sky(setup: Setup, scale: float) -> Setup:
    """The setup with a prior about its own sky, of a part of its C_ell."""
    spectrum = scale * np.asarray(setup.prior.spectrum)
    return replace(setup, prior=lb.HarmonicPrior(spectrum, mean=setup.sky.modes))


def drawn(first: Setup, seed: int) -> Experiment:
    """Data of a sky that is drawn from the prior; N is that of the model sky."""
    z = np.random.default_rng(seed).standard_normal(first.prior.size)
    sky = replace(first.sky, modes=np.asarray(first.prior.colour(z + first.prior.white_mean)))
    setup = replace(first, sky=sky, scenario=first.scenario.model_copy(update={"seed": seed}))
    return Experiment(setup, simulate(setup))


def sky_and_amplitudes(found: Inference) -> tuple[np.ndarray, np.ndarray]:
    """Mean and covariance of the sky and of what all templates are multiplied by, together."""
    columns = np.concatenate([np.asarray(s.columns) for s in found.systematics], axis=1)
    told, sky = template_amplitudes(found.solution, columns), found.posterior.covariance()
    covariance = np.block([[np.asarray(sky), told.with_sky], [told.with_sky.T, told.covariance]])
    return np.concatenate([np.asarray(found.posterior.mean), told.mean]), covariance


def parts(setup: Setup) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A, and the standard deviations of the prior and of radiometer noise."""
    variances = setup.prior.variance(), radiometer(setup).diagonal()
    prior, noise = (np.sqrt(np.asarray(variance)) for variance in variances)
    return np.asarray(setup.coupling.dense()), prior, noise


class DenseChannels(NamedTuple):
    """Matrices and vectors of every channel of a scenario, with the templates of its unknowns."""

    couplings: list[np.ndarray]
    templates: list[np.ndarray]
    noise: list[np.ndarray]
    data: list[np.ndarray]
    prior: list[np.ndarray]

    @classmethod
    def of(cls, scenario: Scenario) -> Self:
        found = cls([], [], [], [], [])
        for channel in scenario.channels():
            experiment = lb.build(channel)
            setup, systematics = experiment.setup, lb.infer(experiment).systematics
            a, prior, noise = parts(setup)
            t = np.concatenate([np.asarray(s.columns) for s in systematics], axis=1)
            rest = np.asarray(experiment.data.data) - np.asarray(setup.offset)
            for all_channels, own in zip(found, (a, t, noise, rest, prior), strict=True):
                all_channels.append(own)
        return found


def draw_within(program, arguments, key, sampler, whitening=None, thin=1) -> dict[str, Any]:
    """One chain inside a JAX program, every ``thin``-th draw; many data sets can be mapped over it.

    The sampler's ``chains`` and ``seed`` are not used.
    """
    run = program if whitening is None else whitened(program, whitening)
    white = set() if whitening is None else set(whitening.names)
    all_white = set(latent_sites(program, arguments)) == white
    dynamic, static = eqx.partition(arguments, eqx.is_array)
    kernel = sampler.kernel(
        lambda dynamic: run(**eqx.combine(dynamic, static)), whitening if all_white else None
    )

    def iterate(n, state):
        return jax.lax.fori_loop(0, n, lambda _, s: kernel.sample(s, (dynamic,), {}), state)

    def step(state, _):
        state = iterate(thin, state)
        return state, state.z

    with numpyro_promotion():
        state = iterate(sampler.warmup, kernel.init(key, sampler.warmup, None, (dynamic,), {}))
        _, z = jax.lax.scan(step, state, None, length=sampler.draws)
        sites = jax.vmap(kernel.postprocess_fn((dynamic,), {}))(z)
    return {name: values for name, values in sites.items() if not name.endswith(WHITE_SUFFIX)}
