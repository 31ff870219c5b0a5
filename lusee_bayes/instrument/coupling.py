"""The coupling matrix A, of any kind: A m, A^T d and operations built on them.

To add a kind, implement the abstract methods of :class:`Coupling` in one file;
``lusee_bayes.testing.check_coupling`` tests it.

**A of an observation** maps sky coefficients to visibilities. The turntable turns its beams, the
lander's lean and the pole tilt them. Let b_rk be the coefficients of product k in run r in the
Moon-fixed frame, and W_j the combination of their tilted copies for the pointing's function of time
u_j (:mod:`.averaging`). A visibility, the mean over its window, is ::

    V_k(t) = [ D_z(-phi(t)) sum_j u_j(t) W_j ] . a             (a: the sky in the mean-pole frame)
           = sum_j u_j(t) sum_m ( cos m phi(t) X_jm + sin m phi(t) Y_jm ),
    X_jm = sum_l (W_lm a_lm + W_l,-m a_l,-m),    Y_jm = sum_l (W_lm a_l,-m - W_l,-m a_lm).

Time enters only through exp(i m phi) and the slow scalars u_j, beams only through b. A product with
a vector never forms A, and only its last sum grows with the number of times.

**A for beams that change** (:class:`Instrument`), at fixed orientations: A is linear in the beams,
so the dA of a difference of beams is the A of that difference.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from lusee_bayes.core.arrays import Array, DataVector, Modes, compiled, namespace
from lusee_bayes.core.checks import Described, require_array, require_float64, require_shape
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.harmonics import lmax_of, mode_numbers, tilts, turn_about, turn_about_z
from lusee_bayes.instrument.beams.fields import ProductBeams
from lusee_bayes.instrument.beams.source import BeamSource, Values
from lusee_bayes.instrument.observation import Observation
from lusee_bayes.instrument.pointing import Pointing
from lusee_bayes.instrument.products import DataLayout

Matrix = Float[Array, "data unknowns"]
BeamModes = Float[Array, "*runs products modes"]
BodyBeams = Float[Array, "runs products functions modes"]
RowNumbers = Int[np.ndarray, " rows"]
TimeModes = Float[Array, "products times modes"]
Factors = Float[Array, "functions powers orders 2"]
# times that A^T d processes at once, for one column of d, and for many; this bounds the memory
MOST_TIMES, FEWEST_TIMES = 8192, 256


class Coupling(Described, eqx.Module):
    """A matrix A, of shape (data, unknowns), from a sky in K to data in K.

    Attributes
    ----------
    response : (data,) array or None
        Factors of the rows, such as gains; None for ones.
    """

    response: DataVector | None = eqx.field(default=None, kw_only=True)

    def description(self) -> tuple[str, ...]:
        data, unknowns = self.shape
        return (f"{data} data x {unknowns} unknowns of the sky, K per K",)

    @property
    @abstractmethod
    def shape(self) -> tuple[int, int]:
        """(data, unknowns)"""

    # whether A^T N^-1 A can be summed over time without forming A (``linear.normal_matrix``)
    has_time_structure = False

    def dense(self) -> Matrix:
        """A as a matrix, with the response."""
        matrix = self._matrix()
        return matrix if self.response is None else matrix * self.response[:, None]

    @abstractmethod
    def _matrix(self) -> Matrix:
        """A as a matrix, without the response (as in all methods below)."""

    @abstractmethod
    def _forward(self, sky: Float[Array, "unknowns *n"]) -> Float[Array, "data *n"]:
        """A m, for vectors of checked type and shape."""

    @abstractmethod
    def _backward(self, data: Float[Array, "data *n"]) -> Float[Array, "unknowns *n"]:
        """A^T d, for vectors of checked type and shape."""

    def __matmul__(self, sky: Float[Array, "unknowns *n"]) -> Float[Array, "data *n"]:
        """Compute A m: the mean data of a sky.

        Parameters
        ----------
        sky : (unknowns,) or (unknowns, n) array
            In K; for harmonics the Galactic coefficients; or several skies as columns. Values are
            not checked: NaN gives NaN.

        Returns
        -------
        (data,) or (data, n) array
            Visibilities in K.

        Raises
        ------
        InputError
            If ``sky`` is not float64 or has another length.
        """
        require_float64("the sky", sky)
        require_shape("the sky", sky, (self.shape[1], *sky.shape[1:2]))
        data = self._forward(sky)
        return data if self.response is None else (data.T * self.response).T

    def transpose_mv(self, data: Float[Array, "data *n"]) -> Float[Array, "unknowns *n"]:
        """Compute A^T d.

        Parameters
        ----------
        data : (data,) or (data, n) array
            Any vector of the length of the data, or several as columns.

        Returns
        -------
        (unknowns,) or (unknowns, n) array
            A^T d, in the unit of ``data``.

        Raises
        ------
        InputError
            If ``data`` is not float64 or has another length.
        """
        require_float64("the data", data)
        require_shape("the data", data, (self.shape[0], *data.shape[1:2]))
        if self.response is not None:
            data = (data.T * self.response).T
        return self._backward(data)

    def with_response(self, factors: DataVector) -> Coupling:
        """Multiply every row by a factor, in addition to the present response.

        Parameters
        ----------
        factors : (data,) array
            Factors without a unit, such as gains.

        Returns
        -------
        Coupling
            The same kind of matrix, with the new response.

        Raises
        ------
        InputError
            If ``factors`` is not float64, not finite, or of another length.
        """
        require_array("the response", factors, (self.shape[0],))
        factors = factors if self.response is None else self.response * factors
        return replace(self, response=factors)


@compiled
def body_beams(modes: BeamModes, pointing: Pointing) -> BodyBeams:
    """Turn beams into the Moon-fixed frame, for each of the pointing's functions of time.

    Parameters
    ----------
    modes : (products, modes) or (runs, products, modes) array
        Harmonic coefficients in the frame of the lander, real packed.
    pointing : Pointing
        The orientations; differentiable in its turntable angles and turns.

    Returns
    -------
    (runs, products, functions, modes) array
    """
    xp, runs = namespace(modes, pointing), []
    for run in range(len(pointing.run_starts) - 1):
        of_run = modes if modes.ndim == 2 else modes[run]
        body = _on_the_moon(turn_about_z(of_run, pointing.turntable[run]), pointing)
        runs.append(_taken_up(xp.stack(tilts(body, pointing.order), axis=1), pointing.factors))
    return xp.stack(runs)


def _on_the_moon(modes: BeamModes, pointing: Pointing) -> Array:
    """Beams of the lander in the Moon-fixed frame, with the pointing's further turns."""
    if pointing.turns is None:
        return pointing.mcmf_from_lander(modes)
    lon, lat, east, north = (pointing.turns[k] for k in range(4))
    leaning = turn_about(0, turn_about(1, turn_about(0, modes, -north), east), -lat)
    return turn_about_z(pointing.mcmf_from_lander(leaning), lon)


