"""Gains of the spectrometer: counts for a spectral density, by level, port and frequency.

As in luseepy's ``GainModel``, each level (L, M, H) of each port has a mean gain and two components,
given at some frequencies. The telemetry predicts the components' strengths, ::

    G(f) = mean(f) + q_1 v_1(f) + q_2 v_2(f),    q_r = sum_k c_rk phi_k,
    phi = 1, F, A, V, D, I, F^2, A^2, F A,

F the temperature of the FPGA, A that of the port's ADC (0 for ports 0 and 1, 1 for 2 and 3), V and
I voltage and current of its 1.8 V, D the 1.2 V. All three curves are cubic splines between the
frequencies; beyond them no gain is defined. An auto in nV^2/Hz is counts / G, a cross is
counts / sqrt(G_a G_b).
"""

from dataclasses import dataclass, replace
from math import prod
from pathlib import Path

import numpy as np
from jaxtyping import Float

from lusee_bayes.core import formats, lazy
from lusee_bayes.core.checks import Described, extent, require_positive, require_shape
from lusee_bayes.core.errors import InputError, require_known
from lusee_bayes.core.files import user_path
from lusee_bayes.core.layouts import Layout, Variable, require_mhz
from lusee_bayes.core.reading import read_table, reading, require_file
from lusee_bayes.core.trees import from_tree, opened_tree, quantity, write_tree
from lusee_bayes.flight.session import LETTERS, PORTS, TELEMETRY, PortLevels, Telemetry

# levels of ports by their names, such as M0, and their indices in arrays
PLACES = {f"{x}{port}": (k, port) for k, x in enumerate(LETTERS) for port in range(PORTS)}
LEAD, N_COMPONENTS, N_TERMS = (len(LETTERS), PORTS), 2, 9
Errors = dict[str, float]
Strengths = Float[np.ndarray, "rows components"]
# one nV^2/Hz
NANO2 = 1e-18
# unit of gains: counts for one nV^2/Hz
COUNTS = "count Hz nV-2"


