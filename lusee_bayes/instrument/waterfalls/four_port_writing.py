"""Write waterfalls as luseepy's four-port simulator does."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits
from jaxtyping import Complex, Float

from lusee_bayes.core.errors import InputError
from lusee_bayes.core.files import user_path
from lusee_bayes.instrument.beams.circuit import Circuit
from lusee_bayes.instrument.beams.gridded import Interpolation
from lusee_bayes.instrument.products import all_products, labels, to_matrix
from lusee_bayes.instrument.visibilities import Visibilities
from lusee_bayes.instrument.waterfalls.four_port import INTERPOLATIONS, UNIT
from lusee_bayes.instrument.waterfalls.writing import grid_of, site_and_times, write_hdus


def write_four_port(
    path: str | Path,
    channels: Sequence[Visibilities],
    circuits: Sequence[Circuit],
    *,
    moon_k: float = 0.0,
    antenna_k: float = 0.0,
    interpolation: Interpolation = "linear",
    response: str = "unknown",
    scenario: str | None = None,
) -> Path:
    """Write channels of one observation in V^2/Hz, whole or not at all.

    Times are written as they are. Missing samples become NaN, and with them what is computed of the
    covariance at their time.

    Parameters
    ----------
    path : str or Path
    channels : sequence of Visibilities
        In K, with the emission of Moon and antennas.
    circuits : sequence of Circuit
        Antennas and loads of each channel.
    moon_k, antenna_k : float
        Temperatures of the Moon and of the antennas.
    interpolation : {"linear", "spline"}
        Of the response between its own frequencies.
    response : str
        Name of its file.
    scenario : str, optional
        Text of the scenario, stored as an image of bytes that luseepy ignores.

    Returns
    -------
    Path

    Raises
    ------
    InputError
        For what the layout cannot hold: open ports, windows, turntable angles other than 0, other
        than four ports, channels of different observations.
    """
    path, observation = user_path(path), channels[0].observation
    receiver, loads = circuits[0].receiver, [circuit.load_ohm for circuit in circuits]
    if receiver is None:
        raise InputError(
            f"{path}: luseepy's four-port waterfalls hold the loads of receivers, and the ports "
            "are open; give another beam.receiver, or write netCDF (a name that does not end in "
            ".fits)"
        )
    kelvin = grid_of(path, channels)
    enclosure = np.array([circuit.per_kelvin for circuit in circuits])
    root = np.sqrt(enclosure.diagonal(axis1=1, axis2=2).real)
    i, j = (np.array([getattr(p, end) for p in all_products()]) for end in ("i", "j"))
    data = kelvin * (root[:, i] * root[:, j]).T
    matrices = {
        "ZA": [c.antenna_ohm for c in circuits],
        "ZL": loads,
        "M": [c.loading for c in circuits],
        "Rsky": [c.resistance_ohm - c.moon_ohm - c.loss_ohm for c in circuits],
        "Rmoon": [c.moon_ohm for c in circuits],
        "Rloss": [c.loss_ohm for c in circuits],
    }
    times = np.stack([observation.times.jd1, observation.times.jd2], axis=-1)
    clock = {"TIMESYS": "UTC", "TIMEUNIT": "d", "CLOCKSRC": "supplied", "SCALEASM": False}
    hdus: list[fits.ImageHDU | fits.BinTableHDU] = [
        _image("data", data, UNIT),
        _image("freq", np.array([channel.frequency_mhz for channel in channels]), "MHz"),
        _image("time", times, "d", TIMEFMT="JD1+JD2", **clock),
        fits.BinTableHDU.from_columns([fits.Column("label", "8A", unit="1", array=labels())]),
    ]
    hdus[-1].header["EXTNAME"] = "products"
    for name, values in matrices.items():
        hdus += _complex(name, np.array(values), "1" if name == "M" else "Ohm")
    hdus += _complex("blackbody_normalization", enclosure, "V^2/(Hz K)")
    condition = np.linalg.cond(np.array(matrices["ZA"]) + np.array(loads))
    eigenvalues = _eigenvalues(data)
    largest = np.abs(eigenvalues).max(-1)
    ratio = np.divide(eigenvalues[..., 0], largest, out=np.zeros_like(largest), where=largest > 0)
    # visibilities are real products of a Hermitian matrix
    none = np.zeros_like(ratio)
    hdus += [
        _image("loading_condition_number", condition, "1"),
        _image("covariance_antihermitian_absolute", none, UNIT),
        _image("covariance_antihermitian_relative", none, "1"),
        _image("covariance_eigenvalues", eigenvalues, UNIT),
        _image("covariance_minimum_eigenvalue_ratio", ratio, "1"),
        _image("receiver_params", _bytes(receiver.luseepy_parameters()), "1"),
    ]
    header = {
        "VERSION": 3,
        "ENGINE": "lusee_bayes",
        **site_and_times(observation),
        "RESPONSE": Path(response).name,
        "FREQINT": INTERPOLATIONS[interpolation],
        **clock,
        "RECMODEL": receiver.luseepy_name,
        "RECSRC": getattr(receiver, "path", "analytic"),
        "SKYFRAME": "galactic",
        "TMOON_K": moon_k,
        "TANT_K": antenna_k,
        "LOADCMAX": float(condition.max()),
        "AHABSMAX": 0.0,
        "AHRELMAX": 0.0,
        "BUNIT": UNIT,
    }
    if np.isfinite(eigenvalues).any():
        header |= {"COVEIMIN": float(np.nanmin(eigenvalues)), "COVERMIN": float(np.nanmin(ratio))}
    return write_hdus(path, hdus, header, scenario)


def _image(name: str, values: np.ndarray, unit: str, **words: Any) -> fits.ImageHDU:
    hdu = fits.ImageHDU(values)
    for key, value in ({"EXTNAME": name, "BUNIT": unit} | words).items():
        hdu.header[key] = value
    return hdu


def _complex(
    name: str, values: Complex[np.ndarray, "frequencies ports ports"], unit: str
) -> list[fits.ImageHDU]:
    parts = {"real": values.real.copy(), "imag": values.imag.copy()}
    return [_image(f"{name}_{part}", image, unit) for part, image in parts.items()]


def _eigenvalues(
    data: Float[np.ndarray, "times products frequencies"],
) -> Float[np.ndarray, "times frequencies ports"]:
    """Of the covariance of the ports at every time; NaN where a product is missing."""
    covariance = np.moveaxis(to_matrix(np.moveaxis(data, 1, 0)), (0, 1), (2, 3))
    complete = np.isfinite(data).all(1)
    values = np.full((*complete.shape, covariance.shape[-1]), np.nan)
    values[complete] = np.linalg.eigvalsh(covariance[complete])
    return values


def _bytes(parameters: dict[str, tuple[float, ...]]) -> np.ndarray:
    text = json.dumps({name: list(values) for name, values in parameters.items()}, sort_keys=True)
    return np.frombuffer(text.encode(), dtype=np.uint8)
