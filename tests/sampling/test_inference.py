"""Chains against posteriors known otherwise, and draws that do not depend on how they were kept.

Monte Carlo errors come from ArviZ's effective sample sizes, oracles from numpy and scipy alone.
"""

import os
import textwrap
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import pytest
from assertions import refuse
from commands import python
from numpyro import distributions as dist
from reference_linear import matrices, random_covariance
from reference_linear import posterior as naive_posterior
from scipy.stats import lognorm, multivariate_normal
from small_models import assert_mean

import lusee_bayes as lb
from lusee_bayes.noise.covariance import DenseCovariance
from lusee_bayes.sampling import hmc as inference
from lusee_bayes.sampling.hmc import CHUNK, STATISTICS, Checkpoints, Sampler, sample

ROOT = Path(lb.__file__).resolve().parents[1]
TESTS = Path(__file__).parent
N_DATA, N_MODES = 12, 9


def small_model() -> lb.LinearGaussian:
    """Nine modes, correlated noise; posterior correlations of up to 0.9, widths 0.1 to 1.4."""
    rng = np.random.default_rng(11)
    return lb.LinearGaussian(
        jnp.asarray(rng.normal(size=(N_DATA, N_MODES)) * np.linspace(3.0, 0.1, N_MODES)),
        lb.HarmonicPrior(jnp.asarray([4.0, 1.0, 2.0])),
        DenseCovariance(jnp.asarray(random_covariance(rng, N_DATA))),
    )


@pytest.fixture(scope="module")
def gaussian():
    return small_model()


@pytest.fixture(scope="module")
def data(gaussian):
    return gaussian.sample(jax.random.key(5))[1]


@pytest.fixture(scope="module")
def exact(gaussian, data):
    """The textbook posterior, by explicit matrices in numpy."""
    return naive_posterior(*matrices(gaussian), data)


def arguments_of(gaussian, data, name="sky"):
    return lb.load_program(name).arguments(gaussian) | {"data": data}


def sky_chains(gaussian, data, sampler, whitening, **options):
    program = lb.load_program("sky").model
    return sample(program, arguments_of(gaussian, data), sampler, whitening, **options)


@pytest.fixture(scope="module")
def nuts(gaussian, data):
    """(chains, whitening): the No-U-Turn Sampler in the posterior's own coordinates."""
    whitening = lb.Whitening.of(gaussian.condition(data).posterior)
    return sky_chains(gaussian, data, Sampler(draws=1000, seed=3), whitening), whitening


@pytest.fixture(scope="module")
def hmc(gaussian, data):
    """The same by HMC in coordinates of another posterior: three times the noise, other data."""
    other = lb.LinearGaussian(gaussian.coupling, gaussian.prior, gaussian.noise.scaled(3.0))
    wrong = lb.Whitening.of(other.condition(-data).posterior)
    sampler = Sampler(chains=4, warmup=150, draws=1500, algorithm="hmc", trajectory=1.2)
    return sky_chains(gaussian, data, sampler, wrong), wrong


def assert_follows(draws, answer):
    """Mean and every entry of the covariance, in coordinates in which ``answer`` is N(0, 1)."""
    root = np.linalg.cholesky(answer.covariance)
    z = np.linalg.solve(root, (draws - answer.mean).reshape(-1, draws.shape[-1]).T).T
    z = z.reshape(draws.shape)
    assert_mean(z, 0.0, "mean")
    i, j = np.triu_indices(z.shape[-1])
    assert_mean(z[..., i] * z[..., j], (i == j).astype(float), "covariance")


@pytest.mark.essential
def test_nuts_follows_the_analytic_posterior(nuts, exact):
    chains, _ = nuts
    assert chains.sites["sky"].shape == (4, 1000, N_MODES)
    assert_follows(chains.sites["sky"], exact)


