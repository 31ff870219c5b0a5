"""Gain tables in files: a folder of luseepy's artifacts, or the package's own netCDF."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import xarray as xr

from lusee_bayes.core import formats
from lusee_bayes.core.errors import InputError, nearest
from lusee_bayes.core.files import replacing
from lusee_bayes.core.layouts import Layout, Variable
from lusee_bayes.core.netcdf_files import read_netcdf
from lusee_bayes.core.paths import user_path
from lusee_bayes.core.reading import read_table, reading, require_file
from lusee_bayes.instrument.flight.gain_table import (
    LETTERS,
    N_COMPONENTS,
    N_TERMS,
    GainTable,
)
from lusee_bayes.instrument.flight.spectrometer import PORTS

COEFFICIENTS = "alpha_refit.csv"
MODELS = ("quadratic", "linear")
DIMS = ("level", "port", "component", "anchor")
LAYOUT = Layout(
    "a gain table",
    {
        "level": Variable(("level",), "text", choices=LETTERS),
        "anchor_mhz": Variable(("level", "port", "anchor"), low=0.0, unit="MHz"),
        "mean": Variable(("level", "port", "anchor")),
        "components": Variable(DIMS),
        "coefficient": Variable((*DIMS[:3], "term")),
        "component_std": Variable(DIMS[:3], low=0.0, optional=True),
    },
)
CSV = Layout(
    "luseepy's coefficients of gains",
    {name: Variable(("row",), "text") for name in ("gain_setting", "component", "model", "term")}
    | {"alpha_refit": Variable(("row",))},
)
HINT = "give the folder of luseepy's gain model (lusee/data/gain), or a netCDF file"


def read_gain_table(path: str | Path, model: str = "quadratic") -> GainTable:
    """Read a gain table.

    Parameters
    ----------
    path : str or Path
        A folder with ``{L,M,H}{0..3}_{mean,eigvecs,freqs}.npy`` and ``alpha_refit.csv`` of luseepy,
        or a file of :func:`write_gain_table`.
    model : {"quadratic", "linear"}
        Which of luseepy's coefficients.

    Raises
    ------
    InputError
        If something is missing or not as it should be.
    """
    path = user_path(path)
    if path.is_dir():
        return _read_folder(path, model)
    require_file(path, "a gain table", HINT)
    found = read_netcdf(path, formats.GAINS, LAYOUT, HINT).arrays
    if tuple(map(str, found["level"])) != LETTERS:
        raise InputError(f"{path}: levels are {found['level']}; expected {', '.join(LETTERS)}")
    return GainTable(
        str(path),
        found["anchor_mhz"],
        found["mean"],
        found["components"],
        found["coefficient"],
        found.get("component_std"),
        "netCDF",
    )


def write_gain_table(path: str | Path, table: GainTable) -> Path:
    """Write a gain table as netCDF, whole or not at all."""
    variables = {
        "anchor_mhz": (("level", "port", "anchor"), table.anchor_mhz, {"units": "MHz"}),
        "mean": (("level", "port", "anchor"), table.mean, {"units": "count / (nV^2/Hz)"}),
        "components": (DIMS, table.component),
        "coefficient": ((*DIMS[:3], "term"), table.coefficient),
    }
    if table.component_std is not None:
        variables["component_std"] = (DIMS[:3], table.component_std)
    dataset = xr.Dataset(
        variables, coords={"level": list(LETTERS)}, attrs={"format": formats.GAINS}
    )
    with replacing(path) as partial:
        dataset.to_netcdf(partial, engine="h5netcdf")
    return user_path(path)


def _read_folder(folder: Path, model: str) -> GainTable:
    if model not in MODELS:
        raise InputError(f"unknown model of gains '{model}'; {nearest(model, MODELS)}")
    arrays: dict[str, list[list[np.ndarray]]] = {"freqs": [], "mean": [], "eigvecs": []}
    for level in LETTERS:
        for name, rows in arrays.items():
            rows.append([_array(folder / f"{level}{port}_{name}.npy") for port in range(PORTS)])
    vectors = [[v[:, :N_COMPONENTS].T for v in row] for row in arrays["eigvecs"]]
    shapes = {v.shape for row in arrays["mean"] for v in row}
    if len(shapes) > 1:
        raise InputError(f"{folder}: gains have different numbers of frequencies, {shapes}")
    return GainTable(
        str(folder),
        np.array(arrays["freqs"]),
        np.array(arrays["mean"]),
        np.array(vectors),
        _coefficients(folder / COEFFICIENTS, model),
        kind=f"luseepy's gain model, {model} coefficients",
    )


def _array(path: Path) -> np.ndarray:
    require_file(path, "a gain table", HINT)
    with reading(path, "an array of luseepy's gain model"), path.open("rb") as file:
        values = np.load(file, allow_pickle=False)
    if values.dtype.kind not in "fiu" or not np.isfinite(values).all():
        raise InputError(f"{path} holds other values than finite numbers")
    two = path.stem.endswith("eigvecs")
    if values.ndim != (2 if two else 1) or (two and values.shape[1] < N_COMPONENTS):
        expected = "a matrix" if two else "a list"
        raise InputError(f"{path} has shape {values.shape}, expected {expected}")
    return values.astype(np.float64)


def _coefficients(path: Path, model: str) -> np.ndarray:
    columns = read_table(path, CSV, HINT)
    found = np.zeros((len(LETTERS), PORTS, N_COMPONENTS, N_TERMS))
    seen: set[tuple[int, ...]] = set()
    names = ("gain_setting", "component", "model", "term", "alpha_refit")
    for number, (setting, component, family, term, value) in enumerate(
        zip(*(columns[name] for name in names), strict=True), start=2
    ):
        if str(family).strip().lower() != model:
            continue
        where = f"{path}: line {number}"
        place = (*_setting(where, str(setting)), _component(where, str(component)))
        place = (*place, _term(where, place[1], str(term)))
        if place in seen:
            raise InputError(f"{where} gives {setting} {component} {term} a second time")
        seen.add(place)
        found[place] = value
    lacking = [
        f"{level}{port} PC{r + 1}"
        for i, level in enumerate(LETTERS)
        for port in range(PORTS)
        for r in range(N_COMPONENTS)
        if not any(place[:3] == (i, port, r) for place in seen)
    ]
    if lacking:
        raise InputError(f"{path} has no coefficients of model {model} for {', '.join(lacking)}")
    return found


def _setting(where: str, text: str) -> tuple[int, int]:
    text = text.strip().upper()
    if len(text) != 2 or text[0] not in LETTERS or text[1] not in "0123":
        raise InputError(f"{where}: gain_setting is '{text}'; expected L0 to H3")
    return LETTERS.index(text[0]), int(text[1])


def _component(where: str, text: str) -> int:
    if text.strip().upper() not in ("PC1", "PC2"):
        raise InputError(f"{where}: component is '{text}'; expected PC1 or PC2")
    return int(text.strip()[-1]) - 1


def _term(where: str, port: int, text: str) -> int:
    adc = "SPE_ADC0_T" if port < 2 else "SPE_ADC1_T"
    fpga = "THERM_FPGA"
    terms = ("1", fpga, adc, "SPE_1VAD8_V", "VMON_1V2D", "SPE_1VAD8_C")
    terms = (*terms, f"{fpga}*{fpga}", f"{adc}*{adc}", f"{fpga}*{adc}")
    if text.strip() not in terms:
        raise InputError(f"{where}: unknown term '{text}' of port {port}; {nearest(text, terms)}")
    return terms.index(text.strip())
