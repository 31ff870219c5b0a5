"""Systematics marginalised in N and sampled exactly: densities by hand, and where they agree."""

from functools import lru_cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from assertions import close, within
from experiments import density, density_of, differences, program_arguments, small_experiment
from jax.flatten_util import ravel_pytree
from reference_linear import exact_posterior
from scipy.stats import lognorm, loguniform, norm, truncnorm, uniform

import lusee_bayes as lb
from lusee_bayes.core.arrays import on_host
from lusee_bayes.experiment import model as models
from lusee_bayes.experiment.experiment import Experiment, program_pieces
from lusee_bayes.experiment.model import full_model, moved, radiometer, set_up, systematics
from lusee_bayes.experiment.rounds import settled
from lusee_bayes.experiment.scenario import Scenario
from lusee_bayes.instrument.beams.monopoles import Monopoles, Regolith
from lusee_bayes.instrument.pointing import CLOCK
from lusee_bayes.instrument.products import all_products
from lusee_bayes.noise.instrument_errors import with_gains
from lusee_bayes.systematics.context import Around
from lusee_bayes.systematics.gain_drifts import GainDrifts
from lusee_bayes.systematics.polarisation import Polarisation
from lusee_bayes.systematics.systematic import Expanded

GAINS = "noise.gain={sigma: %g, correlation_h: 10, treatment: %s, visibilities: %s}"
# of the product (1 + g)(1 + g'), with the gains and the sky by hand
PAIRS = [(i, j) for i in range(4) for j in range(i, 4) for _ in range(1 + (i != j))]


def experiment(sigma=1e-3, treatment="sampled", around="model") -> Experiment:
    return small_experiment(GAINS % (sigma, treatment, around))


def test_the_program_is_the_exact_product_of_gains():
    """Density of sky and white noise against scipy's, with gains worked out antenna by antenna."""
    e = experiment(0.05)
    setup, data = e.setup, e.data
    program = lb.load_program("gains")
    arguments = {**program.arguments(full_model(setup), program_pieces(e)), "data": data.data}
    drifts = arguments["gain_drifts"]
    white = np.random.default_rng(0).normal(size=(4, drifts.grid.shape[0]))
    sky = np.asarray(setup.prior.sample(jax.random.key(1)))
    hours, grid = data.observation.hours, np.asarray(drifts.grid)
    shape = np.sqrt((grid[1] - grid[0]) / 10.0 * np.sqrt(2 / np.pi))
    gains = 0.05 * shape * white @ np.exp(-(((hours[None] - grid[:, None]) / 10.0) ** 2))
    seen = np.asarray(setup.coupling.dense()) @ sky
    for k, (i, j) in enumerate(PAIRS):
        seen[slice(k * len(hours), (k + 1) * len(hours))] *= (1 + gains[i]) * (1 + gains[j])
    expected = norm.logpdf(white).sum()
    expected += norm.logpdf(sky, 0, np.sqrt(np.asarray(setup.prior.variance()))).sum()
    sigma = np.sqrt(np.asarray(radiometer(setup).diagonal()))
    expected += norm.logpdf(np.asarray(data.data), seen, sigma).sum()
    got, trace = density(program, arguments, {"sky": sky, "gain_noise": white})
    # residuals of many sigma: squares of 1e5 sigma, each to 1e-10 of itself
    assert got == pytest.approx(expected, rel=1e-9)
    within(trace["gains"]["value"], gains, 1e-15)


