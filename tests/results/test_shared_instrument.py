"""What channels share of the instrument, and smooth receivers, as one Gaussian."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from assertions import assert_same_map, within
from reference_linear import Answer, random_covariance, white_posterior
from scipy.linalg import block_diag
from scipy.stats import chi2, multivariate_normal

import lusee_bayes as lb
from lusee_bayes.core.harmonics import lmax_of, modes_to_map, pixel_matrix
from lusee_bayes.experiment.model import radiometer
from lusee_bayes.experiment.unknowns import ALL_TOGETHER
from lusee_bayes.judge.cube_fit import disagreement, shared_tests
from lusee_bayes.linear.amplitudes import AlikeErrors, tie
from lusee_bayes.report.figures.judgement import corner
from lusee_bayes.results.sky_spectrum import UNOBSERVED, sky_regions
from lusee_bayes.runs import channels
from lusee_bayes.runs.channels import Share, from_fitting, kernel, map_channels, tie_channels
from lusee_bayes.sky.galaxy import kelvin_steradian

FREQUENCIES, OCTAVES = np.array([15.0, 20.0, 22.0]), 0.4
RUNS = "observation.runs=[{cycles: 1}, {cycles: 1, turntable_deg: 30}]"
OFFSETS = "noise.pointing={turntable_deg: 0.3}"
SMALL = (
    *("frequencies_mhz=[15, 20, 22]", "lmax=5", "observation.step_s=43200.0", RUNS, OFFSETS),
    "noise.beam={parameters: {zenith_angle_deg: 1.0, surface_permittivity: 0.2}}",
    f"noise.receiver={{power_k: 20000, slope: -2, relative_std: 0.5, smooth_octaves: {OCTAVES}}}",
    *("noise.radiometer.factor=1e6", "output.draws=5", "prior={model: isotropic, spectrum: sky}"),
    *("sky.sources=false", "sources={list: [{name: Cas A}, {name: Vir A, block_h: 500}]}"),
)
N_MODES, SAME = 36, ["zenith_angle_deg", "surface_permittivity"]
ANGLES = ["turntable_0_deg", "turntable_1_deg"]
# unknowns of a channel's own: Cas A, Vir A in three blocks, and four receivers
FLUXES, OWN = 4, 8
RECEIVERS = FLUXES + np.arange(4)
# of three values that all channels share, and of four smooth ones
ALL = np.ones((3, 3))
SMOOTH = np.exp(-(np.log2(FREQUENCIES[:, None] / FREQUENCIES) ** 2) / (2.0 * OCTAVES**2))


@pytest.mark.parametrize("volume", [0.0, 3.0])
def test_ties_are_those_of_one_gaussian_of_all_amplitudes(volume):
    """Data y = z + noise of each channel, and the volume of its skies exp(e^T z)."""
    rng = np.random.default_rng(4)
    noise = np.stack([0.1 * random_covariance(rng, 3) for _ in range(3)])
    y, e = rng.normal(size=(3, 3)), volume * rng.normal(size=(3, 3))
    covariance = np.linalg.inv(np.linalg.inv(noise) + np.eye(3))
    mean = np.einsum("kij,kj->ki", covariance, np.linalg.solve(noise, y[..., None])[..., 0] + e)
    kernels = np.stack([ALL, SMOOTH, ALL])
    got = tie(mean, covariance, kernels, np.eye(9))
    every = sum(np.kron(one, np.diag(np.eye(3)[i])) for i, one in enumerate(kernels))
    before, known = every @ e.ravel(), every + block_diag(*noise)
    gain = np.linalg.solve(known, every).T
    after = every - gain @ every
    within(got.mean.ravel(), before + gain @ (y.ravel() - before), 1e-12)
    within(got.covariance, np.stack([after[k : k + 3, k : k + 3] for k in (0, 3, 6)]), 1e-12)
    draws = (got.draws - got.mean).reshape(9, 9)
    within(draws.T @ draws, after, 1e-12)
    # one white number for each shared value
    assert np.count_nonzero(np.abs(draws).sum(1)) == 5
    log_normal = multivariate_normal.logpdf
    expected = log_normal(y.ravel(), before, known) + e.ravel() @ before / 2.0
    for own_y, own_e, own in zip(y, e, noise, strict=True):
        expected -= log_normal(own_y, own_e, np.eye(3) + own) + own_e @ own_e / 2.0
    assert got.log_evidence == pytest.approx(expected, abs=1e-10)


@pytest.mark.parametrize("rho", [0.0, 0.7, 1.0])
def test_errors_that_channels_have_in_common_are_not_averaged_away(rho):
    """The covariance is that of the estimate's errors; with one sky, three channels tell as one."""
    rng, n, one = np.random.default_rng(2), 2, np.eye(2)
    a, t = rng.normal(size=(20, 5)), rng.normal(size=(20, n))
    k = a @ a.T + 0.1 * np.eye(20)
    told, slopes = t.T @ np.linalg.solve(k, t), t.T @ np.linalg.solve(k, a)
    v = np.linalg.inv(told + one)
    alike = AlikeErrors(np.stack([slopes] * 3), np.full((3, 3), rho) + (1.0 - rho) * np.eye(3))
    given = np.stack([v] * 3), np.ones((n, 3, 3)), np.eye(3 * n)
    each = np.eye(3 * n).reshape(3 * n, 3, n)
    weights = np.stack([tie(mean, *given, alike).mean[0] for mean in each], axis=1)
    scores = np.kron(np.eye(3), told) + np.kron(alike.correlation - np.eye(3), slopes @ slopes.T)
    of_z = weights @ np.tile(v @ told, (3, 1)) - one
    weights = weights @ np.kron(np.eye(3), v)
    got = tie(each[0], *given, alike).covariance[0]
    within(got, of_z @ of_z.T + weights @ scores @ weights.T, 1e-9)
    if rho == 1.0:
        noisy = 0.1 * (np.linalg.solve(k, t).T @ np.linalg.solve(k, t)) / 3.0
        known = told @ np.linalg.solve(slopes @ slopes.T + noisy, told)
        within(got, np.linalg.inv(known + one), 1e-9)
    if rho == 0.0:
        within(got, np.linalg.inv(3.0 * told + one), 1e-9)


