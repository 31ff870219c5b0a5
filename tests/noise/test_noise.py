"""Radiometer noise: the paper's formula by a double loop, the exact form by simulated voltages."""

from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from assertions import refuse
from reference_linear import z_of

import lusee_bayes as lb
from lusee_bayes.instrument.products import DataLayout, to_matrix, to_real
from lusee_bayes.noise.radiometer import exact_blocks, paper_variance, sample_covariances
from lusee_bayes.noise.time_blocks import TimeBlockCovariance

N_ANTENNAS, N_PRODUCTS, N_TIMES = 4, 16, 3
BANDWIDTH, STEP = 2.0e5, 600.0


def temperatures(seed=0) -> np.ndarray:
    """T(t), Hermitian and positive definite, shape (times, antennas, antennas), in K."""
    rng, shape = np.random.default_rng(seed), (N_TIMES, N_ANTENNAS, 6)
    x = rng.normal(size=shape) + 1j * rng.normal(size=shape)
    return 1e3 * x @ x.conj().swapaxes(1, 2)


T = temperatures()
VISIBILITIES = to_real(jnp.asarray(np.moveaxis(T, 0, 2)))
LAYOUT = DataLayout(N_PRODUCTS, N_TIMES)
AUTOS = [0, 7, 12, 15]


def noise(form="paper", layout=LAYOUT, **options):
    options = {"bandwidth_hz": BANDWIDTH, "step_s": STEP} | options
    return lb.radiometer_noise(VISIBILITIES, layout, form=form, **options)


def test_paper_form_is_the_papers_formula():
    expected = np.zeros((N_PRODUCTS, N_TIMES))
    for t in range(N_TIMES):
        k = 0
        for i in range(N_ANTENNAS):
            for j in range(i, N_ANTENNAS):
                for value in [T[t, i, j].real] if i == j else [T[t, i, j].real, T[t, i, j].imag]:
                    auto = T[t, i, i].real * T[t, j, j].real
                    expected[k, t] = (auto + value**2) / (2 * BANDWIDTH * STEP)
                    k += 1
    got = noise()
    assert isinstance(got, lb.DiagonalCovariance)
    # a handful of roundings
    np.testing.assert_allclose(got.variance, expected.ravel(), rtol=2e-15)
    expected = expected * BANDWIDTH * STEP
    np.testing.assert_allclose(paper_variance(VISIBILITIES), expected, rtol=2e-15)


def test_exact_form_is_what_complex_gaussian_voltages_do():
    """Products s_i conj(s_j) of voltages s ~ CN(0, T(t=0))."""
    n = 200_000
    white = np.random.default_rng(5).normal(size=(2, n, N_ANTENNAS)) / np.sqrt(2)
    s = (white[0] + 1j * white[1]) @ np.linalg.cholesky(T[0]).T
    delta = (to_real(s.T[:, None] * s.T[None].conj()) - to_real(T[0])[:, None]).T
    # mean of the products: T itself (this pins <s_i conj(s_j)> and the products' order)
    z = delta.mean(0) / (delta.std(0) / np.sqrt(n))
    assert np.abs(z).max() < z_of(N_PRODUCTS)
    expected = np.asarray(exact_blocks(VISIBILITIES))[0]
    for k in range(N_PRODUCTS):
        # scatter of each entry from the fourth moments of the draws themselves
        terms = delta[:, k, None] * delta
        z = (terms.mean(0) - expected[k]) / (terms.std(0) / np.sqrt(n))
        assert np.abs(z).max() < z_of(N_PRODUCTS**2), f"row {k}: {np.abs(z).max():.1f} sigma"


def test_exact_variances_have_closed_forms():
    cov = noise("exact")
    assert isinstance(cov, TimeBlockCovariance)
    variance = np.asarray(cov.diagonal()).reshape(N_PRODUCTS, N_TIMES) * BANDWIDTH * STEP
    autos = np.diagonal(T, axis1=1, axis2=2).real.T
    np.testing.assert_allclose(variance[AUTOS], autos**2, rtol=1e-14)
    # crosses: var Re = (T_ii T_jj + Re^2 - Im^2) / 2, var Im = (T_ii T_jj - Re^2 + Im^2) / 2
    v, auto = T[:, 0, 2], autos[0] * autos[2]
    np.testing.assert_allclose(variance[3], (auto + v.real**2 - v.imag**2) / 2, rtol=1e-13)
    np.testing.assert_allclose(variance[4], (auto - v.real**2 + v.imag**2) / 2, rtol=1e-13)


