"""The orientation of the Moon, from lunarsky's own coordinate transformation, and its Sun."""

from __future__ import annotations

import astropy.units as u
import numpy as np
from astropy.coordinates import ICRS, CartesianRepresentation, Galactic, get_body_barycentric
from astropy.time import Time
from jaxtyping import Float
from lunarsky import MCMF

from lusee_bayes.instrument.times import unannounced_leap_seconds


def mcmf_from_galactic(times: Time) -> Float[np.ndarray, "times 3 3"]:
    """Return the rotations that take Galactic unit vectors to MCMF ones.

    The three Galactic axes go through lunarsky's ICRS -> MCMF transformation in one call.
    """
    axes = Galactic(CartesianRepresentation(np.eye(3)[:, :, None])).transform_to(ICRS())
    icrs = ICRS(CartesianRepresentation(axes.cartesian.xyz.value))
    with unannounced_leap_seconds():
        turned = icrs.transform_to(MCMF(obstime=times))
    return np.moveaxis(turned.cartesian.xyz.value, 2, 0)


def sun_direction(times: Time) -> Float[np.ndarray, "times 3"]:
    """Return Galactic unit vectors from the Moon's centre to where the Sun's is at the time."""
    with unannounced_leap_seconds():
        sun = get_body_barycentric("sun", times, ephemeris="builtin")
        moon = get_body_barycentric("moon", times, ephemeris="builtin")
    direction = (sun - moon).xyz.to_value(u.km)
    galactic = ICRS(CartesianRepresentation(direction)).transform_to(Galactic())
    vector = galactic.cartesian.xyz.value
    return (vector / np.linalg.norm(vector, axis=0)).T