def test_white_noise_makes_drifts_of_the_right_covariance():
    """The response of histories to white noise, squared, is C_g: to exp(-9 pi^2 / 2) = 5e-20."""
    drifts = GainDrifts.build(experiment().setup.scenario.noise.gain, experiment().setup, Around())
    hours = np.asarray(drifts.hours)
    for correlation_h in (10.0, 14.0, 20.0):
        drift = lb.GainDrift(0.02, correlation_h)
        # a margin for 10 hours cuts off longer ones at exp(-(60 / t)^2 2)
        root = np.asarray(drift.history(jnp.eye(drifts.grid.shape[0]), hours, drifts.grid))
        expected = 4e-4 * np.exp(-0.5 * ((hours[:, None] - hours) / correlation_h) ** 2)
        within(root.T @ root, expected, 4e-4 * (1e-14 + np.exp(-2 * (60.0 / correlation_h) ** 2)))


def test_sampled_gains_multiply_what_n_holds_and_drifts_stay_in_it():
    """N by hand: the radiometer's, that of drifts, and the polarised sky behind the table."""
    table, sky = "noise.gain_table={std: 0.02, treatment: sampled}", "{linear: 0.01, lmax: 2}"
    drifts = GAINS % (1e-3, "marginalised", "model")
    e = small_experiment(table, f"noise.polarisation={sky}", drifts, lmax=2)
    setup, z = e.setup, np.array([0.7, -1.1, 0.4, 1.6])
    base, section = models.base_model(setup), setup.scenario.noise
    drifting = GainDrifts.build(section.gain, setup, Around()).marginalised(base)
    gains = np.repeat([np.sqrt((1 + 0.02 * z[i]) * (1 + 0.02 * z[j])) for i, j in PAIRS], 6)
    u = Polarisation.build(section.polarisation, setup, Around()).root
    u = (gains * np.asarray(drifting.coupling.response))[:, None] * u
    a = gains[:, None] * np.asarray(drifting.coupling.dense())
    noise, s = np.asarray(drifting.noise.dense()) + u @ u.T, np.asarray(setup.prior.variance())
    expected = exact_posterior(a, s, noise, np.asarray(e.data.data)).log_prob
    got = density_of(e, {"gain_table": z})
    assert got == pytest.approx(expected + norm.logpdf(z).sum(), rel=1e-8, abs=1e-4)


@pytest.mark.long
@pytest.mark.essential
def test_found_drifts_have_the_shift_of_the_volume():
    """Of sky and drifts together, -ln|Lambda| / 2 has a slope; the map moves by what it pulls.

    Lambda is that of both, differentiated; draws are replaced by a basis, so that means over them
    are exact. The slope neglects what the noise tells between sky and drifts: below 1e-2.
    """
    e = small_experiment(GAINS % (0.05, "marginalised", "posterior"), lmax=2, cycles=0.1)
    found = settled(e.setup, Around(e.data))
    (drifts,), solution, n = found.drifts, found.solution, len(e.data.data)
    assert drifts.found is not None
    weighted = np.asarray(solution.factor.whiten_transpose(np.sqrt(n) * np.eye(n)))
    skies = solution.covariance @ np.asarray(solution.model.coupling.transpose_mv(weighted))
    slope = drifts.volume_slope(solution, (skies.T, weighted.T, 0.0))
    hours = np.asarray(drifts.hours)
    moved_by = (drifts.slopes * drifts.drift.correlated(slope, hours)[:, None]).sum(0)
    pull = solution.factor.solve(np.asarray(e.setup.layout.gather(moved_by)))
    covariance = solution.covariance
    got = -covariance @ np.asarray(solution.model.coupling.transpose_mv(np.asarray(pull)))

    a = np.asarray(e.setup.coupling.dense())
    sigma = np.sqrt(np.asarray(radiometer(e.setup, found.around).diagonal()))
    kernel = np.asarray(drifts.drift.kernel(np.subtract.outer(hours, hours)))
    kernel = kernel + 1e-12 * kernel[0, 0] * np.eye(len(hours))
    root = np.kron(np.eye(4), np.linalg.cholesky(kernel))
    s = np.sqrt(np.asarray(e.setup.prior.variance()))

    def seen(x):  # unit normals of the sky, then of the drifts
        sky, gains = x[: len(s)] * s, (root @ x[len(s) :]).reshape(4, -1)
        signal = e.setup.layout.scatter(a @ sky) + e.setup.background
        return e.setup.layout.gather(with_gains(signal, gains)) / sigma

    def precision(x):
        slopes = jax.jacfwd(seen)(x)
        return slopes.T @ slopes + jnp.eye(len(x))

    x = np.linalg.solve(root, drifts.found.ravel())
    x = jnp.concatenate([np.asarray(found.posterior.mean) / s, x])
    pulled = jax.jit(jax.grad(lambda x: -0.5 * jnp.linalg.slogdet(precision(x))[1]))(x)
    expected = s * np.linalg.solve(precision(x), pulled)[: len(s)]
    std = np.sqrt(np.diag(covariance))
    assert np.abs(expected / std).max() > 0.2
    within(got / std, expected / std, 0.01)