def test_products_of_no_voltages_are_independent():
    """At one time |V_01|^2 exceeds T_00 T_11; at another, ports 0 and 3 are one."""
    t = T.copy()
    t[1, 0, 1] = 1.1 * np.sqrt(t[1, 0, 0] * t[1, 1, 1])
    t[2, :3, 3], t[2, 3, 3] = t[2, :3, 0], t[2, 0, 0]
    seen = to_real(np.moveaxis(t, 0, 2))
    blocks = np.asarray(exact_blocks(seen))
    np.testing.assert_array_equal(blocks[0], np.asarray(exact_blocks(VISIBILITIES))[0])
    for time in (1, 2):
        np.testing.assert_array_equal(blocks[time], np.diag(paper_variance(seen)[:, time]))


@pytest.mark.parametrize("form", ["paper", "exact"])
def test_scalings(form):
    base = np.asarray(noise(form).dense())
    for options, ratio in [
        ({"factor": 10.0}, 10.0),
        ({"duty_cycle": 0.25}, 4.0),
        ({"bandwidth_hz": 4 * BANDWIDTH}, 0.25),
        ({"step_s": STEP / 3}, 3.0),
    ]:
        np.testing.assert_allclose(noise(form, **options).dense(), ratio * base, rtol=1e-14)
    given = {"form": form, "bandwidth_hz": BANDWIDTH, "step_s": STEP}
    doubled = lb.radiometer_noise(2.0 * VISIBILITIES, LAYOUT, **given)
    np.testing.assert_allclose(doubled.dense(), 4.0 * base, rtol=1e-14)


@pytest.mark.parametrize("name", ["bandwidth_hz", "step_s", "factor", "duty_cycle"])
@pytest.mark.parametrize("bad", [0.0, -1.0, float("nan"), float("inf")])
def test_parameters_must_be_positive(name, bad):
    refuse(rf"the radiometer's {name} must be positive, got {bad}", noise, **{name: bad})


def test_bad_options_and_visibilities_are_refused():
    refuse(r"duty_cycle.*exceed 1.*1\.5", noise, duty_cycle=1.5)
    refuse("radiometer form 'exakt'.*'exact'", noise, "exakt")
    never = np.zeros((N_PRODUCTS, N_TIMES), dtype=bool)
    never[7] = True
    for visibilities, layout, words in (
        (VISIBILITIES.at[7, 2].set(-1.0), LAYOUT, r"temperature .* positive.*\(1, 2\).*sky"),
        (VISIBILITIES.at[5, 0].set(jnp.nan), LAYOUT, r"the visibilities.*NaN .*\(5, 0\)"),
        (VISIBILITIES, DataLayout(N_PRODUCTS, 4), r"shape \(16, 3\), expected \(16, 4\)"),
        (VISIBILITIES.astype(jnp.float32), LAYOUT, "must be a float64 array.*float32"),
        (jnp.where(never, 0.0, VISIBILITIES), DataLayout.from_flags(never), "the auto 11R"),
    ):
        refuse(words, lb.radiometer_noise, visibilities, layout)


@pytest.mark.parametrize("form", ["paper", "exact"])
def test_slopes_with_respect_to_the_noise_factor_flow(form):
    slope = jax.jit(jax.grad(lambda f: noise(form, factor=f).log_det()))(jnp.asarray(2.0))
    assert float(slope) == pytest.approx(N_PRODUCTS * N_TIMES / 2.0, rel=1e-12)


# one time without any sample, one product at a time, and port 3 never
WHOLE_TIME, ONE_CROSS, LOST_PORT = np.zeros((3, N_PRODUCTS, N_TIMES), dtype=bool)
WHOLE_TIME[:, 1] = ONE_CROSS[4, 2] = True
LOST_PORT[[5, 6, 10, 11, 13, 14, 15]] = True


