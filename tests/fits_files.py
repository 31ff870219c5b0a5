"""Writing FITS files of images as luseepy does, for tests of their readers."""

from pathlib import Path

import numpy as np
from astropy.io import fits
from reference import tangents, vectors


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


PAIRS = [[i, j] for i in range(4) for j in range(i, 4)]
HEADER = {
    "LUNAR_DAY": "2027-02-01 00:00:00 to 2027-02-02 00:00:00",
    "DELTAT_SEC": 7200.0,
    "LUN_LAT_DEG": -23.814,
    "LUN_LONG_DEG": 182.258,
}


def write_products(path, data=None, pairs=PAIRS, header=HEADER, frequencies=(10.0, 20.0)) -> Path:
    """A value for every product, time and channel: 100 product + time + channel / 10."""
    if data is None:
        n = sum(1 if i == j else 2 for i, j in pairs)
        product, time, channel = np.arange(n), np.arange(12), np.arange(len(frequencies))
        data = 100.0 * product[None, :, None] + time[:, None, None] + channel / 10.0
    images = {"data": data, "freq": np.array(frequencies), "combinations": np.array(pairs)}
    return write_images(path, images, header)


AZIMUTH, ZENITH = np.radians([90.0, 0.0, 272.0, 178.0]), np.radians([80.0, 75.0, 70.0, 78.0])
ARMS = np.array([1.5, 1.4, 1.6, 1.45]) * vectors(ZENITH, AZIMUTH).T


def effective_lengths(theta, phi) -> list[np.ndarray]:
    """Of four different short dipoles along theta and along phi, in m; (port, directions)."""
    return [np.einsum("xi,...x->i...", ARMS, along) for along in tangents(theta, phi)]


def write_response(path: Path, change=lambda images: None, finer: int = 1) -> Path:
    """A small four-port response, FITS version 3, of these dipoles over ground.

    Images are changed as complex ones, and in their parts.
    """
    theta, phi = np.linspace(0, 90, 12 * finer + 1), np.linspace(0, 360, 24 * finer + 1)
    lengths = effective_lengths(np.radians(theta)[:, None], np.radians(phi))
    h_theta, h_phi = (np.repeat(h[:, None] + 0j, 3, 1) for h in lengths)
    frequencies = np.array([10.0, 20.0, 40.0])
    sky = np.array([(f / 10.0) ** 2 * ARMS.T @ ARMS for f in frequencies])
    moon = 0.8 * sky + 0.1 * np.eye(4)[None] * sky[:, :1, :1]
    reactance = -100j * np.eye(4)[None] * (10.0 / frequencies)[:, None, None]
    images = {"H_theta": h_theta, "H_phi": h_phi, "ZA": sky + moon + reactance}
    images |= {"Rsky": sky, "Rmoon": moon, "Rloss": 0.0 * sky}
    change(images)
    images = in_parts(images) | {"freq": frequencies, "theta": theta, "phi": phi}
    change(images)
    return write_images(path, images, {"VERSION": 3})


def in_parts(images: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Real and imaginary parts of complex images, in single precision."""
    return {
        f"{name}_{part}": of(values).astype(np.float32)
        for name, values in images.items()
        for part, of in (("real", np.real), ("imag", np.imag))
    }