@pytest.mark.long
def test_a_map_with_found_drifts_is_that_of_hmc(tmp_path):
    """Drifts of 5 %: without the volume's slope, the sky's mean was 1.9 standard deviations off."""
    scenario = "cycles: 1.0, turntable_deg: 0.0"
    plain = [f"observation={{step_s: 21460, runs: [{{{scenario}}}]}}", "lmax=4", "seed=3"]
    prior = ["sky.sources=false", "prior={model: isotropic, spectrum: sky}"]
    both = [GAINS % (0.05, t, "posterior") for t in ("marginalised", "sampled")]
    marginal, sampled = (lb.load_scenario("fiducial", [*plain, *prior, t]) for t in both)
    posterior = lb.infer(lb.build(marginal)).posterior
    sampler = lb.Sampler(chains=2, warmup=300, draws=600)
    drawn = lb.run_sample(sampled, tmp_path / "run", sampler=sampler).result
    sky = drawn[0].tree["posterior"]["sky"].values.reshape(-1, 25)
    assert np.abs((np.asarray(posterior.mean) - sky.mean(0)) / sky.std(0)).max() < 0.2
    within(np.sqrt(np.diag(np.asarray(posterior.covariance()))) / sky.std(0), 1.0, 0.15)


# --- coordinates for sky and gains together -------------------------------------------------------


SCALES = {"log_sigma_std": 0.5, "log_correlation_std": 0.2}


@lru_cache
def pieces(*scales: str):
    """(gaussian, drifts, chart) with these scales as sites."""
    stds = "".join(f", {name}: {SCALES[name]}" for name in scales)
    gain = f"noise.gain={{sigma: 0.03, correlation_h: 10, treatment: sampled{stds}}}"
    parts = program_pieces(small_experiment(gain, lmax=2))
    gaussian, drifts = parts["gaussian"](), parts["gain_drifts"]()
    return gaussian, drifts, drifts.chart(gaussian)


def values_of(chart, seed=0) -> dict:
    """Unconstrained values of the chart's sites, and of one that it does not know."""
    rng = np.random.default_rng(seed)
    values = {
        "sky": jnp.asarray(1e4 * rng.normal(size=9)),
        "gain_noise": jnp.asarray(rng.normal(size=(4, len(chart.drifts.grid)))),
        "other": jnp.asarray(rng.normal(size=3)),
    }
    if "gain_sigma" in chart.names:
        values["gain_sigma"] = jnp.log(0.03) + jnp.asarray(0.4 * rng.normal())
    if "gain_log_correlation" in chart.names:
        values["gain_log_correlation"] = jnp.asarray(rng.normal())
    return values


def gains_of(drifts, values):
    """Gains at the samples, from the sites, by hand."""
    sigma, correlation_h = 0.03, 10.0
    if "gain_sigma" in values:
        sigma = jnp.exp(values["gain_sigma"])
    if "gain_log_correlation" in values:
        reach = 3.0 * SCALES["log_correlation_std"]
        u = 1.0 / (1.0 + jnp.exp(-values["gain_log_correlation"]))
        correlation_h = 10.0 * jnp.exp(-reach + 2.0 * reach * u)
    drift = lb.GainDrift(sigma, correlation_h)
    return drift.history(values["gain_noise"], np.asarray(drifts.hours), drifts.grid)


