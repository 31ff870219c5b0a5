"""Data against the prediction of all others: by hand, and with something wrong on purpose."""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import chi2

import lusee_bayes as lb
from lusee_bayes.experiment.model import full_model
from lusee_bayes.instrument.layout import DataLayout
from lusee_bayes.linear import residuals as residuals_module
from lusee_bayes.linear.left_out_dense import DenseLeftOut
from lusee_bayes.linear.residuals import residuals
from lusee_bayes.linear.split import WIDER

RUNS = "observation.runs=[{cycles: 0.03}, {cycles: 0.03, turntable_deg: 40}, {cycles: 0.02}]"


def simulated(*overrides, flags=None):
    """Experiment, model and data of a sky drawn from the prior: only that fits it."""
    # noise a thousand times larger than the telescope's: the sky's covariance, on which arithmetic
    # by hand cancels, is then only 1e4 times that of the noise
    given = ["lmax=4", "noise.radiometer.factor=1e6", RUNS, *overrides]
    scenario = lb.load_scenario("fiducial", given)
    e = lb.build(scenario)
    if flags is not None:
        e = lb.build(scenario, flagged(e.data, flags))
    model = full_model(e.setup)
    rng = np.random.default_rng(8)
    sky = np.sqrt(np.asarray(model.prior.variance())) * rng.standard_normal(model.prior.size)
    noise = np.linalg.cholesky(np.asarray(model.noise.dense())) @ rng.standard_normal(model.n_data)
    seen = np.asarray(model.coupling @ jnp.asarray(sky)) + noise
    data = replace(e.data, data=jnp.asarray(seen), layout=e.setup.layout)
    return model, data


def both_sides(x, n):
    return 2 * min(chi2.sf(x, n), chi2.cdf(x, n))


def flagged(data, flags):
    layout = DataLayout.from_flags(flags)
    return replace(data, layout=layout, data=layout.gather(data.layout.scatter(data.data)))


def judged(model, data):
    """The residuals of a model's data."""
    posterior = model.condition(data.data)
    total = model.chi2(posterior.mean, data.data) + posterior.prior_chi2()
    return residuals(model, posterior, data, float(total))


def by_hand(model, data, index, prior):
    """chi^2 of some data given all others, by the textbook's conditional of a Gaussian."""
    k = covariance_of(model, prior)
    d = np.asarray(data.data)
    rest = np.setdiff1d(np.arange(len(d)), index)
    gain = np.linalg.solve(k[np.ix_(rest, rest)], k[np.ix_(rest, index)]).T
    off = d[index] - gain @ d[rest]
    covariance = k[np.ix_(index, index)] - gain @ k[np.ix_(rest, index)]
    return off, covariance, float(off @ np.linalg.solve(covariance, off))


def covariance_of(model, prior):
    a = np.asarray(model.coupling.dense())
    return a @ np.diag(np.asarray(prior.variance())) @ a.T + np.asarray(model.noise.dense())


def degrees_by_hand(model, index, prior):
    """Mean of chi^2 of some data given all others, of noise alone, and of sky a hundredth of it."""
    inverse = np.linalg.inv(covariance_of(model, prior))
    noise = inverse @ np.asarray(model.noise.dense()) @ inverse
    alone = np.trace(np.linalg.solve(inverse[np.ix_(index, index)], noise[np.ix_(index, index)]))
    return alone + (len(index) - alone) / WIDER**2


FLAGS = np.zeros((16, 24), dtype=bool)
FLAGS[3, 5], FLAGS[:, 11] = True, True


