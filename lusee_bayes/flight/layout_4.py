"""Layout 4 of ``lusee.ingest`` in HDF5.

It has row-aligned metadata as a union of fields (``metadata/fields/NAME/variant_000/data``), raw
telemetry with a separate clock, and a clock reference in place of an MJD offset. All is converted
to the names of layout 3.
"""

from pathlib import Path

import h5py
import numpy as np

from lusee_bayes.core.arrays import Rows, Times
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.layouts import Layout, Unread, Variable
from lusee_bayes.core.reading import table_beside
from lusee_bayes.flight.clock import Clock
from lusee_bayes.flight.layout_3 import no_spectra, said_in
from lusee_bayes.flight.session import META, ROWS, SAID, TELEMETRY, Session, session_of
from lusee_bayes.instrument.times import scale_of, time_of_text

LAYOUT_4 = Layout("a session of lusee.ingest, layout 4", ROWS, SAID)
# names in layout 4 of those in layout 3
NAMES = [name.removeprefix(f"{META}/") for name in ROWS if name.startswith(META)]
FIELDS = {name: name.lower() for name in (*NAMES, "actual_gain")}
# groups of data other than spectra of all channels, and their names in messages
UNUSED: dict[str, str] = table_beside(__file__)
# ticks of the telemetry's clock in a second
TICKS = 65536
TELEMETRY_ARRAYS = {
    "field_names": Variable(("field",), "text"),
    **dict.fromkeys(("mission_seconds", "lusee_subsecs"), Variable(("time",))),
    "values": Variable(("time", "field"), missing=True),
    "valid": Variable(("time", "field"), "boolean", optional=True),
}
TELEMETRY_4 = Layout("telemetry as the current luseepy ingests it", TELEMETRY_ARRAYS)


def session_of_4(path: Path, file: h5py.File) -> Session:
    """Create a session from a file of layout 4.

    Parameters
    ----------
    path : Path
    file : h5py.File
        The open file.

    Raises
    ------
    InputError
        If something is missing or invalid.
    """
    if (cube := _dataset(file, "spectra/data")) is None:
        raise no_spectra(path, "spectra/data", file)
    arrays = {"spectra/data": cube, **_metadata(path, file, cube.shape[0] if cube.shape else 0)}
    if (raw_s := _dataset(file, "spectra/raw_seconds")) is not None:
        arrays["spectra/raw_times"] = raw_s
        marks = _dataset(file, "spectra/raw_time_valid")
        if marks is not None and not np.asarray(marks).all():
            raise InputError(
                f"{path}: raw_time_valid marks the clock of {int((np.asarray(marks) == 0).sum())} "
                f"of {len(marks)} spectra as invalid; ingest the session again without them"
            )
    if (clock := _clock_by_reference(path, file)) is not None and raw_s is not None:
        arrays |= _telemetry_at_rows(path, file, clock, np.asarray(raw_s))
    content = LAYOUT_4.checked(path, arrays, said_in(file))
    unused = {
        name: int(np.ravel(file[group].attrs.get("count", 0))[0])
        for group, name in UNUSED.items()
        if group in file
    }
    return session_of(path, content, arrays, layout=4, kind="HDF5", clock=clock, unused=unused)


def _dataset(file: h5py.Group, path: str) -> Unread | None:
    """An array, not yet read, or None."""
    item = file.get(path)
    if not isinstance(item, h5py.Dataset):
        return None
    if h5py.check_string_dtype(item.dtype) is not None:
        return np.array(item.asstr()[()], dtype=np.str_)
    return item