@pytest.mark.parametrize("algorithm", ["hmc", pytest.param("nuts", marks=pytest.mark.long)])
def test_statistics_belong_to_the_draws_beside_them(algorithm, request, gaussian, data):
    """lp is ln p(m, d) + ln|det R|, by scipy, draw by draw; energies hold the momenta's too."""
    chains, whitening = request.getfixturevalue(algorithm)
    assert set(chains.sites) == {"sky"} and set(chains.statistics) == set(STATISTICS)
    # no chain is a copy of another
    first_modes = chains.sites["sky"][..., 0]
    assert not any(np.isin(first_modes[i], np.delete(first_modes, i, 0)).any() for i in range(4))
    a, s, n = matrices(gaussian)
    skies = chains.sites["sky"].reshape(-1, N_MODES)
    expected = multivariate_normal(cov=s).logpdf(skies)
    expected += multivariate_normal(cov=n).logpdf(np.asarray(data) - skies @ a.T)
    expected += np.linalg.slogdet(np.asarray(whitening.root))[1]
    # numbers of some tens, condition numbers below 1e3: 1e-12 would do
    np.testing.assert_allclose(chains.statistics["lp"].ravel(), expected, rtol=1e-10)
    assert not chains.statistics["diverging"].any()
    kinetic = chains.statistics["energy"] + chains.statistics["lp"]
    assert kinetic.min() > 0
    # p^2 / 2 of nine unit momenta averages 4.5, to 5 sigma of sqrt(9 / 2 / 1000) and more where
    # draws hang together: an energy without the momenta, or of others, is off by all of it
    assert kinetic.mean() == pytest.approx(N_MODES / 2, abs=0.6)
    assert (chains.statistics["step_size"] == chains.statistics["step_size"][:, :1]).all()
    assert chains.gradients == chains.statistics["n_steps"].sum()


def test_hmc_in_wrong_coordinates_follows_the_analytic_posterior(hmc, exact):
    """R^-1 C R^-T has eigenvalues from 1/3 to 1 and its centre is off, so that a density without
    the prior's or the likelihood's part of the change of coordinates would not pass."""
    chains, _ = hmc
    assert_follows(chains.sites["sky"], exact)
    # trajectories have the length asked for, to one step
    step, n_steps = chains.statistics["step_size"], chains.statistics["n_steps"]
    assert (np.abs(step * n_steps - 1.2) <= step).all()
    assert (step < 1.2).any()  # else one step is always right


def noisy_sky(coupling, prior, scale, data=None):
    """A sky in white coordinates beside a noise level that is in none: N = level scale^2."""
    level = numpyro.sample("level", dist.LogNormal(0.0, 0.7))
    sky = numpyro.sample("sky", lb.SkyPrior(prior))
    noise = dist.Normal(coupling @ sky, scale * jnp.sqrt(level)).to_event(1)
    numpyro.deterministic("mean_sky", sky.mean())
    numpyro.sample("data", noise, obs=data)


# midpoints in ln level: steps of 0.02 over six sigmas of the prior; sums of smooth functions that
# vanish at both ends are exact to rounding then
LEVELS = np.arange(-4.2, 4.2, 0.02)


@pytest.mark.long
def test_a_sky_in_white_coordinates_beside_a_site_in_none(gaussian, data):
    """Against quadrature over the level: p(level | d), and the sky's mean and second moments."""
    whitening = lb.Whitening.of(gaussian.condition(data).posterior)
    given = {"coupling": gaussian.coupling, "prior": gaussian.prior, "scale": jnp.asarray(0.7)}
    sampler = Sampler(chains=4, warmup=300, draws=1500, seed=2)
    chains = sample(noisy_sky, given | {"data": data}, sampler, whitening)
    assert set(chains.sites) == {"sky", "level", "mean_sky"}
    sky, level = chains.sites["sky"], chains.sites["level"]
    # a sum of nine numbers in another order: rounding
    np.testing.assert_allclose(chains.sites["mean_sky"], sky.mean(-1), rtol=1e-12, atol=1e-13)
    # weights of each ln level, and the sky's posterior given it
    a, s, _ = matrices(gaussian)
    given = [naive_posterior(a, s, np.exp(x) * 0.49 * np.eye(N_DATA), data) for x in LEVELS]
    log_p = np.array([answer.log_prob for answer in given])
    weights = np.exp(log_p - 0.5 * (LEVELS / 0.7) ** 2)
    weights /= weights.sum()
    mean = weights @ np.stack([g.mean for g in given])
    about = [g.covariance + np.outer(g.mean - mean, g.mean - mean) for g in given]
    covariance = np.einsum("g,gij->ij", weights, np.stack(about))
    logs = np.log(level)[..., None]
    expected = [weights @ LEVELS, weights @ LEVELS**2]
    assert_mean(np.concatenate([logs, logs**2], -1), np.array(expected), "level")
    std = np.sqrt(np.diag(covariance))
    scaled = (sky - mean) / std
    i, j = np.triu_indices(N_MODES)
    assert_mean(scaled, 0.0, "sky")
    correlation = covariance / np.outer(std, std)
    assert_mean(scaled[..., i] * scaled[..., j], correlation[i, j], "sky's second moments")


