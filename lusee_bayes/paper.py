"""The paper in one command: cases computed once and kept, then figures and judged claims."""

from __future__ import annotations

import csv
import json
import re
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

import h5py
import numpy as np
import xarray as xr
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from lusee_bayes import paper_plots
from lusee_bayes.beams import HemisphereGrid, stokes_beam
from lusee_bayes.building import build_monopoles
from lusee_bayes.checks import InputError
from lusee_bayes.claims import CLAIMS, FREQUENCIES, Cases, cross, frequency_case
from lusee_bayes.experiment import Experiment
from lusee_bayes.harmonics import modes_to_map, power_spectrum
from lusee_bayes.metrics import (
    correlation,
    expected_chi2,
    highest_altitude,
    signal_to_noise,
    whitened_residuals,
)
from lusee_bayes.scenario import Scenario, load_scenario
from lusee_bayes.staging import staged
from lusee_bayes.version import __version__, versions

FORMAT = "lusee_bayes paper case 1"

# by name: a scenario of the package and what differs from it; those after the frequencies are not
# among the paper's figures, but its text speaks of them or they tell why a claim does not hold
CASES = {
    "fiducial": ("fiducial", []),
    "noise_x10": ("noise_x10", []),
    "noise_x100": ("noise_x100", []),
    "duty_cycle_50": ("duty_cycle_50", []),
    "gain_1e-2": ("gain_1e-2", []),
    "gain_1e-3": ("gain_1e-3", []),
    "gain_ignored": ("gain_ignored", []),
    "beam_4MHz": ("beam_4MHz", []),
    "beam_0.4MHz": ("beam_0.4MHz", []),
    "beam_ignored": ("beam_ignored", []),
    "two_cycles": ("two_cycles", []),
    "three_cycles": ("three_cycles", []),
    "quarter_cycle": ("quarter_cycle", []),
    **{
        frequency_case(f): ("fiducial", [f"frequency_mhz={f}"])
        for f in FREQUENCIES
        if frequency_case(f) != "fiducial"
    },
    "gain_1e-1": ("gain_1e-2", ["noise.gain.sigma=0.1"]),
    "half_cycle": ("fiducial", ["observation.runs.0.cycles=0.5"]),
    "prior_x10": ("fiducial", ["prior.scale=10"]),
    "three_cycles_at_rest": (
        "three_cycles",
        [f"observation.runs.{k}.turntable_deg=0" for k in (1, 2)],
    ),
    # the quarters that follow the scenario's, which starts on 15 January
    "quarter_2nd": ("quarter_cycle", ["observation.start=2027-01-22"]),
    "quarter_3rd": ("quarter_cycle", ["observation.start=2027-01-29"]),
    "quarter_4th": ("quarter_cycle", ["observation.start=2027-02-05"]),
}

# nodes in zenith angle and azimuth of the beams that a case file keeps for the figure
BEAM_NODES = (48, 96)


def run_paper(
    folder: str | Path,
    overrides: Sequence[str] = (),
    skies: Sequence[str | Path] = (),
    console: Console | None = None,
) -> list[Path]:
    """Compute what is missing of the paper's cases, then draw the figures and judge the claims.

    ``overrides`` (key.path=value) apply to every case; ``skies``: see :func:`with_sky`. Returns the
    files written into ``folder``: cases/*.nc, figures/*.png, cases.csv, claims.csv, claims.md.
    """
    folder, console = Path(folder), console or Console(quiet=True)
    cases = run_cases(folder, paper_scenarios(overrides, skies), console)
    with staged(folder) as stage:
        (stage / "figures").mkdir()
        for name, draw in paper_plots.FIGURES.items():
            with console.status(f"figure {name} ..."):
                draw(cases).savefig(stage / "figures" / f"{name}.png", dpi=110)
        write_csv(stage / "cases.csv", case_table(cases))
        claims = claim_table(cases)
        write_csv(stage / "claims.csv", claims)
        (stage / "claims.md").write_text(as_markdown(claims))
        written = sorted(p.relative_to(stage) for p in stage.rglob("*.*"))
    return [folder / "cases" / f"{name}.nc" for name in cases] + [folder / p for p in written]


