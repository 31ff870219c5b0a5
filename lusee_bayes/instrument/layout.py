"""Where each entry of the data vector d belongs: which product, which time.

d is stacked product by product with time running fastest. Samples that are flagged or were
never taken are not in d at all, so the positions are explicit.
"""

from __future__ import annotations

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

from lusee_bayes.core.arrays import Array, namespace
from lusee_bayes.core.checks import Described, is_traced
from lusee_bayes.core.errors import InputError


class DataLayout(Described, eqx.Module):
    """The product and the time of every entry of d.

    Attributes
    ----------
    n_products, n_times : int
        Size of the full grid.
    index : (data,) array of int or None
        Position ``product * n_times + time`` of every entry in the full grid; None if no sample is
        missing.
    """

    n_products: int = eqx.field(static=True)
    n_times: int = eqx.field(static=True)
    index: Int[Array, " data"] | None = None

    def description(self) -> tuple[str, ...]:
        grid = self.n_products * self.n_times
        absent = f", {grid - self.size} absent" if self.index is not None else ""
        return (f"{self.n_products} products x {self.n_times} times, {self.size} data{absent}",)

    @classmethod
    def from_flags(cls, flags: Bool[np.ndarray, "products times"]) -> DataLayout:
        """Return the layout that leaves out every sample whose flag is True.

        Raises
        ------
        InputError
            If all samples are flagged.
        """
        flags = np.asarray(flags, dtype=bool)
        if flags.all():
            raise InputError(
                f"all {flags.size} samples are flagged or missing; there is nothing to map"
            )
        index = None if not flags.any() else np.flatnonzero(~flags.ravel())
        return cls(*flags.shape, index)

    @property
    def size(self) -> int:
        """Number of entries of d."""
        return self.n_products * self.n_times if self.index is None else self.index.shape[0]

    @property
    def product(self) -> np.ndarray:
        """Number of the product of every entry, shape (data,)."""
        return self._positions() // self.n_times

    @property
    def time(self) -> np.ndarray:
        """Number of the time of every entry, shape (data,)."""
        return self._positions() % self.n_times

    @property
    def present(self) -> Bool[Array, "products times"]:
        """Whether each sample of the grid is in d."""
        if self.index is None:
            return np.ones((self.n_products, self.n_times), dtype=bool)
        return self.scatter(namespace(self.index).ones(self.size, dtype=bool))

    def _positions(self) -> np.ndarray:
        if self.index is None:
            return np.arange(self.size)
        return np.asarray(self.index)

    def require_same(self, other: DataLayout) -> None:
        """Check that another layout holds the same samples, where both are known.

        Raises
        ------
        InputError
            If it does not.
        """
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
        """Return the entries of d, with any trailing axes, of a full grid."""
        flat = grid.reshape(self.n_products * self.n_times, *grid.shape[2:])
        return flat if self.index is None else flat[self.index]

    def scatter(self, data: Shaped[Array, "data *rest"]) -> Shaped[Array, "products times *rest"]:
        """Put the entries of d onto the full grid; missing samples are zero."""
        rest = data.shape[1:]
        if self.index is None:
            return data.reshape(self.n_products, self.n_times, *rest)
        xp = namespace(data, self.index)
        flat = xp.zeros((self.n_products * self.n_times, *rest), dtype=data.dtype)
        if xp is np:
            flat[self.index] = data
        else:
            flat = flat.at[self.index].set(data)
        return flat.reshape(self.n_products, self.n_times, *rest)

    def by_time(
        self, data: Float[Array, "data *columns"]
    ) -> Float[Array, "times products all_columns"]:
        """Return d with the products of one time together; missing samples are zero."""
        grid = self.scatter(data)
        return grid.reshape(*grid.shape[:2], -1).swapaxes(0, 1)

    def from_times(
        self, grid: Float[Array, "times products all_columns"], shape: tuple[int, ...]
    ) -> Float[Array, "data *columns"]:
        """Return the array of this shape that :meth:`by_time` has made ``grid`` of."""
        return self.gather(grid.swapaxes(0, 1)).reshape(shape)
