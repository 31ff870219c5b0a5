"""Noise that couples the products of one time, but no two times: a block for each time."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from jaxtyping import Float

from lusee_bayes.core.arrays import Array, compiled, namespace
from lusee_bayes.core.checks import (
    require_finite,
    require_float64,
    require_shape,
    require_symmetric,
)
from lusee_bayes.core.linalg import checked_cholesky, solve_lower
from lusee_bayes.instrument.layout import DataLayout
from lusee_bayes.noise.covariance.base import Covariance, Factor
from lusee_bayes.noise.covariance.diagonal import DiagonalCovariance


class TimeBlockFactor(Factor):
    """The Cholesky factors of the blocks.

    Attributes
    ----------
    lower : (times, products, products) array
    layout : DataLayout
    """

    couples_times: ClassVar[bool] = False
    lower: Float[Array, "times products products"]
    layout: DataLayout

    def whiten(self, x):
        white = solve_lower(self.lower, self.layout.by_time(x), transpose=False)
        return self.layout.from_times(white, x.shape)

    def whiten_transpose(self, x):
        white = solve_lower(self.lower, self.layout.by_time(x), transpose=True)
        return self.layout.from_times(white, x.shape)

    def colour(self, z):
        return self.layout.from_times(
            namespace(self).tril(self.lower) @ self.layout.by_time(z), z.shape
        )

    def log_det(self):
        xp = namespace(self)
        return 2.0 * xp.log(xp.diagonal(self.lower, axis1=1, axis2=2)).sum()


class TimeBlockCovariance(Covariance):
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
    layout: DataLayout

    def __init__(self, blocks: Float[Array, "times products products"], layout: DataLayout):
        require_float64("the noise blocks", blocks)
        n = layout.n_products
        require_shape("the noise blocks", blocks, (layout.n_times, n, n))
        if layout.index is not None:
            present = layout.present.T
            both = present[:, :, None] & present[:, None, :]
            blocks = namespace(blocks, layout).where(both, blocks, np.eye(n)[None])
        require_finite("the noise blocks", blocks)
        require_symmetric("the noise covariance of one time", blocks)
        self.blocks = blocks
        self.layout = layout

    @property
    def size(self) -> int:
        return self.layout.size

    def mv(self, x):
        return self.layout.from_times(self.blocks @ self.layout.by_time(x), x.shape)

    def diagonal(self):
        return self.layout.gather(namespace(self).diagonal(self.blocks, axis1=1, axis2=2).T)

    def dense(self):
        return self.mv(np.eye(self.size))

    def factor(self):
        lower = checked_cholesky("the noise covariance of one time", self.blocks)
        return TimeBlockFactor(lower, self.layout)

    def time_weights(self, layout):
        self.factor()  # raises where a block is not positive definite
        return _inverse_blocks(self)

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


@compiled
def _inverse_blocks(noise: TimeBlockCovariance) -> Float[Array, "products products times"]:
    present = noise.layout.present.T
    both = present[:, :, None] & present[:, None, :]
    xp = namespace(noise)
    return xp.moveaxis(xp.where(both, xp.linalg.inv(noise.blocks), 0.0), 0, 2)
