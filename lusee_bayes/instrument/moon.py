"""The orientation of the Moon, from lunarsky's own coordinate transformation."""

from __future__ import annotations

import numpy as np
from astropy.coordinates import ICRS, CartesianRepresentation, Galactic
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
