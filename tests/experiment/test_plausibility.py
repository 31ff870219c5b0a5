"""Measured data that no sky and no correlator gives."""

from dataclasses import replace

import numpy as np
import pytest

from lusee_bayes.core.errors import InputError
from lusee_bayes.experiment.experiment import build
from lusee_bayes.experiment.scenario import load_scenario
from lusee_bayes.instrument.products import to_matrix
from lusee_bayes.judge.plausibility import SIGNIFICANT, about_information, require_plausible
from lusee_bayes.noise.radiometer import radiometer_noise


@pytest.fixture(scope="module")
def experiment():
    return build(load_scenario("fiducial", ["lmax=6", "observation.runs.0.cycles=0.2"]))


@pytest.fixture(scope="module")
def check(experiment):
    setup = experiment.setup
    noise = radiometer_noise(setup.signal, setup.layout, step_s=7200.0)
    std = np.sqrt(np.asarray(noise.diagonal()))

    def check(change):
        grid = np.array(experiment.data.grid())
        change(grid)
        data = replace(experiment.data, data=setup.layout.gather(grid))
        return require_plausible(data, setup.signal, std)

    return check


def of(experiment, label):
    return experiment.data.labels.index(label)


def test_simulated_data_are_plausible(check):
    assert check(lambda grid: None) == ()


def test_the_modelled_sky_obeys_the_bound(experiment):
    """Cauchy and Schwarz hold for every pair, since V is positive semi-definite at every time."""
    matrix = np.asarray(to_matrix(experiment.setup.signal))
    eigenvalues = np.linalg.eigvalsh(np.moveaxis(matrix, -1, 0))
    assert eigenvalues.min() > 0


@pytest.mark.parametrize(
    ("label", "value", "message"),
    [
        ("11R", -1e5, "product 11R at 2027-01-15T10:00:00 is -1e.05 K .1 samples in all.*negative"),
        ("01I", 1e30, "product 01I .* is 1e.30 K .*more than 1000 times"),
        ("22R", -1e30, "product 22R .* is -1e.30 K .*more than 1000 times"),
    ],
)
def test_single_values_that_cannot_be(check, experiment, label, value, message):
    def change(grid):
        grid[of(experiment, label), 5] = value

    with pytest.raises(InputError, match=message):
        check(change)


def test_an_auto_within_noise_of_zero_is_no_fault(check, experiment):
    """Half of what is refused: six standard deviations below zero."""
    setup = experiment.setup
    noise = radiometer_noise(setup.signal, setup.layout, step_s=7200.0)
    std = np.asarray(setup.layout.scatter(np.sqrt(np.asarray(noise.diagonal()))))
    row = of(experiment, "11R")

    def change(grid, factor):
        grid[row, 5] = factor * SIGNIFICANT * std[row, 5]

    check(lambda grid: change(grid, -0.5))
    with pytest.raises(InputError, match="negative beyond its noise"):
        check(lambda grid: change(grid, -1.5))


def test_another_unit_is_refused_and_another_scale_doubted(check):
    def scaled(factor):
        def change(grid):
            grid *= factor

        return change

    with pytest.raises(InputError, match=r"1e-06 times those of the modelled sky"):
        check(scaled(1e-6))
    doubts = check(scaled(5.0))
    assert "5 times those of the modelled sky" in doubts[0]


def test_a_wrong_product_is_doubted_by_name(check, experiment):
    def change(grid):
        grid[of(experiment, "13R")] *= 10.0

    (doubt,) = check(change)
    assert "|V_13|" in doubt and "11, 33 and 13" in doubt


def test_a_map_without_information_says_so():
    assert about_information(3.0) == about_information(np.nan) == ()
    assert "the map is the prior's" in about_information(1e-9)[0]
