"""A as a linear function of the beams, for fixed orientations and beams that change.

Row t of product k is b_k R(t), with R(t) block diagonal in ell: one rotation matrix for each ell
and sample, computed once. Then A costs 16 products with (2 ell + 1)^2 numbers per ell and sample,
and derivatives cost no more.
"""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Float

from lusee_bayes.core.arrays import Array
from lusee_bayes.core.checks import require_shape
from lusee_bayes.core.harmonics import n_modes
from lusee_bayes.instrument.beams import ProductBeams
from lusee_bayes.instrument.coupling import CouplingMatrix
from lusee_bayes.instrument.layout import DataLayout
from lusee_bayes.instrument.pointing import Pointing

# unit beams that are rotated at once
CHUNK = 64


class BeamOperator(eqx.Module):
    """R(t) of every sample, which rotates beams into Galactic coordinates, up to one lmax.

    Attributes
    ----------
    blocks : tuple of (2 ell + 1, times, 2 ell + 1) arrays
        R(t) for every ell: topocentric orders first, Galactic orders last.
    layout : DataLayout
        The product and the time of every row of A.
    """

    blocks: tuple[Float[Array, "_ times _"], ...]
    layout: DataLayout

    @classmethod
    def of(cls, pointing: Pointing, layout: DataLayout) -> BeamOperator:
        """Compute R(t) of all samples.

        It takes 8 (lmax + 1)^3 4 / 3 bytes a sample: 54 MB for a month at lmax 24.

        Parameters
        ----------
        pointing : Pointing
            The orientations at every sample.
        layout : DataLayout
            Leaves out missing samples.

        Returns
        -------
        BeamOperator
            Up to the lmax of ``pointing``.
        """
        lmax = len(pointing.pole_from_galactic.blocks) - 1
        size = n_modes(lmax)
        blocks: list[list[Array]] = [[] for _ in range(lmax + 1)]
        for start in range(0, size, CHUNK):
            unit = jnp.eye(CHUNK, size, start)
            rows = _turned(unit, pointing)
            for ell in range(lmax + 1):
                first, end = max(start, ell**2), min(start + CHUNK, (ell + 1) ** 2)
                if first < end:
                    inside = rows[first - start : end - start, :, ell**2 : (ell + 1) ** 2]
                    blocks[ell].append(inside)
        return cls(tuple(jnp.concatenate(parts) for parts in blocks), layout)

    def coupling(self, beams: ProductBeams) -> Float[Array, "data modes"]:
        """Compute A as a matrix.

        Parameters
        ----------
        beams : ProductBeams
            Of all products, up to the operator's lmax.

        Returns
        -------
        (data, modes) array
            A of these beams.

        Raises
        ------
        InputError
            If the beams have another lmax.
        """
        lmax = len(self.blocks) - 1
        require_shape("the beam coefficients", beams.modes, (None, n_modes(lmax)))
        parts = [
            jnp.einsum("km,mtn->ktn", beams.modes[:, ell**2 : (ell + 1) ** 2], block)
            for ell, block in enumerate(self.blocks)
        ]
        return self.layout.gather(jnp.concatenate(parts, axis=2))


@eqx.filter_jit
def _turned(
    beams: Float[Array, "beams modes"], pointing: Pointing
) -> Float[Array, "beams times modes"]:
    """Rows of A of any number of beams, without a response and with nothing missing."""
    layout = DataLayout(beams.shape[0], pointing.n_times)
    coupling = CouplingMatrix.of_modes(beams, pointing, layout)
    return coupling.dense().reshape(beams.shape[0], pointing.n_times, -1)
