"""What an observation would tell: against dense textbook algebra and against simulated data."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from assertions import refuse
from commands import assert_drawn, run, table_of
from experiments import flagged
from reference_linear import matrices

import lusee_bayes as lb
from lusee_bayes.core import engine, harmonics, progress
from lusee_bayes.experiment.model import full_model, set_up
from lusee_bayes.instrument.products import all_products
from lusee_bayes.judge.measures import ell_cross
from lusee_bayes.linear.linear_gaussian import InMap
from lusee_bayes.results.forecast import Variation, forecast_rows
from lusee_bayes.runs import plan_run

# many shapes, each of which is compiled
pytestmark = pytest.mark.long
SMALL = ["lmax=6", "observation.runs.0.cycles=0.3", "noise.radiometer.factor=100"]
N_SETS = 200


def varied(*overrides, lost=()):
    scenario = lb.load_scenario("fiducial", [*SMALL, *overrides])
    return Variation("small", "test", "test", scenario, lost)


def turned(*angles, factor=100):
    """The same time at each of these angles, 0.3 cycles in all; ``factor`` of the noise."""
    runs = ", ".join(f"{{cycles: {0.3 / len(angles)}, turntable_deg: {a}}}" for a in angles)
    return varied(f"observation.runs=[{runs}]", f"noise.radiometer.factor={factor}")


def bits(*overrides, lost=()):
    return plan_run.forecast(varied(*overrides, lost=lost)).information_bits


def simulated(variation):
    """The model of a variation, a posterior, and 200 skies with the means of their maps."""
    model = full_model(set_up(variation.scenario))
    solver, skies = model.factorise(), model.prior.sample(jax.random.key(3), N_SETS)
    signals = skies @ model.coupling.dense().T
    noise = map(model.noise.sample, jax.random.split(jax.random.key(4), N_SETS))
    posteriors = [solver.condition(s + n).posterior for s, n in zip(signals, noise, strict=True)]
    means = np.stack([np.asarray(p.mean) for p in posteriors])
    return model, posteriors[0], np.asarray(skies), means


@pytest.mark.parametrize("angles", [(0,), (0, 30), (0, 30, 60)], ids=str)
def test_information_is_the_mean_log_ratio_of_posterior_to_prior_density(angles):
    """ln p(m | d) - ln p(m) at the true sky, with NumPy alone, over 200 data sets."""
    predicted = plan_run.forecast(turned(*angles))
    model, posterior, skies, means = simulated(turned(*angles))
    prior = np.asarray(model.prior.variance())
    root = np.sqrt(prior)
    # in units of the prior; the 2 pi cancel
    c = np.asarray(posterior.covariance()) / np.outer(root, root)
    shift = (skies - means) / root
    chi2 = np.einsum("si,ij,sj->s", shift, np.linalg.inv(c), shift)
    log_ratio = 0.5 * ((skies**2 / prior).sum(1) - chi2 - np.linalg.slogdet(c)[1])
    nats = predicted.information_bits * np.log(2.0)
    # 4 standard errors, from the scatter of the 200
    error = log_ratio.std(ddof=1) / np.sqrt(N_SETS)
    assert abs(log_ratio.mean() - nats) < 4 * error
    # which is a sharp test: the scatter is of order sqrt(modes), a per cent of the information
    assert error < 0.01 * nats


def test_expected_snr_is_that_of_simulated_maps():
    """sum_m mean^2 and sum_m (mean - m)^2, averaged over the 200, and the ell where they cross."""
    faint = turned(0, 30, factor=1e7)  # SNR^2 from 120 to 0.2
    predicted = plan_run.forecast(faint)
    model, _, skies, means = simulated(faint)
    power, error = harmonics.sum_over_m(means**2), harmonics.sum_over_m((means - skies) ** 2)
    prior = harmonics.sum_over_m(np.asarray(model.prior.variance()))
    left = prior / (1.0 + predicted.snr_squared)
    for values, expected in ((power, prior - left), (error, left)):
        tolerance = 4.5 * values.std(axis=0, ddof=1) / np.sqrt(N_SETS)
        assert (np.abs(values.mean(axis=0) - expected) < tolerance).all()
    # SNR^2 is 2.0 before and 0.4 after it: 200 sets decide without doubt
    assert predicted.ell_cross == 5
    assert predicted.ell_cross == ell_cross(np.sqrt(power.mean(0) / error.mean(0)))


def textbook(variation, keep=None):
    """(A, S, N) as matrices with the rows ``keep``."""
    a, s, n = matrices(full_model(set_up(variation.scenario)))
    keep = slice(None) if keep is None else keep
    return a[keep], s, n[keep][:, keep]


def assert_forecast_is(found, a, s, n):
    """Against the data-space evidence ratio and the generalised eigenvalues of (S, C)."""
    w = np.linalg.solve(np.linalg.cholesky(n), a) * np.sqrt(np.diag(s))
    nats = 0.5 * np.linalg.slogdet(np.eye(len(w)) + w @ w.T)[1]
    # w w^T squares the signal-to-noise ratio, 1e5: eps x 1e10 x 100 directions
    assert found.information_bits == pytest.approx(nats / np.log(2.0), abs=1e-3)
    c = np.linalg.inv(w.T @ w + np.eye(w.shape[1])) * np.sqrt(np.outer(np.diag(s), np.diag(s)))
    # (S - C) x = lambda C x
    ratios = scipy.linalg.eigh(s - c, s, eigvals_only=True)
    assert found.modes == (ratios / (1.0 - ratios) > 1.0).sum()
    known, left = (harmonics.sum_over_m(np.diag(x)) for x in (s - c, c))
    np.testing.assert_allclose(found.snr_squared, known / left, rtol=1e-5)


FEWER = [(0.01, "noise.beam={shift_mhz: 4.0}"), (0.3, "noise.gain={sigma: 0.01}")]


@pytest.mark.parametrize(("cycles", "systematic"), FEWER, ids=["fewer data than modes", "more"])
def test_numbers_of_an_experiment_against_dense_algebra(cycles, systematic):
    variation = varied(f"observation.runs.0.cycles={cycles}", systematic)
    found = plan_run.forecast(variation)
    assert 0 < found.modes < 49  # neither none nor all
    assert found.n_data == 16 * int(cycles * 27.321661 * 12)
    assert_forecast_is(found, *textbook(variation))


def test_a_lost_antenna_is_flags():
    variation, dead = varied(), [p.i == 2 or p.j == 2 for p in all_products()]
    experiment = lb.build(variation.scenario)
    flags = np.repeat(np.array(dead)[:, None], experiment.setup.observation.n_times, axis=1)
    found = plan_run.forecast(replace(variation, lost=(2,)))
    assert found.n_data == 9 * experiment.setup.observation.n_times
    assert_forecast_is(found, *textbook(variation, ~flags.ravel()))
    # and the same model as that of data with these flags
    expected = full_model(set_up(variation.scenario, flagged(experiment.data, flags)))
    got = full_model(plan_run.without_ports(experiment.setup, [2]))
    np.testing.assert_array_equal(got.coupling.dense(), expected.coupling.dense())
    np.testing.assert_array_equal(got.noise.diagonal(), expected.noise.diagonal())
    # so is what the sky above lmax adds
    seen = lb.build(varied("noise.above_lmax={margin: 2, least_lmax: 0}").scenario).setup
    kept = plan_run.without_ports(seen, [2]).above.coupling
    np.testing.assert_array_equal(kept.dense(), seen.above.coupling.dense()[~flags.ravel()])


def test_an_ell_that_is_not_seen_and_one_without_power():
    """Expected SNR^2 of 0 and NaN; neither is clipped."""
    a, prior = jnp.eye(9)[:4], lb.HarmonicPrior(jnp.asarray([0.0, 3.0, 2.0]))
    model = lb.LinearGaussian(a, prior, lb.DiagonalCovariance(jnp.ones(4)))
    found = plan_run.expected_snr_squared(model.factorise(InMap).condition(jnp.zeros(4)).posterior)
    assert np.isnan(found[0])
    np.testing.assert_allclose(found[1:], [3.0, 0.0], atol=1e-15)


def test_a_duty_cycle_is_worth_the_noise_it_makes():
    """Half the integration time is twice the variance, and never more than half a bit per mode."""
    half, whole = bits("noise.radiometer.duty_cycle=0.5"), bits()
    assert half == pytest.approx(bits("noise.radiometer.factor=200"), rel=1e-12)
    assert 0 < whole - half < 0.5 * 49


def test_default_variations_compare_like_with_like():
    scenario = lb.load_scenario("two_cycles")
    found = plan_run.default_variations("two_cycles", scenario)
    assert found[0].scenario == scenario
    families = {v.family: [w for w in found if w.family == v.family] for v in found}

    def times(family):
        return [sum(r.cycles for r in v.scenario.observation.runs) for v in families[family]]

    assert times("turned, same time") == pytest.approx([2.0] * 3)
    assert times("turned, more time") == [4.0, 6.0]
    for family, number, cycles in (("turned, same time", 1, 0.5), ("turned, more time", 0, 1.0)):
        runs = families[family][number].scenario.observation.runs
        angles = [(r.cycles, r.turntable_deg) for r in runs]
        assert angles == [(cycles, 0), (cycles, 30), (cycles, 30), (cycles, 60)]
    assert times("duration") == [0.25, 0.5, 1.0, 2.0, 3.0]
    assert all(r.night_only for v in families["nights only"] for r in v.scenario.observation.runs)
    duty = [v.scenario.noise.radiometer.duty_cycle for v in families["duty cycle"]]
    assert duty == [0.25, 0.5, 1.0]
    assert [v.lost for v in families["antenna lost"]] == [(0,), (1,), (2,), (3,)]


def test_what_is_there_twice_is_computed_once(monkeypatch, tmp_path):
    computed, whole = [], varied()
    first = plan_run.forecast(whole)
    monkeypatch.setattr(
        "lusee_bayes.runs.plan_run.forecast",
        lambda variation: computed.append(variation) or replace(first, variation=variation),
    )
    again, broken = replace(whole, name="again"), replace(whole, lost=(1,))
    given = [whole, again, broken], tmp_path, engine.ThisProcess(), progress.Stages()
    made = plan_run.forecasts_of(*given)
    rows = forecast_rows(made)
    assert computed == [whole, broken]
    # and what was computed is taken from its file the next time
    assert forecast_rows(plan_run.forecasts_of(*given)) == rows and len(computed) == 2
    np.testing.assert_array_equal(plan_run.forecasts_of(*given)[0].snr_squared, made[0].snr_squared)
    assert [row["variation"] for row in rows] == ["test", "again", "test"]
    assert rows[1]["difference_bits"] == "0.00"


def test_what_will_be_known_of_clock_and_turntable():
    """Against K = A S A^T + N as a matrix, and the derivative to an angle that is given."""
    offsets = "noise.pointing={turntable_deg: 1.0, clock_s: 60}"
    found = plan_run.forecast(varied(offsets)).offsets
    assert list(found) == ["clock_s", "turntable_deg"]
    # the sky may as well have turned
    assert found["clock_s"] == pytest.approx(60.0, rel=0.02)
    setup = set_up(varied(offsets).scenario)
    a, s, n = matrices(full_model(setup))
    # a step so small that its square, (lmax x step)^2 / 6, is nothing to these data
    up, down = (
        set_up(varied(f"observation.runs.0.turntable_deg={x}").scenario).coupling @ setup.sky.modes
        for x in (0.01, -0.01)
    )
    k, t = a @ s @ a.T + n, (up - down) / 0.02
    expected = np.sqrt(1.0 - t @ np.linalg.solve(k, t))
    assert found["turntable_deg"] == pytest.approx(expected, rel=1e-4)
    rows = forecast_rows([plan_run.forecast(varied(offsets)), plan_run.forecast(varied())])
    assert "turntable_deg +- " in rows[0]["clock_and_pointing"]
    assert rows[1]["clock_and_pointing"] == ""


def test_ports_that_do_not_exist_and_none_left():
    refuse("port 4.*0 to 3", plan_run.forecast, varied(lost=(4,)))
    refuse("small, test.*all .*samples.*flagged", plan_run.forecast, varied(lost=(0, 1, 2, 3)))


# the sky above lmax ends soon
TOP = "noise.above_lmax={margin: 2, least_lmax: 0}"
TINY = ["--set", "lmax=6", "--set", "observation.runs.0.cycles=0.05", "--set", TOP]


def test_the_command_writes_table_and_figure(tmp_path, capsys, monkeypatch):
    # a few variations are enough; the Sun is up all the time
    monkeypatch.setattr(plan_run, "CYCLES", (0.05,))
    monkeypatch.setattr(plan_run, "PARTS", (1,))
    tiny = [*TINY, "--set", "observation.start=2027-02-03"]
    assert run("plan", "fiducial", "noise_x100", *tiny, "-o", tmp_path) == 0
    assert {p.name for p in tmp_path.iterdir()} == {"plan.csv", "figures", "manifest.json"}
    assert_drawn(tmp_path / "figures" / "plan.png")
    rows = table_of(tmp_path / "plan.csv")
    names = [row["variation"] for row in rows if row["scenario"] == "fiducial"]
    ports = [f"port {port}" for port in range(4)]
    assert names == ["as given", "0°", "0.05 cycles", "0.25", "0.5", "1", *ports]
    assert [row["variation"] for row in rows if row["scenario"] == "noise_x100"] == names
    measured = lb.load_scenario("fiducial", tiny[1::2]).of_measured()
    expected = plan_run.forecast(Variation("", "", "", measured))
    first = rows[0]
    # two decimals
    assert float(first["information_bits"]) == pytest.approx(expected.information_bits, abs=0.0051)
    assert int(first["modes_snr_above_1"]) == expected.modes
    more = float(rows[4]["information_bits"]) - expected.information_bits
    assert float(rows[4]["difference_bits"]) == pytest.approx(more, abs=0.0101)
    out = capsys.readouterr().out
    assert "left out: fiducial, nights only, 0.05 cycles: run 0 contains no lunar night" in out
    assert "noise_x100: " in out
    assert out.strip().splitlines()[-1] == f"look at {tmp_path}/figures/plan.png"


def test_values_of_ones_own(tmp_path, capsys):
    arguments = ["plan", "fiducial", *TINY, "--vary", "noise.radiometer.duty_cycle=0.5,1", "-q"]
    assert run(*arguments, "--vary", "observation.start=2027-01-15,2027-01-22", "-o", tmp_path) == 0
    rows = table_of(tmp_path / "plan.csv")
    names = ["as given", "0.5", "1", "2027-01-15", "2027-01-22"]
    assert [row["variation"] for row in rows] == names
    found = [float(row["information_bits"]) for row in rows]
    assert found[1] < found[0] == found[2] == found[3]
    assert found[4] != found[0]
    assert capsys.readouterr().out == ""


def test_brackets_are_values_not_markup(tmp_path, capsys):
    """A list of runs is a value as any other, and printed as it is."""
    runs = "observation.runs=[{cycles: 0.03}, {cycles: 0.02, turntable_deg: 30}]"
    vary = ["--vary", runs, "--vary", "noise.gain=null"]
    assert run("plan", "fiducial", *TINY, *vary, "-o", tmp_path) == 0
    name = "[{'cycles': 0.03}, {'cycles': 0.02, 'turntable_deg': 30}]"
    names = [row["variation"] for row in table_of(tmp_path / "plan.csv")]
    assert names == ["as given", name, "None"]
    assert name in capsys.readouterr().out
