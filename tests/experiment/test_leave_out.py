"""Times that do not fit what all others predict are found, and no others."""

from dataclasses import replace

import jax
import numpy as np
import pytest
from assertions import refuse

import lusee_bayes as lb
from lusee_bayes.experiment.leave_out import NOT_JUDGED, TOO_MANY, fitting, without
from lusee_bayes.experiment.model import radiometer, set_up
from lusee_bayes.instrument.visibilities import Calibration
from lusee_bayes.judge.plausibility import SIGNIFICANT, about_information, require_plausible
from lusee_bayes.systematics.above_lmax import AboveLmaxSection
from lusee_bayes.systematics.context import Around, noise_visibilities
from lusee_bayes.testing import assert_refused

FALSE_ALARM = 1e-4


@pytest.fixture(scope="module")
def experiment():
    """A fifth of a lunar day, noise of all products together."""
    changes = ["lmax=6", "observation.runs.0.cycles=0.2", "noise.radiometer.form=exact"]
    return lb.build(lb.load_scenario("fiducial", changes))


def spoilt(experiment, bad, strength, seed=8):
    """Data that are off by so many standard deviations of their noise, where they are bad."""
    data = experiment.data
    off = strength * np.sqrt(np.asarray(radiometer(experiment.setup).diagonal()))
    off = off * np.random.default_rng(seed).standard_normal(off.size)
    return replace(data, data=np.asarray(data.data) + np.where(bad, off, 0.0))


def with_bursts(experiment, times, strength):
    """All products of some times."""
    return spoilt(experiment, np.isin(experiment.data.layout.time, times), strength, seed=5)


def found_in(experiment, data):
    return fitting(experiment.setup, data, FALSE_ALARM)


def test_clean_data_are_left_as_they_are(experiment):
    """65 times, 5 data sets: 0.07 false alarms of times and values are expected, 0.01 others."""
    setup, flagged = experiment.setup, 0
    for seed in range(5):
        noise = np.asarray(radiometer(setup).sample(jax.random.key(seed)))
        data = replace(experiment.data, data=np.asarray(setup.layout.gather(setup.signal)) + noise)
        found = fitting(setup, data, FALSE_ALARM)
        assert found.remark == "" or found.flagged.any()
        flagged += int(found.flagged.any(axis=0).sum())
    assert flagged <= 2


BAD_TIMES = [([7], 1e3), ([20, 21, 22], 6.0), ([0, 30, 64], 6.0)]


@pytest.mark.parametrize(("times", "strength"), BAD_TIMES)
def test_bad_times_are_found(experiment, times, strength):
    data = with_bursts(experiment, times, strength)
    found = found_in(experiment, data)
    assert np.flatnonzero(found.flagged.all(axis=0)).tolist() == times
    assert found.flagged.sum() == 16 * len(times)
    assert f"{len(times)} of 65 times" in found.remark
    # what is left is what clean data without these times are
    setup, kept = without(experiment.setup, data, found.flagged)
    assert kept.layout.size == data.layout.size - 16 * len(times)
    assert setup.layout is setup.instrument.layout
    untouched = np.flatnonzero(~np.isin(data.layout.time, times))
    np.testing.assert_array_equal(kept.data, np.asarray(experiment.data.data)[untouched])


def test_a_single_bad_value_is_found_alone(experiment):
    """Of one product at one time: the other products of the time stay."""
    layout = experiment.data.layout
    data = spoilt(experiment, (layout.product == 9) & (layout.time == 31), 40.0)
    found = found_in(experiment, data)
    assert np.argwhere(found.flagged).tolist() == [[9, 31]]
    assert "data: 1 single value," in found.remark


@pytest.mark.parametrize("every", [pytest.param(1, marks=pytest.mark.long), 3])
def test_noise_that_is_larger_than_said_is_not_the_datas_fault(experiment, every):
    """Of all products, or of many of them."""
    data = spoilt(experiment, experiment.data.layout.product % every == 0, 2.0)
    found = found_in(experiment, data)
    assert not found.flagged.any()
    assert found.remark.startswith(TOO_MANY)


@pytest.mark.parametrize("strength", [2.0, pytest.param(1e3, marks=pytest.mark.long)])
def test_a_bad_product_is_found_alone(experiment, strength):
    """It spoils what is predicted of all times; a time of its own that is bad is found, too."""
    data = spoilt(experiment, experiment.data.layout.product == 6, strength)
    data = with_bursts(replace(experiment, data=data), [40], 30.0)
    found = found_in(experiment, data)
    expected = np.zeros(found.flagged.shape, dtype=bool)
    expected[6] = expected[:, 40] = True
    np.testing.assert_array_equal(found.flagged, expected)
    assert f"data: product {data.labels[6]} and 1 of 65 times," in found.remark


def test_a_bad_day_is_found_alone(experiment):
    """Each of its data is off by too little to be seen by itself, and so is each of its times."""
    bad = np.floor(experiment.data.observation.hours / 24.0) == 3
    assert bad.sum() == 12
    found = found_in(experiment, spoilt(experiment, bad[experiment.data.layout.time], 0.7, seed=9))
    np.testing.assert_array_equal(found.flagged, np.broadcast_to(bad, found.flagged.shape))
    assert "data: day 2027-01-18, " in found.remark