@pytest.mark.long
@pytest.mark.parametrize("algorithm", ["nuts", "hmc"])
def test_the_marginal_program_finds_the_noise_level(gaussian, data, algorithm):
    """No site in white coordinates; p(level | d) by quadrature over scipy's evidence."""
    a, s, n = matrices(gaussian)
    sampler = Sampler(chains=4, warmup=300, draws=1000, algorithm=algorithm)
    arguments = arguments_of(gaussian, data, "sky_marginal")
    chains = sample(lb.load_program("sky_marginal").model, arguments, sampler)
    assert set(chains.sites) == {"noise_level"}
    levels = np.exp(LEVELS)
    laws = [multivariate_normal(cov=a @ s @ a.T + level * n) for level in levels]
    evidence = [law.logpdf(np.asarray(data)) for law in laws]
    # the density of ln level: the Jacobian is the level itself
    density = np.exp(np.array(evidence)) * lognorm(1.0).pdf(levels) * levels
    density /= density.sum()
    logs = np.log(chains.sites["noise_level"])[..., None]
    expected = [density @ LEVELS, density @ LEVELS**2]
    assert_mean(np.concatenate([logs, logs**2], -1), np.array(expected), "ln noise level")


UNUSABLE = [
    ({"chains": 0}, "chains must be at least 1, got 0"),
    ({"warmup": 19}, "warmup must be at least 20, got 19"),
    ({"draws": 0}, "draws must be at least 1, got 0"),
    ({"target_accept": 1.0}, r"target_accept must lie in 0..1, got 1.0"),
    ({"trajectory": 0.0}, "trajectory must be positive, got 0.0"),
    ({"algorithm": "nut"}, "unknown algorithm 'nut'; did you mean 'nuts'?"),
]


@pytest.mark.parametrize(("settings", "message"), UNUSABLE)
def test_settings_that_cannot_be_used(settings, message):
    refuse(message, Sampler, **settings)


def test_the_number_of_draws_is_no_part_of_a_runs_identity():
    """All other settings are: each changed alone makes another run."""
    base = Sampler()
    assert Sampler(draws=7).identity() == base.identity()
    changed = {"chains": 3, "warmup": 21, "seed": 1, "algorithm": "hmc", "target_accept": 0.8,
               "trajectory": 1.0}  # fmt: skip
    assert {*changed, "draws"} == set(vars(base))
    for name, value in changed.items():
        identity = Sampler(**{name: value}).identity()
        assert {n for n in identity if identity[n] != base.identity()[n]} == {name}


@pytest.mark.parametrize("site", ["data", "skies"])
def test_a_site_to_whiten_that_the_program_does_not_sample(gaussian, data, site):
    whitening = lb.Whitening.of(gaussian.condition(data).posterior, site)
    refuse(f"no latent site '{site}'; it has sky", sky_chains, gaussian, data, Sampler(), whitening)


# ---- draws do not depend on how they were kept. A curved little posterior, whose diagonal metric
# is learnt, so that warmup has a state worth keeping; HMC compiles in a third of NUTS's time.

TINY = Sampler(chains=3, warmup=60, draws=70, seed=8, algorithm="hmc")


def bent(y):
    x = numpyro.sample("x", dist.Normal(jnp.zeros(2), jnp.array([1.0, 5.0])).to_event(1))
    numpyro.sample("y", dist.Normal(x[0] ** 2 + x[1], 0.5), obs=y)


def tiny(sampler=TINY, checkpoints=None, stop_at=None):
    """Draws of the bent program; interrupted by the user once ``stop_at`` iterations are done."""

    def report(iteration, _):
        if iteration == stop_at:
            raise KeyboardInterrupt

    arguments = {"y": jnp.asarray(1.5)}
    if stop_at is None:
        return sample(bent, arguments, sampler, checkpoints=checkpoints)
    with pytest.raises(KeyboardInterrupt):
        sample(bent, arguments, sampler, checkpoints=checkpoints, report=report)
    return None


def assert_identical(chains, expected, draws=slice(None)):
    for part in ("sites", "statistics"):
        got, reference = getattr(chains, part), getattr(expected, part)
        assert set(got) == set(reference)
        for name, values in reference.items():
            np.testing.assert_array_equal(got[name], values[:, draws], err_msg=name)
            assert got[name].dtype == values.dtype


@pytest.fixture(scope="module")
def uninterrupted():
    return tiny()


def test_an_interrupted_run_resumes_to_the_same_draws(uninterrupted, tmp_path):
    """Interrupted in warmup, again among the draws, then left alone; nothing is done twice."""

    def opened():
        return Checkpoints(tmp_path, {"run": 1}, resume=True)

    def kept():
        return {p.name: p.stat().st_mtime_ns for p in tmp_path.glob("chunk-*.npz")}

    in_warmup, among_draws = CHUNK, 4 * CHUNK
    tiny(checkpoints=opened(), stop_at=in_warmup)
    assert opened().chunks()[-1].iteration == in_warmup
    first = kept()
    tiny(checkpoints=opened(), stop_at=among_draws)
    assert opened().chunks()[-1].iteration == among_draws
    second = kept()
    assert_identical(tiny(checkpoints=opened()), uninterrupted)
    for before, after in [(first, second), (second, kept())]:
        assert before.items() < after.items()

    # killed while the last two chunks were being made: they are made again
    for path in sorted(tmp_path.glob("chunk-*.npz"))[-2:]:
        path.unlink()
    assert_identical(tiny(checkpoints=opened()), uninterrupted)


