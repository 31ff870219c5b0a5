"""S as a square root: the interface of priors on the sky, and its kinds.

m ~ N(mu, S) is expressed by a square root S = G G^T. All later steps work with the whitened sky
u = G^-1 m ~ N(G^-1 mu, 1). S is never inverted, so a mode without variance is known to be zero; it
is not an error.

Kinds: correlated coefficients, S = G G^T as a matrix; independent unknowns, S = diag(widths^2); an
isotropic Gaussian sky in real harmonic coefficients, S = diag(C_ell). C_ell can be read from a
text file.
"""

from __future__ import annotations

from abc import abstractmethod
from pathlib import Path
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from lusee_bayes.core import layouts, linalg
from lusee_bayes.core.arrays import Array, namespace
from lusee_bayes.core.checks import Described, extent, is_traced, require_array, require_whole
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.harmonics import LARGEST_LMAX, per_mode
from lusee_bayes.core.reading import read_text, reading

Unknowns = Float[Array, " unknowns"]
Covered = Float[Array, "unknowns unknowns"]
# ell + 1 at which C_ell is the square of the amplitude
PIVOT = 10.0


class Prior(Described, eqx.Module):
    """N(mu, S) over the sky's unknowns: m = G u, with independent normals u of unit variance.

    Attributes
    ----------
    independent : bool
        Whether S is diagonal, which may save work.
    """

    independent: ClassVar[bool] = False
    # kinds with a mean make it a field; None means zero
    mean: ClassVar[None] = None

    def description(self) -> tuple[str, ...]:
        return (f"{self.size} unknowns",)

    @property
    @abstractmethod
    def size(self) -> int:
        """Number of unknowns in m."""

    @abstractmethod
    def colour(self, u: Float[Array, "*batch white"]) -> Float[Array, "*batch unknowns"]:
        """Compute G u, on the last axis."""

    @abstractmethod
    def colour_columns(self, a: Float[Array, "rows unknowns"]) -> Float[Array, "rows white"]:
        """Compute A G: the columns of A in units of the prior."""

    @abstractmethod
    def whiten(self, m: Float[Array, "*batch unknowns"]) -> Float[Array, "*batch white"]:
        """Compute G^-1 m, on the last axis; zero for unknowns without variance."""

    @abstractmethod
    def whiten_columns(self, a: Float[Array, "rows white"]) -> Float[Array, "rows unknowns"]:
        """Compute A G^-1, the inverse of :meth:`colour_columns`."""

    @abstractmethod
    def sandwich(self, matrix: Covered) -> Float[Array, "white white"]:
        """Compute G^T M G for a symmetric M: information about m becomes information about u."""

    def colour_covariance(self, white: Float[Array, "white white"]) -> Covered:
        """Compute G C G^T for a symmetric C: the covariance of u becomes that of m.

        NumPy's C may be overwritten.
        """
        return self.colour(self.colour(white).T)

    @abstractmethod
    def variance(self) -> Unknowns:
        """Return the diagonal of S, in K^2."""

    def covariance(self) -> Covered:
        """Return S as a matrix, in K^2."""
        return self.colour_covariance(namespace(self).eye(self.size))

    @abstractmethod
    def widened(self, factor: float) -> Prior:
        """Return the prior with the same mean and with standard deviations times ``factor``."""

    @abstractmethod
    def log_det(self) -> Float[Array, ""]:
        """Compute ``ln|det G|``, for G in K.

        Raises
        ------
        InputError
            As :meth:`require_density`.
        """

    def require_density(self) -> None:
        """Raise an InputError if S is singular, so that m has no density."""

    @property
    def white_mean(self) -> Float[Array, " white"]:
        """Mean of u."""
        return namespace(self).zeros(self.size) if self.mean is None else self.whiten(self.mean)

    def sample(self, key: PRNGKeyArray, n: int | None = None) -> Float[Array, "..."]:
        """Draw skies from the prior.

        Parameters
        ----------
        key : PRNG key
            Key of the random numbers.
        n : int, optional
            Number of skies; by default one.

        Returns
        -------
        (unknowns,) or (n, unknowns) array
            In K.
        """
        u = jax.random.normal(key, (self.size,) if n is None else (n, self.size), dtype=jnp.float64)
        return self.colour(u + self.white_mean.reshape(*(1,) * (u.ndim - 1), -1))