@pytest.mark.parametrize("strength", [2.0, 30.0])
def test_an_auto_never_goes_without_its_crosses(experiment, strength):
    """The noise of 01R depends on 11R, off at every time: a map stays possible."""
    setup, auto = experiment.setup, experiment.data.labels.index("11R")
    data = spoilt(experiment, experiment.data.layout.product == auto, strength)
    found = fitting(setup, data, FALSE_ALARM)
    assert not found.flagged[auto].all()
    assert "11R" in found.remark and "kept" in found.remark
    _, kept = without(setup, data, found.flagged)
    # the level that noise is taken from is off by no more than the data that are kept
    seen, signal = noise_visibilities(setup, Around(kept), "measured")[auto], setup.signal[auto]
    noise = data.layout.scatter(np.sqrt(np.asarray(radiometer(setup).diagonal())))[auto]
    assert (np.abs(seen - signal) < 5.0 * (1.0 + strength) * noise).all()


@pytest.mark.long
def test_all_rules_together_take_a_fifth_at_most(experiment):
    """Two products and a day, each kind within a fifth, which are more together."""
    layout = experiment.data.layout
    day = np.floor(experiment.data.observation.hours / 24.0)[layout.time] == 3
    bad = np.isin(layout.product, [2, 6]) | day
    assert 0.2 < bad.mean() < 0.3
    assert found_in(experiment, spoilt(experiment, bad, 3.0)).flagged.mean() <= 0.2


@pytest.mark.parametrize(("lost", "goes"), [(0.0, True), (0.17, False)])
def test_what_the_reduction_took_counts(experiment, lost, goes):
    times = list(range(3, 60, 9))
    data = with_bursts(experiment, times, 30.0)
    data = replace(data, calibration=Calibration(np.full(65, 1e6 * 7200.0), lost=lost))
    found = found_in(experiment, data)
    assert np.flatnonzero(found.flagged.all(axis=0)).tolist() == (times if goes else [])
    assert found.remark.startswith("Flagged" if goes else TOO_MANY)
    assert found.share == pytest.approx(len(times) / 65.0 if goes else 0.0)


def test_a_sky_that_does_not_end_at_lmax_is_no_reason_to_flag(experiment):
    """Of a sky with structure up to lmax 14, mapped up to 6: only a time with a burst goes."""
    data = with_bursts(lb.build(experiment.scenario.model_copy(update={"lmax": 14})), [20], 1e3)
    whole = experiment.scenario.with_section("noise", above_lmax=AboveLmaxSection())
    found = fitting(set_up(whole, data), data, FALSE_ALARM)
    assert np.flatnonzero(found.flagged.all(axis=0)).tolist() == [20] and found.flagged.sum() == 16
    # without what is above lmax hardly any time fits
    assert fitting(set_up(experiment.scenario, data), data, FALSE_ALARM).remark.startswith(TOO_MANY)


def test_what_cannot_be_judged_is_said(experiment, monkeypatch):
    gone = np.ones((16, 65), dtype=bool)
    assert_refused(lambda: without(experiment.setup, experiment.data, gone))
    monkeypatch.setattr("lusee_bayes.experiment.leave_out.memory_limit", lambda: 1000)
    found = found_in(experiment, experiment.data)
    assert not found.flagged.any() and found.remark == NOT_JUDGED


# --- what cannot be -------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def check(small_experiment):
    """Of data of which some products (and times) are changed."""
    setup, data = small_experiment.setup, small_experiment.data
    noise = lb.radiometer_noise(setup.signal, setup.layout, step_s=7200.0)
    std = np.sqrt(np.asarray(noise.diagonal()))
    sigma = np.asarray(setup.layout.scatter(std))

    def check(change, label=None, time=slice(None)):
        grid = np.array(data.grid())
        where = np.s_[:] if label is None else np.s_[data.labels.index(label), time]
        grid[where] = change(grid[where], sigma[where])
        return require_plausible(replace(data, data=setup.layout.gather(grid)), setup.signal, std)

    return check


IMPOSSIBLE = [
    (-1e5, ("11R", 5), "product 11R at 2027-01-15T10:00:00 is -1e.05 K .1 samples.*negative"),
    (1e30, ("01I", 5), "product 01I .* is 1e.30 K .*more than 1000 times"),
    (-1e30, ("22R", 5), "product 22R .* is -1e.30 K .*more than 1000 times"),
    (lambda x, s: -1.5 * SIGNIFICANT * s, ("11R", 5), "significantly negative"),
    (lambda x, s: 1e-6 * x, (), "1e-06 times those of the modelled sky"),
]


@pytest.mark.parametrize(("change", "where", "message"), IMPOSSIBLE)
def test_values_that_cannot_be(check, change, where, message):
    refuse(message, check, change if callable(change) else lambda *_: change, *where)


def test_what_may_be_is_no_fault_or_a_doubt(check):
    assert check(lambda x, _: x) == ()
    # half of what is refused: standard deviations below zero
    check(lambda x, s: -0.5 * SIGNIFICANT * s, "11R", 5)
    (doubt, *_) = check(lambda x, _: 5.0 * x)
    assert "5 times those of the modelled sky" in doubt
    (doubt,) = check(lambda x, _: 10.0 * x, "13R")
    assert "|V_13|" in doubt and "11, 33 and 13" in doubt
    assert about_information(3.0) == about_information(np.nan) == ()
    assert "the map is the prior" in about_information(1e-9)[0]
