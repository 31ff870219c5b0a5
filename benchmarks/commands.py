"""Whole commands, cold and warm: seconds, units of LAPACK's work, peak memory.

The unit is dsyrk + dpotrf at the fiducial size (5232 x 2304), timed with SciPy in this run, so that
machines can be compared. Cold: with an empty cache of compiled programs; warm: the same again. The
peak is that of the largest process of the command.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from rich.console import Console
from scipy.linalg.blas import dsyrk
from scipy.linalg.lapack import dpotrf

N_DATA, N_MODES = 5232, 2304
YEAR = ["--set", "observation.step_s=600", "--set", "observation.runs=[{{cycles: 13.3683}}]"]
CHANNELS = ["--frequencies", "5:50:1", "--draws", "20"]
LEARNED = ["--set", "prior.model=local_scales", "--draws", "8"]
MEANS = ["--set", "observation.window=mean"]
POINTING = ["--set", "noise.pointing={{turntable_deg: 0.3, tilt_east_deg: 0.2, clock_s: 60}}"]
COMMANDS = {
    "--help": ["--help"],
    "info posterior.nc": ["info", "{map}/posterior.nc"],
    "info diagnostics.nc": ["info", "{map}/diagnostics.nc"],
    "info map.fits": ["info", "{map}/map.fits"],
    "map fiducial": ["map", "fiducial", "-o", "{map}"],
    "map, means over windows": ["map", "fiducial", *MEANS, "-o", "{means}"],
    "map, clock and pointing": ["map", "fiducial", *MEANS, *POINTING, "-o", "{pointing}"],
    "map, default prior": ["map", "fiducial", *LEARNED, "-o", "{learned}"],
    "46 channels, each by itself": ["map", "fiducial", *CHANNELS, "-o", "{cube}"],
    "46 channels, joint": ["map", "fiducial", *CHANNELS, "--joint", "-o", "{joint}"],
    "46 channels, default prior": [
        "map",
        "fiducial",
        *CHANNELS,
        *LEARNED[:2],
        "-o",
        "{channels}",
    ],
    "a year every ten minutes": ["map", "fiducial", *YEAR, "-o", "{year}"],
}
COLD = ("map fiducial",)
FOLDERS = ("map", "means", "pointing", "learned", "cube", "joint", "channels", "year")


def unit() -> float:
    """Seconds of dsyrk + dpotrf at the fiducial size: the median of five."""
    a = np.asfortranarray(np.random.default_rng(0).standard_normal((N_DATA, N_MODES)))
    seconds = []
    for _ in range(5):
        start = time.perf_counter()
        normal = dsyrk(1.0, a, trans=1, lower=1)
        normal[np.diag_indices(N_MODES)] += 1.0
        dpotrf(normal, lower=1, overwrite_a=1)
        seconds.append(time.perf_counter() - start)
    return float(np.median(seconds))


def run(command: list[str], cache: Path) -> tuple[float, float]:
    """Seconds of a command, and the peak memory of its largest process in GB."""
    program = Path(sys.executable).with_name("lusee-bayes")
    start = time.perf_counter()
    process = subprocess.Popen(
        [program, *command],
        stdout=subprocess.DEVNULL,
        env=os.environ | {"LUSEE_BAYES_CACHE": str(cache)},
    )
    _, status, usage = os.wait4(process.pid, 0)
    seconds = time.perf_counter() - start
    if status:
        raise SystemExit(f"lusee-bayes {' '.join(command)} failed")
    return seconds, usage.ru_maxrss / 1e6


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", action="append", help="names of commands; all by default")
    options = parser.parse_args()
    seconds_of_unit = unit()
    console = Console(width=100)
    console.print(f"unit: {seconds_of_unit:.3f} s (dsyrk + dpotrf, {N_DATA} x {N_MODES})")
    line = "{:28} {:>9} {:>8} {:>9} {:>8} {:>10}"
    console.print(line.format("command", "cold [s]", "[units]", "warm [s]", "[units]", "peak [GB]"))
    with tempfile.TemporaryDirectory() as place:
        folders = {name: f"{place}/{name}" for name in FOLDERS}
        cache = Path(place) / "cache"
        run(["map", "fiducial", "-q", "-o", folders["map"]], cache)
        for name, words in COMMANDS.items():
            if options.only and name not in options.only:
                continue
            command = [word.format(**folders) for word in words]
            cold = ("", "")
            if name in COLD:
                seconds, _ = run(command, Path(place) / "empty")
                cold = (f"{seconds:.1f}", f"{seconds / seconds_of_unit:.1f}")
            seconds, peak = run(command, cache)
            warm = (f"{seconds:.2f}", f"{seconds / seconds_of_unit:.1f}")
            console.print(line.format(name, *cold, *warm, f"{peak:.2f}"))


if __name__ == "__main__":
    main()
