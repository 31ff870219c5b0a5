"""Bad times as a Student-t: its density, its draws, and a sky that bursts do not move."""

from dataclasses import replace
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from assertions import refuse
from experiments import density, four_ports, program_arguments, small_experiment
from scipy import stats

import lusee_bayes as lb
from lusee_bayes.instrument.products import DataLayout, auto_indices
from lusee_bayes.noise.covariance import DenseCovariance
from lusee_bayes.runs.sample_run import coordinates, sample_together
from lusee_bayes.sampling.distributions import TimesStudentT

N_TIMES = 8
FORMS = ["paper", "exact"]


@pytest.fixture(scope="module", params=FORMS)
def case(request):
    """Four products; a time without data, one with a single product, others with gaps."""
    rng, flags = np.random.default_rng(1), np.zeros((4, N_TIMES), dtype=bool)
    flags[:, 2] = flags[:3, 4] = flags[1, 5:] = True
    layout = DataLayout.from_flags(flags)
    visibilities = np.array([9.0, 2.0, -1.0, 16.0])[:, None] * rng.uniform(1.0, 2.0, N_TIMES)
    given = {"bandwidth_hz": 1.0, "step_s": 10.0, "form": request.param}
    noise = lb.radiometer_noise(visibilities, layout, **given)
    loc, value = jnp.asarray(rng.normal(size=(2, layout.size)) * 5.0)
    return SimpleNamespace(layout=layout, noise=noise, loc=loc, value=value)


def by_time(case, nu):
    """The t-distribution of every time that has data, and where its data are in d."""
    dense = np.asarray(case.noise.dense())
    for t in range(N_TIMES):
        at = np.flatnonzero(case.layout.time == t)
        if len(at):
            yield t, at, stats.multivariate_t(case.loc[at], dense[np.ix_(at, at)], df=nu)


# --- the distribution -----------------------------------------------------------------------------


@pytest.mark.parametrize("nu", [0.7, 4.0])
def test_the_density_is_that_of_scipy(case, nu):
    site = TimesStudentT(case.loc, case.noise.factor(), case.layout, nu)
    values = jnp.stack([case.value, 30.0 * case.value, case.loc])
    laws = list(by_time(case, nu))
    expected = [sum(law.logpdf(v[at]) for _, at, law in laws) for v in np.asarray(values)]
    np.testing.assert_allclose(site.log_prob(values), expected, rtol=1e-12)
    for one in (site, TimesStudentT(case.loc, case.noise, case.layout, jnp.asarray(nu))):
        np.testing.assert_allclose(one.log_prob(values[0]), expected[0], rtol=1e-12)


def test_weights_are_means_given_the_residuals(case):
    """E[w_t] by quadrature: w ~ Gamma(nu / 2, nu / 2), d_t ~ N(loc_t, N_t / w)."""
    nu, dense = 3.0, np.asarray(case.noise.dense())
    found = TimesStudentT(case.loc, case.noise, case.layout, nu).weights(case.value)
    w, expected = np.exp(np.linspace(-25.0, 5.0, 4001)), np.ones(N_TIMES)
    for t, at, _ in by_time(case, nu):
        residual = np.asarray(case.value - case.loc)[at]
        chi2 = residual @ np.linalg.solve(dense[np.ix_(at, at)], residual)
        prior = stats.gamma.logpdf(w, nu / 2.0, scale=2.0 / nu)
        # the measure dw = w dx on the grid of x = ln w
        density = prior + 0.5 * len(at) * np.log(w) - 0.5 * w * chi2 + np.log(w)
        density = np.exp(density - density.max())
        expected[t] = (w * density).sum() / density.sum()
    np.testing.assert_allclose(found, expected, rtol=1e-6)


def test_residuals_have_the_misfits_slope(case):
    """J^T r is the gradient of the misfit, whose constants the density has."""

    def site(loc):
        return TimesStudentT(loc, case.noise, case.layout, 4.0)

    r, pull = jax.vjp(lambda loc: site(loc).residual(case.value), case.loc)
    slope = jax.jit(jax.grad(lambda loc: -site(loc).log_prob(case.value)))(case.loc)
    np.testing.assert_allclose(pull(r)[0], slope, rtol=1e-10)


