"""Checks that every implementation of a protocol must pass, and a small scenario.

There is one check for each protocol: covariances, beam sources, coupling matrices, priors and
sources of skies. Bad input must be refused in a sentence. Extensions use them, too.
"""

from collections.abc import Callable
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.stats import norm

from lusee_bayes.core.arrays import on_device, on_host
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.harmonics import n_modes, turn_about_z
from lusee_bayes.experiment.scenario import Scenario, load_scenario
from lusee_bayes.instrument.beams.fields import HemisphereGrid, stokes_beam
from lusee_bayes.instrument.beams.source import BeamSource
from lusee_bayes.instrument.coupling import Coupling
from lusee_bayes.instrument.products import auto_indices, labels, to_matrix, to_real
from lusee_bayes.linear.normal_matrix import normal_matrix
from lusee_bayes.noise.covariance import Covariance, DiagonalCovariance
from lusee_bayes.sky.prior import Prior
from lusee_bayes.sky.sky_source import SkySource

# condition numbers are below 1e3, so a backward stable solve is accurate to 1e3 x 16 eps = 4e-12
TOL = 1e-11
# probability that correct draws fail
FALSE_ALARM = 1e-4


def close(got: object, expected: object, tol: float = TOL) -> None:
    """Assert that arrays agree to a fraction of the largest entry."""
    expected = np.asarray(expected)
    np.testing.assert_allclose(got, expected, rtol=0, atol=tol * np.abs(expected).max())


@eqx.filter_jit
def _numbers_of_covariance(cov: Covariance, x, xs, factor_of_cov):
    """All numbers that the contract compares, compiled once for every structure."""
    factor, unit = cov.factor(), jnp.eye(cov.size)
    return {
        "dense": cov.dense(),
        "diagonal": cov.diagonal(),
        "log_det": (cov.log_det(), factor.log_det(), factor_of_cov.log_det()),
        "solve": [f.solve(v) for f in (factor, factor_of_cov) for v in (x, xs)],
        "solve_of_cov": cov.solve(xs),
        "back": factor_of_cov.whiten(factor_of_cov.colour(xs)),
        "root": factor_of_cov.colour(unit),
        "inverse_root": factor_of_cov.whiten(unit),
        "inverse_root_transpose": factor_of_cov.whiten_transpose(unit),
        "one": [f(x) for f in (factor.colour, factor.whiten, factor.whiten_transpose)],
        "mapped": jax.vmap(lambda v: cov.solve(v))(xs.T),
        "scaled": (cov.scaled(2.5).dense(), cov.scaled(jnp.asarray(2.5)).solve(x)),
        "scaled_log_dets": jax.vmap(lambda s: cov.scaled(s).log_det())(jnp.asarray([1.0, 2.5])),
        "draws": cov.sample(jax.random.key(2), 20_000),
    }


@eqx.filter_jit
def _slopes(cov: Covariance, x):
    """d ln|s N| / ds at s = 2, d(x^T N^-1 x) / dx, and d(x^T (s N)^-1 x) / ds at s = 2."""
    two = jnp.asarray(2.0)
    return (
        jax.grad(lambda s: cov.scaled(s).log_det())(two),
        jax.grad(lambda v: v @ cov.solve(v))(x),
        jax.grad(lambda s: x @ cov.scaled(s).solve(x))(two),
    )


