"""Groups of data against their prediction by all others.

With K = A S A^T + N the covariance of data under the model and u = K^-1 (d - E[d]), a group s
differs from its prediction by K_ss^-1 u_s, K_ss being a block of K^-1, and ::

    chi^2_s = u_s^T K_ss^-1 u_s,
    ln p(d_s | all others) = 1/2 [ln|K_ss| - chi^2_s - n_s ln 2 pi].

Of noise alone its mean is tr K_ss^-1 (K^-1 N K^-1)_ss. Under a wide prior that is the number of
data, less one for every direction of the sky that only this group measures.

*Matrices*, for A and N of any kind: with N = N_0 + T T^T, F = [A S^(1/2), T] and D = N_0^-1, in
blocks of data that N_0 couples (the products of a time, or all data), K = N_0 + F F^T has ::

    K^-1 = D - Y Q^-1 Y^T,    Y = D F,    Q = 1 + F^T D F,    K^-1 F = Y Q^-1,

so that K_ss = D_ss - Y_s Q^-1 Y_s^T and (K^-1 A S A^T K^-1)_ss come from a few rows. A group of
more data than Q has rows is taken out of Q instead, ::

    K_ss^-1 = D_ss^-1 + D_ss^-1 Y_s (Q - Y_s^T D_ss^-1 Y_s)^-1 Y_s^T D_ss^-1.

What is left without a group has N_0 without it, and so the D of that: nothing is fitted again.

*Structure in time*: within a day the rows of A are combinations of a few smooth functions of time,
however many samples it has, and noise within times couples no two of them.

Groups of data against their prediction by all others, through the structure of A.

With K = A S A^T + N the covariance of data under the model and u = K^-1 d = N^-1 (d - A mean), a
group s differs from its prediction by K_ss^-1 u_s, K_ss being a block of K^-1. For noise
N = N_0 + T T^T, with N_0 within times and T some templates, put their amplitudes beside the modes:
A' = [A, T], C' the posterior covariance of both. With D = (N_0^-1)_ss ::

    K_ss = D - D A' C' A'^T D,    chi^2_s = u_s^T K_ss^-1 u_s.

The rows of a stretch of time are A = U R: a few smooth functions U of time for every product. With
D = c c^T, c^T U = Q B (QR), W = C'^(T/2) R^T B^T and the whitened w = c^-1 u ::

    chi^2_s = |w|^2 - |b|^2 + b^T (1 - W^T W)^-1 b,    b = Q^T w,    |K_ss| = |D| |1 - W^T W|,

and a datum's own entry of K_ss comes from the same Q and W. A product, or all data of a turntable
angle, have more data than there are modes; they are taken out of the normal matrix instead, ::

    chi^2_s = |w|^2 + h^T (C'^-1 - A'^T D A')^-1 h,    h = A'^T u_s,
    |K_ss| = |D| |C'^-1 - A'^T D A'| |C'|.

For a long run nothing of the size data x modes is formed.

Without the group the covariance of the modes grows from C to C_w, and the trace of that, in white
coordinates, is the number of directions that only the group measures (:mod:`.left_out`). It is
told by z^T (C_w - C) z of some random z with entries +-1.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from copy import copy
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.linalg import LinAlgError, cho_factor, cho_solve, solve_triangular

from lusee_bayes.core.arrays import DataVector, Grid, GridFlags, Square, TimeFlags, Vector, on_host
from lusee_bayes.core.engine import once
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.harmonics import mode_numbers
from lusee_bayes.core.linalg import cholesky, inverse_from_cholesky, solve_lower
from lusee_bayes.instrument.coupling import CouplingMatrix, turned_about_pole
from lusee_bayes.instrument.products import DataLayout
from lusee_bayes.linear.linear_gaussian import LinearGaussian
from lusee_bayes.linear.normal_matrix import summed
from lusee_bayes.linear.posterior import Posterior
from lusee_bayes.noise.covariance import Covariance, LowRankUpdate

# arrays that recur
Functions = Float[np.ndarray, "times n"]
TimeIndex = Int[np.ndarray, " times"]


class Missed(NamedTuple):
    """How a group differs from its prediction.

    Attributes
    ----------
    chi2 : float
        chi^2_s.
    directions : float
        By how much its mean is below the number of data, if there is noise alone.
    log_det : float
        ln|K_ss|, with K_ss in 1/K^2: large where the others predict the group well.
    """

    chi2: float
    directions: float
    log_det: float

    def log_density(self, n: int) -> float:
        """Compute ln p(d_s | all others) of a group of ``n`` data in K."""
        return 0.5 * (self.log_det - self.chi2 - n * float(np.log(2.0 * np.pi)))


class LeftOut(ABC):
    """A model and its data, ready to leave out groups of them.

    Attributes
    ----------
    u : (products, times) array
        K^-1 (d - E[d]), in 1/K; zero where a sample is missing.
    inverse_diagonal : (products, times) array
        The diagonal of K^-1, in 1/K^2, of the data that :meth:`stretch` has left out; else NaN.
    """

    u: Grid
    inverse_diagonal: Grid

    @abstractmethod
    def stretch(self, times: TimeFlags) -> Missed:
        """Leave out all data of a stretch of time, such as a day."""

    @abstractmethod
    def together(self, times: TimeFlags) -> Missed:
        """Leave out a large part of all data, such as those at one turntable angle."""

    @abstractmethod
    def product(self, number: int) -> Missed:
        """Leave out all data of one product."""


def log_det_of(root: Square) -> float:
    """ln|M| of a matrix with this Cholesky factor; entries off the diagonal are not read."""
    return 2.0 * float(np.log(np.diagonal(root)).sum())


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

    def __init__(self, model: LinearGaussian, data: DataVector, layout: DataLayout):
        model = on_host(model)
        self.layout = layout
        self._blocks, templates = _blocks(model.noise, layout)
        sky = np.asarray(model.prior.colour_columns(model.coupling.dense()))
        self._rows, self._n_sky = np.concatenate([sky, templates], axis=1), sky.shape[1]
        mean, offset = model.prior.white_mean, model.offset
        self._rest = np.asarray(data) - (0.0 if offset is None else offset)
        self._rest = self._rest - (0.0 if mean is None else sky @ mean)
        self._solve()

    def without(self, gone: GridFlags) -> DenseLeftOut:
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


def base_and_templates(noise: Covariance) -> tuple[Covariance, Float[np.ndarray, "data templates"]]:
    """N_0 and T of N = N_0 + T T^T; T has no columns where N is not of this form."""
    if isinstance(noise, LowRankUpdate):
        return noise.base, np.asarray(noise.update.root)
    return noise, np.zeros((noise.size, 0))


def _blocks(
    noise: Covariance, layout: DataLayout
) -> tuple[list[tuple[np.ndarray, np.ndarray]], Float[np.ndarray, "data templates"]]:
    """D in blocks, each with its data, and T; all data in one block where N couples times."""
    base, templates = base_and_templates(noise)
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

    def diagonal(self) -> DataVector:
        """The diagonal of D = c c^T."""
        return self.root**2 if self.root.ndim == 1 else (self.root**2).sum(2).T.ravel()


def smooth_functions(
    phases: Float[np.ndarray, "times functions"], azimuth: Float[np.ndarray, " times"]
) -> Functions:
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


def _root_of_weights(weights: np.ndarray) -> np.ndarray:
    """c of D = c c^T, for D as in :func:`weigh`; zero where a sample is missing."""
    if weights.ndim == 2:
        return np.sqrt(weights).ravel()
    by_time = np.moveaxis(weights, 2, 0)
    present = np.diagonal(by_time, axis1=1, axis2=2) > 0
    missing = np.eye(len(weights)) * ~present[:, None]
    return np.linalg.cholesky(by_time + missing) * present[:, None] * present[:, :, None]


def _log_det_of_roots(root: Float[np.ndarray, "..."]) -> float:
    diagonal = root if root.ndim == 1 else np.diagonal(root, axis1=1, axis2=2)
    return 2.0 * float(np.log(diagonal[diagonal > 0]).sum())


# C^(1/2) A^T is kept up to this size (a month at lmax 47: 0.1 GB); it is made by so many times
KEPT_BYTES, CHUNK = 2.5e8, 64
# random directions for traces: a trace t is then good to sqrt(2 t / 200), at most a tenth of the
# scatter of chi^2_s
PROBES = 200


class StructuredLeftOut(LeftOut):
    """The model of some data, ready to leave out groups of them.

    Parameters
    ----------
    model : LinearGaussian
        With structure in time, noise within times (and templates), and a prior over modes.
    posterior : Posterior
        Of these data, through the normal matrix.
    data : (data,) array
        In K.

    """

    def __init__(self, model: LinearGaussian, posterior: Posterior, data: DataVector):
        model, posterior = on_host(model), on_host(posterior)
        base, templates = base_and_templates(model.noise)
        self._coupling = model.coupling
        shape = self._coupling.layout.n_products, self._coupling.layout.n_times
        self._complete = replace(self._coupling, layout=DataLayout(*shape))
        self._prior = model.prior
        self._lower = posterior.lower
        scatter = self._coupling.layout.scatter
        u = np.asarray(model.noise.solve(np.asarray(data) - model.predict(posterior.mean)))
        self.u = scatter(u)
        self.inverse_diagonal = np.full(self.u.shape, np.nan)
        # D, N_0 u and T on the full grid, zero where a sample is missing
        self._weights = np.asarray(base.time_weights(self._coupling.layout))
        self._y = scatter(np.asarray(base.mv(u)))
        self._t = scatter(templates)
        # q with q q^T = 1 + T^T D T, and V = T^T D A in white coordinates
        weighted = weigh(self._weights, self._t)
        n = templates.shape[1]
        self._q = np.linalg.cholesky(np.eye(n) + np.einsum("kta,ktb->ab", weighted, self._t))
        self._v = self._pulled(self._complete, weighted)
        # C'^(1/2) of every amplitude
        across = cho_solve((self._q, True), self._v)
        signs = np.random.default_rng(0).integers(0, 2, (len(self._lower), PROBES))
        self._probes = np.pad(2.0 * signs - 1.0, ((0, n), (0, 0)))
        # C'^(1/2) of the random directions, whose amplitudes are zero
        self._probed = self._probes.copy()
        self._probed[: len(signs)] = solve_lower(self._lower, 2.0 * signs - 1.0, transpose=False)
        of_sky = solve_lower(self._lower, across.T, transpose=False)
        own = solve_lower(self._q, np.eye(n), transpose=False)
        self._amplitudes = np.concatenate([-of_sky, own])

    def stretch(self, times):
        outside, log_det, inside, halves = 0.0, 0.0, [], []
        for run, span in self._coupling.pointing.runs():
            here = np.flatnonzero(times[span]) + span.start
            if not here.size:
                continue
            functions = smooth_functions(self._phases(here), self._coupling.pointing.azimuth[here])
            half = self._half(self._modes(run, here, functions))
            for part in self._parts(here, functions):
                q, b = np.linalg.qr(part.coloured(part.functions, transpose=True))
                w = half[:, part.columns] @ b.T
                white = part.coloured(self._y[part.where].reshape(-1, 1), transpose=True)[:, 0]
                halves.append(w)
                inside.append(q.T @ white)
                outside += white @ white - inside[-1] @ inside[-1]
                log_det += _log_det_of_roots(part.root)
                seen = part.coloured(q)
                left = part.diagonal() - ((seen @ (w.T @ w)) * seen).sum(1)
                self.inverse_diagonal[part.where] = left.reshape(self.u[part.where].shape)
        half, b = np.concatenate(halves, axis=1), np.concatenate(inside)
        return self._between(half, b, outside, log_det)

    def together(self, times):
        squared = float((self.u * self._y)[:, times].sum())
        every = np.ones(len(self.u), dtype=bool)
        log_det = _log_det_of_roots(_root_of_weights(self._weights[..., times]))
        return self._taken_out(self._weights * times, self.u * times, every, squared, log_det)

    def product(self, number):
        own, mixing = self._weights[number], np.zeros(self.u.shape)
        if self._weights.ndim == 2:
            mixing[number] = own > 0
        else:
            own = self._weights[number, number]
            np.divide(self._weights[number], own, out=mixing, where=own > 0)
        here = own > 0
        white = np.divide(self.u[number], np.sqrt(own), out=np.zeros(len(own)), where=here)
        log_det = float(np.log(own[here]).sum())
        if here.sum() > self._prior.size // 2:
            weights = mixing * own
            if self._weights.ndim == 3:
                weights = mixing[:, None] * mixing[None] * own
            used = mixing.any(axis=1)
            pull, squared = mixing * self.u[number], float(white @ white)
            return self._taken_out(weights, pull, used, squared, log_det)
        half = self._half(self._mixed(mixing))[:, : self.u.shape[1]]
        half = half + self._amplitudes @ np.einsum("jt,jta->at", mixing, self._t)
        return self._between((half * np.sqrt(own))[:, here], white[here], 0.0, log_det)

    def _mixed(self, mixing: Grid) -> np.ndarray:
        """C^(1/2) of the products' rows of every time, added with these factors."""
        if self._kept is not None:
            return np.einsum("jt,jtm->mt", mixing, self._kept, optimize=True)
        rows = []
        for run, span in self._coupling.pointing.runs():
            factors = self._coupling.pointing.functions[span]
            used = np.flatnonzero(mixing[:, span].any(1))
            beams = self._coupling.body_beams[run][used]
            each = mixing[used][:, span].T[:, :, None] * factors[:, None]
            tilted = each.reshape(len(each), -1) @ beams.reshape(-1, beams.shape[-1])
            turned = turned_about_pole(tilted[None], self._coupling.pointing.azimuth[span])[0]
            rows.append(self._coupling.pointing.pole_from_galactic.T(turned))
        return self._whitened(np.concatenate(rows))

    @once
    def _kept(self) -> Float[np.ndarray, "products times modes"] | None:
        """C^(1/2) of the row of every datum, which days and products share; None if it is large."""
        n_modes = self._prior.size
        if 8 * self.u.size * n_modes > KEPT_BYTES:
            return None
        kept = np.empty((*self.u.shape, n_modes))
        for run, span in self._coupling.pointing.runs():
            for first in range(span.start, span.stop, CHUNK):
                end = min(first + CHUNK, span.stop)
                rows = self._rows(run, np.arange(first, end), np.eye(end - first))
                kept[:, first:end] = self._whitened(rows).T.reshape(len(kept), -1, n_modes)
        return kept

    def _modes(
        self, run: int, here: TimeIndex, functions: Functions
    ) -> Float[np.ndarray, "modes columns"]:
        """C^(1/2) of the rows of functions of time, for every product."""
        if len(here) == functions.shape[1] and self._kept is not None:
            return self._kept[:, here].reshape(-1, self._prior.size).T
        return self._whitened(self._rows(run, here, functions))

    def _phases(self, here: TimeIndex) -> Float[np.ndarray, "times functions"]:
        """cos and sin of m phi(t) times every function of time: all that A knows of time."""
        factors = self._coupling.pointing.functions[here]
        angle = self._coupling.pointing.azimuth[here, None] * np.arange(self._coupling.lmax + 1.0)
        waves = np.concatenate([np.cos(angle), np.sin(angle)], axis=1)
        return (factors[:, :, None] * waves[:, None]).reshape(len(here), -1)

    def _rows(
        self, run: int, here: TimeIndex, functions: Functions
    ) -> Float[np.ndarray, "rows modes"]:
        """R: for every product U^T A, whose rows are combinations of those of A."""
        coupling, n = self._coupling, self._coupling.lmax + 1
        ell, m = mode_numbers(coupling.lmax)
        n_products, n_functions = coupling.body_beams.shape[1:3]
        phases = (functions.T @ self._phases(here)).reshape(-1, n_functions, 2, n)
        cosine, sine = phases.transpose(2, 3, 1, 0)  # (orders, functions of A, functions)
        # by order: W_lm, and W_l,-m, of every product and degree
        beams = coupling.by_order[run].reshape(n, n_products, n_functions, 2 * n).swapaxes(2, 3)
        plus, minus = beams[:, :, :n], beams[:, :, n:]
        cosine, sine = cosine[:, None], sine[:, None]
        even = plus @ cosine - minus @ sine
        odd = minus @ cosine + plus @ sine
        order = np.abs(m)
        packed = np.where((m >= 0)[:, None, None], even[order, :, ell], odd[order, :, ell])
        rows = packed.transpose(1, 2, 0).reshape(-1, len(m))
        return coupling.pointing.pole_from_galactic.T(rows)

    def _parts(self, here: TimeIndex, functions: Functions) -> list[Part]:
        n_products, n = len(self.u), functions.shape[1]
        weights = self._weights[..., here]
        if weights.ndim == 2 and not len(self._q):
            return [
                Part((k, here), slice(k * n, (k + 1) * n), np.sqrt(weights[k]), functions)
                for k in range(n_products)
            ]
        root = _root_of_weights(weights)
        every = np.kron(np.eye(n_products), functions)
        amplitudes = self._t[:, here].reshape(len(every), -1)
        where = np.ix_(np.arange(n_products), here)
        return [Part(where, slice(None), root, np.concatenate([every, amplitudes], axis=1))]

    def _half(self, modes: Float[np.ndarray, "modes columns"]) -> Float[np.ndarray, "rank more"]:
        """C'^(1/2) of combinations of modes, and then of every amplitude."""
        if not len(self._q):
            return modes
        modes = np.pad(modes, ((0, len(self._q)), (0, 0)))
        return np.concatenate([modes, self._amplitudes], axis=1)

    def _whitened(self, rows: Float[np.ndarray, "rows modes"]) -> Float[np.ndarray, "modes rows"]:
        """C^(1/2) of combinations of modes."""
        return solve_lower(self._lower, self._prior.colour_columns(rows).T, transpose=False)

    def _pulled(
        self, coupling: CouplingMatrix, grid: Float[np.ndarray, "products times columns"]
    ) -> Float[np.ndarray, "columns modes"]:
        """Columns of A^T in white coordinates, as rows."""
        pulled = [coupling.transpose_mv(x.ravel()) for x in np.moveaxis(grid, 2, 0)]
        rows = np.reshape(pulled, (grid.shape[2], self._prior.size))
        return self._prior.colour_columns(rows)

    @once
    def _precision(self) -> Float[np.ndarray, "rank rank"]:
        """C'^-1."""
        n = self._prior.size
        precision = np.empty((n + len(self._q),) * 2)
        precision[:n, :n] = self._lower @ self._lower.T
        precision[:n, :n] += self._v.T @ cho_solve((self._q, True), self._v)
        precision[n:, :n], precision[:n, n:] = self._v, self._v.T
        precision[n:, n:] = self._q @ self._q.T
        return precision

    def _taken_out(
        self,
        weights: Float[np.ndarray, "..."],
        pull: Grid,
        used: Bool[np.ndarray, " products"],
        squared: float,
        log_det: float,
    ) -> Missed:
        """``squared`` + h^T (C'^-1 - A'^T D A')^-1 h, given D and how u pulls at a group's data.

        ``used``: the products that D and u have a part in. ``log_det``: ln|D|.
        """
        n, weighted = self._prior.size, weigh(weights, self._t)
        coupling = self._complete if used.all() else of_products(self._complete, used)
        within = weights[used] if weights.ndim == 2 else weights[used][:, used]
        left = self._precision.copy()
        left[:n, :n] -= self._prior.sandwich(summed(coupling, within))
        if len(self._q):
            taken = self._pulled(coupling, weighted[used])
            left[n:, :n] -= taken
            left[:n, n:] -= taken.T
            left[n:, n:] -= np.einsum("kta,ktb->ab", weighted, self._t)
        of_sky = self._pulled(coupling, pull[used][..., None])[0]
        h = np.concatenate([of_sky, np.einsum("kt,kta->a", pull, self._t)])
        try:
            root = cho_factor(left, lower=True, overwrite_a=True)
        except LinAlgError:
            # as in :meth:`_between`
            return NOT_TOLD
        grown = (self._probes * cho_solve(root, self._probes)).sum() - (self._probed**2).sum()
        log_det += log_det_of(root[0]) - log_det_of(self._lower) - log_det_of(self._q)
        return Missed(float(squared + h @ cho_solve(root, h)), float(grown / PROBES), log_det)

    def _between(
        self, half: Float[np.ndarray, "rank n"], b: Vector, outside: float, log_det: float
    ) -> Missed:
        """``outside`` + b^T (1 - W^T W)^-1 b, in whichever of the two spaces is smaller.

        ``log_det``: ln|D|.
        """
        rank, n = half.shape
        wide = half if n <= rank else half.T
        try:
            root = cho_factor(np.eye(len(wide.T)) - wide.T @ wide)
        except LinAlgError:
            # all others know so little, and these so much, that 64 bits do not tell it from nothing
            return NOT_TOLD
        if n <= rank:
            seen = half.T @ self._probed
            chi2, grown = b @ cho_solve(root, b), (seen * cho_solve(root, seen)).sum()
        else:
            h = half @ b
            chi2 = b @ b + h @ cho_solve(root, h)
            grown = (self._probed * cho_solve(root, self._probed)).sum() - (self._probed**2).sum()
        return Missed(float(outside + chi2), float(grown / PROBES), log_det + log_det_of(root[0]))


def of_products(coupling: CouplingMatrix, used: Bool[np.ndarray, " products"]) -> CouplingMatrix:
    """Take A of some products, at all times."""
    n_runs, n_orders, _, n_degrees = coupling.by_order.shape
    by_product = coupling.by_order.reshape(n_runs, n_orders, len(used), -1, n_degrees)
    return replace(
        coupling,
        body_beams=coupling.body_beams[:, used],
        by_order=by_product[:, :, used].reshape(n_runs, n_orders, -1, n_degrees),
        layout=DataLayout(int(used.sum()), coupling.layout.n_times),
    )
