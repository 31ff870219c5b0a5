"""What info says of maps and cubes of the sky, as lines; it needs few libraries."""

from __future__ import annotations

from pathlib import Path

from lusee_bayes.core.formats import is_fits, opened
from lusee_bayes.sky.sky_source import read_sky_file


def describe_sky(path: Path) -> list[str]:
    """A sky map, cube or coefficients."""
    return [*read_sky_file(path).summary(), *(_describe_cards(path) if is_fits(path) else [])]


def _describe_cards(path: Path) -> list[str]:
    """What a FITS file of the package says of itself."""
    with opened(path) as hdus:
        headers = [hdu.header for hdu in hdus if "SCENHASH" in hdu.header]
        if not headers:
            return []
        (header, *_) = headers
        at = f" at {header['FREQ']:g} MHz" if "FREQ" in header else ""
        return [
            f"{header['CONTENT']} of the posterior{at} up to ell = {header['LMAX']}, beam "
            f"{header['BEAM']}, site {header['SITELON']:g}, {header['SITELAT']:g} degrees",
            f"{header['CREATOR']}, scenario {header['SCENHASH'][:12]}",
        ]
