"""Write sessions in layout 3 of ``lusee.ingest``, piece by piece.

What is written is what :func:`.read_session` and luseepy read; of what else a
session of luseepy may hold, such as waveforms and housekeeping packets, there is nothing.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from lusee_bayes.core.errors import InputError
from lusee_bayes.core.files import replacing
from lusee_bayes.core.paths import user_path
from lusee_bayes.instrument.flight.session_rows import SessionRows
from lusee_bayes.instrument.flight.session_writing_fits import write_fits_session
from lusee_bayes.instrument.flight.session_writing_hdf5 import write_hdf5_session

KINDS = ("hdf5", "fits")


def write_session(
    path: str | Path,
    rows: SessionRows,
    blocks: Iterable[Float32[np.ndarray, "_ products _"]],
    *,
    kind: str = "hdf5",
) -> Path:
    """Write a session whole or not at all.

    Parameters
    ----------
    path : str or Path
    rows : SessionRows
    blocks : iterable of (some rows, 16, bins) array
        Counts, in the spectrometer's order of products; one after the other, so that they are never
        in memory together. Fewer bins than 2048 are filled up with NaN.
    kind : {"hdf5", "fits"}

    Raises
    ------
    InputError
        For another kind, blocks that do not make up the rows, and a file that cannot be
        written.
    """
    if kind not in KINDS:
        raise InputError(f"sessions are written as hdf5 or fits, not as {kind}")
    path = user_path(path)
    with replacing(path) as partial:
        if kind == "fits":
            write_fits_session(partial, rows, blocks)
        else:
            write_hdf5_session(partial, rows, blocks)
    return path