def test_more_draws_of_a_run_begin_with_those_there_are(uninterrupted, tmp_path):
    """A run extended, then asked for fewer: the draws are the same."""
    for draws in (30, 70, 41):
        sampler = Sampler(**{**vars(TINY), "draws": draws})
        chains = tiny(sampler, Checkpoints(tmp_path, {"run": 1}, resume=True))
        assert_identical(chains, uninterrupted, slice(draws))


def test_draws_do_not_depend_on_the_size_of_chunks(uninterrupted, monkeypatch):
    monkeypatch.setattr(inference, "CHUNK", 7)
    assert_identical(tiny(), uninterrupted)


def test_progress_is_reported_after_each_chunk_and_another_seed_makes_other_draws(uninterrupted):
    told, other = [], Sampler(**{**vars(TINY), "seed": 9})

    def report(iteration, state):
        told.append((iteration, int(state.i[0])))

    chains = sample(bent, {"y": jnp.asarray(1.5)}, other, report=report)
    # NumPyro's own counter agrees with ours; the last chunk goes on to its end
    assert told == [*[(n, n) for n in (25, 50, 75, 100, 125)], (130, 150)]
    assert not np.isin(chains.sites["x"], uninterrupted.sites["x"]).any()


# ---- several devices

DEVICES_SCRIPT = """
    import sys
    from pathlib import Path
    import jax
    import numpy as np
    sys.path.insert(0, {tests!r})
    import test_inference as t

    assert len(jax.devices()) == 2
    out, gaussian = Path(sys.argv[1]), t.small_model()
    data = gaussian.sample(jax.random.key(5))[1]
    whitening = t.lb.Whitening.of(gaussian.condition(data).posterior)

    for stop_at in (75, None):
        seen = set()

        def report(iteration, state):
            seen.add(len(jax.tree.leaves(state.z)[0].sharding.device_set))
            if iteration == stop_at:
                raise KeyboardInterrupt

        kept = t.Checkpoints(out / "chains", {{"run": 1}}, resume=True)
        try:
            chains = t.sky_chains(
                gaussian, data, t.DEVICES, whitening, checkpoints=kept, report=report
            )
        except KeyboardInterrupt:
            assert stop_at == 75
        assert seen == {{2}}, seen
    np.savez(out / "chains.npz", **chains.sites, **chains.statistics)
    assert t.TINY.chains == 3
    alone = t.inference._Run(t.bent, {{"y": t.jnp.asarray(1.5)}}, t.TINY, None)
    with jax.numpy_rank_promotion("allow"):
        assert len(jax.tree.leaves(alone.start().z)[0].sharding.device_set) == 1
"""


DEVICES = Sampler(chains=4, warmup=60, draws=60, seed=4, algorithm="hmc")


@pytest.mark.long
def test_chains_are_shared_out_among_devices_and_draw_the_same(gaussian, data, tmp_path):
    """Four chains on two devices, interrupted and resumed there; three chains stay on one."""
    env = os.environ | {
        "XLA_FLAGS": "--xla_force_host_platform_device_count=2",
        "JAX_PLATFORMS": "cpu",
        "PYTHONPATH": os.pathsep.join((str(ROOT), str(TESTS.parent))),
    }
    code = textwrap.dedent(DEVICES_SCRIPT.format(tests=str(TESTS)))
    done = python("-c", code, tmp_path, env=env, cwd=tmp_path, check=False)
    assert done.returncode == 0, done.stderr
    shared = np.load(tmp_path / "chains.npz")
    whitening = lb.Whitening.of(gaussian.condition(data).posterior)
    single = sky_chains(gaussian, data, DEVICES, whitening)
    # Sums are rounded in another order: 1e-16 of numbers of order ten in a step size or a position.
    # In white coordinates the motion is that of a harmonic oscillator, which carries an error on
    # without amplifying it: after 120 iterations of a few steps 1e-8 is generous, and any draw
    # that went another way would be off by order one.
    std = np.asarray(gaussian.condition(data).posterior.std())
    assert (np.abs(shared["sky"] - single.sites["sky"]) / std).max() < 1e-8
    np.testing.assert_allclose(shared["step_size"], single.statistics["step_size"], rtol=1e-8)
    np.testing.assert_array_equal(shared["n_steps"], single.statistics["n_steps"])
