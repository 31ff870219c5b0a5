"""Products of pairs of antennas, their correlations, and the layout of data.

Voltages s_i give V_ij = <s_i conj(s_j)>: one real number for each antenna (auto), two for
each pair (Re, Im). They are ordered and labelled as in luseepy:
``00R, 01R, 01I, 02R, 02I, 03R, 03I, 11R, 12R, ... 33R``, n^2 real products in all.

Names of products and signs of imaginary parts vary with the instrument and its software;
:meth:`.Visibilities.from_arrays` converts them with the functions of this module.

A :class:`DataLayout` gives the product and the time of each entry of the data vector d.
d is stacked product by product with time running fastest. Flagged and missing samples are not in d
at all, so the positions are explicit.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import lru_cache
from itertools import combinations_with_replacement
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Complex, Float, Int, Shaped

from lusee_bayes.core.arrays import Array, Grid, GridFlags, as_complex, namespace, placed, read_only
from lusee_bayes.core.checks import Described, is_traced
from lusee_bayes.core.errors import InputError, require_known
from lusee_bayes.core.lazy import pandas

N_ANTENNAS = 4
Products = Float[Array, "products *rest"]
Hermitian = Complex[Array, "antennas antennas *rest"]
ByTime = Float[Array, "times products all_columns"]
Columns = Float[Array, "data *columns"]


class Product(NamedTuple):
    """One real correlation product: the antennas ``i <= j`` and the part, ``"R"`` or ``"I"``."""

    i: int
    j: int
    part: str

    @property
    def label(self) -> str:
        """Label as in luseepy, for example ``02I``."""
        return f"{self.i}{self.j}{self.part}"


@lru_cache
def all_products(n_antennas: int = N_ANTENNAS) -> tuple[Product, ...]:
    """Return the n^2 real products of ``n_antennas`` antennas, in luseepy's order."""
    pairs = combinations_with_replacement(range(n_antennas), 2)
    return tuple(Product(i, j, part) for i, j in pairs for part in ("R" if i == j else "RI"))


def labels(n_antennas: int = N_ANTENNAS) -> tuple[str, ...]:
    """Return the labels of :func:`all_products`."""
    return tuple(p.label for p in all_products(n_antennas))


def labels_of(n_products: int) -> tuple[str, ...]:
    """Return the labels of ``n_products`` products; InputError if it is not a square number."""
    return labels(antennas_of(n_products))


def antennas_of(n_products: int) -> int:
    """Return the number of antennas; InputError if ``n_products`` is not a square number."""
    n = round(np.sqrt(n_products))
    if n * n != n_products:
        raise InputError(f"{n_products} products do not match any number of antennas; expected n^2")
    return n


def auto_indices(n_antennas: int = N_ANTENNAS) -> np.ndarray:
    """Return the positions of the autos 00R, 11R, ... among the products; shape (antennas,)."""
    return np.array([k for k, p in enumerate(all_products(n_antennas)) if p.i == p.j])


@lru_cache
def ports(n_antennas: int = N_ANTENNAS) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the two ports of every product, and whether it is an imaginary part."""
    i, j, part = zip(*all_products(n_antennas), strict=True)
    return read_only(np.array(i), np.array(j), np.array(part) == "I")


def to_real(matrix: Hermitian) -> Products:
    """Return the products of a Hermitian matrix V_ij (first two axes), in luseepy's order."""
    i, j, imaginary = ports(matrix.shape[0])
    picked = matrix[i, j]
    imaginary = imaginary.reshape(-1, *(1,) * (picked.ndim - 1))
    return namespace(matrix).where(imaginary, picked.imag, picked.real)


def to_matrix(products: Products) -> Hermitian:
    """Return the Hermitian matrix V_ij of real products; inverse of :func:`to_real`."""
    xp, n = namespace(products), antennas_of(products.shape[0])
    at, rows = {label: products[k] for k, label in enumerate(labels(n))}, []
    for i, j in np.ndindex(n, n):
        pair = f"{min(i, j)}{max(i, j)}"
        imag = xp.zeros_like(at[f"{pair}R"]) if i == j else at[f"{pair}I"]
        rows.append(as_complex(at[f"{pair}R"], imag if i < j else -imag))
    return xp.stack(rows).reshape(n, n, *products.shape[1:])


