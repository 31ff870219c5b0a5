"""A^T N^-1 A without A: from the beams and Fourier sums over time.

With c_lm(t) = sum_p e_p(t) beta_p,lm exp(i m phi(t)), beta_lm = W_lm + i W_l,-m (coupling.py), a
visibility is Re sum_m conj(c_lm) (a_lm + i a_l,-m), and for noise that does not couple times ::

    sum_t w(t) c_lm conj(c'_l'm') = sum_pp' beta_p,lm conj(beta'_p',l'm') F_pp'(m - m') = P,
    sum_t w(t) c_lm c'_l'm'       = sum_pp' beta_p,lm beta'_p',l'm' F_pp'(m + m')       = Q,

with F the sums of :mod:`time_sums`. The four parts of the matrix follow from P + Q and P - Q.
Noise that couples different times is whitened in order of time, a few rows of A at once.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Complex, Float

from lusee_bayes.core.arrays import Array
from lusee_bayes.core.checks import require_shape
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.linalg import N_BLOCKS, checked_cholesky, gram_matrix, solve_lower
from lusee_bayes.core.rotations import Rotation
from lusee_bayes.instrument.coupling import Coupling, CouplingMatrix, turned_about_pole
from lusee_bayes.linear.time_sums import time_sums
from lusee_bayes.noise.covariance import (
    Covariance,
    DiagonalCovariance,
    LowRankUpdate,
    TimeBandedCovariance,
    TimeBlockCovariance,
)
from lusee_bayes.noise.covariance.time_banded import TimeBandedFactor


def normal_matrix(coupling: Coupling, noise: Covariance) -> Float[Array, "modes modes"]:
    """Compute A^T N^-1 A without forming A.

    Exact for the coupling's own order of the tilt. For diagonal noise and blocks in time the cost
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
    base = noise.base if isinstance(noise, LowRankUpdate) else noise
    return coupling.has_time_structure and type(base) in NORMAL_MATRICES


def _within_times(coupling: CouplingMatrix, noise: Covariance) -> Array:
    return summed(coupling, noise.time_weights(coupling.layout))


def _with_templates(coupling: CouplingMatrix, noise: LowRankUpdate) -> Array:
    """With N_0 + T T^T: A^T D A - V^T (1 + T^T D T)^-1 V, V = T^T D A, D = N_0^-1."""
    base = noise.base.factor()
    weighted = base.solve(noise.update.root)
    v = jnp.stack([coupling.transpose_mv(column) for column in weighted.T])
    small = jnp.eye(v.shape[0]) + noise.update.root.T @ weighted
    lower = checked_cholesky(f"1 + T^T D T of {noise.update.name}", small)
    return normal_matrix(coupling, noise.base) - gram_matrix(solve_lower(lower, v, transpose=False))


def _of_bands(coupling: CouplingMatrix, noise: TimeBandedCovariance) -> Array:
    return _streamed(coupling, noise.factor())


# how A^T N^-1 A is summed for each structure of N in time; those without an entry need A itself
NORMAL_MATRICES: dict[type[Covariance], Callable[..., Array]] = {
    DiagonalCovariance: _within_times,
    TimeBlockCovariance: _within_times,
    TimeBandedCovariance: _of_bands,
    LowRankUpdate: _with_templates,
}


def summed(coupling: CouplingMatrix, weights: Float[Array, "..."]) -> Float[Array, "modes modes"]:
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
    return _summed(coupling, weights, _turntable_groups(coupling))


def _turntable_groups(coupling: CouplingMatrix) -> tuple[tuple[int, ...], ...]:
    """Runs of one turntable angle: they see the sky with the same beams."""
    angles = np.asarray(coupling.pointing.turntable)
    return tuple(tuple(np.flatnonzero(angles == a).tolist()) for a in np.unique(angles))


@eqx.filter_jit
def _summed(
    coupling: CouplingMatrix, weights: Array, groups: tuple[tuple[int, ...], ...]
) -> Float[Array, "modes modes"]:
    """For noise within times; weights: (products, times), or (products, products, times)."""
    pointing, n = coupling.pointing, coupling.lmax + 1
    runs = dict(pointing.runs())
    n_products, n_powers = coupling.body_beams.shape[1:3]
    betas, sums = [], []
    for group in groups:
        spans = [runs[run] for run in group]
        beams = coupling.by_order[group[0]].reshape(n, n_products, n_powers, 2 * n)
        betas.append(jax.lax.complex(beams[..., :n], beams[..., n:]))
        flat = jnp.concatenate([weights[..., span] for span in spans], axis=-1)
        azimuth = jnp.concatenate([pointing.azimuth[span] for span in spans])
        tilt = jnp.concatenate([pointing.tilt[span] for span in spans])
        flat = flat.reshape(-1, azimuth.shape[0])
        f = time_sums(flat, azimuth, tilt, pointing.order, coupling.lmax)
        sums.append(f.reshape(*weights.shape[:-1], *f.shape[1:]))
    return _to_galactic(pointing.pole_from_galactic, _from_sums(betas, sums))


