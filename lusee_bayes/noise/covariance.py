"""N: what every kind of covariance of the noise answers, and the kinds.

A :class:`Covariance` describes N by its dense form and its diagonal. :meth:`Covariance.factor` does
the expensive part once and returns a :class:`Factor`, a square root N = L L^T that whitens vectors
(L^-1 x), colours them (L z) and solves with N.

A new structure is one file: implement the abstract methods here, and ``absorb`` for the sums that
keep the structure. ``a + b`` tries whether either side can absorb the other.

**Noise along a few directions**, such as templates with prior variances or beam errors: U U^T alone
is singular; added to any other covariance N_0 it gives N_0 + U U^T, which is solved through the
small matrix C = 1 + V^T V, V = L_0^-1 U (Woodbury). With C = R R^T, ::

    B = 1 - V R^-T (R + 1)^-1 V^T     satisfies     B B^T = (1 + V V^T)^-1,

so that L = L_0 B^-T is a square root of the sum, applied by products with V. Nothing is subtracted
from N_0^-1, which would leave a small difference of large numbers.

**Noise that couples the products of one time** has a block for each time. **Noise that is
correlated in time** has blocks for times up to some number of samples apart. The matrix is banded
where the products of one time stand together. Its Cholesky factor fills only the band, so that
factorising costs O(times x bandwidth^2). Several times make up one block row, large enough for
matrix products to run at full speed and small enough to follow the edge of the band.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from lusee_bayes.core import checks
from lusee_bayes.core.arrays import Array, namespace
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.linalg import checked_cholesky, solve_lower
from lusee_bayes.instrument.products import DataLayout

Columns = Float[Array, "data *columns"]
Band = Float[Array, "times widths products products"]


class Factor(eqx.Module):
    """A square root L of a covariance: N = L L^T.

    L need not be triangular, and each kind of factor orders whitened entries as it likes: only L z
    of independent normals z, and products of whitened vectors with each other, have a meaning.

    Attributes
    ----------
    couples_times : bool
        Whether N may couple different times. If not, every whitened entry is made of data of its
        own time.
    """

    couples_times: ClassVar[bool] = True

    @abstractmethod
    def whiten(self, x: Columns) -> Columns:
        """Return L^-1 x, for a vector or for every column of a matrix."""

    @abstractmethod
    def whiten_transpose(self, x: Columns) -> Columns:
        """Return L^-T x."""

    @abstractmethod
    def colour(self, z: Columns) -> Columns:
        """Return L z, which turns independent unit normals into draws of N(0, N)."""

    @abstractmethod
    def log_det(self) -> Float[Array, ""]:
        """Return ``ln|N|``."""

    def solve(self, x: Columns) -> Columns:
        """Return N^-1 x."""
        return self.whiten_transpose(self.whiten(x))


class Covariance(checks.Described, eqx.Module):
    """A symmetric positive definite matrix N over the entries of the data vector, in K^2."""

    def description(self) -> tuple[str, ...]:
        return (f"noise covariance of {self.size} data, in K^2",)

    @property
    @abstractmethod
    def size(self) -> int:
        """Number of data."""

    @abstractmethod
    def diagonal(self) -> Float[Array, " data"]:
        """Return the variances."""

    @abstractmethod
    def dense(self) -> Float[Array, "data data"]:
        """Return N as a matrix."""

    @abstractmethod
    def factor(self) -> Factor:
        """Return a square root of N.

        Raises
        ------
        InputError
            If N is not positive definite.
        """

    @abstractmethod
    def absorb(self, other: Covariance) -> Covariance | None:
        """Return ``self + other`` if ``self`` has a structure that can hold it, None otherwise."""

    @abstractmethod
    def scaled(self, factor: float | Float[Array, ""]) -> Covariance:
        """Return ``factor * N`` for a positive factor."""

    def time_weights(self, layout: DataLayout) -> Float[Array, "..."] | None:
        """Return N^-1 on the full grid, if N couples no two times.

        Parameters
        ----------
        layout : DataLayout
            Of the data.

        Returns
        -------
        (products, times) or (products, products, times) array, or None
            The inverse variances, or the inverse of the block of every time, zero where a sample is
            missing; None if N has no such structure.

        Raises
        ------
        InputError
            If N is not positive definite.
        """
        return None

    def solve(self, x: Columns) -> Columns:
        """Return N^-1 x."""
        return self.factor().solve(x)

    def log_det(self) -> Float[Array, ""]:
        """Return ``ln|N|``."""
        return self.factor().log_det()

    @property
    def rank(self) -> int:
        """Number of independent normals behind a draw of N(0, N)."""
        return self.size

    def colour(self, z: Float[Array, "white *columns"]) -> Columns:
        """Turn ``rank`` independent normals, or columns of them, into draws of N(0, N)."""
        return self.factor().colour(z)

    def sample(self, key: PRNGKeyArray, n: int | None = None) -> Float[Array, "..."]:
        """Draw from N(0, N): a (data,) array, or an (n, data) one with ``n``."""
        z = jax.random.normal(key, (self.rank, 1 if n is None else n), dtype=jnp.float64)
        if namespace(self) is np and not checks.is_traced(z):
            z = np.asarray(z)
        draws = self.colour(z).T
        return draws[0] if n is None else draws

    def __add__(self, other: Covariance) -> Covariance:
        if self.size != other.size:
            raise InputError(
                f"cannot add covariances of {self.size} and {other.size} data; "
                "build both terms for the same observation and flags"
            )
        total = self.absorb(other)
        total = other.absorb(self) if total is None else total
        if total is None:
            raise InputError(
                f"{type(self).__name__} and {type(other).__name__} have no common structure; "
                "turn one of them into DenseCovariance(term.dense())"
            )
        return total


def _log_det(lower: Float[Array, "*batch n n"]) -> Float[Array, ""]:
    """ln|L L^T|, of all blocks together."""
    xp = namespace(lower)
    return xp.asarray(2.0 * xp.log(xp.diagonal(lower, axis1=-2, axis2=-1)).sum())


class CholeskyFactor(Factor):
    """The Cholesky factor of a dense covariance.

    Attributes
    ----------
    lower : (data, data) array
        L; only the lower triangle is read.
    """

    lower: Float[Array, "*batch n n"]

    def _columns(self, x: Columns) -> Float[Array, "*batch n all_columns"]:
        return x.reshape(x.shape[0], -1)

    def _data(self, columns: Array, shape: tuple[int, ...]) -> Columns:
        return columns.reshape(shape)

    def whiten(self, x):
        return self._data(solve_lower(self.lower, self._columns(x), transpose=False), x.shape)

    def whiten_transpose(self, x):
        return self._data(solve_lower(self.lower, self._columns(x), transpose=True), x.shape)

    def colour(self, z):
        return self._data(namespace(self).tril(self.lower) @ self._columns(z), z.shape)

    def log_det(self):
        return _log_det(self.lower)


class TimeBlockFactor(CholeskyFactor):
    """The Cholesky factors of the blocks of all times.

    Attributes
    ----------
    lower : (times, products, products) array
    layout : DataLayout
    """

    couples_times: ClassVar[bool] = False
    layout: DataLayout

    def _columns(self, x):
        return self.layout.by_time(x)

    def _data(self, columns, shape):
        return self.layout.from_times(columns, shape)


class DenseCovariance(Covariance):
    """A covariance that is given as a matrix.

    Attributes
    ----------
    matrix : (data, data) array
        N in K^2.
    name : str
        Of the term, for error messages.

    Raises
    ------
    InputError
        Unless the matrix is square, finite and symmetric.
    """

    matrix: Float[Array, "data data"]
    name: str = eqx.field(static=True, default="the dense covariance")

    def __check_init__(self):
        checks.require_array(self.name, self.matrix, (self.matrix.shape[0],) * 2)
        checks.require_symmetric(self.name, self.matrix)

    @property
    def size(self) -> int:
        return self.matrix.shape[0]

    def diagonal(self):
        return jnp.diagonal(self.matrix)

    def dense(self):
        return self.matrix

    def factor(self):
        return CholeskyFactor(checked_cholesky(self.name, self.matrix))

    def absorb(self, other):
        return DenseCovariance(self.matrix + other.dense(), self.name)

    def scaled(self, factor):
        return DenseCovariance(factor * self.matrix, self.name)


def _down(vector: Float[Array, " data"], x: Columns) -> Float[Array, "..."]:
    """The vector shaped to multiply the rows of x."""
    return vector.reshape(-1, *(1,) * (x.ndim - 1))


class DiagonalFactor(Factor):
    """The square root of a diagonal covariance, L = diag(sigma).

    Attributes
    ----------
    sigma : (data,) array
        In K.
    """

    couples_times: ClassVar[bool] = False
    sigma: Float[Array, " data"]

    def whiten(self, x):
        return x / _down(self.sigma, x)

    whiten_transpose = whiten

    def colour(self, z):
        return z * _down(self.sigma, z)

    def log_det(self):
        return 2.0 * namespace(self.sigma).log(self.sigma).sum()


class DiagonalCovariance(Covariance):
    """Independent noise of given variances.

    Attributes
    ----------
    variance : (data,) array
        In K^2.

    Raises
    ------
    InputError
        If a variance is not positive.
    """

    variance: Float[Array, " data"]

    def __check_init__(self):
        checks.require_float64("the noise variance", self.variance)
        checks.require_shape("the noise variance", self.variance, (None,))
        checks.require_positive("the noise variance", self.variance)

    @property
    def size(self) -> int:
        return self.variance.shape[0]

    def diagonal(self):
        return self.variance

    def dense(self):
        return namespace(self.variance).diag(self.variance)

    def factor(self):
        return DiagonalFactor(namespace(self.variance).sqrt(self.variance))

    def time_weights(self, layout):
        return layout.scatter(1.0 / self.variance)

    def absorb(self, other):
        if isinstance(other, DiagonalCovariance):
            return DiagonalCovariance(self.variance + other.variance)
        return None

    def scaled(self, factor):
        return DiagonalCovariance(factor * self.variance)


class LowRankCovariance(Covariance):
    """U U^T, which is only semidefinite: add it to another noise term.

    Attributes
    ----------
    root : (data, rank) array
        U in K.
    name : str
        Of the term, for error messages.

    Raises
    ------
    InputError
        If U is not a finite matrix.
    """

    root: Float[Array, "data rank"]
    name: str = eqx.field(static=True, default="the low-rank term")

    def __check_init__(self):
        checks.require_array(self.name, self.root, (None, None))

    @property
    def size(self) -> int:
        return self.root.shape[0]

    @property
    def rank(self) -> int:
        return self.root.shape[1]

    def colour(self, z):
        return self.root @ z

    def diagonal(self):
        return (self.root**2).sum(1)

    def dense(self):
        return self.root @ self.root.T

    def factor(self):
        raise InputError(
            f"{self.name} has rank {self.root.shape[1]} at most over {self.size} data, so it is "
            "not positive definite by itself; add the radiometer noise"
        )

    def absorb(self, other):
        if isinstance(other, LowRankCovariance):
            xp = namespace(self, other)
            return LowRankCovariance(xp.concatenate([self.root, other.root], axis=1), self.name)
        if isinstance(other, LowRankUpdate):
            return None
        if self.root.shape[1] >= self.size:  # no structure left: a dense sum is cheaper
            return DenseCovariance(other.dense() + self.dense(), f"the sum with {self.name}")
        return LowRankUpdate(other, self)

    def scaled(self, factor):
        checks.require_positive("the factor of a low-rank term", factor)
        return LowRankCovariance(namespace(self, factor).sqrt(factor) * self.root, self.name)


class LowRankUpdate(Covariance):
    """N_0 + U U^T.

    Attributes
    ----------
    base : Covariance
        N_0, positive definite.
    update : LowRankCovariance
        U U^T.
    """

    base: Covariance
    update: LowRankCovariance

    @property
    def size(self) -> int:
        return self.base.size

    def diagonal(self):
        return self.base.diagonal() + self.update.diagonal()

    def dense(self):
        return self.base.dense() + self.update.dense()

    def factor(self):
        base = self.base.factor()
        v = base.whiten(self.update.root)
        small = np.eye(v.shape[1]) + v.T @ v
        lower = checked_cholesky(f"1 + V^T V of {self.update.name}", small)
        return LowRankFactor(base, v, lower)

    def absorb(self, other):
        if isinstance(other, LowRankUpdate):
            return (self.base + other.base) + (self.update + other.update)
        if isinstance(other, LowRankCovariance):
            return self.base + (self.update + other)
        return (self.base + other) + self.update

    def scaled(self, factor):
        return LowRankUpdate(self.base.scaled(factor), self.update.scaled(factor))


class KnownFactor(Covariance):
    """N with its square root, computed once: programs would do it at every evaluation.

    Attributes
    ----------
    covariance : Covariance
        N.
    root : Factor
        Of N.
    """

    covariance: Covariance
    root: Factor

    @classmethod
    def of(cls, noise: Covariance) -> KnownFactor:
        """Factorise it. InputError if it is not positive definite."""
        return cls(noise, noise.factor())

    @property
    def size(self) -> int:
        return self.covariance.size

    def diagonal(self):
        return self.covariance.diagonal()

    def dense(self):
        return self.covariance.dense()

    def factor(self):
        return self.root

    def absorb(self, other):
        low_rank = isinstance(other, LowRankCovariance | LowRankUpdate)
        return None if low_rank else self.covariance + other

    def scaled(self, factor):
        return self.covariance.scaled(factor)


class LowRankFactor(Factor):
    """The square root L = L_0 B^-T of N_0 + U U^T.

    Attributes
    ----------
    base : Factor
        L_0.
    v : (data, rank) array
        V = L_0^-1 U.
    lower : (rank, rank) array
        R, the Cholesky factor of 1 + V^T V.
    """

    base: Factor
    v: Float[Array, "data rank"]
    lower: Float[Array, "rank rank"]

    def _shrink(self, x: Array, *, transpose: bool) -> Array:
        """B x, or B^T x with ``transpose``."""
        columns = x.reshape(x.shape[0], -1)
        inner = self.v.T @ columns
        roots = self.lower, self.lower + np.eye(self.lower.shape[0])
        first, second = roots if transpose else roots[::-1]
        inner = solve_lower(first, inner, transpose=False)
        inner = solve_lower(second, inner, transpose=True)
        return (columns - self.v @ inner).reshape(x.shape)

    def whiten(self, x):
        return self._shrink(self.base.whiten(x), transpose=True)

    def whiten_transpose(self, x):
        return self.base.whiten_transpose(self._shrink(x, transpose=False))

    def colour(self, z):
        """Return L z = L_0 (1 + V V^T) B z, since B^-T = (1 + V V^T) B."""
        shrunk = self._shrink(z, transpose=False)
        return self.base.colour(shrunk + self.v @ (self.v.T @ shrunk))

    def log_det(self):
        return self.base.log_det() + _log_det(self.lower)


class _OverLayout(Covariance):
    """A covariance that knows which product and time each of its data has."""

    layout: DataLayout

    @property
    def size(self) -> int:
        return self.layout.size


def _masked(band: Band, layout: DataLayout) -> Band:
    """The band with blocks before the first time, and missing samples, as of the unit matrix."""
    n_times, widths, products = band.shape[:3]
    time, back = np.arange(n_times)[:, None], np.arange(widths)[None]
    row = layout.present.T
    column = row[np.maximum(time - back, 0)] & (time >= back)[:, :, None]
    unit = np.eye(products) * (back == 0)[:, :, None, None]
    return namespace(band, layout).where(row[:, None, :, None] & column[:, :, None], band, unit)


class TimeBlockCovariance(_OverLayout):
    """N with one block for each time.

    Missing samples get the rows and columns of the unit matrix, which change neither the solution
    nor the determinant of the other samples.

    Attributes
    ----------
    blocks : (times, products, products) array
        In K^2.
    layout : DataLayout

    Raises
    ------
    InputError
        If the blocks do not fit the layout, are not finite or not symmetric.
    """

    blocks: Float[Array, "times products products"]

    def __init__(self, blocks: Float[Array, "times products products"], layout: DataLayout):
        checks.require_float64("the noise blocks", blocks)
        n = layout.n_products
        checks.require_shape("the noise blocks", blocks, (layout.n_times, n, n))
        blocks = _masked(blocks[:, None], layout)[:, 0]
        checks.require_finite("the noise blocks", blocks)
        checks.require_symmetric("the noise covariance of one time", blocks)
        self.blocks = blocks
        self.layout = layout

    def dense(self):
        unit = namespace(self).eye(self.size)
        return self.layout.from_times(self.blocks @ self.layout.by_time(unit), unit.shape)

    def diagonal(self):
        return self.layout.gather(namespace(self).diagonal(self.blocks, axis1=1, axis2=2).T)

    def factor(self):
        lower = checked_cholesky("the noise covariance of one time", self.blocks)
        return TimeBlockFactor(lower, self.layout)

    def time_weights(self, layout):
        self.factor()  # raises where a block is not positive definite
        xp, present = namespace(self), self.layout.present.T
        both = present[:, :, None] & present[:, None, :]
        return xp.moveaxis(xp.where(both, xp.linalg.inv(self.blocks), 0.0), 0, 2)

    def absorb(self, other):
        if isinstance(other, TimeBlockCovariance):
            self.layout.require_same(other.layout)
            # a missing sample's unit row must stay a unit row: the constructor puts it back
            return TimeBlockCovariance(self.blocks + other.blocks, self.layout)
        if isinstance(other, DiagonalCovariance):
            added = self.layout.scatter(other.variance).T
            blocks = self.blocks + added[:, :, None] * np.eye(self.layout.n_products)[None]
            return TimeBlockCovariance(blocks, self.layout)
        return None

    def scaled(self, factor):
        return TimeBlockCovariance(factor * self.blocks, self.layout)


# rows of a block: measured at 16 products and a band of 43 times, whitening 5232 x 2304 on two
# cores takes 0.28 s with 112 or 176 rows, 0.30 s with 352, 0.37 s with 704
ROWS = 176


class TimeBandedFactor(Factor):
    """The Cholesky factor of a banded covariance, in block rows.

    Its products are compiled: outside of a program, JAX compiles a loop anew in every call. The
    last block row is padded with rows of the unit matrix.

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

    def _swept(self, step: Callable, across: Array, x: Columns, reverse: bool = False) -> Columns:
        """x with a step for each block row: of what it hands on, and L before and in its row."""
        (n, rows, window), layout = self.left.shape, self.layout
        grid = layout.by_time(x)
        flat = grid.reshape(layout.n_times * layout.n_products, -1)
        padded = jnp.pad(flat, ((0, n * rows - len(flat)), (0, 0)))
        start = jnp.zeros((window, flat.shape[1]))
        parts = (self.left, across, padded.reshape(n, rows, -1))
        _, found = jax.lax.scan(step, start, parts, reverse=reverse)
        found = found.reshape(n * rows, -1)[: len(flat)]
        return layout.from_times(found.reshape(grid.shape), x.shape)

    @eqx.filter_jit
    def whiten(self, x):
        def step(window, row):
            left, inverse, block = row
            solved = inverse @ (block - left @ window)
            return jnp.concatenate([window[len(block) :], solved]), solved

        return self._swept(step, self.inverse, x)

    @eqx.filter_jit
    def whiten_transpose(self, x):
        def step(pending, row):
            left, inverse, block = row
            solved = inverse.T @ (block - pending[-len(block) :])
            pending = jnp.concatenate([jnp.zeros_like(block), pending[: -len(block)]])
            return pending + left.T @ solved, solved

        return self._swept(step, self.inverse, x, reverse=True)

    @eqx.filter_jit
    def colour(self, z):
        def step(window, row):
            left, diagonal, block = row
            coloured = diagonal @ block + left @ window
            return jnp.concatenate([window[len(block) :], block]), coloured

        return self._swept(step, self.diagonal, z)

    def log_det(self):
        return _log_det(self.diagonal)