CASES = [(), ("log_sigma_std",), ("log_correlation_std",), tuple(SCALES)]


@pytest.mark.essential
@pytest.mark.parametrize("scales", CASES)
def test_there_and_back_with_the_determinant_of_the_derivative(scales):
    """Rounding of the solves: the smallest covariance is the floor, 3e-10 over 4e-3 of the drifts'.

    So the way back is good to 1e-16 * 1e7, and the determinant likewise.
    """
    _, _, chart = pieces(*scales)
    values = values_of(chart)
    x = chart.from_values(values)
    back, log_det = chart.to_values(x)
    assert set(back) == set(values)
    for name in values:
        within(back[name], values[name], 1e-9 * np.abs(np.asarray(values[name])).max())
    assert (np.asarray(x["other"]) == np.asarray(values["other"])).all()
    flat, split = ravel_pytree(x)
    jacobian = jax.jit(jax.jacfwd(lambda f: ravel_pytree(chart.to_values(split(f))[0])[0]))(flat)
    expected = np.linalg.slogdet(np.asarray(jacobian))[1]
    assert float(log_det) == pytest.approx(expected, abs=1e-6) and abs(expected) > 1e-2


@pytest.mark.essential
@pytest.mark.parametrize("scales", CASES)
def test_the_data_do_not_change_along_the_shared_scale(scales):
    """Nor with strength and correlation time, by more than the noise."""
    gaussian, drifts, chart = pieces(*scales)

    def seen(x):
        values, _ = chart.to_values(x)
        gains = gains_of(drifts, values)
        return np.asarray(drifts.response(gains) * gaussian.predict(values["sky"])), gains

    x = chart.from_values(values_of(chart))
    before, gains = seen(x)
    scale, constant = chart._shared()
    assert float((scale * jnp.ones((4, 1)) * constant).sum()) == pytest.approx(1.0, rel=1e-14)
    moved, other = seen(x | {"gain_noise": x["gain_noise"] + 0.1 * constant})
    noise = np.sqrt(np.asarray(chart.floor) * before.size)
    # the gains of constant noise are constant to what lies outside the grid, exp(-36); with other
    # scales to a fraction of the noise
    exact = 1e-12 if not scales else noise
    assert np.linalg.norm(moved - before) < exact * np.abs(before).max()
    assert np.linalg.norm(np.asarray(1 + other - np.exp(0.1) * (1 + gains))) < exact
    for name, step in [("gain_sigma", 0.2), ("gain_log_correlation", 0.5)]:
        if name not in x:
            continue
        turned, other = seen(x | {name: x[name] + step})
        # each of the gains' modes to floor / (floor + variance) of itself: half the noise at most
        assert np.linalg.norm(np.asarray(other - gains)) < noise
        assert np.linalg.norm(turned - before) < 2 * noise * np.abs(before).max()
        # while the same change of the site alone changes them altogether
        values, _ = chart.to_values(x)
        plain = gains_of(drifts, values | {name: values[name] + step})
        assert np.linalg.norm(np.asarray(plain - gains)) > 10 * noise


def test_drifts_too_strong_for_the_coordinates_have_none():
    """Where the mean gain may be -1 the scale has no logarithm: 0.1 exp(3 x 0.5) > 0.2."""
    gaussian, drifts, chart = pieces("log_sigma_std")
    assert chart is not None
    assert GainDrifts(**{**vars(drifts), "drift": lb.GainDrift(0.1, 10.0)}).chart(gaussian) is None


# --- models/instrument.py and models/gain_scales.py -----------------------------------------------


