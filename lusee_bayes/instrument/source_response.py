"""The exact response of the antennas to a source that is much smaller than their resolution.

A source of x K sr in the direction n(t), in the frame of the antennas, gives V_k(t) = x B_k(n(t)).
No harmonic expansion comes in, so that the source rises and sets sharply, and it may move.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from lusee_bayes.core.arrays import Array
from lusee_bayes.core.checks import is_traced, require_array
from lusee_bayes.core.errors import InputError
from lusee_bayes.instrument.beams.monopoles import Monopoles, beams_towards
from lusee_bayes.instrument.observation import Observation


def antenna_directions(
    observation: Observation, galactic: Float[np.ndarray, "..."]
) -> Float[np.ndarray, "times 3"]:
    """Return the direction of a source in the frame of the antennas at every sample.

    The frame turns with the antennas: seen from antennas that are turned by psi from East towards
    North, a source has turned by -psi. As for all skies here, stellar aberration (0.006 degrees) is
    left out.

    Parameters
    ----------
    observation : Observation
    galactic : (3,) or (times, 3) array
        Galactic unit vector of the source, fixed or at every sample.

    Returns
    -------
    (times, 3) array
        East, North and up components.

    Raises
    ------
    InputError
        Unless ``galactic`` is a finite float64 array of such a shape.
    """
    require_array("galactic", galactic, (3,) if galactic.ndim == 1 else (observation.n_times, 3))
    vectors = np.broadcast_to(galactic, (observation.n_times, 3))
    mcmf = np.einsum("tij,tj->ti", observation.mcmf_from_galactic, vectors)
    topocentric_from_mcmf = observation.topocentric_from_mcmf()
    leaning = observation.lander_from_mcmf() @ topocentric_from_mcmf.T
    east, north, up = leaning @ (mcmf @ topocentric_from_mcmf.T).T
    turned = np.radians(np.asarray(observation.turntable_deg, dtype=np.float64))[observation.run]
    cos, sin = np.cos(turned), np.sin(turned)
    return np.stack([cos * east + sin * north, cos * north - sin * east, up], axis=1)


def source_response(
    observation: Observation,
    galactic: Float[np.ndarray, "..."],
    frequency_mhz: float | Float[Array, ""],
    monopoles: Monopoles | None = None,
    *,
    stokes_v: float | Float[Array, ""] = 0.0,
) -> Float[Array, "products times"]:
    """Return the visibilities of a source of 1 K sr at every sample.

    V_k(t) = B_k^I(n(t)) + stokes_v B_k^V(n(t)), since I = 1 K sr and V = stokes_v I. Multiply by
    the flux in K sr, constant or (times,). Differentiable in ``monopoles`` and ``stokes_v``.

    Parameters
    ----------
    observation : Observation
    galactic : (3,) or (times, 3) array
        As of :func:`antenna_directions`.
    frequency_mhz : float
    monopoles : Monopoles, optional
        By default the paper's antennas.
    stokes_v : float
        V / I with the IAU's sign. Where it is positive, a receiver that looks towards the source
        sees the electric field turn counter-clockwise (right-handed).

    Returns
    -------
    (products, times) array
        In K; zero while the source is below the horizon.

    Raises
    ------
    InputError
        As :func:`antenna_directions`; for vectors whose length is not one, a frequency that is not
        positive, or ``|stokes_v| > 1``.
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
    return response + stokes_v * circular
