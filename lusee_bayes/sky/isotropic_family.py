"""Isotropic Gaussian skies of mean zero whose C_ell is learned."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float

from lusee_bayes.core.harmonics import per_mode, sum_over_m
from lusee_bayes.sky.learned_spectrum import SpectrumBasis
from lusee_bayes.sky.prior_family import Hyperprior, Member, PriorFamily
from lusee_bayes.sky.priors import HarmonicPrior

# standard deviation of the logarithm of C_0, which is not part of the spectrum's form
LOG_MONOPOLE_WIDTH = 2.0
# fluctuations relative to the mean, where the spectrum is started
RELATIVE_STRENGTH = 0.05


@dataclass(frozen=True)
class IsotropicFamily(PriorFamily):
    """S = diag(C_ell), with C_ell of :class:`SpectrumBasis` for ell > 0 and a C_0 of its own.

    Attributes
    ----------
    spectrum : SpectrumBasis
    log_monopole : float
        Expected ln C_0.
    """

    spectrum: SpectrumBasis
    log_monopole: float

    @classmethod
    def around(cls, temperature: float, lmax: int) -> IsotropicFamily:
        """Make the family of skies of about a mean temperature, in K."""
        power = 4.0 * np.pi * (RELATIVE_STRENGTH * temperature) ** 2 / 100.0
        monopole = float(np.log(4.0 * np.pi * temperature**2))
        return cls(SpectrumBasis.around(power, lmax), monopole)

    @property
    def hyperprior(self) -> Hyperprior:
        return Hyperprior(
            np.append(self.spectrum.centre, self.log_monopole),
            np.append(self.spectrum.width, LOG_MONOPOLE_WIDTH),
        )

    @property
    def names(self) -> tuple[str, ...]:
        return SpectrumBasis.names

    def at(self, parameters: Float[np.ndarray, " parameters"]) -> IsotropicMember:
        return IsotropicMember(self, parameters)

    def averaged(self, parameters, spread):
        return np.diag(per_mode(np.exp(self.basis @ parameters + 0.5 * spread(self.basis))))

    def prior(self, covariance):
        lmax = self.basis.shape[0] - 1
        return HarmonicPrior(np.diagonal(covariance)[np.arange(lmax + 1) ** 2].copy())

    def start_from(self, coarse, parameters):
        more = np.zeros(self.hyperprior.size - len(parameters))
        return np.concatenate([parameters[:-1], more, parameters[-1:]])

    @cached_property
    def basis(self) -> Float[np.ndarray, "ells parameters"]:
        """ln C_ell as a linear function of the parameters."""
        form = self.spectrum.matrix.copy()
        form[0] = 0.0
        return np.column_stack([form, np.arange(len(form)) == 0])


@dataclass(frozen=True)
class IsotropicMember(Member):
    """One prior of :class:`IsotropicFamily`."""

    family: IsotropicFamily
    parameters: Float[np.ndarray, " parameters"]

    @cached_property
    def spectrum(self) -> Float[np.ndarray, " ells"]:
        """C_ell, in K^2."""
        return np.exp(self.family.basis @ self.parameters)

    @property
    def covariance(self):
        return np.diag(per_mode(self.spectrum))

    def traces(self, matrix):
        of_ells = sum_over_m(np.diagonal(matrix))
        return self.family.basis.T @ (0.5 * self.spectrum * of_ells)

    def forms(self, columns):
        of_ells = sum_over_m((columns**2).T).T
        return self.family.basis.T @ (0.5 * self.spectrum[:, None] * of_ells)
