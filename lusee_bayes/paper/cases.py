"""The paper's cases: their scenarios, and the quantities that figures and claims need."""

import json
import re
from collections.abc import Sequence
from itertools import product
from pathlib import Path

import numpy as np
import xarray as xr

from lusee_bayes.core import formats, reading, version
from lusee_bayes.core.errors import InputError
from lusee_bayes.experiment import model, sky_sections
from lusee_bayes.experiment.experiment import build
from lusee_bayes.experiment.scenario import Scenario, load_scenario
from lusee_bayes.instrument.beams.fields import HemisphereGrid, stokes_beam
from lusee_bayes.paper.claims import Cases, cross
from lusee_bayes.results.channel_map import conditioned

# by name: the scenarios, and labels in figures
TABLE = reading.table_beside(__file__)
# by name: a scenario of the package, and changes to it
CASES = {name: (one.get("scenario", name), one.get("changes", [])) for name, one in TABLE.items()}

# a channel's attributes in a case file
MODES, NUMBERS = ("mean", "truth", "std"), ("log_evidence", "chi2", "chi2_expected", "n_data")
# nodes in zenith angle and azimuth of the beams in a case file, for the figure
BEAM_NODES = (48, 96)


def paper_scenarios(
    overrides: Sequence[str] = (), skies: Sequence[str | Path] = ()
) -> dict[str, Scenario]:
    """The resolved scenario of every case."""
    files = {sky_frequency_mhz(path): Path(path).resolve() for path in skies}
    scenarios = {
        name: load_scenario(base, [*changes, *overrides]) for name, (base, changes) in CASES.items()
    }
    for name, scenario in scenarios.items() if files else ():
        # the file nearest in log frequency, scaled to the scenario's
        nearest = min(files, key=lambda f: abs(np.log(f / scenario.frequency_mhz)))
        sky = sky_sections.FileSkySection(file=str(files[nearest]), file_frequency_mhz=nearest)
        scenarios[name] = scenario.model_copy(update={"sky": sky})
    return scenarios


def sky_frequency_mhz(path: str | Path) -> float:
    """Frequency in a file name like ULSA's: exp10.0MHz_sky_map_with_absorption.hdf5.

    InputError if the file is missing or its name has no frequency.
    """
    path = reading.require_file(path, "sky map")
    match = re.search(r"exp(\d+(?:\.\d+)?)MHz", Path(path).name)
    if match is None or float(match[1]) == 0.0:
        wrong = f"'{Path(path).name}' states no frequency; name it as exp10.0MHz_sky_map.hdf5"
        raise InputError(wrong)
    return float(match[1])


def is_case(path: Path, scenario: Scenario) -> bool:
    """Whether a file contains a scenario's case, computed by this version of the package."""
    return formats.says(path, formats.header(formats.PAPER_CASE) | {"scenario": scenario.to_yaml()})


def compute_case(scenario: Scenario) -> xr.Dataset:
    """Simulate and map a scenario, and collect everything that figures and claims need.

    Returns
    -------
    xarray.Dataset
        On dims ell, mode, pixel (HEALPix RING, Galactic), product and time, pattern and theta and
        phi; temperatures in K. Attributes: scenario, versions and single numbers.
    """
    experiment = build(scenario)
    setup, data, made = experiment.setup, experiment.data, conditioned(experiment)
    channel = made.result(made.channel_data(alone=False))
    spectra, maps = channel.spectra(), channel.maps()
    variances = data.layout.scatter(model.radiometer(setup).diagonal())
    grid = HemisphereGrid.gauss_legendre(*BEAM_NODES)
    beams = stokes_beam(setup.beam_source.fields(scenario.frequency_mhz, grid))[0, [0, 2, 1]]
    rms = channel.beam_rms_difference
    units = {"rho": "1", "snr": "1", "cl_mean": "K2", "cl_truth": "K2"}
    grid_of_data, kelvin, angle = ("product", "time"), {"units": "K"}, {"units": "rad"}
    variables = {
        **{name: ("ell", spectra[name], {"units": unit}) for name, unit in units.items()},
        **{f"{name}_modes": ("mode", getattr(channel, name), kelvin) for name in MODES},
        **{name: ("pixel", maps[name], kelvin) for name in ("mean", "truth")},
        "highest_altitude": ("pixel", channel.highest_altitude, {"units": "1"}),
        "data": (grid_of_data, data.grid(), kelvin),
        "noise_std": (grid_of_data, np.sqrt(np.asarray(variances)), kelvin),
        "beam": (("pattern", "theta", "phi"), np.abs(beams).astype(np.float32), {"units": "1"}),
    }
    coords = {
        "ell": np.arange(scenario.lmax + 1),
        "product": list(data.labels),
        "pattern": ["auto 00", "|cross 02|", "|cross 01|"],
        "theta": ("theta", grid.theta, angle),
        "phi": ("phi", grid.phi, angle),
    }
    attributes = {
        **formats.header(formats.PAPER_CASE),
        "scenario": scenario.to_yaml(),
        "versions": json.dumps(version.versions()),
        "frequency_mhz": scenario.frequency_mhz,
        **{name: getattr(channel, name) for name in NUMBERS},
        "n_modes": len(channel.mean),
        **({} if rms is None else {"beam_rms_difference": rms}),
    }
    return formats.with_grid(xr.Dataset(variables, coords, attributes))


def case_table(cases: Cases) -> list[dict[str, object]]:
    """Rows of cases.csv."""
    rows = []
    for name, case in cases.items():
        row: dict[str, object] = {"case": name, "frequency_mhz": case.attrs["frequency_mhz"]}
        for metric, ell in product(("rho", "snr"), (1, 10, 20, 30, 40)):
            inside = ell < case.sizes["ell"]
            row[f"{metric}_{ell}"] = f"{float(case[metric][ell]):.4g}" if inside else "beyond"
        row["ell_cross"] = cross(case) if cross(case) < case.sizes["ell"] else "none"
        row |= {key: f"{case.attrs[key]:.1f}" for key in ("log_evidence", "chi2", "chi2_expected")}
        row["n_data"] = case.attrs["n_data"]
        rms = case.attrs.get("beam_rms_difference")
        row["beam_rms_difference"] = "none" if rms is None else f"{rms:.4f}"
        rows.append(row)
    return rows
