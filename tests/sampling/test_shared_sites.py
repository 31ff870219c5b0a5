"""Programs of several channels as one: their density, and what is drawn of them.

The oracle is the Gaussian process written out: all channels' values at once, without conditioning
one channel on another.
"""

import jax
import numpy as np
import numpyro
import pytest
from numpyro import distributions as dist
from numpyro import handlers
from numpyro.infer.util import log_density
from scipy.stats import multivariate_normal, norm

import lusee_bayes as lb
from lusee_bayes.experiment.scenario import Scenario
from lusee_bayes.linear.amplitudes import Amplitudes
from lusee_bayes.sampling import hmc, programs, shared_sites
from lusee_bayes.systematics.systematic import Unknown

FREQUENCIES = {"10MHz": 10.0, "18MHz": 18.0, "40MHz": 40.0}
MEANS = dict(zip(FREQUENCIES, (3.0, 5.0, 9.0), strict=True))
DATA = {name: np.array([0.3, 4.0]) * k for k, name in enumerate(FREQUENCIES)}


def program(mean, data=None):
    """One value for all channels, one smooth over frequency, one of each channel's own."""
    common = numpyro.sample("common", dist.LogNormal(0.2, 0.5))
    smooth = numpyro.sample("smooth", dist.Normal(mean, 0.1 * mean))
    own = numpyro.sample("own", dist.Normal(0.0, 2.0))
    at = np.array([1.0, 0.0]) * (common + own) + np.array([0.0, 1.0]) * smooth
    numpyro.sample("data", dist.Normal(at, 0.7).to_event(1), obs=data)


CHANNELS = {name: {"mean": mean} for name, mean in MEANS.items()}


@pytest.mark.parametrize("octaves", [0.7, 1.5])
def test_the_density_is_that_of_all_channels_at_once(octaves):
    shared = shared_sites.SharedSites(program, FREQUENCIES, {"common": np.inf, "smooth": octaves})
    rng = np.random.default_rng(1)
    common, smooth, own = 1.4, rng.normal(list(MEANS.values()), 0.3), rng.normal(size=3)
    sites = {"10MHz/common": common}
    for name, s, o in zip(FREQUENCIES, smooth, own, strict=True):
        sites |= {f"{name}/smooth": s, f"{name}/own": o}
    with programs.numpyro_promotion():
        found, trace = log_density(shared, (), {"channels": CHANNELS, "data": DATA}, sites)
    x, means = np.log2(list(FREQUENCIES.values())), np.array(list(MEANS.values()))
    kernel = np.exp(-0.5 * ((x[:, None] - x) / octaves) ** 2) * np.outer(means, means) * 0.01
    expected = multivariate_normal(means, kernel).logpdf(smooth) + norm(0.0, 2.0).logpdf(own).sum()
    expected += norm(0.2, 0.5).logpdf(np.log(common)) - np.log(common)
    seen = np.stack([common + own, smooth], axis=1)
    expected += norm(seen, 0.7).logpdf(np.stack(list(DATA.values()))).sum()
    assert float(found) == pytest.approx(expected, rel=1e-12)
    assert all(float(trace[f"{name}/common"]["value"]) == common for name in FREQUENCIES)


def test_what_is_nearly_the_same_has_no_site_of_its_own():
    """Over 1e6 octaves the variance that is left is below rounding: one site, scaled."""
    shared = shared_sites.SharedSites(program, FREQUENCIES, {"smooth": 1e6})
    with programs.numpyro_promotion():
        trace = handlers.trace(handlers.seed(shared, jax.random.key(0))).get_trace(CHANNELS, DATA)
    z = [float(trace[f"{c}/smooth"]["value"] / m - 1.0) / 0.1 for c, m in MEANS.items()]
    kinds = [trace[f"{name}/smooth"]["type"] for name in FREQUENCIES]
    assert kinds == ["sample", "deterministic", "deterministic"]
    np.testing.assert_allclose(z, z[0], rtol=1e-9)


def test_a_channel_has_its_own_names():
    chains = hmc.Chains({"10MHz/sky": np.ones(1), "18MHz/sky": np.zeros(1)}, {"lp": np.zeros(1)})
    assert shared_sites.of_channel(chains, "18MHz").sites == {"sky": np.zeros(1)}


