"""Draws as a DataTree: what each group must hold follows from the draws and from d = A m + n.

The draws are exact ones of the posterior, so that every Monte Carlo error is that of independent
draws. Two samples are flagged.
"""

import arviz_stats
import jax
import numpy as np
import pytest
import xarray as xr
from assertions import refuse, require_conventions
from reference_linear import assert_draws_follow, matrices
from reference_linear import posterior as naive_posterior
from small_models import random_gaussian

import lusee_bayes as lb
from lusee_bayes.core import formats
from lusee_bayes.instrument.products import DataLayout
from lusee_bayes.sampling import datatree, hmc

# two antennas, so four products
PRODUCTS, N_TIMES, N_MODES = ("00R", "01R", "01I", "11R"), 4, 9
N_CHAINS, N_DRAWS = 4, 500
FLAGGED = [(1, 2), (3, 0)]


@pytest.fixture(scope="module")
def setting():
    """(model, data): nine modes seen by 14 of 16 samples, with correlated noise."""
    flags = np.zeros((len(PRODUCTS), N_TIMES), dtype=bool)
    flags[tuple(zip(*FLAGGED, strict=True))] = True
    layout = DataLayout.from_flags(flags)
    model = random_gaussian([4.0, 1.0, 0.5], layout.size, 4)
    truth, values = model.sample(jax.random.key(2))
    observation = lb.Observation.from_runs([lb.Run(cycles=N_TIMES / 327.5)])
    assert observation.n_times == N_TIMES
    return model, lb.Visibilities(values, layout, observation, 25.0, truth)


@pytest.fixture(scope="module")
def exact(setting):
    model, data = setting
    return naive_posterior(*matrices(model), data.data)


def chains_of(sites):
    rng, shape = np.random.default_rng(0), next(iter(sites.values())).shape[:2]
    statistics = {name: rng.random(shape) for name in hmc.STATISTICS}
    return hmc.Chains(sites, statistics | {"diverging": rng.random(shape) > 0.5})


def tree_of(setting, chains, program="sky", **options):
    model, data = setting
    posterior = model.condition(data.data).posterior
    return datatree.to_datatree(chains, lb.load_program(program), model, posterior, data, **options)


@pytest.fixture(scope="module")
def drawn(setting):
    """(tree, chains) of the program sky."""
    model, data = setting
    skies = model.condition(data.data).posterior.sample(jax.random.key(3), N_CHAINS * N_DRAWS)
    chains = chains_of({"sky": np.asarray(skies).reshape(N_CHAINS, N_DRAWS, N_MODES)})
    given = {"attributes": {"frequency_mhz": 25.0, "note": "µ = 1"}}
    return tree_of(setting, chains, n_predictive=N_CHAINS * N_DRAWS, **given), chains


@pytest.fixture(scope="module")
def collapsed(setting):
    """(tree, chains) of sky_marginal; its noise levels span a factor of a hundred."""
    levels = np.exp(np.random.default_rng(8).uniform(-2.3, 2.3, (N_CHAINS, N_DRAWS)))
    chains = chains_of({"noise_level": levels})
    return tree_of(setting, chains, "sky_marginal", n_predictive=N_CHAINS * N_DRAWS), chains


def test_every_group_is_there_with_its_dimensions(drawn, setting):
    tree, _ = drawn
    draws, known = ("chain", "draw"), ("prior_std", "analytic_mean", "analytic_std", "truth")
    expected = {
        "posterior": {"sky": (*draws, "mode")},
        "sample_stats": dict.fromkeys(hmc.STATISTICS, draws),
        "prior": {"sky": (*draws, "mode")},
        "prior_predictive": {"data": (*draws, "datum")},
        "posterior_predictive": {"data": (*draws, "datum")},
        "observed_data": {"data": ("datum",)},
        "constant_data": dict.fromkeys(known, ("mode",)),
    }
    for name, group in tree.children.items():
        assert {n: values.dims for n, values in group.data_vars.items()} == expected.pop(name)
    assert not expected
    assert setting[1].data.size == len(PRODUCTS) * N_TIMES - len(FLAGGED)
    assert tree["posterior_predictive"].sizes["draw"] == N_DRAWS
    assert tree["prior"].sizes["draw"] == N_CHAINS * N_DRAWS


