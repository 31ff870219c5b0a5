"""Receivers, ground and gain table: templates of N about what data tell, or sites, by hand."""

from dataclasses import replace

import numpy as np
import pytest
from assertions import refuse, within
from experiments import density_of, drawn, four_ports, offset_posterior, parts, sky_and_amplitudes
from reference_linear import Answer, white_posterior
from scipy.optimize import least_squares
from scipy.stats import norm

import lusee_bayes as lb
from lusee_bayes.experiment import model as models
from lusee_bayes.experiment.experiment import Experiment
from lusee_bayes.experiment.model import full_model, radiometer, set_up, simulate, true_values
from lusee_bayes.experiment.rounds import Inference, settled
from lusee_bayes.instrument import products, visibilities
from lusee_bayes.instrument.beams.sampled import read_beam
from lusee_bayes.systematics.context import Around, Setup
from lusee_bayes.systematics.gain_table import GainTable
from lusee_bayes.testing import small_scenario

RECEIVER = "noise.receiver={power_k: 2000, relative_std: 0.1, treatment: %s}"
GROUND = "noise.regolith={std_k: 30, treatment: %s}"
AUTOS = [products.labels().index(f"{port}{port}R") for port in range(4)]


@pytest.fixture(scope="module")
def warm(response_file) -> Experiment:
    return lb.build(four_ports(response_file, RECEIVER % "marginalised", GROUND % "marginalised"))


def ground(response_file, moon_k: float) -> np.ndarray:
    return np.asarray(replace(read_beam(response_file), moon_k=moon_k).background(20.0))


def columns(response_file, n_times: int) -> np.ndarray:
    """What one standard deviation of each of the five adds to the data, made by hand."""
    grid = np.zeros((16, n_times, 5))
    for port, product in enumerate(AUTOS):
        grid[product, :, port] = 200.0
    grid[:, :, 4] = (ground(response_file, 280.0) - ground(response_file, 250.0))[:, None]
    return grid.reshape(-1, 5)


def joint(warm: Experiment, response_file):
    """Sky and the five together: 21 unknowns with independent priors."""
    setup, data = warm.setup, np.asarray(warm.data.data)
    t = columns(response_file, setup.layout.n_times)
    a, prior, noise = parts(setup)
    a, prior = np.concatenate([a, t], axis=1), np.append(prior, np.ones(5))
    constant = ground(response_file, 250.0).copy()
    constant[AUTOS] += 2000.0
    return white_posterior(a, prior, noise, data - np.repeat(constant, setup.layout.n_times))


def assert_same(found: Inference, expected: Answer, sigma: float) -> None:
    """Sky and unknowns: means to so many standard deviations, covariances to 1e-5.

    Lambda's condition costs 1e-6.
    """
    mean, covariance = sky_and_amplitudes(found)
    assert np.abs((mean - expected.mean) / expected.std).max() < sigma
    scale = np.outer(expected.std, expected.std)
    within(covariance / scale, expected.covariance / scale, 1e-5)


def test_marginalised_they_are_the_closed_form(warm, response_file):
    found, expected = lb.infer(warm), joint(warm, response_file)
    assert_same(found, expected, 1e-5)
    assert float(found.posterior.log_evidence) == pytest.approx(expected.log_prob, abs=1e-4)
    # sky and unknowns do depend on one another, and the data do tell the receivers
    std = expected.std
    assert np.abs(expected.covariance[0, 16:] / std[0] / std[16:]).max() > 0.05
    assert (std[16:20] < 0.5).all()


def test_the_mean_receiver_sets_the_noise_and_the_offset(warm, response_file):
    bare, setup = set_up(four_ports(response_file)), warm.setup
    added = np.asarray(setup.signal) - np.asarray(bare.signal)
    np.testing.assert_allclose(added[AUTOS], 2000.0, rtol=1e-9)
    np.testing.assert_allclose(np.delete(added, AUTOS, axis=0), 0.0, atol=1e-9)
    ratio = np.asarray(radiometer(setup).diagonal()) / np.asarray(radiometer(bare).diagonal())
    assert ratio.reshape(16, -1)[0].min() > 1.2
    np.testing.assert_allclose(setup.offset - bare.offset, setup.layout.gather(added), atol=1e-8)


