"""Systematics know how well they know: ranks of known truths over many data sets.

Truths are drawn from a program's own priors, data from the truths (by the program without data),
draws from the posterior by Hamiltonian Monte Carlo about the mode found for each data set.
"""

from dataclasses import replace

import equinox as eqx
import experiments as ex
import numpy as np
import pytest
from numpyro import handlers
from scipy import stats

import lusee_bayes as lb
from lusee_bayes.experiment.experiment import program_pieces
from lusee_bayes.experiment.model import full_model, set_up, true_values
from lusee_bayes.experiment.unknowns import SKY
from lusee_bayes.judge.coverage import LEVELS
from lusee_bayes.sampling import mode, programs
from lusee_bayes.sampling.validation import FALSE_ALARM, N_DRAWS, Ranks, calibrate
from lusee_bayes.systematics import gain_drifts, gain_table, systematic

TINY = ("lmax=6", "observation.runs.0.cycles=0.02")  # 96 data, 49 modes
MONTH = ("lmax=6", "observation.step_s=172800")  # a sample every other day: all sources rise
SPECTRUM = "prior.log_amplitude_std=0.5", "prior.tilt_std=0.5"
LEVEL = "noise.radiometer.log_factor_std=0.5"
JUPITER = "{name: Jupiter, flux_jy: 100000, stokes_v: 0.3}"
SOURCES = f"sources.list=[{{name: Cas A}}, {{name: Cyg A}}, {{name: For A}}, {JUPITER}]"


def pieces(name: str, *overrides: str):
    """(program, its arguments without the data) of a scenario."""
    e, program = lb.build(lb.load_scenario("fiducial", overrides)), lb.load_program(name)
    return program, program.arguments(full_model(e.setup), program_pieces(e))


class Truth(eqx.Module):
    """Values of all sites, and data, drawn by the program itself."""

    program: object = eqx.field(static=True)
    arguments: dict

    def __call__(self, key):
        trace = handlers.trace(handlers.seed(self.program.model, key)).get_trace(**self.arguments)
        data = trace.pop("data")["value"]
        return {name: site["value"] for name, site in trace.items()}, data


def hmc(warmup: int) -> lb.Sampler:
    return lb.Sampler(warmup=warmup, draws=N_DRAWS, algorithm="hmc")


class Draws(eqx.Module):
    """Draws of one chain about the mode of each data set; of sky and drifts in their chart."""

    program: object = eqx.field(static=True)
    arguments: dict
    sampler: lb.Sampler = eqx.field(static=True)
    starts: int = eqx.field(static=True, default=1)
    chart: systematic.Chart | None = None
    thin: int = eqx.field(static=True, default=1)

    def __call__(self, key, data):
        model, arguments = self.program.model, {**self.arguments, "data": data}
        start, hold = None, ()
        if self.chart is not None:
            start, hold = {"sky": marginalised(arguments, data).mean}, gain_drifts.SCALES
        found = mode.laplace_approximation(model, arguments, start, hold, self.starts, self.chart)
        return ex.draw_within(model, arguments, key, self.sampler, found.whitening, self.thin)


class Sites(eqx.Module):
    """What is ranked: the sites of these names."""

    names: tuple[str, ...] = eqx.field(static=True)

    def __call__(self, unknowns, data):
        return {name: unknowns[name] for name in self.names}


def ranks_of(program, arguments, quantities, *, draws=None, n=100, seed=1, regions=()) -> Ranks:
    """One data set after the other: in a batch, each would wait for the slowest."""
    given = Truth(program, arguments), draws or Draws(program, arguments, hmc(60)), quantities
    options = {"n_simulations": n, "seed": seed, "batch": 1, "regions": regions}
    with programs.numpyro_promotion():
        return calibrate(*given, **options)


def limits(ranks: Ranks, level: float) -> tuple[float, float]:
    """Between which a coverage lies that is right, given how many are looked at."""
    chance = 1 - FALSE_ALARM / (len(LEVELS) * len(ranks.names))
    low, high = stats.binom.interval(chance, ranks.n_simulations, level)
    return low / ranks.n_simulations, high / ranks.n_simulations


def assert_calibrated(ranks: Ranks):
    """Even ranks, and intervals that hold the truth as often as they say, binomially."""
    assert ranks.passed, dict(zip(ranks.names, ranks.p_values(), strict=True))
    for level in LEVELS:
        least, most = limits(ranks, level)
        for name, coverage in ranks.coverage().items():
            assert least <= coverage[level] <= most, (name, level, coverage[level])


@pytest.mark.long
def test_noise_level_amplitude_and_tilt():
    program, arguments = pieces("systematics", *TINY, LEVEL, *SPECTRUM)
    assert_calibrated(ranks_of(program, arguments, Sites(("noise_level", "amplitude", "tilt"))))


@pytest.mark.long
def test_fluxes_of_sources_at_rest_and_of_jupiter():
    program, arguments = pieces("systematics", *MONTH, SOURCES, "sources.treatment=sampled")
    names = tuple(f"flux_{name}" for name in ("Cas_A", "Cyg_A", "For_A", "Jupiter"))
    assert_calibrated(ranks_of(program, arguments, Sites(names)))


@pytest.mark.long
def test_permittivity_loss_tangent_and_tilt():
    """On a coarse grid (4e-4 of the beams), of truth and posterior alike: a gradient in 2 ms."""
    parameters = "surface_permittivity: 0.1, loss_tangent: 0.002, zenith_angle_deg: 1.0"
    treatment = f"noise.beam={{treatment: sampled, parameters: {{{parameters}}}}}"
    program, arguments = pieces("systematics", *TINY, treatment)
    (antennas,) = arguments["systematics"]
    source = replace(antennas.instrument.source, nodes=(12, 16))
    coarse = replace(antennas, instrument=replace(antennas.instrument, source=source))
    arguments = {**arguments, "systematics": (coarse,)}
    draws = Draws(program, arguments, hmc(40), starts=3)
    assert_calibrated(ranks_of(program, arguments, Sites(antennas.names), draws=draws))