def test_draws_statistics_and_data_are_the_ones_given(drawn, setting):
    tree, chains = drawn
    np.testing.assert_array_equal(tree["posterior"]["sky"], chains.sites["sky"])
    for name, values in chains.statistics.items():
        np.testing.assert_array_equal(tree["sample_stats"][name], values)
    np.testing.assert_array_equal(tree["observed_data"]["data"], setting[1].data)


def test_modes_are_labelled_by_ell_and_m(drawn):
    tree, _ = drawn
    for group in ("posterior", "prior", "constant_data"):
        ell, m = tree[group]["ell"].values, tree[group]["m"].values
        np.testing.assert_array_equal(ell**2 + ell + m, np.arange(N_MODES))
        assert (np.abs(m) <= ell).all()


def test_data_are_labelled_by_product_and_time_without_the_flagged_ones(drawn, setting):
    """Written out one by one: products in luseepy's order, two hours between samples."""
    expected = [
        (product, f"2027-01-15T{2 * time:02d}:00:00.000")
        for k, product in enumerate(PRODUCTS)
        for time in range(N_TIMES)
        if (k, time) not in FLAGGED
    ]
    for group in ("observed_data", "posterior_predictive", "prior_predictive"):
        labelled = drawn[0][group]
        found = zip(labelled["product"].values, labelled["time"].values, strict=True)
        assert list(found) == expected
    # and each value is where the full grid has it
    grid = xr.DataArray(setting[1].grid(), coords=[("product", list(PRODUCTS)), ("time", range(4))])
    values = drawn[0]["observed_data"]["data"].values
    for value, (product, time) in zip(values, expected, strict=True):
        assert float(grid.sel(product=product, time=int(time[11:13]) // 2)) == value


def test_units_are_written_on_what_has_them(drawn):
    tree, _ = drawn
    for group in tree.children.values():
        for name, values in group.data_vars.items():
            assert values.attrs.get("units") == ("1" if name in hmc.STATISTICS else "K"), name


def test_constants_against_the_textbook(drawn, setting, exact):
    model, data = setting
    constants = drawn[0]["constant_data"]
    # well conditioned matrices of order one
    np.testing.assert_allclose(constants["analytic_mean"], exact.mean, atol=1e-10)
    np.testing.assert_allclose(constants["analytic_std"], exact.std, rtol=1e-10)
    prior_std = np.sqrt(np.diag(np.asarray(model.prior.covariance())))
    np.testing.assert_allclose(constants["prior_std"], prior_std, rtol=1e-14)
    np.testing.assert_array_equal(constants["truth"], data.truth)


def test_prior_groups_follow_the_prior(drawn, setting):
    """Skies N(0, S), data N(0, A S A^T + N), and the data are those of the skies beside them."""
    a, s, n = matrices(setting[0])
    skies = drawn[0]["prior"]["sky"].values[0]
    data = drawn[0]["prior_predictive"]["data"].values[0]
    assert_draws_follow(skies, np.zeros(N_MODES), s)
    assert_draws_follow(data, np.zeros(len(n)), a @ s @ a.T + n)
    assert_draws_follow(data - skies @ a.T, np.zeros(len(n)), n)


def test_posterior_predictive_follows_the_posterior(drawn, setting, exact):
    """N(A mean, A C A^T + N); new noise on the very sky of the same chain and draw."""
    a, _, n = matrices(setting[0])
    replicated = drawn[0]["posterior_predictive"]["data"].values
    flat = replicated.reshape(-1, len(n))
    assert_draws_follow(flat, a @ exact.mean, a @ exact.covariance @ a.T + n)
    noise = replicated - drawn[1].sites["sky"] @ a.T
    assert_draws_follow(noise.reshape(-1, len(n)), np.zeros(len(n)), n)


def test_predictive_groups_are_thinned_and_know_which_draws_they_belong_to(setting):
    """4 x 30 draws to about 10: every twelfth."""
    model, data = setting
    posterior = model.condition(data.data).posterior
    skies = np.asarray(posterior.sample(jax.random.key(1), 120)).reshape(4, 30, N_MODES)
    # noise a million times smaller than the sky tells which sky the data belong to
    quiet = lb.LinearGaussian(model.coupling, model.prior, model.noise.scaled(1e-12))
    arguments = (lb.load_program("sky"), quiet, posterior, data)
    tree = datatree.to_datatree(chains_of({"sky": skies}), *arguments, n_predictive=10)
    predicted = tree["posterior_predictive"]
    np.testing.assert_array_equal(predicted["draw"], [0, 12, 24])
    assert predicted.sizes["chain"] == 4
    thinned = tree["posterior"]["sky"].sel(draw=predicted["draw"]).values
    expected = thinned @ np.asarray(model.coupling.dense()).T
    # noise of 1e-6 times some units
    np.testing.assert_allclose(predicted["data"], expected, atol=1e-5)
    assert tree["prior"].sizes["draw"] == 10
    few = datatree.to_datatree(chains_of({"sky": skies[:, :5]}), *arguments, n_predictive=30)
    np.testing.assert_array_equal(few["posterior_predictive"]["draw"], np.arange(5))


def test_another_seed_makes_other_predictive_draws_and_real_data_have_no_truth(setting):
    model, data = setting
    real = lb.Visibilities(data.data, data.layout, data.observation, 25.0)
    posterior = model.condition(data.data).posterior
    chains = chains_of({"sky": np.asarray(posterior.sample(jax.random.key(1), 8))[None]})
    first = tree_of((model, data), chains, seed=1, n_predictive=8)
    other = tree_of((model, real), chains, seed=2, n_predictive=8)
    groups = {"prior": "sky", "prior_predictive": "data", "posterior_predictive": "data"}
    for group, name in groups.items():
        assert not np.isin(first[group][name].values, other[group][name].values).any()
    xr.testing.assert_equal(first["posterior"], other["posterior"])
    constants = {"prior_std", "analytic_mean", "analytic_std"}
    assert set(other["constant_data"].data_vars) == constants
    assert set(first["constant_data"].data_vars) == constants | {"truth"}


def test_a_program_without_the_sky_gets_it_drawn_given_each_of_its_draws(collapsed, setting):
    """Each in the coordinates of the posterior of its own noise level: unit normals."""
    model, data = setting
    a, s, n = matrices(model)
    tree, chains = collapsed
    levels = chains.sites["noise_level"]
    np.testing.assert_array_equal(tree["posterior"]["noise_level"], levels)
    assert tree["posterior"]["sky"].dims == ("chain", "draw", "mode")
    assert "units" not in tree["posterior"]["noise_level"].attrs
    skies = tree["posterior"]["sky"].values
    z = np.empty(skies.shape)
    for index in np.ndindex(levels.shape):
        answer = naive_posterior(a, s, levels[index] * n, data.data)
        root = np.linalg.cholesky(answer.covariance)
        z[index] = np.linalg.solve(root, skies[index] - answer.mean)
    assert_draws_follow(z.reshape(-1, N_MODES), np.zeros(N_MODES), np.eye(N_MODES))
    # no sky is a copy of another
    assert len(np.unique(skies[..., 0])) == levels.size


def test_data_of_a_program_without_the_sky_are_replicated_with_its_skies(collapsed, setting):
    """(d - A m) / sqrt(level) ~ N(0, N), draw by draw; the prior predictive by its variance."""
    model, _ = setting
    a, s, n = matrices(model)
    tree, chains = collapsed
    noise = tree["posterior_predictive"]["data"].values - tree["posterior"]["sky"].values @ a.T
    scaled = noise / np.sqrt(chains.sites["noise_level"])[..., None]
    assert_draws_follow(scaled.reshape(-1, len(n)), np.zeros(len(n)), n)
    assert set(tree["prior"].data_vars) == {"noise_level"}
    logs = np.log(tree["prior"]["noise_level"].values[0])
    assert_draws_follow(logs[:, None], [0.0], [[1.0]])
    # given its level, prior data are N(0, A S A^T + level N)
    data = tree["prior_predictive"]["data"].values[0]
    roots = [np.linalg.cholesky(a @ s @ a.T + np.exp(x) * n) for x in logs]
    whitened = [np.linalg.solve(root, d) for root, d in zip(roots, data, strict=True)]
    assert_draws_follow(whitened, np.zeros(len(n)), np.eye(len(n)))


@pytest.mark.parametrize("which", ["drawn", "collapsed"])
def test_a_written_tree_comes_back(which, request, tmp_path):
    tree, _ = request.getfixturevalue(which)
    tree.to_netcdf(tmp_path / "samples.nc", engine="h5netcdf")
    found = datatree.read_datatree(tmp_path / "samples.nc")
    xr.testing.assert_identical(found, tree)
    for path, group in tree.subtree_with_keys:
        for name, values in group.data_vars.items():
            assert found[path][name].dtype == values.dtype, f"{path}/{name}"
    assert found.attrs["format"] == formats.SAMPLES
    assert found.attrs["program"] == {"drawn": "sky", "collapsed": "sky_marginal"}[which]
    if which == "drawn":
        require_conventions(tmp_path / "samples.nc")
        assert (found.attrs["frequency_mhz"], found.attrs["note"]) == (25.0, "µ = 1")


def test_arviz_reads_the_tree(drawn):
    """Its own summary of the sky, of independent draws: bulk ESS of the size of their number."""
    table = arviz_stats.summary(drawn[0], var_names=["sky"], round_to="none")
    skies = drawn[1].sites["sky"]
    np.testing.assert_allclose(table["mean"], skies.mean((0, 1)), rtol=1e-10)
    np.testing.assert_allclose(table["sd"], skies.std((0, 1), ddof=1), rtol=1e-3)
    # the estimate's own scatter is below a tenth at 2000 draws
    assert (np.abs(table["ess_bulk"] / skies[..., 0].size - 1) < 0.3).all()
    # 2000 independent draws of 4 chains: R-hat - 1 of order 1 / 500
    assert (table["r_hat"] < 1.01).all()


def test_files_that_are_no_samples_are_refused(setting, drawn, tmp_path):
    setting[1].write(tmp_path / "data.nc")
    (tmp_path / "text.nc").write_text("hello")
    xr.Dataset({"x": ("x", [1.0])}).to_netcdf(tmp_path / "bare.nc", engine="h5netcdf")
    drawn[0].to_netcdf(tmp_path / "cut.nc", engine="h5netcdf")
    whole = (tmp_path / "cut.nc").read_bytes()
    (tmp_path / "cut.nc").write_bytes(whole[: len(whole) // 2])
    for name, message in [
        ("gone.nc", "no samples of lusee-bayes sample at .*gone.nc"),
        ("text.nc", "its format is 'absent', expected"),
        ("data.nc", "its format is 'lusee_bayes visibilities 1', expected 'lusee_bayes samples 1'"),
        ("bare.nc", "its format is 'absent', expected"),
        ("cut.nc", "cannot be read as HDF5"),
        (".", "is a folder; give a file: samples"),
    ]:
        refuse(message, datatree.read_datatree, tmp_path / name)