# meaning of an imaginary part, and the sign that turns it into that of <s_i conj(s_j)>
CONVENTIONS = {"s_i conj(s_j)": 1.0, "conj(s_i) s_j": -1.0}
# an auto is real; rounding of 32-bit numbers is below this relative error
AUTO_TOLERANCE = 1e-5
NAME = re.compile(r"\s*(\d)\s*[-_x, ]?\s*(\d)\s*([RI]?)\s*", re.IGNORECASE)


def in_order(
    columns: Sequence[tuple[str, Float[np.ndarray, "*shape"]]], n_antennas: int = N_ANTENNAS
) -> Float[np.ndarray, "products *shape"]:
    """Return named columns in the package's order of products, NaN for missing products.

    Raises
    ------
    InputError
        For a name that is unknown or given twice.
    """
    places = {label: place for place, label in enumerate(labels(n_antennas))}
    grid = np.full((len(places), *columns[0][1].shape), np.nan)
    for number, (name, values) in enumerate(columns):
        require_known("unknown product", name, places)
        if name in [other for other, _ in columns[:number]]:
            raise InputError(f"the product {name} is listed twice; list each once")
        grid[places[name]] = values
    return grid


def real_products(data: Any, products: Any, flags: Any, convention: str, n_antennas: int) -> Grid:
    """Return the real products of arrays of correlations in the package's order.

    Parameters
    ----------
    data : (times, names) array
        Complex correlations, or real products; NaN, or masked, where a sample is absent.
    products : sequence of str or None
        The name of each column; see :meth:`.Visibilities.from_arrays`.
    flags : (times, names) or (times,) array of bool, optional
        True where a sample is not used.
    convention : str
        A key of ``CONVENTIONS``.
    n_antennas : int

    Returns
    -------
    (products, times) array
        In the unit of the data, NaN where absent.

    Raises
    ------
    InputError
        For names that are unknown or given twice, wrong shapes, autos that are not real,
        infinities, and an unknown convention.
    """
    masked = getattr(data, "mask", False)
    data = _numbers(data)
    require_known("unknown convention", convention, CONVENTIONS)
    ports_and_parts = _columns(products, np.iscomplexobj(data), n_antennas)
    if data.shape[1] != len(ports_and_parts):
        turned = "; transpose them" if data.shape[0] == len(ports_and_parts) else ""
        why = f"the data have shape {data.shape}, expected (times, {len(ports_and_parts)}){turned}"
        raise InputError(why)
    absent = np.isnan(data) | masked | _flags(flags, data.shape)
    if np.isinf(data[~absent]).any():
        first = np.argwhere(np.isinf(data) & ~absent)[0]
        raise InputError(
            f"the data contain infinity at time {first[0]}, product {first[1]}; flag these samples"
        )
    columns: list[tuple[str, np.ndarray]] = []
    for (i, j, part), values, gone in zip(ports_and_parts, data.T, absent.T, strict=True):
        pair, sign = f"{min(i, j)}{max(i, j)}", CONVENTIONS[convention] * (1.0 if i <= j else -1.0)
        imaginary = np.abs(values.imag) > AUTO_TOLERANCE * np.abs(values.real)
        if i == j and (imaginary & ~gone).any():
            k = int(np.argmax(imaginary & ~gone))
            wrong = f"the auto {pair} is {values[k]:.6g} at time {k}, not real; check the names"
            raise InputError(wrong)
        parts = {part: values} if part else {"R": values.real, "I": values.imag}
        for name, numbers in parts.items():
            if i != j or name == "R":
                signed = np.where(gone, np.nan, numbers if name == "R" else sign * numbers)
                columns.append((f"{pair}{name}", signed))
    return in_order(columns, n_antennas)


