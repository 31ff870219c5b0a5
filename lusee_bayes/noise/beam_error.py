"""Errors of the beams in A: N_beam = dA (S + mu mu^T) dA^T along known directions dA.

If the true coupling matrix is A + dA, the data hold dA m besides A m; over skies of the prior, that
is noise of covariance dA S dA^T (paper, section on beam precision). Directions: the
difference to another beam (a frequency shift, another file), or the derivative with respect to a
parameter of the embedded beam times its standard deviation.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Float

from lusee_bayes.core.arrays import Array
from lusee_bayes.core.checks import require_shape
from lusee_bayes.instrument.beams import Monopoles, ProductBeams, monopole_beams, parameter, placed
from lusee_bayes.instrument.coupling import Coupling
from lusee_bayes.noise.covariance import LowRankCovariance
from lusee_bayes.sky.priors import Prior


def beam_error_noise(direction: Coupling, prior: Prior) -> LowRankCovariance:
    """Return the covariance dA (S + mu mu^T) dA^T of a beam error, mu being the prior's mean.

    Parameters
    ----------
    direction : Coupling
        dA: the coupling matrix of a difference of beams.
    prior : Prior
        S and mu.

    Returns
    -------
    LowRankCovariance
        In K^2.
    """
    columns = prior.colour_columns(direction.dense())
    if prior.white_mean is not None:
        columns = jnp.concatenate([columns, (columns @ prior.white_mean)[:, None]], axis=1)
    return LowRankCovariance(columns, "the beam-error covariance")


def difference(true: ProductBeams, model: ProductBeams) -> ProductBeams:
    """Return the difference true - model of two beams, the direction of a beam error.

    Raises
    ------
    InputError
        If their shapes differ.
    """
    require_shape("the other beam's coefficients", true.modes, model.modes.shape)
    return ProductBeams(true.modes - model.modes, model.frequency_mhz)


def derivative(name: str, frequency_mhz: float, lmax: int, monopoles: Monopoles) -> ProductBeams:
    """Return the derivative of the beams in a parameter of the embedded antennas.

    Parameters
    ----------
    name : str
        One of ``beams.PARAMETERS``.
    frequency_mhz : float
    lmax : int
    monopoles : Monopoles
        Where to take the derivative.

    Returns
    -------
    ProductBeams
        In K per K and unit of the parameter.

    Raises
    ------
    InputError
        If the parameter is unknown.
    """

    def modes(value: Float[Array, ""]) -> Float[Array, "products modes"]:
        return monopole_beams(frequency_mhz, lmax, placed(monopoles, {name: value})).modes

    value = parameter(name).where(monopoles)
    _, slope = jax.jvp(modes, (value,), (jnp.ones_like(value),))
    return ProductBeams(slope, float(frequency_mhz))


def rms_difference(true: ProductBeams, model: ProductBeams) -> float:
    """Return the RMS difference of two beams, relative to the RMS of ``model``.

    Over products and directions, by Parseval's theorem from the coefficients up to lmax.
    """
    error = difference(true, model).modes
    return float(jnp.sqrt((error**2).sum() / (model.modes**2).sum()))
