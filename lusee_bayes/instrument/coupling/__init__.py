"""The coupling matrix A, from sky coefficients to visibilities: one protocol, two kinds."""

from lusee_bayes.instrument.coupling.base import Coupling
from lusee_bayes.instrument.coupling.dense import DenseCoupling, as_coupling
from lusee_bayes.instrument.coupling.structured import CouplingMatrix, turned_about_pole

__all__ = ["Coupling", "CouplingMatrix", "DenseCoupling", "as_coupling", "turned_about_pole"]
