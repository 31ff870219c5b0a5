"""Data of a stretch of time: the few functions of time in their rows of A, and their noise.

Within a day the rows of A are combinations of a few smooth functions of time, however many samples
it has, and noise within times couples no two of them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

# what smooth functions of time may miss of any phase exp(i m phi), |m| <= lmax, or tilt
SMOOTH = 1e-12
# stretches of no more times than that are taken as they are
FEW_TIMES = 16


@dataclass(frozen=True)
class Part:
    """Data of a stretch of time that N_0 couples with each other, but with no other data.

    Attributes
    ----------
    where : tuple
        Their places on the grid (products, times).
    columns : slice
        Those of the stretch that they have a part in.
    root : (data,) or (times, products, products) array
        c: of independent data, or of the products of each time.
    functions : (data, columns) array
        U.
    """

    where: tuple
    columns: slice
    root: Float[np.ndarray, "..."]
    functions: Float[np.ndarray, "data columns"]

    def coloured(self, x: Float[np.ndarray, "data columns"], *, transpose: bool = False):
        """c x, or c^T x."""
        if self.root.ndim == 1:
            return self.root[:, None] * x
        by_time = x.reshape(self.root.shape[1], len(self.root), -1).swapaxes(0, 1)
        turned = (self.root.swapaxes(1, 2) if transpose else self.root) @ by_time
        return turned.swapaxes(0, 1).reshape(x.shape)

    def diagonal(self) -> Float[np.ndarray, " data"]:
        """The diagonal of D = c c^T."""
        return self.root**2 if self.root.ndim == 1 else (self.root**2).sum(2).T.ravel()

    def log_det(self) -> float:
        """ln|D| of the data that are there."""
        return _log_det_of_roots(self.root)


def smooth_functions(
    phases: Float[np.ndarray, "times functions"], azimuth: Float[np.ndarray, " times"]
) -> Float[np.ndarray, "times n"]:
    """Find few orthonormal functions of time that make up all of the given ones.

    Parameters
    ----------
    phases : (times, functions) array
        To be made up, to ``SMOOTH``.
    azimuth : (times,) array
        phi(t) in radians, whose polynomials they are; turns of 2 pi do not matter.

    Returns
    -------
    (times, n) array
        The unit matrix where the times are few, or the functions not smooth.
    """
    n_times = len(phases)
    x = np.unwrap(azimuth)
    x = (2.0 * x - x.min() - x.max()) / max(np.ptp(x), 1e-300)
    for n in range(FEW_TIMES, n_times, 4):
        basis = np.linalg.qr(np.polynomial.chebyshev.chebvander(x, n - 1))[0]
        missed = phases - basis @ (basis.T @ phases)
        if np.abs(missed).max() <= SMOOTH * np.abs(phases).max():
            return basis
    return np.eye(n_times)


def weigh(weights: np.ndarray, grid: Float[np.ndarray, "products times n"]) -> np.ndarray:
    """D x, for D of independent data or of the products of each time."""
    if weights.ndim == 2:
        return weights[..., None] * grid
    return np.einsum("kjt,jtn->ktn", weights, grid)


def roots_of_blocks(
    blocks: Float[np.ndarray, "products products times"],
) -> Float[np.ndarray, "times products products"]:
    """Cholesky factors of blocks that are zero where a sample is missing."""
    by_time = np.moveaxis(blocks, 2, 0)
    present = np.diagonal(by_time, axis1=1, axis2=2) > 0
    missing = np.eye(len(blocks)) * ~present[:, None]
    return np.linalg.cholesky(by_time + missing) * present[:, None] * present[:, :, None]


def log_det_of_weights(weights: np.ndarray) -> float:
    """ln|D| of the data that are there, for D as in :func:`weigh`."""
    root = np.sqrt(weights).ravel() if weights.ndim == 2 else roots_of_blocks(weights)
    return _log_det_of_roots(root)


def _log_det_of_roots(root: Float[np.ndarray, "..."]) -> float:
    diagonal = root if root.ndim == 1 else np.diagonal(root, axis1=1, axis2=2)
    return 2.0 * float(np.log(diagonal[diagonal > 0]).sum())
