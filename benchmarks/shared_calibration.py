"""Are maps and instrument right where three channels share an unknown instrument?

Skies (lmax 6) and instruments are drawn from their priors; each data set is half a cycle at each of
two turntable angles, with gains, ground, arms, clock, turntable and receivers unknown. For every
set: chi^2 per mode of each channel's sky, and per unknown of each channel's instrument, all about 1
if their errors are right. 30 s a set; sets FIRST, FIRST + STEP, ... below N.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path

import healpy
import numpy as np

import lusee_bayes as lb
from lusee_bayes.core.harmonics import modes_to_map
from lusee_bayes.experiment.model import set_up, simulate, true_values
from lusee_bayes.experiment.scenario import Scenario

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
    "receiver": {"power_k": 2e4, "relative_std": 0.1, "smooth_octaves": 1.0},
}


def scenario(seed: int, mean_file: Path) -> Scenario:
    """Three channels whose skies are known to a fifth, and an instrument of this seed."""
    prior = {"model": "isotropic", "spectrum": "sky", "scale": 0.04, "mean_file": str(mean_file)}
    runs = [{"cycles": 0.5}, {"cycles": 0.5, "turntable_deg": 30.0}]
    return Scenario.model_validate(
        {
            "frequencies_mhz": [10.0, 18.0, 25.0],
            "lmax": 6,
            "seed": seed,
            "instrument_seed": seed,
            "prior": prior | {"file_frequency_mhz": 25.0, "spectral_index": -2.5},
            "observation": {"runs": runs, "step_s": 43200.0},
            "output": {"covariance": True, "draws": 0},
            "noise": NOISE,
        }
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--step", type=int, default=1)
    parser.add_argument("--n", type=int, default=100)
    given, of_sky, of_instrument = parser.parse_args(), [], []
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        sky = set_up(Scenario.model_validate({"frequency_mhz": 25.0, "lmax": 6})).sky.modes
        file, units = folder / "mean.fits", {"coord": "G", "column_units": "K"}
        healpy.write_map(file, modes_to_map(np.asarray(sky), 16), dtype=np.float64, **units)
        for seed in range(given.first, given.n, given.step):
            cube, data, true = scenario(seed, file), [], []
            for number, channel in enumerate(cube.channels()):
                setup = set_up(channel)
                white = np.random.default_rng(1000 * seed + number)
                drawn = setup.prior.colour(white.standard_normal(setup.prior.size))
                modes = np.asarray(drawn) + np.asarray(setup.prior.mean)
                true.append(true_values(setup))
                data.append(simulate(setup.under(replace(setup.sky, modes=modes))))
            found = lb.run_map(cube, folder / "map", data=data, replace=True).result
            of_sky.append([])
            of_instrument.append([])
            for one, seen, known in zip(found.channels, data, true, strict=True):
                off = one.mean - np.asarray(seen.truth)
                of_sky[-1].append(off @ np.linalg.solve(one.covariance, off) / len(off))
                rows = one.theta.corner
                pulls = ((rows["value"] - rows["unknown"].map(known)) / rows["std"]).to_numpy()
                away = np.linalg.solve(one.theta.correlation, pulls)
                of_instrument[-1].append(pulls @ away / len(pulls))
            print(seed, np.round(of_sky[-1], 2), np.round(of_instrument[-1], 2), flush=True)
    for name, values in (("sky", of_sky), ("instrument", of_instrument)):
        print(f"{name}: mean {np.mean(values, 0).round(3)}, scatter {np.std(values, 0).round(3)}")


if __name__ == "__main__":
    main()
