"""A^T N^-1 A without A, from the beams and Fourier sums over time.

Time enters only through sums over times of weights, pairs of functions and exp(i q phi), ::

    F_c,jk(q) = sum_t w_c(t) u_j(t) u_k(t) exp(i q phi(t)),    q = -2 lmax .. 2 lmax

Only their cost grows with the number of samples, and they are a small part of the cost of a normal
matrix.

With c_lm(t) = sum_j u_j(t) beta_j,lm exp(i m phi(t)), beta_lm = W_lm + i W_l,-m (coupling.py), a
visibility is Re sum_m conj(c_lm) (a_lm + i a_l,-m). For noise that does not couple times, ::

    sum_t w(t) c_lm conj(c'_l'm') = sum_jk beta_j,lm conj(beta'_k,l'm') F_jk(m - m') = P,
    sum_t w(t) c_lm c'_l'm'       = sum_jk beta_j,lm beta'_k,l'm' F_jk(m + m')       = Q,

at each turntable angle. The four parts of the matrix follow from P + Q and P - Q.
Noise that couples times is whitened in order of time, a few rows of A at once. All of this runs in
NumPy, whatever kind of arrays A and N have.
"""

from collections.abc import Callable

import numpy as np
from jaxtyping import Complex, Float, Int

from lusee_bayes.core import checks, harmonics, linalg
from lusee_bayes.core.arrays import ModesMatrix, on_host
from lusee_bayes.instrument.coupling import Coupling, CouplingMatrix, turned_about_pole
from lusee_bayes.noise import covariance, time_blocks

# arrays that recur
Beams = Complex[np.ndarray, "orders groups functions degrees"]

Places = Int[np.ndarray, " modes"]
Sums = Complex[np.ndarray, "q groups functions functions"]
Blocks = Float[np.ndarray, "rows columns"]
# number of times summed at once, which bounds the memory
CHUNK = 512