def _numbers(data: Any) -> np.ndarray:
    try:
        data = np.asarray(data)
        data = data.astype(np.complex128 if np.iscomplexobj(data) else np.float64)
    except (ValueError, TypeError) as error:
        wrong = f"the data are not an array of numbers: {error}; give (times, products), in K"
        raise InputError(wrong) from error
    if data.ndim != 2 or not data.size:
        raise InputError(f"the data have shape {data.shape}, expected (times, products)")
    return data


def _columns(products: Any, is_complex: bool, n_antennas: int) -> list[tuple[int, int, str]]:
    """Ports and part of each column; the part is empty for complex numbers."""
    if products is None:
        real = labels(n_antennas)
        products = dict.fromkeys(label[:2] for label in real) if is_complex else real
    if isinstance(products, str):
        raise InputError(f"products is '{products}'; give a list of the names of the columns")
    columns: list[tuple[int, int, str]] = []
    for name in products:
        match = NAME.fullmatch(name if isinstance(name, str) else "".join(map(str, np.ravel(name))))
        if not match:
            example = "'01'" if is_complex else "'01R' and '01I'"
            raise InputError(f"unknown product '{name}'; name the two ports, such as {example}")
        i, j, part = int(match[1]), int(match[2]), match[3].upper()
        if max(i, j) >= n_antennas:
            wrong = f"the product '{name}' has port {max(i, j)}, beyond n_antennas = {n_antennas}"
            raise InputError(wrong)
        if is_complex and part:
            raise InputError(f"the data are complex; replace '{name}' by its ports, '{i}{j}'")
        if not is_complex and not part and i != j:
            raise InputError(f"the data are real; name the part of '{name}', {name}R or {name}I")
        if i == j and part == "I":
            raise InputError(f"unknown product '{name}': an auto is real")
        columns.append((i, j, part if is_complex else part or "R"))
        if columns[-1] in columns[:-1]:
            raise InputError(f"the product '{name}' is listed twice; list each once")
    return columns


def _flags(flags: Any, shape: tuple[int, ...]) -> np.ndarray:
    flags = np.zeros(shape, dtype=bool) if flags is None else np.asarray(flags)
    if flags.dtype.kind not in "biu" or not np.isin(flags, (0, 1)).all():
        raise InputError("flags must be true or false; give true where samples are not used")
    if flags.shape not in (shape, shape[:1]):
        wrong = f"flags have shape {flags.shape}, expected {shape} as the data, or {shape[:1]}"
        raise InputError(wrong)
    return (flags if flags.ndim == 2 else flags[:, None]).astype(bool)


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
    def from_flags(cls, flags: GridFlags) -> DataLayout:
        """Return the layout that leaves out every sample whose flag is True.

        Raises
        ------
        InputError
            If all samples are flagged.
        """
        if (flags := np.asarray(flags, dtype=bool)).all():
            raise InputError(f"all {flags.size} samples are flagged or missing: nothing to map")
        return cls(*flags.shape, None if not flags.any() else np.flatnonzero(~flags.ravel()))

    @property
    def size(self) -> int:
        """Number of entries of d."""
        return self.n_products * self.n_times if self.index is None else self.index.shape[0]

    @property
    def product(self) -> Int[Array, " data"]:
        """Product number of every entry, shape (data,)."""
        return self._positions() // self.n_times

    @property
    def time(self) -> Int[Array, " data"]:
        """Time number of every entry, shape (data,)."""
        return self._positions() % self.n_times

    @property
    def present(self) -> Bool[Array, "products times"]:
        """Whether each sample of the grid is in d."""
        return self.scatter(namespace(self.index).ones(self.size, dtype=bool))

    def _positions(self) -> Int[Array, " data"]:
        return np.arange(self.size) if self.index is None else self.index

    def require_same(self, other: DataLayout) -> None:
        """Check that another layout has the same samples, if both are known.

        Raises
        ------
        InputError
            If it does not.
        """
        ours, theirs = ((one.n_products, one.n_times, one.size) for one in (self, other))
        same = ours == theirs
        if same and self.index is not None and other.index is not None:
            same = is_traced(self.index, other.index) or np.array_equal(self.index, other.index)
        if not same:
            raise InputError(
                f"two layouts of {self.size} and {other.size} data contain different samples; "
                "build both terms for the same observation and flags"
            )

    def gather(self, grid: Shaped[Array, "products times *rest"]) -> Shaped[Array, "data *rest"]:
        """Return the entries of d from a full grid, with any trailing axes."""
        flat = grid.reshape(self.n_products * self.n_times, *grid.shape[2:])
        return flat if self.index is None else flat[self.index]

    def scatter(self, data: Shaped[Array, "data *rest"]) -> Shaped[Array, "products times *rest"]:
        """Put the entries of d onto the full grid; missing samples are zero."""
        rest = data.shape[1:]
        if self.index is None:
            return data.reshape(self.n_products, self.n_times, *rest)
        xp = namespace(data, self.index)
        flat = xp.zeros((self.n_products * self.n_times, *rest), dtype=data.dtype)
        return placed(flat, self.index, data).reshape(self.n_products, self.n_times, *rest)

    def by_time(self, data: Columns) -> ByTime:
        """Return d with the products of one time together; missing samples are zero."""
        grid = self.scatter(data)
        return grid.reshape(*grid.shape[:2], -1).swapaxes(0, 1)

    def from_times(self, grid: ByTime, shape: tuple[int, ...]) -> Columns:
        """Return the array of this shape from which :meth:`by_time` computed ``grid``."""
        return self.gather(grid.swapaxes(0, 1)).reshape(shape)