def test_powers_in_volts_and_their_slope(response_file):
    """P / U_aa at the receiver's input, and a power law in frequency: (20 / 5)^-2 = 1/16."""
    per_kelvin = read_beam(response_file).per_kelvin(20.0)
    keys = "slope: -2, reference_mhz: 5"
    volts = set_up(four_ports(response_file, f"noise.receiver={{power_v2_hz: 1e-17, {keys}}}"))
    moon = ground(response_file, 250.0)[AUTOS]
    expected = 1e-17 / 16 / per_kelvin
    np.testing.assert_allclose(volts.background[AUTOS, 0] - moon, expected, rtol=1e-9)
    kelvin = set_up(four_ports(response_file, f"noise.receiver={{power_k: 160, {keys}}}"))
    np.testing.assert_allclose(kelvin.background[AUTOS, 0] - moon, 10.0, rtol=1e-9)
    # of antennas that know no volts
    plain = set_up(small_scenario("noise.receiver={power_k: 100}"))
    np.testing.assert_array_equal(plain.background[AUTOS], 100.0)


@pytest.mark.parametrize("treatment", ["marginalised", "sampled", "ignored"])
def test_simulated_data_hold_them_whatever_their_treatment(warm, response_file, treatment):
    given = four_ports(response_file, RECEIVER % treatment, GROUND % treatment)
    setup = replace(warm.setup, scenario=given)
    truth = true_values(setup)
    assert set(truth) == {*(f"receiver_{port}_k" for port in range(4)), "regolith_k"}
    powers = np.array([truth[f"receiver_{port}_k"] for port in range(4)])
    # drawn from their priors, each its own
    assert (np.abs(powers - 2000.0) < 4 * 200.0).all()
    assert len(set(powers)) == 4
    assert 0.0 < abs(truth["regolith_k"] - 250.0) < 4 * 30.0
    z = np.append((powers - 2000.0) / 200.0, (truth["regolith_k"] - 250.0) / 30.0)
    added = np.asarray(setup.layout.gather(models.true_signal(setup, truth) - setup.signal))
    within(added, columns(response_file, setup.layout.n_times) @ z, 1e-8)
    np.testing.assert_array_equal(simulate(setup).data, warm.data.data)
    reseeded = replace(setup, scenario=given.model_copy(update={"seed": 2}))
    assert not set(true_values(reseeded).values()) & set(truth.values())


def test_ground_at_zero_kelvin_has_a_template_all_the_same(response_file):
    cold = set_up(four_ports(response_file, "beam.moon_temperature_k=0", GROUND % "marginalised"))
    assert cold.offset is None
    root = columns(response_file, cold.layout.n_times)[:, 4:]
    bare = np.diag(np.asarray(radiometer(cold).diagonal()))
    np.testing.assert_allclose(full_model(cold).noise.dense(), bare + root @ root.T, rtol=1e-6)


def test_receivers_sampled_have_the_density_of_the_closed_form(warm, response_file):
    """Priors by scipy, and the evidence of the sky alone given the five."""
    e = lb.build(four_ports(response_file, RECEIVER % "sampled", GROUND % "sampled"))
    setup, z = e.setup, np.array([0.3, -0.2, 0.1, 0.5, -1.2])
    values = {f"receiver_{port}_k": 2000.0 + 200.0 * z[port] for port in range(4)}
    values["regolith_k"] = 250.0 + 30.0 * z[4]
    t = columns(response_file, setup.layout.n_times)
    rest = np.asarray(e.data.data) - np.asarray(setup.offset) - t @ z
    a, prior, noise = parts(setup)
    expected = white_posterior(a, prior, noise, rest).log_prob
    expected += norm.logpdf(z).sum() - 4 * np.log(200.0) - np.log(30.0)
    # chi^2 of 1e7, each of whose squares is right to 1e-10 of itself
    assert density_of(e, values) == pytest.approx(expected, rel=1e-8)
    # in the model of first order they are in N all the same
    noise, marginalised = (full_model(one).noise.dense() for one in (setup, warm.setup))
    np.testing.assert_array_equal(noise, marginalised)


