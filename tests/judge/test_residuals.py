"""Residuals, chi^2 and their tests: by hand, and with something wrong on purpose.

And groups of data that are left out.
"""

from dataclasses import replace
from functools import lru_cache

import jax.numpy as jnp
import numpy as np
import pytest
from experiments import correlated, flagged
from reference_linear import matrices, posterior
from scipy import stats
from scipy.stats import chi2

import lusee_bayes as lb
from lusee_bayes.experiment.model import full_model
from lusee_bayes.instrument.coupling import DenseCoupling
from lusee_bayes.judge import left_out, measures
from lusee_bayes.judge.chi2 import FALSE_ALARM, ChiSquare, stands_out
from lusee_bayes.judge.left_out import KINDS, LeftOut, groups_of, roots
from lusee_bayes.judge.residuals import residuals
from lusee_bayes.judge.split import WIDER, Split, widened
from lusee_bayes.linear.linear_gaussian import FromInformation, InData, InMap, form_of
from lusee_bayes.noise.covariance import DenseCovariance, LowRankCovariance
from lusee_bayes.sky.prior import DensePrior

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
    model, rng = full_model(e.setup), np.random.default_rng(8)
    sky = np.sqrt(np.asarray(model.prior.variance())) * rng.standard_normal(model.prior.size)
    noise = np.linalg.cholesky(np.asarray(model.noise.dense())) @ rng.standard_normal(model.n_data)
    seen = np.asarray(model.coupling @ jnp.asarray(sky)) + noise
    return model, replace(e.data, data=jnp.asarray(seen), layout=e.setup.layout)


def both_sides(x, n):
    return 2 * min(chi2.sf(x, n), chi2.cdf(x, n))


def judged(model, data):
    """The residuals of a model's data."""
    return residuals(model.condition(data.data), data)


def of_kind(found, kind):
    return [group for group in found.groups if group.kind == kind]


def by_hand(model, data, index, prior):
    """chi^2 of some data given all others, by the textbook's conditional of a Gaussian."""
    k, d = covariance_of(model, prior), np.asarray(data.data)
    rest = np.setdiff1d(np.arange(len(d)), index)
    gain = np.linalg.solve(k[np.ix_(rest, rest)], k[np.ix_(rest, index)]).T
    off = d[index] - gain @ d[rest]
    covariance = k[np.ix_(index, index)] - gain @ k[np.ix_(rest, index)]
    return off, covariance, float(off @ np.linalg.solve(covariance, off))


def covariance_of(model, prior):
    a, s, n = matrices(with_prior(model, prior))
    return a @ s @ a.T + n


def degrees_by_hand(model, index, prior):
    """Mean of chi^2 of some data given all others, of noise alone, and of sky a hundredth of it."""
    inverse = np.linalg.inv(covariance_of(model, prior))
    noise = inverse @ np.asarray(model.noise.dense()) @ inverse
    alone = np.trace(np.linalg.solve(inverse[np.ix_(index, index)], noise[np.ix_(index, index)]))
    return alone + (len(index) - alone) / WIDER**2


FLAGS = np.zeros((16, 24), dtype=bool)
FLAGS[3, 5], FLAGS[:, 11] = True, True


EXACT = "noise.radiometer.form=exact"
GAIN, BEAM = "noise.gain={sigma: 0.01}", "noise.beam={shift_mhz: 4}"
LONG, ESSENTIAL = pytest.mark.long, pytest.mark.essential


KINDS_OF_N = [
    pytest.param((), None, id="diagonal"),
    pytest.param((EXACT,), None, id="blocks", marks=ESSENTIAL),
    pytest.param((GAIN, BEAM), None, id="banded and low rank", marks=LONG),
    pytest.param((EXACT, GAIN), FLAGS, id="banded with gaps", marks=LONG),
]


