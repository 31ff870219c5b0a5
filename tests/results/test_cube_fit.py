"""The joint verdict over channels, against simulations and by hand."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy import stats

import lusee_bayes as lb
from lusee_bayes.experiment.experiment import build
from lusee_bayes.experiment.model import full_model
from lusee_bayes.experiment.scenario import load_scenario
from lusee_bayes.results.cube_fit import ChannelFits

FREQUENCIES = np.linspace(5.0, 50.0, 46)


def fits(chi2, n=5000.0, **more):
    degrees = np.broadcast_to(np.float64(n), (len(chi2),)).copy()
    return ChannelFits(
        FREQUENCIES[: len(chi2)], np.asarray(chi2, dtype=np.float64), degrees, **more
    )


def test_each_joint_test_is_right_where_the_model_holds():
    """p-values of sum and of the channel furthest out are uniform, those of the sign test are of
    a binomial distribution; three tests make at most three false alarms in a hundred."""
    rng = np.random.default_rng(4)
    runs = [fits(rng.chisquare(5000.0, 46)) for _ in range(300)]
    by_test = np.array([[t.p for t in run.tests()] for run in runs])
    assert stats.kstest(by_test[:, 0], "uniform").pvalue > 1e-4
    # the least of 46 uniform ones
    assert stats.kstest(by_test[:, 2], "beta", args=(1, 46)).pvalue > 1e-4
    for q in (0.02, 0.1, 0.5):
        expected = (stats.binom.cdf(np.arange(24), 46, 0.5) * 2 <= q).sum() - 1
        share = min(1.0, 2 * stats.binom.cdf(expected, 46, 0.5)) if expected >= 0 else 0.0
        assert np.mean(by_test[:, 1] <= q) == pytest.approx(share, abs=4 * np.sqrt(q / 300))
    alarms = np.mean([run.fit().level != "consistent" for run in runs])
    assert alarms <= 0.03 + 4 * np.sqrt(0.03 / 300)


def test_a_small_excess_of_most_channels_is_seen():
    """38 of 46 channels a little too large, none by itself: once called a fit of all channels."""
    chi2 = np.full(46, 5000.0 + 60.0)
    chi2[::6] = 4950.0
    run = fits(chi2)
    fit = run.fit()
    above = run.tests()[1]
    assert above.found == "38 of 46"
    assert above.p == pytest.approx(stats.binomtest(38, 46).pvalue, rel=1e-9)
    assert run.extremes() == []
    assert fit.level == "in tension"
    assert "38 of 46" in fit.text


def test_channels_that_stand_out_are_named():
    chi2 = np.random.default_rng(5).chisquare(5000.0, 46)
    chi2[7], chi2[30] = 5000.0 + 1000.0, 5000.0 + 520.0
    run = fits(chi2)
    assert run.extremes() == [7, 30]
    text = run.fit().text
    assert "2 of 46 channels stand out: 12 MHz" in text and "35 MHz" in text
    assert run.fit().level == "does not fit"
    # noise that is given too large is no fit either
    assert fits(0.8 * chi2[:1]).fit().level == "does not fit"


def test_p_values_of_a_joint_run_are_not_too_small():
    """r ~ N(0, M), 0 <= M <= 1: of chi^2 = r^T r with tr M degrees of freedom."""
    rng = np.random.default_rng(6)
    m = np.concatenate([np.ones(200), rng.uniform(0, 1, 300)])
    chi2 = (m * rng.standard_normal((4000, 500)) ** 2).sum(1)
    p = fits(chi2[:0], joint=True)
    p = ChannelFits(np.arange(4000.0), chi2, np.full(4000, m.sum()), joint=True).p()
    for q in (0.01, 0.05, 0.3):
        assert np.mean(p < q) <= q + 4 * np.sqrt(q / 4000)
    # and with the number of data for the mean, on the upper side
    p = ChannelFits(np.arange(4000.0), chi2, np.full(4000, 500.0), joint=True, bound=True).p()
    assert np.mean(p < 0.3) <= 0.3


def test_chi2_of_a_channel_is_that_of_its_data_under_the_model(small_cube):
    """d^T K^-1 d with K = A S A^T + N as a matrix."""
    run = small_cube.result
    for channel, scenario in zip(run.channels, run.scenario.channels(), strict=True):
        experiment = build(scenario)
        model = full_model(experiment.setup)
        a, d = np.asarray(model.coupling.dense()), np.asarray(experiment.data.data)
        k = a @ np.diag(np.asarray(model.prior.variance())) @ a.T + np.asarray(model.noise.dense())
        assert channel.chi2_model == pytest.approx(d @ np.linalg.solve(k, d), rel=1e-4)
    told = json.loads((small_cube.folder / "summary.json").read_text())
    assert told["level"] == run.fit.level and told["verdict"] == run.verdict()
    assert told["tests"][0]["test"] == "sum over all channels"
    for channel, p in zip(told["channels"], run.fits().p(), strict=True):
        assert channel["p"] == pytest.approx(p)


@pytest.mark.long
def test_a_joint_run_is_judged(tmp_path):
    """One posterior: its chi^2 counts, and is not the sum of the channels'."""
    sizes = ["lmax=3", "observation.runs.0.cycles=0.1", "frequencies_mhz=[20, 25, 30]"]
    scenario = load_scenario("fiducial", [*sizes, "joint=true", "spectral.residual=0.1"])
    run = lb.run_map(scenario, tmp_path / "joint").result
    total = run.fits().tests()[0]
    assert total.name == "sum over all channels"
    assert f"chi^2 {run.components.chi2:.0f}" in total.found


def test_sky_and_noise_are_told_apart():
    """m ~ N(0, 1) with five data of noise N(0, 1/4) each: with twice the S, or twice the N."""
    rng = np.random.default_rng(7)
    n, k, channels = 1000, 5, 46
    for factor_s, factor_n, words in ((2.0, 1.0, "it is the sky"), (1.0, 2.0, "noise and beams")):
        chi2, about = [], 0.0
        for _ in range(channels):
            sky = np.sqrt(factor_s) * rng.standard_normal((n, 1))
            d = sky + np.sqrt(factor_n) * 0.5 * rng.standard_normal((n, k))
            mean = d.mean(1) / (1.0 + 0.25 / k)
            residual = float((((d - mean[:, None]) / 0.5) ** 2).sum())
            about += residual
            chi2.append(residual + float((mean**2).sum()))
        # each mode takes 1 - C / S from the number of data
        expected = channels * n * (k - 1.0 / (1.0 + 0.25 / k))
        run = fits(chi2, n=float(n * k), residuals=(about, expected))
        assert run.fit().level == "does not fit" and words in run.fit().text