def time_sums(
    weights: Float[np.ndarray, "weights times"],
    azimuth: Float[np.ndarray, " times"],
    functions: Float[np.ndarray, "times functions"],
    lmax: int,
) -> Complex[np.ndarray, "weights functions functions q"]:
    """Compute F for every pair of functions of time.

    Parameters
    ----------
    weights : (weights, times) array
        w_c(t), in 1/K^2 if they are inverse variances.
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
    sums = np.zeros((weights.shape[0] * len(left), 2 * (2 * lmax + 1)))
    for first in range(0, len(azimuth), CHUNK):
        times = slice(first, first + CHUNK)
        u = functions[times]
        pairs = u[:, left] * u[:, right]
        angle = azimuth[times, None] * np.arange(2.0 * lmax + 1.0)
        phases = np.concatenate([np.cos(angle), np.sin(angle)], axis=1)
        sums += (weights[:, None, times] * pairs.T).reshape(len(sums), -1) @ phases
    cosine, sine = np.split(sums.reshape(weights.shape[0], len(left), -1), 2, axis=-1)
    positive = cosine + 1j * sine
    full = np.concatenate([positive[..., :0:-1].conj(), positive], axis=-1)
    place = np.zeros((n, n), dtype=int)
    place[left, right] = place[right, left] = np.arange(len(left))
    return full[:, place]


def of_one_angle(
    by_order: Float[np.ndarray, "orders beams degrees"],
    weights: Float[np.ndarray, "..."],
    azimuth: Float[np.ndarray, " times"],
    functions: Float[np.ndarray, "functions times"],
    n_products: int,
) -> ModesMatrix:
    """Lower triangle of one angle's part in the mean-pole frame; modes as :func:`places` has them.

    Each order is one block row on and below the diagonal. Only columns of orders up to its own, and
    rows of degrees from it, are computed; the others are mirror images or zero.
    """
    n = by_order.shape[0]
    parts = by_order.reshape(n, n_products, -1, 2, n)
    beams = parts[..., 0, :] + 1j * parts[..., 1, :]
    sums = time_sums(weights.reshape(-1, azimuth.shape[0]), azimuth, functions.T, n - 1)
    f = np.moveaxis(sums.reshape(*weights.shape[:-1], *sums.shape[1:]), -1, 0)
    if weights.ndim == 3:  # products are coupled: treat them like functions
        f, beams = f.swapaxes(2, 3), beams.reshape(n, 1, -1, n)
    f = np.ascontiguousarray(f).reshape(len(f), *beams.shape[1:3], beams.shape[2])
    # degree and order of every mode, and whether it is a_l,-m
    ell, m = (x[harmonics.modes_by_size_of_order(n - 1)] for x in harmonics.mode_numbers(n - 1))
    m, s = np.abs(m), (m < 0).astype(int)
    whole = np.zeros((len(m),) * 2)
    for order in range(n):
        start, stop = np.searchsorted(m, (order, order + 1))
        column = (s * (order + 1) + m) * n + ell
        whole[start:stop, :stop] = _rows_of_order(order, beams, f)[: stop - start, column[:stop]]
    return whole


def places(lmax: int) -> Places:
    """Rows of the packed modes: by increasing ``|m|``, and for each the a_lm before the a_l,-m."""
    return np.argsort(harmonics.modes_by_size_of_order(lmax))


def _rows_of_order(m: int, beams: Beams, f: Sums) -> Blocks:
    """Rows a_lm, then a_l,-m, of one order; columns a_l'm', then a_l',-m', of orders up to it.

    Rows of degrees from ``m``; columns of all degrees, with zeros where there is no mode.
    """
    n, zero = beams.shape[0], len(f) // 2
    beam, others = beams[m][..., m:], beams[: m + 1]
    p = f[zero : zero + m + 1][::-1] @ others.conj()
    q = f[zero + m : zero + 2 * m + 1] @ others
    beam = beam.reshape(-1, beam.shape[-1]).T / 2.0
    # (rows, orders and degrees)
    seen = (beam @ x.reshape(m + 1, -1, n) for x in (p + q, p - q))
    u, v = (x.swapaxes(0, 1).reshape(n - m, -1) for x in seen)
    return np.block([[u.real, -v.imag], [u.imag, v.real]])


def normal_matrix(
    coupling: Coupling, noise: covariance.Covariance, factor: covariance.Factor | None = None
) -> ModesMatrix:
    """Compute A^T N^-1 A, without forming A if it and N have structure in time.

    Exact for the coupling's functions of time. JAX arrays are copied to the host, so that it cannot
    be called inside JAX's transformations. For diagonal noise and blocks in time the cost is nearly
    independent of the number of samples; for time-banded noise it is proportional to that number,
    and the memory is bounded.

    Parameters
    ----------
    coupling : Coupling
        A.
    noise : Covariance
        N, in K^2.
    factor : Factor, optional
        Of N, if it has been computed.

    Returns
    -------
    (modes, modes) array
        In Galactic modes, in 1/K^2; symmetric to the last bit.

    Raises
    ------
    InputError
        If their sizes differ, or N is not positive definite.
    """
    checks.require_shape("N", np.empty((noise.size, 0)), (coupling.shape[0], None))
    factor = noise.factor() if factor is None else factor
    kind = NORMAL_MATRICES[type(noise)] if has_structure(coupling, noise) else _dense
    return kind(*on_host((coupling, noise, factor)))


def has_structure(coupling: Coupling, noise: covariance.Covariance) -> bool:
    """Check whether :func:`normal_matrix` does not form A.

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


def is_within_times(noise: covariance.Covariance) -> bool:
    """Check whether noise couples no two times, except through templates.

    Parameters
    ----------
    noise : Covariance
        N.

    Returns
    -------
    bool
        True for independent noise and blocks in time, with or without templates.
    """
    return NORMAL_MATRICES.get(type(_base(noise))) is _within_times


def _base(noise: covariance.Covariance) -> covariance.Covariance:
    return noise.base if isinstance(noise, covariance.LowRankUpdate) else noise


def _dense(coupling: Coupling, _: covariance.Covariance, factor: covariance.Factor) -> ModesMatrix:
    return linalg.gram_matrix(np.asarray(factor.whiten(coupling.dense())))


# inverses of blocks with a larger collinearity lose digits that whitened data keep
MOST_COLLINEAR = 1e5


def _within_times(
    coupling: CouplingMatrix, noise: covariance.Covariance, factor: covariance.Factor
) -> ModesMatrix:
    if factor.collinearity > MOST_COLLINEAR:
        return _dense(coupling, noise, factor)
    return summed(coupling, noise.time_weights(coupling.layout))


def _with_templates(
    coupling: CouplingMatrix, noise: covariance.LowRankUpdate, factor: covariance.LowRankFactor
) -> ModesMatrix:
    """With N_0 + T T^T: A^T D A - V^T (1 + T^T D T)^-1 V, V = T^T D A, D = N_0^-1."""
    v = coupling.transpose_mv(np.asarray(factor.base.whiten_transpose(factor.v)))
    solved = linalg.solve_lower(factor.lower, v.T, transpose=False)
    return normal_matrix(coupling, noise.base, factor.base) - linalg.gram_matrix(solved)


