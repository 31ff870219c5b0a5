"""The beam of every product in given directions: the exact response to a point source.

Harmonic coefficients up to lmax blur a point source; the field pattern itself does not.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from lusee_bayes.core.arrays import Array, compiled, namespace
from lusee_bayes.core.checks import (
    is_traced,
    require_finite,
    require_float64,
    require_positive,
    require_shape,
)
from lusee_bayes.core.errors import InputError
from lusee_bayes.instrument.beams.fields import AntennaFields
from lusee_bayes.instrument.beams.grid import HemisphereGrid
from lusee_bayes.instrument.beams.monopoles import Monopoles
from lusee_bayes.instrument.beams.product_beams import mean_auto_integral, stokes_pairs
from lusee_bayes.instrument.products import to_real

# rotations keep |n| = 1 to rounding; a vector that is further from it is a mistake
UNIT_TOLERANCE = 1e-9

# the autos' integral is converged on this grid, the one of every lmax up to 63
NORMALISATION_LMAX = 63


def beams_towards(
    frequency_mhz: float | Float[Array, ""],
    directions: Float[Array, "directions 3"],
    monopoles: Monopoles | None = None,
    *,
    stokes: str = "I",
) -> Float[Array, "products directions"]:
    """Return the beams B_k(n) of the embedded antennas in the directions n.

    A source of x K sr in direction n adds x B_k(n) kelvin to product k (for ``stokes`` V, x is the
    integral of V over the source). Differentiable in every parameter of ``monopoles``, also below
    the horizon, and in the directions, except at the zenith, where theta and phi have no slope.

    Parameters
    ----------
    frequency_mhz : float
    directions : (directions, 3) array
        Unit vectors: East, North, up in the frame of the antennas.
    monopoles : Monopoles, optional
        By default the paper's four arms on its ground.
    stokes : {"I", "Q", "U", "V"}
        Q and U refer to the directions of increasing theta and phi; at the zenith, to East and
        North.

    Returns
    -------
    (products, directions) array
        In 1/sr, with the normalisation of :func:`monopole_beams`; zero where up <= 0.

    Raises
    ------
    InputError
        For a frequency that is not positive, vectors whose length is not one, or an unknown Stokes
        parameter.
    """
    require_positive("frequency_mhz", frequency_mhz)
    require_shape("directions", directions, (None, 3))
    require_float64("directions", directions)
    require_finite("directions", directions)
    _require_unit(directions)
    monopoles = Monopoles() if monopoles is None else monopoles
    # an array: one compilation for all frequencies
    frequency = namespace(frequency_mhz).asarray(frequency_mhz, dtype=np.float64)
    patterns = _patterns(frequency, directions, monopoles, stokes)
    return patterns / _normalisation(frequency, monopoles)


@compiled
def _patterns(
    frequency_mhz: Float[Array, ""],
    directions: Float[Array, "directions 3"],
    monopoles: Monopoles,
    stokes: str,
) -> Float[Array, "products directions"]:
    visible = directions[:, 2] > 0.0
    # a visible direction replaces the hidden ones: its field and its slopes are finite
    xp = namespace(frequency_mhz, directions, monopoles)
    stand_in = np.array([0.6, 0.0, 0.8])[None]
    east, north, up = xp.where(visible[:, None], directions, stand_in).T
    theta, phi = xp.arctan2(xp.hypot(east, north), up), xp.arctan2(north, east)
    patterns = to_real(stokes_pairs(*monopoles.towards(frequency_mhz, theta, phi), stokes))
    return xp.where(visible[None], patterns, 0.0)


@compiled
def _normalisation(frequency_mhz: Float[Array, ""], monopoles: Monopoles) -> Float[Array, ""]:
    grid = HemisphereGrid.for_lmax(NORMALISATION_LMAX)
    e_theta, e_phi = monopoles.towards(frequency_mhz, grid.theta[:, None], grid.phi[None])
    return mean_auto_integral(AntennaFields(e_theta, e_phi, grid))


def _require_unit(directions: Float[Array, "directions 3"]) -> None:
    if is_traced(directions):
        return
    length = np.linalg.norm(np.asarray(directions), axis=1)
    bad = np.flatnonzero(np.abs(length - 1.0) > UNIT_TOLERANCE)
    if bad.size:
        raise InputError(
            f"directions must be unit vectors, number {bad[0]} has length {length[bad[0]]:.6g}; "
            "divide them by their length"
        )
