"""Groups of data against their prediction by all others, with A and N of any kind as matrices.

With N = L L^T and (A S A^T + N)^-1 = L^-T (1 - H^T H) L^-1 (:meth:`Solver.half`), the columns of
L^-1 that belong to a group, E, give K_ss = E^T (1 - H^T H) E and (K^-1 N K^-1)_ss =
E^T (1 - H^T H)^2 E.
"""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int
from scipy.linalg import cho_solve

from lusee_bayes.core.arrays import Array
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.linalg import cholesky
from lusee_bayes.instrument.layout import DataLayout
from lusee_bayes.linear.left_out import LeftOut, Missed, log_det_of
from lusee_bayes.linear.model import LinearGaussian
from lusee_bayes.noise.covariance import Factor

# columns of L^-1 at a time: all groups share one compiled program
COLUMNS = 512


class DenseLeftOut(LeftOut):
    """The model of some data, ready to leave out groups of them.

    Parameters
    ----------
    model : LinearGaussian
        Of any kind.
    data : (data,) array
        In K.
    layout : DataLayout
        The product and the time of every datum.

    Raises
    ------
    InputError
        If the model cannot be factorised; by its methods, if a group is too precise for 64 bits.
    """

    def __init__(self, model: LinearGaussian, data: Float[Array, " data"], layout: DataLayout):
        solver = model.factorise()
        self._factor, self._half, self._layout = solver.factor, solver.half(), layout
        white = solver.surprise(data)
        rest = white - self._half.T @ (self._half @ white)
        self._u = np.asarray(solver.factor.whiten_transpose(rest))
        self._gram = np.asarray(self._half @ self._half.T)
        self.u = layout.scatter(self._u)
        self.inverse_diagonal = np.full(self.u.shape, np.nan)

    def stretch(self, times):
        return self._missed(np.flatnonzero(times[self._layout.time]))

    def together(self, times):
        return self.stretch(times)

    def product(self, number):
        return self._missed(np.flatnonzero(self._layout.product == number))

    def _missed(self, index: Int[np.ndarray, " group"]) -> Missed:
        columns = []
        for first in range(0, len(index), COLUMNS):
            chosen = index[first : first + COLUMNS]
            unit = np.zeros((len(self._u), COLUMNS))
            unit[chosen, np.arange(len(chosen))] = 1.0
            white, inside = _columns(self._factor, self._half, jnp.asarray(unit))
            columns.append(
                (np.asarray(white)[:, : len(chosen)], np.asarray(inside)[:, : len(chosen)])
            )
        white, inside = (np.concatenate(parts, axis=1) for parts in zip(*columns, strict=True))
        block = white.T @ white - inside.T @ inside
        where = (self._layout.product[index], self._layout.time[index])
        self.inverse_diagonal[where] = np.diagonal(block)
        if len(index) == len(self._u):
            # nothing is left that could predict them
            return Missed(np.nan, np.nan, np.nan)
        lower = cholesky(block)
        if not np.isfinite(np.diagonal(lower)).all():
            raise InputError(
                "the data are too precise to tell how a part of them differs from what the others "
                "predict; use fewer data at once"
            )
        root = (lower, True)
        # of noise alone (K^-1 N K^-1)_ss is K_ss less that
        sky = inside.T @ inside - inside.T @ (self._gram @ inside)
        chi2 = self._u[index] @ cho_solve(root, self._u[index])
        return Missed(float(chi2), float(np.trace(cho_solve(root, sky))), log_det_of(lower))


@eqx.filter_jit
def _columns(
    factor: Factor, half: Float[Array, "rank data"], unit: Float[Array, "data columns"]
) -> tuple[Array, Array]:
    """L^-1 and H L^-1 times columns of the unit matrix."""
    white = factor.whiten(unit)
    return white, half @ white