@pytest.mark.parametrize("wrong", [[], [1], [0, 4]])
def test_channels_that_disagree_are_those_that_are_wrong(wrong):
    """chi^2 against matrices: y of a channel given y of all others that agree."""
    rng, mhz = np.random.default_rng(8), np.array([15.0, 20.0, 22.0, 26.0, 30.0, 31.0])
    far = np.log2(mhz[:, None] / mhz)
    kernels = np.stack([np.ones((6, 6)), np.exp(-0.5 * (far / OCTAVES) ** 2), np.ones((6, 6))])
    noise = np.stack([0.01 * random_covariance(rng, 3) for _ in mhz])
    noise[2] += np.diag([0.0, 0.0, 1e7])  # knows nothing of the third
    every = sum(np.kron(one, np.diag(np.eye(3)[i])) for i, one in enumerate(kernels))
    known = every + block_diag(*noise)
    y = multivariate_normal(np.zeros(18), known, seed=4).rvs().reshape(6, 3)
    y[wrong, 0] += 4.0
    covariance = np.linalg.inv(np.linalg.inv(noise) + np.eye(3))
    mean = np.einsum("kij,kj->ki", covariance, np.linalg.solve(noise, y[..., None])[..., 0])
    tests = shared_tests(mean, covariance, kernels, ("a", "b", "c"), mhz.tolist())
    assert [k for k, one in enumerate(tests) if one.disagrees] == wrong
    for k in set(range(6)) - set(wrong):
        own = 3 * k + np.arange(2 if k == 2 else 3)
        others = [3 * j + i for j in range(6) if j != k and j not in wrong for i in range(3)]
        gain = np.linalg.solve(known[np.ix_(others, others)], known[np.ix_(others, own)]).T
        off = y.ravel()[own] - gain @ y.ravel()[others]
        left = known[np.ix_(own, own)] - gain @ known[np.ix_(others, own)]
        expected = off @ np.linalg.solve(left, off)
        assert (tests[k].chi2, tests[k].degrees) == (pytest.approx(expected, rel=1e-5), len(own))
        assert tests[k].p == pytest.approx(chi2.sf(expected, len(own)), rel=1e-4)
    told = 1.0 / np.diagonal(covariance, axis1=1, axis2=2) - 1.0
    told[wrong] = 0.0
    shares = [[one.shares[name] for name in "ac"] for one in tests]
    within(shares, (told / told.sum(0))[:, [0, 2]], 1e-12)
    assert all(len(one.shares) == 2 for one in tests)
    text = disagreement(tests)
    assert bool(text) == bool(wrong) and all(f"{mhz[k]:g} MHz" in text for k in wrong)