class TimeBandedCovariance(_OverLayout):
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

    band: Band
    name: str = eqx.field(static=True, default="the time-banded covariance")

    def __init__(self, band: Band, layout: DataLayout, name: str = "the time-banded covariance"):
        checks.require_float64(name, band)
        n = layout.n_products
        checks.require_shape(name, band, (layout.n_times, None, n, n))
        band = _masked(band, layout)
        checks.require_finite(name, band)
        checks.require_symmetric(f"{name} within one time", band[:, 0])
        self.band = band
        self.layout = layout
        self.name = name

    def dense(self):
        unit = namespace(self).eye(self.size)
        grid = self.layout.by_time(unit)

        def add(w, total):
            block = jax.lax.dynamic_index_in_dim(self.band, w, 1, keepdims=False)
            earlier = block @ jnp.roll(grid, w, axis=0)  # band[t, w] is zero where t < w
            later = jnp.roll(jnp.swapaxes(block, 1, 2) @ grid, -w, axis=0)
            return total + earlier + jnp.where(w > 0, 1.0, 0.0) * later

        total = jax.lax.fori_loop(0, self.band.shape[1], add, jnp.zeros_like(grid))
        return self.layout.from_times(total, unit.shape)

    def diagonal(self):
        return self.layout.gather(jnp.diagonal(self.band[:, 0], axis1=1, axis2=2).T)

    def factor(self):
        left, diagonal = _cholesky(*_block_rows(self.band))
        if not checks.is_traced(diagonal):
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
