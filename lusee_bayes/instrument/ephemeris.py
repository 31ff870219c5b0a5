"""Directions and distances of the Sun, the Earth and the planets, seen from the lander.

Positions come from ERFA's analytical series (astropy's ``builtin``; nothing is downloaded): the
Earth to 1e-7 au and the Moon to 10 arcseconds, the Sun as good as the Earth, Jupiter, Saturn and
Uranus to 90 arcseconds, the other planets to 20 (notes of erfa.epv00, moon98 and plan94).
"""

from __future__ import annotations

import astropy.units as u
import numpy as np
from astropy.constants import c
from astropy.coordinates import ICRS, CartesianRepresentation, Galactic, get_body_barycentric
from astropy.time import Time, TimeDelta
from jaxtyping import Float

from lusee_bayes.core.errors import InputError, nearest
from lusee_bayes.instrument.observation import Observation
from lusee_bayes.instrument.times import unannounced_leap_seconds

BODIES = (
    "Sun",
    "Mercury",
    "Venus",
    "Earth",
    "Mars",
    "Jupiter",
    "Saturn",
    "Uranus",
    "Neptune",
)

MOON_RADIUS_KM = 1737.4  # IAU mean radius
LIGHT_KM_PER_S = c.to_value(u.km / u.s)

# each iteration leaves v / c < 2e-4 of the light time's error: three of them leave 0.1 us
LIGHT_TIME_ITERATIONS = 3


def body_direction(body: str, observation: Observation) -> Float[np.ndarray, "times 3"]:
    """Return the direction from the lander to a body at every sample.

    The direction is that from the lander's place on the Moon to where the body was when its light
    left. As for all skies here, stellar aberration (0.006 degrees) is left out.

    Parameters
    ----------
    body : str
        One of ``BODIES``, in upper or lower case.
    observation : Observation

    Returns
    -------
    (times, 3) array
        Galactic unit vectors.

    Raises
    ------
    InputError
        If the body is unknown.
    """
    vector = _from_lander_km(body, observation)
    return vector / np.linalg.norm(vector, axis=1, keepdims=True)


def body_distance_au(body: str, observation: Observation) -> Float[np.ndarray, " times"]:
    """Return the distance in au that the light of a body has travelled to the lander.

    Parameters and errors as of :func:`body_direction`.
    """
    return (np.linalg.norm(_from_lander_km(body, observation), axis=1) * u.km).to_value(u.au)


def _from_lander_km(body: str, observation: Observation) -> Float[np.ndarray, "times 3"]:
    known = {name.lower(): name for name in BODIES}
    if body.lower() not in known:
        hint = nearest(body.capitalize(), BODIES)
        raise InputError(f"unknown body '{body}' in the sky of the Moon; {hint}")
    with unannounced_leap_seconds():
        arrival = observation.times.tdb
    lander = _barycentric_km("moon", arrival) + MOON_RADIUS_KM * observation.zenith_galactic()
    light_time = np.zeros(observation.n_times)
    for _ in range(LIGHT_TIME_ITERATIONS):
        departure = arrival - TimeDelta(light_time, format="sec", scale="tdb")
        vector = _barycentric_km(body.lower(), departure) - lander
        light_time = np.linalg.norm(vector, axis=1) / LIGHT_KM_PER_S
    return vector


def _barycentric_km(body: str, times: Time) -> Float[np.ndarray, "times 3"]:
    """Place from the barycentre of the Solar System along Galactic axes."""
    place = get_body_barycentric(body, times, ephemeris="builtin").xyz.to_value(u.km)
    axes = ICRS(CartesianRepresentation(np.eye(3))).transform_to(Galactic())
    return (axes.cartesian.xyz.value @ place).T