class DensePrior(Prior):
    """S = G G^T over correlated modes, with G lower triangular, about a mean sky.

    Attributes
    ----------
    root : (modes, modes) array
        G, lower triangular with a positive diagonal, in K.
    mean : (modes,) array or None
        The prior mean, in K, Galactic, real packed; None for zero.

    Raises
    ------
    InputError
        If they are not float64, not finite or of the wrong shape, or G is not lower triangular with
        a positive diagonal.
    """

    root: Float[Array, "modes white"]
    mean: Unknowns | None = eqx.field(default=None, kw_only=True)

    def __check_init__(self):
        require_array("the root of the prior", self.root, (self.size, self.size))
        if self.mean is not None:
            require_array("the prior mean", self.mean, (self.size,))
        if is_traced(self.root):
            return
        root = np.asarray(self.root)
        above = any(row[k + 1 :].any() for k, row in enumerate(root))
        if above or not (np.diagonal(root) > 0).all():
            why = "the root of the prior must be a Cholesky factor: lower triangular, diagonal > 0"
            raise InputError(why)

    @classmethod
    def of_root(
        cls, root: Float[np.ndarray, "modes columns"], mean: Unknowns | None = None
    ) -> DensePrior:
        """Create the prior from any R with S = R R^T, without forming S: it may be ill conditioned.

        Parameters
        ----------
        root : (modes, columns) array
            R, in K, with as many columns as modes or more.
        mean : (modes,) array, optional
            Prior mean, in K.

        Raises
        ------
        InputError
            If S is not positive definite.
        """
        lower = np.linalg.qr(root.T, mode="r").T
        return cls(np.tril(lower * np.sign(np.diagonal(lower))), mean=mean)

    def description(self) -> tuple[str, ...]:
        mean = "zero" if self.mean is None else "a mean sky"
        width = extent(namespace(self).sqrt(self.variance()), "K")
        head = f"correlated coefficients with mean {mean}, {self.size} modes, Galactic"
        return head, f"standard deviations {width}"

    @property
    def size(self) -> int:
        return self.root.shape[0]

    def colour(self, u):
        flat = u.reshape(-1, self.size)
        return linalg.times_lower(flat, self.root, transpose=True).reshape(u.shape)

    def colour_columns(self, a):
        return linalg.times_lower(a, self.root, transpose=False)

    def whiten(self, m):
        flat = m.reshape(-1, self.size)
        return linalg.solve_lower(self.root, flat.T, transpose=False).T.reshape(m.shape)

    def whiten_columns(self, a):
        return linalg.solve_lower(self.root, a.T, transpose=True).T

    def sandwich(self, matrix):
        return linalg.sandwich(matrix, self.root)

    def colour_covariance(self, white):
        return linalg.outer_sandwich(white, self.root)

    def widened(self, factor):
        return DensePrior(self.root * factor, mean=self.mean)

    def variance(self):
        return namespace(self).einsum("ij,ij->i", self.root, self.root)

    def log_det(self):
        xp = namespace(self)
        return xp.asarray(xp.log(xp.diagonal(self.root)).sum())


class DiagonalPrior(Prior):
    """A prior whose G is diagonal.

    Kinds have ``widths``, the diagonal of G: an array (unknowns,) of prior standard deviations,
    each in its unknown's unit.
    """

    independent: ClassVar[bool] = True

    @property
    def size(self) -> int:
        return self.widths.shape[0]

    def colour(self, u):
        return u * self.widths.reshape(*(1,) * (u.ndim - 1), -1)

    colour_columns = colour

    def whiten(self, m):
        xp, root = namespace(m, self), self.widths.reshape(*(1,) * (m.ndim - 1), -1)
        power = root != 0
        return m * xp.where(power, 1.0 / xp.where(power, root, 1.0), 0.0)

    whiten_columns = whiten

    def sandwich(self, matrix):
        return linalg.scaled(matrix, self.widths)

    def colour_covariance(self, white):
        return linalg.scaled(white, self.widths, overwrite=True)

    def variance(self):
        return self.widths**2

    def log_det(self):
        self.require_density()
        xp = namespace(self)
        return xp.asarray(xp.log(xp.abs(self.widths)).sum())

    def require_density(self) -> None:
        if not is_traced(self.widths) and not np.asarray(self.widths).all():
            zero = int(np.argmin(np.abs(np.asarray(self.widths))))
            raise InputError(f"unknown {zero} has zero prior variance and no density; drop it")


class IndependentPrior(DiagonalPrior):
    """Independent unknowns of any kind, such as sky modes and source fluxes: S = diag(widths^2).

    Attributes
    ----------
    widths : (unknowns,) array
        Prior standard deviations, each in its unknown's unit.

    Raises
    ------
    InputError
        If they are not float64 or not finite.
    """

    widths: Unknowns

    def __check_init__(self):
        require_array("the prior's standard deviations", self.widths)

    def widened(self, factor):
        return IndependentPrior(self.widths * factor)


