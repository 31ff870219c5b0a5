"""The coupling matrix A: from sky coefficients to visibilities.

With b_rk the coefficients of product k in run r, turned into the Moon-fixed frame, and W_p its
tilted copies (``rotations.tilts``), a visibility is

    V_k(t) = [ D_z(-phi(t)) sum_p e_p(t) W_p b_rk ] . a        (a: the sky in the mean-pole frame)
           = sum_p e_p(t) sum_m ( cos m phi(t) X_pm + sin m phi(t) Y_pm ),
    X_pm = sum_l (W_lm a_lm + W_l,-m a_l,-m),    Y_pm = sum_l (W_lm a_l,-m - W_l,-m a_lm).

Time enters only through exp(i m phi) and the slow scalars e_p, beams only through b: a product of
A with a vector never forms A, and nothing in it but the last sum grows with the number of times.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from lusee_bayes.beams import ProductBeams
from lusee_bayes.checks import InputError, require_float64, require_shape
from lusee_bayes.harmonics import mode_numbers
from lusee_bayes.layout import DataLayout
from lusee_bayes.observation import Observation
from lusee_bayes.pointing import Pointing
from lusee_bayes.rotations import tilts, turn_about_z


class CouplingMatrix(eqx.Module):
    """A, of shape (data, modes): the beams of an observation, in Galactic coordinates.

    ``A @ sky`` and ``A.transpose_mv(data)`` use the structure; :meth:`rows` and :meth:`dense` give
    the numbers. Differentiable in the beams.
    """

    body_beams: Float[Array, "runs products powers modes"]
    pointing: Pointing
    layout: DataLayout
    frequency_mhz: float = eqx.field(static=True)

    @classmethod
    def build(
        cls,
        beams: ProductBeams,
        pointing: Pointing,
        layout: DataLayout | None = None,
    ) -> CouplingMatrix:
        """A for these beams and orientations; ``layout`` leaves out missing samples."""
        n_modes = sum(b.shape[0] for b in pointing.pole_from_galactic.blocks)
        require_shape("the beam coefficients", beams.modes, (beams.n_products, n_modes))
        if layout is None:
            layout = DataLayout(beams.n_products, pointing.n_times)
        if (layout.n_products, layout.n_times) != (beams.n_products, pointing.n_times):
            raise InputError(
                f"the data layout has {layout.n_products} products x {layout.n_times} times, "
                f"beams and pointing have {beams.n_products} x {pointing.n_times}"
            )
        body = _body_beams(beams.modes, pointing)
        return cls(body, pointing, layout, beams.frequency_mhz)

    @classmethod
    def observe(cls, beams: ProductBeams, observation: Observation) -> CouplingMatrix:
        """A of a complete observation with these beams."""
        return cls.build(beams, Pointing.of(observation, beams.lmax))

    @property
    def shape(self) -> tuple[int, int]:
        """(data, modes)"""
        return self.layout.size, self.body_beams.shape[-1]

    @property
    def lmax(self) -> int:
        """Highest ell of the sky it acts on."""
        return len(self.pointing.pole_from_galactic.blocks) - 1

    def __matmul__(self, sky: Float[Array, " modes"]) -> Float[Array, " data"]:
        """A a: the visibilities, in K, of a sky with Galactic coefficients ``sky`` in K.

        The values of ``sky`` are not looked at: NaN comes out as NaN.
        """
        require_float64("the sky", sky)
        require_shape("the sky", sky, (self.shape[1],))
        return _forward(self, sky)

    def transpose_mv(self, data: Float[Array, " data"]) -> Float[Array, " modes"]:
        """A^T d."""
        require_float64("the data", data)
        require_shape("the data", data, (self.shape[0],))
        return _backward(self, data)

    def rows(
        self, product: Int[np.ndarray, " rows"], time: Int[np.ndarray, " rows"]
    ) -> Float[Array, "rows modes"]:
        """Rows of A for chosen product and time numbers, flagged or not."""
        product, time = np.asarray(product), np.asarray(time)
        require_shape("time", time, product.shape)
        for name, numbers, limit in [
            ("product", product, self.layout.n_products),
            ("time", time, self.layout.n_times),
        ]:
            if ((numbers < 0) | (numbers >= limit)).any():
                raise InputError(f"{name} numbers must lie in 0..{limit - 1}, got {numbers}")
        rows = jnp.zeros((len(product), self.shape[1]))
        for run, span in self.pointing.runs():
            here = np.flatnonzero((time >= span.start) & (time < span.stop))
            times, position = np.unique(time[here], return_inverse=True)
            block = self._block(run, times)[product[here], position]
            rows = rows.at[here].set(block)
        return rows

    def dense(self) -> Float[Array, "data modes"]:
        """A as a matrix (96 MB for 5232 x 2304)."""
        return _dense(self)

    def _block(self, run: int, times) -> Float[Array, "products times modes"]:
        """Rows of all products for some samples of one run; times: a slice or numbers."""
        _, m = mode_numbers(self.lmax)
        factors = self.pointing.tilt_factors()[times]
        azimuth = self.pointing.azimuth[times]
        tilted = jnp.einsum("tp,kpc->ktc", factors, self.body_beams[run])
        turned = _turn_each(tilted, azimuth, m)
        return self.pointing.pole_from_galactic.T(turned)


def _turn_each(
    beams: Float[Array, "products times modes"], azimuth: Float[Array, " times"], m: np.ndarray
) -> Float[Array, "products times modes"]:
    """D_z(-phi(t)) on the coefficients of every time."""
    mirrored = beams[..., np.arange(len(m)) - 2 * m]
    angle = azimuth[:, None] * jnp.arange(0.0, m.max() + 1.0)[None]
    cosine, sine = jnp.cos(angle), jnp.sin(angle)
    signed = sine[:, np.abs(m)] * _signs(m)[None]
    return beams * cosine[None, :, np.abs(m)] - mirrored * signed[None]


@eqx.filter_jit
def _body_beams(
    modes: Float[Array, "products modes"], pointing: Pointing
) -> Float[Array, "runs products powers modes"]:
    """Tilted copies of the beams in the Moon-fixed frame, for every run's turntable angle."""
    runs = []
    for run in range(len(pointing.run_starts) - 1):
        body = pointing.mcmf_from_topocentric(turn_about_z(modes, pointing.turntable[run]))
        runs.append(jnp.stack(tilts(body, pointing.order), axis=1))
    return jnp.stack(runs)