def test_two_channels_that_differ_are_both_named():
    mean, covariance = np.array([[1.0], [-1.0]]), np.full((2, 1, 1), 1e-4)
    tests = shared_tests(mean, covariance, np.ones((1, 2, 2)), ("a",), [15.0, 20.0])
    assert [one.disagrees for one in tests] == [True, True]


def test_a_channel_without_an_unknown_tells_nothing_of_it():
    scenario = lb.load_scenario("fiducial", SMALL)
    both, covariance = {"a": np.inf, "b": np.inf}, np.diag([0.2, 0.1])
    one = Share(both, np.array([0.5, 1.0]), covariance, 4, {}, True, 0.0)
    other = Share({"a": np.inf}, np.array([0.3]), np.full((1, 1), 0.5), 4, {}, True, 0.0)
    tied, _ = tie_channels(scenario, [15.0, 20.0], [one, other])
    assert tied.names == ("a", "b")
    # of a: 1 / 0.2 + 1 / 0.5 - 1
    within(tied.mean, [[3.1 / 6.0, 1.0]] * 2, 1e-12)
    within(tied.covariance, np.stack([np.diag([1.0 / 6.0, 0.1])] * 2), 1e-12)
    # a third that differs from both keeps its own, and tells the others nothing
    third = Share({"a": np.inf}, np.array([-9.0]), np.full((1, 1), 0.01), 4, {}, True, 0.0)
    apart, tests = tie_channels(scenario, [15.0, 20.0, 22.0], [one, other, third])
    assert [test.disagrees for test in tests] == [False, False, True]
    within(apart.mean, [[3.1 / 6.0, 1.0]] * 2 + [[-9.0, 0.0]], 1e-12)
    within(apart.covariance[2], np.diag([0.01, 1.0]), 1e-12)
    within(kernel(FREQUENCIES, np.inf), ALL, 0)
    within(kernel(FREQUENCIES, OCTAVES), SMOOTH, 1e-15)


def test_others_start_from_the_channels_that_agree():
    """Three of four say 75 + 0.5 std, whichever comes first."""
    scenario, prior = lb.load_scenario("fiducial", SMALL), {"a": (75.0, 0.5)}
    std = np.full((1, 1), 1e-2)
    for said in ([-3.0, 0.5, 0.5, 0.5], [0.5, 0.5, -3.0, 0.5]):
        shares = [Share({"a": np.inf}, np.array([z]), std**2, 4, prior, True, 0.0) for z in said]
        found = from_fitting(scenario, [10.0, 20.0, 30.0, 40.0], shares)
        assert found == pytest.approx({"a": 75.25}, abs=1e-3)


@pytest.fixture(scope="module")
def scenario():
    return lb.load_scenario("fiducial", SMALL)


@pytest.fixture(scope="module")
def cube(scenario, tmp_path_factory):
    return map_channels(scenario, tmp_path_factory.mktemp("shared"))


