"""Simulation-based calibration of the log-normal posterior, A and the tilt among the unknowns.

Skies are drawn from the prior, data of them from a small instrument, and the rank of the truth
among weighted draws of the posterior is uniform if the posterior is right.
"""

from __future__ import annotations

from dataclasses import replace

import jax
import numpy as np
import pytest
from scipy import stats

from lusee_bayes.core.arrays import on_host
from lusee_bayes.core.harmonics import n_modes, pixel_matrix
from lusee_bayes.experiment.learned_prior import about_sky
from lusee_bayes.experiment.setup import set_up
from lusee_bayes.experiment.simulate import simulate
from lusee_bayes.linear.information import Information
from lusee_bayes.sampling.calibration import N_DRAWS, Ranks
from lusee_bayes.sampling.log_normal.learned import learn_log_normal
from lusee_bayes.sampling.log_normal.prior import LogNormalPrior
from lusee_bayes.sky import BRIGHT_SOURCES
from lusee_bayes.sky.log_normal import LogNormalSky, deviation_spectrum
from lusee_bayes.sky.template import EmbeddedTemplate
from lusee_bayes.testing import small_scenario

LMAX, MHZ = 8, 25.0
A, TILT, WIDTHS = 0.04, -2.5, (0.5, 0.4)
N_SETS, N_WRONG, BINS = 100, 40, 10
PARTS = ("brightest", "faintest", "best known", "mode 0", "mode 6", "mode 40", "mode 80")
NAMES = ("ln A", "tilt", "source", *PARTS)


@pytest.fixture(scope="module")
def instrument() -> Information:
    """A^T N^-1 A of a sixth of a lunar day."""
    setup = set_up(small_scenario(lmax=LMAX, cycles=0.15))
    return on_host(about_sky(setup, simulate(setup)))


def prior() -> LogNormalPrior:
    """A grid that resolves products of this lmax."""
    spectrum = deviation_spectrum(LMAX, A, TILT, np.array([4.0 * np.pi * 0.25]))
    template = EmbeddedTemplate(MHZ)
    sky = LogNormalSky.of(template, spectrum, MHZ, BRIGHT_SOURCES[:1], band=32)
    return LogNormalPrior.of(sky, A, TILT, WIDTHS)


def observed(
    instrument: Information, sky: np.ndarray, rng: np.random.Generator, noise: float
) -> Information:
    """What data of a sky say, their noise being so many times that of N."""
    root = np.linalg.cholesky(instrument.matrix + 1e-16 * np.diag(np.diag(instrument.matrix)))
    vector = noise * (root @ rng.standard_normal(len(sky)))
    return replace(instrument, vector=vector, reference=sky, misfit=instrument.n_data)


def quantities(given: LogNormalPrior, known, parameters, white, skies) -> np.ndarray:
    """Of skies (n, modes), their u (n, unknowns) and parameters (n, 2): (n, quantities).

    ``known`` (modes,): a direction.
    """
    pixels = pixel_matrix(4, LMAX)
    mean = pixels @ given.sky.modes(np.zeros(given.sky.size))
    rows = np.stack([pixels[np.argmax(mean)], pixels[np.argmin(mean)], known])
    modes = np.array([0, 6, 40, 80])
    source = white[:, n_modes(LMAX) :]
    return np.concatenate([parameters, source, skies @ rows.T, skies[:, modes]], axis=1)


def ranked(instrument: Information, number: int, noise: float = 1.0) -> np.ndarray:
    """Ranks of one sky of the prior among draws of the posterior."""
    given, rng = prior(), np.random.default_rng(number)
    theta = np.array([np.log(A), TILT]) + np.array(WIDTHS) * rng.standard_normal(2)
    white = rng.standard_normal(given.sky.size)
    sky = given.sky.with_power_law(float(np.exp(theta[0])), float(theta[1]))
    truth = sky.modes(white)
    found = learn_log_normal(given, observed(instrument, truth, rng, noise), number)
    drawn = found.drawn(jax.random.key(number), N_DRAWS)
    known = np.linalg.eigh(instrument.matrix)[1][:, -1]
    draws = quantities(given, known, drawn.parameters, drawn.white, drawn.skies)
    true = quantities(given, known, theta[None], white[None], truth[None])
    return (draws < true).sum(0)


def ranks_of(instrument: Information, n: int, noise: float = 1.0) -> Ranks:
    rows = [ranked(instrument, number, noise) for number in range(n)]
    return Ranks(np.array(rows), N_DRAWS, NAMES)


def p_values(ranks: Ranks) -> np.ndarray:
    """Of flat histograms, by chi^2; ten bins, so that each holds ten of a hundred."""
    counts = ranks.histogram().reshape(len(NAMES), BINS, -1).sum(2)
    expected = ranks.n_simulations / BINS
    return stats.chi2.sf(((counts - expected) ** 2 / expected).sum(1), BINS - 1)


@pytest.mark.long
def test_ranks_are_uniform(instrument):
    p = p_values(ranks_of(instrument, N_SETS))
    assert p.min() > 1e-3, dict(zip(NAMES, p, strict=True))


@pytest.mark.long
def test_noise_that_is_twice_as_large_as_said_is_found_out(instrument):
    """What the data determine is then too certain; A and the tilt hardly depend on it."""
    p = p_values(ranks_of(instrument, N_WRONG, noise=2.0))
    assert p.min() < 1e-6, dict(zip(NAMES, p, strict=True))
