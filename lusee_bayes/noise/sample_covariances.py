"""Sample covariances of complex Gaussian voltages, for as many samples as a spectrum averages.

The mean of v v* over N independent samples of covariance T = L L* is T + L H L* / sqrt(N), where H
is Hermitian and for large N Gaussian: real numbers of variance one on its diagonal, complex ones of
mean square one beside it. Its covariances are those of :func:`.exact_blocks`, divided by N.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Complex

from lusee_bayes.core.errors import InputError


def sample_covariances(
    t: Complex[np.ndarray, "antennas antennas *rest"],
    n_averaged: float,
    generator: np.random.Generator,
) -> Complex[np.ndarray, "antennas antennas *rest"]:
    """Draw sample covariances.

    Parameters
    ----------
    t : (antennas, antennas, ...) array
        The covariances T.
    n_averaged : float
        Independent samples behind each.
    generator : Generator

    Raises
    ------
    InputError
        If one of the T is not positive definite: no voltages have it.
    """
    n, rest = t.shape[0], t.shape[2:]
    low = _cholesky(t)
    scale = 1.0 / np.sqrt(n_averaged)
    hermitian: dict[tuple[int, int], np.ndarray] = {}
    for i in range(n):
        hermitian[i, i] = generator.standard_normal(rest) * scale
        for j in range(i):
            parts = generator.standard_normal((2, *rest)) * (scale * np.sqrt(0.5))
            hermitian[i, j] = parts[0] + 1j * parts[1]
            hermitian[j, i] = hermitian[i, j].conj()
    found = t.copy()
    for i in range(n):
        row = [sum(low[i, a] * hermitian[a, b] for a in range(i + 1)) for b in range(n)]
        for j in range(i + 1):
            noise = sum(row[b] * low[j, b].conj() for b in range(j + 1))
            found[i, j] += noise.real if i == j else noise
            if i != j:
                found[j, i] = found[i, j].conj()
    return found


def _cholesky(
    t: Complex[np.ndarray, "antennas antennas *rest"],
) -> dict[tuple[int, int], np.ndarray]:
    """The lower factor of many small matrices, entry by entry."""
    low: dict[tuple[int, int], np.ndarray] = {}
    for j in range(t.shape[0]):
        left = t[j, j].real - sum(np.abs(low[j, k]) ** 2 for k in range(j))
        if not (left > 0.0).all():
            raise InputError(
                "the covariance of the voltages is not positive definite, so that there is no "
                "radiometer noise for it; check that the autos are positive and the correlations "
                "below one"
            )
        low[j, j] = np.sqrt(left)
        for i in range(j + 1, t.shape[0]):
            rest = t[i, j] - sum(low[i, k] * low[j, k].conj() for k in range(j))
            low[i, j] = rest / low[j, j]
    return low