def summed(coupling: CouplingMatrix, weights: Float[np.ndarray, "..."]) -> ModesMatrix:
    """Compute A^T W A for weights W that do not couple times.

    Parameters
    ----------
    coupling : CouplingMatrix
        A.
    weights : (products, times) or (products, products, times) array
        The diagonal of W, or its block for each time; zero where a sample is missing.

    Returns
    -------
    (modes, modes) array
        In Galactic modes; symmetric to the last bit.
    """
    pointing, total = coupling.pointing, 0.0
    runs, beams, n_products = dict(pointing.runs()), coupling.by_order, coupling.body_beams.shape[1]
    # drop products without weight, e.g. all but the one that is left out
    used = np.flatnonzero(weights.any(axis=-1).reshape(-1, n_products).any(axis=0))
    if len(used) < n_products:
        by_product = beams.reshape(*beams.shape[:2], n_products, -1, beams.shape[3])
        beams = by_product[:, :, used].reshape(*beams.shape[:2], -1, beams.shape[3])
        weights = weights[used] if weights.ndim == 2 else weights[used][:, used]
    # runs of one turntable angle see the sky with the same beams
    angles = np.asarray(pointing.turntable)
    for angle in np.unique(angles[[bool(weights[..., span].any()) for span in runs.values()]]):
        group = np.flatnonzero(angles == angle)
        times = np.concatenate([np.arange(pointing.n_times)[runs[run]] for run in group])
        sums = weights[..., times], pointing.azimuth[times], pointing.functions[times].T
        total = total + of_one_angle(beams[group[0]], *sums, len(used))
    turn = pointing.pole_from_galactic
    return _turned(turn, linalg.mirrored(total), places(len(turn.blocks) - 1))


def _turned(rotation: harmonics.Rotation, matrix: ModesMatrix, place: Places) -> ModesMatrix:
    """R^T M R on and below the diagonal, degree by degree: the operands fit into a cache."""
    turned = np.empty_like(matrix)
    spans = [slice(ell**2, (ell + 1) ** 2) for ell in range(len(rotation.blocks))]
    for ell, (left, span) in enumerate(zip(rotation.blocks, spans, strict=True)):
        rows = left.T @ matrix[place[span]].take(place[: span.stop], axis=1)
        for right, other in zip(rotation.blocks[: ell + 1], spans[: ell + 1], strict=True):
            turned[span, other] = rows[:, other] @ right
    return linalg.mirrored(turned)


# rows of A that enter one product, if N couples times
STREAMED = 1024


def _streamed(
    coupling: CouplingMatrix, _: covariance.Covariance, factor: time_blocks.TimeBandedFactor
) -> ModesMatrix:
    """For time-banded noise: compute, whiten and sum A, one block row of N after the other."""
    pointing, layout = coupling.pointing, coupling.layout
    n_blocks, rows, window = factor.left.shape
    steps, n_modes = rows // layout.n_products, coupling.shape[1]
    present, total = layout.present.T, np.zeros((n_modes, n_modes))
    run_of = np.repeat(np.arange(len(pointing.run_starts) - 1), np.diff(pointing.run_starts))
    # white rows: the window before a block row, and all since the last sum
    white = np.zeros((window, n_modes))
    for block in range(n_blocks):
        times = slice(block * steps, (block + 1) * steps)
        body = coupling.body_beams[run_of[times]]
        beams = np.einsum("tj,tkjc->ktc", pointing.functions[times], body)
        a = turned_about_pole(beams, pointing.azimuth[times]).swapaxes(0, 1)
        a = (a * present[times][:, :, None]).reshape(-1, n_modes)
        a = np.pad(a, ((0, rows - len(a)), (0, 0)))
        solved = factor.inverse[block] @ (a - factor.left[block] @ white[-window:])
        white = np.concatenate([white, solved])
        if len(white) >= window + STREAMED or block == n_blocks - 1:
            total += linalg.gram_matrix(white[window:])
            white = white[-window:]
    return _turned(pointing.pole_from_galactic, total, np.arange(n_modes))


# how A^T N^-1 A is summed for each structure of N in time; those without an entry need A itself
NORMAL_MATRICES: dict[type[covariance.Covariance], Callable[..., ModesMatrix]] = {
    covariance.DiagonalCovariance: _within_times,
    time_blocks.TimeBlockCovariance: _within_times,
    time_blocks.TimeBandedCovariance: _streamed,
    covariance.LowRankUpdate: _with_templates,
}