@dataclass(frozen=True, eq=False, repr=False)
class GainModel(Described):
    """Gains of all levels and ports.

    Attributes
    ----------
    path : str
        Origin of the table, for messages.
    anchor_mhz : (levels, ports, anchors) array
        Frequencies, increasing.
    mean : (levels, ports, anchors) array
        Counts for 1 nV^2/Hz.
    components : (levels, ports, components, anchors) array
        v_r, in the same unit.
    coefficient : (levels, ports, components, terms) array
        c_rk, in the order of phi.
    component_std : (levels, ports, components) array or None
        Standard deviations of the strengths q_r; None if they are unknown.
    kind : str
        How it was read, for reports.
    """

    path: str
    anchor_mhz: Float[np.ndarray, "level port anchor"] = quantity(
        "MHz", "frequencies of the gains", checks={"low": 0.0, "unit": "MHz"}
    )
    mean: Float[np.ndarray, "level port anchor"] = quantity(COUNTS, "mean gains", checks={})
    components: Float[np.ndarray, "level port component anchor"] = quantity(
        COUNTS, "components of gains", checks={}
    )
    coefficient: Float[np.ndarray, "level port component term"] = quantity(
        "1", "strengths of components for telemetry", checks={}
    )
    component_std: Float[np.ndarray, "level port component"] | None = quantity(
        "1", "errors of the strengths", checks={"low": 0.0}, default=None
    )
    kind: str = "made"

    def description(self) -> tuple[str, ...]:
        return (
            f"levels {', '.join(LETTERS)} of {PORTS} ports, {extent(self.anchor_mhz, 'MHz')}, mean "
            f"{np.median(self.mean):.3g} counts for 1 nV^2/Hz",
            f"errors {'not ' if self.component_std is None else ''}known",
        )

    def __post_init__(self):
        require_shape(f"{self.path}: coefficient", self.coefficient, (*LEAD, N_COMPONENTS, N_TERMS))
        if not (np.diff(self.anchor_mhz, axis=2) > 0.0).all():
            raise InputError(f"{self.path}: the frequencies of the gains do not increase")
        require_mhz(f"{self.path}: the frequencies of the gains", self.anchor_mhz)
        require_positive(f"{self.path}: the mean gain", self.mean, "give counts for 1 nV^2/Hz")

    def basis(
        self, level: str, port: int, frequencies_mhz: Float[np.ndarray, " frequencies"]
    ) -> Float[np.ndarray, "3 frequencies"]:
        """Return mean, v_1 and v_2 at some frequencies.

        Parameters
        ----------
        level : {"L", "M", "H"}
        port : int
        frequencies_mhz : (frequencies,) array

        Returns
        -------
        (3, frequencies) array
            Counts for 1 nV^2/Hz; NaN where the table has no gain.
        """
        place = LETTERS.index(level), port
        curves = np.vstack([self.mean[place], self.components[place]])
        spline = lazy.interpolate.CubicSpline(self.anchor_mhz[place], curves.T, extrapolate=False)
        return spline(frequencies_mhz).T

    def with_component_std(self, std: tuple[float, ...] | None) -> "GainModel":
        """Return the table with errors of the components of each level of each port, if given.

        Raises
        ------
        InputError
            If the table already has errors.
        """
        if std is None:
            return self
        if self.component_std is not None:
            why = f"{self.path} contains the errors of its components; remove flight.component_std"
            raise InputError(why)
        return replace(self, component_std=np.broadcast_to(std, self.components.shape[:3]).copy())

    def strengths(self, level: str, port: int, telemetry: Telemetry) -> Strengths:
        """Return q_1 and q_2 for telemetry.

        Parameters
        ----------
        level : {"L", "M", "H"}
        port : int
        telemetry : mapping of str to (rows,) array
            All of :data:`.TELEMETRY`.

        Raises
        ------
        InputError
            If part of it is missing.
        """
        if lacking := [name for name in TELEMETRY if name not in telemetry]:
            raise InputError(
                f"the telemetry lacks {', '.join(lacking)}, from which the gain table predicts "
                "gains; ingest the session with its telemetry, interpolated to the spectra"
            )
        values = {"1": np.ones_like(telemetry[TELEMETRY[0]]), **telemetry}
        phi = [prod(values[name] for name in term.split("*")) for term in _terms(port)]
        return np.stack(phi, axis=1) @ self.coefficient[LETTERS.index(level), port].T


# first and last frequency of curves, and number of points
CURVE_MHZ = (0.5, 51.0, 203)


@dataclass(frozen=True, eq=False)
class Curves:
    """Gains over frequency, at the mean telemetry.

    Attributes
    ----------
    frequencies_mhz : (curve,) array
    gain : (levels, ports, curve) array
        Counts for 1 nV^2/Hz; NaN for levels that no spectrum uses.
    std : (levels, ports, curve) array
        Standard deviation of the gains; 0 where it is unknown.
    """

    frequencies_mhz: Float[np.ndarray, " curve"] = quantity("MHz", checks={"grows": True})
    gain: Float[np.ndarray, "level port curve"] = quantity(COUNTS)
    std: Float[np.ndarray, "level port curve"] = quantity(COUNTS)


def gain_curves(
    table: GainModel, gain_std: float | None, levels: PortLevels, telemetry: Telemetry
) -> Curves:
    """Return the gains of every level of every port that occurs in the spectra.

    Parameters
    ----------
    table : GainModel
    gain_std : float or None
        Relative standard deviation of the gains of a level of a port.
    levels : (rows, ports) array of str
    telemetry : mapping of str to (rows,) array
    """
    mhz = np.linspace(*CURVE_MHZ)
    gain, std = np.full((*LEAD, len(mhz)), np.nan), np.zeros((*LEAD, len(mhz)))
    mean = {name: np.array([values.mean()]) for name, values in telemetry.items()}
    for (level, _), place in PLACES.items():
        if not (levels[:, place[1]] == level).any():
            continue
        basis = table.basis(level, place[1], mhz)
        gain[place] = basis[0] + table.strengths(level, place[1], mean)[0] @ basis[1:]
        variance = (gain_std or 0.0) ** 2 * np.square(gain[place])
        if table.component_std is not None:
            components = table.component_std[place][:, None] * basis[1:]
            variance = variance + np.square(components).sum(axis=0)
        std[place] = np.sqrt(variance)
    return Curves(mhz, gain, std)


