"""Products of fields on the sphere: harmonic transforms on Gauss-Legendre rings.

The rule is exact up to degree 2 ``band``. If ``band`` is twice the band limit of the harmonics, it
integrates products of two harmonics with a field of band limit ``band`` exactly. A transform takes
one matrix product per order m and one FFT per ring.
"""

import equinox as eqx
import numpy as np
from jaxtyping import Float

from lusee_bayes.core import checks, harmonics, lazy, linalg
from lusee_bayes.core.arrays import Array, Fields, as_complex, namespace
from lusee_bayes.core.errors import InputError


class SphereGrid(eqx.Module):
    """Real harmonics up to ``lmax`` on the rings of a Gauss-Legendre rule.

    Attributes
    ----------
    theta : (rings,) array
        Colatitude of each ring in radians.
    weights : (rings,) array
        Solid angle of each point of a ring; the sum over all points is 4 pi.
    legendre : (orders, rings, ells) array
        lambda_lm(theta) for m = 0..lmax, times sqrt(2) where m > 0.
    n_phi : int
        Points on a ring; the first is at azimuth zero.
    """

    theta: Float[Array, " rings"]
    weights: Float[Array, " rings"]
    legendre: Float[Array, "orders rings ells"]
    n_phi: int = eqx.field(static=True)

    @classmethod
    def of(cls, lmax: int, band: int) -> "SphereGrid":
        """Build the grid in NumPy.

        Parameters
        ----------
        lmax : int
            Highest ell of the harmonics.
        band : int
            The rule is exact up to degree 2 ``band``.

        Raises
        ------
        InputError
            If ``band`` is below ``lmax``, since the harmonics are not orthogonal on such a grid.
        """
        if band < lmax:
            wrong = f"a grid of band limit {band} does not support harmonics up to ell = {lmax}"
            raise InputError(wrong)
        x, weights = np.polynomial.legendre.leggauss(band + 1)
        theta, n_phi = np.arccos(x), 2 * band + 2
        # ells, orders, rings
        table = lazy.special.sph_legendre_p_all(lmax, lmax, theta)[0][:, : lmax + 1]
        table = np.ascontiguousarray(table.transpose(1, 2, 0))
        table[1:] *= harmonics.SQRT2
        return cls(theta, weights * (2.0 * np.pi / n_phi), table, n_phi)

    @property
    def lmax(self) -> int:
        """Highest ell of the harmonics."""
        return self.legendre.shape[0] - 1

    @property
    def shape(self) -> tuple[int, int]:
        """Number of rings, and number of points on each ring."""
        return self.legendre.shape[1], self.n_phi

    def directions(self) -> tuple[Float[np.ndarray, " points"], Float[np.ndarray, " points"]]:
        """Return theta and phi of every point in radians, ring after ring."""
        phi = 2.0 * np.pi * np.arange(self.n_phi) / self.n_phi
        return np.repeat(np.asarray(self.theta), self.n_phi), np.tile(phi, self.shape[0])

    def synthesise(self, modes: Fields) -> Float[Array, "*batch rings phi"]:
        """Evaluate fields with these real packed coefficients at the grid's points.

        Parameters
        ----------
        modes : (..., modes) array

        Raises
        ------
        InputError
            If the coefficients have another lmax.
        """
        batch = modes.shape[:-1]
        checks.require_shape("the coefficients", modes, (*batch, harmonics.n_modes(self.lmax)))
        xp, lmax = namespace(modes, self.legendre), self.lmax
        order, ell = np.mgrid[: lmax + 1, : lmax + 1]
        plus = np.where(ell >= order, ell * (ell + 1) + order, 0)
        minus = np.where(ell >= order, ell * (ell + 1) - order, 0)
        flat = modes.reshape(-1, modes.shape[-1])
        # where ell < m, the table is zero; the sine of m = 0 is dropped below
        both = xp.stack([flat[:, plus], flat[:, minus]])
        columns = both.reshape(-1, lmax + 1, lmax + 1).transpose(1, 2, 0)
        rings = (self.legendre @ columns).transpose(2, 1, 0).reshape(2, *batch, -1, lmax + 1)
        factor = np.where(np.arange(lmax + 1) > 0, 0.5, 1.0) * self.n_phi
        row = (*(1,) * (len(batch) + 1), -1)
        sine = factor * (np.arange(lmax + 1) > 0)
        amplitude = as_complex(rings[0] * factor.reshape(row), rings[1] * sine.reshape(row))
        return xp.fft.irfft(amplitude, n=self.n_phi, axis=-1)

    def analyse(self, field: Float[Array, "*batch rings phi"]) -> Fields:
        """Integrate fields times every harmonic: the fields' coefficients up to lmax.

        Parameters
        ----------
        field : (..., rings, phi) array
            Values at the grid's points.

        Raises
        ------
        InputError
            If the values belong to another grid.
        """
        batch = field.shape[:-2]
        checks.require_shape("the field", field, (*batch, *self.shape))
        xp, lmax = namespace(field, self.legendre), self.lmax
        weights = self.weights.reshape(*(1,) * len(batch), -1, 1)
        amplitude = xp.fft.rfft(field * weights, axis=-1)[..., : lmax + 1]
        both = xp.stack([amplitude.real, amplitude.imag])
        columns = both.reshape(-1, self.shape[0], lmax + 1).transpose(2, 1, 0)
        table = (self.legendre.transpose(0, 2, 1) @ columns).transpose(2, 0, 1)
        cosine, sine = table.reshape(2, -1, lmax + 1, lmax + 1)
        ell, m = harmonics.mode_numbers(lmax)
        picked = xp.where((m >= 0)[None], cosine[:, np.abs(m), ell], sine[:, np.abs(m), ell])
        return picked.reshape(*batch, harmonics.n_modes(lmax))

    def product_matrix(
        self, field: Float[np.ndarray, "rings phi"], lmax: int | None = None
    ) -> Float[np.ndarray, "rows modes"]:
        """Compute int y_i f y_j dOmega: multiplication by a field, as a matrix over harmonics.

        On a ring, products of cosines and sines of m phi and m' phi only need the field's Fourier
        amplitudes at m - m' and m + m'; no harmonic is evaluated on the grid.

        Parameters
        ----------
        field : (rings, phi) array
            f at the grid's points.
        lmax : int, optional
            Highest ell of i: at most, and by default, the grid's lmax, which applies to j.

        Returns
        -------
        (rows, modes) array
            Symmetric if both have the same lmax.

        Raises
        ------
        InputError
            If the values belong to another grid.
        """
        checks.require_shape("the field", field, self.shape)
        highest, table = self.lmax, np.asarray(self.legendre)
        lmax = highest if lmax is None else lmax
        square = lmax == highest
        fourier = np.fft.fft(np.asarray(field) * np.asarray(self.weights)[:, None], axis=1).T
        order, ell = np.triu_indices(lmax + 1)
        legendre = table[order, :, ell]
        # rows and columns ordered by |m|
        rows, columns = (harmonics.modes_by_size_of_order(x) for x in (lmax, highest))
        row, column = np.argsort(rows), np.argsort(columns)
        matrix = np.empty((len(rows), len(columns)))
        for m in range(highest + 1):
            others = np.arange(lmax + 1)
            low, high = fourier[others - m], fourier[(others + m) % self.n_phi]
            # cos m'phi and sin m'phi, times cos m phi and sin m phi
            cosine = (low + high).real, (low + high).imag
            sine = (high - low).imag, (low - high).real
            for sign, factors in zip((1, -1), [cosine, sine][: 1 + (m > 0)], strict=False):
                first = column[m * (m + 1) + sign * m]
                for other, factor in zip((1, -1), factors, strict=True):
                    some = slice(np.searchsorted(order, max(m if square else 0, other < 0)), None)
                    n, to = order[some], ell[some] * (ell[some] + 1) + other * order[some]
                    values = (legendre[some] * (0.5 * factor)[n]) @ table[m][:, m:]
                    matrix[row[to], first : first + highest + 1 - m] = values
        return linalg.permuted(linalg.mirrored(matrix) if square else matrix, row, column)

    def diagonal(self, matrix: Float[np.ndarray, "modes modes"]) -> Float[np.ndarray, "rings phi"]:
        """Compute y^T C y at the grid's points: the variance of a field with covariance C.

        Parameters
        ----------
        matrix : (modes, modes) array
            C, symmetric, over harmonics up to any lmax.
        """
        between = harmonics.order_products(matrix, np.asarray(self.theta))
        phi = 2.0 * np.pi * np.arange(self.n_phi) / self.n_phi
        azimuth = harmonics.azimuth_functions(phi, harmonics.lmax_of(matrix.shape[0]))
        return ((azimuth @ between) * azimuth).sum(2)
