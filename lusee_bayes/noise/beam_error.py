"""Beams that are not quite what A says: N_beam = dA S dA^T along known directions dA.

If the true coupling matrix is A + dA, the data hold dA m besides A m; averaged over skies of the
prior that is noise of covariance dA S dA^T (paper, section on beam precision). Directions: the
difference to another beam (a frequency shift, another file), or the derivative with respect to a
parameter of the embedded beam times its standard deviation.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from lusee_bayes.beams import Monopoles, ProductBeams, monopole_beams, parameter, placed
from lusee_bayes.checks import require_shape
from lusee_bayes.coupling import CouplingMatrix
from lusee_bayes.covariance import LowRankCovariance
from lusee_bayes.prior import Prior


def beam_error_noise(direction: CouplingMatrix, prior: Prior) -> LowRankCovariance:
    """dA S dA^T, in K^2; ``direction`` is dA: a coupling matrix of the difference of two beams."""
    return LowRankCovariance(prior.colour_columns(direction.dense()), "the beam-error covariance")


def difference(true: ProductBeams, model: ProductBeams) -> ProductBeams:
    """Beams true - model: the direction of a beam error. InputError if they do not match."""
    require_shape("the other beam's coefficients", true.modes, model.modes.shape)
    return ProductBeams(true.modes - model.modes, model.frequency_mhz)


def derivative(name: str, frequency_mhz: float, lmax: int, monopoles: Monopoles) -> ProductBeams:
    """d beams / d (a parameter of the embedded antennas), by forward mode.

    ``name``: one of ``beams.PARAMETERS``; InputError naming the nearest for others.
    """

    def modes(value: Float[Array, ""]) -> Float[Array, "products modes"]:
        return monopole_beams(frequency_mhz, lmax, placed(monopoles, {name: value})).modes

    value = parameter(name).where(monopoles)
    _, slope = jax.jvp(modes, (value,), (jnp.ones_like(value),))
    return ProductBeams(slope, float(frequency_mhz))


def rms_difference(true: ProductBeams, model: ProductBeams) -> float:
    """RMS over products and directions of the difference of two beams, over the RMS of the model.

    By Parseval, from the coefficients up to lmax.
    """
    error = difference(true, model).modes
    return float(jnp.sqrt((error**2).sum() / (model.modes**2).sum()))