def draw_gains(
    table: GainModel, gain_std: float | None, generator: np.random.Generator
) -> tuple[GainModel, Errors]:
    """Draw gains whose mean is a table.

    With independent standard normal z for each level of each port,
    G = (1 + gain_std z_0) (mean + q_1 v_1 + q_2 v_2) + sum_r component_std_r z_r v_r.

    Parameters
    ----------
    table : GainModel
        With its ``component_std``, or None if its components are exact.
    gain_std : float or None
        Relative to the gain; None if it is exact.
    generator : numpy.random.Generator

    Returns
    -------
    table : GainModel
        The sampled gains, for the same telemetry.
    errors : dict
        z, by their names in averages of spectra, such as M0 and M0 PC1.

    Raises
    ------
    InputError
        If a sampled gain is negative.
    """
    mean, coefficient = table.mean.copy(), table.coefficient.copy()
    errors: Errors = {}
    for name, place in PLACES.items():
        if gain_std is not None:
            errors[name] = float(generator.standard_normal())
            if (factor := 1.0 + gain_std * errors[name]) <= 0.0:
                raise InputError(
                    f"with a relative standard deviation of {gain_std:g}, the sampled gain of "
                    f"{name} is negative; give a smaller flight.gain_std"
                )
            mean[place] *= factor
            coefficient[place] *= factor
        if table.component_std is not None:
            for r in range(N_COMPONENTS):
                z = errors[f"{name} PC{r + 1}"] = float(generator.standard_normal())
                coefficient[(*place, r, 0)] += table.component_std[(*place, r)] * z
    return replace(table, mean=mean, coefficient=coefficient), errors


CSV = Layout(
    "luseepy's coefficients of gains",
    {name: Variable(("row",), "text") for name in ("gain_setting", "component", "model", "term")}
    | {"alpha_refit": Variable(("row",))},
)
HINT = "give the folder of luseepy's gain model (lusee/data/gain), or a netCDF file"


def read_gain_table(path: str | Path, model: str = "quadratic") -> "GainModel":
    """Read a gain table.

    Parameters
    ----------
    path : str or Path
        A folder with ``{L,M,H}{0..3}_{mean,eigvecs,freqs}.npy`` and ``alpha_refit.csv`` of luseepy,
        or a file of :func:`write_gain_table`.
    model : {"quadratic", "linear"}
        Set of luseepy's coefficients.

    Raises
    ------
    InputError
        If something is missing or invalid.
    """
    path = user_path(path)
    if path.is_dir():
        return _read_folder(path, model)
    with opened_tree(path, formats.GAINS, "a gain table", HINT) as tree:
        tree.attrs.update(path=str(path), kind="netCDF")
        return from_tree(GainModel, tree, str(path))


def write_gain_table(path: str | Path, table: GainModel) -> Path:
    """Write a gain table as netCDF, complete or not at all."""
    return write_tree(path, table, formats.GAINS)


# luseepy's arrays of every level and port
ARRAYS = {"freqs": ("anchor",), "mean": ("anchor",), "eigvecs": ("anchor", N_COMPONENTS)}


