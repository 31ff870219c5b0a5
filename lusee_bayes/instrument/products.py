"""The correlation products of n antennas: their order and their labels.

Voltages s_i give V_ij = <s_i conj(s_j)>: one real number for each antenna (auto), two for
each pair (Re, Im). They are ordered and labelled as in luseepy:
``00R, 01R, 01I, 02R, 02I, 03R, 03I, 11R, 12R, ... 33R``, n^2 real products in all.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float

from lusee_bayes.core.arrays import Array, as_complex, namespace

N_ANTENNAS = 4


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
    return tuple(
        Product(i, j, part)
        for i in range(n_antennas)
        for j in range(i, n_antennas)
        for part in (("R",) if i == j else ("R", "I"))
    )


def labels(n_antennas: int = N_ANTENNAS) -> tuple[str, ...]:
    """Return the labels of :func:`all_products`."""
    return tuple(p.label for p in all_products(n_antennas))


def auto_indices(n_antennas: int = N_ANTENNAS) -> np.ndarray:
    """Return the positions of the autos 00R, 11R, ... among the products; shape (antennas,)."""
    return np.array([k for k, p in enumerate(all_products(n_antennas)) if p.i == p.j])


def to_real(matrix: Complex[Array, "antennas antennas *rest"]) -> Float[Array, "products *rest"]:
    """Return the products of a Hermitian matrix V_ij (first two axes), in luseepy's order."""
    products = all_products(matrix.shape[0])
    picked = matrix[np.array([p.i for p in products]), np.array([p.j for p in products])]
    imaginary = np.array([p.part == "I" for p in products])
    imaginary = imaginary.reshape(-1, *(1,) * (picked.ndim - 1))
    return namespace(matrix).where(imaginary, picked.imag, picked.real)


def to_matrix(
    products: Float[Array, "products *rest"],
) -> Complex[Array, "antennas antennas *rest"]:
    """Return the Hermitian matrix V_ij of real products; inverse of :func:`to_real`."""
    xp, n = namespace(products), round(np.sqrt(products.shape[0]))
    position = {p: k for k, p in enumerate(all_products(n))}
    rows = []
    for i in range(n):
        for j in range(n):
            real = products[position[Product(min(i, j), max(i, j), "R")]]
            if i == j:
                imag = xp.zeros_like(real)
            else:
                imag = products[position[Product(min(i, j), max(i, j), "I")]]
            rows.append(as_complex(real, imag if i < j else -imag))
    return xp.stack(rows).reshape(n, n, *products.shape[1:])
