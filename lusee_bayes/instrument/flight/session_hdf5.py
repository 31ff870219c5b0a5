"""Sessions of ``lusee.ingest`` in HDF5, layouts 3 and 4."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from jaxtyping import Shaped

from lusee_bayes.core.errors import InputError
from lusee_bayes.core.hdf5_probe import require_readable_hdf5
from lusee_bayes.core.layouts import Unread
from lusee_bayes.core.reading import reading
from lusee_bayes.instrument.flight.cubes import cache_for
from lusee_bayes.instrument.flight.session import TELEMETRY, Read, Session
from lusee_bayes.instrument.flight.session_layout import META, require_version, session_of
from lusee_bayes.instrument.flight.session_layout_4 import session_of_4

INTERPOLATED = "spectra_interpolated_telemetry"
WHAT = "a session of lusee.ingest in HDF5"


def read_hdf5_session(path: Path) -> Session:
    """Read everything of a session but its spectra.

    Parameters
    ----------
    path : Path

    Raises
    ------
    InputError
        For a file that is damaged, of another kind or of another version, and for whatever it
        lacks.
    """
    with reading(path, WHAT):
        require_readable_hdf5(path)
        with h5py.File(path) as file:
            version = require_version(path, file.attrs.get("layout_version"))
            if version == 4:
                return session_of_4(path, file, _opener(path))
            if "spectra" not in file or "data" not in file["spectra"]:
                raise InputError(
                    f"{path} has no spectra/data: the session holds no spectra (it has "
                    f"{', '.join(file) or 'nothing'})"
                )
            arrays, values = _content(file)
            arrays |= _telemetry(path, file)
            return session_of(path, version, "HDF5", arrays, values, None, _opener(path))


def _opener(path: Path) -> Callable[[], AbstractContextManager[Read]]:
    @contextmanager
    def opened() -> Iterator[Read]:
        with h5py.File(path) as file:
            cache = cache_for(file["spectra/data"].chunks)
        with h5py.File(path, **cache) as file:
            cube = file["spectra/data"]

            def read(first: int, last: int) -> Shaped[np.ndarray, "rows products channels"]:
                return np.asarray(cube[first:last], dtype=np.float32)

            yield read

    return opened


def _content(file: h5py.File) -> tuple[dict[str, Unread], dict[str, Any]]:
    """Arrays by their paths, and attributes as group.name."""
    arrays: dict[str, Unread] = {}
    for group in ("spectra", META):
        if group in file:
            arrays |= {
                f"{group}/{name}": item
                for name, item in file[group].items()
                if isinstance(item, h5py.Dataset)
            }
    values = {
        f"{name}.{key}": value
        for name in ("constants", "session_invariants", "spectra/data")
        if name in file
        for key, value in file[name].attrs.items()
    }
    return arrays, values


def _telemetry(path: Path, file: h5py.File) -> dict[str, Unread]:
    """Telemetry at the times of the spectra, as the file has it."""
    if INTERPOLATED not in file:
        return {}
    group = file[INTERPOLATED]
    if "time" in group and "raw_times" in file["spectra"]:
        theirs, ours = np.asarray(group["time"]), np.asarray(file["spectra/raw_times"])
        if theirs.shape != ours.shape or not np.array_equal(theirs, ours):
            raise InputError(f"{path}: {INTERPOLATED}/time are not the times of the spectra")
    return {f"telemetry/{name}": group[name] for name in TELEMETRY if name in group}
