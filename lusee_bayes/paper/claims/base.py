"""What the paper claims, and how each claim is judged from the computed cases.

A claim's judge turns the cases into what was obtained and whether that agrees: yes, partly or no,
by the two conditions given to :func:`grade`. Every number in it is computed here from the cases.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import xarray as xr
from jaxtyping import Bool, Float, Shaped

from lusee_bayes.core.reading import parse_yaml
from lusee_bayes.linear.metrics import ell_cross

Cases = Mapping[str, xr.Dataset]

FREQUENCIES = tuple(range(5, 51, 5))
SHOWN_FREQUENCIES = (5, 15, 25, 35, 45)
SIDEREAL_MONTH_DAYS = 27.3


@dataclass(frozen=True)
class Verdict:
    """What was obtained, and whether it agrees with the paper: yes, partly or no."""

    obtained: str
    agrees: str


@dataclass(frozen=True)
class Claim:
    """Where the paper says what, how it is judged, and why it may fail with this beam and sky."""

    section: str
    statement: str
    otherwise: str
    judge: Callable[[Cases], Verdict]


Judge = Callable[[Cases], Verdict]


def registrar(claims: list[Claim]) -> Callable[[str, str, str], Callable[[Judge], Judge]]:
    """A decorator ``claim(section, statement, otherwise)`` that adds its judge to ``claims``."""

    def claim(section: str, statement: str, otherwise: str) -> Callable[[Judge], Judge]:
        def register(judge: Judge) -> Judge:
            claims.append(Claim(section, statement, otherwise, judge))
            return judge

        return register

    return claim


def grade(obtained: str, agrees: bool | np.bool_, partly: bool | np.bool_ = False) -> Verdict:
    """A verdict; a NaN in a condition makes it false."""
    return Verdict(obtained, "yes" if agrees else "partly" if partly else "no")


def frequency_case(frequency_mhz: int) -> str:
    """Name of the fiducial experiment's case at a frequency."""
    return "fiducial" if frequency_mhz == 25 else f"at_{frequency_mhz}MHz"


def bands(cases: Cases, frequencies: tuple[int, ...] = FREQUENCIES) -> list[xr.Dataset]:
    """The fiducial experiment at the frequencies."""
    return [cases[frequency_case(f)] for f in frequencies]


def cross(case: xr.Dataset) -> int:
    """First ell >= 1 with SNR < 1; lmax + 1 if there is none."""
    first = ell_cross(case["snr"].values)
    return case.sizes["ell"] if first is None else first


def first_below(values: Float[np.ndarray, " ells"], level: float) -> int:
    """First ell >= 1 where ``values`` fall below ``level``; lmax + 1 if nowhere."""
    below = np.flatnonzero(~(values[1:] >= level))
    return int(below[0]) + 1 if below.size else values.size


def middle(values: Shaped[np.ndarray, " n"]) -> float:
    """Median, NaN for nothing at all (ells beyond lmax)."""
    return float(np.median(values)) if values.size else float("nan")


def snr_ratio(cases: Cases, name: str, low: int, high: int) -> float:
    """Median over low <= ell <= high of a case's SNR over the fiducial one."""
    return middle((cases[name]["snr"].values / cases["fiducial"]["snr"].values)[low : high + 1])


def power_ratio(case: xr.Dataset, low: int, high: int) -> float:
    """Median over low <= ell <= high of the map's power over the true sky's."""
    return middle((case["cl_mean"].values / case["cl_truth"].values)[low : high + 1])


def observed(case: xr.Dataset) -> Bool[np.ndarray, " pixels"]:
    """Pixels that were ever above the horizon."""
    return case["highest_altitude"].values > 0


def residual_percent(case: xr.Dataset) -> float:
    """Median over the observed sky of |mean - truth|, in per cent of the true mean."""
    mean, truth = case["mean"].values, case["truth"].values
    return 100.0 * middle(np.abs(mean - truth)[observed(case)]) / float(truth.mean())


def likeness(case: xr.Dataset) -> float:
    """Correlation of map and truth over the observed pixels, means removed."""
    seen = observed(case)
    return float(np.corrcoef(case["mean"].values[seen], case["truth"].values[seen])[0, 1])


def span(values: list[float] | list[int], form: str = "d") -> str:
    """The least and the greatest, as text."""
    return f"{min(values):{form}} to {max(values):{form}}"


def entry(case: xr.Dataset, path: str) -> float:
    """An entry of the case's scenario, by its path with dots."""
    node = parse_yaml(case.attrs["scenario"], "the scenario of a case")
    for key in path.split("."):
        node = node[int(key)] if isinstance(node, list) else node[key]
    return float(node)