@pytest.mark.long
def test_the_instruments_program():
    """Beams of antennas built so, the evidence in decimal arithmetic, and the priors by scipy."""
    e = small_experiment(lmax=4)
    setup, data = e.setup, e.data
    values = {"surface_permittivity": 3.4, "deep_permittivity": 6.6, "loss_tangent": 0.02}
    values |= {"zenith_angle_deg": 76.5, "noise_level": 1.7}
    antennas = Monopoles(Regolith(3.4, 6.6, 0.02), zenith_angle_deg=76.5)
    a = lb.CouplingMatrix.build(lb.monopole_beams(25.0, 4, antennas), setup.pointing).dense()
    noise = np.diag(1.7 * np.asarray(radiometer(setup).diagonal()))
    s = np.asarray(setup.prior.variance())
    expected = exact_posterior(np.asarray(a), s, noise, np.asarray(data.data)).log_prob
    expected += uniform.logpdf(3.4, 2.5, 2.5) + uniform.logpdf(6.6, 5.0, 3.0)
    expected += loguniform.logpdf(0.02, 1e-3, 1e-1) + lognorm.logpdf(1.7, 0.5)
    expected += norm.logpdf(76.5, 75.0, 2.0)
    # chi^2 of 1e8, of which A by two routes leaves 1e-13 of 2e4 K against 0.2 K, twice
    assert abs(expected) > 1e4
    assert density_of(e, values, "instrument") == pytest.approx(expected, rel=1e-7)


@pytest.mark.essential
def test_the_program_of_gain_scales():
    """N with the drifts' covariance entry by entry, the mean of the autos, and the priors."""
    gain = "noise.gain={sigma: 0.01, correlation_h: 8, treatment: sampled, visibilities: model}"
    e = small_experiment(gain, lmax=4)
    setup, data = e.setup, e.data
    sigma, octaves = 0.013, 0.4
    correlation_h = 8.0 * 2.0**octaves
    hours, products = np.asarray(data.observation.hours), all_products(4)
    drifts = GainDrifts.build(setup.scenario.noise.gain, setup, Around(data))
    around = np.asarray(drifts.visibilities)
    c = sigma**2 * np.exp(-0.5 * ((hours[:, None] - hours) / correlation_h) ** 2)
    n_times, noise = len(hours), np.diag(np.asarray(radiometer(setup).diagonal()))
    for x, p in enumerate(products):
        for y, q in enumerate(products):
            shared = (p.i == q.i) + (p.i == q.j) + (p.j == q.i) + (p.j == q.j)
            both = (p.i == q.i) * (p.j == q.j) + (p.i == q.j) * (p.j == q.i)
            rows = slice(x * n_times, (x + 1) * n_times)
            columns = slice(y * n_times, (y + 1) * n_times)
            signal = around[x][:, None] * around[y][None]
            noise[rows, columns] += signal * c * (shared + c * both)
    mean = np.repeat([1.0 + sigma**2 * (p.i == p.j) for p in products], n_times)
    a = mean[:, None] * np.asarray(setup.coupling.dense())
    s = np.asarray(setup.prior.variance())
    expected = exact_posterior(a, s, noise, np.asarray(data.data)).log_prob
    expected += lognorm.logpdf(sigma, 0.5, scale=0.01)
    expected += truncnorm.logpdf(octaves, -1 / 0.7, 1 / 0.7, 0.0, 0.7)
    values = {"gain_sigma": sigma, "gain_octaves": octaves}
    program = lb.load_program("gain_scales")
    got, trace = density(program, program_arguments(program, e), values)
    assert set(trace) == {*values, "gain_correlation_h", "data"}
    assert float(trace["gain_correlation_h"]["value"]) == pytest.approx(correlation_h, rel=1e-14)
    # logarithms of 49 squeezed modes, each to 1e-6
    assert got == pytest.approx(expected, rel=1e-8, abs=1e-4)


# --- what is marginalised is the derivative of what is sampled ------------------------------------