@pytest.mark.parametrize(
    "case",
    [
        pytest.param({"overrides": ()}, id="diagonal"),
        pytest.param(
            {"overrides": ("noise.radiometer.form=exact",)},
            id="blocks",
            marks=[pytest.mark.long, pytest.mark.essential],
        ),
        pytest.param(
            {"overrides": ("noise.gain={sigma: 0.01}", "noise.beam={shift_mhz: 4}")},
            id="banded and low rank",
            marks=pytest.mark.long,
        ),
        pytest.param(
            {
                "overrides": ("noise.radiometer.form=exact", "noise.gain={sigma: 0.01}"),
                "flags": FLAGS,
            },
            id="banded with gaps",
            marks=pytest.mark.long,
        ),
    ],
)
def test_groups_and_single_data_by_hand(case):
    model, data = simulated(*case["overrides"], flags=case.get("flags"))
    found = judged(model, data)
    wide, whole = found.split.wide.prior, found.split.instrument
    layout, run = data.layout, data.observation.run
    hours = data.observation.hours
    assert [g.name for g in found.products] == list(data.labels)
    assert [g.name for g in found.angles] == ["0", "40"]
    angle = np.array(data.observation.turntable_deg)[run[layout.time]]
    members = [layout.product == 7, hours[layout.time] // 24 == 1, angle == 40.0]
    for group, member in zip(
        (found.products[7], found.days[1], found.angles[1]), members, strict=True
    ):
        index = np.flatnonzero(member)
        _, _, expected = by_hand(model, data, index, wide)
        assert group.n == len(index)
        assert group.chi2 == pytest.approx(expected, rel=1e-6)
        # 200 random directions tell a trace t to sqrt(2 t / 200), matrices tell it exactly
        degrees = degrees_by_hand(model, index, wide)
        assert group.degrees == pytest.approx(
            degrees, abs=4 * np.sqrt((len(index) - degrees) / 100)
        )
        assert group.p == pytest.approx(both_sides(group.chi2, group.degrees), rel=1e-6)
        assert group.others_p == pytest.approx(
            both_sides(whole.chi2 - group.chi2, whole.degrees - group.degrees), rel=1e-6
        )
    for datum in (0, 33, layout.size - 1):
        off, covariance, _ = by_hand(model, data, np.array([datum]), wide)
        assert found.z[datum] == pytest.approx(off[0] / np.sqrt(covariance[0, 0]), abs=1e-6)
    mean = model.condition(data.data).mean
    predicted = np.asarray(model.predict(mean))
    np.testing.assert_allclose(found.predicted, predicted, rtol=0, atol=1e-6 * predicted.max())
    assert found.fit().level == "consistent" and found.suspects() == []
    assert found.fit().text.startswith("Consistent: instrument and noise fit (p ")


@pytest.mark.parametrize(
    ("width", "said", "not_said"),
    [(10.0, "error bars are too wide; a narrower prior", "what the prior allows"),
     (0.1, "stronger than the prior expects, error bars are too narrow", "narrower prior")],
)  # fmt: skip
def test_a_prior_that_is_too_wide_is_told_from_one_that_is_too_narrow(width, said, not_said):
    """The same data, under a prior ten times as wide as the sky's, and as narrow."""
    model, data = simulated()
    fit = judged(replace(model, prior=model.prior.widened(width)), data).fit()
    assert fit.level == "unlike the prior"
    assert said in fit.text and not_said not in fit.text


def test_one_group_is_everything():
    model, data = simulated("observation.runs=[{cycles: 0.02}]")
    found = judged(model, data)
    (angle,) = found.angles
    whole = found.split.instrument
    assert (angle.chi2, angle.degrees, angle.n) == (whole.chi2, whole.degrees, data.layout.size)
    assert np.isnan(angle.others_p)


def test_precise_data_of_one_day_are_judged_by_product(monkeypatch):
    """A as a matrix: K^-1 of all data, which nothing predicts, has no root in 64 bits."""
    monkeypatch.setattr(
        residuals_module, "leave_out", lambda m, _, d: DenseLeftOut(m, d.data, d.layout)
    )
    model, data = simulated("noise.radiometer.factor=1e-6", "observation.runs=[{cycles: 0.03}]")
    found = judged(model, data)
    assert found.level() == "consistent" and np.isfinite(found.z).all()
    (day,) = found.days
    assert day.n == data.layout.size and np.isnan(day.others_p)
    assert len(found.compared()) == 16


def corrupted(data, where, by):
    grid = data.grid()
    grid[where] += by
    return replace(data, data=data.layout.gather(jnp.asarray(np.nan_to_num(grid))))


@pytest.mark.parametrize(
    ("kind", "name"), [("product", "22R"), ("day", "1"), ("turntable angle", "40")]
)
def test_what_is_wrong_is_pointed_at(kind, name):
    model, data = simulated()
    where = {
        "product": np.arange(16)[:, None] == 12,
        "day": data.observation.hours[None] // 24 == 1,
        "turntable angle": data.observation.run[None] == 1,
    }[kind] & np.ones((16, 24), dtype=bool)
    bad = corrupted(data, where, 40.0 * np.sqrt(float(model.noise.diagonal().mean())))
    found = judged(model, bad)
    assert found.fit().level == "does not fit"
    verdict = found.fit().text
    assert (kind, name) in [(k, group.name) for k, group in found.suspects()]
    assert (
        f"{kind} {name}" in verdict
        and "The others fit without" in verdict
        and "leave it out" in verdict
    )
    # and no other of its kind
    assert len(found.suspects()) == len({k for k, _ in found.suspects()})


@pytest.mark.long
@pytest.mark.essential
def test_what_no_group_explains():
    model, data = simulated()
    rng = np.random.default_rng(1)
    noise = 3.0 * np.sqrt(float(model.noise.diagonal().mean()))
    bad = corrupted(data, slice(None), noise * rng.standard_normal((16, 24)))
    found = judged(model, bad)
    assert found.suspects() == []
    assert "no single one is to blame" in found.fit().text
