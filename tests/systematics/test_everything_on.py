"""Gains, ground, arms, clock, turntable and receivers, all unknown, found together with the sky."""

from pathlib import Path

import numpy as np
import pytest

import lusee_bayes as lb
from lusee_bayes.experiment.model import set_up, simulate, true_values
from lusee_bayes.experiment.rounds import Inference
from lusee_bayes.experiment.scenario import Scenario
from lusee_bayes.systematics.context import Setup

SKIES = {
    10.0: ("ulsa/exp10.0MHz_sky_map_with_absorption.hdf5", 10.0),
    25.0: ("surveys/gsm2008_25MHz.fits", 25.0),
}
# half a percent of gains, 5 % of the ground, 0.3 degrees of the arms, 20 s, 0.2 degrees, 10 %
NOISE = {
    "gain": {"sigma": 0.005},
    "beam": {
        "parameters": {
            "surface_permittivity": 0.185,
            "deep_permittivity": 0.3,
            "zenith_angle_deg": 0.3,
        }
    },
    "pointing": {"clock_s": 20.0, "turntable_deg": 0.2},
    "receiver": {"power_k": 2e4, "relative_std": 0.1},
}


def scenario(mhz: float, angles: int, **more) -> Scenario:
    runs = [{"cycles": 1.0, "turntable_deg": 30.0 * k} for k in range(angles)]
    observation = {"runs": runs, "step_s": more.pop("step_s", 7200.0)}
    tree = {"frequency_mhz": mhz, "noise": NOISE, "observation": observation}
    return Scenario.model_validate(tree | more)


def of_another_sky(folder: Path, mhz: float, angles: int, **more) -> tuple[Setup, Inference]:
    """Infer what data of a published map tell, which is not drawn from the prior."""
    file, at = SKIES[mhz]
    if not (folder / file).exists():
        pytest.skip(f"needs {folder / file}")
    sky = {"model": "file", "file": str(folder / file), "file_frequency_mhz": at}
    truth = set_up(scenario(mhz, angles, sky=sky, **more))
    return truth, lb.infer(lb.build(scenario(mhz, angles, **more), data=simulate(truth)))


def whitened_error(truth: Setup, found: Inference) -> float:
    """RMS over all directions of the sky, each in its own standard deviation."""
    posterior = found.posterior
    away = posterior.prior.whiten(truth.sky.modes) - posterior.white_mean
    return float(np.sqrt(np.mean((np.asarray(posterior.lower).T @ away) ** 2)))


def pulls(truth: Setup, found: Inference) -> dict[str, float]:
    """How far every parameter is off, in its standard deviations."""
    values, off = true_values(truth), {}
    for part in found.expanded:
        own, told = part.systematic, found.amplitudes(part)
        true = own.true(values)
        z = (np.array([true[name] for name in own.names]) - own.means) / own.stds
        away = (np.asarray(part.expected) + told.mean - z) / told.std
        off |= dict(zip(own.names, away.tolist(), strict=True))
    return off


def test_all_are_found_together(test_data):
    more = {"lmax": 6, "step_s": 21600.0, "prior": {"model": "isotropic"}, "seed": 1}
    truth, found = of_another_sky(test_data, 10.0, 2, **more)
    away = pulls(truth, found)
    assert len(away) == 3 + 3 + 4
    assert not found.unsettled and found.rounds < 12
    assert 0.75 < whitened_error(truth, found) < 1.25
    assert max(map(abs, away.values())) < 3.5


@pytest.mark.long
@pytest.mark.parametrize("angles", [1, 2])
@pytest.mark.parametrize("mhz", [10.0, 25.0])
def test_all_are_found_together_at_full_resolution(test_data, mhz, angles):
    truth, found = of_another_sky(test_data, mhz, angles, lmax=16, seed=1)
    away = pulls(truth, found)
    print(mhz, angles, whitened_error(truth, found), found.rounds, away)
    assert not found.unsettled and found.rounds < 12
    assert 0.8 < whitened_error(truth, found) < 1.25
    assert max(map(abs, away.values())) < 3.5
