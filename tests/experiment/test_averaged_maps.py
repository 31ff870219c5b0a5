"""Maps of averages against maps of the fine samples that they are made of.

The fine samples are so short that an instant in their middle stands for them: what A knows of
windows does not enter their map. Averages are a part of what the fine samples say. So, over draws
of sky and noise, the mean of their map differs from that of the fine samples with the covariance
C_avg - C_fine, and ``log2 det(C_avg C_fine^-1) / 2`` bits are lost.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy import stats
from scipy.linalg import eigh

from lusee_bayes.experiment.model import full_model, simulate
from lusee_bayes.experiment.scenario import load_scenario
from lusee_bayes.experiment.setup import set_up
from lusee_bayes.instrument.averaging import averaged
from lusee_bayes.instrument.visibilities import Visibilities
from lusee_bayes.linear.model import LinearGaussian
from lusee_bayes.runs.forecasting import expected_posterior

DRAWS = 12
HOUR = 3600.0


@dataclass(frozen=True)
class Map:
    """A model, the covariance of its posterior, and what the planner says of its information."""

    model: LinearGaussian
    covariance: np.ndarray
    bits: float

    def mean(self, data):
        """C A^T N^-1 d, refined: no mean of the prior, no correlations in N."""
        model, found = self.model, np.zeros(len(self.covariance))
        for _ in range(3):
            left = (data - np.asarray(model.coupling @ found)) / np.asarray(model.noise.diagonal())
            gradient = np.asarray(model.coupling.transpose_mv(left))
            found = found + self.covariance @ (gradient - found / model.prior.variance())
        return found

    def chi2(self, data):
        """Of data under the model, any sky of the prior being possible."""
        mean = self.mean(data)
        return float(self.model.chi2(mean, data) + (mean**2 / self.model.prior.variance()).sum())

    def squared(self, shift):
        """Square of a shift of the map in standard deviations, correlations counted."""
        return float(shift @ np.linalg.solve(self.covariance, shift))


@dataclass(frozen=True)
class Maps:
    """Maps of fine samples (as instants), of averages, and of of averages taken for instants."""

    samples: Visibilities
    to_s: float
    sky: np.ndarray
    fine: Map
    windows: Map
    instants: Map

    def average(self, values):
        return self.averaged(values).data

    def averaged(self, values):
        return averaged(replace(self.samples, data=np.asarray(values)), self.to_s)


def map_of(scenario, data, observation):
    setup = set_up(scenario, replace(data, observation=observation))
    model = full_model(setup)
    covariance = np.asarray(model.condition(np.zeros(model.n_data)).covariance())
    bits = float(expected_posterior(setup).information_bits())
    return Map(model, covariance, bits)


def maps_of(lmax, step_s, cycles, to_s):
    overrides = [
        f"lmax={lmax}",
        f"observation.step_s={step_s}",
        "observation.window=mean",
        f"observation.runs=[{{cycles: {cycles}}}]",
    ]
    scenario = load_scenario("fiducial", overrides)
    setup = set_up(scenario)
    samples = simulate(setup)
    coarse = averaged(samples, to_s)
    mean = coarse.observation
    return Maps(
        samples,
        to_s,
        np.asarray(setup.sky.modes),
        map_of(scenario, samples, replace(samples.observation, windows=None)),
        map_of(scenario, coarse, mean),
        map_of(scenario, coarse, replace(mean, windows=None)),
    )


@pytest.fixture(scope="module", params=[2, 12], ids=lambda hours: f"60 s to {hours} h")
def maps(request):
    return maps_of(8, 60.0, 0.1, request.param * HOUR)


@pytest.fixture(scope="module")
def draws(maps):
    """Skies of the prior, their fine samples with noise, and the averages of these."""
    rng = np.random.default_rng(3)
    model, found = maps.fine.model, []
    std = np.sqrt(np.asarray(model.noise.diagonal()))
    for _ in range(DRAWS):
        sky = np.asarray(model.prior.colour(rng.standard_normal(model.prior.size)))
        fine = np.asarray(model.coupling @ sky) + std * rng.standard_normal(len(std))
        found.append((sky, fine, maps.average(fine)))
    return found


def test_averages_of_the_fine_samples_are_what_a_with_windows_says(maps):
    sigma = np.sqrt(np.asarray(maps.windows.model.noise.diagonal()))
    expected = maps.average(maps.fine.model.coupling @ maps.sky)
    off = (np.asarray(maps.windows.model.coupling @ maps.sky) - expected) / sigma
    # instants for the fine samples: (lmax w step / 2)^2 / 6 of the part of V that varies, below
    # 1e5 sigma of an average
    assert np.abs(off).max() < 1e-2
    instants = (np.asarray(maps.instants.model.coupling @ maps.sky) - expected) / sigma
    assert np.abs(instants).max() > (0.5 if maps.to_s < 4 * HOUR else 10.0)


def test_as_much_is_lost_as_the_planner_says(maps):
    ratios = eigh(maps.windows.covariance, maps.fine.covariance, eigvals_only=True)
    # N of averages has the squares of mean autos, which are smaller than the mean squares
    noise = maps.averaged(maps.fine.model.noise.diagonal())
    samples = noise.observation.live_s[noise.layout.time] / maps.samples.observation.step_s
    too_small = 1.0 - np.asarray(maps.windows.model.noise.diagonal()) / (noise.data / samples)
    assert 0.0 < too_small.max() < 2e-3
    # and of the finest structure A leaves out up to 1e-5 of what little it adds
    assert ratios.min() > 1.0 - too_small.max() - 2e-5
    lost = 0.5 * np.log2(ratios).sum()
    assert maps.fine.bits - maps.windows.bits == pytest.approx(lost, abs=1e-3)
    assert 0.1 < lost < 0.02 * maps.fine.bits


def test_means_differ_by_what_is_lost(maps, draws):
    """|mean_avg - mean_fine|^2 in units of C_fine is a sum of squares of variances ratio - 1."""
    ratios = eigh(maps.windows.covariance, maps.fine.covariance, eigvals_only=True)
    excess = ratios - 1.0
    shifts = [
        maps.fine.squared(maps.windows.mean(coarse) - maps.fine.mean(fine))
        for _, fine, coarse in draws
    ]
    scatter = np.sqrt(2.0 * (excess**2).sum() / DRAWS)
    assert np.mean(shifts) == pytest.approx(excess.sum(), abs=4.0 * scatter)


def test_maps_of_averages_are_right_and_of_instants_wrong(maps, draws):
    n_modes, n_data = len(maps.sky), maps.windows.model.n_data
    low, high = stats.chi2(DRAWS * n_modes).interval(1 - 1e-4)
    right, wrong = (
        sum(one.squared(one.mean(coarse) - sky) for sky, _, coarse in draws)
        for one in (maps.windows, maps.instants)
    )
    assert low < right < high < wrong
    low, high = stats.chi2(DRAWS * n_data).interval(1 - 1e-4)
    assert low < sum(maps.windows.chi2(coarse) for *_, coarse in draws) < high


def test_how_wrong_instants_are_and_what_chi2_shows_of_it(maps):
    """A mean smooths the sky along the Moon's turn, which another sky explains as well."""
    signal = maps.average(maps.fine.model.coupling @ maps.sky)
    unexplained = signal - np.asarray(maps.instants.model.coupling @ maps.sky)
    off = np.sqrt(maps.instants.squared(maps.instants.mean(unexplained)))
    shown = maps.instants.chi2(unexplained) / np.sqrt(2.0 * len(unexplained))
    if maps.to_s < 4 * HOUR:
        assert off > 3.0
        assert shown < 0.1
    else:
        assert off > 100.0