@pytest.mark.parametrize("octaves", [0.7, 1e6])
def test_coordinates_are_those_of_the_gaussian_given_all_channels(octaves):
    """Against all channels' values at once: prior precision and data added up.

    Over 1e6 octaves only the first channel has a site, whose value the others scale.
    """
    unknowns = [Unknown("common", 3.0, 0.2), Unknown("smooth", 0.0, 2.0), Unknown("own", size=2)]
    shared, rng, n = {"common": np.inf, "smooth": octaves}, np.random.default_rng(2), 12
    known, seen, pulled = {}, np.zeros((n, n)), np.zeros(n)
    for k, name in enumerate(FREQUENCIES):
        rows = rng.normal(size=(5, 4))
        data, covariance = rng.normal(size=5), np.linalg.inv(np.eye(4) + rows.T @ rows)
        here = slice(4 * k, 4 * k + 4)
        seen[here, here], pulled[here] = rows.T @ rows, rows.T @ data
        known[name] = Amplitudes(covariance @ rows.T @ data, covariance, np.zeros((0, 4)))
    x, prior = np.log2(list(FREQUENCIES.values())), np.zeros((3, 4, 3, 4))
    prior[:, 0, :, 0] = 1.0
    prior[:, 1, :, 1] = np.exp(-0.5 * ((x[:, None] - x) / octaves) ** 2)
    prior[:, 2, :, 2] = prior[:, 3, :, 3] = np.eye(3)
    prior = prior.reshape(n, n)
    expected = prior @ np.linalg.inv(np.eye(n) + seen @ prior)
    mean = expected @ pulled
    few = ["10MHz/smooth"] if octaves > 1.0 else [f"{name}/smooth" for name in FREQUENCIES]
    latent = ["10MHz/common", *few, *(f"{name}/own" for name in FREQUENCIES)]
    white = shared_sites.gaussian_of_sites(known, unknowns, FREQUENCIES, shared, latent)
    assert sorted(white.names) == sorted(latent)
    own = ("common", "smooth", "own")
    at = {f"{name}/{u}": 4 * k + j for k, name in enumerate(FREQUENCIES) for j, u in enumerate(own)}
    numbers = [[at[s], at[s] + 1][: shape[0] if shape else 1] for s, shape in white.sites]
    numbers = np.concatenate(numbers)
    scale, middle = (np.tile(v, 3)[numbers] for v in ([0.2, 2.0, 1.0, 1.0], [3.0, 0.0, 0.0, 0.0]))
    np.testing.assert_allclose(white.mean, middle + scale * mean[numbers], rtol=1e-9)
    whole = scale[:, None] * expected[np.ix_(numbers, numbers)] * scale
    np.testing.assert_allclose(white.root @ white.root.T, whole, rtol=1e-8, atol=1e-12)
    assert float(white.log_det) == pytest.approx(np.linalg.slogdet(whole)[1] / 2.0)


SCENARIO = (
    *("frequencies_mhz=[10, 25]", "lmax=2", "seed=3", "prior={model: isotropic}"),
    "observation={runs: [{cycles: 0.25}, {cycles: 0.25, turntable_deg: 40}], step_s: 43200}",
    "noise.pointing={clock_s: 20, treatment: %s}",
    "noise.receiver={power_k: 2e4, relative_std: 0.1, smooth_octaves: 1, treatment: %s}",
)


@pytest.mark.long
def test_channels_that_share_what_is_sampled_are_sampled_together(tmp_path):
    """The clock's draws are the same in all; they and the skies are those of the tied maps.

    600 draws or more of every unknown: means to 0.2 and widths to 0.15 of a width are five errors.
    """
    sampled, mapped = (
        lb.load_scenario(Scenario(), [text.replace("%s", treatment) for text in SCENARIO])
        for treatment in ("sampled", "marginalised")
    )
    sampler = lb.Sampler(chains=4, warmup=50, draws=250, seed=1)
    drawn = lb.run_sample(sampled, tmp_path / "sampled", sampler=sampler).result
    clocks = [one.tree["posterior"]["clock_s"].values for one in drawn]
    np.testing.assert_array_equal(clocks[0], clocks[1])
    assert not (tmp_path / "sampled" / "chains").exists()
    again = lb.run_sample(sampled, tmp_path / "sampled", sampler=sampler, resume=True).result
    channels = lb.run_map(mapped, tmp_path / "mapped").result.channels
    for one, channel in zip(again, channels, strict=True):
        table, found = channel.theta.corner.set_index("unknown"), one.summary
        assert list(table.index) == ["clock_s", *(f"receiver_{port}_k" for port in range(4))]
        found = found.loc[table.index]
        assert (found["ess_bulk"] > 600).all() and (found["r_hat"] < 1.02).all()
        assert (abs(found["mean"] - table["value"]) < 0.2 * table["std"]).all()
        np.testing.assert_allclose(found["sd"], table["std"], rtol=0.15)
        skies = one.skies.reshape(-1, one.skies.shape[-1])
        assert (abs(skies.mean(0) - channel.mean) < 0.2 * channel.std).all()
        np.testing.assert_allclose(skies.std(0), channel.std, rtol=0.15)