@pytest.fixture(scope="module")
def dense(scenario):
    """Skies, shared values, fluxes and receivers about what each channel's own data tell."""
    skies, same, own, rest, noise, stds, constant = [], [], [], [], [], [], 0.0
    expectations, begin = [], None
    for channel in scenario.channels():
        experiment = lb.build(channel, values=begin)
        found = lb.infer(experiment)
        if begin is None:  # the others' rounds do with what the first has found
            parts = [s for s in found.expanded if s.systematic.moves]
            told = [s.systematic.in_units(s.expected + found.amplitudes(s).mean) for s in parts]
            begin = told[0] | told[1]
        columns = np.concatenate([s.columns for s in found.expanded], axis=1)
        e = np.concatenate([s.expected for s in found.expanded])
        constant -= e @ (e + np.concatenate([found.amplitudes(s).mean for s in found.expanded]))
        skies.append(np.asarray(found.model.coupling.dense()))
        same.append(columns[:, :4])
        own.append(columns[:, 4:])
        rest.append(np.asarray(experiment.data.data - found.model.offset) + columns @ e)
        noise.append(np.sqrt(np.asarray(radiometer(experiment.setup).diagonal())))
        stds.append(np.sqrt(np.asarray(found.model.prior.variance())))
        expectations.append(e)
    e = np.sum(expectations, axis=0)
    assert np.abs(e[:4]).max() > 0.5 and not e[4:].any()
    # volumes exp(e^T z) of all channels together make the prior's mean their sum
    before = e[:4]
    rows = np.concatenate([block_diag(*skies), np.concatenate(same), block_diag(*own)], axis=1)
    is_flux = np.diag(np.arange(OWN) < FLUXES)
    mixed = np.kron(np.linalg.cholesky(SMOOTH), np.eye(OWN) - is_flux)
    unmixed = block_diag(np.eye(3 * N_MODES + 4), np.kron(np.eye(3), is_flux) + mixed)
    prior = np.concatenate([*stds, np.ones(4 + 3 * OWN)])
    left = np.concatenate(rest) - np.concatenate(same) @ before
    white = white_posterior(rows @ unmixed, prior, np.concatenate(noise), left)
    mean = unmixed @ white.mean
    mean[3 * N_MODES :][:4] += before
    log_prob = white.log_prob + before @ before / 2.0 + constant
    seen = [np.hstack([a, t[:, :FLUXES]]) for a, t in zip(skies, own, strict=True)]
    tied = [np.hstack([t, z[:, FLUXES:]]) for t, z in zip(same, own, strict=True)]
    return Answer(mean, unmixed @ white.covariance @ unmixed.T, log_prob), seen, noise, stds, tied


@pytest.fixture(scope="module")
def expected(dense, cube) -> Answer:
    """With the weights that channels have whose skies are alike; all else given what they share."""
    (mean, covariance, log_prob), *parts = dense
    u = np.stack([channel.departure.mean for channel in cube.channels])
    told, slopes = np.zeros((16, 16)), np.zeros((3, 16, N_MODES))
    for k, (seen, noise, std, shared) in enumerate(zip(*parts, strict=True)):
        before = np.append(std, np.ones(FLUXES + 8))
        both = np.hstack([seen, shared])
        alone = white_posterior(both, before, noise, np.zeros(len(both))).covariance
        v, place = alone[-8:, -8:], np.r_[:4, 4 + 4 * k + np.arange(4)]
        told[np.ix_(place, place)] += np.linalg.inv(v) - np.eye(8)
        slopes[k, place] = -np.linalg.solve(v, alone[-8:, :N_MODES]) / std
    apart = np.inner(u, u) - np.diag((u**2).sum(1))
    more = np.einsum("kim,kl,ljm->ij", slopes, apart, slopes)
    prior = block_diag(np.eye(4), np.kron(np.linalg.inv(SMOOTH), np.eye(4)))
    at = 3 * N_MODES + np.r_[:4, np.concatenate([4 + OWN * k + RECEIVERS for k in range(3)])]
    half = np.linalg.inv(np.linalg.cholesky(prior + told))
    values, axes = np.linalg.eigh(half @ more @ half.T)
    more = np.linalg.solve(half, axes * np.sqrt(np.maximum(values, 0.0)))
    gain = np.linalg.solve(told + more @ more.T, told).T
    after = np.linalg.inv(prior + gain @ told)
    left = after @ gain @ (prior + told) @ mean[at] - mean[at]
    slope = np.linalg.solve(covariance[np.ix_(at, at)], covariance[at]).T
    wider = slope @ (after - covariance[np.ix_(at, at)]) @ slope.T
    return Answer(mean + slope @ left, covariance + wider, log_prob)


