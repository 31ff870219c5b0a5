"""Noise that is correlated in time: blocks couple times up to some number of samples apart.

The matrix is banded where the products of one time stand together. Its Cholesky factor fills only
the band, so that factorising costs O(times x bandwidth^2). Several times make up one block row,
large enough for matrix products to run at full speed and small enough to follow the edge of the
band.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from lusee_bayes.core.arrays import Array
from lusee_bayes.core.checks import (
    is_traced,
    require_finite,
    require_float64,
    require_shape,
    require_symmetric,
)
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.linalg import solve_lower
from lusee_bayes.instrument.layout import DataLayout
from lusee_bayes.noise.covariance.base import Covariance, Factor
from lusee_bayes.noise.covariance.diagonal import DiagonalCovariance
from lusee_bayes.noise.covariance.time_blocks import TimeBlockCovariance

# rows of a block: measured at 16 products and a band of 43 times, whitening 5232 x 2304 on two
# cores takes 0.28 s with 112 or 176 rows, 0.30 s with 352, 0.37 s with 704
ROWS = 176


class TimeBandedFactor(Factor):
    """The Cholesky factor of a banded covariance, in block rows.

    The last block row is padded with rows of the unit matrix. Whitened entries are in order of
    time, which spares a transposition of every matrix that is whitened.

    Attributes
    ----------
    left : (blocks, rows, window) array
        L before the diagonal blocks, as far as the band reaches.
    diagonal : (blocks, rows, rows) array
        The diagonal blocks of L, lower triangular.
    inverse : (blocks, rows, rows) array
        Their inverses.
    layout : DataLayout
    """

    left: Float[Array, "blocks rows window"]
    diagonal: Float[Array, "blocks rows rows"]
    inverse: Float[Array, "blocks rows rows"]
    layout: DataLayout

    def _pad(self, flat: Float[Array, "entries columns"]) -> Float[Array, "blocks rows columns"]:
        n, rows = self.diagonal.shape[:2]
        flat = jnp.pad(flat, ((0, n * rows - flat.shape[0]), (0, 0)))
        return flat.reshape(n, rows, -1)

    def _from_data(self, x: Float[Array, "data *columns"]) -> Float[Array, "blocks rows last"]:
        grid = self.layout.by_time(x)
        return self._pad(grid.reshape(grid.shape[0] * grid.shape[1], -1))

    def _to_data(self, blocks: Array, shape: tuple[int, ...]) -> Float[Array, "data *columns"]:
        flat = blocks.reshape(-1, blocks.shape[-1])
        n_times, n_products = self.layout.n_times, self.layout.n_products
        grid = flat[: n_times * n_products].reshape(n_times, n_products, -1)
        return self.layout.from_times(grid, shape)

    def _in_time_order(self) -> Int[Array, " data"] | None:
        """Positions of the samples that are not missing, with products running fastest."""
        if self.layout.index is None:
            return None
        return jnp.flatnonzero(self.layout.present.T.ravel(), size=self.layout.size)

    def _from_white(self, z: Float[Array, "data *columns"]) -> Float[Array, "blocks rows last"]:
        flat, where = z.reshape(z.shape[0], -1), self._in_time_order()
        if where is not None:
            n = self.layout.n_times * self.layout.n_products
            flat = jnp.zeros((n, flat.shape[1])).at[where].set(flat)
        return self._pad(flat)

    def _to_white(self, blocks: Array, shape: tuple[int, ...]) -> Float[Array, "data *columns"]:
        flat, where = blocks.reshape(-1, blocks.shape[-1]), self._in_time_order()
        n = self.layout.n_times * self.layout.n_products
        return (flat[:n] if where is None else flat[where]).reshape(shape)

    def _window(self, columns: int) -> Float[Array, "window columns"]:
        return jnp.zeros((self.left.shape[2], columns))

    def whiten(self, x):
        blocks, rows = self._from_data(x), self.diagonal.shape[1]

        def step(window, row):
            left, inverse, block = row
            solved = inverse @ (block - left @ window)
            return jnp.concatenate([window[rows:], solved]), solved

        start = self._window(blocks.shape[-1])
        _, solved = jax.lax.scan(step, start, (self.left, self.inverse, blocks))
        return self._to_white(solved, x.shape)

    def whiten_transpose(self, x):
        blocks, rows = self._from_white(x), self.diagonal.shape[1]

        def step(pending, row):
            left, inverse, block = row
            solved = inverse.T @ (block - pending[-rows:])
            pending = jnp.concatenate([jnp.zeros((rows, block.shape[-1])), pending[:-rows]])
            return pending + left.T @ solved, solved

        start = self._window(blocks.shape[-1])
        _, solved = jax.lax.scan(step, start, (self.left, self.inverse, blocks), reverse=True)
        return self._to_data(solved, x.shape)

    def colour(self, z):
        blocks, rows = self._from_white(z), self.diagonal.shape[1]

        def step(window, row):
            left, diagonal, block = row
            return jnp.concatenate([window[rows:], block]), diagonal @ block + left @ window

        start = self._window(blocks.shape[-1])
        _, coloured = jax.lax.scan(step, start, (self.left, self.diagonal, blocks))
        return self._to_data(coloured, z.shape)

    def log_det(self):
        return 2.0 * jnp.log(jnp.diagonal(self.diagonal, axis1=1, axis2=2)).sum()


class TimeBandedCovariance(Covariance):
    """N with a block for every two times up to ``width`` samples apart, zero beyond.

    Missing samples get the rows and columns of the unit matrix.

    Attributes
    ----------
    band : (times, width + 1, products, products) array
        In K^2; band[t, w] is the block of rows t and columns t - w. Blocks of columns before the
        first time are ignored.
    layout : DataLayout
    name : str
        Of the term, for error messages.

    Raises
    ------
    InputError
        If the band does not fit the layout, is not finite, or is not symmetric within one time.
    """

    band: Float[Array, "times widths products products"]
    layout: DataLayout
    name: str = eqx.field(static=True, default="the time-banded covariance")

    def __init__(
        self,
        band: Float[Array, "times widths products products"],
        layout: DataLayout,
        name: str = "the time-banded covariance",
    ):
        require_float64(name, band)
        n = layout.n_products
        require_shape(name, band, (layout.n_times, None, n, n))
        band = _mask(band, layout)
        require_finite(name, band)
        require_symmetric(f"{name} within one time", band[:, 0])
        self.band = band
        self.layout = layout
        self.name = name

    @property
    def size(self) -> int:
        return self.layout.size

    @property
    def width(self) -> int:
        """Largest distance in samples at which two times are coupled."""
        return self.band.shape[1] - 1

    def mv(self, x):
        grid = self.layout.by_time(x)

        def add(w, total):
            block = jax.lax.dynamic_index_in_dim(self.band, w, 1, keepdims=False)
            earlier = block @ jnp.roll(grid, w, axis=0)  # band[t, w] is zero where t < w
            later = jnp.roll(jnp.swapaxes(block, 1, 2) @ grid, -w, axis=0)
            return total + earlier + jnp.where(w > 0, 1.0, 0.0) * later

        total = jax.lax.fori_loop(0, self.band.shape[1], add, jnp.zeros_like(grid))
        return self.layout.from_times(total, x.shape)

    def diagonal(self):
        return self.layout.gather(jnp.diagonal(self.band[:, 0], axis1=1, axis2=2).T)

    def dense(self):
        return self.mv(jnp.eye(self.size))

    def factor(self):
        left, diagonal = _cholesky(*_block_rows(self.band))
        if not is_traced(diagonal):
            self._require_positive(diagonal)
        unit = jnp.broadcast_to(jnp.eye(diagonal.shape[1]), diagonal.shape)
        inverse = solve_lower(diagonal, unit, transpose=False)
        return TimeBandedFactor(left, diagonal, inverse, self.layout)

    def _require_positive(self, diagonal: Float[Array, "blocks rows rows"]) -> None:
        """InputError, with the lowest eigenvalue of the samples where the factorisation broke."""
        broken = ~np.isfinite(np.asarray(diagonal)).all(axis=(1, 2))
        if not broken.any():
            return
        end = (int(np.argmax(broken)) + 1) * (diagonal.shape[1] // self.layout.n_products)
        end = min(end, self.layout.n_times)
        start, lowest = end, np.inf
        while lowest > 0 and start > 0:  # a short stretch may be positive by itself
            start = max(0, end - 2 * max(self.band.shape[1], end - start))
            part = TimeBandedCovariance(
                self.band[start:end], DataLayout(self.layout.n_products, end - start), self.name
            )
            lowest = float(jnp.linalg.eigvalsh(part.dense()).min())
        raise InputError(
            f"{self.name} is not positive definite: its lowest eigenvalue is {lowest:.3g} between "
            f"samples {start} and {end - 1} (largest entry {float(jnp.abs(self.band).max()):.3g}); "
            "add the radiometer noise or check the term's amplitude"
        )

    def absorb(self, other):
        if isinstance(other, TimeBandedCovariance | TimeBlockCovariance):
            self.layout.require_same(other.layout)
        if isinstance(other, TimeBandedCovariance):
            wide, narrow = sorted((self.band, other.band), key=lambda b: -b.shape[1])
            extra = wide.shape[1] - narrow.shape[1]
            narrow = jnp.pad(narrow, ((0, 0), (0, extra), (0, 0), (0, 0)))
            return TimeBandedCovariance(wide + narrow, self.layout, self.name)
        if isinstance(other, DiagonalCovariance):
            other = TimeBlockCovariance(jnp.zeros_like(self.band[:, 0]), self.layout).absorb(other)
        if isinstance(other, TimeBlockCovariance):
            band = self.band.at[:, 0].add(other.blocks)
            return TimeBandedCovariance(band, self.layout, self.name)
        return None

    def scaled(self, factor):
        return TimeBandedCovariance(factor * self.band, self.layout, self.name)


def _mask(band: Array, layout: DataLayout) -> Array:
    """Set blocks before the first time, and missing samples, to those of the unit matrix."""
    n_times, widths = band.shape[:2]
    inside = np.arange(n_times)[:, None] >= np.arange(widths)[None]
    if layout.index is None and inside.all():
        return band
    present = layout.present.T
    earlier = np.maximum(np.arange(n_times)[:, None] - np.arange(widths)[None], 0)
    both = present[:, None, :, None] & present[earlier][:, :, None, :]
    band = jnp.where(both & jnp.asarray(inside)[:, :, None, None], band, 0.0)
    unit = jnp.eye(layout.n_products)[None] * (~present)[:, :, None].astype(band.dtype)
    return band.at[:, 0].add(unit)


def _block_rows(band: Array) -> tuple[Array, Array]:
    """Rearrange the band into block rows: (blocks, rows, window) before the diagonal, and on it."""
    n_times, widths, products, _ = band.shape
    steps = max(1, ROWS // products)
    before = max(1, -(-(widths - 1) // steps))  # block columns that the band reaches back
    n = -(-n_times // steps)
    padded = jnp.pad(band, ((0, n * steps - n_times), (0, 0), (0, 0), (0, 0)))
    padding = jnp.asarray(np.arange(n * steps) >= n_times, dtype=band.dtype)
    padded = padded.at[:, 0].add(padding[:, None, None] * jnp.eye(products)[None])
    row, column = np.arange(steps)[:, None], np.arange((before + 1) * steps)[None]
    distance = row + before * steps - column
    valid = jnp.asarray((distance >= 0) & (distance < widths))
    index = np.clip(distance, 0, widths - 1)
    grouped = padded.reshape(n, steps, widths, products, products)
    blocks = grouped[:, row, index]  # (n, steps, columns, products, products)
    blocks = jnp.where(valid[None, :, :, None, None], blocks, 0.0)
    blocks = jnp.swapaxes(blocks, 2, 3).reshape(n, steps * products, -1)
    split = before * steps * products
    return blocks[:, :, :split], blocks[:, :, split:]


@eqx.filter_jit
def _cholesky(left: Array, diagonal: Array) -> tuple[Array, Array]:
    """Block rows of L from those of N.

    Row i of L before the diagonal solves  L_i W^T = N_i,  with W the lower triangle of the block
    rows of L that the band reaches from row i.
    """
    rows, window = left.shape[1:]

    def step(reach, row):
        before, on = row
        solved = solve_lower(reach, before.T, transpose=False).T
        # Cholesky's value needs the lower triangle only, its derivative a symmetric matrix
        rest = jnp.tril(on - solved @ solved.T)
        rest = rest + jnp.tril(rest, -1).T
        lower = jax.lax.linalg.cholesky(rest, symmetrize_input=False)
        shifted = jnp.zeros_like(reach).at[:-rows, :-rows].set(reach[rows:, rows:])
        new = jnp.concatenate([solved[:, rows:], jnp.tril(lower)], axis=1)
        return shifted.at[-rows:].set(new), (solved, jnp.tril(lower))

    _, factor = jax.lax.scan(step, jnp.eye(window), (left, diagonal))
    return factor