def _metadata(path: Path, file: h5py.File, n: int) -> dict[str, Unread]:
    """Fields that all rows have, in one shape."""
    fields: dict[str, Unread] = {}
    for ours, theirs in FIELDS.items():
        if (values := _dataset(file, f"{META}/fields/{theirs}/variant_000/data")) is None:
            continue
        rows = _dataset(file, f"{META}/fields/{theirs}/variant_000/row_indices")
        aligned = rows is None or np.array_equal(np.asarray(rows), np.arange(n))
        if tuple(values.shape)[:1] != (n,) or not aligned:
            raise InputError(
                f"{path}: {META}/fields/{theirs} has shape {tuple(values.shape)} for {n} spectra, "
                f"several shapes, or row_indices other than 0 to {n - 1}; ingest the session again"
            )
        fields[f"{META}/{ours}"] = values
    if (navgf := _dataset(file, "spectra/navgf")) is not None:
        averaged = np.asarray(fields.setdefault(f"{META}/Navgf", navgf))
        if not np.array_equal(averaged, np.asarray(navgf)):
            raise InputError(
                f"{path}: spectra/navgf is {_values(navgf)}, navgf of the metadata is "
                f"{_values(averaged)}; ingest the session again"
            )
    return fields


def _values(numbers: Unread) -> str:
    """The distinct values of an array, as text."""
    return ", ".join(map(str, np.unique(np.asarray(numbers)).tolist()))


def _clock_by_reference(path: Path, file: h5py.File) -> Clock | None:
    said = file["clock_reference"].attrs if "clock_reference" in file else {}
    if not bool(said.get("available")):
        return None
    scale = scale_of(f"{path}: time_scale", str(said["time_scale"]))
    if (raw_s := _anchors(file).get("spectrometer")) is None:
        return None
    time = time_of_text("clock_reference_isot", str(said["clock_reference_isot"]), scale)
    return Clock(str(path), float(time.jd1), float(time.jd2), scale, raw_s)


def _anchors(file: h5py.File) -> dict[str, float]:
    """Reading of each clock at the reference."""
    names = _dataset(file, "clock_reference/clock_sources")
    raw_s = _dataset(file, "clock_reference/clock_reference_raw_seconds")
    if names is None or raw_s is None:
        return {}
    values = np.asarray(raw_s, dtype=np.float64).tolist()
    return dict(zip(np.asarray(names).tolist(), values, strict=True))


def _telemetry_at_rows(path: Path, file: h5py.File, clock: Clock, raw_s: Rows) -> dict[str, Unread]:
    """Telemetry at the times of the spectra, if both clocks have a reference."""
    if (anchor := _anchors(file).get("dcb")) is None or "telemetry" not in file:
        return {}
    group = file["telemetry"]
    given = {name: array for name in group if (array := _dataset(group, name)) is not None}
    arrays = TELEMETRY_4.checked(f"{path}: telemetry", given, {}).arrays
    names = arrays["field_names"].tolist()
    values = np.where(arrays.get("valid", True), arrays["values"], np.nan)
    times_s = arrays["mission_seconds"] + arrays["lusee_subsecs"] / TICKS - anchor + clock.raw_s
    columns = {name: values[:, names.index(name)] for name in TELEMETRY if name in names}
    return {
        f"telemetry/{name}": _interpolated_to(f"{path}: telemetry {name}", raw_s, times_s, column)
        for name, column in columns.items()
    }


def _interpolated_to(where: str, raw_s: Rows, times_s: Times, values: Times) -> Rows:
    """Interpolate telemetry linearly to the times of spectra, both of one clock.

    Raises
    ------
    InputError
        If the telemetry does not cover them: nothing is extrapolated.
    """
    good = np.argsort(times_s, kind="stable")
    good = good[np.isfinite(values[good])]
    times_s, values = times_s[good], values[good]
    # a spectrum is longer than the telemetry's step, so its ends may lack half a step
    slack = 2.0 * float(np.median(np.diff(times_s))) if len(times_s) > 1 else 0.0
    if not len(times_s) or raw_s[0] < times_s[0] - slack or raw_s[-1] > times_s[-1] + slack:
        wrong = f"{where} does not cover the spectra; ingest the session with its telemetry"
        raise InputError(wrong)
    return np.interp(raw_s, times_s, values)
