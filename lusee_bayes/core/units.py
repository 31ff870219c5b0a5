"""Units that files may state for the quantities that they hold, and the mistake of Hz for MHz."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from lusee_bayes.core.errors import InputError

# for each unit of the package, what a file may state instead, with the factor to it
UNITS: Mapping[str, Mapping[str, float]] = {
    "K": {"K": 1.0, "kelvin": 1.0, "Kelvin": 1.0, "mK": 1e-3, "kK": 1e3},
    "V^2/Hz": dict.fromkeys(("V^2/Hz", "V**2/Hz", "V2/Hz", "V2 Hz-1", "V2 / Hz"), 1.0),
    "MHz": {"MHz": 1.0, "kHz": 1e-3, "Hz": 1e-6, "GHz": 1e3},
    "Ohm": dict.fromkeys(("Ohm", "ohm"), 1.0),
    "deg": dict.fromkeys(("deg", "degree", "degrees"), 1.0),
    "m": {"m": 1.0},
    "d": {"d": 1.0},
}
# what software writes that was not given a word or a unit, in lower case
UNSTATED = ("", "unknown", "unspecified", "none")
# LuSEE-Night ends at 50 MHz; what is larger was meant in Hz or kHz
LARGEST_MHZ = 1000.0
NOT_HZ = f"expected at most {LARGEST_MHZ:g} MHz; is this Hz? Divide by 1e6"


def factor_to(where: str, unit: str, stated: Any) -> float:
    """Return the factor from the unit that a file states to the package's.

    Parameters
    ----------
    where : str
        The file and its variable, for the message.
    unit : str
        The package's, of :data:`UNITS`; empty for a quantity without one.
    stated : object
        The file's; None or one of :data:`UNSTATED` if it states none: then it is the package's.

    Raises
    ------
    InputError
        If it is another quantity's unit, or unknown.
    """
    stated = stated.decode(errors="replace") if isinstance(stated, bytes) else stated
    text = "" if stated is None else str(stated).strip()
    if not unit or text.lower() in UNSTATED:
        return 1.0
    if text not in UNITS[unit]:
        raise InputError(
            f"{where} has the unit '{text}', expected one of {', '.join(UNITS[unit])}; convert it, "
            "and correct the unit"
        )
    return UNITS[unit][text]


def require_mhz(where: str, mhz: Any) -> None:
    """Check that frequencies may be in MHz. InputError if one is so high that it must be in Hz."""
    largest = float(np.max(mhz))
    if largest > LARGEST_MHZ:
        raise InputError(f"{where}: got {largest:g} MHz, {NOT_HZ}")
