"""How time and memory grow: samples, lmax, channels, workers; each case in a process of its own.

    python benchmarks/scaling.py samples lmax        the structured normal matrix
    python benchmarks/scaling.py channels workers    whole runs of lusee-bayes map (minutes)
    python benchmarks/scaling.py tasks               bytes and seconds of the parts of a joint run

The operation count beside a time is that of the products the structure leaves: for A^T N^-1 A
16 (16 P) N_modes^2 / 2 (P powers of the tilt; P and Q of normal_matrix.py, both triangles left out)
plus 2 x 16 P' (4 lmax + 2) a sample (P' powers up to twice the order).
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from pathlib import Path

import jax
import numpy as np
from rich.console import Console
from rich.table import Table
from scipy.linalg.blas import dsyrk

import lusee_bayes as lb
from lusee_bayes.core.harmonics import tilt_powers
from lusee_bayes.experiment.model import full_model, set_up
from lusee_bayes.instrument.pointing import Pointing
from lusee_bayes.linear.joint import ComponentSums, summed_information
from lusee_bayes.linear.normal_matrix import normal_matrix
from lusee_bayes.noise.radiometer import radiometer_noise
from lusee_bayes.results.channel_map import conditioned
from lusee_bayes.systematics.context import Around

SAMPLES = [(1.0, 7200.0), (1.0, 600.0), (3.0, 7200.0), (12.0, 600.0), (13.368, 600.0)]
LMAX = [16, 24, 32, 47, 64, 95]
CHANNELS = [1, 4, 12, 46]
WORKERS = [1, 2, 4]
REPEATS = 5


def peak_gb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9


def steady(work) -> float:
    """Median seconds of some calls after a first one."""
    seconds = []
    for _ in range(REPEATS + 1):
        start = time.perf_counter()
        jax.block_until_ready(work())
        seconds.append(time.perf_counter() - start)
    return float(np.median(seconds[1:]))


def normal(cycles: float, step_s: float, lmax: int, order: int | None, dense: bool) -> dict:
    """The structured normal matrix of one observation, and dsyrk of the whitened A if asked for."""
    setup = set_up(lb.load_scenario("fiducial", [f"lmax={lmax}"]))
    runs = [lb.Run(cycles)]
    observation = lb.Observation.from_runs(runs, step_s=step_s)

    def coupling_of(order: int | None):
        pointing = Pointing.of(observation, lmax, order)
        return lb.CouplingMatrix.build(setup.beams, pointing)

    coupling, sky = coupling_of(order), setup.sky.modes
    exact = coupling_of(4)
    signal = exact.layout.scatter(exact @ sky)
    noise = radiometer_noise(signal, exact.layout, step_s=step_s)
    off = np.asarray(coupling @ sky - exact @ sky) / np.sqrt(np.asarray(noise.variance))
    powers = len(tilt_powers(coupling.pointing.order))
    twice = len(tilt_powers(2 * coupling.pointing.order))
    modes, times = (lmax + 1) ** 2, observation.n_times
    found = {
        "cycles": cycles,
        "step [s]": step_s,
        "lmax": lmax,
        "times": times,
        "order": coupling.pointing.order,
        "rms error [sigma]": float(np.sqrt((off**2).mean())),
        "seconds": steady(lambda: normal_matrix(coupling, noise)),
        "Gflop": (8 * 16 * powers * modes**2 + 2 * 16 * twice * (4 * lmax + 2) * times) / 1e9,
        "peak [GB]": peak_gb(),
    }
    if dense:
        white = np.asfortranarray(np.asarray(coupling.dense()))
        start = time.perf_counter()
        for _ in range(REPEATS):
            dsyrk(1.0, white, trans=1, lower=1)
        found["over dsyrk"] = found["seconds"] / ((time.perf_counter() - start) / REPEATS)
    return found


def posterior_of_a_year() -> dict:
    """From the data of a year every ten minutes to posterior mean and standard deviations."""
    runs = "observation.runs=[{cycles: 13.368}]"
    scenario = lb.load_scenario("fiducial", [runs, "observation.step_s=600"])
    experiment = lb.build(scenario)
    data = experiment.data
    start = time.perf_counter()
    posterior = full_model(experiment.setup, Around(data)).condition(data.data).posterior
    posterior.std()
    return {
        "visibilities": int(data.layout.size),
        "seconds": time.perf_counter() - start,
        "bits": float(posterior.information_bits()),
        "peak [GB]": peak_gb(),
    }


def run_of_channels(n: int, joint: bool, workers: int) -> dict:
    """lusee-bayes map of n channels from 5 MHz on."""
    step = 45.0 / max(n - 1, 1)
    frequencies = ",".join(f"{5 + k * step:g}" for k in range(n))
    command = [sys.executable, "-m", "lusee_bayes.cli", "map", "fiducial", "-q", "--draws=20"]
    command += [f"--frequencies={frequencies}"] + ["--joint"] * joint
    command += [f"--workers={workers}"] if n > 1 else []
    peak = 0.0
    with tempfile.TemporaryDirectory() as folder:
        start = time.perf_counter()
        with subprocess.Popen([*command, "-o", folder]) as run:
            while run.poll() is None:
                peak = max(peak, memory_gb(run.pid))
                time.sleep(0.1)
        seconds = time.perf_counter() - start
    assert run.returncode == 0
    return {
        "channels": n,
        "kind": "joint" if joint else "independent",
        "workers": workers,
        "seconds": seconds,
        "peak of all processes [GB]": peak,
    }


def memory_gb(pid: int) -> float:
    """Resident memory of a process and of all that it has started; shared pages count once."""
    total = 0
    with suppress(OSError):
        lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()
        total = 1024 * next(int(line.split()[1]) for line in lines if line.startswith("Pss:"))
        for tasks in Path(f"/proc/{pid}/task").glob("*/children"):
            total += 1e9 * sum(memory_gb(int(child)) for child in tasks.read_text().split())
    return total / 1e9


def tasks_of_joint_run(lmax: int) -> dict:
    """Bytes and seconds of what a joint run does for a channel, and of what it moves for a sum."""
    scenario = lb.load_scenario("fiducial", [f"lmax={lmax}", "frequencies_mhz=[10,20,30,40]"])
    scenario = scenario.model_copy(update={"joint": True})
    channel = scenario.channels()[1]
    start = time.perf_counter()
    known = conditioned(lb.build(channel)).information
    inform_s = time.perf_counter() - start
    frequencies = np.array(scenario.frequencies_mhz)
    reference = np.stack([np.asarray(known.reference)] * 4)
    prior = scenario.spectral.prior(frequencies, reference)
    sums = ComponentSums.empty(prior, reference)
    start = time.perf_counter()
    sums = jax.block_until_ready(summed_information(sums, prior, 1, known))
    sum_s = time.perf_counter() - start
    start = time.perf_counter()
    sums.plus(sums)
    merge_s = time.perf_counter() - start

    def megabytes(tree: object) -> float:
        return sum(leaf.nbytes for leaf in jax.tree.leaves(tree)) / 1e6

    return {
        "lmax": lmax,
        "information [s]": inform_s,
        "its file [MB]": megabytes(known),
        "adding to a sum [s]": sum_s,
        "a sum [MB]": megabytes(sums),
        "merging two [s]": merge_s,
    }


def cases(topic: str) -> list[list]:
    """Name of a function above and its arguments, for every row of a table."""
    if topic == "samples":
        rows = [["normal", *case, 47, order, False] for case in SAMPLES for order in (1, 2)]
        rows[0][-1] = rows[1][-1] = True
        return [*rows, ["posterior_of_a_year"]]
    if topic == "lmax":
        return [["normal", 1.0, 7200.0, lmax, 2, True] for lmax in LMAX]
    if topic == "channels":
        return [
            ["run_of_channels", n, joint, 1]
            for joint in (False, True)
            for n in CHANNELS
            if n > 1 or not joint
        ]
    if topic == "tasks":
        return [["tasks_of_joint_run", lmax] for lmax in (31, 47)]
    return [["run_of_channels", 46, joint, w] for joint in (False, True) for w in WORKERS]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("topics", nargs="*", default=["samples", "lmax"])
    parser.add_argument("--case", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.case:
        name, *arguments = json.loads(options.case)
        print(json.dumps(globals()[name](*arguments)))
        return
    for topic in options.topics:
        tables: dict[tuple[str, ...], Table] = {}
        for case in cases(topic):
            answer = subprocess.run(
                [sys.executable, __file__, "--case", json.dumps(case)],
                check=True,
                capture_output=True,
                text=True,
            ).stdout
            row = json.loads(answer.splitlines()[-1])
            heads = tuple(row)
            if heads not in tables:
                tables[heads] = Table(*heads, title=topic)
            cells = [f"{v:.3g}" if isinstance(v, float) else str(v) for v in row.values()]
            tables[heads].add_row(*cells)
        for table in tables.values():
            Console(width=130).print(table)


if __name__ == "__main__":
    main()
