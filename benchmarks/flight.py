"""Time and memory of reducing sessions: a lunar cycle of spectra to bands and averages of 2 h.

python benchmarks/flight.py [SPECTRA] [BANDS]

The session has one stretch of noise, repeated: what is read is decompressed as any other. It is
written into a temporary folder, which is removed.
"""

from __future__ import annotations

import sys
import tempfile
import time
from itertools import islice
from pathlib import Path

import numpy as np

from lusee_bayes.core.progress import peak_memory_gb
from lusee_bayes.experiment.data_files import recipe_of
from lusee_bayes.experiment.flight_simulation import simulate_flight
from lusee_bayes.experiment.scenario import load_scenario
from lusee_bayes.flight.reduction import reduce_sessions
from lusee_bayes.flight.session_files import read_session, write_session
from lusee_bayes.runs.data_run import run_simulate_flight

STEP_S, SPECTRA, BANDS = 42.0, 57_000, 46
# spectra that are simulated, and then repeated
STRETCH = 512


def main(spectra: int, bands: int) -> None:
    """Write a session, reduce it, and print what that takes."""
    cycles = (spectra + 0.5) * STEP_S / (27.321661 * 86400.0)
    frequencies = np.linspace(5.0, 50.0, bands).tolist()
    sizes = ["lmax=1", f"observation.step_s={STEP_S}", "frequencies_mhz=[10, 30]"]
    sizes += ["flight={per_kelvin_v2_hz: 1e-21}", "observation.window=mean"]
    sizes += [f"flight.simulated={{session_h: {spectra * STEP_S / 1800.0}}}"]
    scenario = load_scenario("fiducial", [*sizes, f"observation.runs=[{{cycles: {cycles}}}]"])
    with tempfile.TemporaryDirectory() as folder:
        small = scenario.model_copy(
            update={"observation": scenario.observation.model_copy(update={"step_s": 86400.0 / 4})}
        )
        files = run_simulate_flight(small, folder)
        made = simulate_flight(scenario)
        blocks = list(islice(made.blocks(made.sessions[0]), STRETCH // 16))
        rows = made.rows(made.sessions[0])
        stretch = np.concatenate(blocks)
        repeated = (
            stretch[: min(STRETCH, rows.n_rows - start)] for start in range(0, rows.n_rows, STRETCH)
        )
        start = time.perf_counter()
        path = write_session(Path(folder) / "long.h5", rows, repeated)
        size = path.stat().st_size / 1e9
        print(
            f"{rows.n_rows} spectra, {size:.2f} GB: written in {time.perf_counter() - start:.0f} s"
        )
        print(f"peak memory so far {peak_memory_gb():.2f} GB")
        mapped = load_scenario(str(files.scenario), ["observation.average_s=7200"])
        recipe = recipe_of(mapped.model_copy(update={"frequencies_mhz": tuple(frequencies)}))
        start = time.perf_counter()
        reduced = reduce_sessions([read_session(path)], recipe)
        seconds = time.perf_counter() - start
        print(reduced)
        print(
            f"reduced to {bands} bands and {reduced.values.shape[2]} bins in {seconds:.0f} s, "
            f"peak memory {peak_memory_gb():.2f} GB"
        )


if __name__ == "__main__":
    main(*(int(given) for given in (sys.argv[1:] + [SPECTRA, BANDS][len(sys.argv) - 1 :])))
