"""luseepy's quadrature rules, against closed forms."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

from lusee_bayes.core.harmonics import mode_numbers, polar_functions
from lusee_bayes.instrument.beams.luseepy_rules import (
    BandLimitedGrid,
    cardinal_functions,
    rectangle_rule,
)


@pytest.mark.parametrize("parity", [0, 1])
def test_cardinal_functions_interpolate(parity):
    """One at a sample, zero at the others; exact for cosines (sines) of fewer than n periods."""
    n = 12
    samples = np.pi * np.arange(n + 1) / n
    at_samples = cardinal_functions(samples, n, parity)
    expected = np.eye(n + 1)
    if parity:
        expected[[0, -1], [0, -1]] = 0.0  # an odd function is zero at the poles
    np.testing.assert_allclose(at_samples, expected, rtol=0, atol=1e-13)
    theta = np.linspace(0.1, 3.0, 17)
    wave = np.sin if parity else np.cos
    for order in range(1, n):
        got = cardinal_functions(theta, n, parity) @ wave(order * samples)
        np.testing.assert_allclose(got, wave(order * theta), rtol=0, atol=1e-13)


def test_a_band_limited_pattern_above_the_horizon_is_integrated_as_it_is_given():
    """A sum of harmonics that vanishes below the horizon does not exist; but what the rule makes of
    samples is linear, so the sum over both hemispheres of a function gives its coefficients back.

    Samples below the horizon are those of the mirrored function, of (-1)^(ell + m) the harmonics.
    """
    lmax, n = 6, 9
    theta = np.linspace(0.0, np.pi / 2, n)
    grid = BandLimitedGrid.of(theta, 16)
    weights = grid.polar_weights(lmax)
    ell, m = mode_numbers(lmax)
    polar = polar_functions(theta, lmax)
    mirror = (-1.0) ** (ell + m)
    # coefficients of lambda_lm of given m over the whole sphere: (1 + mirror mirror') of the half
    for k in range(len(ell)):
        same = m == m[k]
        both = weights[:, same].T @ polar[:, k] * (1.0 + mirror[same] * mirror[k])
        expected = (ell[same] == ell[k]) / (2 * np.pi)
        np.testing.assert_allclose(both, expected, rtol=0, atol=1e-13)
    # and the integral over the whole sphere of 1 is 4 pi: two halves
    ones = jnp.ones((n, 16))
    assert float(grid.integrate(ones)) == pytest.approx(2 * np.pi, rel=1e-13)


def test_the_rectangle_rule():
    """sin(theta) dtheta over [0, pi / 2] by hand: the sum falls short by a twelfth of the step
    squared (Euler and Maclaurin) on top of half the last ring."""
    n = 91
    grid = rectangle_rule(np.linspace(0.0, np.pi / 2, n), 180)
    step = np.pi / 180
    assert float(grid.integrate(jnp.ones((n, 180)))) == pytest.approx(
        2 * np.pi * (1.0 + step / 2 - step**2 / 12), rel=1e-9
    )
