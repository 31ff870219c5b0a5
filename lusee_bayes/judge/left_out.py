"""Groups of data against their prediction by all others.

Let K = A S A^T + N be the covariance of data under the model, and u = K^-1 (d - E[d]). A group s
differs from its prediction by K_ss^-1 u_s, where K_ss is a block of K^-1, and ::

    chi^2_s = u_s^T K_ss^-1 u_s.

For noise alone, the mean of chi^2_s is the number of data, minus one for each direction of the sky
that only this group measures: tr K_ss^-1 (K^-1 A S A^T K^-1)_ss in total.

With N = N_0 + T T^T, F = [T, A S^(1/2)], and D = N_0^-1, whose blocks are the data that N_0 couples
(the products of a time, or all data), ::

    K^-1 = D - Y Q^-1 Y^T,    Y = D F,    Q = 1 + F^T D F = L L^T.

**A small group** is left out in the space of its data. With D_ss = c c^T and W = c^-1 Y_s L^-T ::

    K_ss = c (1 - W W^T) c^T,    directions = |(1 - W W^T)^(-1/2) W L^-1|^2 over the sky's columns.

Rows of A at nearby times are combinations of the rows at a few of them, A_s = U A_few
(:func:`.spanning_rows`), so that c^T U = q r gives W = q (r F_few L^-T). In a day of ten-minute
samples the few are an eighth, in a stretch of ``DAYS`` days still fewer. L^-T and Q^-1 are applied
to the rows of a stretch, once for all groups within it and for the diagonal of K^-1. Up to
``SHARED`` times are one stretch; if D couples their products, or A has no structure in time, Y L^-T
of all data is kept.

**A large group** is removed from Q, without rows of A if A and N have structure in time::

    Q_s = Q - F^T D_:s D_ss^-1 D_s: F,    h = F^T D_:s D_ss^-1 u_s,
    chi^2_s = u_s^T D_ss^-1 u_s + h^T Q_s^-1 h,
    directions = tr (Q_s^-1 - Q^-1) of the sky.

If Y L^-T is kept, W has more rows than columns, Q_s = L (1 - W^T W) L^T and h = L W^T c^-1 u_s.

The data that remain have N_0 without the group, so that D loses ``D_:s D_ss^-1 D_s:``.
"""

from __future__ import annotations

from collections import ChainMap
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

from lusee_bayes.core import engine, linalg
from lusee_bayes.core.arrays import Grid, GridFlags, Square, Vector, on_host
from lusee_bayes.core.errors import InputError
from lusee_bayes.instrument.products import DataLayout
from lusee_bayes.instrument.visibilities import Visibilities
from lusee_bayes.linear.linear_gaussian import LinearGaussian
from lusee_bayes.linear.normal_matrix import is_within_times, summed
from lusee_bayes.linear.posterior import Posterior
from lusee_bayes.noise.covariance import LowRankUpdate

# a larger A without structure in time is not formed: 60,000 data at lmax 47
DENSE_BYTES = 1.2e9
# Y L^-T and Y Q^-1 of all data are kept up to this size (a month of hours at lmax 47: 0.4 GB)
KEPT_BYTES = 5e8
# steps that refine Q^-1 F^T D d, to restore the digits that normal equations lose
REFINEMENTS = 2
# up to SHARED times are one stretch, more have stretches of DAYS days: for a year of ten-minute
# samples, 15 days take 3 % less time and 0.12 GB more
SHARED, DAYS = 1000, 7
# times whose rows are computed at once, and number of data up to which a group is always small
CHUNK, QUICK = 16, 500

# arrays by block of D (times, or one block of all data) and place in it (products, or data)
Cells = Float[np.ndarray, "blocks places"]
CellFlags = Bool[np.ndarray, "blocks places"]
Weights = Float[np.ndarray, "blocks places *places"]
Roots = Float[np.ndarray, "blocks used *used"]
Rows = Float[np.ndarray, "rows rank"]
SkyRows = Float[np.ndarray, "rows sky"]
Answer = tuple[float, float]


class Missed(NamedTuple):
    """How a group differs from its prediction.

    Attributes
    ----------
    n : int
        Number of its data.
    chi2 : float
        chi^2_s; NaN if the group cannot be compared: there are no other data, or they constrain too
        little next to the group, so that it is lost in rounding.
    directions : float
        Number of data minus the mean of chi^2_s, for noise alone.
    """

    n: int
    chi2: float
    directions: float

    @property
    def degrees(self) -> float:
        """The mean of chi^2_s for noise alone."""
        return self.n - float(np.clip(self.directions, 0.0, self.n))


