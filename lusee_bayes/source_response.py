"""The exact response of the antennas to a source much smaller than their resolution.

A source of x K sr in the direction n(t), in the frame of the antennas, gives V_k(t) = x B_k(n(t)).
No harmonic expansion comes in, so that the source rises and sets sharply, and it may move.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lusee_bayes.beams import Monopoles, beams_towards
from lusee_bayes.checks import (
    InputError,
    is_traced,
    require_finite,
    require_float64,
    require_shape,
)
from lusee_bayes.observation import Observation


def antenna_directions(
    observation: Observation, galactic: Float[np.ndarray, "..."]
) -> Float[np.ndarray, "times 3"]:
    """East, North, up components, in the frame of the antennas, of a source at every sample.

    ``galactic``: its Galactic unit vector, (3,) if fixed or (times, 3). The frame of the antennas
    turns with them: seen from antennas turned by psi from East towards North, a source has turned
    by -psi. Geometric, without stellar aberration (0.006 degrees), as all skies here.

    InputError unless the vectors are finite float64 arrays of that shape.
    """
    east, north, up = _topocentric(observation, galactic).T
    turned = np.radians(np.asarray(observation.turntable_deg, dtype=np.float64))[observation.run]
    cos, sin = np.cos(turned), np.sin(turned)
    return np.stack([cos * east + sin * north, cos * north - sin * east, up], axis=1)


def altitude_deg(
    observation: Observation, galactic: Float[np.ndarray, "..."]
) -> Float[np.ndarray, " times"]:
    """Altitude of a source above the horizon at every sample, in degrees.

    ``galactic`` and errors as for :func:`antenna_directions`.
    """
    east, north, up = _topocentric(observation, galactic).T
    return np.degrees(np.arctan2(up, np.hypot(east, north)))


def source_response(
    observation: Observation,
    galactic: Float[np.ndarray, "..."],
    frequency_mhz: float | Float[Array, ""],
    monopoles: Monopoles | None = None,
    *,
    stokes_v: float | Float[Array, ""] = 0.0,
) -> Float[Array, "products times"]:
    """Visibilities, in K, of a source of 1 K sr at every sample; zero while it is down.

    V_k(t) = B_k^I(n(t)) + stokes_v B_k^V(n(t)): I = 1 K sr, V = stokes_v I. Multiply by the flux,
    constant or (times,), in K sr. V > 0: the electric field turns clockwise for whoever looks
    towards the source (left-handed in the convention of the IAU). Differentiable in ``monopoles``
    (default: the paper's antennas) and ``stokes_v``.

    ``galactic`` as for :func:`antenna_directions`; InputError as there, for vectors not of length
    one, for a frequency that is not positive and for |stokes_v| > 1.
    """
    if not is_traced(stokes_v) and not abs(stokes_v) <= 1.0:
        raise InputError(
            f"stokes_v is the fraction V / I, from -1 to 1, got {stokes_v}; no wave is polarised "
            "by more than all of itself"
        )
    directions = antenna_directions(observation, galactic)
    response = beams_towards(frequency_mhz, directions, monopoles)
    if not is_traced(stokes_v) and stokes_v == 0.0:
        return response
    circular = beams_towards(frequency_mhz, directions, monopoles, stokes="V")
    return response + jnp.asarray(stokes_v, dtype=jnp.float64) * circular


def _topocentric(
    observation: Observation, galactic: Float[np.ndarray, "..."]
) -> Float[np.ndarray, "times 3"]:
    require_float64("galactic", galactic)
    require_shape("galactic", galactic, (3,) if galactic.ndim == 1 else (observation.n_times, 3))
    require_finite("galactic", galactic)
    vectors = np.broadcast_to(galactic, (observation.n_times, 3))
    mcmf = np.einsum("tij,tj->ti", observation.mcmf_from_galactic(), vectors)
    return mcmf @ observation.topocentric_from_mcmf().T
