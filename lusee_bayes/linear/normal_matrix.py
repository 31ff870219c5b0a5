"""A^T N^-1 A without A: from the beams and Fourier sums over time.

Sums over times of weights, pairs of functions and exp(i q phi) hold all of time, ::

    F_c,jk(q) = sum_t w_c(t) u_j(t) u_k(t) exp(i q phi(t)),    q = -2 lmax .. 2 lmax

They are the only part of a normal matrix whose cost grows with the number of samples, and a small
part of its cost.

With c_lm(t) = sum_j u_j(t) beta_j,lm exp(i m phi(t)), beta_lm = W_lm + i W_l,-m (coupling.py), a
visibility is Re sum_m conj(c_lm) (a_lm + i a_l,-m), and for noise that does not couple times ::

    sum_t w(t) c_lm conj(c'_l'm') = sum_jk beta_j,lm conj(beta'_k,l'm') F_jk(m - m') = P,
    sum_t w(t) c_lm c'_l'm'       = sum_jk beta_j,lm beta'_k,l'm' F_jk(m + m')       = Q,

at each turntable angle. The four parts of the matrix follow from P + Q and P - Q.
Noise that couples different times is whitened in order of time, a few rows of A at once.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from itertools import pairwise

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Complex, Float, Int

from lusee_bayes.core.arrays import (
    Array,
    ModesMatrix,
    as_complex,
    compiled,
    namespace,
    placed,
    scan,
)
from lusee_bayes.core.checks import is_traced, require_shape
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.harmonics import Rotation, mode_numbers
from lusee_bayes.core.linalg import checked_cholesky, gram_matrix, mirrored, solve_lower
from lusee_bayes.instrument.coupling import Coupling, CouplingMatrix, turned_about_pole
from lusee_bayes.noise.covariance import (
    Covariance,
    DiagonalCovariance,
    LowRankUpdate,
    TimeBandedCovariance,
    TimeBandedFactor,
    TimeBlockCovariance,
)

# arrays that recur
Beams = Float[Array, "orders products 2 functions degrees"]

# times that are summed at once: it bounds the memory
CHUNK = 512


def time_sums(
    weights: Float[Array, "weights times"],
    azimuth: Float[Array, " times"],
    functions: Float[Array, "times functions"],
    lmax: int,
) -> Complex[Array, "weights functions functions q"]:
    """Compute F for every pair of functions of time.

    Parameters
    ----------
    weights : (weights, times) array
        w_c(t), in 1/K^2 where they are inverse variances.
    azimuth : (times,) array
        phi(t), in radians.
    functions : (times, functions) array
        u_j(t).
    lmax : int
        Highest order m of either beam.

    Returns
    -------
    (weights, functions, functions, 4 lmax + 1) complex array
        The last axis counts q from -2 lmax to 2 lmax. In the unit of ``weights``.
    """
    n = functions.shape[1]
    left, right = np.triu_indices(n)
    n_chunks = -(-azimuth.shape[0] // CHUNK)
    missing = n_chunks * CHUNK - azimuth.shape[0]

    xp = namespace(weights, azimuth, functions)

    def chunked(x: Array) -> Array:
        padded = xp.pad(x, ((0, missing), *((0, 0),) * (x.ndim - 1)))
        return padded.reshape(n_chunks, CHUNK, *x.shape[1:])

    def add(total, part):
        w, phi, u = part
        pairs = u[:, left] * u[:, right]
        angle = phi[:, None] * np.arange(2.0 * lmax + 1.0)[None]
        phases = xp.concatenate([xp.cos(angle), xp.sin(angle)], axis=1)
        weighted = (w.T[:, None] * pairs.T[None]).reshape(-1, CHUNK)
        return total + weighted @ phases, None

    start = xp.zeros((weights.shape[0] * len(left), 2 * (2 * lmax + 1)))
    parts = (chunked(weights.T), chunked(azimuth), chunked(functions))
    sums, _ = scan(xp, add, start, parts)
    cosine, sine = xp.split(sums.reshape(weights.shape[0], len(left), -1), 2, axis=-1)
    positive = as_complex(cosine, sine)
    full = xp.concatenate([positive[..., :0:-1].conj(), positive], axis=-1)
    place = np.zeros((n, n), dtype=int)
    place[left, right] = place[right, left] = np.arange(len(left))
    return xp.take(full, place, axis=1)


# strips of orders where they are compiled: more save products with zeros
N_STRIPS = 6


@compiled
def of_one_angle(
    by_order: Float[Array, "orders beams degrees"],
    weights: Float[Array, "..."],
    azimuth: Float[Array, " times"],
    functions: Float[Array, "functions times"],
    n_products: int,
) -> ModesMatrix:
    """The lower triangle of their part in the mean-pole frame; modes as :func:`places` has them."""
    n = by_order.shape[0]
    beams = by_order.reshape(n, n_products, -1, 2, n).swapaxes(2, 3)
    f = time_sums(weights.reshape(-1, azimuth.shape[0]), azimuth, functions.T, n - 1)
    return _from_sums(beams, f.reshape(*weights.shape[:-1], *f.shape[1:]))


def _from_sums(beams: Beams, f: Complex[Array, "..."]) -> ModesMatrix:
    """The matrix of beams (W_lm, W_l,-m) and Fourier sums, one strip of orders after the other.

    Only columns of orders up to the strip's own last one, and rows of degrees from its first one,
    are computed; the others are mirror images, or zero. Modes come in the order of
    :func:`places`, so that a strip is one block on and below the diagonal.
    """
    xp, n = namespace(beams, f), beams.shape[0]
    # of every mode: degree, order, and whether it is a_l,-m
    ell, m = (x[_by_order(n - 1)] for x in mode_numbers(n - 1))
    m, s = np.abs(m), (m < 0).astype(int)
    whole = xp.zeros((len(m),) * 2)
    n_strips = n if xp is np else min(N_STRIPS, n)
    strips = list(pairwise(np.linspace(0, n, n_strips + 1).astype(int).tolist()))

    def put(strip: tuple[int, int], whole: Array) -> Array:
        first, end = strip

        def add(_, number):
            return None, _rows_of_order(number, beams, f, first, end)

        _, rows = scan(xp, add, None, np.arange(first, end))
        start, stop = np.searchsorted(m, (first, end))
        row = ((m - first) * 2 + s) * (n - first) + ell - first
        column = (s * end + m) * n + ell
        rows = rows.reshape(-1, rows.shape[-1])[row[start:stop][:, None], column[:stop][None]]
        return placed(whole, (slice(start, stop), slice(stop)), rows)

    for strip in strips:
        whole = put(strip, whole)
    return whole


def places(lmax: int) -> Int[np.ndarray, " modes"]:
    """Rows of the packed modes: by growing ``|m|``, for each first the a_lm, then the a_l,-m."""
    return np.argsort(_by_order(lmax))


@lru_cache(maxsize=4)
def _by_order(lmax: int) -> Int[np.ndarray, " modes"]:
    ell, m = mode_numbers(lmax)
    return np.lexsort((ell, m < 0, np.abs(m)))


def _rows_of_order(
    m: Array, beams: Beams, f: Complex[Array, "..."], first: int, end: int
) -> Float[Array, "rows columns"]:
    """Rows a_lm, then a_l,-m, of one order; columns a_l'm', then a_l',-m', of orders below end.

    Rows of degrees from ``first``; columns of all degrees, with zeros where there is no mode.
    """
    xp, n, others = namespace(beams, f), beams.shape[0], np.arange(end)
    difference = xp.take(f, m - others + 2 * (n - 1), axis=-1)
    total = xp.take(f, m + others + 2 * (n - 1), axis=-1)
    plus, minus = _weighted((total + difference) / 2.0, (total - difference) / 2.0, beams[:end])
    real, imaginary = own = beams[m][..., first:].swapaxes(0, 1)
    # real and imaginary parts of complex products by products of real matrices
    both = xp.concatenate([xp.stack([real, -imaginary], 1), xp.stack([imaginary, real], 1)], -1)
    both = both.reshape(-1, 2 * own.shape[-1]).T
    # (rows, orders, degrees) of either
    u, v = ((both @ x).swapaxes(0, 1) for x in (plus, minus))
    r = n - first
    u, v = u.reshape(2 * r, -1), v.reshape(2 * r, -1)
    return xp.concatenate([xp.concatenate([u[:r], -v[r:]], 1), xp.concatenate([u[r:], v[:r]], 1)])


def _weighted(
    even: Complex[Array, "..."], odd: Complex[Array, "..."], beams: Beams
) -> list[Float[Array, "orders parts degrees"]]:
    """(P + Q) / 2 and (P - Q) / 2 without the row's own beam, real and imaginary parts.

    With the other beam W + i W', and F(m + m') + F(m - m') = 2 even, their difference 2 odd::

        (P + Q) / 2 = even W + i odd W',    (P - Q) / 2 = -odd W - i even W'.
    """
    xp, (n_orders, n_products, _, n_functions, n) = namespace(even, beams), beams.shape
    factors = [
        xp.stack([xp.stack([even.real, -odd.imag]), xp.stack([even.imag, odd.real])]),
        xp.stack([xp.stack([-odd.real, even.imag]), xp.stack([-odd.imag, -even.real])]),
    ]
    if even.ndim == 5:
        # part, other part, product, other product, function, other function, order
        factors = [x.transpose(6, 2, 0, 4, 3, 1, 5) for x in factors]
        factors = [x.reshape(n_orders, n_products * 2 * n_functions, -1) for x in factors]
        return [x @ beams.reshape(n_orders, -1, n) for x in factors]
    beams = beams.reshape(n_orders, n_products, -1, n)
    factors = [x.transpose(5, 2, 0, 3, 1, 4).reshape(*beams.shape[:3], -1) for x in factors]
    if xp is np:
        products = [x @ beams for x in factors]
    else:  # XLA multiplies many small matrices a sixth as fast as it adds these terms
        products = [
            sum(x[..., q, None] * beams[:, :, None, q] for q in range(beams.shape[2]))
            for x in factors
        ]
    return [x.reshape(n_orders, -1, n) for x in products]


def normal_matrix(coupling: Coupling, noise: Covariance) -> ModesMatrix:
    """Compute A^T N^-1 A without forming A.

    Exact for the coupling's own functions of time. For diagonal noise and blocks in time the cost
    hardly grows with the number of samples; for time-banded noise it grows in proportion, in
    bounded memory.

    Parameters
    ----------
    coupling : Coupling
        A, with structure in time.
    noise : Covariance
        N, in K^2, of one of the kinds in ``NORMAL_MATRICES``.

    Returns
    -------
    (modes, modes) array
        In Galactic modes, in 1/K^2; symmetric to the last bit.

    Raises
    ------
    InputError
        If A or N has no structure in time (:func:`has_structure`), their sizes differ, or N is not
        positive definite.
    """
    require_shape("N", np.empty((noise.size, 0)), (coupling.shape[0], None))
    if not has_structure(coupling, noise):
        raise InputError(
            f"{type(noise).__name__} has no structure in time that A^T N^-1 A could use, or the "
            "coupling has a response of its own; use the dense form"
        )
    return NORMAL_MATRICES[type(noise)](coupling, noise)


def has_structure(coupling: Coupling, noise: Covariance) -> bool:
    """Tell whether :func:`normal_matrix` can be used.

    Parameters
    ----------
    coupling : Coupling
        A.
    noise : Covariance
        N.

    Returns
    -------
    bool
        True if both have structure in time.
    """
    return coupling.has_time_structure and type(_base(noise)) in NORMAL_MATRICES


def is_within_times(noise: Covariance) -> bool:
    """Tell whether noise couples no two times, but for templates.

    Parameters
    ----------
    noise : Covariance
        N.

    Returns
    -------
    bool
        True for independent noise and blocks in time, and these with templates.
    """
    return NORMAL_MATRICES.get(type(_base(noise))) is _within_times


def _base(noise: Covariance) -> Covariance:
    return noise.base if isinstance(noise, LowRankUpdate) else noise


def _within_times(coupling: CouplingMatrix, noise: Covariance) -> Array:
    return summed(coupling, noise.time_weights(coupling.layout))


def _with_templates(coupling: CouplingMatrix, noise: LowRankUpdate) -> Array:
    """With N_0 + T T^T: A^T D A - V^T (1 + T^T D T)^-1 V, V = T^T D A, D = N_0^-1."""
    base = noise.base.factor()
    weighted = base.solve(noise.update.root)
    v = namespace(weighted).stack([coupling.transpose_mv(column) for column in weighted.T])
    small = np.eye(v.shape[0]) + noise.update.root.T @ weighted
    lower = checked_cholesky(f"1 + T^T D T of {noise.update.name}", small)
    return normal_matrix(coupling, noise.base) - gram_matrix(solve_lower(lower, v, transpose=False))


# how A^T N^-1 A is summed for each structure of N in time; those without an entry need A itself
NORMAL_MATRICES: dict[type[Covariance], Callable[..., Array]] = {
    DiagonalCovariance: _within_times,
    TimeBlockCovariance: _within_times,
    TimeBandedCovariance: lambda coupling, noise: _streamed(coupling, noise.factor()),
    LowRankUpdate: _with_templates,
}


def summed(coupling: CouplingMatrix, weights: Float[Array, "..."]) -> ModesMatrix:
    """Compute A^T W A for weights W within times.

    Parameters
    ----------
    coupling : CouplingMatrix
        A.
    weights : (products, times) or (products, products, times) array
        The diagonal of W, or its block of every time; zero where a sample is missing.

    Returns
    -------
    (modes, modes) array
        In Galactic modes; symmetric to the last bit.
    """
    xp, pointing = namespace(coupling, weights), coupling.pointing
    runs, total, beams = dict(pointing.runs()), 0.0, coupling.by_order
    n_products = coupling.body_beams.shape[1]
    if xp is np:
        # products without weight, such as all but one that is left out
        used = np.flatnonzero(weights.any(axis=-1).reshape(-1, n_products).any(axis=0))
        if len(used) < n_products:
            by_product = beams.reshape(*beams.shape[:2], n_products, -1, beams.shape[3])
            beams = by_product[:, :, used].reshape(*beams.shape[:2], -1, beams.shape[3])
            weights = weights[used] if weights.ndim == 2 else weights[used][:, used]
            n_products = len(used)
    for group in _turntable_groups(coupling, weights):
        spans = [runs[run] for run in group]
        here = [
            xp.concatenate([x[..., span] for span in spans], axis=-1)
            for x in (weights, pointing.azimuth, pointing.functions.T)
        ]
        missing = -here[1].shape[0] % CHUNK
        padded = [xp.pad(x, ((0, 0),) * (x.ndim - 1) + ((0, missing),)) for x in here]
        part = of_one_angle(beams[group[0]], *padded, n_products)
        total = total + part
    turn = pointing.pole_from_galactic
    return _to_galactic(turn, total, places(len(turn.blocks) - 1))


def _turntable_groups(
    coupling: CouplingMatrix, weights: Float[Array, "..."]
) -> tuple[tuple[int, ...], ...]:
    """Runs of one turntable angle, which see the sky with the same beams, if they have weight."""
    runs = dict(coupling.pointing.runs())
    if is_traced(coupling.pointing.turntable):  # which angles are the same is not known
        return tuple((run,) for run in runs)
    angles = np.asarray(coupling.pointing.turntable)
    every = np.unique(angles)
    if not is_traced(weights):
        weighs = [bool(np.asarray(weights[..., span]).any()) for span in runs.values()]
        every = np.unique(angles[weighs])
    return tuple(tuple(np.flatnonzero(angles == angle).tolist()) for angle in every)


@compiled
def _to_galactic(
    pole_from_galactic: Rotation, lower: ModesMatrix, place: Int[Array, " modes"]
) -> ModesMatrix:
    """R^T M R, symmetric to the last bit.

    Of M the lower triangle is given, with the packed mode k in row ``place[k]``. NumPy's is
    overwritten.
    """
    if namespace(pole_from_galactic, lower) is np:
        return _turned(pole_from_galactic, mirrored(lower), place)
    matrix = jnp.tril(lower) + jnp.tril(lower, -1).T
    back = pole_from_galactic.T
    turned = back(back(matrix[place[:, None], place[None]]).T)
    return (turned + turned.T) / 2.0


def _turned(
    rotation: Rotation, matrix: ModesMatrix, place: Int[np.ndarray, " modes"]
) -> ModesMatrix:
    """R^T M R degree by degree, on and below the diagonal: what is worked on fits into a cache."""
    turned = np.empty_like(matrix)
    spans = [slice(ell**2, (ell + 1) ** 2) for ell in range(len(rotation.blocks))]
    for ell, (left, here) in enumerate(zip(rotation.blocks, spans, strict=True)):
        rows = left.T @ matrix[place[here]].take(place[: here.stop], axis=1)
        for right, there in zip(rotation.blocks[: ell + 1], spans[: ell + 1], strict=True):
            turned[here, there] = rows[:, there] @ right
    return mirrored(turned)


@eqx.filter_jit
def _streamed(coupling: CouplingMatrix, factor: TimeBandedFactor) -> ModesMatrix:
    """For time-banded noise: A is made, whitened and summed one block row of N after the other."""
    pointing, layout = coupling.pointing, coupling.layout
    n_blocks, rows, window = factor.left.shape
    steps, n_modes = rows // layout.n_products, coupling.shape[1]
    starts = np.array(pointing.run_starts)
    run_of = jnp.asarray(np.repeat(np.arange(len(starts) - 1), np.diff(starts)))
    missing = n_blocks * steps - layout.n_times

    def blocked(x: Array) -> Array:
        padded = jnp.pad(x, ((0, missing), *((0, 0),) * (x.ndim - 1)))
        return padded.reshape(n_blocks, steps, *x.shape[1:])

    def add(carry, block):
        before, total = carry
        left, inverse, u, phi, run, present = block
        beams = jnp.einsum("tj,tkjc->ktc", u, coupling.body_beams[run])
        a = jnp.swapaxes(turned_about_pole(beams, phi), 0, 1) * present[:, :, None]
        white = inverse @ (a.reshape(rows, n_modes) - left @ before)
        return (jnp.concatenate([before[rows:], white]), total + gram_matrix(white)), None

    present = layout.present.T.astype(jnp.float64)
    parts = (
        factor.left,
        factor.inverse,
        *map(blocked, (pointing.functions, pointing.azimuth, run_of, present)),
    )
    start = (jnp.zeros((window, n_modes)), jnp.zeros((n_modes, n_modes)))
    (_, total), _ = jax.lax.scan(add, start, parts)
    return _to_galactic(pointing.pole_from_galactic, total, np.arange(n_modes))