KINDS = ("product", "day", "turntable angle")


class DataGroup(NamedTuple):
    """Data that are left out together.

    Attributes
    ----------
    kind : str
        One of ``KINDS``.
    name : str
    data : (products, times) array of bool
        Which data belong to it.
    """

    kind: str
    name: str
    data: GridFlags


def groups_of(data: Visibilities) -> list[DataGroup]:
    """Find the products, days and turntable angles that have data.

    Parameters
    ----------
    data : Visibilities
        With the times and the turntable angles.

    Returns
    -------
    list of DataGroup
        Days have 24 hours from the first sample, and the name of the date on which they begin. Runs
        at the same turntable angle are one group.
    """
    observation, present = data.observation, np.asarray(data.layout.present)
    day, first = observation.day, np.datetime64(str(observation.times[0].isot)[:19])
    angle = np.asarray(observation.turntable_deg)[observation.run]
    product = np.arange(len(present))[:, None]
    kinds = [("product", label, product == k) for k, label in enumerate(data.labels)]
    dates = {k: str(first + np.timedelta64(int(k), "D"))[:10] for k in np.unique(day)}
    kinds += [("day", date, (day == k)[None]) for k, date in dates.items()]
    kinds += [("turntable angle", f"{x:g}", (angle == x)[None]) for x in np.unique(angle)]
    groups = [DataGroup(*one, np.broadcast_to(flags, present.shape)) for *one, flags in kinds]
    return [group for group in groups if (group.data & present).any()]


class Chosen(NamedTuple):
    """A group: its cells, the blocks and places that have any, its cells there, c and c^-1 u_s."""

    cells: CellFlags
    blocks: Int[np.ndarray, " n"]
    places: Int[np.ndarray, " m"]
    some: Bool[np.ndarray, "n m"]
    root: Roots
    b: Float[np.ndarray, "n m 1"]


class Span(NamedTuple):
    """A few of several times, and U: F at all of them is U F_few."""

    few: Int[np.ndarray, " few"]
    factors: Float[np.ndarray, "times few"]


class Stretch(NamedTuple):
    """F at ordered times: for every product F_few L^-T and F_few Q^-1 of the sky, and U."""

    times: Int[np.ndarray, " times"]
    half: Float[np.ndarray, "products few rank"]
    with_sky: Float[np.ndarray, "products few sky"]
    factors: Float[np.ndarray, "times few"]


