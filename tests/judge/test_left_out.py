"""Groups of data left out, against A, S and N as matrices."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from experiments import correlated, flagged
from reference_linear import matrices, posterior

import lusee_bayes as lb
from lusee_bayes.experiment.model import full_model
from lusee_bayes.instrument.coupling import DenseCoupling
from lusee_bayes.judge import left_out
from lusee_bayes.judge.left_out import KINDS, LeftOut, groups_of
from lusee_bayes.judge.residuals import held_out
from lusee_bayes.linear.linear_gaussian import FromInformation, form_of

# noise a thousand times larger than the telescope's: what matrices lose to cancellation is then
# below the tolerances
NOISY = "noise.radiometer.factor=1e6"
# few modes: a product has more data than there are modes; many: it has fewer
FEW = ("lmax=3", "observation.runs=[{cycles: 0.04}, {cycles: 0.03, turntable_deg: 40}]")
MANY = ("lmax=10", "observation.runs=[{cycles: 0.03}, {cycles: 0.02, turntable_deg: 40}]")
NOISES = {
    "diagonal": (),
    "blocks": ("noise.radiometer.form=exact",),
    "templates": ("noise.beam={shift_mhz: 4}",),
    "blocks and templates": ("noise.radiometer.form=exact", "noise.beam={shift_mhz: 4}"),
    "coupled": ("noise.gain={sigma: 0.01, visibilities: model}",),
}
WITHIN_TIMES = [kind for kind in NOISES if kind != "coupled"]
TWO = ["diagonal", "blocks and templates"]
SIZES = {"few": FEW, "gaps": FEW, "many": MANY, "dense": MANY}
SIZES |= {"often": (*FEW, "observation.step_s=2400")}


@lru_cache
def observed(size, kind, *more):
    """A model, its data, and K^-1 and the sky's part of K as matrices."""
    scenario = lb.load_scenario("fiducial", [*SIZES[size], NOISY, *NOISES[kind], *more])
    e = lb.build(scenario)
    if size == "gaps":
        # a product but for some times, a time, and single data
        flags = np.zeros((e.data.layout.n_products, e.data.layout.n_times), dtype=bool)
        flags[5, 3:] = flags[:, 7] = flags[2, 11] = flags[9, 0] = True
        e = lb.build(scenario, flagged(e.data, flags))
    model = full_model(e.setup)
    expected = by_matrices(model, e.data)
    if size == "dense":  # without structure in time
        model = replace(model, coupling=DenseCoupling(model.coupling.dense()))
    return model, e.data, *expected


def by_matrices(model, data):
    """K^-1, the sky's part of K, and K^-1 times the data minus their mean."""
    a, s, n = matrices(model)
    inverse = np.linalg.inv(a @ s @ a.T + n)
    mean = 0.0 if model.offset is None else np.asarray(model.offset)
    mean = mean if model.prior.mean is None else mean + a @ np.asarray(model.prior.mean)
    return inverse, a @ s @ a.T, inverse @ (np.asarray(data.data) - mean)


def check(found: LeftOut, data, inverse, sky, u, groups, chosen=None):
    """Against blocks of K^-1, of the data that there are."""
    layout = data.layout
    chosen = np.ones(layout.size, dtype=bool) if chosen is None else chosen
    present = np.zeros((layout.n_products, layout.n_times), dtype=bool)
    present[layout.product[chosen], layout.time[chosen]] = True
    np.testing.assert_array_equal(found.present, present)
    np.testing.assert_allclose(found.u[present], u, rtol=1e-6, atol=1e-7 * np.abs(u).max())
    assert not found.u[~present].any()
    np.testing.assert_allclose(found.inverse_diagonal[present], np.diag(inverse), rtol=1e-6)
    for group in groups:
        inside = group[present]
        block = inverse[np.ix_(inside, inside)]
        missed = found.missed(group)
        assert missed.n == inside.sum()
        chi2 = u[inside] @ np.linalg.solve(block, u[inside])
        assert missed.chi2 == pytest.approx(chi2, rel=1e-6)
        assert missed.log_det == pytest.approx(np.linalg.slogdet(block)[1], rel=1e-7)
        of_sky = (inverse @ sky @ inverse)[np.ix_(inside, inside)]
        # a difference of numbers of data, and of traces with condition numbers of 1e6
        directions = np.trace(np.linalg.solve(block, of_sky))
        assert missed.directions == pytest.approx(directions, rel=1e-5, abs=1e-5)


def every_kind(data):
    """A time, single data, and all products, days and angles that others can predict."""
    groups = [group.data for group in groups_of(data)]
    shape = groups[0].shape
    time = np.broadcast_to(np.arange(shape[1]) == 3, shape)
    single = np.zeros(shape, dtype=bool)
    single[4, 2] = single[4, 9] = single[6, 9] = True
    present = np.asarray(data.layout.present)
    return [group for group in [*groups, time, single] if (present & ~group).any()]


# all groups are small, in rows that are kept; large ones, too; and as in long runs, without rows
LIMITS = [{}, {"QUICK": 0}, {"QUICK": 0, "SHARED": 0}]
MANY_TIMES = {"SHARED": 0, "DAYS": 1}
ESSENTIAL = [pytest.mark.long, pytest.mark.essential]


