"""What the headers of luseepy's beam files state about their own conventions.

A word that is absent, or "UNKNOWN", as luseepy writes where it was not given any, states nothing.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lusee_bayes.core.errors import InputError, nearest
from lusee_bayes.core.layouts import UNSTATED

# what this package assumes of the images, in lower case
CONVENTIONS: Mapping[str, str] = {
    "TIMECONV": "e+jwt",
    "COORDSYS": "instrument-topocentric",
    "THETADEF": "colatitude-from-+z",
    "PHIDEF": "right-handed-about-+z",
    "OMEGADEF": "source-arrival-direction",
    "POLBASIS": "e_theta,e_phi",
    "PORTS": "0123",
    "CANONICAL": "h[m],si-rms",
}
# of responses: what luseepy has converted to effective lengths in m, and how, by NORM_KIND
SOURCES = ("NORM_KIND", "INPUT_KIND", "FIELD_KIND", "FIELD_UNIT")
CONVERTED: Mapping[str, tuple[str, str, tuple[str, ...]]] = {
    "already-effective-length": ("bare", "effective-length", ("m",)),
    "already-per-ampere": ("bare", "re-per-current", ("v/a", "mv/a")),
    "current": ("bare", "re", ("v", "mv")),
    "vsource": ("embedded", "re", ("v", "mv")),
    "unloaded-zl": ("loaded", "effective-length", ("m",)),
}


def require_conventions(path: str | Path, said: Mapping[str, Any]) -> None:
    """Check the words of a header against what this package assumes.

    Parameters
    ----------
    path : str or Path
        The file, for the message.
    said : mapping of str to str
        Its words.

    Raises
    ------
    InputError
        If one contradicts it.
    """
    stated = {key: str(value).strip().lower() for key, value in said.items()}
    stated = {key: text for key, text in stated.items() if text not in UNSTATED}
    kind = stated.get("NORM_KIND", "already-effective-length")
    if kind not in CONVERTED:
        raise InputError(f"{path}: NORM_KIND is '{kind}'; {nearest(kind, CONVERTED)}")
    source = dict(zip(SOURCES[1:], CONVERTED[kind], strict=True))
    for key, expected in (CONVENTIONS | source).items():
        allowed = (expected,) if isinstance(expected, str) else expected
        if key in stated and stated[key] not in allowed:
            raise InputError(
                f"{path}: {key} is '{said[key]}', expected '{' or '.join(allowed)}'; convert the "
                "file with luseepy, or correct its header"
            )
