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


def write_response(path: Path) -> Path:
    """A small four-port response, FITS version 3, of four different short dipoles over ground."""
    theta, phi = np.linspace(0, 90, 13), np.linspace(0, 360, 25)
    azimuth, zenith = np.radians([90.0, 0.0, 272.0, 178.0]), np.radians([80.0, 75.0, 70.0, 78.0])
    arms = np.array([1.5, 1.4, 1.6, 1.45]) * vectors(zenith, azimuth).T
    towards = tangents(np.radians(theta)[:, None], np.radians(phi))
    h_theta, h_phi = (np.einsum("ai,tpa->itp", arms, along)[:, None] for along in towards)
    frequencies = np.array([10.0, 20.0, 40.0])
    sky = np.array([(f / 10.0) ** 2 * arms.T @ arms for f in frequencies])
    moon = 0.8 * sky + 0.1 * np.eye(4)[None] * sky[:, :1, :1]
    reactance = -100j * np.eye(4)[None] * (10.0 / frequencies)[:, None, None]
    images = {"H_theta": np.repeat(h_theta, 3, 1), "H_phi": np.repeat(h_phi, 3, 1)}
    images |= {"ZA": sky + moon + reactance, "Rsky": sky, "Rmoon": moon, "Rloss": 0.0 * sky}
    axes = {"freq": frequencies, "theta": theta, "phi": phi}
    return write_images(path, in_parts(images) | axes, {"VERSION": 3})


def in_parts(images: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Real and imaginary parts of complex images, in single precision."""
    parts = ("real", np.real), ("imag", np.imag)
    return {
        f"{name}_{part}": of(values).astype(np.float32)
        for name, values in images.items()
        for part, of in parts
    }