@pytest.mark.parametrize(("overrides", "flags"), KINDS_OF_N)
def test_groups_and_single_data_by_hand(overrides, flags):
    model, data = simulated(*overrides, flags=flags)
    found = judged(model, data)
    wide, whole = found.split.wide.prior, found.split.instrument
    layout, run = data.layout, data.observation.run
    hours = data.observation.hours
    assert [g.name for g in of_kind(found, "product")] == list(data.labels)
    assert [g.name for g in of_kind(found, "turntable angle")] == ["0", "40"]
    angle = np.array(data.observation.turntable_deg)[run[layout.time]]
    members = [layout.product == 7, hours[layout.time] // 24 == 1, angle == 40.0]
    numbers = {"product": 7, "day": 1, "turntable angle": 1}
    groups = [of_kind(found, kind)[number] for kind, number in numbers.items()]
    for group, member in zip(groups, members, strict=True):
        index = np.flatnonzero(member)
        _, _, expected = by_hand(model, data, index, wide)
        assert group.n == len(index)
        assert group.chi2 == pytest.approx(expected, rel=1e-6)
        # condition numbers of 1e8 under the wide prior
        assert group.degrees == pytest.approx(degrees_by_hand(model, index, wide), abs=1e-4)
        assert group.p == pytest.approx(both_sides(group.chi2, group.degrees), rel=1e-6)
        others = whole.chi2 - group.chi2, whole.degrees - group.degrees
        assert group.others_p == pytest.approx(both_sides(*others), rel=1e-6)
    for datum in (0, 33, layout.size - 1):
        off, covariance, _ = by_hand(model, data, np.array([datum]), wide)
        assert found.z[datum] == pytest.approx(off[0] / np.sqrt(covariance[0, 0]), abs=1e-6)
    assert found.fit().level == "consistent" and found.suspects() == []
    assert "consistent" in found.fit().headline and "(p " not in found.fit().headline


PRIORS = [(10.0, "narrower prior", "too narrow"), (0.1, "too narrow", "narrower prior")]


@pytest.mark.parametrize(("width", "said", "not_said"), PRIORS)
def test_a_prior_that_is_too_wide_is_told_from_one_that_is_too_narrow(width, said, not_said):
    """The same data, under a prior ten times as wide as the sky's, and as narrow."""
    model, data = simulated()
    found = judged(replace(model, prior=model.prior.widened(width)), data)
    assert found.fit().level == "unlike the prior"
    assert said in found.fit().text and not_said not in found.fit().text
    # one that was fitted to these data is not too wide
    learned = replace(found, learned=True)
    assert learned.level() == ("consistent" if width > 1.0 else "unlike the prior")


def test_a_quiet_group_is_named_although_the_whole_fits():
    found = judged(*simulated())
    first, *others = found.groups
    quiet = replace(first, chi2=0.1 * first.degrees, p=1e-12)
    text = replace(found, groups=(quiet, *others)).fit().text
    assert "As a whole, the data fit" in text and str(quiet) in text


def test_weights_that_rounding_makes_indefinite_have_no_roots():
    found = roots(np.array([np.eye(2), [[1.0, 2.0], [2.0, 1.0]]]), np.ones((2, 2), dtype=bool))
    np.testing.assert_array_equal(found[0], np.eye(2))
    assert np.isnan(found[1]).all()


def test_one_group_is_everything():
    model, data = simulated("observation.runs=[{cycles: 0.02}]")
    found = judged(model, data)
    (angle,) = of_kind(found, "turntable angle")
    whole = found.split.instrument
    assert (angle.chi2, angle.degrees, angle.n) == (whole.chi2, whole.degrees, data.layout.size)
    assert np.isnan(angle.others_p)


def test_precise_data_of_one_day_are_judged_by_product():
    """A as a matrix: K^-1 of all data, which nothing predicts, has no root in 64 bits."""
    model, data = simulated("noise.radiometer.factor=1e-6", "observation.runs=[{cycles: 0.03}]")
    found = judged(replace(model, coupling=DenseCoupling(model.coupling.dense())), data)
    assert found.level() == "consistent"
    # N(0, 1) or narrower: one of 1e5 data is beyond 5
    assert np.abs(found.z).max() < 5
    (day,) = of_kind(found, "day")
    assert day.n == data.layout.size and np.isnan(day.others_p)
    assert len(found.compared()) == 16


def corrupted(data, where, by):
    grid = data.grid()
    grid[where] += by
    return replace(data, data=data.layout.gather(jnp.asarray(np.nan_to_num(grid))))


WRONG_GROUPS = [("product", "22R"), ("day", "2027-01-16"), ("turntable angle", "40")]


@pytest.mark.parametrize(("kind", "name"), WRONG_GROUPS)
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
    assert (kind, name) in [(group.kind, group.name) for group in found.suspects()]
    for words in (f"{kind} {name}", "The others fit without"):
        assert words in found.fit().text
    assert "are inconsistent: " in (text := found.fit(truncated=True).text)
    assert "without" not in text and "exclud" not in text
    # and no other of its kind
    assert len(found.suspects()) == len({group.kind for group in found.suspects()})


@pytest.mark.essential
def test_what_no_group_explains():
    model, data = simulated()
    rng = np.random.default_rng(1)
    noise = 3.0 * np.sqrt(float(model.noise.diagonal().mean()))
    found = judged(model, corrupted(data, slice(None), noise * rng.standard_normal((16, 24))))
    assert found.suspects() == []
    assert "any one of them is not enough" in found.fit().text
    # noise a hundred times too large, in every group
    quiet = judged(replace(model, noise=model.noise.scaled(1e4)), data).fit()
    assert "The noise is smaller than assumed" in quiet.text and "exclud" not in quiet.text


# --- chi^2 in two parts ---------------------------------------------------------------------------


N_MODES = 25
# the seed is fixed: what is right fails once in 10,000 seeds
RARE = 1e-4


def model_of(n_data=60, prior="harmonic", seed=1):
    """Data that know some directions to 1e-3 of the prior, and others hardly."""
    rng = np.random.default_rng(seed)
    left, _ = np.linalg.qr(rng.standard_normal((n_data, N_MODES if n_data > N_MODES else n_data)))
    right, _ = np.linalg.qr(rng.standard_normal((N_MODES, left.shape[1])))
    a = (left * np.geomspace(1e3, 1e-4, left.shape[1])) @ right.T
    spectrum = jnp.asarray([4.0, 2.0, 1.0, 0.5, 0.3])
    if prior == "harmonic":
        s = lb.HarmonicPrior(spectrum)
    else:
        root = np.tril(0.1 * rng.standard_normal((N_MODES, N_MODES)), -1) + np.eye(N_MODES)
        s = DensePrior(jnp.asarray(root), mean=jnp.asarray(rng.standard_normal(N_MODES)))
    noise = rng.standard_normal((n_data, n_data))
    n = DenseCovariance(jnp.asarray(noise @ noise.T / n_data + np.eye(n_data)))
    return lb.LinearGaussian(jnp.asarray(a), s, n, jnp.asarray(rng.standard_normal(n_data)))


def drawn(model, rng, strength=1.0):
    """Data of a sky whose deviations from the prior mean are so many times the prior's."""
    u, mean = strength * rng.standard_normal(N_MODES), model.prior.white_mean
    sky = model.prior.colour(jnp.asarray(u) if mean is None else u + mean)
    root = np.linalg.cholesky(np.asarray(model.noise.dense()))
    return model.predict(sky) + jnp.asarray(root @ rng.standard_normal(model.n_data))


def split_of(model, data, form=InMap):
    solution = model.condition(data, form=form)
    split = Split.of(solution.posterior, solution.chi2, model.n_data)
    return split, solution.posterior, solution.chi2


def with_prior(model, prior):
    return lb.LinearGaussian(model.coupling, prior, model.noise, model.offset)


@pytest.mark.parametrize("form", [InMap, InData, FromInformation])
@pytest.mark.parametrize("prior", ["harmonic", "dense"])
def test_the_posterior_under_a_wider_prior(form, prior):
    """Against conditioning on the data again."""
    model = model_of(60 if form is not InData else 18, prior)
    data = drawn(model, np.random.default_rng(2))
    solution = model.condition(data, form=form)
    wide, less = widened(solution.posterior, 3.0)
    again = with_prior(model, model.prior.widened(3.0)).condition(data, form=form)
    expected = again.posterior
    std = np.asarray(expected.std())
    assert np.abs((wide.mean - expected.mean) / std).max() < 1e-6
    np.testing.assert_allclose(wide.std(), std, rtol=1e-6)
    assert float(wide.log_evidence) == pytest.approx(float(expected.log_evidence), abs=1e-6)
    assert less == pytest.approx(solution.chi2 - again.chi2, abs=1e-6 * solution.chi2)


@pytest.mark.parametrize("strength", [1.0, 30.0])
def test_the_two_parts_by_matrices(strength):
    model = model_of()
    data = drawn(model, np.random.default_rng(3), strength)
    found, posterior, chi2 = split_of(model, data)
    a, s, n = matrices(model)
    d, k = np.asarray(data - model.offset), a @ s @ a.T + n
    # how strong the sky is: |u|^2 over its mean, tr (1 - C S^-1), at least 1
    known = N_MODES - np.trace(np.asarray(posterior.covariance()) @ np.linalg.inv(s))
    power = max(1.0, float(posterior.prior_chi2()) / known)
    assert (power > 100.0) == (strength > 1.0)
    wide = WIDER**2 * power * (k - n) + n
    assert found.instrument.chi2 == pytest.approx(d @ np.linalg.solve(wide, d), rel=1e-6)
    expected = np.trace(np.linalg.solve(wide, n + power * (k - n)))
    assert found.instrument.degrees == pytest.approx(expected, rel=1e-6)
    assert found.instrument.chi2 + found.prior.chi2 == pytest.approx(chi2)
    assert found.instrument.degrees + found.prior.degrees == pytest.approx(model.n_data)


def p_values(model, strength, n=40, truth=None):
    rng = np.random.default_rng(5)
    parts = [split_of(model, drawn(truth or model, rng, strength))[0] for _ in range(n)]
    return np.array([[one.instrument.p, one.prior.p] for one in parts])


def test_no_sky_makes_the_instrument_look_wrong():
    """The instrument's p is uniform whatever the sky, 100 times the prior's too; the prior's is
    where it holds, but for the transition between known and unknown directions."""
    model = model_of()
    for strength in (0.0, 1.0, 100.0):
        instrument, prior = p_values(model, strength).T
        assert stats.kstest(instrument, "uniform").pvalue > RARE
        if strength == 1.0:
            for q in (0.02, 0.1, 0.3):
                assert np.mean(prior <= q) <= q + 4.0 * np.sqrt(q / len(prior))
        else:
            assert np.median(prior) < 1e-2


def test_noise_that_is_wrong_is_no_matter_of_the_prior():
    """Data with 1.5 times the noise variance."""
    model = model_of(n_data=200)
    noise = DenseCovariance(1.5 * model.noise.dense())
    truth = lb.LinearGaussian(model.coupling, model.prior, noise, model.offset)
    instrument, _ = p_values(model, 1.0, n=10, truth=truth).T
    assert np.median(instrument) < 1e-3


def test_data_that_are_fewer_than_the_modes_leave_little():
    """Every sky explains them: what is left has few degrees of freedom, and no verdict."""
    a = jnp.asarray(100.0 * np.random.default_rng(1).standard_normal((9, N_MODES)))
    prior, noise = lb.HarmonicPrior(jnp.ones(5)), lb.DiagonalCovariance(jnp.ones(9))
    model = lb.LinearGaussian(a, prior, noise)
    found, _, _ = split_of(model, drawn(model, np.random.default_rng(2)), form=InData)
    assert found.instrument.degrees == pytest.approx(0.01 * 9, rel=1e-3)
    assert 0.0 < found.instrument.p <= 1.0


# --- probabilities --------------------------------------------------------------------------------


def test_both_sides_count():
    for q in (1e-8, 1e-3, 0.2):
        for value in (stats.chi2.isf(q, 100), stats.chi2.ppf(q, 100)):
            assert ChiSquare(float(value), 100.0).p == pytest.approx(2 * q, rel=1e-9)
    assert ChiSquare(0.0, 100.0).p == 0.0
    assert 0.999 < ChiSquare(float(stats.chi2.median(100)), 100.0).p <= 1.0


def test_one_rate_for_all_tests_of_a_report():
    assert not stands_out(FALSE_ALARM, 1) and stands_out(FALSE_ALARM * (1.0 - 1e-9), 1)
    # the best of many is nothing special
    assert not stands_out(1e-4, 10) and stands_out(1e-4, 9)


def test_what_was_found_is_told_with_what_was_expected():
    part = ChiSquare(130.0, 98.0)
    assert part.p == pytest.approx(2 * stats.chi2.sf(130.0, 98.0))
    assert part.words() == f"p = {part.p:.2g}, chi2 130, expected 98 +- 14"
    assert ChiSquare(1e9, 98.0).words().startswith("p < 1e-300, chi2 1000000000")


# --- score tests of templates ---------------------------------------------------------------------


N_DATA, LMAX, N = 60, 4, 5


@pytest.mark.parametrize("low_rank", [False, True])
def test_amplitudes_errors_and_gains(low_rank):
    rng = np.random.default_rng(8)
    a = rng.standard_normal((N_DATA, (LMAX + 1) ** 2))
    noise = lb.DiagonalCovariance(rng.uniform(0.5, 2.0, N_DATA))
    if low_rank:
        noise = noise + LowRankCovariance(rng.standard_normal((N_DATA, 2)))
    prior = lb.HarmonicPrior(np.full(LMAX + 1, 4.0), mean=rng.standard_normal((LMAX + 1) ** 2))
    model = lb.LinearGaussian(DenseCoupling(a), prior, noise, rng.standard_normal(N_DATA))
    data = 3.0 * rng.standard_normal(N_DATA)
    # the last one is a sky that the prior allows, but for a small part
    templates = rng.standard_normal((N_DATA, N))
    templates[:, -1] = a @ rng.standard_normal(a.shape[1]) + 0.01 * templates[:, -1]
    got = measures.preferences(model.condition(data), templates)
    k = a @ np.diag(np.asarray(prior.variance())) @ a.T + np.asarray(noise.dense())
    mean = np.asarray(model.predict(prior.colour(prior.white_mean)))
    inverse = np.linalg.inv(k)
    information = np.einsum("da,de,ea->a", templates, inverse, templates)
    pull = templates.T @ inverse @ (data - mean)
    np.testing.assert_allclose(got["std"], information**-0.5, rtol=1e-9)
    np.testing.assert_allclose(got["value"], pull / information, rtol=1e-8)
    # chi^2 of the data without the best amount of each template
    for number in range(N):
        left = data - mean - got["value"][number] * templates[:, number]
        gain = (data - mean) @ inverse @ (data - mean) - left @ inverse @ left
        assert got["chi2_gain"][number] == pytest.approx(gain, rel=1e-7)


def test_what_the_sky_takes_up_is_not_told():
    """A template that the prior's wide sky explains altogether: NaN, not a rounding error."""
    rng = np.random.default_rng(9)
    a = rng.standard_normal((N_DATA, (LMAX + 1) ** 2))
    prior = lb.HarmonicPrior(np.full(LMAX + 1, 1e14))
    model = lb.LinearGaussian(DenseCoupling(a), prior, lb.DiagonalCovariance(np.ones(N_DATA)))
    data = rng.standard_normal(N_DATA)
    got = measures.preferences(model.condition(data), a @ rng.standard_normal((a.shape[1], 1)))
    assert np.isnan([got["value"], got["std"]]).all()


# --- groups of data left out, against A, S and N as matrices --------------------------------------

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
TWO, ALONE = ("diagonal", "blocks and templates"), ("blocks", "templates")
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
    of_sky = inverse @ sky @ inverse
    np.testing.assert_allclose(found.inverse_diagonal[present], np.diag(inverse), rtol=1e-6)
    for group in groups:
        inside = group[present]
        block, missed = inverse[np.ix_(inside, inside)], found.missed(group)
        assert missed.n == inside.sum()
        assert missed.chi2 == pytest.approx(u[inside] @ np.linalg.solve(block, u[inside]), rel=1e-6)
        # a difference of numbers of data, and of traces with condition numbers of 1e6
        directions = np.trace(np.linalg.solve(block, of_sky[np.ix_(inside, inside)]))
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


SETTINGS = [
    *((size, kind, limits) for size in ("few", "gaps") for kind in TWO for limits in LIMITS),
    *(("many", kind, limits) for kind in TWO for limits in LIMITS[:2]),
    *(pytest.param("many", kind, LIMITS[2], marks=LONG) for kind in TWO),
    *(("often", kind, MANY_TIMES) for kind in TWO),
    # what is in "blocks and templates" alone
    *(pytest.param("few", kind, limits, marks=LONG) for kind in ALONE for limits in LIMITS),
    *(pytest.param("often", kind, MANY_TIMES, marks=LONG) for kind in ALONE),
    *(("dense", kind, {"QUICK": 0}) for kind in TWO),
    *(pytest.param("few", "coupled", limits, marks=ESSENTIAL) for limits in LIMITS),
]


@pytest.mark.parametrize(("size", "kind", "limits"), SETTINGS)
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
    left, keep = left.without(gone), ~gone[data.layout.product, data.layout.time]
    rest = np.linalg.solve(inverse, u)[keep]
    inverse = np.linalg.inv(np.linalg.inv(inverse)[np.ix_(keep, keep)])
    time = np.broadcast_to(np.arange(data.layout.n_times) == 9, gone.shape)
    groups = [time & ~gone, every_kind(data)[0] & ~gone]
    check(left, data, inverse, sky[np.ix_(keep, keep)], inverse @ rest, groups, keep)


def test_groups_have_data():
    """Days of 24 hours and turntable angles; none of a product that is missing."""
    _, data, *_ = observed("few", "diagonal")
    found = groups_of(data)
    assert [sum(group.kind == kind for group in found) for kind in KINDS] == [16, 2, 2]
    day = data.observation.hours // 24 == 1
    np.testing.assert_array_equal(found[17].data, np.broadcast_to(day, (16, len(day))))
    assert found[3].name not in [group.name for group in groups_of(flagged(data, found[3].data))]


@pytest.mark.parametrize(("factor", "blamed"), [(0.999, True), (1e6, False)])
def test_what_rounding_hides_is_not_blamed(factor, blamed, monkeypatch):
    """chi^2 of a group exceeds that of all data only by rounding: the others would seem to fit."""
    model, data = simulated()
    data = replace(data, data=100.0 * np.asarray(data.data))
    whole = judged(model, data).split.instrument.chi2

    def each(self, groups):
        return [left_out.Missed(n := int(np.sum(g)), factor * whole, float(n)) for g in groups]

    monkeypatch.setattr(LeftOut, "each", each)
    found = judged(model, data)
    assert found.level() == "does not fit"
    assert bool(found.compared()) == blamed
    assert ("not tested" in found.fit().details) != blamed