def _taken_up(
    tilted: Float[Array, "products powers modes"], factors: Factors
) -> Float[Array, "products functions modes"]:
    """sum_p G_j(p, m) W_p, a complex factor for each pair c_m + i c_-m."""
    ell, m = mode_numbers(lmax_of(tilted.shape[-1]))
    xp = namespace(tilted, factors)
    # contiguous modes, as matrix products need them
    mirrored = xp.take(tilted, ell * (ell + 1) - m, axis=-1)
    real = xp.take(factors[..., 0], np.abs(m), axis=-1)
    sign = np.sign(m).astype(np.float64)[None, None]
    imaginary = xp.take(factors[..., 1], np.abs(m), axis=-1) * sign
    return sum(
        tilted[:, None, p] * real[None, :, p] - mirrored[:, None, p] * imaginary[None, :, p]
        for p in range(tilted.shape[1])
    )


class DenseCoupling(Coupling):
    """A as an array.

    Parameters
    ----------
    matrix : (data, unknowns) array
        A without the response. The unknowns need not be harmonic coefficients.
    response : (data,) array or None
        Factors of the rows, such as gains; None for ones.

    Raises
    ------
    InputError
        If ``matrix`` is not a float64 matrix, or contains NaN or infinity. Values are not checked
        inside a JAX transformation.
    """

    matrix: Matrix = eqx.field(converter=jnp.asarray)

    def __check_init__(self):
        require_array("the coupling matrix", self.matrix, (None, None))

    @property
    def shape(self) -> tuple[int, int]:
        return self.matrix.shape

    def _matrix(self):
        return self.matrix

    def _forward(self, sky):
        return self.matrix @ sky

    def _backward(self, data):
        return self.matrix.T @ data


