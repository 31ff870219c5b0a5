"""Every covariance and every sum of two obeys one contract, checked against dense numpy."""

from itertools import permutations, product
from operator import add

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from assertions import refuse
from reference_linear import random_covariance

import lusee_bayes as lb
from lusee_bayes.instrument.products import DataLayout
from lusee_bayes.noise import covariance, time_blocks
from lusee_bayes.testing import check_covariance, close

N_PRODUCTS, N_TIMES = 3, 4
FLAGS = np.zeros((N_PRODUCTS, N_TIMES), dtype=bool)
FLAGS[:, 2] = True  # nothing at all at one time
FLAGS[1, 0] = True


@pytest.fixture
def small_blocks(monkeypatch):
    """Block rows of two times of three products, so that small matrices have several."""
    monkeypatch.setattr(time_blocks, "ROWS", 7)


def _entries(flags):
    """(product, time) of every datum, product by product with time running fastest."""
    n_products, n_times = flags.shape
    return [(k, t) for k in range(n_products) for t in range(n_times) if not flags[k, t]]


def _banded(flags, width, seed=5):
    """(time-banded covariance, the same matrix by hand): N = G G^T with G block banded."""
    rng = np.random.default_rng(seed)
    n_products, n_times = flags.shape
    g = np.zeros((n_times, n_times, n_products, n_products))
    for t in range(n_times):
        for s in range(max(0, t - width), t + 1):
            g[t, s] = rng.normal(size=(n_products, n_products))
            g[t, s] /= np.sqrt(2 * n_products * (width + 1))
        g[t, t] += np.eye(n_products)
    full = np.einsum("arij,brkj->abik", g, g)  # blocks of rows a and columns b
    # what lies before the first time is ignored, whatever it is
    band = np.full((n_times, width + 1, n_products, n_products), np.nan)
    for t in range(n_times):
        for w in range(min(width, t) + 1):
            band[t, w] = full[t, t - w]
    product_of, time_of = (np.array(x) for x in zip(*_entries(flags), strict=True))
    by_hand = full[time_of[:, None], time_of[None], product_of[:, None], product_of[None]]
    assert (by_hand[np.abs(time_of[:, None] - time_of[None]) > width] == 0).all()
    layout = DataLayout.from_flags(flags)
    return time_blocks.TimeBandedCovariance(jnp.asarray(band), layout, "the memory"), by_hand


def _directions(n, rank=2, seed=11):
    """(U U^T, the same by hand, entry by entry)."""
    u = np.random.default_rng(seed).normal(size=(n, rank))
    by_hand = np.array([[sum(u[i] * u[j]) for j in range(n)] for i in range(n)])
    return covariance.LowRankCovariance(jnp.asarray(u), "the templates"), by_hand


def _terms(flags):
    """kind: (covariance, the same matrix by hand) of every kind, for one layout."""
    rng, layout = np.random.default_rng(3), DataLayout.from_flags(flags)
    entries = _entries(flags)
    n = len(entries)
    variance = rng.uniform(0.5, 2.0, n)
    blocks = np.stack([random_covariance(rng, N_PRODUCTS) for _ in range(N_TIMES)])
    by_hand = np.zeros((n, n))
    for (a, (k, t)), (b, (j, s)) in product(enumerate(entries), repeat=2):
        if t == s:
            by_hand[a, b] = blocks[t, k, j]
    matrix, updated = random_covariance(rng, n), rng.uniform(0.5, 2.0, n)
    base, (directions, outer) = lb.DiagonalCovariance(jnp.asarray(updated)), _directions(n)
    return {
        "diagonal": (lb.DiagonalCovariance(jnp.asarray(variance)), np.diag(variance)),
        "blocks": (time_blocks.TimeBlockCovariance(jnp.asarray(blocks), layout), by_hand),
        "dense": (covariance.DenseCovariance(jnp.asarray(matrix)), matrix),
        "banded": _banded(flags, 2),
        "low rank": (covariance.LowRankUpdate(base, directions), np.diag(updated) + outer),
    }


KINDS = ["diagonal", "blocks", "dense", "banded", "low rank"]
QUICK = [kind for kind in KINDS if kind != "banded"]


@pytest.mark.parametrize("kind", [*QUICK, pytest.param("banded", marks=pytest.mark.long)])
def test_contract(kind, small_blocks):
    check_covariance(*_terms(FLAGS)[kind])


def test_contract_without_flags():
    """Which change nothing in terms without a layout."""
    check_covariance(*_terms(np.zeros_like(FLAGS))["blocks"], slopes=False)


FIRST = [pytest.param(k, marks=pytest.mark.essential) if k == "blocks" else k for k in KINDS]


