"""Write sessions in the layouts of ``lusee.ingest``, piece by piece.

What is written is what :func:`.read_session` reads, and luseepy for layout 3; of what else a
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
LAYOUTS = (3, 4)


def write_session(
    path: str | Path,
    rows: SessionRows,
    blocks: Iterable[Float32[np.ndarray, "_ products _"]],
    *,
    kind: str = "hdf5",
    layout: int = 3,
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
    layout : {3, 4}

    Raises
    ------
    InputError
        For another kind or layout, blocks that do not make up the rows, and a file that cannot be
        written.
    """
    if kind not in KINDS or layout not in LAYOUTS:
        raise InputError(
            f"sessions are written as hdf5 or fits of layout 3 or 4, not as {kind} of layout "
            f"{layout}"
        )
    path = user_path(path)
    with replacing(path) as partial:
        if kind == "fits":
            write_fits_session(partial, rows, blocks, layout)
        else:
            write_hdf5_session(partial, rows, blocks, layout)
    return path