def check_covariance(cov: Covariance, dense: np.ndarray, *, slopes: bool = True) -> None:
    """Check the contract of a Covariance: everything agrees with a matrix.

    Parameters
    ----------
    cov : Covariance
    dense : (data, data) array
        The same matrix, made independently, with a condition number below 1e3.
    slopes : bool
        Check derivatives, too.

    Raises
    ------
    AssertionError
        If something disagrees.
    """
    rng, n = np.random.default_rng(7), len(dense)
    x, xs = rng.normal(size=n), rng.normal(size=(n, 3))
    inverse, (sign, log_det) = np.linalg.inv(dense), np.linalg.slogdet(dense)
    assert sign == 1.0
    assert cov.size == n
    factor = cov.factor()  # outside of jit, where values are checked
    got = _numbers_of_covariance(cov, jnp.asarray(x), jnp.asarray(xs), factor)

    # entries, determinant and solutions
    close(got["dense"], dense, 1e-15)
    assert (np.asarray(got["dense"]) == np.asarray(got["dense"]).T).all()
    close(got["diagonal"], np.diag(dense), 1e-15)
    np.testing.assert_allclose(got["log_det"], log_det, rtol=0, atol=TOL * n)
    for value, v in zip(got["solve"], 2 * (x, xs), strict=True):
        close(value, inverse @ v)
    close(got["solve_of_cov"], inverse @ xs)
    close(got["mapped"], xs.T @ inverse)

    # the square root: L L^T = N, whiten = L^-1, whiten_transpose = L^-T
    root = np.asarray(got["root"])
    close(root @ root.T, dense)
    inverse_root = np.linalg.inv(root)
    close(got["inverse_root"], inverse_root)
    close(got["inverse_root_transpose"], inverse_root.T)
    close(got["back"], xs)
    for value, matrix in zip(got["one"], (root, inverse_root, inverse_root.T), strict=True):
        close(value, matrix @ x)

    # scaled
    close(got["scaled"][0], 2.5 * dense)
    close(got["scaled"][1], inverse @ x / 2.5)
    close(got["scaled_log_dets"], [log_det, log_det + n * np.log(2.5)])

    # draws
    assert jax.eval_shape(cov.sample, jax.random.key(1)).shape == (n,)
    assert got["draws"].shape == (20_000, n)
    _assert_draws_follow(np.asarray(got["draws"]), dense)

    if slopes:
        of_log_det, of_vector, of_scale = _slopes(cov, jnp.asarray(x))
        np.testing.assert_allclose(of_log_det, n / 2.0, rtol=TOL)
        close(of_vector, 2.0 * inverse @ x)
        np.testing.assert_allclose(of_scale, -x @ inverse @ x / 4.0, rtol=TOL)


def _assert_draws_follow(
    draws: np.ndarray, covariance: np.ndarray, mean: np.ndarray | float = 0.0
) -> None:
    """Check moments, which scatter by sqrt(C_ii / n) and sqrt((C_ii C_jj + C_ij^2) / n) (Wick)."""
    variance, deviations = np.diag(covariance), draws - mean
    second = np.sqrt(np.outer(variance, variance) + covariance**2)
    for moment, expected, scatter in (
        (deviations.mean(0), 0.0, np.sqrt(variance)),
        (deviations.T @ deviations / len(draws), covariance, second),
    ):
        worst = np.abs(moment - expected) * np.sqrt(len(draws))
        # entries without variance are exact except for the rounding of a square root
        limit = norm.isf(FALSE_ALARM / (2 * worst.size)) * scatter + 1e-9 * second.max()
        assert (worst < limit).all()


# relative error of sums of a few thousand terms
ROUNDING = 1e-12


def assert_refused(call: Callable[[], object]) -> None:
    """Assert that a call raises InputError with one sentence, on one line."""
    try:
        call()
    except InputError as error:
        assert str(error) and "\n" not in str(error)
    else:
        raise AssertionError("expected an InputError")