@pytest.mark.long
@pytest.mark.parametrize("second", KINDS)
@pytest.mark.parametrize("first", FIRST)
def test_contract_of_sums(first, second, small_blocks):
    terms = _terms(FLAGS)
    (cov_a, dense_a), (cov_b, dense_b) = terms[first], terms[second]
    check_covariance(cov_a + cov_b, dense_a + dense_b, slopes=True)


@pytest.mark.essential
@pytest.mark.parametrize("kind", ["banded", "blocks", "dense"])
def test_contract_of_low_rank_updates(kind, small_blocks):
    cov, dense = _terms(FLAGS)[kind]
    directions, outer = _directions(len(dense), seed=12)
    check_covariance(covariance.LowRankUpdate(cov, directions), dense + outer, slopes=True)
    for total in (cov + directions, directions + cov):
        close(_dense(total), dense + outer)


# blocks of two times: widths below, at and above a block, whole matrices; times no multiple of two
WIDTHS = [*((w, False) for w in (0, 1, 2, 3, 6, 9)), *((w, True) for w in (2, 5))]


@pytest.mark.essential
@pytest.mark.parametrize(("width", "flagged"), WIDTHS)
def test_bands_of_every_width(width, flagged, small_blocks):
    flags = np.zeros((3, 7), dtype=bool)
    if flagged:
        flags[:, [0, 3]] = flags[1, 5] = flags[2, 6] = True
    check_covariance(*_banded(flags, width), slopes=False)


# 11 and 44 times make a block row; one gap hides more than a whole block row
SIZES = [
    (16, 25, 0, slice(0, 0)),
    (16, 25, 11, slice(0, 0)),
    (16, 27, 12, slice(9, 23)),
    (16, 25, 40, slice(3, 4)),
    (4, 95, 50, slice(60, 70)),
]


@pytest.mark.long
@pytest.mark.parametrize(("n_products", "n_times", "width", "gap"), SIZES)
def test_bands_at_the_blocks_own_size(n_products, n_times, width, gap):
    flags = np.zeros((n_products, n_times), dtype=bool)
    flags[:, gap] = True
    check_covariance(*_banded(flags, width), slopes=False)


def test_sums_keep_the_structure():
    diagonal, blocks, dense, banded, low_rank = (_terms(FLAGS)[kind][0] for kind in KINDS)
    directions, _ = _directions(diagonal.size)
    assert isinstance(diagonal + diagonal, lb.DiagonalCovariance)
    for term in (diagonal + blocks, blocks + diagonal, blocks + blocks):
        assert isinstance(term, time_blocks.TimeBlockCovariance)
    for term in (dense + blocks, blocks + dense, diagonal + dense, dense + dense, banded + dense):
        assert isinstance(term, covariance.DenseCovariance)
    for other in (diagonal, blocks, banded):
        for term in (banded + other, other + banded):
            assert isinstance(term, time_blocks.TimeBandedCovariance) and term.band.shape[1] == 3
        for term in (other + directions, directions + other, other + low_rank, low_rank + other):
            assert isinstance(term, covariance.LowRankUpdate) and isinstance(term.base, type(other))
    assert (low_rank + directions).update.root.shape[1] == 4
    assert isinstance(directions + directions, covariance.LowRankCovariance)


def test_bands_of_different_width_add_up(small_blocks):
    (wide, dense_wide), (narrow, dense_narrow) = _banded(FLAGS, 3), _banded(FLAGS, 1, seed=6)
    close((narrow + wide).dense(), dense_wide + dense_narrow, 1e-15)
    assert (narrow + wide).band.shape[1] == 4


def test_as_many_directions_as_data_leave_no_structure():
    cov, dense = _terms(FLAGS)["banded"]
    for rank in (len(dense), len(dense) + 3):
        directions, outer = _directions(len(dense), rank)
        total = cov + directions
        assert isinstance(total, covariance.DenseCovariance)
        close(total.dense(), dense + outer)
        ones = np.ones(len(dense))
        close(total.solve(jnp.asarray(ones)), np.linalg.solve(dense + outer, ones))


def test_low_rank_alone():
    directions, outer = _directions(6, 2)
    other, other_outer = _directions(6, 1, seed=13)
    for cov, dense in [
        (directions, outer),
        (directions + other, outer + other_outer),
        (directions.scaled(2.5), 2.5 * outer),
    ]:
        assert cov.size == 6
        close(cov.dense(), dense, 1e-15)
        close(cov.diagonal(), np.diag(dense), 1e-15)
    for use in (directions.factor, directions.log_det, lambda: directions.solve(jnp.ones(6))):
        refuse("templates.*rank 2.* 6 data.*radio", use)


