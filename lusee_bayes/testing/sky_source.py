"""The contract of sky sources."""

from __future__ import annotations

import numpy as np

from lusee_bayes.core.harmonics import n_modes
from lusee_bayes.sky import SkySource
from lusee_bayes.testing.refusals import assert_refused


def check_sky_source(
    source: SkySource,
    *,
    frequency_mhz: float,
    lmax: int,
    slice_rtol: float,
    missing_mhz: float | None = None,
    missing_lmax: int | None = None,
) -> None:
    """Check the laws that every source of skies obeys.

    Parameters
    ----------
    source : SkySource
    frequency_mhz : float
        A frequency in MHz at which it has a sky.
    lmax : int
        Highest ell to ask for, at least 2.
    slice_rtol : float
        How far a sky of smaller lmax may be from a slice of it, rms over rms: 0 for coefficients,
        and for maps what aliases from above lmax in iterated quadrature.
    missing_mhz : float, optional
        A frequency in MHz at which it has no sky.
    missing_lmax : int, optional
        An ell up to which it has no sky.
    """
    sky = source.at(frequency_mhz, lmax)
    modes = np.asarray(sky.modes)
    assert sky.frequency_mhz == frequency_mhz
    assert sky.lmax == lmax
    assert sky.name
    np.testing.assert_array_equal(modes, source.at(frequency_mhz, lmax).modes)
    smaller = np.asarray(source.at(frequency_mhz, lmax // 2).modes)
    assert smaller.size == n_modes(lmax // 2)
    difference = smaller - modes[: smaller.size]
    assert np.linalg.norm(difference) <= slice_rtol * np.linalg.norm(smaller)
    for frequency, highest in ((missing_mhz, lmax), (frequency_mhz, missing_lmax)):
        if frequency is not None and highest is not None:
            assert_refused(lambda f=frequency, ell=highest: source.at(f, ell))
