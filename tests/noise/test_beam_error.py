"""Beam errors: dA S dA^T by hand, rms by quadrature."""

import jax.numpy as jnp
import numpy as np
import pytest
from assertions import close, refuse
from reference import real_harmonics, sphere
from reference_linear import random_covariance

import lusee_bayes as lb
from lusee_bayes.instrument.beams import fields, monopoles
from lusee_bayes.instrument.pointing import Pointing
from lusee_bayes.instrument.products import DataLayout
from lusee_bayes.noise.instrument_errors import beam_error_noise, difference, rms_difference
from lusee_bayes.sky.prior import DensePrior

LMAX, FREQUENCY = 4, 25.0
ANTENNAS = monopoles.Monopoles(turntable_offset_deg=10.0)


@pytest.fixture(scope="module")
def beams():
    return lb.monopole_beams(FREQUENCY, LMAX, ANTENNAS)


@pytest.fixture(scope="module")
def shifted():
    return lb.monopole_beams(FREQUENCY + 4.0, LMAX, ANTENNAS)


def test_the_term_is_da_s_da(beams, shifted):
    pointing = Pointing.of(lb.Observation.from_runs([lb.Run(0.02)]), LMAX)
    flags = np.zeros((16, pointing.n_times), dtype=bool)
    flags[2, 1] = flags[:, 4] = True
    layout = DataLayout.from_flags(flags)
    three = beams, shifted, difference(shifted, beams)
    a, b, direction = (lb.CouplingMatrix.build(one, pointing, layout) for one in three)
    error = np.asarray(b.dense()) - np.asarray(a.dense())
    spectrum = 1e8 / (1.0 + np.arange(LMAX + 1.0)) ** 2
    per_mode = np.repeat(spectrum, 2 * np.arange(LMAX + 1) + 1)
    expected = error * per_mode @ error.T
    got = beam_error_noise(direction, lb.HarmonicPrior(jnp.asarray(spectrum)))
    # the difference of two A of ten times its size, each good to a few eps
    close(got.dense(), expected, 1e-13)
    close(got.diagonal(), np.diag(expected), 1e-13)
    # a prior that correlates modes, about a mean sky
    root = np.sqrt(per_mode)
    s = root[:, None] * random_covariance(np.random.default_rng(1), len(root)) * root
    got = beam_error_noise(direction, DensePrior(np.linalg.cholesky(s), mean=root))
    seen = error @ root
    close(got.dense(), error @ s @ error.T + np.outer(seen, seen), 1e-11)


def test_rms_difference_is_that_over_directions(beams, shifted):
    """Both fields on a grid of the whole sphere that integrates products up to 2 lmax exactly."""
    theta, phi, weight = sphere(LMAX + 2, 2 * LMAX + 2)
    harmonics = real_harmonics(theta, phi, LMAX)
    model, true = (np.asarray(b.modes) @ harmonics.T for b in (beams, shifted))
    expected = np.sqrt(((true - model) ** 2 @ weight).sum() / (model**2 @ weight).sum())
    got = rms_difference(shifted, beams)
    assert got == pytest.approx(expected, rel=1e-12) and 0.02 < got < 0.5
    assert rms_difference(beams, beams) == 0.0
    double = fields.ProductBeams(3.0 * beams.modes, FREQUENCY)
    assert rms_difference(double, beams) == pytest.approx(2.0, rel=1e-14)
    assert rms_difference(beams, double) == pytest.approx(2.0 / 3.0, rel=1e-14)


@pytest.mark.parametrize("shape", [(16, 36), (9, 25)])
def test_beams_that_do_not_match_are_refused(beams, shape):
    other = fields.ProductBeams(jnp.ones(shape), FREQUENCY)
    message = rf"coefficients has shape \({shape[0]}, {shape[1]}\), expected \(16, 25\)"
    for use in (difference, rms_difference):
        refuse(message, use, other, beams)