@pytest.mark.parametrize("kind", ["diagonal", "banded"])
def test_strong_directions_are_whitened_too(kind):
    """U U^T of 1e8 times the base, the worst of the fiducial terms: W (N_0 + U U^T) W^T is 1.

    The sum is never formed here: in float64 it would lose N_0. Along U, whitening cancels 1e4 of
    the base's standard deviations down to 1: rounding 1e4 eps of each of some 10 operations.
    """
    base, dense = _terms(FLAGS)[kind]
    directions, _ = _directions(len(dense), rank=3)
    factor = covariance.LowRankUpdate(base, directions.scaled(1e8)).factor()
    strong = factor.whiten(1e4 * directions.root)
    weak = factor.whiten(jnp.asarray(np.linalg.cholesky(dense)))
    unit = np.asarray(strong @ strong.T + weak @ weak.T)
    np.testing.assert_allclose(unit, np.eye(len(dense)), rtol=0, atol=1e4 * 2.2e-16 * 10)
    # ln|N_0 + s U U^T| = ln|N_0| + ln|1 + s U^T N_0^-1 U|, well conditioned in eigenvalues
    u = np.asarray(directions.root)
    small = np.eye(3) + 1e8 * u.T @ np.linalg.solve(dense, u)
    expected = np.linalg.slogdet(dense)[1] + np.log(np.linalg.eigvalsh(small)).sum()
    assert float(factor.log_det()) == pytest.approx(expected, abs=1e-10)


_dense = eqx.filter_jit(lambda cov: cov.dense())


def test_sums_of_three_do_not_depend_on_order():
    terms = list(_terms(FLAGS).values())
    for triple in [(0, 1, 2), (1, 3, 4)]:
        expected = sum(terms[i][1] for i in triple)
        for a, b, c in permutations([terms[i][0] for i in triple]):
            close(_dense(a + b + c), expected)
            close(_dense(a + (b + c)), expected)


def test_flagged_samples_change_nothing_whatever_their_blocks_hold():
    cov, dense = _terms(FLAGS)["blocks"]
    junk = np.asarray(cov.blocks).copy()
    junk[FLAGS.T] = 1e6  # rows of samples that were never taken
    again = time_blocks.TimeBlockCovariance(jnp.asarray(junk), cov.layout)
    close(again.dense(), dense, 1e-15)
    assert float(again.log_det()) == float(cov.log_det())


def test_gradients_reach_the_entries():
    """d (ln|N| + x^T N^-1 x) / dN = N^-1 - y y^T with y = N^-1 x, at every free entry."""
    layout = DataLayout.from_flags(FLAGS)
    x = jnp.linspace(-1.0, 1.0, layout.size)

    def slope(build, entries):
        def value(e):
            n = build((e + jnp.swapaxes(e, -1, -2)) / 2.0 if e.ndim > 1 else e)
            return n.log_det() + x @ n.solve(x)

        return np.asarray(jax.jit(jax.grad(value))(entries))

    def expected(matrix):
        y = np.linalg.solve(matrix, np.asarray(x))
        return np.linalg.inv(matrix) - np.outer(y, y)

    terms = _terms(FLAGS)
    (diagonal, d), (blocks, b), (dense, m) = (terms[k] for k in ("diagonal", "blocks", "dense"))
    close(slope(lb.DiagonalCovariance, diagonal.variance), np.diag(expected(d)))
    close(slope(covariance.DenseCovariance, dense.matrix), expected(m))
    by_block = np.zeros((N_TIMES, N_PRODUCTS, N_PRODUCTS))
    product_of, time_of = np.nonzero(~FLAGS)
    for i, j in product(range(layout.size), repeat=2):
        if time_of[i] == time_of[j]:
            by_block[time_of[i], product_of[i], product_of[j]] = expected(b)[i, j]
    close(slope(lambda e: time_blocks.TimeBlockCovariance(e, layout), blocks.blocks), by_block)


# --- refusals ---------------------------------------------------------------------------------


LAYOUT = DataLayout(2, 3)
BAND = jnp.zeros((3, 2, 2, 2)).at[:, 0].set(jnp.eye(2))
BLOCKS = jnp.tile(jnp.eye(2)[None], (3, 1, 1))
UNIT, ROOT = jnp.eye(3), jnp.ones((4, 2))
MAKERS = {
    "diagonal": lb.DiagonalCovariance,
    "dense": lambda m: covariance.DenseCovariance(m, "the gain term"),
    "blocks": lambda b: time_blocks.TimeBlockCovariance(b, LAYOUT),
    "banded": lambda b: time_blocks.TimeBandedCovariance(b, LAYOUT, "the gain term"),
    "low rank": lambda u: covariance.LowRankCovariance(u, "the beams"),
}