def check_beam_source(
    source: BeamSource,
    turned: BeamSource,
    *,
    turned_deg: float,
    frequency_mhz: float = 20.0,
    lmax: int = 6,
    quadrature: float = 1e-9,
) -> None:
    """Check the laws that the beams of every source obey.

    Parameters
    ----------
    source : BeamSource
    turned : BeamSource
        The same antennas, turned by ``turned_deg`` from East towards North.
    turned_deg : float
    frequency_mhz : float
        A frequency that the source supports.
    lmax : int
    quadrature : float
        Error of the source's own quadrature, relative to the largest coefficient.

    Raises
    ------
    AssertionError
        If a law is broken.
    """
    n, beams = source.n_ports, source.beams(frequency_mhz, lmax)
    modes = np.asarray(beams.modes)
    largest = np.abs(modes).max()
    rounding = {"rtol": 0.0, "atol": ROUNDING * largest}
    assert modes.shape == (n**2, (lmax + 1) ** 2)
    assert np.isfinite(modes).all()
    assert beams.labels == labels(n)
    assert beams.frequency_mhz == frequency_mhz

    # coefficients agree with patterns, in the beams' unit, and patterns with fields; a smaller lmax
    # is a slice
    grid = HemisphereGrid.for_lmax(lmax)
    patterns = np.asarray(source.patterns(frequency_mhz, grid))
    assert patterns.shape == (n, n, len(grid.theta), grid.n_phi)
    expected = np.asarray(grid.modes(to_real(patterns), lmax))
    try:
        fields = source.fields(frequency_mhz, grid)
    except InputError as error:
        assert "product beams" in str(error)
    else:
        assert fields.grid is grid
        assert fields.n_antennas == n
        close(patterns, stokes_beam(fields), ROUNDING)
    unit = (modes * expected).sum() / (expected**2).sum()
    assert unit > 0
    np.testing.assert_allclose(modes, unit * expected, rtol=0, atol=quadrature * largest)
    fewer = np.asarray(source.beams(frequency_mhz, lmax - 1).modes)
    np.testing.assert_allclose(fewer, modes[:, : lmax**2], **rounding)

    # the voltages from a uniform sky have a covariance
    covariance = np.asarray(to_matrix(beams.modes))[..., 0]
    assert np.linalg.eigvalsh(covariance).min() > -ROUNDING * np.abs(covariance).max()

    # turned antennas see the sky turned the other way, and the same ground
    assert turned.n_ports == n
    rotated = turn_about_z(beams.modes, np.radians(turned_deg))
    np.testing.assert_allclose(turned.beams(frequency_mhz, lmax).modes, rotated, **rounding)

    background = np.asarray(source.background(frequency_mhz))
    assert background.shape == (n**2,)
    assert np.isfinite(background).all()
    assert (background[auto_indices(n)] >= 0.0).all()
    close(turned.background(frequency_mhz), background, ROUNDING)

    impedance = source.impedance(frequency_mhz)
    assert impedance is None or np.isfinite(impedance)
    assert source.interpolated(frequency_mhz) in (None, "linear", "spline")
    if (circuit := source.circuit(frequency_mhz)) is not None:
        per_kelvin = np.linalg.eigvalsh(circuit.per_kelvin)
        assert per_kelvin.min() > -ROUNDING * per_kelvin.max() and per_kelvin.max() > 0.0


@eqx.filter_jit
def _numbers_of_coupling(coupling: Coupling, m, d, skies, responses):
    """Numbers that the contract compares inside transformations, in one program."""
    first, second = responses
    changed = coupling.with_response(first).with_response(second)
    return {
        "jitted": coupling @ m,
        "mapped": jax.vmap(lambda x: coupling @ x)(skies),
        "slope": jax.grad(lambda x: d @ (coupling @ x))(m),
        "changed": changed.dense(),
        "changed_mv": changed @ m,
        "changed_transpose_mv": changed.transpose_mv(d),
        "slope_of_response": jax.grad(lambda r: d @ (coupling.with_response(r) @ m))(first),
    }