def as_coupling(coupling: Coupling | Array) -> Coupling:
    """Wrap an array in a :class:`DenseCoupling`; a coupling is returned as it is."""
    return coupling if isinstance(coupling, Coupling) else DenseCoupling(coupling)


class CouplingMatrix(Coupling):
    """A of the beams of an observation, in Galactic coordinates, with its structure in time.

    ``A @ sky`` and ``A.transpose_mv(data)`` use the structure; :meth:`rows` and :meth:`dense` give
    the numbers. Differentiable in beams and response. Create it with :meth:`observe`, :meth:`build`
    or :meth:`of_modes`.

    Attributes
    ----------
    body_beams : (runs, products, functions, modes) array
        Beams turned by the turntable into the Moon-fixed frame, for each function of time.
    by_order : (runs, orders, beams, degrees) array
        The same coefficients order by order: the matrices behind X and Y of the module's equations.
    pointing : Pointing
        The orientations at every sample.
    layout : DataLayout
        The product and the time of every row.
    modes : (products, modes) or (runs, products, modes) array
        The beams in the lander's frame, from which the rest is computed; one set per run if the
        terrain does not turn with the turntable.
    """

    body_beams: BodyBeams
    by_order: Float[Array, "runs orders beams degrees"]
    pointing: Pointing
    layout: DataLayout
    modes: BeamModes

    @classmethod
    def build(
        cls, beams: ProductBeams, pointing: Pointing, layout: DataLayout | None = None
    ) -> CouplingMatrix:
        """Build A from beams and orientations.

        Parameters
        ----------
        beams : ProductBeams
            Beams of all products, up to the lmax of ``pointing``.
        pointing : Pointing
            The orientations at every sample.
        layout : DataLayout, optional
            The samples that are present; by default all.

        Returns
        -------
        CouplingMatrix
            A of these beams.

        Raises
        ------
        InputError
            If beams, pointing and layout differ in lmax, products or times.
        """
        size = len(pointing.pole_from_galactic.blocks) ** 2
        require_shape("the beam coefficients", beams.modes, (beams.n_products, size))
        layout = DataLayout(beams.n_products, pointing.n_times) if layout is None else layout
        if (layout.n_products, layout.n_times) != (beams.n_products, pointing.n_times):
            raise InputError(
                f"the data layout has {layout.n_products} products x {layout.n_times} times, "
                f"beams and pointing have {beams.n_products} x {pointing.n_times}"
            )
        return cls.of_modes(beams.modes, pointing, layout)

    @classmethod
    def of_modes(cls, modes: BeamModes, pointing: Pointing, layout: DataLayout) -> CouplingMatrix:
        """Build A for any number of beams from their coefficients, without checks.

        Parameters
        ----------
        modes : (beams, modes) or (runs, beams, modes) array
            Harmonic coefficients in the frame of the lander, real packed; one set per run if the
            terrain does not turn with the turntable.
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
        return cls(body, _by_order(body, lmax_of(body.shape[-1])), pointing, layout, modes)

    @classmethod
    def observe(cls, beams: ProductBeams, observation: Observation) -> CouplingMatrix:
        """Build A for a complete observation.

        Parameters
        ----------
        beams : ProductBeams
            Beams of all products, up to the lmax of the sky.
        observation : Observation
            Place, times and turntable angles.

        Returns
        -------
        CouplingMatrix
            A with a row for every product and time.
        """
        return cls.build(beams, Pointing.of(observation, beams.lmax))

    def description(self) -> tuple[str, ...]:
        how = "applied without forming it: beams, pointing and a rotation for each order m"
        return *super().description(), *self.layout.description(), how

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

    def along(
        self, beams: Iterable[BeamModes], pointing: Pointing | None = None
    ) -> Callable[[Modes], Float[Array, "beams products times"]]:
        """Prepare the visibilities of several sets of beams for any sky, without the response.

        Parameters
        ----------
        beams : iterable of (products, modes) array
            In the frame of the lander.
        pointing : Pointing, optional
            Orientations; by default those of this matrix.

        Returns
        -------
        callable
            Maps a (modes,) sky to (beams, products, times) visibilities, missing samples included.
        """
        stacked = np.concatenate(list(beams), axis=-2)
        shape = -1, self.layout.n_products, self.layout.n_times
        pointing = self.pointing if pointing is None else pointing
        made = self.of_modes(stacked, pointing, DataLayout(stacked.shape[-2], shape[2]))
        return lambda sky: np.asarray(made @ np.asarray(sky)).reshape(shape)

    def of(
        self, *, modes: BeamModes | None = None, pointing: Pointing | None = None
    ) -> CouplingMatrix:
        """Return the same matrix for other beams or another pointing; differentiable in both.

        Parameters
        ----------
        modes : (products, modes) array, optional
            Beams in the frame of the lander.
        pointing : Pointing, optional
            The orientation at every sample.
        """
        pointing = self.pointing if pointing is None else pointing
        made = self.of_modes(self.modes if modes is None else modes, pointing, self.layout)
        return replace(made, response=self.response)

    def rows(self, product: RowNumbers, time: RowNumbers) -> Float[Array, "rows modes"]:
        """Compute selected rows of A, flagged or not, without the response.

        Parameters
        ----------
        product, time : (rows,) arrays of int
            Product and time number of every row.

        Returns
        -------
        (rows, modes) array
            The rows, in the requested order.

        Raises
        ------
        InputError
            If a number is out of range, or the two arrays differ in length.
        """
        product, time = np.asarray(product), np.asarray(time)
        require_shape("time", time, product.shape)
        limits = {"product": self.layout.n_products, "time": self.layout.n_times}
        for numbers, (name, limit) in zip((product, time), limits.items(), strict=True):
            if ((numbers < 0) | (numbers >= limit)).any():
                raise InputError(f"{name} numbers must lie in 0..{limit - 1}, got {numbers}")
        places, blocks = [], []
        for run, span in self.pointing.runs():
            chosen = np.flatnonzero((time >= span.start) & (time < span.stop))
            times, position = np.unique(time[chosen], return_inverse=True)
            places.append(chosen)
            blocks.append(self._block(run, times)[product[chosen], position])
        return namespace(*blocks).concatenate(blocks)[np.argsort(np.concatenate(places))]

    def time_features(self, times: Int[np.ndarray, " n"]) -> Float[np.ndarray, "n features"]:
        """Return the functions of time in A: rows of one run are linear in these numbers.

        Parameters
        ----------
        times : (n,) array of int

        Returns
        -------
        (n, features) array
            cos m phi(t) and sin m phi(t) times every u_j(t).
        """
        waves = np.concatenate(_phases(self.pointing.azimuth[times], self.lmax), axis=1)
        return (self.pointing.functions[times][:, :, None] * waves[:, None]).reshape(len(times), -1)

    @compiled
    def _matrix(self) -> Matrix:
        """96 MB for 5232 x 2304."""
        blocks = [self._block(run, span) for run, span in self.pointing.runs()]
        return self.layout.gather(namespace(*blocks).concatenate(blocks, axis=1))

    @compiled
    def _forward(self, sky: Float[Array, "modes *n"]) -> Float[Array, "data *n"]:
        n, columns = self.lmax + 1, sky.shape[1:]
        n_products, n_functions = self.body_beams.shape[1:3]
        pairs = _pairs(self.pointing.pole_from_galactic(sky.reshape(len(sky), -1).T), self.lmax)
        xp, zero_order, half = namespace(self, sky), np.arange(n) == 0, len(pairs)
        crossed = [pairs[:, n:], -xp.where(zero_order, 0.0, pairs[:, :n])]
        both, grids = xp.concatenate([pairs, xp.concatenate(crossed, axis=1)]).T, []
        for run, part in self._parts(half):
            x_and_y = self.by_order[run] @ both
            cosine, sine = _phases(self.pointing.azimuth[part], self.lmax)
            x, y = (one.reshape(n, -1) for one in (x_and_y[..., :half], x_and_y[..., half:]))
            over_time = (cosine @ x + sine @ y).reshape(-1, n_products, n_functions, half)
            seen = (over_time * self.pointing.functions[part][:, None, :, None]).sum(2)
            grids.append(seen.swapaxes(0, 1))
        return self.layout.gather(xp.concatenate(grids, axis=1)).reshape(-1, *columns)

    @compiled
    def _backward(self, data: Float[Array, "data *n"]) -> Float[Array, "modes *n"]:
        """The transpose of :func:`_forward`, step by step."""
        n, columns = self.lmax + 1, data.shape[1:]
        grid = self.layout.scatter(data.reshape(len(data), -1))
        functions = self.pointing.functions
        n_products, n_functions = self.body_beams.shape[1:3]
        xp, both = namespace(grid, functions), 0.0
        for run, part in self._parts(grid.shape[-1]):
            over_time = grid[:, part].swapaxes(0, 1).reshape(part.stop - part.start, -1)
            waves = []
            for wave in _phases(self.pointing.azimuth[part], self.lmax):
                wave = wave[:, :, None] * functions[part][:, None]
                seen = wave.reshape(len(over_time), -1).T @ over_time
                seen = seen.reshape(n, n_functions, n_products, -1).swapaxes(1, 2)
                waves.append(seen.reshape(n, n_products * n_functions, -1))
            both = both + self.by_order[run].swapaxes(1, 2) @ xp.concatenate(waves, axis=-1)
        # (orders, degrees, columns): for the pairs, and for the crossed pairs
        half = both.shape[-1] // 2
        straight, crossed = both[..., :half], both[..., half:]
        plus, minus = straight[:, :n] - crossed[:, n:], straight[:, n:] + crossed[:, :n]
        ell, m = mode_numbers(self.lmax)
        packed = xp.where((m >= 0)[:, None], plus[np.abs(m), ell], minus[np.abs(m), ell])
        return self.pointing.pole_from_galactic.T(packed.T).T.reshape(self.shape[1], *columns)

    def _parts(self, columns: int = 1) -> Iterator[tuple[int, slice]]:
        """Runs in parts of at most MOST_TIMES samples: number of the run, and its samples."""
        step = max(MOST_TIMES // max(columns, 1), FEWEST_TIMES)
        for run, span in self.pointing.runs():
            for first in range(span.start, span.stop, step):
                yield run, slice(first, min(first + step, span.stop))

    def _block(self, run: int, times) -> Float[Array, "products times modes"]:
        """Rows of all products for some samples of one run; times: a slice or numbers."""
        beams = self.pointing.functions[times] @ self.body_beams[run]
        turned = turned_about_pole(beams, self.pointing.azimuth[times])
        return self.pointing.pole_from_galactic.T(turned)


def turned_about_pole(beams: TimeModes, azimuth: Float[Array, " times"]) -> TimeModes:
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
    lmax, xp = lmax_of(beams.shape[-1]), namespace(beams, azimuth)
    _, m = mode_numbers(lmax)
    cosine, sine = (xp.take(wave, np.abs(m), axis=1) for wave in _phases(azimuth, lmax))
    signed, mirror = sine * np.sign(m).astype(np.float64)[None], np.arange(len(m)) - 2 * m
    if xp is not np:
        return beams * cosine[None] - xp.take(beams, mirror, axis=-1) * signed[None]
    # one product at a time stays in the processor's cache; indexing in place of take, or all
    # products at once, would take several times as long
    return np.stack([one * cosine - np.take(one, mirror, axis=1) * signed for one in beams])


def _phases(azimuth: Float[Array, " times"], lmax: int) -> tuple[Array, Array]:
    """cos m phi(t) and sin m phi(t), each (times, orders)."""
    xp, angle = namespace(azimuth), azimuth[:, None] * np.arange(lmax + 1.0)[None]
    return xp.cos(angle), xp.sin(angle)


@compiled
def _by_order(body_beams: BodyBeams, lmax: int) -> Float[Array, "runs orders beams degrees"]:
    """W_lm and W_l,-m side by side for every order: the matrices behind X and Y.

    Takes a tenth of the time of sums over modes in packed order (fiducial size).
    """
    pair = _pairs(body_beams, lmax)
    n_runs, n_beams = body_beams.shape[0], body_beams.shape[1] * body_beams.shape[2]
    return pair.reshape(n_runs, n_beams, 2 * (lmax + 1), lmax + 1).transpose(0, 3, 1, 2)


def _pairs(modes: Float[Array, "*batch modes"], lmax: int) -> Float[Array, "*batch degrees orders"]:
    """c_lm for l = 0..lmax, then c_l,-m, for m = 0..lmax; zero for l < m, and for c_l,-0."""
    ell, m = np.arange(lmax + 1)[:, None], np.arange(lmax + 1)[None]
    centre, xp = ell**2 + ell, namespace(modes)
    plus = xp.where(ell >= m, modes[..., np.where(ell >= m, centre + m, 0)], 0.0)
    inside = (ell >= m) & (m > 0)
    minus = xp.where(inside, modes[..., np.where(inside, centre - m, 0)], 0.0)
    return xp.concatenate([plus, minus], axis=-2)


class Instrument(eqx.Module):
    """Antennas whose parameters may change, and all else that A depends on.

    Attributes
    ----------
    source : BeamSource
        The antennas and the ground, with the present values of all parameters.
    pointing : Pointing
        The orientations at every sample.
    layout : DataLayout
        The product and the time of every row of A.
    frequency_mhz : float
        In MHz.
    lmax : int
        Highest ell of the beams and the sky.
    """

    source: BeamSource
    pointing: Pointing
    layout: DataLayout
    frequency_mhz: float = eqx.field(static=True)
    lmax: int = eqx.field(static=True)

    def value(self, name: str) -> Float[Array, ""]:
        """Look up the present value of a parameter.

        Parameters
        ----------
        name : str
            One of :meth:`.BeamSource.parameters`.

        Returns
        -------
        () array
            In the unit at the end of the name.

        Raises
        ------
        InputError
            If there is no such parameter; the message names the nearest.
        """
        return self.source.parameter(name).value

    def beams(self, values: Values | None = None) -> ProductBeams:
        """Compute the beams of all products.

        Parameters
        ----------
        values : mapping of str to () array, optional
            Values of some parameters (:meth:`.BeamSource.parameters`); the others keep theirs.

        Returns
        -------
        ProductBeams
            Up to ``lmax``; differentiable in the values.

        Raises
        ------
        InputError
            If there is no parameter of that name.
        """
        return self.source.with_values(values or {}).beams(self.frequency_mhz, self.lmax)

    def coupling(self, values: Values | None = None) -> CouplingMatrix:
        """Compute A for these values of the antennas' parameters.

        Parameters
        ----------
        values : mapping of str to () array, optional
            Values of some parameters (:meth:`.BeamSource.parameters`); the others keep theirs.

        Returns
        -------
        CouplingMatrix
            Differentiable in the values.

        Raises
        ------
        InputError
            If there is no parameter of that name.
        """
        return CouplingMatrix.build(self.beams(values), self.pointing, self.layout)
