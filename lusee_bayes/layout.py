"""Where each entry of the data vector d belongs: which product, which time.

d is stacked product by product with time running fastest. Samples that are flagged or were
never taken are not in d at all, so the positions are explicit.
"""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from lusee_bayes.checks import InputError, is_traced


class DataLayout(eqx.Module):
    """The product and the time of every entry of d.

    ``index`` holds, for every entry, its position ``product * n_times + time`` in the full
    grid; None means that nothing is missing.
    """

    n_products: int = eqx.field(static=True)
    n_times: int = eqx.field(static=True)
    index: Int[Array, " data"] | None = None

    @classmethod
    def from_flags(cls, flags: Bool[np.ndarray, "products times"]) -> DataLayout:
        """The layout that leaves out every sample whose flag is True.

        Raises InputError if all samples are flagged.
        """
        flags = np.asarray(flags, dtype=bool)
        if flags.all():
            raise InputError(
                f"all {flags.size} samples are flagged or missing; there is nothing to map"
            )
        index = None if not flags.any() else jnp.asarray(np.flatnonzero(~flags.ravel()))
        return cls(*flags.shape, index)

    @property
    def size(self) -> int:
        """Number of entries of d."""
        return self.n_products * self.n_times if self.index is None else self.index.shape[0]

    @property
    def product(self) -> np.ndarray:
        """Product number of every entry, shape (data,)."""
        return self._positions() // self.n_times

    @property
    def time(self) -> np.ndarray:
        """Time number of every entry, shape (data,)."""
        return self._positions() % self.n_times

    @property
    def present(self) -> Bool[Array, "products times"]:
        """True where the grid has an entry in d."""
        grid = jnp.zeros(self.n_products * self.n_times, dtype=bool)
        grid = ~grid if self.index is None else grid.at[self.index].set(True)
        return grid.reshape(self.n_products, self.n_times)

    def _positions(self) -> np.ndarray:
        if self.index is None:
            return np.arange(self.size)
        return np.asarray(self.index)

    def require_same(self, other: DataLayout) -> None:
        """InputError unless ``other`` holds the same samples (where both are known)."""
        same = (self.n_products, self.n_times, self.size) == (
            other.n_products,
            other.n_times,
            other.size,
        )
        if same and self.index is not None and other.index is not None:
            same = is_traced(self.index, other.index) or np.array_equal(self.index, other.index)
        if not same:
            raise InputError(
                f"two layouts of {self.size} and {other.size} data hold different samples; build "
                "both terms for the same observation and flags"
            )

    def gather(self, grid: Float[Array, "products times *rest"]) -> Float[Array, "data *rest"]:
        """The entries of d (and of any trailing axes) out of a full grid."""
        flat = grid.reshape(self.n_products * self.n_times, *grid.shape[2:])
        return flat if self.index is None else flat[self.index]

    def scatter(self, data: Float[Array, "data *rest"]) -> Float[Array, "products times *rest"]:
        """Put the entries of d back onto the full grid, zero where nothing was taken."""
        rest = data.shape[1:]
        if self.index is None:
            return data.reshape(self.n_products, self.n_times, *rest)
        flat = jnp.zeros((self.n_products * self.n_times, *rest), dtype=data.dtype)
        return flat.at[self.index].set(data).reshape(self.n_products, self.n_times, *rest)

    def by_time(
        self, data: Float[Array, "data *columns"]
    ) -> Float[Array, "times products all_columns"]:
        """Entries of d with the products of one time together, zero where nothing was taken."""
        grid = self.scatter(data)
        return jnp.swapaxes(grid.reshape(*grid.shape[:2], -1), 0, 1)

    def from_times(
        self, grid: Float[Array, "times products all_columns"], shape: tuple[int, ...]
    ) -> Float[Array, "data *columns"]:
        """Inverse of :meth:`by_time`, into an array of ``shape``."""
        return self.gather(jnp.swapaxes(grid, 0, 1)).reshape(shape)
