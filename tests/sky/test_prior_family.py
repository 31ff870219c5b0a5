"""Families of priors: their S and its derivatives against brute force."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import quad

from lusee_bayes.core.harmonics import n_modes, per_mode, synthesis_matrix
from lusee_bayes.core.sphere_grid import SphereGrid
from lusee_bayes.priors.families import Hyperprior, IsotropicFamily, PriorFamily
from lusee_bayes.priors.local_scales import embedded_local_scales, windows

LMAX = 5


MAKE = {
    "isotropic": lambda lmax: IsotropicFamily.around(2e4, lmax),
    "local scales": lambda lmax: embedded_local_scales(25.0, lmax),
}


@pytest.fixture(scope="module", params=MAKE)
def made(request):
    """A family, and the same of a lower lmax."""
    return MAKE[request.param](LMAX), MAKE[request.param](3)


@pytest.fixture(scope="module")
def family(made):
    return made[0]


def somewhere(family: PriorFamily) -> np.ndarray:
    """Parameters away from the centre."""
    start = family.hyperprior.start()
    return start + 0.3 * np.random.default_rng(3).standard_normal(len(start))


def test_derivatives_are_those_of_the_covariance(family):
    """Central differences of step 1e-4: their error is 1e-8 of the third derivative, 1e-7 here."""
    rng, theta = np.random.default_rng(1), somewhere(family)
    n = n_modes(LMAX)
    half = rng.standard_normal((n, n)) / np.sqrt(np.diagonal(family.at(theta).covariance))[:, None]
    matrix, columns = half @ half.T, half[:, :2]
    member = family.at(theta)
    traces, forms = member.traces(matrix), member.forms(columns)
    chosen = np.unique(np.linspace(0, len(theta) - 1, 25).astype(int))
    for i in chosen:
        step = np.zeros_like(theta)
        step[i] = 1e-4
        up, down = (family.at(theta + s).covariance for s in (step, -step))
        slope = (up - down) / 2e-4
        np.testing.assert_allclose(
            traces[i], 0.5 * (slope * matrix).sum(), rtol=1e-6, atol=1e-7 * np.abs(traces).max()
        )
        np.testing.assert_allclose(
            forms[i],
            0.5 * np.einsum("ik,ij,jk->k", columns, slope, columns),
            rtol=1e-6,
            atol=1e-7 * np.abs(forms).max(),
        )


def test_averages_are_means_over_the_parameters(family):
    """Without uncertainty S itself; with some, what each variance gains is exp(half of its own)."""
    theta = somewhere(family)
    alone = family.averaged(theta, lambda rows: np.zeros(len(rows)))
    np.testing.assert_allclose(alone, family.at(theta).covariance, rtol=1e-12, atol=1e-6)
    wider = family.averaged(theta, lambda rows: np.full(len(rows), 0.5))
    gain = np.diagonal(wider)[1:] / np.diagonal(alone)[1:]
    assert (gain <= np.exp(0.25) * (1 + 1e-12)).all()
    assert gain.max() > 1.01


def test_priors_of_a_family_have_its_covariance(family):
    expected = family.at(family.hyperprior.start()).covariance
    found = np.asarray(family.expected().covariance())
    np.testing.assert_allclose(found, expected, rtol=1e-10, atol=1e-8 * expected.max())


def test_an_even_texture_is_isotropic():
    """Where no strength varies, the last term of the equation has the covariance diag(C_ell)."""
    family = embedded_local_scales(25.0, LMAX)
    theta = family.hyperprior.start()
    power, fluxes, covariates, cells = family._split(theta)
    even = np.concatenate([power, fluxes, 0.0 * covariates, cells])
    member = family.at(even)
    expected = np.diag(per_mode(np.where(np.arange(LMAX + 1) > 0, member.spectrum, 0.0)))
    np.testing.assert_allclose(member.texture, expected, atol=1e-12 * expected.max())


def test_the_texture_is_filtered_white_noise():
    """R sum_j w_j Y^T diag(area v_j) Y w_j R, with dense harmonics at the grid's points."""
    family = embedded_local_scales(25.0, LMAX)
    member = family.at(somewhere(family))
    expected = np.zeros((n_modes(LMAX),) * 2)
    for band, strength in zip(family.bands, member.strengths, strict=True):
        harmonics = synthesis_matrix(*band.grid.directions(), LMAX)
        area = np.repeat(band.grid.weights, band.grid.n_phi)
        scale = per_mode(band.window * np.sqrt(member.spectrum))
        expected += scale[:, None] * ((harmonics.T * (area * strength)) @ harmonics) * scale
    np.testing.assert_allclose(member.texture, expected, atol=1e-11 * expected.max())


@pytest.mark.parametrize("lmax", [1, 2, 5, 31, 47])
def test_windows_share_every_ell(lmax):
    found = windows(lmax)
    np.testing.assert_allclose((found**2).sum(0)[1:], 1.0, rtol=1e-14)
    assert (found[:, 0] == 0.0).all()


def test_the_diagonal_on_a_grid():
    """y^T C y of dense harmonics, and the adjoint of multiplication by a field."""
    rng = np.random.default_rng(5)
    grid = SphereGrid.of(4, 7)
    half = rng.standard_normal((25, 25))
    matrix, field = half @ half.T, rng.standard_normal(grid.shape)
    harmonics = synthesis_matrix(*grid.directions(), 4)
    dense = np.einsum("pi,ij,pj->p", harmonics, matrix, harmonics).reshape(grid.shape)
    np.testing.assert_allclose(grid.diagonal(matrix), dense, rtol=1e-12)
    area = np.asarray(grid.weights)[:, None]
    np.testing.assert_allclose(
        (grid.product_matrix(field) * matrix).sum(),
        (field * area * grid.diagonal(matrix)).sum(),
        rtol=1e-11,
    )


def test_the_hyperprior_is_a_density():
    """It integrates to one over a parameter and over a cell, and its gradient is its own."""
    theta = Hyperprior(np.array([-2.7]), np.array([0.2]))
    total, _ = quad(lambda x: np.exp(theta.log_density(np.array([x]))), -np.inf, np.inf)
    assert total == pytest.approx(1.0, rel=1e-6)
    cell = Hyperprior(np.zeros(0), np.zeros(0), 1)
    total, _ = quad(lambda x: np.exp(cell.log_density(np.array([x]))), -8.0, 60.0, limit=200)
    assert total == pytest.approx(1.0, rel=1e-6)
    both = Hyperprior(np.array([1.0, -2.0]), np.array([0.5, 2.0]), 2)
    at = np.array([1.4, -5.0, -0.3, 2.0])
    for i in range(4):
        step = np.zeros(4)
        step[i] = 1e-5
        slope = (both.log_density(at + step) - both.log_density(at - step)) / 2e-5
        assert both.gradient(at)[i] == pytest.approx(slope, rel=1e-7)
    assert (both.curvature(at) > 0.0).all()


def test_a_coarse_start_keeps_what_both_have(made):
    family, coarse = made
    found = family.start_from(coarse, coarse.hyperprior.start() + 0.1)
    assert len(found) == family.hyperprior.size
    moved = found - family.hyperprior.start()
    assert (np.abs(moved) > 0.05).sum() == coarse.hyperprior.size
