"""Beams on the Moon: turned by the turntable, leaning with the lander, tilted with the pole."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from lusee_bayes.core.arrays import Array, compiled, namespace
from lusee_bayes.core.harmonics import (
    lmax_of,
    mode_numbers,
    tilts,
    turn_about_x,
    turn_about_y,
    turn_about_z,
)
from lusee_bayes.instrument.pointing import Pointing


@compiled
def body_beams(
    modes: Float[Array, "products modes"], pointing: Pointing
) -> Float[Array, "runs products functions modes"]:
    """Turn beams into the Moon-fixed frame, as every function of time of the pointing sees them.

    Parameters
    ----------
    modes : (products, modes) array
        Harmonic coefficients in the frame of the lander, real packed.
    pointing : Pointing
        The orientations; differentiable in its turntable angles and turns.

    Returns
    -------
    (runs, products, functions, modes) array
    """
    xp, runs = namespace(modes, pointing), []
    for run in range(len(pointing.run_starts) - 1):
        body = _on_the_moon(turn_about_z(modes, pointing.turntable[run]), pointing)
        runs.append(_taken_up(xp.stack(tilts(body, pointing.order), axis=1), pointing.factors))
    return xp.stack(runs)


def _on_the_moon(modes: Float[Array, "products modes"], pointing: Pointing) -> Array:
    """Beams of the lander in the Moon-fixed frame, with the pointing's further turns."""
    if pointing.turns is None:
        return pointing.mcmf_from_lander(modes)
    lon, lat, east, north = (pointing.turns[k] for k in range(4))
    leaning = turn_about_x(turn_about_y(turn_about_x(modes, -north), east), -lat)
    return turn_about_z(pointing.mcmf_from_lander(leaning), lon)


def _taken_up(
    tilted: Float[Array, "products powers modes"],
    factors: Float[Array, "functions powers orders 2"],
) -> Float[Array, "products functions modes"]:
    """sum_p G_j(p, m) W_p, a complex factor for each pair c_m + i c_-m."""
    ell, m = mode_numbers(lmax_of(tilted.shape[-1]))
    xp = namespace(tilted, factors)
    # modes side by side in memory, as products of matrices want them
    mirrored = xp.take(tilted, ell * (ell + 1) - m, axis=-1)
    real = xp.take(factors[..., 0], np.abs(m), axis=-1)
    sign = np.sign(m).astype(np.float64)[None, None]
    imaginary = xp.take(factors[..., 1], np.abs(m), axis=-1) * sign
    return sum(
        tilted[:, None, p] * real[None, :, p] - mirrored[:, None, p] * imaginary[None, :, p]
        for p in range(tilted.shape[1])
    )