@eqx.filter_jit
def _dense(coupling: CouplingMatrix) -> Float[Array, "data modes"]:
    blocks = [coupling._block(run, span) for run, span in coupling.pointing.runs()]
    grid = blocks[0] if len(blocks) == 1 else jnp.concatenate(blocks, axis=1)
    return coupling.layout.gather(grid)


def _phases(pointing: Pointing, lmax: int) -> tuple[Array, Array]:
    """cos m phi(t) and sin m phi(t), each (times, orders)."""
    angle = pointing.azimuth[:, None] * jnp.arange(lmax + 1.0)[None]
    return jnp.cos(angle), jnp.sin(angle)


@eqx.filter_jit
def _forward(coupling: CouplingMatrix, sky: Float[Array, " modes"]) -> Float[Array, " data"]:
    _, m = mode_numbers(coupling.lmax)
    a = coupling.pointing.pole_from_galactic(sky)
    # X and Y of the module's equation
    same = coupling.body_beams * a[None, None, None]
    crossed = coupling.body_beams * (a[np.arange(len(m)) - 2 * m] * _signs(m))[None, None, None]
    by_order = jax.vmap(lambda x: _sum_orders(x, np.abs(m), coupling.lmax))
    shape = coupling.body_beams.shape
    cosine, sine = _phases(coupling.pointing, coupling.lmax)
    factors = coupling.pointing.tilt_factors()
    real = by_order(same.reshape(-1, shape[-1])).reshape(*shape[:-1], -1)
    imag = by_order(crossed.reshape(-1, shape[-1])).reshape(*shape[:-1], -1)
    grids = []
    for run, span in coupling.pointing.runs():
        c = jnp.einsum("tm,kpm->ktp", cosine[span], real[run])
        s = jnp.einsum("tm,kpm->ktp", sine[span], imag[run])
        grids.append(jnp.einsum("tp,ktp->kt", factors[span], c + s))
    return coupling.layout.gather(jnp.concatenate(grids, axis=1))


@eqx.filter_jit
def _backward(coupling: CouplingMatrix, data: Float[Array, " data"]) -> Float[Array, " modes"]:
    _, m = mode_numbers(coupling.lmax)
    grid = coupling.layout.scatter(data)
    cosine, sine = _phases(coupling.pointing, coupling.lmax)
    factors = coupling.pointing.tilt_factors()
    total = jnp.zeros(coupling.shape[1])
    for run, span in coupling.pointing.runs():
        weighted = jnp.einsum("kt,tp->kpt", grid[:, span], factors[span])
        c = jnp.einsum("kpt,tm->kpm", weighted, cosine[span])[..., np.abs(m)]
        s = jnp.einsum("kpt,tm->kpm", weighted, sine[span])[..., np.abs(m)]
        beams = coupling.body_beams[run]
        mirrored = beams[..., np.arange(len(m)) - 2 * m]
        total = total + jnp.einsum("kpc,kpc->c", c, beams)
        total = total - jnp.einsum("kpc,kpc->c", s, mirrored) * _signs(m)
    return coupling.pointing.pole_from_galactic.T(total)


def _signs(m: np.ndarray) -> Float[Array, " modes"]:
    return jnp.sign(jnp.asarray(m, dtype=jnp.float64))


def _sum_orders(values: Float[Array, " modes"], order: np.ndarray, lmax: int) -> Array:
    return jax.ops.segment_sum(values, order, num_segments=lmax + 1)