@pytest.mark.essential
def test_skies_are_those_of_one_normal_equation(cube, expected):
    for k, channel in enumerate(cube.channels):
        own = slice(k * N_MODES, (k + 1) * N_MODES)
        assert_same_map(channel, Answer(expected.mean[own], expected.covariance[own, own], 0), 1e-6)
    assert cube.log_evidence == pytest.approx(expected.log_prob, abs=1e-4)
    assert "except for the instrument that they share" in cube.headline()
    assert any("Unknowns of the beams are the same at all" in line for line in cube.lines())


@pytest.mark.essential
def test_tables_have_the_shared_values(cube, expected):
    shared, std = slice(3 * N_MODES, None), expected.std
    for k, channel in enumerate(cube.channels):
        table, offsets = channel.unknowns.table, channel.pointing.offsets
        assert list(table["unknown"]) == [*SAME, *(f"receiver_{i}_k" for i in range(4))]
        assert list(offsets["offset"]) == ANGLES
        z = (table["value"] - table["prior"]) / table["prior_std"]
        z = np.concatenate([z[:2], offsets["value"] / offsets["prior_std"], z[2:]])
        width = (one["std"] / one["prior_std"] for one in (table[:2], offsets, table[2:]))
        mine = np.r_[:4, 4 + OWN * k + RECEIVERS]
        within((z - expected.mean[shared][mine]) / std[shared][mine], 0.0, 1e-6)
        np.testing.assert_allclose(np.concatenate(list(width)), std[shared][mine], rtol=1e-6)


