"""Groups of data against their prediction by all others, with A and N of any kind as matrices.

With N = N_0 + T T^T, F = [A S^(1/2), T] and D = N_0^-1, in blocks of data that N_0 couples (the
products of a time, or all data), K = N_0 + F F^T has ::

    K^-1 = D - Y Q^-1 Y^T,    Y = D F,    Q = 1 + F^T D F,    K^-1 F = Y Q^-1,

so that K_ss = D_ss - Y_s Q^-1 Y_s^T and (K^-1 A S A^T K^-1)_ss come from a few rows. A group of
more data than Q has rows is taken out of Q instead, ::

    K_ss^-1 = D_ss^-1 + D_ss^-1 Y_s (Q - Y_s^T D_ss^-1 Y_s)^-1 Y_s^T D_ss^-1.

What is left without a group has N_0 without it, and so the D of that: nothing is fitted again.
"""

from __future__ import annotations

from copy import copy

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.linalg import LinAlgError, cho_factor, cho_solve, solve_triangular

from lusee_bayes.core.arrays import Array, on_host
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.linalg import cholesky, inverse_from_cholesky, solve_lower
from lusee_bayes.instrument.layout import DataLayout
from lusee_bayes.linear.left_out import LeftOut, Missed, log_det_of
from lusee_bayes.linear.model import LinearGaussian
from lusee_bayes.noise.covariance import Covariance, LowRankUpdate