def _from_sums(betas: list[Array], sums: list[Array]) -> Float[Array, "modes modes"]:
    """The matrix in the mean-pole frame, one strip of orders after the other.

    betas : (orders, products, powers, degrees) of each group of runs; sums : F of each. Only
    columns of orders up to the strip's own last one are computed; the others are mirror images.
    """
    n = betas[0].shape[0]
    # by growing order m: a_lm, l = m..lmax, then a_l,-m
    modes = [(m, s, ell) for m in range(n) for s in ((0, 1) if m else (0,)) for ell in range(m, n)]
    m, s, ell = np.array(modes).T
    strips = []
    for first, end in pairwise(np.linspace(0, n, N_BLOCKS + 1).astype(int).tolist()):
        if first == end:
            continue
        columns = m < end
        column = (s * end * n + m * n + ell)[columns]
        _, rows = jax.lax.scan(
            lambda _, order, end=end, column=column: (
                None,
                _rows_of_order(order, betas, sums, end)[:, column],
            ),
            None,
            jnp.arange(first, end),
        )
        inside = columns & (m >= first)
        row = ((m - first) * 2 * n + s * n + ell)[inside]
        strip = rows.reshape(-1, rows.shape[-1])[row]
        strips.append(jnp.pad(strip, ((0, 0), (0, len(modes) - strip.shape[1]))))
    lower = jnp.tril(jnp.concatenate(strips))
    whole = lower + jnp.tril(lower, -1).T
    packed = np.argsort(ell * (ell + 1) + np.where(s == 0, m, -m))
    return whole[packed][:, packed]


def _rows_of_order(
    m: Array, betas: list[Array], sums: list[Array], end: int
) -> Float[Array, "rows columns"]:
    """Rows a_lm, then a_l,-m, of one order; columns a_l'm', then a_l',-m', of orders below end."""
    n = betas[0].shape[0]
    others = jnp.arange(end)
    plus, minus, left = [], [], []
    for beta, f in zip(betas, sums, strict=True):
        p = _weighted(jnp.take(f, m - others + 2 * (n - 1), axis=-1), beta[:end].conj())
        q = _weighted(jnp.take(f, m + others + 2 * (n - 1), axis=-1), beta[:end])
        plus.append(((p + q) / 2.0).reshape(-1, end * n))
        minus.append(((p - q) / 2.0).reshape(-1, end * n))
        left.append(beta[m].reshape(-1, n))
    b = jnp.concatenate(left)
    # real and imaginary parts of b^T u by products of real matrices
    both = jnp.concatenate(
        [jnp.concatenate([b.real.T, b.imag.T], 1), jnp.concatenate([b.imag.T, -b.real.T], 1)]
    )
    u, v = (both @ jnp.concatenate([x.real, -x.imag]) for x in map(jnp.concatenate, (plus, minus)))
    return jnp.concatenate(
        [jnp.concatenate([u[:n], -v[n:]], 1), jnp.concatenate([u[n:], v[:n]], 1)]
    )


def _weighted(
    f: Complex[Array, "..."], beta: Complex[Array, "orders products powers degrees"]
) -> Complex[Array, "products powers orders degrees"]:
    """sum over the other beam of F times its coefficients, order by order."""
    if f.ndim == 4:  # products do not mix
        return jnp.einsum("kpqm,mkql->kpml", f, beta)
    return jnp.einsum("kjpqm,mjql->kpml", f, beta)


def _to_galactic(
    pole_from_galactic: Rotation, matrix: Float[Array, "modes modes"]
) -> Float[Array, "modes modes"]:
    """R^T M R, symmetric to the last bit."""
    back = pole_from_galactic.T
    turned = back(back(matrix).T)
    return (turned + turned.T) / 2.0


@eqx.filter_jit
def _streamed(coupling: CouplingMatrix, factor: TimeBandedFactor) -> Float[Array, "modes modes"]:
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
        left, inverse, e, phi, run, present = block
        beams = coupling.body_beams[run]
        tilted = jnp.einsum("tp,tkpc->ktc", e, beams)
        a = jnp.swapaxes(turned_about_pole(tilted, phi), 0, 1) * present[:, :, None]
        white = inverse @ (a.reshape(rows, n_modes) - left @ before)
        return (jnp.concatenate([before[rows:], white]), total + gram_matrix(white)), None

    present = layout.present.T.astype(jnp.float64)
    parts = (
        factor.left,
        factor.inverse,
        *map(blocked, (pointing.tilt_factors(), pointing.azimuth, run_of, present)),
    )
    start = (jnp.zeros((window, n_modes)), jnp.zeros((n_modes, n_modes)))
    (_, total), _ = jax.lax.scan(add, start, parts)
    return _to_galactic(pointing.pole_from_galactic, total)