# --- gain drifts ------------------------------------------------------------------------------


def marginalised(arguments, data):
    """The sky's posterior with the drifts in N, built around its own prediction."""
    gaussian, drifts = arguments["gaussian"], arguments["gain_drifts"]
    around = data
    for _ in range(4):
        model = replace(drifts, visibilities=drifts.layout.scatter(around)).marginalised(gaussian)
        posterior = model.condition(data).posterior
        around = gaussian.predict(posterior.mean)
    return posterior


class MarginalisedDrifts(eqx.Module):
    """Draws of the sky with the drifts integrated out, to second order."""

    arguments: dict

    def __call__(self, key, data):
        return {"sky": marginalised(self.arguments, data).sample(key, N_DRAWS)}


class SkyAsAWhole(eqx.Module):
    """Some modes, and the distance from the marginalised posterior's mean in its own metric."""

    arguments: dict

    def __call__(self, unknowns, data):
        sky = unknowns["sky"]
        white = marginalised(self.arguments, data).whiten(sky[None])[0]
        return {"mode": sky[::6], "distance": (white**2).sum()}


def drifting(drift: str, thin: int):
    program, arguments = pieces("gains", *TINY, f"noise.gain={{{drift}, treatment: sampled}}")
    chart = arguments["gain_drifts"].chart(arguments["gaussian"])
    return program, arguments, Draws(program, arguments, hmc(100), chart=chart, thin=thin)


@pytest.mark.long
def test_strong_drifts_are_calibrated_where_they_are_sampled_and_not_where_marginalised():
    """sigma_g = 0.05 against noise of 1e-5: second order is not enough for the sky as a whole."""
    program, arguments, draws = drifting("sigma: 0.05, correlation_h: 10", 3)
    quantities, regions = SkyAsAWhole(arguments), ("distance",)
    exact = ranks_of(program, arguments, quantities, draws=draws, n=200, regions=regions)
    assert_calibrated(exact)
    draws = MarginalisedDrifts(arguments)
    approximate = ranks_of(program, arguments, quantities, draws=draws, n=1000, regions=regions)
    for level in (0.90, 0.95):
        assert approximate.coverage()["distance"][level] < limits(approximate, level)[0], level
        off = [abs(r.coverage()["distance"][level] - level) for r in (exact, approximate)]
        assert off[0] < off[1], (level, off)


@pytest.mark.long
def test_strength_and_correlation_time_of_drifts():
    """Sampled with the drifts themselves and the sky."""
    scales = "sigma: 0.02, correlation_h: 10, log_sigma_std: 0.5, log_correlation_std: 0.2"
    program, arguments, draws = drifting(scales, 8)
    quantities = Sites(("gain_sigma", "gain_correlation_h"))
    assert_calibrated(ranks_of(program, arguments, quantities, draws=draws))


# --- receivers, ground, gain table and sky, and their null direction ------------------------------


N = 100
GROUND = "noise.regolith={std_k: 30}"
UNKNOWN = "noise.receiver={power_k: 2000}", GROUND, "noise.gain_table={std: 0.01}"
# modes of the sky whose ranks are taken: one of every ell, and some with m != 0
MODES = (0, 2, 3, 6, 8, 12)


@pytest.mark.long
def test_simulation_based_calibration(response_file):
    # known to a fifth, so that no sky is without a signal
    first = ex.with_known_sky(set_up(ex.four_ports(response_file, *UNKNOWN)), 0.04)
    sky_std = np.sqrt(np.asarray(first.prior.variance()))
    ranks, null, shares = [], [], []
    for seed in range(N):
        experiment = ex.drawn(first, seed)
        setup = experiment.setup
        found, truth = lb.infer(experiment), true_values(setup)
        mean, covariance = ex.sky_and_amplitudes(found)
        mean[16:] += np.concatenate([s.expected for s in found.systematics])
        rng = np.random.default_rng((seed, 1))
        draws = rng.multivariate_normal(mean, covariance, N_DRAWS, method="cholesky")
        z = [(truth[f"receiver_{port}_k"] - 2000.0) / 200.0 for port in range(4)]
        z += [(truth["regolith_k"] - 250.0) / 30.0, *truth["gain_table"]]
        true = np.concatenate([setup.sky.modes, z])
        ranks.append((draws < true).sum(0)[[*MODES, *range(16, 25)]])
        # along the null direction, in prior standard deviations
        report = ex.unknowns_report(experiment, found)
        assert report.null.names[0] == SKY and report.null.names[-1] == gain_table.COMMON_GAIN
        off = true - mean
        parts = np.concatenate([off[:1] / sky_std[0], off[16:21], [off[21:].sum() / 2.0]])
        null.append(report.null.weights @ parts)
        shares.append(report.null.share)
    names = [f"mode {k}" for k in MODES] + [f"receiver {port}" for port in range(4)]
    names += ["regolith", *(f"gain {port}" for port in range(4))]
    table = Ranks(np.array(ranks), tuple(names))
    assert table.passed, dict(zip(names, table.p_values(), strict=True))
    # the direction that the data do not tell scatters as its share of the prior says
    assert min(shares) > 0.9
    low, high = stats.chi2(N).interval(1 - 1e-3)
    assert low < np.sum(np.array(null) ** 2 / shares) < high