def paper_scenarios(
    overrides: Sequence[str] = (), skies: Sequence[str | Path] = ()
) -> dict[str, Scenario]:
    """The resolved scenario of every case."""
    files = {sky_frequency_mhz(path): Path(path).resolve() for path in skies}
    scenarios = {
        name: load_scenario(base, [*changes, *overrides]) for name, (base, changes) in CASES.items()
    }
    return {name: with_sky(s, files) for name, s in scenarios.items()} if files else scenarios


def sky_frequency_mhz(path: str | Path) -> float:
    """Frequency in a file name like ULSA's: exp10.0MHz_sky_map_with_absorption.hdf5.

    InputError if the file is missing or its name does not tell.
    """
    if not Path(path).is_file():
        raise InputError(f"no sky map at '{path}'")
    found = re.search(r"exp(\d+(?:\.\d+)?)MHz", Path(path).name)
    if found is None or float(found[1]) == 0.0:
        raise InputError(
            f"'{Path(path).name}' does not tell its frequency; name the file exp<F>MHz..., for "
            "example exp10.0MHz_sky_map.hdf5"
        )
    return float(found[1])


def with_sky(scenario: Scenario, files: Mapping[float, Path]) -> Scenario:
    """The scenario with the file (by MHz) nearest in log frequency, scaled to its frequency."""
    nearest = min(files, key=lambda f: abs(np.log(f / scenario.frequency_mhz)))
    sky = scenario.sky.model_copy(
        update={"file": str(files[nearest]), "file_frequency_mhz": nearest}
    )
    return scenario.model_copy(update={"sky": sky})


def run_cases(folder: Path, scenarios: Mapping[str, Scenario], console: Console) -> Cases:
    """Every case, read from ``folder``/cases where the same scenario was computed before.

    Each is written, whole, when it is done: an interrupted run goes on where it stopped.
    """
    columns = (
        TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(),
    )  # fmt: skip
    cases = {}
    with Progress(*columns, console=console, transient=True) as progress:
        task = progress.add_task("cases", total=len(scenarios))
        for number, (name, scenario) in enumerate(scenarios.items(), 1):
            progress.update(task, description=name)
            start = time.perf_counter()
            case = read_case(folder / "cases" / f"{name}.nc", scenario)
            kept = case is not None
            if case is None:
                case = compute_case(scenario)
                with staged(folder) as stage:
                    (stage / "cases").mkdir()
                    case.to_netcdf(stage / "cases" / f"{name}.nc", engine="h5netcdf")
            cases[name] = case
            taken = "kept" if kept else f"{time.perf_counter() - start:.1f} s"
            progress.console.print(
                f"  {number:2}/{len(scenarios)} {name:<20} {taken:>7}   first SNR < 1: "
                f"{cross(case)}",
                highlight=False,
            )
            progress.advance(task)
    return cases


def read_case(path: Path, scenario: Scenario) -> xr.Dataset | None:
    """A case computed before with the same scenario and version of the package, or None."""
    if not h5py.is_hdf5(path):
        return None
    case = xr.load_dataset(path, engine="h5netcdf")
    wanted = {"format": FORMAT, "scenario": scenario.to_yaml(), "version": __version__}
    return case if all(case.attrs.get(key) == value for key, value in wanted.items()) else None


