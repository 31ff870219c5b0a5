"""A posterior in a small file: mean, and covariance as a diagonal less a matrix of low rank.

In units of the prior's standard deviations the covariance is the identity wherever the data say
nothing, so that it takes only the directions v_k in which they do, with variances c_k < 1:

    C = D (1 - V diag(1 - c) V^T) D,    a draw = mean + D (1 - V diag(1 - sqrt(c)) V^T) z,

D = diag(prior standard deviations), z ~ N(0, 1).
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from lusee_bayes.checks import InputError
from lusee_bayes.harmonics import lmax_of, mode_numbers
from lusee_bayes.posterior import Posterior

FORMAT = "lusee_bayes compact posterior 1"
# directions whose variance the data reduce by less are left at the prior's
TOLERANCE = 1e-2


@dataclass(frozen=True)
class CompactPosterior:
    """Mean and covariance of real harmonic coefficients, in K.

    directions : (modes, rank) orthonormal, in units of ``prior_std``; variances : (rank,) below 1
    """

    mean: Float[np.ndarray, " modes"]
    prior_std: Float[np.ndarray, " modes"]
    directions: Float[np.ndarray, "modes rank"]
    variances: Float[np.ndarray, " rank"]

    @classmethod
    def of(cls, posterior: Posterior, tolerance: float = TOLERANCE) -> CompactPosterior:
        """All directions whose variance is below (1 - tolerance) of the prior's.

        No variance comes out too small, and none too large by more than a part ``tolerance`` of
        the prior's. InputError for a prior that is not diagonal.
        """
        scale = posterior.prior.diagonal_root()
        if scale is None:
            raise InputError("only posteriors over harmonic coefficients have a compact form")
        lower = np.tril(np.asarray(posterior.lower))
        # the singular values of L: its eigenvalues squared are lost where Lambda is formed
        left, singular, _ = np.linalg.svd(lower)
        variances = singular**-2.0
        kept = variances < 1.0 - tolerance
        directions = left[:, kept]
        if posterior.basis is not None:
            directions = np.asarray(posterior.basis) @ directions
        return cls(np.asarray(posterior.mean), np.asarray(scale), directions, variances[kept])

    def covariance(self) -> Float[np.ndarray, "modes modes"]:
        """C as a matrix, in K^2."""
        inner = (self.directions * (1.0 - self.variances)) @ self.directions.T
        return self.prior_std[:, None] * (np.eye(len(self.mean)) - inner) * self.prior_std

    def std(self) -> Float[np.ndarray, " modes"]:
        """Standard deviation of every coefficient, in K."""
        squared = self.directions**2
        outside = 1.0 - squared.sum(1)
        return self.prior_std * np.sqrt(outside + squared @ self.variances)

    def sample(self, rng: np.random.Generator, n: int) -> Float[np.ndarray, "n modes"]:
        """Draws, in K."""
        z = rng.standard_normal((n, len(self.mean)))
        z = z - (z @ self.directions) * (1.0 - np.sqrt(self.variances)) @ self.directions.T
        return self.mean + self.prior_std * z

    def write(self, path: Path, about: dict[str, object]) -> None:
        """Write NumPy's .npz; ``about`` is kept with it as JSON."""
        ell, m = mode_numbers(lmax_of(len(self.mean)))
        with path.open("wb") as file:
            np.savez(
                file,
                mean=self.mean,
                prior_std=self.prior_std,
                directions=self.directions,
                variances=self.variances,
                ell=ell,
                m=m,
                about=json.dumps({"format": FORMAT, **about}),
            )


def read_compact(path: str | Path) -> tuple[CompactPosterior, dict[str, object]]:
    """What :meth:`CompactPosterior.write` wrote: the posterior, and what is said about it.

    InputError for anything else.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            about = json.loads(str(file["about"]))
            names = ("mean", "prior_std", "directions", "variances")
            posterior = CompactPosterior(*(file[name] for name in names))
    except (OSError, KeyError, ValueError) as error:
        raise InputError(f"'{path}' cannot be read as a compact posterior: {error}") from error
    return posterior, about


def is_compact(path: Path) -> bool:
    """Whether a .npz file is one of these."""
    with np.load(path, allow_pickle=False) as file:
        return "directions" in file