def test_draws_follow_their_law(case):
    """chi^2_t / n_t ~ F(n_t, nu), times independent, covariances nu / (nu - 2) N."""
    nu, n = 10.0, 20_000
    site = TimesStudentT(case.loc, case.noise, case.layout, nu)
    draws = site.sample(jax.random.key(3), (2, n // 2))
    assert draws.shape == (2, n // 2, case.layout.size)
    away = np.asarray(draws).reshape(n, -1) - np.asarray(case.loc)
    dense, chi2 = np.asarray(case.noise.dense()), []
    for _, at, law in by_time(case, nu):
        precise = np.linalg.inv(law.shape) if len(at) > 1 else 1.0 / dense[np.ix_(at, at)]
        chi2.append(np.einsum("na,ab,nb->n", away[:, at], precise, away[:, at]) / len(at))
        assert stats.kstest(chi2[-1], stats.f(len(at), nu).cdf).pvalue > 1e-4
        # of Gaussian draws it would be chi^2
        assert stats.kstest(chi2[-1], stats.chi2(len(at), scale=1.0 / len(at)).cdf).pvalue < 1e-4
    ranks = stats.spearmanr(np.array(chi2).T).statistic
    assert np.abs(ranks - np.eye(len(chi2))).max() < 5.0 / np.sqrt(n)
    covariance = dense * nu / (nu - 2.0)
    sigma = np.sqrt(np.diag(covariance))
    # the kurtosis of t with ten degrees of freedom is 4: variances scatter by sqrt(3 / n)
    assert np.abs((np.cov(away.T) - covariance) / np.outer(sigma, sigma)).max() < 5 * np.sqrt(3 / n)
    assert np.abs(away.mean(0) / sigma).max() < 5.0 / np.sqrt(n)


def test_noise_that_couples_times_is_refused(case):
    dense = DenseCovariance(jnp.asarray(case.noise.dense()))
    site, complete = TimesStudentT, DataLayout(4, N_TIMES)
    refuse("correlation in time, not DenseCovariance", site, case.loc, dense, case.layout, 4.0)
    refuse("layout.*32 data.*mean 22", site, case.loc, case.noise, complete, 4.0)
    refuse("nu .*Student-t.*positive", site, case.loc, case.noise, case.layout, 0.0)


# --- the program ----------------------------------------------------------------------------------

PROGRAM = lb.load_program("student_t")
STRENGTH = 1000.0
NU = 4.0


def gibbs(gaussian, layout, data, n, rng):
    """Means and standard deviations of the sky, from draws of w and sky in turn."""
    scale, variance = np.sqrt(gaussian.prior.variance()), np.asarray(gaussian.noise.diagonal())
    a = np.asarray(gaussian.coupling.dense()) * scale
    data, time, counts = np.asarray(data), layout.time, layout.present.sum(0)
    w, means, covariances = np.ones(layout.n_times), [], []
    for _ in range(n):
        half = a * np.sqrt(w[time] / variance)[:, None]
        root = np.linalg.inv(np.linalg.cholesky(half.T @ half + np.eye(len(scale))))
        mean = root.T @ (root @ (a.T @ (w[time] / variance * data)))
        sky = mean + root.T @ rng.standard_normal(len(mean))
        chi2 = np.bincount(time, (data - a @ sky) ** 2 / variance, layout.n_times)
        w = rng.gamma((NU + counts) / 2.0) * 2.0 / (NU + chi2)
        means.append(scale * mean)
        covariances.append(scale**2 * (root**2).sum(0))
    means, covariances = np.array(means[50:]), np.array(covariances[50:])
    # Rao and Blackwell: of the means given w, and the variance within and between them
    return means.mean(0), np.sqrt(covariances.mean(0) + means.var(0))


def rms(x):
    return float(np.sqrt(np.mean(np.asarray(x) ** 2)))


@pytest.fixture(scope="module")
def burst():
    """98 times of 16 products, 81 modes, every twentieth time with bursts of 1000 sigma."""
    clean, rng = small_experiment(lmax=8, cycles=0.3), np.random.default_rng(3)
    layout, noise = clean.data.layout, lb.infer(clean).model.noise
    bad = rng.choice(layout.n_times, round(0.05 * layout.n_times), replace=False)
    hit = np.isin(layout.time, bad)
    strength = STRENGTH * np.abs(rng.standard_normal(layout.size)) * np.sqrt(noise.diagonal())
    dirty = np.asarray(clean.data.data) + np.where(hit, strength, 0.0)
    experiment = replace(clean, data=replace(clean.data, data=dirty))
    arguments = program_arguments(PROGRAM, experiment)
    gaussian = lb.infer(experiment).model
    given = {name: value for name, value in arguments.items() if name != "data"}
    white = coordinates(PROGRAM, given, experiment.data, lb.infer(experiment), ["sky"])
    sampler = lb.Sampler(warmup=100, draws=300, algorithm="hmc")
    chains = lb.sample(PROGRAM.model, arguments, sampler, white)
    a, variance = np.asarray(gaussian.coupling.dense()), np.asarray(gaussian.noise.diagonal())
    rest = lb.LinearGaussian(a[~hit], gaussian.prior, lb.DiagonalCovariance(variance[~hit]))
    good = rest.condition(dirty[~hit])
    return SimpleNamespace(
        bad=np.isin(np.arange(layout.n_times), bad),
        layout=layout,
        gaussian=gaussian,
        dirty=dirty,
        clean=gaussian.condition(np.asarray(clean.data.data)).posterior,
        naive=gaussian.condition(dirty).posterior,
        good=good.posterior,
        chains=chains,
        skies=chains.sites["sky"].reshape(-1, good.model.prior.size),
    )


@pytest.mark.long
def test_bursts_do_not_move_the_sky(burst):
    """Off by 0.16 of the clean data's standard deviations, by 182 with a Gaussian density."""

    def off(mean, reference):
        return rms((np.asarray(mean) - np.asarray(reference.mean)) / np.asarray(reference.std()))

    assert off(burst.naive.mean, burst.clean) > 100.0
    assert off(burst.skies.mean(0), burst.clean) < 0.2
    assert off(burst.skies.mean(0), burst.good) < 0.13
    # no narrower, no wider than with the bad times left out
    ratio = burst.skies.std(0) / np.asarray(burst.good.std())
    assert ratio.mean() == pytest.approx(1.0, abs=0.03)


@pytest.mark.long
def test_weights_tell_bad_times(burst):
    weight = burst.chains.sites["weight"].mean((0, 1))
    assert weight[burst.bad].max() < 1e-4 and weight[~burst.bad].min() > 0.3
    assert weight[~burst.bad].mean() == pytest.approx(1.1, abs=0.1)


@pytest.mark.long
def test_draws_are_those_of_another_sampler(burst):
    """Gibbs: the sky given w_t is Gaussian in closed form, w_t given the sky a Gamma law."""
    mean, std = gibbs(burst.gaussian, burst.layout, burst.dirty, 600, np.random.default_rng(4))
    # 1200 draws, worth at least 300 each: 0.06, less where they are worth more
    assert rms((burst.skies.mean(0) - mean) / std) < 0.06
    assert rms((burst.skies.mean(0) - np.asarray(burst.good.mean)) / std) > 0.06
    assert (burst.skies.std(0) / std).mean() == pytest.approx(1.0, abs=0.015)


def test_systematics_are_sampled_with_it(response_file):
    """Receivers: every time is scipy's multivariate t about sky, ground and receivers."""
    section = "noise.receiver={power_k: 800, relative_std: 0.1, treatment: sampled}"
    experiment = lb.build(four_ports(response_file, section))
    arguments = program_arguments(PROGRAM, experiment)
    gaussian, layout = arguments["gaussian"], experiment.data.layout
    power = np.array([790.0, 805.0, 850.0, 700.0])
    sites = {f"receiver_{k}_k": jnp.asarray(x) for k, x in enumerate(power)}
    sky = gaussian.prior.sample(jax.random.key(1))
    found, trace = density(PROGRAM, arguments, {"sky": sky, **sites})
    assert set(trace) == {"sky", "data", "weight", *sites}
    # 800 K of every receiver, and the ground, are part of what is seen without a sky
    more = np.zeros((layout.n_products, layout.n_times))
    more[auto_indices(4)] = (power - 800.0)[:, None]
    loc = np.asarray(gaussian.predict(sky)) + layout.gather(more)
    data, dense = np.asarray(arguments["data"]), np.asarray(gaussian.noise.dense())
    by_times = [np.flatnonzero(layout.time == t) for t in range(layout.n_times)]
    laws = [stats.multivariate_t(loc[at], dense[np.ix_(at, at)], df=NU) for at in by_times]
    seen = sum(law.logpdf(data[at]) for law, at in zip(laws, by_times, strict=True))
    prior = stats.norm(800.0, 80.0).logpdf(power).sum()
    prior += stats.norm(0.0, np.sqrt(gaussian.prior.variance())).logpdf(sky).sum()
    np.testing.assert_allclose(found, seen + prior, rtol=1e-9)


@pytest.mark.long
def test_a_run_keeps_the_weights(tmp_path):
    experiment = small_experiment(lmax=2)
    given = {"": experiment}, PROGRAM, lb.Sampler(chains=2, warmup=20, draws=30), tmp_path
    (result,) = sample_together(*given)
    assert result.tree["posterior"]["weight"].shape == (2, 30, experiment.data.layout.n_times)
    assert result.tree.attrs["coordinates"] == "white"