@pytest.mark.essential
def test_temperatures_of_all_channels_are_those_of_one_gaussian(cube, expected, dense):
    """Means over pixels of all skies, with their full covariance, and what each unknown adds.

    Skies that are alike add what the data of each do not measure, given the instrument.
    """
    missed, u = [], []
    for k, (a, noise, std) in enumerate(zip(*dense[1:4], strict=True)):
        before = np.append(std, np.ones(FLUXES))
        left = np.linalg.inv(np.diag(before**-2.0) + a.T @ (a / noise[:, None] ** 2))
        missed.append(left[:, :N_MODES] / std)
        u.append(cube.channels[k].departure.mean)
    # estimates of correlations, none of which exceeds one
    alike = np.inner(u, u)
    assert (alike[0, 1:] > 0.5).all() and (np.triu(alike, 1) < 1.0).all()
    spectrum, first = cube.sky_spectrum(), cube.channel
    regions = sky_regions(first.highest_altitude)
    inside, hidden = np.stack([*regions.values()]), ~regions["observed sky"]
    grid = pixel_matrix(64, lmax_of(N_MODES))
    for k, pixels in enumerate(inside):
        row = grid[pixels].mean(0) if k else np.eye(1, N_MODES)[0] / np.sqrt(4.0 * np.pi)
        rows = block_diag(*[row] * 3)
        covariance = rows @ expected.covariance[: 3 * N_MODES, : 3 * N_MODES] @ rows.T
        scale = np.sqrt(np.diagonal(covariance))
        error = np.stack([row @ one[:N_MODES] for one in missed])
        covariance += np.where(np.eye(3) == 1, 0.0, alike * (error @ error.T))
        off = spectrum.temperature[k] - rows @ expected.mean[: 3 * N_MODES]
        within(off / scale, 0.0, 1e-6)
        within((spectrum.covariance[k] - covariance) / np.outer(scale, scale), 0.0, 1e-6)
        never = block_diag(*[grid[hidden].mean(0)] * 3)
        seen = expected.covariance[: 3 * N_MODES, : 3 * N_MODES] @ never.T
        left = np.diagonal(rows @ seen) ** 2 / np.diagonal(never @ seen)
        at = spectrum.sources.index(UNOBSERVED)
        np.testing.assert_allclose(spectrum.shares[at, k], left / scale**2, rtol=1e-5, atol=1e-12)
        known = 3 * N_MODES + np.arange(2)  # the beams
        cross = rows @ expected.covariance[: 3 * N_MODES, known]
        gone = cross @ np.linalg.solve(expected.covariance[np.ix_(known, known)], cross.T)
        share = spectrum.shares[spectrum.sources.index("the beams"), k]
        np.testing.assert_allclose(share, np.diagonal(gone) / scale**2, rtol=1e-4)
    # a point source is the mean temperature that it adds to the sky
    table = pd.concat([channel.fluxes[:1] for channel in cube.channels])
    at, k = 3 * N_MODES + 4 + OWN * np.arange(3), spectrum.place("Cas A")
    assert k == len(regions) == len(spectrum.regions) - 1
    flux = table["prior_jy"] + table["prior_std_jy"] * expected.mean[at]
    error = np.stack([one[N_MODES] for one in missed])
    covariance = expected.covariance[np.ix_(at, at)]
    covariance += np.where(np.eye(3) == 1, 0.0, alike * (error @ error.T))
    covariance *= np.outer(*[table["prior_std_jy"]] * 2)
    scale = np.sqrt(np.diagonal(covariance))
    per_kelvin = kelvin_steradian(1.0, FREQUENCIES) / (4.0 * np.pi)
    within((table["flux_jy"] - flux) / scale, 0.0, 1e-6)
    within((spectrum.temperature[k] / per_kelvin - flux) / scale, 0.0, 1e-6)
    found = spectrum.covariance[k] / np.outer(per_kelvin, per_kelvin)
    within((found - covariance) / np.outer(scale, scale), 0.0, 1e-6)
    np.testing.assert_allclose(table["std_jy"], scale, rtol=1e-6)
    np.testing.assert_allclose(spectrum.truth[k] / per_kelvin, table["true_jy"], rtol=1e-12)
    known = 3 * N_MODES + np.arange(2)
    cross = expected.covariance[np.ix_(at, known)]
    gone = cross @ np.linalg.solve(expected.covariance[np.ix_(known, known)], cross.T)
    gone, share = np.diagonal(gone) / expected.std[at] ** 2, spectrum.shares[:, k]
    np.testing.assert_allclose(share[spectrum.sources.index("the beams")], gone, rtol=1e-4)
    assert not share[spectrum.sources.index("the sources")].any()
    together = share[spectrum.sources.index(ALL_TOGETHER)]
    for number, mine in enumerate(at):
        others = 3 * N_MODES + np.r_[:4, 4 + OWN * number + RECEIVERS]
        cross = expected.covariance[mine, others]
        gone = cross @ np.linalg.solve(expected.covariance[np.ix_(others, others)], cross)
        assert together[number] == pytest.approx(gone / expected.std[mine] ** 2, rel=1e-4)
    # its errors at two frequencies are alike
    assert (np.abs(covariance[0, 1:] / scale[0] / scale[1:]) > 0.01).any()
    header, rows = spectrum.rows("Cas A")
    assert header[1] == "S [Jy]" and float(rows[0][1].replace(",", "")) == round(flux.iloc[0], 1)
    # unknowns that channels share make their errors alike
    assert (spectrum.covariance[0, 0, 1:] > 1e-3 * spectrum.std[0, 0] * spectrum.std[0, 1:]).any()
    truth = np.array([c.truth[0] for c in cube.channels]) / np.sqrt(4.0 * np.pi)
    off = spectrum.temperature[0] - truth
    expected_chi2 = off @ np.linalg.inv(spectrum.covariance[0]) @ off
    assert spectrum.chi2("mean sky").chi2 == pytest.approx(expected_chi2, rel=1e-6)