@pytest.mark.parametrize(
    ("size", "kind", "limits"),
    [
        *(("few", kind, limits) for kind in WITHIN_TIMES for limits in LIMITS),
        *((size, kind, limits) for size in ("many", "gaps") for kind in TWO for limits in LIMITS),
        *(("often", kind, MANY_TIMES) for kind in WITHIN_TIMES),
        *(("dense", kind, {"QUICK": 0}) for kind in TWO),
        *(pytest.param("few", "coupled", limits, marks=ESSENTIAL) for limits in LIMITS),
    ],
)
def test_it_is_what_matrices_say(size, kind, limits, monkeypatch):
    for name, value in limits.items():
        monkeypatch.setattr(left_out, name, value)
    model, data, *expected = observed(size, kind)
    check(LeftOut(model, data), data, *expected, every_kind(data))


def test_what_the_posterior_saves_and_means_over_windows():
    """Which have other functions of time than those of instants."""
    model, data, *expected = observed("many", "diagonal", "observation.window=mean")
    assert data.observation.windows is not None
    check(LeftOut(model, data), data, *expected, every_kind(data))
    model, data, *expected = observed("few", "blocks and templates")
    found = LeftOut(model, data, posterior=model.condition(data.data).posterior)
    check(found, data, *expected, every_kind(data))


@pytest.mark.parametrize("kind", ["diagonal", "blocks", "templates"])
def test_a_prior_that_correlates_modes(kind):
    """And that has a mean: the posterior with structure in time, and what it leaves out."""
    model, data, *_ = observed("few", kind)
    model = replace(model, prior=correlated(model.prior))
    assert form_of(model) is FromInformation
    found = model.condition(data.data).posterior
    inverse, sky, u = by_matrices(model, data)
    a, s, n = matrices(model)
    answer = posterior(a, s, n, (sky + n) @ u)
    off = np.asarray(found.mean - model.prior.mean) - answer.mean
    assert (np.abs(off) / answer.std).max() < 1e-5
    np.testing.assert_allclose(found.std(), answer.std, rtol=1e-6)
    np.testing.assert_allclose(found.log_evidence, answer.log_prob, rtol=1e-7)
    check(LeftOut(model, data, posterior=found), data, inverse, sky, u, every_kind(data))


def test_all_data_have_nothing_to_be_compared_with():
    model, data, *_ = observed("few", "diagonal")
    missed = LeftOut(model, data).missed(np.asarray(data.layout.present))
    assert missed.n == data.layout.size and np.isnan(missed.chi2)


@pytest.mark.parametrize("kind", [*NOISES])
def test_what_is_taken_out_leaves_the_model_of_the_rest(kind):
    """K = A S A^T + N of the others as a matrix; in two steps as in one."""
    model, data, inverse, sky, u = observed("few", kind)
    gone = np.zeros((data.layout.n_products, data.layout.n_times), dtype=bool)
    gone[:, 4] = gone[6, 9] = True
    left = LeftOut(model, data).without(gone)
    gone[2] = True
    left = left.without(gone)
    keep = ~gone[data.layout.product, data.layout.time]
    rest = np.linalg.solve(inverse, u)[keep]
    inverse = np.linalg.inv(np.linalg.inv(inverse)[np.ix_(keep, keep)])
    time = np.broadcast_to(np.arange(data.layout.n_times) == 9, gone.shape)
    groups = [time & ~gone, every_kind(data)[0] & ~gone]
    check(left, data, inverse, sky[np.ix_(keep, keep)], inverse @ rest, groups, keep)


def test_densities_of_groups_are_what_the_covariance_of_the_data_says():
    """ln p(d_s | others) = ln p(d) - ln p(others), each of K = A S A^T + N as a matrix."""
    model, data, inverse, _, u = observed("few", "diagonal")
    k = np.linalg.inv(inverse)
    less = k @ u

    def log_density(chosen):
        block = k[np.ix_(chosen, chosen)]
        value = np.linalg.slogdet(block)[1] + less[chosen] @ np.linalg.solve(block, less[chosen])
        return -0.5 * (value + chosen.sum() * np.log(2.0 * np.pi))

    every = np.ones(len(less), dtype=bool)
    day = data.observation.hours[data.layout.time] // 24
    groups = {
        "product": [data.layout.product == j for j in range(16)],
        "day": [day == j for j in np.unique(day)],
    }
    for found in held_out(model.condition(data.data), data):
        chosen = groups.pop(found.kind)
        expected = sum(log_density(every) - log_density(~inside) for inside in chosen)
        assert (found.groups, found.n) == (len(chosen), len(less))
        # sums of differences of thousands, from blocks with condition numbers of 1e6
        assert found.log_density == pytest.approx(expected, abs=1e-3)
    assert not groups


def test_groups_have_data():
    """Days of 24 hours and turntable angles; none of a product that is missing."""
    _, data, *_ = observed("few", "diagonal")
    found = groups_of(data)
    assert [sum(group.kind == kind for group in found) for kind in KINDS] == [16, 2, 2]
    day = data.observation.hours // 24 == 1
    np.testing.assert_array_equal(found[17].data, np.broadcast_to(day, (16, len(day))))
    fewer = groups_of(flagged(data, found[3].data))
    assert found[3].name not in [group.name for group in fewer]
