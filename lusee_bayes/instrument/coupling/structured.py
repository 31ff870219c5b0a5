"""A of the beams of an observation: from sky coefficients to visibilities.

With b_rk the coefficients of product k in run r, turned into the Moon-fixed frame, and W_j what the
pointing's function of time u_j has of its tilted copies (:mod:`.window_average`), a visibility, the
mean over its window, is ::

    V_k(t) = [ D_z(-phi(t)) sum_j u_j(t) W_j ] . a             (a: the sky in the mean-pole frame)
           = sum_j u_j(t) sum_m ( cos m phi(t) X_jm + sin m phi(t) Y_jm ),
    X_jm = sum_l (W_lm a_lm + W_l,-m a_l,-m),    Y_jm = sum_l (W_lm a_l,-m - W_l,-m a_lm).

Time enters only through exp(i m phi) and the slow scalars u_j, beams only through b: a product of
A with a vector never forms A, and nothing in it but the last sum grows with the number of times.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int

from lusee_bayes.core.arrays import Array, compiled, namespace
from lusee_bayes.core.checks import require_shape
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.harmonics import lmax_of, mode_numbers
from lusee_bayes.instrument.beams import ProductBeams
from lusee_bayes.instrument.coupling.base import Coupling
from lusee_bayes.instrument.coupling.body_beams import body_beams
from lusee_bayes.instrument.coupling.dense import DenseCoupling
from lusee_bayes.instrument.layout import DataLayout
from lusee_bayes.instrument.observation import Observation
from lusee_bayes.instrument.pointing import Pointing


class CouplingMatrix(Coupling):
    """A of the beams of an observation, in Galactic coordinates, with its structure in time.

    ``A @ sky`` and ``A.transpose_mv(data)`` use the structure; :meth:`rows` and :meth:`dense` give
    the numbers. Differentiable in the beams and the response. Made by :meth:`observe`,
    :meth:`build` or :meth:`of_modes`.

    Attributes
    ----------
    body_beams : (runs, products, functions, modes) array
        Beams turned by the turntable into the Moon-fixed frame, as each function of time sees them.
    by_order : (runs, orders, beams, degrees) array
        The same coefficients order by order: the matrices behind X and Y of the module's equations.
    pointing : Pointing
        The orientations at every sample.
    layout : DataLayout
        The product and the time of every row.
    """

    body_beams: Float[Array, "runs products functions modes"]
    by_order: Float[Array, "runs orders beams degrees"]
    pointing: Pointing
    layout: DataLayout

    @classmethod
    def build(
        cls,
        beams: ProductBeams,
        pointing: Pointing,
        layout: DataLayout | None = None,
    ) -> CouplingMatrix:
        """Build A from beams and orientations.

        Parameters
        ----------
        beams : ProductBeams
            Beams of all products, up to the lmax of ``pointing``.
        pointing : Pointing
            The orientations at every sample.
        layout : DataLayout, optional
            Leaves out missing samples; without it none is missing.

        Returns
        -------
        CouplingMatrix
            A of these beams.

        Raises
        ------
        InputError
            If beams, pointing and layout differ in lmax, products or times.
        """
        n_modes = sum(b.shape[0] for b in pointing.pole_from_galactic.blocks)
        require_shape("the beam coefficients", beams.modes, (beams.n_products, n_modes))
        if layout is None:
            layout = DataLayout(beams.n_products, pointing.n_times)
        if (layout.n_products, layout.n_times) != (beams.n_products, pointing.n_times):
            raise InputError(
                f"the data layout has {layout.n_products} products x {layout.n_times} times, "
                f"beams and pointing have {beams.n_products} x {pointing.n_times}"
            )
        return cls.of_modes(beams.modes, pointing, layout)

    @classmethod
    def of_modes(
        cls,
        modes: Float[Array, "beams modes"],
        pointing: Pointing,
        layout: DataLayout,
    ) -> CouplingMatrix:
        """Build A of any number of beams from their coefficients; nothing is checked.

        Parameters
        ----------
        modes : (beams, modes) array
            Harmonic coefficients in the topocentric frame, real packed.
        pointing : Pointing
            The orientations at every sample.
        layout : DataLayout
            With as many products as there are beams.

        Returns
        -------
        CouplingMatrix
            A of these beams.
        """
        body = body_beams(modes, pointing)
        lmax = len(pointing.pole_from_galactic.blocks) - 1
        return cls(body, _by_order(body, lmax), pointing, layout)

    @classmethod
    def observe(cls, beams: ProductBeams, observation: Observation) -> CouplingMatrix:
        """Build A of a complete observation.

        Parameters
        ----------
        beams : ProductBeams
            Beams of all products; their lmax is that of the sky.
        observation : Observation
            Place, times and turntable angles.

        Returns
        -------
        CouplingMatrix
            A with a row for every product and time.
        """
        return cls.build(beams, Pointing.of(observation, beams.lmax))

    def description(self) -> tuple[str, ...]:
        return (
            *super().description(),
            *self.layout.description(),
            "never formed: beams, pointing and a turn for each order m",
        )

    @property
    def shape(self) -> tuple[int, int]:
        return self.layout.size, self.body_beams.shape[-1]

    @property
    def lmax(self) -> int:
        """Highest ell of the sky it acts on."""
        return len(self.pointing.pole_from_galactic.blocks) - 1

    @property
    def has_time_structure(self) -> bool:
        return self.response is None

    def plus(self, amplitude, direction):
        if direction.response is not None:
            raise InputError("the direction must have no response of its own")
        if not isinstance(direction, CouplingMatrix):
            plain = replace(self, response=None).dense()
            return DenseCoupling(plain, response=self.response).plus(amplitude, direction)
        self.layout.require_same(direction.layout)
        return replace(
            self,
            body_beams=self.body_beams + amplitude * direction.body_beams,
            by_order=self.by_order + amplitude * direction.by_order,
        )

    def rows(
        self, product: Int[np.ndarray, " rows"], time: Int[np.ndarray, " rows"]
    ) -> Float[Array, "rows modes"]:
        """Compute chosen rows of A, flagged or not, without the response.

        Parameters
        ----------
        product, time : (rows,) arrays of int
            Product and time number of every row.

        Returns
        -------
        (rows, modes) array
            The rows, in the order asked for.

        Raises
        ------
        InputError
            If a number is out of range, or the two arrays differ in length.
        """
        product, time = np.asarray(product), np.asarray(time)
        require_shape("time", time, product.shape)
        for name, numbers, limit in [
            ("product", product, self.layout.n_products),
            ("time", time, self.layout.n_times),
        ]:
            if ((numbers < 0) | (numbers >= limit)).any():
                raise InputError(f"{name} numbers must lie in 0..{limit - 1}, got {numbers}")
        places, blocks = [], []
        for run, span in self.pointing.runs():
            here = np.flatnonzero((time >= span.start) & (time < span.stop))
            times, position = np.unique(time[here], return_inverse=True)
            places.append(here)
            blocks.append(self._block(run, times)[product[here], position])
        return namespace(*blocks).concatenate(blocks)[np.argsort(np.concatenate(places))]

    def dense(self) -> Float[Array, "data modes"]:
        """A as a matrix (96 MB for 5232 x 2304)."""
        return _dense(self)

    def _forward(self, sky):
        return _forward(self, sky)

    def _backward(self, data):
        return _backward(self, data)

    def _block(self, run: int, times) -> Float[Array, "products times modes"]:
        """Rows of all products for some samples of one run; times: a slice or numbers."""
        beams = self.pointing.functions[times] @ self.body_beams[run]
        return self.pointing.pole_from_galactic.T(
            turned_about_pole(beams, self.pointing.azimuth[times])
        )


def turned_about_pole(
    beams: Float[Array, "products times modes"], azimuth: Float[Array, " times"]
) -> Float[Array, "products times modes"]:
    """Turn beams about the pole by the azimuth of every time: D_z(-phi(t)).

    Parameters
    ----------
    beams : (products, times, modes) array
        Coefficients in the Moon-fixed frame.
    azimuth : (times,) array
        phi(t), in radians.

    Returns
    -------
    (products, times, modes) array
        Coefficients in the mean-pole frame.
    """
    _, m = mode_numbers(lmax_of(beams.shape[-1]))
    mirrored = beams[..., np.arange(len(m)) - 2 * m]
    xp = namespace(beams, azimuth)
    angle = azimuth[:, None] * np.arange(0.0, m.max() + 1.0)[None]
    cosine, sine = xp.cos(angle), xp.sin(angle)
    signed = sine[:, np.abs(m)] * np.sign(m).astype(np.float64)[None]
    return beams * cosine[None, :, np.abs(m)] - mirrored * signed[None]


@compiled
def _dense(coupling: CouplingMatrix) -> Float[Array, "data modes"]:
    blocks = [coupling._block(run, span) for run, span in coupling.pointing.runs()]
    rows = coupling.layout.gather(namespace(*blocks).concatenate(blocks, axis=1))
    return rows if coupling.response is None else rows * coupling.response[:, None]


def _phases(pointing: Pointing, lmax: int) -> tuple[Array, Array]:
    """cos m phi(t) and sin m phi(t), each (times, orders)."""
    xp = namespace(pointing.azimuth)
    angle = pointing.azimuth[:, None] * np.arange(lmax + 1.0)[None]
    return xp.cos(angle), xp.sin(angle)


@compiled
def _by_order(
    body_beams: Float[Array, "runs products functions modes"], lmax: int
) -> Float[Array, "runs orders beams degrees"]:
    """W_lm and W_l,-m side by side for every order: the matrices behind X and Y.

    A tenth of the time of sums over modes that lie in the packed order (fiducial size).
    """
    pair = _pairs(body_beams, lmax)
    n_runs, n_beams = body_beams.shape[0], body_beams.shape[1] * body_beams.shape[2]
    return pair.reshape(n_runs, n_beams, 2 * (lmax + 1), lmax + 1).transpose(0, 3, 1, 2)


def _pairs(modes: Float[Array, "*batch modes"], lmax: int) -> Float[Array, "*batch degrees orders"]:
    """c_lm for l = 0..lmax, then c_l,-m, of m = 0..lmax; zero for l < m, and for c_l,-0."""
    ell, m = np.arange(lmax + 1)[:, None], np.arange(lmax + 1)[None]
    centre = ell**2 + ell
    xp = namespace(modes)
    plus = xp.where(ell >= m, modes[..., np.where(ell >= m, centre + m, 0)], 0.0)
    inside = (ell >= m) & (m > 0)
    minus = xp.where(inside, modes[..., np.where(inside, centre - m, 0)], 0.0)
    return xp.concatenate([plus, minus], axis=-2)


@compiled
def _forward(coupling: CouplingMatrix, sky: Float[Array, " modes"]) -> Float[Array, " data"]:
    n_products, n_functions = coupling.body_beams.shape[1:3]
    pairs = _pairs(coupling.pointing.pole_from_galactic(sky), coupling.lmax)
    plus, minus = pairs[: coupling.lmax + 1], pairs[coupling.lmax + 1 :]
    xp = namespace(coupling, sky)
    zero_order = np.arange(coupling.lmax + 1)[None] == 0
    crossed = xp.concatenate([minus, -xp.where(zero_order, 0.0, plus)])
    both = xp.stack([pairs.T, crossed.T], axis=-1)
    cosine, sine = _phases(coupling.pointing, coupling.lmax)
    functions = coupling.pointing.functions
    grids = []
    for run, span in coupling.pointing.runs():
        x_and_y = coupling.by_order[run] @ both
        over_time = cosine[span] @ x_and_y[..., 0] + sine[span] @ x_and_y[..., 1]
        over_time = over_time.reshape(-1, n_products, n_functions)
        grids.append((over_time * functions[span][:, None]).sum(-1).T)
    data = coupling.layout.gather(xp.concatenate(grids, axis=1))
    return data if coupling.response is None else data * coupling.response


@compiled
def _backward(coupling: CouplingMatrix, data: Float[Array, " data"]) -> Float[Array, " modes"]:
    """The transpose of :func:`_forward`, step by step."""
    n = coupling.lmax + 1
    data = data if coupling.response is None else data * coupling.response
    grid = coupling.layout.scatter(data)
    cosine, sine = _phases(coupling.pointing, coupling.lmax)
    functions = coupling.pointing.functions
    both = 0.0
    for run, span in coupling.pointing.runs():
        weighted = grid[:, span].T[:, :, None] * functions[span][:, None]
        weighted = weighted.reshape(weighted.shape[0], -1)
        x_and_y = namespace(weighted).stack(
            [cosine[span].T @ weighted, sine[span].T @ weighted], axis=-1
        )
        both = both + coupling.by_order[run].swapaxes(1, 2) @ x_and_y
    # (orders, degrees): of pairs, and of what they are crossed to
    straight, crossed = both[..., 0], both[..., 1]
    plus, minus = straight[:, :n] - crossed[:, n:], straight[:, n:] + crossed[:, :n]
    ell, m = mode_numbers(coupling.lmax)
    packed = namespace(both).where(m >= 0, plus[np.abs(m), ell], minus[np.abs(m), ell])
    return coupling.pointing.pole_from_galactic.T(packed)
