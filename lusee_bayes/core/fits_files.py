"""Read the images of FITS files by name; a damaged file raises an error."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from astropy.io import fits
from astropy.utils.exceptions import AstropyWarning

from lusee_bayes.core.errors import InputError


def is_fits(path: str | Path) -> bool:
    """Return whether a file begins like FITS."""
    with Path(path).open("rb") as file:
        return file.read(6) == b"SIMPLE"


def image_names(path: str | Path) -> list[str]:
    """Return the names of all images and tables of a FITS file, in lower case.

    Raises
    ------
    InputError
        If the file cannot be read or is cut short.
    """
    return list(_open(Path(path), ())[1])


def read_images(
    path: str | Path, names: Sequence[str], kind: str
) -> tuple[dict[str, np.ndarray], fits.Header]:
    """Read images by name.

    Parameters
    ----------
    path : str or Path
    names : sequence of str
        Upper and lower case are the same.
    kind : str
        What the file should be, for the error message.

    Returns
    -------
    images : dict of str to array
        With ``names`` as keys.
    header : fits.Header
        The primary header.

    Raises
    ------
    InputError
        If the file cannot be read, is cut short, or lacks one of the images.
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
    """Open a FITS file for the duration of a ``with`` block.

    Raises
    ------
    InputError
        If the file, or what the block reads of it, is cut short or damaged.
    """
    try:
        # astropy only warns of a file that is cut short
        with warnings.catch_warnings(), Path(path).open("rb") as file:
            warnings.simplefilter("error", AstropyWarning)
            with fits.open(file, memmap=False) as hdus:
                yield hdus
    except InputError:
        raise
    except (OSError, TypeError, ValueError, AstropyWarning) as error:
        raise InputError(f"{path} cannot be read as FITS, or is cut short: {error}") from error