BAD_ENTRIES = [
    *(
        ("diagonal", jnp.array([1.0, bad, 2.0]), r"must be positive, .* first at \(1,\)")
        for bad in (0.0, -1.0, np.nan, np.inf)
    ),
    *(
        (kind, jnp.float32(entries), "(variance|term|blocks|beams) must be a float64 array")
        for kind, entries in zip(MAKERS, (jnp.ones(3), UNIT, BLOCKS, BAND, ROOT), strict=True)
    ),
    ("dense", UNIT.at[0, 2].set(jnp.nan), r"the gain term.*NaN .*\(0, 2\)"),
    ("blocks", BLOCKS.at[1, 1, 0].set(jnp.inf), r"noise blocks.*NaN .*\(1, 0, 1, 0\)"),
    ("banded", BAND.at[1, 1, 0, 1].set(jnp.nan), r"NaN .* first at \(1, 1, 0, 1\)"),
    ("low rank", ROOT.at[3, 1].set(jnp.inf), r"the beams.*NaN or infinity .*\(3, 1\)"),
    ("blocks", jnp.ones((2, 3, 3)), r"shape \(2, 1, 3, 3\), expected \(3, any, 2, 2\)"),
    ("banded", BAND[:2], r"shape \(2, 2, 2, 2\), expected \(3, any, 2, 2\)"),
    ("dense", UNIT.at[0, 1].set(0.01), r"gain term is not symmetric: .* up to 0\.01 "),
    ("blocks", BLOCKS.at[1, 0, 1].set(0.1), "not symmetric"),
    ("banded", BAND.at[2, 0, 0, 1].set(0.5), "within one time is not symmetric: .* 0\\.5 "),
]


@pytest.mark.parametrize(("kind", "entries", "message"), BAD_ENTRIES)
def test_entries_that_no_covariance_has_are_refused(kind, entries, message):
    refuse(message, MAKERS[kind], entries)


def test_what_passes_and_a_factor_that_does_not():
    covariance.DenseCovariance(UNIT.at[0, 1].set(1e-14))  # rounding
    # blocks between times need not be symmetric
    time_blocks.TimeBandedCovariance(BAND.at[1, 1, 0, 1].set(0.5), LAYOUT)
    for bad in (0.0, -2.0):
        refuse("must be positive", lb.DiagonalCovariance(jnp.ones(3)).scaled, bad)


def _indefinite():
    """A symmetric matrix whose lowest eigenvalue is -0.25, by construction."""
    q = np.linalg.qr(np.random.default_rng(0).normal(size=(6, 6)))[0]
    m = q @ np.diag([-0.25, 1.0, 2.0, 3.0, 4.0, 5.0]) @ q.T
    return jnp.asarray((m + m.T) / 2)


@pytest.mark.parametrize("kind", ["dense", "blocks", "banded"])
def test_indefinite_terms_are_named_with_their_lowest_eigenvalue(kind):
    if kind == "dense":
        cov = covariance.DenseCovariance(_indefinite(), "the gain term")
    elif kind == "blocks":
        blocks = jnp.stack([jnp.eye(6), _indefinite()])
        cov = time_blocks.TimeBlockCovariance(blocks, DataLayout(6, 2))
    else:
        # times 0 and 1 correlated by 1.25: eigenvalues 1 +- 1.25; the last time stands alone
        band = jnp.zeros((3, 2, 4, 4)).at[:, 0].set(jnp.eye(4)).at[1, 1].set(1.25 * jnp.eye(4))
        cov = time_blocks.TimeBandedCovariance(band, DataLayout(4, 3), "the gain term")
        cov = covariance.LowRankUpdate(cov, covariance.LowRankCovariance(1e-3 * jnp.ones((12, 1))))
    name = "noise" if kind == "blocks" else "the gain term"
    for use in (cov.factor, cov.log_det, lambda: cov.solve(jnp.ones(cov.size))):
        refuse(rf"{name}.* not positive definite: .* eigenvalue is -0\.25 ", use)


def test_sizes_must_match_in_a_sum():
    for kind in KINDS:
        cov, dense = _terms(FLAGS)[kind]
        for other in (_directions(len(dense) + 1)[0], lb.DiagonalCovariance(jnp.ones(3))):
            for a, b in [(cov, other), (other, cov)]:
                refuse(f"of {a.size} and {b.size} data; build both", add, a, b)


def test_blocks_with_other_flags_are_refused():
    other = FLAGS[:, ::-1]  # as many samples, but not the same ones
    for first, second in product(["blocks", "banded"], repeat=2):
        a, b = _terms(FLAGS)[first][0], _terms(other)[second][0]
        refuse("contain different samples; build both", add, a, b)


def test_a_dense_term_can_be_built_inside_jit_from_known_numbers():
    matrix = jnp.asarray(random_covariance(np.random.default_rng(0), 3))
    got = jax.jit(lambda x: covariance.DenseCovariance(matrix).solve(x))(jnp.ones(3))
    close(got, np.linalg.solve(np.asarray(matrix), np.ones(3)))
