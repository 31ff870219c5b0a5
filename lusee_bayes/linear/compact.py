"""A posterior in a small file: mean, and the prior's covariance less a matrix of low rank.

In units of the prior, S = G G^T, the covariance is the identity wherever the data say nothing.
Only the directions v_k in which they say something are kept, with variances c_k < 1::

    C = G (1 - V diag(1 - c) V^T) G^T,    a draw = mean + G (1 - V diag(1 - sqrt(c)) V^T) z,

z ~ N(0, 1). For independent modes G = diag(prior standard deviations).
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from lusee_bayes.core import formats
from lusee_bayes.core.arrays import on_host
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.harmonics import lmax_of, mode_numbers
from lusee_bayes.core.layouts import Attribute, Layout, Variable
from lusee_bayes.core.reading import read_arrays, reading
from lusee_bayes.core.representation import Described, extent
from lusee_bayes.linear.posterior import Posterior

# directions whose variance the data reduce by less than this share are left at the prior's
TOLERANCE = 1e-2

LAYOUT = Layout(
    "a compact posterior",
    {
        "mean": Variable(("mode",)),
        "prior_std": Variable(("mode",), low=0.0),
        "directions": Variable(("mode", "rank")),
        "variances": Variable(("rank",), low=0.0, high=1.0),
        "prior_root": Variable(("mode", "mode"), optional=True),
    },
    {"about": Attribute("text")},
)


@dataclass(frozen=True, repr=False)
class CompactPosterior(Described):
    """Mean and covariance of real harmonic coefficients.

    Attributes
    ----------
    mean : (modes,) array
        In K.
    prior_std : (modes,) array
        Prior standard deviations, in K.
    directions : (modes, rank) array
        V: orthonormal columns, in units of the prior.
    variances : (rank,) array
        c, below 1.
    prior_root : (modes, modes) array or None
        G, in K; None if it is the diagonal of ``prior_std``.
    """

    mean: Float[np.ndarray, " modes"]
    prior_std: Float[np.ndarray, " modes"]
    directions: Float[np.ndarray, "modes rank"]
    variances: Float[np.ndarray, " rank"]
    prior_root: Float[np.ndarray, "modes modes"] | None = None

    def description(self) -> tuple[str, ...]:
        return (
            f"{len(self.mean)} modes, {len(self.variances)} directions better than the prior",
            f"monopole {self.mean[0] / np.sqrt(4 * np.pi):.4g} K (mean over the sky)",
            f"standard deviations of modes {extent(self.std(), 'K')}",
        )

    @classmethod
    def of(cls, posterior: Posterior, tolerance: float = TOLERANCE) -> CompactPosterior:
        """Make the compact form of a posterior.

        Parameters
        ----------
        posterior : Posterior
            Over harmonic coefficients.
        tolerance : float
            Directions whose variance is above (1 - tolerance) of the prior's keep the prior's. So
            no variance is too small, and none too large by more than this share of the prior's.

        Returns
        -------
        CompactPosterior
            With as few directions as that allows.

        Raises
        ------
        InputError
            If the prior is over pixels.
        """
        prior = on_host(posterior.prior)
        if not prior.invertible:
            raise InputError("only posteriors over harmonic coefficients have a compact form")
        lower = np.tril(np.asarray(posterior.lower))
        # the singular values of L: its eigenvalues squared are lost where Lambda is formed
        left, singular, _ = np.linalg.svd(lower)
        variances = singular**-2.0
        kept = variances < 1.0 - tolerance
        directions = left[:, kept]
        if posterior.basis is not None:
            directions = np.asarray(posterior.basis) @ directions
        root = None if prior.independent else prior.colour(np.eye(prior.rank)).T
        width = np.sqrt(prior.variance())
        return cls(np.asarray(posterior.mean), width, directions, variances[kept], root)

    def covariance(self) -> Float[np.ndarray, "modes modes"]:
        """Compute C as a matrix.

        Returns
        -------
        (modes, modes) array
            In K^2.
        """
        inner = (self.directions * (1.0 - self.variances)) @ self.directions.T
        return self._coloured(self._coloured(np.eye(len(self.mean)) - inner).T)

    def std(self) -> Float[np.ndarray, " modes"]:
        """Compute the standard deviation of every coefficient.

        Returns
        -------
        (modes,) array
            In K.
        """
        seen = self._coloured(self.directions.T) ** 2
        return np.sqrt(self.prior_std**2 - (1.0 - self.variances) @ seen)

    def sample(self, rng: np.random.Generator, n: int) -> Float[np.ndarray, "n modes"]:
        """Draw from the posterior.

        Parameters
        ----------
        rng : numpy.random.Generator
            Source of random numbers.
        n : int
            Number of draws.

        Returns
        -------
        (n, modes) array
            In K.
        """
        z = rng.standard_normal((n, len(self.mean)))
        z = z - (z @ self.directions) * (1.0 - np.sqrt(self.variances)) @ self.directions.T
        return self.mean + self._coloured(z)

    def _coloured(self, u: Float[np.ndarray, "n modes"]) -> Float[np.ndarray, "n modes"]:
        """G u of every row."""
        return u * self.prior_std if self.prior_root is None else u @ self.prior_root.T

    def write(self, path: Path, metadata: dict[str, object]) -> None:
        """Write a NumPy .npz file.

        Parameters
        ----------
        path : Path
            Of the file.
        metadata : dict
            What JSON can hold; it is written under the name ``about``.
        """
        ell, m = mode_numbers(lmax_of(len(self.mean)))
        root = {} if self.prior_root is None else {"prior_root": self.prior_root}
        with path.open("wb") as file:
            np.savez(
                file,
                mean=self.mean,
                prior_std=self.prior_std,
                directions=self.directions,
                variances=self.variances,
                ell=ell,
                m=m,
                **root,
                about=json.dumps({"format": formats.COMPACT_POSTERIOR, **metadata}),
            )


def read_compact(path: str | Path) -> tuple[CompactPosterior, dict[str, object]]:
    """Read a file that :meth:`CompactPosterior.write` wrote.

    Parameters
    ----------
    path : str or Path
        Of the file.

    Returns
    -------
    CompactPosterior
        The posterior.
    dict
        The metadata.

    Raises
    ------
    InputError
        If the file is missing or of another kind.
    """
    found = read_arrays(path, LAYOUT)
    with reading(path, LAYOUT.what):
        metadata = json.loads(found.values["about"])
    if not isinstance(metadata, dict) or metadata.get("format") != formats.COMPACT_POSTERIOR:
        raise InputError(f"{path} does not say that it is {LAYOUT.what}")
    names = ("mean", "prior_std", "directions", "variances")
    arrays = [found.arrays[name] for name in names]
    return CompactPosterior(*arrays, found.arrays.get("prior_root")), metadata