def compute_case(scenario: Scenario) -> xr.Dataset:
    """Simulate and map a scenario; all that figures and claims need of it.

    Dims ell, mode, pixel (HEALPix RING, Galactic), product and time, pattern and theta and phi;
    temperatures in K. Attributes: the scenario, the versions and what is one number.
    """
    experiment = Experiment.from_scenario(scenario)
    data = experiment.simulate()
    model, posterior, _ = experiment.infer(data)
    mean, truth, nside = np.asarray(posterior.mean), np.asarray(data.truth), scenario.map_nside
    residuals = np.asarray(whitened_residuals(model, posterior, data.data))
    variances = data.layout.scatter(experiment.radiometer().diagonal())
    grid = HemisphereGrid.gauss_legendre(*BEAM_NODES)
    beams = np.abs(stokes_beam(build_monopoles(scenario).fields(scenario.frequency_mhz, grid)))
    rms = experiment.beam_rms_difference()
    return xr.Dataset(
        {
            "rho": ("ell", correlation(mean, truth)),
            "snr": ("ell", signal_to_noise(mean, truth)),
            "cl_mean": ("ell", power_spectrum(mean)),
            "cl_truth": ("ell", power_spectrum(truth)),
            "mean_modes": ("mode", mean),
            "truth_modes": ("mode", truth),
            "std_modes": ("mode", np.asarray(posterior.std())),
            "mean": ("pixel", modes_to_map(mean, nside)),
            "truth": ("pixel", modes_to_map(truth, nside)),
            "highest_altitude": ("pixel", highest_altitude(data.observation, nside)),
            "data": (("product", "time"), data.grid()),
            "noise_std": (("product", "time"), np.sqrt(np.asarray(variances))),
            "beam": (
                ("pattern", "theta", "phi"),
                np.stack([beams[0, 0], beams[0, 2], beams[0, 1]]).astype(np.float32),
            ),
        },
        coords={
            "ell": np.arange(scenario.lmax + 1),
            "product": list(data.labels),
            "pattern": ["auto 00", "|cross 02|", "|cross 01|"],
            "theta": grid.theta,
            "phi": grid.phi,
        },
        attrs={
            "format": FORMAT,
            "scenario": scenario.to_yaml(),
            "version": __version__,
            "versions": json.dumps(versions()),
            "frequency_mhz": scenario.frequency_mhz,
            "log_evidence": float(posterior.log_evidence),
            "chi2": float(residuals @ residuals),
            "chi2_expected": expected_chi2(posterior, model.n_data),
            "n_data": model.n_data,
            "n_modes": model.prior.size,
            **({} if rms is None else {"beam_rms_difference": rms}),
        },
    )


def case_table(cases: Cases) -> list[dict[str, object]]:
    """Rows of cases.csv."""
    rows = []
    for name, case in cases.items():
        row: dict[str, object] = {"case": name, "frequency_mhz": case.attrs["frequency_mhz"]}
        for metric in ("rho", "snr"):
            for ell in (1, 10, 20, 30, 40):
                inside = ell < case.sizes["ell"]
                row[f"{metric}_{ell}"] = f"{float(case[metric][ell]):.4g}" if inside else "beyond"
        row["ell_cross"] = cross(case) if cross(case) < case.sizes["ell"] else "none"
        for key in ("log_evidence", "chi2", "chi2_expected"):
            row[key] = f"{case.attrs[key]:.1f}"
        row["n_data"] = case.attrs["n_data"]
        rms = case.attrs.get("beam_rms_difference")
        row["beam_rms_difference"] = "none" if rms is None else f"{rms:.4f}"
        rows.append(row)
    return rows


def claim_table(cases: Cases) -> list[dict[str, object]]:
    """Rows of claims.csv, in the order of the paper."""
    rows = []
    for claim in CLAIMS:
        verdict = claim.judge(cases)
        rows.append(
            {
                "section": claim.section,
                "paper": claim.statement,
                "obtained": verdict.obtained,
                "agrees": verdict.agrees,
                "reason": "it holds" if verdict.agrees == "yes" else claim.otherwise,
            }
        )
    return rows


def write_csv(path: Path, rows: Sequence[Mapping[str, object]]) -> None:
    """A table with the keys of its first row as header."""
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, rows[0])
        writer.writeheader()
        writer.writerows(rows)


def as_markdown(rows: Sequence[Mapping[str, object]]) -> str:
    """The claims as a table, with a count of the verdicts above it."""
    verdicts = [row["agrees"] for row in rows]
    counts = ", ".join(f"{verdicts.count(v)} {v}" for v in ("yes", "partly", "no"))
    head = "| section | the paper says | obtained | agrees | if not, why |\n" + "| --- " * 5 + "|\n"
    lines = []
    for row in rows:
        cells = [str(value).replace("|", "\\|") for value in row.values()]
        cells[-1] = "" if row["agrees"] == "yes" else cells[-1]
        lines.append(f"| {' | '.join(cells)} |\n")
    return f"{len(rows)} claims: {counts}.\n\n{head}{''.join(lines)}"