def test_what_antennas_without_volts_or_ground_cannot_have():
    for section, message in (
        ("noise.receiver={power_v2_hz: 1e-17}", "power_v2_hz needs antennas calibrated in volts"),
        ("noise.regolith={std_k: 30}", r"noise\.regolith needs antennas that receive from the"),
    ):
        refuse(message, set_up, lb.load_scenario("fiducial", ["lmax=2", section]))


# --- errors of the gain table ---------------------------------------------------------------------


TABLE = "noise.gain_table={std: 0.01, treatment: %s}"
UNKNOWN = ("noise.receiver={power_k: 2000}", "noise.regolith={std_k: 30}", TABLE % "marginalised")
LEVELS = ("M0 PC1", "M0 PC2", "L3 PC1", "M1 PC1", "H2 PC1")
PORTS = np.array([0, 0, 0, 1, 2])


def slopes(n_times: int) -> np.ndarray:
    """Two components at one level of port 0 and another level after it; port 3 has no error, and
    port 2 never the level that the last is of."""
    early, ramp = np.arange(n_times) < n_times // 2, np.linspace(-1.0, 1.0, n_times)
    return np.stack([0.01 * early, 0.004 * ramp * early, 0.02 * ~early, 0.008 + 0 * ramp, 0 * ramp])


# as of averaged spectra, whose files name the errors of their table
NAMED = visibilities.Calibration(np.full(23, 1e10), LEVELS, PORTS, slopes(23))


def by_hand(z: np.ndarray, port, slope: np.ndarray) -> np.ndarray:
    """sqrt((1 + eps_i)(1 + eps_j)) of every datum."""
    gain = np.ones((4, slope.shape[1]))
    for value, p, s in zip(z, port, slope, strict=True):
        gain[p] += value * s
    return np.concatenate([np.sqrt(gain[p.i] * gain[p.j]) for p in products.all_products()])


def per_port(z: np.ndarray, n_times: int = 23) -> np.ndarray:
    return by_hand(z, range(4), np.full((4, n_times), 0.01))


@pytest.fixture(scope="module")
def experiment(response_file) -> Experiment:
    return lb.build(four_ports(response_file, *UNKNOWN, "seed=5"))


@pytest.fixture(scope="module")
def named(response_file) -> Setup:
    return replace(set_up(four_ports(response_file, "noise.gain_table={}")), calibration=NAMED)


# --- simulated data -------------------------------------------------------------------------------


def test_simulated_data_hold_the_errors_that_data_name(named):
    z = true_values(named)["gain_table"]
    # the last has no effect and is none
    assert z.shape == (4,)
    seen = np.asarray(named.layout.gather(models.true_signal(named, {"gain_table": z})))
    factors = by_hand(z, PORTS[:4], slopes(23)[:4])
    plain = np.asarray(named.layout.gather(named.signal))
    np.testing.assert_allclose(seen, factors * plain, rtol=1e-9, atol=1e-9)


# --- marginalised ---------------------------------------------------------------------------------


def test_about_given_values_it_is_the_closed_form(experiment, response_file):
    """d = F(z_0)(A m + c + T_l z_l) + dF/dz v_0 (z - z_0) + n with 25 unknowns, and flags."""
    setup, data = experiment.setup, experiment.data
    rng = np.random.default_rng(3)
    z, powers = np.array([0.7, -1.0, 0.4, 1.5]), rng.normal(size=4)
    values = {f"gain_{port}": 0.01 * z[port] for port in range(4)}
    values |= {f"receiver_{port}_k": 2000.0 + 200.0 * powers[port] for port in range(4)}
    sky = setup.sky.modes * rng.uniform(0.9, 1.1, 16)
    around = Around(data, values=values, sky=sky)
    model, systematics = models.model_about(setup, around)
    found = Inference(model.condition(data.data), systematics, 1, around)
    linear = columns(response_file, 23)
    a, prior, noise = parts(setup)
    seen = a @ sky + np.asarray(setup.offset) + linear[:, :4] @ powers
    factors = per_port(z)[:, None]
    t = factors * log_slopes(z) * seen[:, None]
    rows, prior = [factors * a, factors * linear, t], np.append(prior, np.ones(9))
    rest = np.asarray(data.data) - factors[:, 0] * np.asarray(setup.offset) + t @ z
    # residuals here are 1e4 standard deviations
    assert_same(found, white_posterior(np.concatenate(rows, axis=1), prior, noise, rest), 1e-3)


