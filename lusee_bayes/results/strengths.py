"""How strong the sky is compared with its prior: by Galactic latitude and by multipole.

If the model holds, the deviation of the posterior mean from that of the prior is drawn from
N(0, S - C): what the prior allows less what the data leave open. Its square over that expectation
is 1 on average, larger where the prior is too narrow, and smaller where it is too wide.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

from lusee_bayes.core.harmonics import lmax_of, modes_to_map
from lusee_bayes.core.lazy import healpy
from lusee_bayes.results.coverage import latitudes, multipoles


def strengths(
    deviation: Float[np.ndarray, " modes"],
    of_modes: Float[np.ndarray, " modes"],
    of_pixels: Float[np.ndarray, " pixels"],
) -> dict[str, float]:
    """Compute the square of a sky's deviation over what is expected, part by part.

    The monopole, of which priors know little, is left out.

    Parameters
    ----------
    deviation : (modes,) array
        Posterior mean less prior mean, in K.
    of_modes, of_pixels : (modes,), (pixels,) array
        The diagonal of S - C, of the modes and of the pixels without the monopole, in K^2.

    Returns
    -------
    dict of str to float
        By name of the part; parts of which the data know nothing are left out.
    """
    rest = np.where(np.arange(len(deviation)) > 0, deviation, 0.0)
    nside = healpy.npix2nside(len(of_pixels))
    bands = latitudes(nside)
    ells = multipoles(lmax_of(len(deviation)))
    parts = [(name, modes_to_map(rest, nside), of_pixels, bands[name]) for name in list(bands)[:-1]]
    parts += [(name, rest, of_modes, ells[name]) for name in list(ells)[1:-1]]
    return {
        name: float((values[inside] ** 2).sum() / expected[inside].sum())
        for name, values, expected, inside in parts
        if expected[inside].sum() > 0
    }


def strengths_in_words(found: Mapping[str, float]) -> str:
    """A sentence of them; empty if there are none."""
    if not found:
        return ""
    listed = ", ".join(f"{value:.2g} at {name}" for name, value in found.items())
    return f"Power of the sky over what the prior expects: {listed}."