ABSENT = [*product((WHOLE_TIME, LOST_PORT), ("paper", "exact")), (ONE_CROSS, "paper")]


@pytest.mark.parametrize("absent", [0.0, np.nan])
@pytest.mark.parametrize(("flags", "form"), ABSENT)
def test_absent_samples_change_nothing_for_the_others(flags, form, absent):
    layout, seen = DataLayout.from_flags(flags), np.where(flags, absent, np.asarray(VISIBILITIES))
    options = {"bandwidth_hz": BANDWIDTH, "step_s": STEP, "form": form}
    got = lb.radiometer_noise(seen, layout, **options)
    keep = np.flatnonzero(~flags.ravel())
    whole = np.asarray(noise(form).dense())[np.ix_(keep, keep)]
    np.testing.assert_allclose(got.dense(), whole, rtol=1e-13, atol=1e-13 * whole.max())


def test_an_absent_auto_is_interpolated_in_time():
    flags = np.zeros((N_PRODUCTS, N_TIMES), dtype=bool)
    flags[0, 1] = True
    rising = np.asarray(VISIBILITIES).copy()
    rising[0] = [1e4, 1.2e4, 1.4e4]  # a straight line, so that nothing is lost
    layout = DataLayout.from_flags(flags)
    options = {"bandwidth_hz": BANDWIDTH, "step_s": STEP}
    whole = lb.radiometer_noise(rising, LAYOUT, **options).diagonal()[~flags.ravel()]
    got = lb.radiometer_noise(np.where(flags, 0.0, rising), layout, **options).diagonal()
    np.testing.assert_allclose(got, whole, rtol=1e-14)
    # a model's values of absent samples stay
    np.testing.assert_array_equal(lb.radiometer_noise(rising, layout, **options).diagonal(), whole)


@pytest.mark.parametrize("form", ["paper", "exact"])
def test_every_sample_has_its_own_live_time(form):
    """The mean of samples, weighted by live time, has the noise of all of their live time."""
    live = np.random.default_rng(4).uniform(10.0, 300.0, 5)
    v, layout = jnp.repeat(VISIBILITIES[:, :1], 5, axis=1), DataLayout(N_PRODUCTS, 5)
    fine = np.asarray(lb.radiometer_noise(v, layout, step_s=live, form=form).dense())
    weight = np.kron(np.eye(16), live / live.sum())
    expected = weight @ fine @ weight.T
    given = {"step_s": np.array([live.sum()]), "form": form}
    got = lb.radiometer_noise(v[:, :1], DataLayout(16, 1), **given).dense()
    np.testing.assert_allclose(got, expected, rtol=1e-12, atol=1e-12 * expected.max())
    refuse(r"step_s.*\(4,\)", lb.radiometer_noise, v, layout, **given | {"step_s": live[:4]})


# --- sample covariances scatter so ----------------------------------------------------------------


DRAWS, AVERAGED = 20_000, 1e4


def test_their_covariance_is_that_of_the_exact_form():
    rng = np.random.default_rng(1)
    a = rng.normal(size=(4, 5)) + 1j * rng.normal(size=(4, 5))
    one = a @ a.conj().T
    t = np.broadcast_to(one[..., None], (4, 4, DRAWS)).copy()
    drawn, true = to_real(sample_covariances(t, AVERAGED, rng)), to_real(one[..., None])
    block, found = np.asarray(exact_blocks(true))[0] / AVERAGED, np.cov(drawn)
    # a sample covariance of Gaussians scatters by this
    std = np.sqrt((block**2 + np.outer(block.diagonal(), block.diagonal())) / DRAWS)
    assert np.abs((found - block) / std).max() < 4.5
    assert np.abs((drawn.mean(axis=1) - true[:, 0]) / np.sqrt(block.diagonal() / DRAWS)).max() < 4.0
    np.testing.assert_array_equal(t[..., 0], one)


def test_what_no_voltages_have_is_refused():
    t = to_matrix(np.ones((16, 3)))
    refuse("not positive definite", sample_covariances, t, AVERAGED, np.random.default_rng(1))