def log_slopes(z: np.ndarray) -> np.ndarray:
    """dln F/dz: of gains that differ for each port ln F is half of the sum of two logarithms."""
    # how often each port is in the product of every datum: (data, ports)
    ports = [[(p.i == port) + (p.j == port) for port in range(4)] for p in products.all_products()]
    return 0.005 * np.repeat(np.array(ports, dtype=np.float64), 23, axis=0) / (1.0 + 0.01 * z)


def test_rounds_find_the_mode_and_the_first_order_does_not(experiment, response_file):
    """Errors of 1 %, noise of 1e-5 of the signal: all unknowns, where p(z | d) is the largest.

    Its gradient is that of exact least squares in all unknowns and of ln|K(z)|, by hand, with
    K = F (A S A^T + T_l T_l^T) F + N_0 a matrix; the mode is where both cancel, to 1e-12.
    """
    setup, d = experiment.setup, np.asarray(experiment.data.data)
    found = lb.infer(experiment)
    assert found.rounds > 2
    (a, prior, noise), offset = parts(setup), np.asarray(setup.offset)
    rows = np.concatenate([a * prior, columns(response_file, 23)], axis=1)

    def volume(z):
        """d(ln|K| / 2)/dz."""
        inside = np.linalg.svd(per_port(z)[:, None] * rows / noise[:, None], full_matrices=False)
        left, values, _ = inside
        followed = (left**2 * (values**2 / (1.0 + values**2))).sum(1)
        return log_slopes(z).T @ followed

    def residuals(x, force):
        seen = rows @ x[:21] + offset
        return np.append((per_port(x[21:]) * seen - d) / noise, x + np.append(np.zeros(21), force))

    def jacobian(x, force):
        seen, factors = rows @ x[:21] + offset, per_port(x[21:])
        by_gain = (factors * seen)[:, None] * log_slopes(x[21:])
        white = np.concatenate([factors[:, None] * rows, by_gain], axis=1) / noise[:, None]
        return np.concatenate([white, np.eye(25)])

    tight = {"xtol": 1e-15, "ftol": 1e-15, "gtol": 1e-15, "max_nfev": 2000, "x_scale": "jac"}
    mode = np.zeros(25)
    for _ in range(4):
        force = volume(mode[21:])
        mode = least_squares(residuals, mode, jacobian, args=(force,), **tight).x
    assert np.abs(volume(mode[21:]) - force).max() < 1e-6
    root = np.linalg.qr(jacobian(mode, force))[1]
    std = np.sqrt(np.diag(np.linalg.inv(root.T @ root)))

    def off(it: Inference) -> np.ndarray:
        told = [part.expected + it.amplitudes(part).mean for part in it.systematics]
        return np.concatenate([np.asarray(it.posterior.mean) / prior, *told]) - mode

    # every unknown, and every direction of them
    assert np.abs(off(found) / std).max() < 0.05
    assert np.abs(root @ off(found)).max() < 0.05
    # first order leaves out what goes as the square of the way to the mode: about gains that are
    # three prior standard deviations too high, three times as far as their prior means, it is wrong
    # by a hundred times what is allowed; rounds lead to the mode from there, too
    high = np.full(4, 3.0)
    sky = np.linalg.lstsq(a, d / per_port(high) - offset, rcond=None)[0]
    values = {f"gain_{port}": 0.01 * z for port, z in enumerate(high)}
    around = replace(found.around, values=values, sky=sky)
    ways = np.linalg.norm([mode[21:] - high, mode[21:]], axis=1)
    assert ways[0] > 3.0 * ways[1]
    model, unknowns = models.model_about(setup, around)
    first = Inference(model.condition(d), unknowns, 1, around)
    assert np.abs(off(first) / std).max() > 5.0
    assert np.abs(root @ off(first)).max() > 5.0
    assert np.abs(off(settled(experiment.setup, around)) / std).max() < 0.05
    # the joint mode is another: each of 21 skies and powers gains by being 0.5 % smaller
    assert force.min() > 0.04
    joint = least_squares(residuals, mode, jacobian, args=(np.zeros(4),), **tight).x
    assert ((joint - mode) / std)[21:].min() > 0.04