def _read_folder(folder: Path, model: str) -> "GainModel":
    layout = {
        f"{place}_{name}": Variable(dims) for name, dims in ARRAYS.items() for place in PLACES
    }
    files = {}
    for name in layout:
        path = require_file(folder / f"{name}.npy", "a gain table", HINT)
        with reading(path, "an array of luseepy's gain model"), path.open("rb") as file:
            values = np.load(file, allow_pickle=False)
        files[name] = values[:, :N_COMPONENTS] if values.ndim == 2 else values
    arrays = Layout("luseepy's gain model", layout).checked(folder, files, {}).arrays
    stacks = (np.stack([arrays[f"{place}_{name}"] for place in PLACES]) for name in ARRAYS)
    mhz, mean, vectors = (stack.reshape(*LEAD, *stack.shape[1:]) for stack in stacks)
    coefficients = _coefficients(folder / "alpha_refit.csv", model)
    kind = f"luseepy's gain model, {model} coefficients"
    return GainModel(str(folder), mhz, mean, vectors.swapaxes(2, 3), coefficients, kind=kind)


def _coefficients(path: Path, model: str) -> np.ndarray:
    columns = read_table(path, CSV, HINT)
    names = [
        f"{place} PC{r + 1} {term}"
        for place, (_, port) in PLACES.items()
        for r in range(N_COMPONENTS)
        for term in _terms(port)
    ]
    found: dict[str, float] = {}
    rows = zip(*(columns[name] for name in CSV.variables), strict=True)
    for number, (setting, component, family, term, value) in enumerate(rows, start=2):
        if str(family).strip().lower() != model:
            continue
        name = f"{setting.strip().upper()} {component.strip().upper()} {term.strip()}"
        require_known(f"{path}: line {number}: unknown coefficient", name, names)
        if name in found:
            raise InputError(f"{path}: line {number} repeats {name}")
        found[name] = value
    given = {name.rpartition(" ")[0] for name in found}
    lacking = dict.fromkeys(one for name in names if (one := name.rpartition(" ")[0]) not in given)
    if lacking:
        raise InputError(f"{path} has no coefficients of model {model} for {', '.join(lacking)}")
    return np.array([found.get(name, 0.0) for name in names]).reshape(*LEAD, N_COMPONENTS, N_TERMS)


def _terms(port: int) -> tuple[str, ...]:
    """Luseepy's names of phi."""
    adc, fpga = f"SPE_ADC{port // 2}_T", "THERM_FPGA"
    squares = (f"{fpga}*{fpga}", f"{adc}*{adc}", f"{fpga}*{adc}")
    return ("1", fpga, adc, "SPE_1VAD8_V", "VMON_1V2D", "SPE_1VAD8_C", *squares)


MEAN = {"L": 7e-4, "M": 3e-2, "H": 1.5}
ANCHORS_MHZ = np.array([0.1, 0.7, 1.1, 3.1, *np.linspace(7.1, 70.1, 12)])
# coefficients of q_1 and q_2 for the telemetry: 1, F, A, V, D, I, F^2, A^2, F A
TERMS = (
    (0.0, 2e-4, 1e-4, 1e-2, 1e-2, 5e-2, 1e-6, 1e-6, 0.0),
    (1e-3, 1e-4, -1e-4, 0.0, 0.0, 0.0, 0.0, 1e-6, -1e-6),
)
# the gain falls towards the ends of the band
LOW_MHZ, HIGH_MHZ = 0.2, 80.0


def synthetic_gains() -> "GainModel":
    """Return a made-up table."""
    f = ANCHORS_MHZ
    shape = (f / (f + LOW_MHZ)) ** 2 / (1.0 + (f / HIGH_MHZ) ** 2)
    ports = 1.0 + 0.04 * np.arange(PORTS)
    mean = np.array([MEAN[level] for level in LETTERS])[:, None, None] * ports[:, None] * shape
    component = np.stack([mean, mean * (np.log(f / 20.0) / 5.0)], axis=2)
    # the law differs between levels and ports
    factor = 1.0 + 0.1 * np.arange(len(PLACES)).reshape(*LEAD, 1, 1)
    coefficient = np.broadcast_to(TERMS, (*LEAD, N_COMPONENTS, N_TERMS)) * factor
    return GainModel("made up", np.broadcast_to(f, mean.shape).copy(), mean, component, coefficient)
