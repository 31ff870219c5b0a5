"""Read the waterfalls of luseepy, scalar or four-port."""

from __future__ import annotations

from pathlib import Path

from lusee_bayes.core.formats import image_names
from lusee_bayes.core.reading import require_file
from lusee_bayes.instrument.waterfalls.four_port import read_four_port
from lusee_bayes.instrument.waterfalls.scalar import read_scalar
from lusee_bayes.instrument.waterfalls.waterfall import Waterfall


def read_waterfall(path: str | Path) -> Waterfall:
    """Read a waterfall of luseepy's simulators, with all products or some.

    Parameters
    ----------
    path : str or Path

    Returns
    -------
    Waterfall

    Raises
    ------
    InputError
        If there is no file, or as :func:`read_scalar` and :func:`read_four_port`.
    """
    path = require_file(path, "data")
    names = set(image_names(path))
    return read_four_port(path) if "blackbody_normalization_real" in names else read_scalar(path)