def without_gaps(visibilities: Grid, layout: DataLayout) -> Grid:
    """Return visibilities with a value at every sample, for computing noise.

    The noise of a sample depends on the antenna temperatures of its ports, and in the exact form on
    all products at its time. Missing values are interpolated linearly, in the number of the sample,
    between the nearest samples of the same product (at the ends the nearest one is used). A cross
    that was never measured is zero: its ports are assumed to be uncorrelated. The auto of a port
    that was never used is the mean of the others, and no sample depends on it.

    Parameters
    ----------
    visibilities : (products, times) array
        In K. A sample is absent if it is not in the layout and its value is 0 (as
        :meth:`DataLayout.scatter` leaves it) or NaN; a model's values at absent samples are kept.
    layout : DataLayout

    Returns
    -------
    (products, times) array

    Raises
    ------
    InputError
        If an auto is absent at all times, but a product of its port is not.
    """
    if layout.index is None or is_traced(visibilities, layout.index):
        return visibilities
    values, present = np.array(visibilities), np.asarray(layout.present)
    absent = ~present & (np.isnan(values) | (values == 0.0))
    if not absent.any():
        return visibilities
    i, j, _ = ports(antennas_of(layout.n_products))
    filled = interpolated(np.where(absent, np.nan, values))
    values, measured = np.where(absent, filled, values), present.any(1)
    autos, names = i == j, labels_of(layout.n_products)
    unused = autos & absent.all(1)
    for auto in np.flatnonzero(unused):
        if (needed := measured & ((i == i[auto]) | (j == i[auto]))).any():
            raise InputError(
                f"the auto {names[auto]} is missing at all times, but the noise of "
                f"{names[int(needed.argmax())]} depends on it; give modelled visibilities of all "
                "samples, such as the signal of a CouplingMatrix without flags"
            )
    values[unused] = values[autos & ~absent.all(1)].mean(0)
    return namespace(visibilities).asarray(values)


def interpolated(grid: Grid) -> Grid:
    """Visibilities with NaN interpolated in time, and 0 for products without any."""
    table = pandas.DataFrame(np.asarray(grid).T).interpolate(limit_direction="both")
    return table.fillna(0.0).to_numpy().T
