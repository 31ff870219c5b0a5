"""Modulated skies whose C_ell of relative deviations is learned."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float

from lusee_bayes.core.harmonics import per_mode, sum_over_m
from lusee_bayes.sky.learned_spectrum import SpectrumBasis
from lusee_bayes.sky.modulated import Modulation
from lusee_bayes.sky.prior_family import Hyperprior, Member, PriorFamily
from lusee_bayes.sky.priors import DensePrior

# C_ell of relative deviations of 4 % at ell = 9, where it is started
RELATIVE_POWER = 0.04**2


@dataclass(frozen=True)
class ModulatedFamily(PriorFamily):
    """Priors of one :class:`.Modulation` with C_ell of :class:`SpectrumBasis`.

    Attributes
    ----------
    modulation : Modulation
    spectrum : SpectrumBasis
        Of the relative deviations, without unit.
    """

    modulation: Modulation
    spectrum: SpectrumBasis

    @classmethod
    def of(cls, modulation: Modulation) -> ModulatedFamily:
        """Make the family."""
        return cls(modulation, SpectrumBasis.around(RELATIVE_POWER, modulation.lmax_deviations))

    @property
    def hyperprior(self) -> Hyperprior:
        return Hyperprior(self.spectrum.centre, self.spectrum.width)

    @property
    def names(self) -> tuple[str, ...]:
        return SpectrumBasis.names

    def at(self, parameters: Float[np.ndarray, " parameters"]) -> ModulatedMember:
        return ModulatedMember(self, np.exp(self.spectrum.matrix @ parameters))

    def averaged(self, parameters, spread):
        matrix = self.spectrum.matrix
        return ModulatedMember(self, np.exp(matrix @ parameters + 0.5 * spread(matrix))).covariance

    def prior(self, covariance):
        return DensePrior.of_covariance(covariance, self.modulation.mean)

    def start_from(self, coarse, parameters):
        return np.append(parameters, np.zeros(self.hyperprior.size - len(parameters)))


@dataclass(frozen=True)
class ModulatedMember(Member):
    """One prior of :class:`ModulatedFamily`.

    Attributes
    ----------
    family : ModulatedFamily
    power : (ells,) array
        C_ell of the deviations.
    """

    family: ModulatedFamily
    power: Float[np.ndarray, " ells"]

    @cached_property
    def coloured(self) -> Float[np.ndarray, "modes deviations"]:
        """B C^1/2."""
        return self.family.modulation.matrix * np.sqrt(per_mode(self.power))

    @cached_property
    def covariance(self):
        patterns = self.family.modulation.patterns
        return self.coloured @ self.coloured.T + patterns.T @ patterns

    def traces(self, matrix):
        of_deviations = np.einsum("ia,ia->a", self.coloured, matrix @ self.coloured)
        return self.family.spectrum.matrix.T @ (0.5 * sum_over_m(of_deviations))

    def forms(self, columns):
        of_deviations = (self.coloured.T @ columns) ** 2
        return self.family.spectrum.matrix.T @ (0.5 * sum_over_m(of_deviations.T).T)
