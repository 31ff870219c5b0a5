"""The joint verdict over channels, against simulations and by hand."""

import json

import numpy as np
import pytest
from reference_linear import matrices
from scipy import stats

import lusee_bayes as lb
from lusee_bayes.experiment.model import full_model
from lusee_bayes.judge import cube_fit, split
from lusee_bayes.judge.chi2 import FALSE_ALARM, ChiSquare

FREQUENCIES = np.linspace(5.0, 50.0, 46)


def fits(chi2, n=5000.0, prior=(200.0, 200.0), **more):
    channels = tuple(ChiSquare(float(x), n) for x in chi2)
    return cube_fit.ChannelFits(FREQUENCIES[: len(chi2)], channels, ChiSquare(*prior), **more)


def test_each_joint_test_is_right_where_the_model_holds():
    """p-values of sum, of the channel furthest out and of the prior are uniform, those of the sign
    test are of a binomial distribution; all together make a false alarm once in a thousand."""
    rng = np.random.default_rng(4)
    drawn = ((rng.chisquare(5000.0, 46), float(rng.chisquare(200.0))) for _ in range(300))
    runs = [fits(chi2, prior=(prior, 200.0)) for chi2, prior in drawn]
    by_test = np.array([[t.p for t in run.tests()] for run in runs])
    for column in (0, 3):
        assert stats.kstest(by_test[:, column], "uniform").pvalue > 1e-4
    # the least of 46 uniform ones
    assert stats.kstest(by_test[:, 2], "beta", args=(1, 46)).pvalue > 1e-4
    for q in (0.02, 0.1, 0.5):
        expected = (stats.binom.cdf(np.arange(24), 46, 0.5) * 2 <= q).sum() - 1
        share = min(1.0, 2 * stats.binom.cdf(expected, 46, 0.5)) if expected >= 0 else 0.0
        assert np.mean(by_test[:, 1] <= q) == pytest.approx(share, abs=4 * np.sqrt(q / 300))
    alarms = np.mean([run.fit().level != "consistent" for run in runs])
    assert alarms <= FALSE_ALARM + 4 * np.sqrt(FALSE_ALARM / 300)


def test_a_small_excess_of_most_channels_is_seen():
    """38 of 46 channels a little too large, none by itself."""
    chi2 = np.full(46, 5000.0 + 60.0)
    chi2[::6] = 4950.0
    run = fits(chi2)
    above = run.tests()[1]
    assert above.found == "38 of 46"
    assert above.p == pytest.approx(stats.binomtest(38, 46).pvalue, rel=1e-9)
    assert run.extremes() == []
    assert run.fit().level == "does not fit" and "38 of 46" in run.fit().text


def test_channels_that_stand_out_are_named():
    chi2 = np.random.default_rng(5).chisquare(5000.0, 46)
    chi2[7], chi2[30] = 5000.0 + 1000.0, 5000.0 + 520.0
    run = fits(chi2)
    # noise that is given too large is no fit either
    fit, quiet = run.fit(), fits(0.8 * chi2[:1]).fit()
    assert run.extremes() == [7, 30] and fit.level == quiet.level == "does not fit"
    assert "2 of 46 channels flagged: 12 MHz" in fit.text and "35 MHz" in fit.text
    assert "No sky explains" in fit.text and "too large" not in fit.text
    assert "noise.radiometer" in quiet.text and "No sky explains" not in quiet.text
    # one channel that is too loud, whatever the sum
    loud = np.full(46, 4970.0)
    loud[7] = 6000.0
    assert loud.sum() < 46 * 5000.0
    assert "No sky explains" in fits(loud).fit().text


PRIORS = [
    (400.0, False, ["another prior", "400, expected 200 +- 20", "too narrow"], "are fainter"),
    (400.0, True, ["spectral.components"], "another prior"),
    (50.0, False, ["skies are fainter", "error bars are too wide"], "too narrow"),
    (50.0, True, ["smaller spectral.residual"], "another prior"),
]


@pytest.mark.parametrize(("found", "joint", "said", "not_said"), PRIORS)
def test_the_prior_is_judged_apart(found, joint, said, not_said):
    """Only if the instrument fits."""
    chi2 = np.random.default_rng(6).chisquare(5000.0, 46)
    fit = fits(chi2, prior=(found, 200.0), joint=joint).fit()
    assert fit.level == "unlike the prior"
    assert all(words in fit.text for words in said) and not_said not in fit.text
    assert fits(1.2 * chi2, prior=(found, 200.0)).fit().level == "does not fit"


def test_chi2_of_a_channel_is_that_of_its_data_under_the_model(small_cube):
    """d^T K^-1 d with K = A S A^T + N as a matrix."""
    run = small_cube.result
    for channel, scenario in zip(run.channels, run.scenario.channels(), strict=True):
        experiment = lb.build(scenario)
        (a, s, n), d = matrices(full_model(experiment.setup)), np.asarray(experiment.data.data)
        sky = a @ s @ a.T
        assert channel.chi2_model == pytest.approx(d @ np.linalg.solve(sky + n, d), rel=1e-4)
        # what no sky explains, with a prior that is wide by hand
        expected = d @ np.linalg.solve(split.WIDER**2 * sky + n, d)
        assert channel.instrument.chi2 == pytest.approx(expected, abs=0.02 * expected)
    fits = run.fits()
    total, n_data = (sum(getattr(c, k) for c in run.channels) for k in ("chi2_model", "n_data"))
    n = len(fits.channels)
    assert n * fits.prior.chi2 + fits.total.chi2 == pytest.approx(total)
    assert n * fits.prior.degrees + fits.total.degrees == pytest.approx(n_data)
    told = json.loads((small_cube.folder / "summary.json").read_text())
    assert told["level"] == run.fit.level and told["verdict"] == run.verdict()
    first, _, _, last = (test["name"] for test in told["tests"])
    assert (first, last) == ("sum over all channels", "prior, mean over channels")
    for channel, p in zip(told["channels"], fits.p(), strict=True):
        assert channel["instrument"]["p"] == pytest.approx(p)


@pytest.mark.long
def test_a_joint_run_is_judged(tmp_path):
    """One posterior: its chi^2 counts, and is not the sum of the channels'."""
    sizes = ["lmax=3", "observation.runs.0.cycles=0.1", "frequencies_mhz=[20, 25, 30]"]
    scenario = lb.load_scenario("fiducial", [*sizes, "joint=true", "spectral.residual=0.1"])
    run = lb.run_map(scenario, tmp_path / "joint").result
    alone = sum(channel.instrument.chi2 for channel in run.channels)
    assert run.fits().prior.chi2 + alone == pytest.approx(run.joint.chi2)
    # the instrument is judged as in channels of their own
    own = lb.run_map(lb.load_scenario("fiducial", sizes), tmp_path / "own").result
    here, there = ([one.chi2 for one in made.fits().channels] for made in (run, own))
    np.testing.assert_allclose(here, there, rtol=1e-6)