def check_coupling(coupling: Coupling, dense: Float[np.ndarray, "data unknowns"]) -> None:
    """Check the laws that every coupling matrix obeys.

    Parameters
    ----------
    coupling : Coupling
        Without a response.
    dense : (data, unknowns) array
        The same matrix, made independently.

    Raises
    ------
    AssertionError
        If a law is broken.
    """
    rng = np.random.default_rng(0)
    n_data, n_unknowns = dense.shape
    sky, data = rng.standard_normal(n_unknowns), rng.standard_normal(n_data)
    m, d = jnp.asarray(sky), jnp.asarray(data)

    same = partial(close, tol=ROUNDING)
    # A, A m and A^T d agree with the matrix, outside and inside transformations
    assert coupling.shape == dense.shape
    assert coupling.response is None
    same(coupling.dense(), dense)
    same(coupling @ m, dense @ sky)
    same(coupling @ jnp.stack([m, -m], axis=1), np.stack([dense @ sky, -dense @ sky], axis=1))
    same(coupling.transpose_mv(d), dense.T @ data)
    assert np.isnan(coupling @ m.at[0].set(jnp.nan)).any()
    skies, responses = rng.standard_normal((3, n_unknowns)), rng.uniform(0.5, 2.0, (2, n_data))
    arguments = (m, d, jnp.asarray(skies), jnp.asarray(responses))
    got = _numbers_of_coupling(coupling, *arguments)
    same(got["jitted"], dense @ sky)
    same(got["mapped"], skies @ dense.T)
    same(got["slope"], dense.T @ data)

    # responses multiply the rows and one another, and sampling can differentiate by them
    changed = coupling.with_response(arguments[3][0]).with_response(arguments[3][1])
    factors = responses.prod(0)
    rows = factors[:, None] * dense
    assert changed.shape == dense.shape
    same(changed.response, factors)
    same(got["changed"], rows)
    same(got["changed_mv"], rows @ sky)
    same(got["changed_transpose_mv"], rows.T @ data)
    same(got["slope_of_response"], data * (dense @ sky))

    # with structure in time, the normal matrix can be summed without A
    if coupling.has_time_structure:
        variance = rng.uniform(0.5, 2.0, n_data)
        normal = normal_matrix(coupling, DiagonalCovariance(jnp.asarray(variance)))
        same(normal, dense.T @ (dense / variance[:, None]))

    for wrong in (m[1:], m.astype(jnp.float32)):
        assert_refused(lambda x=wrong: coupling @ x)
    for wrong in (d[1:], d.astype(jnp.float32)):
        assert_refused(lambda x=wrong: coupling.transpose_mv(x))
        assert_refused(lambda x=wrong: coupling.with_response(x))
    assert_refused(lambda: coupling.with_response(d.at[0].set(jnp.nan)))


DRAWS = 20_000


def check_prior(prior: Prior, covariance: np.ndarray, mean: np.ndarray | None = None) -> None:
    """Check the contract of a Prior: everything agrees with a matrix, in NumPy and in JAX.

    Parameters
    ----------
    prior : Prior
    covariance : (unknowns, unknowns) array
        S, made independently; its condition number, without zero variances, must be below 1e3.
    mean : (unknowns,) array, optional
        The prior mean; zero by default.

    Raises
    ------
    AssertionError
        If something disagrees.
    """
    n = len(covariance)
    assert prior.size == n
    assert all(isinstance(line, str) for line in prior.description())
    assert prior.independent == bool((covariance == np.diag(np.diag(covariance))).all())
    rng = np.random.default_rng(11)
    u, a = rng.normal(size=(2, 3, n)), rng.normal(size=(70, n))
    white, matrix = rng.normal(size=(2, n, n))
    inputs = u, a, white @ white.T, matrix @ matrix.T
    traced = on_host(eqx.filter_jit(_numbers_of_prior)(on_device(prior), *map(jnp.asarray, inputs)))
    for name, value in _numbers_of_prior(on_host(prior), *map(np.array, inputs)).items():
        close(value, traced[name])
    root = traced["root"]
    close(root @ root.T, covariance)
    close(traced["covariance"], covariance)
    close(traced["variance"], np.diag(covariance))
    close(traced["coloured"], u @ root.T)
    close(traced["columns"], a @ root)
    close(traced["sandwich"], root.T @ inputs[3] @ root)
    close(traced["colour_covariance"], root @ inputs[2] @ root.T)
    expected, powerless = np.zeros(n) if mean is None else mean, np.diag(covariance) == 0
    for one in (on_host(prior), on_device(prior)):
        back = np.asarray(one.whiten(one.colour(u)))
        close(back, np.where(powerless, 0.0, u))
        close(one.whiten(one.colour(u[0, 0])), back[0, 0])
        restored = np.asarray(one.whiten_columns(a @ root))
        close(restored @ root, a @ root)
        assert (restored[:, powerless] == 0.0).all()
    if powerless.any():
        assert_refused(prior.require_density)
        assert_refused(prior.log_det)
    else:
        prior.require_density()
        log_det = 0.5 * np.linalg.slogdet(covariance)[1]
        np.testing.assert_allclose(prior.log_det(), log_det, atol=TOL)
    close(prior.colour(prior.white_mean), expected)
    wide = prior.widened(3.0)
    close(wide.covariance(), 9.0 * covariance)
    close(wide.colour(wide.white_mean), expected)
    assert prior.sample(jax.random.key(1)).shape == (n,)
    _assert_draws_follow(np.asarray(prior.sample(jax.random.key(0), DRAWS)), covariance, expected)


