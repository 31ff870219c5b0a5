"""Writing FITS files of images as luseepy does, for tests of their readers."""

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


def write_response(path: Path) -> Path:
    """A small four-port response, FITS version 3, of four different short dipoles over ground."""
    theta, phi = np.linspace(0, 90, 13), np.linspace(0, 360, 25)
    th, ph = np.meshgrid(np.radians(theta), np.radians(phi), indexing="ij")
    azimuth, lift = np.radians([90.0, 0.0, 272.0, 178.0]), np.radians([10.0, 15.0, 20.0, 12.0])
    length = np.array([1.5, 1.4, 1.6, 1.45])
    arms = length * np.array(
        [np.cos(lift) * np.cos(azimuth), np.cos(lift) * np.sin(azimuth), np.sin(lift)]
    )
    to_theta = np.array([np.cos(th) * np.cos(ph), np.cos(th) * np.sin(ph), -np.sin(th)])
    to_phi = np.array([-np.sin(ph), np.cos(ph), 0.0 * ph])
    frequencies = np.array([10.0, 20.0, 40.0])
    sky = np.array([(f / 10.0) ** 2 * arms.T @ arms for f in frequencies])
    moon = 0.8 * sky + 0.1 * np.eye(4)[None] * sky[:, :1, :1]
    reactance = -100j * np.eye(4)[None] * (10.0 / frequencies)[:, None, None]
    images = {
        "H_theta": np.repeat(np.einsum("ai,atp->itp", arms, to_theta)[:, None], 3, 1) + 0j,
        "H_phi": np.repeat(np.einsum("ai,atp->itp", arms, to_phi)[:, None], 3, 1) + 0j,
        "ZA": sky + moon + reactance,
        "Rsky": sky + 0j,
        "Rmoon": moon + 0j,
        "Rloss": 0j * sky,
    }
    flat = {}
    for name, values in images.items():
        flat |= {f"{name}_real": values.real.astype(np.float32)}
        flat |= {f"{name}_imag": values.imag.astype(np.float32)}
    flat |= {"freq": frequencies, "theta": theta, "phi": phi}
    return write_images(path, flat, {"VERSION": 3})
