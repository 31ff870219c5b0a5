"""A^T N^-1 A without A: from the beams and Fourier sums over time.

With c_lm(t) = sum_j u_j(t) beta_j,lm exp(i m phi(t)), beta_lm = W_lm + i W_l,-m (coupling.py), a
visibility is Re sum_m conj(c_lm) (a_lm + i a_l,-m), and for noise that does not couple times ::

    sum_t w(t) c_lm conj(c'_l'm') = sum_jk beta_j,lm conj(beta'_k,l'm') F_jk(m - m') = P,
    sum_t w(t) c_lm c'_l'm'       = sum_jk beta_j,lm beta'_k,l'm' F_jk(m + m')       = Q,

with F the sums of :mod:`time_sums`. The four parts of the matrix follow from P + Q and P - Q.
Noise that couples different times is whitened in order of time, a few rows of A at once.
"""

from __future__ import annotations

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from lusee_bayes.core.arrays import Array, compiled, namespace
from lusee_bayes.core.checks import is_traced, require_shape
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.harmonics import Rotation
from lusee_bayes.core.linalg import checked_cholesky, gram_matrix, mirrored, solve_lower
from lusee_bayes.instrument.coupling import Coupling, CouplingMatrix, turned_about_pole
from lusee_bayes.linear.one_angle import of_one_angle, places
from lusee_bayes.linear.time_sums import CHUNK
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
    xp, pointing = namespace(coupling, weights), coupling.pointing
    runs, total = dict(pointing.runs()), 0.0
    for group in _turntable_groups(coupling, weights):
        spans = [runs[run] for run in group]
        here = [
            xp.concatenate([x[..., span] for span in spans], axis=-1)
            for x in (weights, pointing.azimuth, pointing.functions.T)
        ]
        missing = -here[1].shape[0] % CHUNK
        padded = [xp.pad(x, ((0, 0),) * (x.ndim - 1) + ((0, missing),)) for x in here]
        part = of_one_angle(coupling.by_order[group[0]], *padded, coupling.body_beams.shape[1])
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
    pole_from_galactic: Rotation,
    lower: Float[Array, "modes modes"],
    place: Int[Array, " modes"],
) -> Float[Array, "modes modes"]:
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
    rotation: Rotation, matrix: Float[np.ndarray, "modes modes"], place: Int[np.ndarray, " modes"]
) -> Float[np.ndarray, "modes modes"]:
    """R^T M R degree by degree, on and below the diagonal: what is worked on fits into a cache."""
    turned = np.empty_like(matrix)
    spans = [slice(ell**2, (ell + 1) ** 2) for ell in range(len(rotation.blocks))]
    for ell, (left, here) in enumerate(zip(rotation.blocks, spans, strict=True)):
        rows = left.T @ matrix[place[here]].take(place[: here.stop], axis=1)
        for right, there in zip(rotation.blocks[: ell + 1], spans[: ell + 1], strict=True):
            turned[here, there] = rows[:, there] @ right
    return mirrored(turned)


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
