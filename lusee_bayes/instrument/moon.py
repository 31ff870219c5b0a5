"""Orientations of the Moon, from lunarsky's own coordinate transformation, and on it; the Sun."""

from __future__ import annotations

import astropy.units as u
import numpy as np
from astropy.coordinates import ICRS, CartesianRepresentation, Galactic, get_body_barycentric
from astropy.time import Time
from jaxtyping import Float
from lunarsky import MCMF
from scipy.spatial.transform import Rotation as SpatialRotation

from lusee_bayes.instrument.times import unannounced_leap_seconds

# a sidereal month
CYCLE_DAYS = 27.321661
# period after which the sky repeats itself in luseepy's engine croissant
LUSEEPY_MONTH_HOURS = 655.72


def mcmf_from_galactic(times: Time) -> Float[np.ndarray, "times 3 3"]:
    """Return the rotations that take Galactic unit vectors to MCMF ones.

    The three Galactic axes go through lunarsky's ICRS -> MCMF transformation in one call.
    """
    axes = Galactic(CartesianRepresentation(np.eye(3)[:, :, None])).transform_to(ICRS())
    icrs = ICRS(CartesianRepresentation(axes.cartesian.xyz.value))
    with unannounced_leap_seconds():
        turned = icrs.transform_to(MCMF(obstime=times))
    return np.moveaxis(turned.cartesian.xyz.value, 2, 0)


def about_fixed_axis(
    times: Time, hours: Float[np.ndarray, " times"]
) -> Float[np.ndarray, "times 3 3"]:
    """Return the same of a Moon that turns evenly about the axis of the first time.

    Parameters
    ----------
    times : (times,) Time
    hours : (times,) array
        Since the first one.
    """
    angle = 2.0 * np.pi * hours / LUSEEPY_MONTH_HOURS
    about_z = SpatialRotation.from_rotvec(np.outer(-angle, [0.0, 0.0, 1.0])).as_matrix()
    return about_z @ mcmf_from_galactic(times[:1])[0]


def topocentric_from_mcmf(lon_deg: float, lat_deg: float) -> Float[np.ndarray, "3 3"]:
    """Return the rotation from MCMF to the East, North and up of a site, its rows."""
    lon, lat = np.radians(lon_deg), np.radians(lat_deg)
    up = np.array([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)])
    east = np.array([-np.sin(lon), np.cos(lon), 0.0])
    return np.array([east, np.cross(up, east), up])


def lean(tilt_deg: tuple[float, float]) -> Float[np.ndarray, "3 3"]:
    """Return the rotation from East, North and up to the axes of a lander.

    It leans first towards North, about East, then towards East, about North.
    """
    east, north = np.radians(tilt_deg)
    turned = SpatialRotation.from_rotvec([0.0, east, 0.0])
    turned *= SpatialRotation.from_rotvec([-north, 0.0, 0.0])
    return turned.inv().as_matrix()


def sun_direction(times: Time) -> Float[np.ndarray, "times 3"]:
    """Return Galactic unit vectors from the Moon's centre to where the Sun's is at the time."""
    with unannounced_leap_seconds():
        sun = get_body_barycentric("sun", times, ephemeris="builtin")
        moon = get_body_barycentric("moon", times, ephemeris="builtin")
    direction = (sun - moon).xyz.to_value(u.km)
    galactic = ICRS(CartesianRepresentation(direction)).transform_to(Galactic())
    vector = galactic.cartesian.xyz.value
    return (vector / np.linalg.norm(vector, axis=0)).T
