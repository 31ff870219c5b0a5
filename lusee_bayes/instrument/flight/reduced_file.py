"""Reduced spectra in a netCDF file."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from lusee_bayes.core import formats
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.files import replacing
from lusee_bayes.core.layouts import Attribute, Layout, Variable
from lusee_bayes.core.netcdf_files import read_netcdf
from lusee_bayes.core.paths import user_path
from lusee_bayes.core.reading import naming
from lusee_bayes.core.version import __version__
from lusee_bayes.instrument.flight.gain_table import LETTERS
from lusee_bayes.instrument.flight.reduced import REASONS, Curves, Reduced
from lusee_bayes.instrument.flight.spectrometer import NO_LEVEL, PORTS
from lusee_bayes.instrument.observation import Observation
from lusee_bayes.instrument.products import labels
from lusee_bayes.instrument.times import JD_SCALES, utc_of_jd
from lusee_bayes.instrument.windows import Windows

HINT = "make it with: lusee-bayes reduce SCENARIO SESSION..."
CURVES = ("level_3", "port", "curve")
BANDS, GAINS = ("frequency", "product", "bin"), ("frequency", "port", "bin")
LAYOUT = Layout(
    "reduced spectra",
    {
        "frequency": Variable(("frequency",), low=0.0, grows=True, unit="MHz"),
        "product": Variable(("product",), "text"),
        "visibility": Variable(BANDS, missing=True, unit="V^2/Hz"),
        "before_flags": Variable(BANDS, missing=True, unit="V^2/Hz"),
        "n_averaged": Variable(("frequency", "bin"), low=0.0),
        "level": Variable(("bin", PORTS), "text", choices=(*LETTERS, NO_LEVEL)),
        "gain": Variable(GAINS, missing=True),
        "gain_slope": Variable(("frequency", "port", "component", "bin"), missing=True),
        "component_std": Variable((len(LETTERS), PORTS, "component"), low=0.0, optional=True),
        "curve_mhz": Variable(("curve",), low=0.0, grows=True),
        "curve_gain": Variable((len(LETTERS), PORTS, "curve"), missing=True),
        "curve_std": Variable((len(LETTERS), PORTS, "curve"), missing=True),
        "scatter": Variable(("frequency",), missing=True),
        "line_scatter": Variable(("frequency",), missing=True),
        "curvature": Variable(("frequency",), missing=True),
        "jd1": Variable(("spectrum",)),
        "jd2": Variable(("spectrum",)),
        "run": Variable(("spectrum",), "integer", low=0.0),
        "bin_of": Variable(("spectrum",), "integer", low=0.0),
        "window_start_s": Variable(("spectrum",), optional=True),
        "window_end_s": Variable(("spectrum",), optional=True),
        "live_s": Variable(("spectrum",), low=0.0, optional=True),
        "turntable_deg": Variable(("run_number",)),
        "reason": Variable(
            ("frequency", "spectrum"), "integer", low=0.0, high=float(len(REASONS) - 1)
        ),
        "line_share": Variable(("frequency", "spectrum"), low=0.0, high=1.0),
    },
    {
        "lon_deg": Attribute(low=-360.0, high=360.0),
        "lat_deg": Attribute(low=-90.0, high=90.0),
        **JD_SCALES,
        "step_s": Attribute(low=0.0),
        "bandwidth_mhz": Attribute(low=0.0),
        "average_s": Attribute(low=0.0, optional=True),
        "gain_std": Attribute(low=0.0, optional=True),
        "sessions": Attribute("text"),
        # files of older versions do not say it
        "recipe": Attribute("text", optional=True),
    },
)


def write_reduced(path: str | Path, reduced: Reduced, scenario: str = "") -> Path:
    """Write reduced spectra, whole or not at all.

    Parameters
    ----------
    path : str or Path
    reduced : Reduced
    scenario : str
        Text of the scenario that they were reduced with.
    """
    seen = reduced.observation
    variables = {
        "visibility": (BANDS, reduced.values, {"units": "V^2/Hz"}),
        "before_flags": (BANDS, reduced.before.astype(np.float32), {"units": "V^2/Hz"}),
        "n_averaged": (("frequency", "bin"), reduced.n_averaged),
        "level": (("bin", "port"), reduced.level.astype(object)),
        "gain": (GAINS, reduced.gain, {"units": "count / (nV^2/Hz)"}),
        "gain_slope": (("frequency", "port", "component", "bin"), reduced.slope),
        "curve_mhz": (("curve",), reduced.curves.frequencies_mhz, {"units": "MHz"}),
        "curve_gain": (CURVES, reduced.curves.gain, {"units": "count / (nV^2/Hz)"}),
        "curve_std": (CURVES, reduced.curves.std, {"units": "count / (nV^2/Hz)"}),
        "scatter": (("frequency",), reduced.scatter),
        "line_scatter": (("frequency",), reduced.line_scatter),
        "curvature": (("frequency",), reduced.curvature),
        "jd1": (("spectrum",), seen.times.jd1, {"scale": "utc"}),
        "jd2": (("spectrum",), seen.times.jd2, {"scale": "utc"}),
        "run": (("spectrum",), seen.run.astype(np.int32)),
        "bin_of": (("spectrum",), reduced.bin_of.astype(np.int32)),
        "turntable_deg": (("run_number",), np.array(seen.turntable_deg)),
        "reason": (
            ("frequency", "spectrum"),
            reduced.reason,
            {"flag_meanings": ", ".join(REASONS)},
        ),
        "line_share": (("frequency", "spectrum"), reduced.lines),
    }
    if seen.windows is not None:
        variables |= {
            "window_start_s": (("spectrum",), seen.windows.start_s),
            "window_end_s": (("spectrum",), seen.windows.end_s),
            "live_s": (("spectrum",), seen.windows.live_s),
        }
    if reduced.component_std is not None:
        variables["component_std"] = (("level_3", "port", "component"), reduced.component_std)
    numbers = {"average_s": reduced.average_s, "gain_std": reduced.gain_std}
    dataset = xr.Dataset(
        variables,
        coords={"frequency": reduced.frequencies_mhz, "product": list(labels())},
        attrs={
            "format": formats.REDUCED,
            "lon_deg": seen.lon_deg,
            "lat_deg": seen.lat_deg,
            "step_s": seen.step_s,
            "bandwidth_mhz": reduced.bandwidth_mhz,
            "sessions": json.dumps([dict(one) for one in reduced.sessions]),
            "recipe": json.dumps(dict(reduced.recipe)),
            "scenario": scenario,
            "lusee_bayes_version": __version__,
            **{name: value for name, value in numbers.items() if value is not None},
        },
    )
    small = {"zlib": True, "complevel": 1}
    encoding = dict.fromkeys(("before_flags", "reason", "line_share", "visibility"), small)
    with replacing(path) as partial:
        dataset.to_netcdf(partial, engine="h5netcdf", encoding=encoding)
    return user_path(path)


def read_reduced(path: str | Path) -> Reduced:
    """Read reduced spectra.

    Parameters
    ----------
    path : str or Path

    Raises
    ------
    InputError
        If the file is missing, of another kind or damaged.
    """
    found = read_netcdf(path, formats.REDUCED, LAYOUT, HINT)
    here, said = found.arrays, found.values
    if tuple(map(str, here["product"])) != labels():
        raise InputError(f"{path} has other products than {', '.join(labels())}")
    texts = {"sessions": said["sessions"], "recipe": said.get("recipe", "{}")}
    told: dict[str, Any] = {}
    for name, text in texts.items():
        try:
            told[name] = json.loads(text)
        except json.JSONDecodeError as error:
            raise InputError(f"{path}: the attribute {name} is no JSON: {error}") from error
    windows = None
    with naming(path):
        if "window_start_s" in here and "window_end_s" in here:
            windows = Windows.whole(
                here["window_start_s"], here["window_end_s"], here.get("live_s")
            )
        observation = Observation(
            said["lon_deg"],
            said["lat_deg"],
            utc_of_jd(found),
            here["run"],
            tuple(here["turntable_deg"].tolist()),
            said["step_s"],
            windows=windows,
        )
    if here["bin_of"].max() >= found.sizes["bin"]:
        raise InputError(f"{path}: bin_of goes beyond the {found.sizes['bin']} bins")
    return Reduced(
        frequencies_mhz=here["frequency"],
        bandwidth_mhz=said["bandwidth_mhz"],
        observation=observation,
        bin_of=here["bin_of"],
        average_s=said.get("average_s"),
        reason=here["reason"].astype(np.uint8),
        values=here["visibility"],
        before=here["before_flags"],
        n_averaged=here["n_averaged"],
        level=here["level"],
        gain=here["gain"],
        slope=here["gain_slope"],
        bend=here["curvature"][:, None, None],
        span_scatter=here["scatter"][:, None],
        slab_scatter=here["line_scatter"][:, None],
        lines=here["line_share"].astype(np.float32),
        component_std=here.get("component_std"),
        gain_std=said.get("gain_std"),
        curves=Curves(here["curve_mhz"], here["curve_gain"], here["curve_std"]),
        sessions=tuple(told["sessions"]),
        recipe=told["recipe"],
    )