@pytest.mark.essential
def test_theta_adds_the_variance_that_fixing_it_would_take_away(cube, expected):
    """Against the covariance of all skies and unknowns, conditioned with matrices."""
    for k, channel in enumerate(cube.channels):
        sky, theta = np.arange(k * N_MODES, (k + 1) * N_MODES), channel.theta
        shared = 3 * N_MODES + np.arange(4)
        own = 3 * N_MODES + 4 + OWN * k + np.arange(OWN)
        parts = {ALL_TOGETHER: np.r_[shared, own], "the beams": shared[:2]}
        parts |= {"clock and pointing": shared[2:], "the sources": own[:FLUXES]}
        parts |= {"the receivers": own[FLUXES:]}
        before = expected.covariance[np.ix_(sky, sky)]
        for name, at in parts.items():
            cross, own = expected.covariance[np.ix_(sky, at)], expected.covariance[np.ix_(at, at)]
            gone = cross @ np.linalg.solve(own, cross.T)
            assert theta.shares[name] == pytest.approx(np.trace(gone) / np.trace(before), rel=1e-4)
            if name == ALL_TOGETHER:
                grid = np.stack([modes_to_map(one, channel.nside) for one in np.eye(N_MODES)])
                share = np.einsum("mp,mn,np->p", grid, gone, grid)
                share /= np.einsum("mp,mn,np->p", grid, before, grid)
                np.testing.assert_allclose(theta.pixel_share, share, rtol=1e-4)
        assert set(theta.shares) == set(parts) and 0.01 < theta.shares[ALL_TOGETHER] < 1.0
        # without the blocks of time, which the table has as one row
        same, blocks = np.delete(parts[ALL_TOGETHER], [5, 6, 7]), parts["the sources"][1:]
        scale = np.outer(expected.std[same], expected.std[same])
        within(theta.correlation, expected.covariance[np.ix_(same, same)] / scale, 1e-6)
        widths = np.insert(expected.std[same], 5, np.sqrt(np.mean(expected.std[blocks] ** 2)))
        np.testing.assert_allclose(theta.table["width"], widths, rtol=1e-6)
        assert list(theta.corner["unknown"][:4]) == [*SAME, *ANGLES]
    assert not disagreement(cube.shared_tests) and len(cube.shared_tests) == 3
    assert cube.fit.level == "consistent"


@pytest.mark.essential
def test_a_wrong_resonance_in_one_channel_of_eight_is_named(tmp_path, monkeypatch):
    """Its antennas are 2 cm longer than those of the other seven."""
    frequencies = [10.0, 13.0, 16.0, 19.0, 21.0, 24.0, 27.0, 30.0]
    sizes = (f"frequencies_mhz={frequencies}", "lmax=4", "observation.step_s=1e5", RUNS)
    more = ("noise.radiometer.factor=1e4", "noise.beam={parameters: {length_m: 0.01}}")
    model = ("prior={model: isotropic, spectrum: sky}", "output.draws=0")
    eight = lb.load_scenario("fiducial", (*sizes, *more, *model))
    other = lb.load_scenario(eight, ["beam.length_m=3.02"]).channels()[3]
    wrong, made = lb.build(other).data, channels.measured_experiment

    def measured(channel, data, *given, **more):
        own = wrong if channel.frequency_mhz == other.frequency_mhz else data
        return made(channel, own, *given, **more)

    monkeypatch.setattr(channels, "measured_experiment", measured)
    found = map_channels(eight, tmp_path)
    assert found.fit.level == "does not fit" and not found.remarks("doubts")
    assert found.lines()[0].startswith("19 MHz (p ") and "do not fit" in found.lines()[-2]
    assert [one.disagrees for one in found.summary().shared] == [f == 19.0 for f in frequencies]
    # what is drawn is shared
    later = corner(replace(found, channels=found.channels[3:]))
    assert later.get_suptitle().startswith("Unknowns of the instrument (channel of 21 MHz)")
    # the data at 19 MHz are given, not simulated
    for one in (*found.channels[:3], *found.channels[4:]):
        (own,) = one.unknowns.table[["value", "true", "std"]].to_numpy()
        assert abs(own[0] - own[1]) < 4.0 * own[2]
