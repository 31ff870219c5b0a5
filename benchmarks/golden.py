"""Golden runs: every array of every file that eight small commands write, against those of before.

Changes that should move no number are checked with it; it is no test of what the numbers ought to
be. With one thread of BLAS on one machine all must be equal to the last bit.

    python benchmarks/golden.py make FOLDER [RUN...]   run the commands (all) as the package stands
    python benchmarks/golden.py compare OLD NEW        exit code 1 if any array differs
"""

from __future__ import annotations

import csv
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import h5py
import numpy as np
from astropy.io import fits

SHARED = Path(__file__).resolve().parents[2] / "shared" / "data"
SMALL = ("lmax=8", "observation.runs.0.cycles=0.05")
LEARNED = "prior={model: local_scales}"
CHANNELS = ("--frequencies", "10,17,25", "--workers", "1")
JOINT = "prior={model: isotropic, spectrum: sky}"
RUNS = {
    "given": ("map", "fiducial", *SMALL),
    "learned": ("map", "fiducial", "--diagnose", *SMALL, LEARNED),
    "gains": ("map", "gain_1e-2", *SMALL, LEARNED, "noise.gain.treatment=marginalised"),
    "channels": ("map", "fiducial", *CHANNELS, *SMALL, LEARNED),
    "joint": ("map", "fiducial", "--joint", "--draws", "5", *CHANNELS, *SMALL, JOINT,
              "spectral.components=[power_law, curvature]"),
    "hmc": ("sample", "fiducial", "--draws", "50", "--warmup", "50", "--chains", "2", "lmax=4",
            "observation.runs.0.cycles=0.05"),
    "plan": ("plan", "fiducial", "gain_1e-2", "--workers", "1", "--vary", "frequency_mhz=10,25",
             *SMALL),
    "paper": ("map", "beam_4MHz", "--covariance", "--information", "--draws", "5", *SMALL),
    "sessions": (
        "map", "fiducial",
        "--data", *(str(SHARED / "flight" / f"session_{name}.h5") for name in "abcd"),
        "frequency_mhz=10.0", "lmax=12", "observation={timestamp: instant}",
        f"beam={{model: response, file: {SHARED / 'luseepy' / 'synthetic_response_v3.fits'}, "
        "receiver: jfet, moon_temperature_k: 250.0}",
        f"sky={{model: file, file: {SHARED / 'luseepy' / 'sky_alm.npz'}}}", JOINT,
        "noise={radiometer: {form: exact, temperature: measured}, "
        "receiver: {power_v2_hz: 4.0e-20, relative_std: 0.1}}",
        f"flight={{gain_table: {SHARED / 'flight' / 'gain'}, bin_origin: centre}}",
    ),
}  # fmt: skip
# what tells of the run and not of the sky
LEFT_OUT = ("seconds", "versions", "commit", "command", ":made", "peak_memory", "per_second")


def command(words: tuple[str, ...], folder: Path) -> list[str]:
    settings = [part for word in words if _is_setting(word) for part in ("--set", word)]
    plain = [word for word in words if not _is_setting(word)]
    program = [sys.executable, "-m", "lusee_bayes.cli", plain[0]]
    return [*program, *plain[1:], *settings, "--quiet", "--force", "-o", str(folder)]


def _is_setting(word: str) -> bool:
    return "=" in word and not word.startswith("frequency_mhz=10,")


def make(root: Path, names: list[str]) -> None:
    environment = os.environ | {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    for name in names or RUNS:
        print(name, flush=True)
        subprocess.run(command(RUNS[name], root / name), check=True, env=environment)


def arrays(root: Path) -> Iterator[tuple[str, np.ndarray]]:
    """Every array and number of a folder's files, by file and place."""
    for path in sorted(root.rglob("*")):
        place = str(path.relative_to(root))
        if path.suffix == ".nc":
            with h5py.File(path) as file:
                found: list[tuple[str, np.ndarray]] = []
                file.visititems(
                    lambda key, item, found=found: (
                        found.append((key, item[()])) if isinstance(item, h5py.Dataset) else None
                    )
                )
            yield from ((f"{place}:{key}", np.asarray(value)) for key, value in found)
        elif path.suffix == ".fits":
            with fits.open(path) as hdus:
                for k, hdu in enumerate(hdus):
                    if hdu.data is None:
                        continue
                    for column in getattr(hdu.data, "names", None) or [None]:
                        data = hdu.data if column is None else hdu.data[column]
                        yield f"{place}:{k}:{column}", np.asarray(data)
        elif path.suffix == ".npz":
            with np.load(path) as file:
                yield from ((f"{place}:{key}", file[key]) for key in file.files)
        elif path.suffix == ".json":
            yield from _leaves(place, json.loads(path.read_text(encoding="utf-8")))
        elif path.suffix == ".csv":
            with path.open(encoding="utf-8", newline="") as file:
                for k, row in enumerate(csv.reader(file)):
                    yield f"{place}:{k}", np.array(row)


def _leaves(place: str, value: object) -> Iterator[tuple[str, np.ndarray]]:
    if isinstance(value, dict):
        for key, item in value.items():
            yield from _leaves(f"{place}:{key}", item)
    elif isinstance(value, list):
        for k, item in enumerate(value):
            yield from _leaves(f"{place}:{k}", item)
    else:
        yield place, np.array(str(value) if isinstance(value, str) or value is None else value)


def compare(old: Path, new: Path) -> bool:
    equal = True
    for name in RUNS:
        before, after = (dict(arrays(root / name)) for root in (old, new))
        for place in sorted(before.keys() | after.keys()):
            if any(word in place for word in LEFT_OUT):
                continue
            difference = _difference(before.get(place), after.get(place))
            if difference:
                print(f"{name} {place}: {difference}")
                equal = False
        print(f"{name}: {len(before)} arrays before, {len(after)} after", flush=True)
    return equal


def _difference(before: np.ndarray | None, after: np.ndarray | None) -> str:
    if before is None or after is None:
        return "only " + ("after" if before is None else "before")
    if before.shape != after.shape:
        return f"shape {before.shape}, {after.shape}"
    if before.dtype.kind not in "fciub" or after.dtype.kind not in "fciub":
        return "" if np.array_equal(before, after) else f"{before!s:.60} became {after!s:.60}"
    if np.array_equal(before, after, equal_nan=before.dtype.kind in "fc"):
        return ""
    return f"differs by up to {np.nanmax(np.abs(np.asarray(after) - before)):.3g}"


if __name__ == "__main__":
    if sys.argv[1] == "make":
        make(Path(sys.argv[2]), sys.argv[3:])
    elif not compare(Path(sys.argv[2]), Path(sys.argv[3])):
        sys.exit(1)