class LeftOut:
    """A model and its data, prepared for leaving out groups of data.

    Parameters
    ----------
    model : LinearGaussian
        Of any kind. A is formed unless A and N have structure in time; N^-1, if N couples times.
    data : Visibilities
        In K.
    posterior : Posterior, optional
        Of this model, given any data: saves factorising it.
    gone : (products, times) array of bool, optional
        Data that are left out permanently.

    Attributes
    ----------
    data : Visibilities
        As given.
    present : (products, times) array of bool
        Which data are present.
    u : (products, times) array
        K^-1 (d - E[d]), in 1/K; zero where there are no data.

    Raises
    ------
    InputError
        If the model cannot be factorised.
    """

    def __init__(
        self,
        model: LinearGaussian,
        data: Visibilities,
        *,
        posterior: Posterior | None = None,
        gone: GridFlags | None = None,
    ):
        self._model, self.data, self._layout = on_host(model), data, on_host(data.layout)
        self._set_noise()
        self.present = np.asarray(self._layout.present)
        if gone is not None:
            self.present = self.present & ~gone
            self._weights = self._weights - lost_weights(self._weights, self._on_cells(gone))
        self._lower = self._factorised(None if gone is not None else on_host(posterior))
        self._u = self._weighted_residuals()
        self.u = self._layout.scatter(self._cells.gather(self._u.T))
        self._kept, self._whole, self._spans = None, None, {}
        self._lost, self._day = np.full(self._u.shape, np.nan), self.data.observation.day
        short = len(self._u) <= SHARED and 16 * self._u.size * len(self._lower) <= KEPT_BYTES
        self._stretch_of = (self._day // DAYS) * (not short)
        if not self._summable or (short and self._weights.ndim == 3):
            self._kept = self._halves(weigh(self._weights, self._rows(None)))
        elif short:
            self._whole = self._stretch(0)

    @classmethod
    def of(
        cls, model: LinearGaussian, data: Visibilities, posterior: Posterior | None = None
    ) -> LeftOut | None:
        """Prepare a model unless it is too large.

        Parameters
        ----------
        model : LinearGaussian
        data : Visibilities
            In K.
        posterior : Posterior, optional
            Of this model, given any data.

        Returns
        -------
        LeftOut or None
            None if A would have to be formed and be larger than ``DENSE_BYTES``.
        """
        summable = model.coupling.has_time_structure and is_within_times(model.noise)
        if not summable and 8 * model.n_data * model.prior.size > DENSE_BYTES:
            return None
        return cls(model, data, posterior=posterior)

    def without(self, gone: GridFlags) -> LeftOut:
        """Leave out data permanently; the rest of the model does not change.

        Parameters
        ----------
        gone : (products, times) array of bool
        """
        return LeftOut(self._model, self.data, gone=gone | ~self.present)

    def missed(self, group: GridFlags, stretch: Stretch | None = None) -> Missed:
        """Leave out a group.

        Parameters
        ----------
        group : (products, times) array of bool
            With data.
        stretch : Stretch, optional
            With all times of the group; without it the rows of the group are computed.

        Returns
        -------
        Missed
            NaN if the group cannot be compared.
        """
        cells = self._on_cells(group & self.present)
        n = int(np.count_nonzero(cells))
        if n == np.count_nonzero(self.present):
            return Missed(n, np.nan, np.nan)
        blocks, places = (np.flatnonzero(cells.any(axis)) for axis in (1, 0))
        where, root = np.ix_(blocks, places), roots(self._weights[blocks], cells[blocks])
        b = solve_roots(root, np.where(cells[where], self._u[where], 0.0)[..., None])
        chosen = Chosen(cells, blocks, places, cells[where], root, b)
        # all NaN if Q_s, or 1 - W W^T, has no root
        return Missed(n, *(self._small(chosen, stretch) or self._taken_out(chosen)))

    def each(self, groups: Sequence[GridFlags]) -> list[Missed]:
        """Leave out each of several groups, in threads; those of one stretch share its rows."""
        batches: dict[int, list[int]] = {}
        by_stretch = self._kept is None and self._whole is None
        for k, group in enumerate(groups):
            stretches = self._stretch_of[group.any(axis=0)]
            within = by_stretch and stretches[0] == stretches[-1]
            batches.setdefault(int(stretches[0]) if within else -k - 1, []).append(k)

        def leave_out(number: int) -> dict[int, Missed]:
            stretch = self._stretch(number) if number >= 0 else self._whole
            return {k: self.missed(groups[k], stretch) for k in batches[number]}

        missed = ChainMap(*engine.in_threads(leave_out, list(batches)))
        return [missed[k] for k in range(len(groups))]

    @engine.once
    def inverse_diagonal(self) -> Grid:
        """The diagonal of K^-1, in 1/K^2; NaN where it is lost in rounding."""
        if self._kept is not None:
            self._lost = np.einsum("tkm,tkm->tk", self._kept[0], self._kept[0])
        else:
            missing = np.unique(self._stretch_of[np.isnan(self._lost[:, 0])])
            engine.in_threads(self._stretch, missing.tolist())
        w = self._weights
        precision = w if w.ndim == 2 else np.diagonal(w, axis1=1, axis2=2)
        precision = np.where(precision > self._lost, precision - self._lost, np.nan)
        return self._layout.scatter(self._cells.gather(precision.T))

    # --- the model ----------------------------------------------------------------------------

    def _set_noise(self) -> None:
        """Set D and T by block: one for each time, or one for all data if N couples times."""
        noise, self._cells = self._model.noise, self._layout
        base, self._templates = noise, np.zeros((noise.size, 0))
        if isinstance(noise, LowRankUpdate) and is_within_times(noise):
            base, self._templates = noise.base, np.asarray(noise.update.root)
        weights = base.time_weights(self._layout)
        self._summable = weights is not None and self._model.coupling.has_time_structure
        if weights is None:
            self._cells = DataLayout(noise.size, 1)
            weights = np.asarray(noise.factor().solve(np.eye(noise.size)))[..., None]
        self._weights = np.moveaxis(np.asarray(weights), -1, 0)
        self._t, self._n_templates = self._by_cell(self._templates), self._templates.shape[1]

    def _factorised(self, posterior: Posterior | None) -> Square:
        """L, whose lower right block is the root of the precision of the sky."""
        if posterior is None or posterior.basis is not None:
            normal = self._gram(self._weights)
            normal[np.diag_indices_from(normal)] += 1.0
            lower = linalg.cholesky(normal, overwrite=True)
        else:
            n = self._n_templates
            across = self._pull(weigh(self._weights, self._t))
            across[:n] += np.eye(n)
            lower = np.zeros((len(across),) * 2)
            lower[:n, :n] = np.linalg.cholesky(across[:n])
            lower[n:, :n] = linalg.solve_lower(lower[:n, :n], across[n:].T, transpose=False).T
            lower[n:, n:] = linalg.lower_triangle(posterior.lower)
        if not np.isfinite(np.diagonal(lower)).all():
            raise InputError(
                "the data are too precise to predict a part of them from others; use fewer at once"
            )
        return lower

    def _weighted_residuals(self) -> Cells:
        """u = D (d - E[d] - F z), with z = Q^-1 F^T D (d - E[d])."""
        model, z = self._model, np.zeros(len(self._lower))
        centred = np.asarray(self.data.data) - (0.0 if model.offset is None else model.offset)
        centred = centred - model.coupling @ model.prior.colour(model.prior.white_mean)
        n, weighted = self._n_templates, weigh(self._weights, self._by_cell(centred[:, None]))
        for _ in range(1 + REFINEMENTS):
            step = (self._pull(weighted)[:, 0] - z)[:, None]
            half = linalg.solve_lower(self._lower, step, transpose=False)
            z = z + linalg.solve_lower(self._lower, half, transpose=True)[:, 0]
            seen = self._templates @ z[:n] + model.coupling @ model.prior.colour(z[n:])
            weighted = weigh(self._weights, self._by_cell((centred - seen)[:, None]))
        return weighted[..., 0]

    def _by_cell(self, columns: Shaped[np.ndarray, "data *rest"]) -> np.ndarray:
        return self._cells.scatter(columns).swapaxes(0, 1)

    def _on_cells(self, flags: GridFlags) -> CellFlags:
        return self._by_cell(self._layout.gather(flags))

    def _pull(self, x: Float[np.ndarray, "blocks places k"]) -> Float[np.ndarray, "rank k"]:
        """F^T x."""
        model, columns = self._model, self._cells.gather(np.ascontiguousarray(x.swapaxes(0, 1)))
        sky = model.prior.colour_columns(model.coupling.transpose_mv(columns).T).T
        return np.concatenate([self._templates.T @ columns, sky])

    def _gram(self, weights: Weights) -> Square:
        """F^T W F."""
        if not self._summable:
            rows = self._rows(None)
            some = weights.any(axis=-1) if weights.ndim == 3 else weights != 0.0
            return rows[some].T @ weigh(weights, rows)[some]
        n, model = self._n_templates, self._model
        sky = model.prior.sandwich(summed(model.coupling, np.moveaxis(weights, 0, -1)))
        across = self._pull(weigh(weights, self._t))
        return np.block([[across[:n], across[n:].T], [across[n:], sky]])

    def _rows(self, blocks: Int[np.ndarray, " n"] | None) -> Float[np.ndarray, "n places rank"]:
        """F of all products at some times, or of all data."""
        prior, coupling = self._model.prior, self._model.coupling
        if blocks is None:
            sky = prior.colour_columns(coupling.dense())
            return self._by_cell(np.concatenate([self._templates, sky], axis=1))
        shape = len(blocks), self._layout.n_products
        product, time = np.indices(shape)[1].ravel(), np.repeat(blocks, shape[1])
        sky = prior.colour_columns(coupling.rows(product, time)).reshape(*shape, -1)
        return np.concatenate([self._t[blocks], sky], axis=2)

    def _halves(self, rows: Float[np.ndarray, "*cells rank"]) -> tuple[np.ndarray, np.ndarray]:
        """x L^-T of rows x, and the sky's columns of x Q^-1."""
        half = linalg.solve_lower(self._lower, rows.reshape(-1, rows.shape[-1]).T, transpose=False)
        sky = linalg.solve_lower(self._lower, half, transpose=True)[self._n_templates :].T
        return half.T.reshape(rows.shape), sky.reshape(*rows.shape[:-1], -1)

    def _stretch(self, number: int) -> Stretch:
        """F at the times of a stretch; keeps the diagonal of Y Q^-1 Y^T there."""
        times = np.flatnonzero(self._stretch_of == number)
        stretch = self._stretch_at(times, self._span(times))
        half, factors, weights = stretch.half, stretch.factors, self._weights[times]
        if weights.ndim == 2:
            within = half @ half.swapaxes(1, 2)
            self._lost[times] = ((factors @ within) * factors).sum(-1).T * weights**2
            return stretch
        within = np.einsum("krm,lsm->krls", half, half, optimize=True)
        for part in pieces(len(times)):
            u = factors[part]
            covariance = np.einsum("tr,krls,ts->tkl", u, within, u, optimize=True)
            self._lost[times[part]] = ((weights[part] @ covariance) * weights[part]).sum(-1)
        return stretch

    def _stretch_at(self, times: Int[np.ndarray, " n"], span: Span) -> Stretch:
        """F L^-T and the sky's columns of F Q^-1 at a few times that span others."""
        shape, rank = (len(span.few), self._layout.n_products), len(self._lower)
        half, sky = np.empty((*shape, rank)), np.empty((*shape, rank - self._n_templates))

        def fill(part: Int[np.ndarray, " n"]) -> None:
            half[part], sky[part] = self._halves(self._rows(span.few[part]))

        engine.in_threads(fill, pieces(len(span.few)))
        return Stretch(times, half.swapaxes(0, 1), sky.swapaxes(0, 1), span.factors)

    def _span(self, times: Int[np.ndarray, " n"]) -> Span:
        """A few times that span all of these."""
        if (key := times.tobytes()) not in self._spans:
            templates = self._t[times].reshape(len(times), -1)
            templates = templates / np.maximum(np.abs(templates).max(axis=0), 1e-300)
            features = [self._model.coupling.time_features(times), templates]
            run = np.searchsorted(self._model.coupling.pointing.run_starts, times, side="right")
            few, factors = linalg.spanning_rows(np.concatenate(features, axis=1), run)
            self._spans[key] = Span(times[few], factors)
        return self._spans[key]

    # --- groups in the space of their data ----------------------------------------------------

    def _small(self, chosen: Chosen, stretch: Stretch | None) -> Answer | None:
        """chi^2_s and directions; None for a large group."""
        cells, blocks, places, some, root, b = chosen
        rank = max(len(self._lower), QUICK)
        if self._kept is not None:
            halves = (some[..., None] * x[np.ix_(blocks, places)] for x in self._kept)
            rows = (solve_roots(root, x).reshape(some.size, -1) for x in halves)
            if np.count_nonzero(some) > rank:
                return self._among_unknowns(next(rows), b.ravel())
            return self._among_data(chosen, *rows, b.ravel())
        independent = self._weights.ndim == 2
        whole = independent or (cells[blocks] == self._on_cells(self.present)[blocks]).all()
        if not whole or len(blocks) > rank:
            return None
        span = self._span(blocks)
        if len(places) * min(span.factors.shape) > rank:
            return None
        stretch = self._stretch_at(blocks, span) if stretch is None else stretch
        if independent:
            c, b = (root * some).T[..., None] * span.factors, b.swapaxes(0, 1)
        else:
            c = np.einsum("tkj,tr->tjkr", root * some[..., None], span.factors)
            c, b = c.reshape(1, some.size, -1), b.reshape(1, -1, 1)
        q, r = np.linalg.qr(c)
        combined = stretch.factors[np.searchsorted(stretch.times, span.few)]
        mine = slice(None) if len(places) == len(stretch.half) else places
        few = ((combined @ x[mine]).reshape(len(r), r.shape[-1], -1) for x in stretch[1:3])
        w, with_sky = ((r @ x).reshape(-1, x.shape[-1]) for x in few)
        return self._among_data(chosen, w, with_sky, (q.swapaxes(1, 2) @ b).ravel())

    def _among_data(self, chosen: Chosen, w: Rows, with_sky: SkyRows, inside: Vector) -> Answer:
        """As :meth:`_small`, from q^T W, q^T W L^-1, and q^T c^-1 u_s."""
        lower = linalg.cholesky(np.eye(len(w)) - w @ w.T, overwrite=True)
        solved = linalg.solve_lower(lower, np.column_stack([inside, with_sky]), transpose=False)
        chi2, directions = (float((x**2).sum()) for x in (solved[:, 0], solved[:, 1:]))
        return float((chosen.b**2).sum() - (inside**2).sum()) + chi2, directions

    def _among_unknowns(self, w: Rows, b: Vector) -> Answer:
        """The same for more data than unknowns: Q_s = L (1 - W^T W) L^T."""
        lower = linalg.cholesky(np.eye(w.shape[1]) - w.T @ w, overwrite=True)
        h = linalg.solve_lower(lower, (w.T @ b)[:, None], transpose=False)
        directions = self._trace_of_sky(self._lower @ lower) - self._trace
        return float((b**2).sum() + (h**2).sum()), directions

    # --- groups that are removed from Q -------------------------------------------------------

    @engine.once
    def _normal(self) -> Square:
        """Q."""
        return linalg.times_lower(self._lower, self._lower, transpose=True)

    @engine.once
    def _trace(self) -> float:
        """tr Q^-1 of the sky."""
        return self._trace_of_sky(self._lower.copy())

    def _trace_of_sky(self, lower: Square) -> float:
        """tr (L L^T)^-1 of the sky; overwrites L."""
        inverse = linalg.invert_lower(lower, overwrite=True)[:, self._n_templates :]
        return float(np.einsum("ij,ij->", inverse, inverse))

    def _taken_out(self, chosen: Chosen) -> Answer:
        """chi^2_s and directions."""
        mean = np.zeros((*chosen.cells.shape, 1))
        where = np.ix_(chosen.blocks, chosen.places)
        mean[where] = solve_roots(chosen.root, chosen.b, transpose=True)
        h = self._pull(weigh(self._weights, mean))
        gram = self._gram(lost_weights(self._weights, chosen.cells))
        lower = linalg.cholesky(np.subtract(self._normal, gram, out=gram), overwrite=True)
        h = linalg.solve_lower(lower, h, transpose=False)
        return float((chosen.b**2).sum() + (h**2).sum()), self._trace_of_sky(lower) - self._trace


def pieces(n: int) -> list[Int[np.ndarray, " part"]]:
    """The numbers 0 to n - 1 in pieces of at most ``CHUNK``."""
    return np.array_split(np.arange(n), -(-n // CHUNK))


def weigh(weights: Weights, x: Float[np.ndarray, "blocks places k"]) -> np.ndarray:
    """D x."""
    return weights[..., None] * x if weights.ndim == 2 else weights @ x


def roots(weights: Weights, chosen: CellFlags) -> Roots:
    """c of D_ss = c c^T in every block, at places used by any block; 1 where this one has none."""
    used = np.flatnonzero(chosen.any(axis=0))
    some, within = chosen[:, used], weights[:, used]
    if weights.ndim == 2:
        return np.where(some, np.sqrt(within), 1.0)
    blocks = np.where(some[:, :, None] & some[:, None], within[..., used], np.eye(len(used)))
    try:
        return np.linalg.cholesky(blocks)
    except np.linalg.LinAlgError:  # NaN where there is none
        return linalg.cholesky(blocks)


def solve_roots(root: Roots, x: np.ndarray, *, transpose: bool = False) -> np.ndarray:
    """c^-1 x, or c^-T x."""
    if root.ndim == 2:
        return x / root[..., None]
    return np.linalg.solve(root.swapaxes(1, 2) if transpose else root, x)


def lost_weights(weights: Weights, chosen: CellFlags) -> Weights:
    """The part of D lost without a group, ``D_:s D_ss^-1 D_s:``: all of D in the group's rows."""
    if weights.ndim == 2:
        return np.where(chosen, weights, 0.0)
    lost, blocks = np.zeros_like(weights), np.flatnonzero(chosen.any(axis=1))
    some, within = chosen[blocks], weights[blocks]
    used = np.flatnonzero(some.any(axis=0))
    e = solve_roots(roots(within, some), np.where(some[:, used, None], within[:, used], 0.0))
    # exact to the last bit in the group's rows
    lost[blocks] = np.where(some[:, :, None] | some[:, None], within, e.swapaxes(1, 2) @ e)
    return lost