class HarmonicPrior(DiagonalPrior):
    """S = diag(C_ell): an isotropic Gaussian sky in real harmonic coefficients, about a mean sky.

    Attributes
    ----------
    spectrum : (ells,) array
        C_ell in K^2 for ell = 0..lmax; C_0 is the prior variance of the monopole.
    mean : (modes,) array or None
        The prior mean, in K, Galactic, real packed; None for zero.

    Raises
    ------
    InputError
        If the spectrum or the mean is not float64 or not finite, the spectrum is negative, or the
        mean has another lmax, or power at an ell where the spectrum has none.
    """

    spectrum: Float[Array, " ells"]
    mean: Float[Array, " modes"] | None = eqx.field(default=None, kw_only=True)

    def __check_init__(self):
        require_array("the prior spectrum", self.spectrum)
        if self.mean is not None:
            require_array("the prior mean", self.mean, (self.size,))
        if is_traced(self.spectrum, self.mean):
            return
        if (negative := np.asarray(self.spectrum) < 0).any():
            ell = int(np.argmax(negative))
            why = f"C_ell of the prior is {float(self.spectrum[ell]):.3g} at ell = {ell}: negative"
            raise InputError(why)
        if self.mean is None:
            return
        fixed = np.flatnonzero((np.asarray(self.mean) != 0.0) & ~(np.asarray(self.variance()) > 0))
        if fixed.size:
            raise InputError(
                f"at ell = {int(np.sqrt(fixed[0]))} the prior has a mean, but no variance; give one"
            )

    def description(self) -> tuple[str, ...]:
        mean = "zero" if self.mean is None else "a mean sky"
        return (
            f"independent coefficients with mean {mean}, lmax = {self.spectrum.shape[0] - 1}",
            f"{self.size} real coefficients, Galactic; C_ell {extent(self.spectrum, 'K^2')}",
        )

    @property
    def widths(self) -> Float[Array, " modes"]:
        # at an ell without power the derivative of sqrt is zero here, not infinite
        xp, power = namespace(self.spectrum), self.spectrum > 0
        return per_mode(xp.where(power, xp.sqrt(xp.where(power, self.spectrum, 1.0)), 0.0))

    def widened(self, factor):
        return HarmonicPrior(self.spectrum * factor**2, mean=self.mean)

    def variance(self):
        return per_mode(self.spectrum)

    def require_density(self) -> None:
        if not is_traced(self.spectrum) and not np.asarray(self.spectrum).all():
            ell = int(np.argmin(np.asarray(self.spectrum)))
            wrong = f"the prior spectrum is zero at ell = {ell} and has no density; drop that ell"
            raise InputError(wrong)


SPECTRUM_COLUMNS = {
    "ell": layouts.Variable(("line",), "integer", low=0.0, grows=True),
    "C_ell": layouts.Variable(("line",), low=0.0),
}
SPECTRUM = layouts.Layout("text file of ell and C_ell in K^2", SPECTRUM_COLUMNS)


def read_spectrum(path: str | Path, lmax: int) -> Float[np.ndarray, " ells"]:
    """Read C_ell from a text file.

    Each line has ell and C_ell, separated by spaces or a comma. Text after # is a comment, and so
    is a first line of names.

    Parameters
    ----------
    path : str or Path
    lmax : int
        Highest ell; the file may have more.

    Returns
    -------
    (ells,) array
        C_ell in K^2 for ell = 0..lmax.

    Raises
    ------
    InputError
        If the file cannot be read, a line is not two numbers, C_ell is negative or not finite, or
        zero at every ell, or an ell is missing or out of order.
    """
    require_whole("lmax", lmax, 0, LARGEST_LMAX)
    text = read_text(path, SPECTRUM.what, "check prior.spectrum_file").splitlines()
    lines = [row for line in text if (row := line.split("#")[0].replace(",", " ").strip())]
    if lines and lines[0][0].isalpha():  # names of the columns
        del lines[0]
    if not lines:
        raise InputError(f"{path} contains no numbers; expected {SPECTRUM.what}")
    with reading(path, SPECTRUM.what):
        table = np.loadtxt(lines, ndmin=2)
        if table.shape[1] != 2 or (table[:, 0] % 1.0).any():
            raise ValueError("expected ell and C_ell in K^2 in every line")
    columns = {"ell": table[:, 0].astype(np.int64), "C_ell": table[:, 1]}
    checked = SPECTRUM.checked(path, columns, {}).arrays
    ells = set(checked["ell"].tolist())
    if missing := [ell for ell in range(lmax + 1) if ell not in ells]:
        several = f" and {len(missing) - 1} more up to lmax = {lmax}" if len(missing) > 1 else ""
        raise InputError(
            f"{path} has no C_ell at ell = {missing[0]}{several}; give all up to lmax, or lower it"
        )
    if not (spectrum := checked["C_ell"][: lmax + 1]).any():
        raise InputError(f"{path}: C_ell is zero at every ell up to {lmax}; a prior needs variance")
    return spectrum