def _numbers_of_prior(prior: Prior, u, a, white, matrix):
    """All numbers on which NumPy and JAX must agree."""
    return {
        "root": prior.colour(np.eye(prior.size)).T,
        "covariance": prior.covariance(),
        "variance": prior.variance(),
        "coloured": prior.colour(u),
        "columns": prior.colour_columns(a),
        "sandwich": prior.sandwich(matrix),
        "colour_covariance": prior.colour_covariance(white),
    }


def check_sky_source(
    source: SkySource,
    *,
    frequency_mhz: float,
    lmax: int,
    slice_rtol: float,
    missing_mhz: float | None = None,
    missing_lmax: int | None = None,
) -> None:
    """Check the laws that every source of skies obeys.

    Parameters
    ----------
    source : SkySource
    frequency_mhz : float
        A frequency in MHz at which it has a sky.
    lmax : int
        Highest ell to request, at least 2.
    slice_rtol : float
        Largest relative rms difference between a sky of smaller lmax and a slice of it: 0 for
        coefficients; for maps, aliasing from above lmax in iterated quadrature.
    missing_mhz : float, optional
        A frequency in MHz at which it has no sky.
    missing_lmax : int, optional
        An ell up to which it has no sky.
    """
    sky = source.at(frequency_mhz, lmax)
    modes = np.asarray(sky.modes)
    assert sky.frequency_mhz == frequency_mhz
    assert sky.lmax == lmax
    assert sky.name
    np.testing.assert_array_equal(modes, source.at(frequency_mhz, lmax).modes)
    smaller = np.asarray(source.at(frequency_mhz, lmax // 2).modes)
    assert smaller.size == n_modes(lmax // 2)
    assert np.linalg.norm(smaller - modes[: smaller.size]) <= slice_rtol * np.linalg.norm(smaller)
    for frequency, highest in ((missing_mhz, lmax), (frequency_mhz, missing_lmax)):
        if frequency is not None and highest is not None:
            assert_refused(lambda f=frequency, ell=highest: source.at(f, ell))


def small_scenario(*overrides: str, lmax: int = 6, cycles: float = 0.02) -> Scenario:
    """Return a small version of the paper's scenario: 49 modes and, by default, 96 data.

    Tests that use the same sizes share the compiled programs.

    Parameters
    ----------
    *overrides : str
        ``key.path=value``, as on the command line.
    lmax : int
        Highest ell.
    cycles : float
        Length of the observation, in lunar days.

    Returns
    -------
    Scenario
        ``fiducial`` at these sizes: the embedded Galaxy without point sources.
    """
    sizes = [f"lmax={lmax}", f"observation.runs.0.cycles={cycles}"]
    return load_scenario("fiducial", [*sizes, *overrides])
