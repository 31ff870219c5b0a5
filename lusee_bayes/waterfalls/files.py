"""Waterfall files, whatever kind they are."""

from __future__ import annotations

from pathlib import Path

from lusee_bayes.checks import InputError
from lusee_bayes.fits_images import image_names
from lusee_bayes.waterfalls.four_port import read_four_port
from lusee_bayes.waterfalls.scalar import read_scalar
from lusee_bayes.waterfalls.waterfall import Waterfall


def read_waterfall(path: str | Path) -> Waterfall:
    """Read a waterfall of luseepy's simulators, scalar or four-port; any subset of products.

    InputError as :func:`read_scalar` and :func:`read_four_port`.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"no data at '{path}'")
    names = set(image_names(path))
    return read_four_port(path) if "blackbody_normalization_real" in names else read_scalar(path)
