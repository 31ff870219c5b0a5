"""Read the package's own files of visibilities."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lusee_bayes.core import formats
from lusee_bayes.core.checks import require_finite
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.formats import read_netcdf
from lusee_bayes.core.layouts import Attribute, Layout, Variable
from lusee_bayes.core.reading import naming, require_file
from lusee_bayes.instrument.beams.receiver import MeasuredReceiver
from lusee_bayes.instrument.layout import DataLayout
from lusee_bayes.instrument.observation import Observation
from lusee_bayes.instrument.products import labels
from lusee_bayes.instrument.times import JD_SCALES, utc_of_jd
from lusee_bayes.instrument.visibilities import HINT, LOADS, Visibilities
from lusee_bayes.instrument.window_variables import ATTRIBUTES, VARIABLES, read_windows

# what a file of visibilities holds
LAYOUT = Layout(
    "visibilities",
    {
        "product": Variable(("product",), "text"),
        "visibility": Variable(("product", "time"), finite=False, unit="K"),
        "flag": Variable(("product", "time"), "boolean"),
        "jd1": Variable(("time",)),
        "jd2": Variable(("time",)),
        "run": Variable(("time",), "integer", low=0.0),
        "turntable_deg": Variable(("run_number",)),
        **VARIABLES,
        "truth": Variable(("mode",), optional=True, unit="K"),
        # the receivers' loads ZL, where they are known
        "load_frequency_mhz": Variable(
            ("load_frequency",), low=0.0, grows=True, optional=True, unit="MHz"
        ),
        **{name: Variable(("load_frequency", "port", "port_2"), optional=True) for name in LOADS},
    },
    {
        "frequency_mhz": Attribute(low=0.0, unit="MHz"),
        "lon_deg": Attribute(low=-360.0, high=360.0),
        "lat_deg": Attribute(low=-90.0, high=90.0),
        "step_s": Attribute(low=0.0),
        **ATTRIBUTES,
        **JD_SCALES,
    },
)


def read_visibilities(path: str | Path) -> Visibilities:
    """Read a file that :meth:`Visibilities.write` has written.

    Parameters
    ----------
    path : str or Path

    Returns
    -------
    Visibilities

    Raises
    ------
    InputError
        If the file is missing or of another kind, holds NaN that is not flagged, or has nothing
        but flagged samples.
    """
    require_file(path, "data", HINT)
    found = read_netcdf(path, formats.VISIBILITIES, LAYOUT, HINT)
    here = found.arrays
    n, products = round(np.sqrt(found.sizes["product"])), tuple(map(str, here["product"]))
    if products != labels(n):
        raise InputError(
            f"{path} has products {', '.join(products)}; expected {', '.join(labels(n))}"
        )
    flags = here["flag"]
    values = np.where(flags, 0.0, here["visibility"])
    require_finite(f"{path}: visibility (where not flagged)", values)
    if here["run"].max() >= found.sizes["run_number"]:
        raise InputError(
            f"{path}: run numbers go up to {here['run'].max()}, and turntable_deg has "
            f"{found.sizes['run_number']} runs"
        )
    with naming(path):
        layout = DataLayout.from_flags(flags)
        utc = utc_of_jd(found)
        times, windows, says_window = read_windows(found, utc)
        observation = Observation(
            found.values["lon_deg"],
            found.values["lat_deg"],
            times,
            here["run"],
            tuple(here["turntable_deg"].tolist()),
            found.values["step_s"],
            windows=windows,
        )
        return Visibilities(
            layout.gather(values),
            layout,
            observation,
            found.values["frequency_mhz"],
            here.get("truth"),
            _receiver(path, here),
            says_window,
        )


def _receiver(path: str | Path, here: dict[str, np.ndarray]) -> MeasuredReceiver | None:
    names = ("load_frequency_mhz", *LOADS)
    if not set(names) <= set(here):
        return None
    frequencies, real, imaginary = (here[name] for name in names)
    return MeasuredReceiver(str(path), frequencies, real + 1j * imaginary)