@pytest.mark.long
def test_many_modes_do_not_pass_for_a_gain():
    """20 skies of 121 modes: the common gain that is found is zero on average.

    The data tell it by the power of these modes alone, sqrt(2 x 121) x 0.005 = 0.08 prior standard
    deviations for each sky, 0.02 on average. About the joint mode it would be 121 x 0.005 = 0.6.
    """
    given = ["lmax=10", "prior={model: isotropic, spectrum: sky}", "noise.receiver={power_k: 2000}"]
    first = set_up(lb.load_scenario("fiducial", [*given, TABLE % "marginalised"]))
    found = []
    for seed in range(20):
        it = lb.infer(drawn(first, seed))
        gains = it.systematics[-1]
        (common,) = gains.systematic.like_the_sky()[1]
        found.append(common @ (gains.expected + it.amplitudes(gains).mean))
        assert common @ gains.expected < -0.5
    assert np.std(found) < 0.25 and abs(np.mean(found)) < 0.1


def test_errors_that_data_name_are_found(named):
    data = replace(simulate(named), calibration=named.calibration)
    found = lb.infer(Experiment(named, data))
    (table,) = found.systematics
    assert table.systematic.names == ("gain_M0_PC1", "gain_M0_PC2", "gain_L3_PC1", "gain_M1_PC1")
    rms = [np.sqrt((s[s != 0] ** 2).mean()) for s in slopes(23)[:4]]
    np.testing.assert_allclose(table.systematic.stds, rms, rtol=1e-12)
    told = found.amplitudes(table)
    off = (table.expected + told.mean - true_values(named)["gain_table"]) / told.std
    assert np.abs(off).max() < 4.0
    # port 3 is right, so that the others are told from it
    assert told.std.max() < 0.05
    misfit = float(found.model.chi2(found.posterior.mean, data.data) + found.posterior.prior_chi2())
    assert abs(misfit - 368) < 4 * np.sqrt(2 * 368)


def test_clock_and_pointing_beside_it_settle_in_the_same_rounds(response_file):
    """The step of Gauss and Newton that is left, with derivatives of the exact model in all 26."""
    pointing = "noise.pointing={turntable_deg: 0.05, true_values: {turntable_deg: 0.08}}"
    experiment = lb.build(four_ports(response_file, *UNKNOWN, pointing, "seed=5"))
    setup, d = experiment.setup, np.asarray(experiment.data.data)
    found = lb.infer(experiment)
    assert [type(s.systematic).__name__ for s in found.moving] == ["PointingOffsets", "GainTable"]
    _, prior, noise = parts(setup)
    turntable = offset_posterior(found)[0]["turntable_deg"] / 0.05
    _, *rest = found.systematics
    linear = columns(response_file, 23)
    told = [found.amplitudes(part).mean for part in rest]
    told[-1] = told[-1] + rest[-1].expected
    x = np.concatenate([np.asarray(found.posterior.mean) / prior, *told, [turntable]])

    def residuals(x):
        there = models.moved(setup, {"turntable_deg": 0.05 * x[25]})
        seen = np.asarray(there.coupling @ (prior * x[:16])) + np.asarray(setup.offset)
        seen = seen + linear @ x[16:21]
        force = np.concatenate([np.zeros(21), rest[-1].expected, found.offsets.expected])
        return np.append((per_port(x[21:25]) * seen - d) / noise, x - force)

    steps = 1e-4 * np.eye(26)
    slope = np.stack([(residuals(x + s) - residuals(x - s)) / 2e-4 for s in steps], axis=1)
    left = np.linalg.lstsq(slope, residuals(x), rcond=None)[0]
    root = np.linalg.qr(slope)[1]
    assert np.abs(root @ left).max() < 0.05
    truth = true_values(setup)["turntable_deg"] / 0.05
    std = np.sqrt(np.diag(np.linalg.inv(root.T @ root)))
    assert abs(turntable - truth) < 4 * std[25]
    # it is told from none
    assert truth > 10 * std[25]


