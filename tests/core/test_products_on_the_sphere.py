"""Multiplication by a field as a matrix over harmonics, against sums over points of the sphere."""

from __future__ import annotations

import numpy as np
import pytest

from lusee_bayes.core.errors import InputError
from lusee_bayes.core.harmonics import n_modes, synthesis_matrix
from lusee_bayes.core.sphere_grid import SphereGrid

HIGHEST, LMAX, OF_FIELD = 7, 4, 3


def field(theta, phi):
    """A field of degree 3."""
    coefficients = np.random.default_rng(1).normal(size=n_modes(OF_FIELD))
    return synthesis_matrix(theta, phi, OF_FIELD) @ coefficients


@pytest.mark.parametrize("lmax", [LMAX, HIGHEST])
def test_a_product_matrix_is_an_integral(lmax):
    grid = SphereGrid.of(HIGHEST, HIGHEST + OF_FIELD)
    found = grid.product_matrix(field(*grid.directions()).reshape(grid.shape), lmax)
    # another rule: equal steps in azimuth from elsewhere, and many more rings
    x, weights = np.polynomial.legendre.leggauss(40)
    phi = 0.1 + 2.0 * np.pi * np.arange(50) / 50
    theta, phi = (a.ravel() for a in np.meshgrid(np.arccos(x), phi, indexing="ij"))
    area = np.repeat(weights, 50) * 2.0 * np.pi / 50
    y = synthesis_matrix(theta, phi, HIGHEST)
    expected = (y * (area * field(theta, phi))[:, None]).T @ y
    np.testing.assert_allclose(found, expected[: n_modes(lmax)], atol=1e-13)


def test_values_of_another_grid_are_refused():
    with pytest.raises(InputError, match="the field has shape"):
        SphereGrid.of(3, 6).product_matrix(np.ones((3, 4)))
