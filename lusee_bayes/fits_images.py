"""Reading the images of a FITS file by name, whole or not at all."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from astropy.io import fits
from astropy.utils.exceptions import AstropyWarning

from lusee_bayes.checks import InputError


def is_fits(path: str | Path) -> bool:
    """Whether a file begins like FITS."""
    with Path(path).open("rb") as file:
        return file.read(6) == b"SIMPLE"


def image_names(path: str | Path) -> list[str]:
    """Names of what a FITS file holds, in lower case. InputError if it cannot be read."""
    return list(_open(Path(path), ())[1])


def read_images(
    path: str | Path, names: Sequence[str], kind: str
) -> tuple[dict[str, np.ndarray], fits.Header]:
    """Images by name (capitals or not), and the primary header.

    ``kind``: what the file should be, for messages. InputError if it cannot be read, is cut short,
    or has no image of one of these names.
    """
    path = Path(path)
    images, found, header = _open(path, names)
    missing = [name for name in names if name not in images]
    if missing:
        raise InputError(
            f"{path} has no image '{missing[0]}' (it has {', '.join(found.values())}); expected "
            f"{kind}"
        )
    return images, header


def _open(
    path: Path, names: Sequence[str]
) -> tuple[dict[str, np.ndarray], dict[str, str], fits.Header]:
    with opened(path) as hdus:
        found = {hdu.name.lower(): hdu.name for hdu in hdus}
        images = {n: np.array(hdus[n].data) for n in names if n.lower() in found}
        return images, found, hdus[0].header.copy()


@contextmanager
def opened(path: str | Path) -> Iterator[fits.HDUList]:
    """An open FITS file. InputError if it, or what is read of it meanwhile, is cut short or bad."""
    try:
        # a file cut short is only warned of
        with warnings.catch_warnings(), Path(path).open("rb") as file:
            warnings.simplefilter("error", AstropyWarning)
            with fits.open(file, memmap=False) as hdus:
                yield hdus
    except InputError:
        raise
    except (OSError, TypeError, ValueError, AstropyWarning) as error:
        raise InputError(f"{path} cannot be read as FITS, or is cut short: {error}") from error
