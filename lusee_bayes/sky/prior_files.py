"""What a prior can be read from: C_ell in a text file, and a mean sky in a FITS map."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float

from lusee_bayes.core.checks import require_whole
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.harmonics import LARGEST_LMAX
from lusee_bayes.core.layouts import Layout, Variable
from lusee_bayes.core.reading import read_text, require_file
from lusee_bayes.sky.source import read_sky_file

SPECTRUM = Layout(
    "text file of ell and C_ell in K^2",
    {
        "ell": Variable(("line",), "integer", low=0.0, grows=True),
        "C_ell": Variable(("line",), low=0.0),
    },
)


def read_spectrum(path: str | Path, lmax: int) -> Float[np.ndarray, " ells"]:
    """Read C_ell from a text file.

    Each line has ell and C_ell, divided by spaces or a comma; the rest of a line after # is a
    comment, and so is a first line of names.

    Parameters
    ----------
    path : str or Path
    lmax : int
        Highest ell; the file may have more.

    Returns
    -------
    (ells,) array
        C_ell in K^2 for ell = 0..lmax.

    Raises
    ------
    InputError
        If the file cannot be read, a line is not two numbers, C_ell is negative or not finite, or
        zero at every ell, or an ell is missing or not in its place.
    """
    rows: list[list[float]] = []
    named = False
    require_whole("lmax", lmax, 0, LARGEST_LMAX)
    text = read_text(path, SPECTRUM.what, "check prior.spectrum_file")
    for number, line in enumerate(text.splitlines(), start=1):
        words = line.split("#")[0].replace(",", " ").split()
        if not words:
            continue
        try:
            row = [float(word) for word in words]
        except ValueError as error:
            if not rows and not named:
                named = True
                continue
            raise InputError(f"{path}: line {number} is '{line.strip()}', no numbers") from error
        if len(row) != 2 or not row[0].is_integer():
            raise InputError(
                f"{path}: line {number} is '{line.strip()}', expected ell and C_ell in K^2"
            )
        rows.append(row)
    if not rows:
        raise InputError(f"{path} holds no numbers; expected {SPECTRUM.what}")
    table = np.array(rows)
    columns = {"ell": table[:, 0].astype(np.int64), "C_ell": table[:, 1]}
    found = SPECTRUM.checked(path, columns, {}).arrays
    there = set(found["ell"].tolist())
    missing = [ell for ell in range(lmax + 1) if ell not in there]
    if missing:
        several = f" and {len(missing) - 1} more up to lmax = {lmax}" if len(missing) > 1 else ""
        raise InputError(
            f"{path} has no C_ell at ell = {missing[0]}{several}; give every ell from 0 to lmax, "
            "or lower lmax"
        )
    spectrum = found["C_ell"][: lmax + 1]
    if not spectrum.any():
        raise InputError(f"{path}: C_ell is zero at every ell up to {lmax}; a prior needs variance")
    return spectrum


def read_mean(path: str | Path, frequency_mhz: float, lmax: int) -> Float[np.ndarray, " modes"]:
    """Read a prior's mean sky: a HEALPix FITS map, or any other file of skies.

    Parameters
    ----------
    path : str or Path
    frequency_mhz : float
        For files that say their frequencies.
    lmax : int
        Highest ell of the map's coefficients that are used.

    Returns
    -------
    (modes,) array
        Galactic, real packed, in K.

    Raises
    ------
    InputError
        If the file cannot be used, or is too coarse.
    """
    path = require_file(path, "mean map of the prior", "check prior.mean_file")
    return read_sky_file(path).modes_at(frequency_mhz, lmax)