RUNS = "observation.runs=[{cycles: 0.2}, {cycles: 0.2, turntable_deg: 30}]"
POINTING = (
    "noise.pointing={clock_s: 60, clock_drift_s_per_day: 20, turntable_deg: 0.3, lon_deg: 0.1, "
    "lat_deg: 0.1, tilt_east_deg: 0.2, tilt_north_deg: 0.1}"
)
SOURCES = ["sky.sources=false", "sources.list=[{name: Cas A}, {name: Cyg A, stokes_v: 0.3}]"]
TABLE = ["noise.receiver={power_k: 500}", "noise.gain_table={std: 0.02}"]
OTHERS = [*TABLE, "sources.list=[{name: Cas A, block_h: 50}]", "sky.sources=false"]


def scenario(*more: str) -> Scenario:
    given = ["lmax=5", "observation.step_s=43200", RUNS, *more]
    return lb.load_scenario("fiducial", [*given, "prior={model: isotropic, spectrum: sky}"])


BESIDE_SOURCES = pytest.param([POINTING, *SOURCES], marks=pytest.mark.long)


@pytest.mark.parametrize("more", [OTHERS, [POINTING], BESIDE_SOURCES])
def test_columns_are_the_derivative_of_the_effect(more):
    """Away from the prior means. Differences are good to rounding over the step, 1e-16 / 1e-4 of
    data that are 1e3 times what a standard deviation does; a clock's drift turns the Moon about its
    z axis there and about the mean pole here, 0.04 degrees apart."""
    setup = set_up(scenario(*more))
    rng, values = np.random.default_rng(0), {}
    for _, systematic in systematics(setup):
        values |= systematic.in_units(rng.normal(size=len(systematic.names)))
    model, sky = models.base_model(setup), setup.sky.modes
    for _, systematic in systematics(setup, Around(values=values)):
        expanded = on_host(Expanded.at(systematic, model, Around(sky=sky, values=values)))
        steps = 1e-4 * np.eye(len(expanded.centre))
        expected = differences(systematic, model, sky, expanded.centre, steps)
        size, off = (np.linalg.norm(x, axis=0) for x in (expected, expanded.columns - expected))
        for name, size_of, off_of in zip(systematic.names, size, off, strict=True):
            # a source that is down in a block does nothing
            assert size_of > 0.0 or name.startswith("flux_")
            assert off_of <= (1e-3 if "drift" in name else 1e-6) * size_of


def test_about_values_a_is_that_of_the_shifted_observation():
    setup = set_up(scenario(POINTING, *SOURCES))
    (_, nominal), *_ = systematics(setup)
    values = nominal.in_units(np.random.default_rng(1).normal(size=len(nominal.names)))
    (_, offsets), *_ = systematics(setup, Around(values=values))
    model, sky = models.base_model(setup), setup.sky.modes
    got = np.asarray(offsets.effect(model, values).predict(sky))
    exact = np.asarray(moved(setup, values).coupling @ sky)
    close(got, exact, 1e-12)
    # sources that the context has moved are not moved twice, and angles alone need no ephemeris; of
    # what a clock does without them 1e-3 are left out
    angles = {name: value for name, value in values.items() if name not in CLOCK}
    for some, tolerance in ((angles, 1e-9), ({"clock_s": 90.0}, 1e-3)):
        given = dict.fromkeys(values, 0.0) | some
        got, there = np.asarray(nominal.effect(model, given).predict(sky)), moved(setup, some)
        exact, before = (np.asarray(one.coupling @ sky) for one in (there, setup))
        change = np.array(there.responses) - np.array(setup.responses)
        for section, seen in zip(setup.scenario.sources.list, change, strict=True):
            exact = exact + section.mean_flux(25.0) * setup.layout.gather(seen)
        assert np.linalg.norm(got - exact) < tolerance * np.linalg.norm(exact - before)
