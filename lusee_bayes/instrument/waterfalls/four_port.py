"""Waterfalls of luseepy's four-port simulator: covariances at the receivers' inputs, in V^2/Hz.

FITS version 3: image ``data`` (time, product, frequency); ``freq`` in MHz; ``time`` (JD1, JD2) in
the scale TIMESYS; table ``products`` with a column ``label``; U (frequency, port, port), the
covariance that an enclosure of 1 K makes, as ``blackbody_normalization``; the receivers' loads ZL
(frequency, port, port) in Ohm. Header: LUN_LAT_DEG, LUN_LONG_DEG, DELTAT_SEC, TMOON_K, TANT_K and
FREQINT, the interpolation of the response between its frequencies. Divided by sqrt(U_aa U_bb),
visibilities are in K.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from lusee_bayes.core.checks import require_positive
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.formats import read_fits
from lusee_bayes.core.layouts import Attribute, Layout, Variable
from lusee_bayes.core.reading import naming
from lusee_bayes.instrument.beams.gridded import Interpolation
from lusee_bayes.instrument.beams.receiver import LOADS, MeasuredReceiver
from lusee_bayes.instrument.observation import Observation
from lusee_bayes.instrument.products import N_ANTENNAS, all_products, labels
from lusee_bayes.instrument.times import scale_of, utc_of
from lusee_bayes.instrument.waterfalls.waterfall import SITE_AND_STEP, Waterfall

UNIT = "V^2/Hz"
# what FREQINT calls the interpolation of responses between their frequencies
INTERPOLATIONS: dict[Interpolation, str] = {"linear": "linear-native-alm", "spline": "cubic-spline"}
LAYOUT = Layout(
    "a waterfall of luseepy's four-port simulator",
    {
        "freq": Variable(("freq",), low=0.0, grows=True, unit="MHz"),
        "time": Variable(("time", 2), unit="d"),
        "products.label": Variable(("product",), "text"),
        # NaN where a sample is missing
        "data": Variable(("time", "product", "freq"), finite=False, unit=UNIT),
        "blackbody_normalization_real": Variable(("freq", N_ANTENNAS, N_ANTENNAS)),
        **{
            name: Variable(("freq", N_ANTENNAS, N_ANTENNAS), optional=True, unit="Ohm")
            for name in LOADS
        },
    },
    {
        **SITE_AND_STEP,
        "TMOON_K": Attribute(low=0.0),
        "TANT_K": Attribute(low=0.0, optional=True),
        "TIMESYS": Attribute("text", optional=True),
        "TIMEUNIT": Attribute("text", choices=("d",), optional=True),
        "FREQINT": Attribute("text", optional=True),
        "BUNIT": Attribute("text", choices=(UNIT,)),
    },
)


def read_four_port(path: Path) -> Waterfall:
    """Read a waterfall of luseepy's four-port simulator.

    Parameters
    ----------
    path : Path

    Returns
    -------
    Waterfall

    Raises
    ------
    InputError
        For a truncated file, a missing image or header entry, shapes or a unit that do not fit,
        unknown products, or times that do not grow.
    """
    found = read_fits(path, LAYOUT)
    images, said = found.arrays, found.values
    data, frequencies = images["data"], images["freq"]
    places = _places(path, images["products.label"])
    enclosure = images["blackbody_normalization_real"]
    per_kelvin = enclosure.diagonal(axis1=1, axis2=2)
    require_positive(f"{path}: the diagonal of blackbody_normalization_real", per_kelvin)
    root = np.sqrt(per_kelvin)
    grid = np.full((len(all_products()), len(data), len(frequencies)), np.nan)
    for column, place in enumerate(places):
        product = all_products()[place]
        grid[place] = data[:, column] / (root[:, product.i] * root[:, product.j])
    return Waterfall(
        str(path),
        grid,
        frequencies,
        _observation(path, said, images["time"]),
        per_kelvin,
        said["TMOON_K"],
        said.get("TANT_K", 0.0),
        _receiver(path, images),
        said.get("FREQINT"),
    )


def _receiver(path: Path, images: dict[str, np.ndarray]) -> MeasuredReceiver | None:
    if not set(LOADS) <= set(images):
        return None
    real, imaginary = (images[name] for name in LOADS)
    return MeasuredReceiver(str(path), images["freq"], real + 1j * imaginary)


def _places(path: Path, products: np.ndarray) -> list[int]:
    """The number of the product in each column, in the package's order."""
    named, known = [str(label).strip() for label in products], labels()
    for label in named:
        if label not in known:
            raise InputError(
                f"{path}: there is no product '{label}'; expected some of {', '.join(known)}"
            )
    if len(set(named)) < len(named):
        raise InputError(f"{path}: products names the same product twice")
    return [known.index(label) for label in named]


def _observation(
    path: Path, said: dict[str, Any], times: Float[np.ndarray, "times 2"]
) -> Observation:
    with naming(path):
        scale = scale_of("TIMESYS", said.get("TIMESYS", "UTC"))
        return Observation(
            said["LUN_LONG_DEG"],
            said["LUN_LAT_DEG"],
            utc_of(times[:, 0], times[:, 1], scale),
            np.zeros(len(times), dtype=int),
            (0.0,),
            said["DELTAT_SEC"],
        )
