"""Writing FITS files of images as luseepy does, for tests of their readers."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from astropy.io import fits


def write_images(path: Path, images: dict[str, np.ndarray], header: dict[str, object]) -> Path:
    """Images by name, the first of them primary and with this header."""
    hdus = fits.HDUList()
    for name, image in images.items():
        hdus.append(fits.ImageHDU(image, name=name) if hdus else fits.PrimaryHDU(image))
        hdus[-1].header["EXTNAME"] = name
    for key, value in header.items():
        hdus[0].header[f"HIERARCH {key}"] = value
    hdus.writeto(path)
    return path