# --- sampled --------------------------------------------------------------------------------------


def test_sampled_the_density_is_the_closed_form(response_file):
    """Factors by hand on the rows of A and on the offset."""
    e = lb.build(four_ports(response_file, TABLE % "sampled"))
    setup, z = e.setup, np.array([0.5, -1.5, 0.2, 1.1])
    values, factors = {"gain_table": z}, per_port(z)
    a, prior, noise = parts(setup)
    a = factors[:, None] * a
    rest = np.asarray(e.data.data) - factors * np.asarray(setup.offset)
    expected = white_posterior(a, prior, noise, rest).log_prob + norm.logpdf(z).sum()
    assert abs(expected) > 1e4
    # chi^2 of 1e7, each of whose squares is right to 1e-10 of itself
    assert density_of(e, values) == pytest.approx(expected, rel=1e-8)


def test_beside_what_is_sampled_it_is_marginalised_in_its_place(response_file):
    """Receivers sampled, the gain table in N: the density is that of N about what data tell."""
    receiver = "noise.receiver={power_k: 2000, treatment: sampled}"
    e = lb.build(four_ports(response_file, receiver, TABLE % "marginalised"))
    values = {f"receiver_{port}_k": 2000.0 + 50.0 * port for port in range(4)}
    (table,) = lb.infer(e).moving
    factors = np.asarray(table.systematic.factors(np.asarray(table.centre)))
    a, prior, noise = parts(e.setup)
    t = np.asarray(table.columns)
    rest = np.asarray(e.data.data) - factors * np.asarray(e.setup.offset)
    rest -= t @ (table.expected - np.asarray(table.centre))
    rest -= factors * (columns(response_file, 23)[:, :4] @ [0.0, 0.25, 0.5, 0.75])
    rows, prior = np.concatenate([factors[:, None] * a, t], axis=1), np.append(prior, np.ones(4))
    expected = white_posterior(rows, prior, noise, rest).log_prob
    expected += norm.logpdf([0.0, 0.25, 0.5, 0.75]).sum() - 4 * np.log(200.0)
    assert density_of(e, values) == pytest.approx(expected, rel=1e-7)


# --- refused --------------------------------------------------------------------------------------


BARE, UNNAMED = "noise.gain_table={}", visibilities.Calibration(np.full(23, 1e10))
SLOPES = np.repeat([[0.08], [0.07]], 23, axis=1)
WIDE = visibilities.Calibration(np.full(23, 1e10), ("a", "b"), np.array([1, 1]), SLOPES)


BAD_TABLES = [
    ([BARE], None, r"contain no gain table; give noise\.gain_table\.std"),
    ([BARE], UNNAMED, "give noise.gain_table.std"),
    ([TABLE % "marginalised"], NAMED, "gain table; remove noise.gain_table.std"),
    ([BARE, "flight={gain_std: 0.3}"], None, "flight.gain_std is 0.3, .* give a smaller noise"),
    ([BARE], WIDE, "of port 1 an error of 11%, not at most"),
]


@pytest.mark.parametrize(("overrides", "calibration", "message"), BAD_TABLES)
def test_tables_by_none_or_both_or_hardly_known(response_file, overrides, calibration, message):
    setup = replace(set_up(four_ports(response_file, *overrides)), calibration=calibration)
    for ask in (true_values, full_model):
        refuse(message, ask, setup)


def test_without_a_table_each_port_is_off_as_the_levels_of_flight_files_are(response_file):
    said = set_up(four_ports(response_file, "noise.gain_table={}", "flight={gain_std: 0.03}"))
    slope = GainTable.build(said.scenario.noise.gain_table, said, Around()).slope
    np.testing.assert_array_equal(slope, np.full((4, said.layout.n_times), 0.03))
    own = set_up(four_ports(response_file, TABLE % "marginalised", "flight={gain_std: 0.03}"))
    assert (GainTable.build(own.scenario.noise.gain_table, own, Around()).slope == 0.01).all()