# of a group that cannot be compared with all others
NOT_TOLD = Missed(np.nan, np.nan, np.nan)
# steps that refine Q^-1 Y^T d, which loses what the normal equations lose
REFINEMENTS = 2


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
        If the model cannot be factorised.
    """

    def __init__(self, model: LinearGaussian, data: Float[Array, " data"], layout: DataLayout):
        model = on_host(model)
        self.layout = layout
        self._blocks, templates = _blocks(model.noise, layout)
        sky = np.asarray(model.prior.colour_columns(model.coupling.dense()))
        self._rows, self._n_sky = np.concatenate([sky, templates], axis=1), sky.shape[1]
        mean, offset = model.prior.white_mean, model.offset
        self._rest = np.asarray(data) - (0.0 if offset is None else offset)
        self._rest = self._rest - (0.0 if mean is None else sky @ mean)
        self._solve()

    def without(self, gone: Bool[np.ndarray, "products times"]) -> DenseLeftOut:
        """Take out data for good.

        Parameters
        ----------
        gone : (products, times) array of bool
        """
        keep = ~gone[self.layout.product, self.layout.time]
        number = np.cumsum(keep) - 1
        left = copy(self)
        left.layout = DataLayout.from_flags(~np.asarray(self.layout.present) | gone)
        left._rows, left._rest = self._rows[keep], self._rest[keep]
        left._blocks = []
        for index, weights in self._blocks:
            here = keep[index]
            inside = weights[np.ix_(here, here)]
            if not here.all():
                between = weights[np.ix_(~here, here)]
                across = np.linalg.solve(weights[np.ix_(~here, ~here)], between)
                inside = inside - between.T @ across
            if here.any():
                left._blocks.append((number[index[here]], inside))
        left._solve()
        return left

    def _solve(self) -> None:
        """Y, Q, u and what each datum needs of them."""
        n, rank = self._rows.shape
        self._weighted, self._block, self._place = np.empty((n, rank)), *np.empty((2, n), dtype=int)
        diagonal = np.empty(n)
        for number, (index, weights) in enumerate(self._blocks):
            self._weighted[index] = weights @ self._rows[index]
            self._block[index], self._place[index] = number, np.arange(len(index))
            diagonal[index] = np.diagonal(weights)
        self._normal = self._rows.T @ self._weighted
        self._normal[np.diag_indices(rank)] += 1.0
        self._lower = cholesky(self._normal)
        if not np.isfinite(np.diagonal(self._lower)).all():
            raise InputError(
                "the data are too precise to tell how a part of them differs from what the others "
                "predict; use fewer data at once"
            )
        self._half = solve_lower(self._lower, self._weighted.T, transpose=False)
        self._sky = solve_lower(self._lower, self._half, transpose=True)[: self._n_sky]
        z = np.zeros(rank)
        for _ in range(1 + REFINEMENTS):
            step = self._weighted.T @ (self._rest - self._rows @ z) - z
            z += cho_solve((self._lower, True), step)
        self._u = np.empty(n)
        misfit = self._rest - self._rows @ z
        for index, weights in self._blocks:
            self._u[index] = weights @ misfit[index]
        self.u = self.layout.scatter(self._u)
        spread = diagonal - (self._half**2).sum(axis=0)
        self.inverse_diagonal = self.layout.scatter(np.where(spread > 0.0, spread, np.nan))

    def stretch(self, times):
        return self._missed(np.flatnonzero(times[self.layout.time]))

    def together(self, times):
        return self.stretch(times)

    def product(self, number):
        return self._missed(np.flatnonzero(self.layout.product == number))

    def _inside(self, index: Int[np.ndarray, " group"]) -> list[tuple[np.ndarray, np.ndarray]]:
        """D_ss: places in a group, and the block of each."""
        found = []
        block, place = self._block[index], self._place[index]
        for number in np.unique(block).tolist():
            here = np.flatnonzero(block == number)
            found.append((here, self._blocks[number][1][np.ix_(place[here], place[here])]))
        return found

    def _missed(self, index: Int[np.ndarray, " group"]) -> Missed:
        if len(index) == len(self._u):
            # nothing is left that could predict them
            return NOT_TOLD
        try:
            if len(index) <= len(self._normal):
                return self._among_data(index)
            return self._taken_out(index)
        except LinAlgError:
            # all others know so little, and these so much, that 64 bits do not tell it from nothing
            return NOT_TOLD

    def _among_data(self, index: Int[np.ndarray, " group"]) -> Missed:
        half, sky, u = self._half[:, index], self._sky[:, index].T, self._u[index]
        block = -half.T @ half
        for here, weights in self._inside(index):
            block[np.ix_(here, here)] += weights
        root = cho_factor(block, lower=True)
        directions = (sky * cho_solve(root, sky)).sum()
        return Missed(float(u @ cho_solve(root, u)), float(directions), log_det_of(root[0]))

    def _taken_out(self, index: Int[np.ndarray, " group"]) -> Missed:
        white, u, log_det = self._weighted[index], self._u[index].copy(), 0.0
        for here, weights in self._inside(index):
            lower = np.linalg.cholesky(weights)
            white[here] = solve_triangular(lower, white[here], lower=True)
            u[here] = solve_triangular(lower, u[here], lower=True)
            log_det += log_det_of(lower)
        root = cho_factor(self._normal - white.T @ white, lower=True)
        h = white.T @ u
        chi2 = u @ u + h @ cho_solve(root, h)
        without, within = (
            np.diagonal(inverse_from_cholesky(np.tril(lower)))[: self._n_sky].sum()
            for lower in (root[0], self._lower)
        )
        log_det += log_det_of(root[0]) - log_det_of(self._lower)
        return Missed(float(chi2), float(without - within), log_det)


def _blocks(
    noise: Covariance, layout: DataLayout
) -> tuple[list[tuple[np.ndarray, np.ndarray]], Float[np.ndarray, "data templates"]]:
    """D in blocks, each with its data, and T; all data in one block where N couples times."""
    base, templates = noise, np.zeros((noise.size, 0))
    if isinstance(base, LowRankUpdate):
        base, templates = base.base, np.asarray(base.update.root)
    weights = base.time_weights(layout)
    if weights is None:
        root = cho_factor(np.asarray(noise.dense()), lower=True)
        whole = cho_solve(root, np.eye(noise.size))
        return [(np.arange(noise.size), whole)], np.zeros((noise.size, 0))
    weights, found = np.asarray(weights), []
    order = np.argsort(layout.time, kind="stable")
    for index in np.split(order, np.flatnonzero(np.diff(layout.time[order])) + 1):
        product, time = layout.product[index], layout.time[index[0]]
        here = weights[..., time]
        here = np.diag(here) if here.ndim == 1 else here
        found.append((index, here[np.ix_(product, product)]))
    return found, templates
