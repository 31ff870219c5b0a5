"""The paper on the instrument and the simulated data (section 2)."""

from __future__ import annotations

import numpy as np
import xarray as xr

from lusee_bayes.instrument.beams import HemisphereGrid
from lusee_bayes.paper.claims.base import (
    SHOWN_FREQUENCIES,
    SIDEREAL_MONTH_DAYS,
    Cases,
    Claim,
    Verdict,
    bands,
    cross,
    entry,
    frequency_case,
    grade,
    middle,
    registrar,
    span,
)

CLAIMS: list[Claim] = []
claim = registrar(CLAIMS)


@claim("2.3", "4 autos and 6 complex crosses: 16 real products", "the data hold other products")
def _products(cases: Cases) -> Verdict:
    names = [str(name) for name in cases["fiducial"]["product"].values]
    autos = sum(name[0] == name[1] for name in names)
    return grade(
        f"{autos} autos, {len(names) - autos} parts of crosses, {len(names)} in all",
        (autos, len(names)) == (4, 16),
    )


@claim(
    "2.4, fig. 2",
    "beams broaden significantly towards lower frequencies",
    "here the width follows the ground's fringes: a short thin monopole alone has a pattern that "
    "does not depend on frequency; the coupling of the arms and the lander are not modelled",
)
def _broadening(cases: Cases) -> Verdict:
    low, high = (half_power_share(cases[frequency_case(f)]) for f in (5, 45))
    return grade(
        f"above half power: {low:.2f} of the hemisphere at 5 MHz, {high:.2f} at 45 MHz",
        low > 1.2 * high,
        low > high,
    )


def half_power_share(case: xr.Dataset) -> float:
    """Share of the hemisphere where auto 00 exceeds half of its peak."""
    beam = case["beam"].values[0]
    weights = HemisphereGrid.gauss_legendre(*beam.shape).weights
    return float(weights @ (beam > 0.5 * beam.max()).mean(axis=1) / weights.sum())


@claim(
    "2.4, fig. 2",
    "beyond 25 MHz the beam bifurcates",
    "the dip at the zenith grows with frequency, but not past a tenth at each of them",
)
def _bifurcation(cases: Cases) -> Verdict:
    dip = {f: zenith_dip(cases[frequency_case(f)]) for f in SHOWN_FREQUENCIES}
    return grade(
        "zenith below the lobes beside the arm by "
        + ", ".join(f"{100 * d:.0f} % ({f} MHz)" for f, d in dip.items()),
        all((d > 0.1) == (f > 25) for f, d in dip.items()),
        max(dip.values()) == dip[45] and dip[45] > 0.1,
    )


def zenith_dip(case: xr.Dataset) -> float:
    """How far auto 00 at the zenith is below its peak in the plane across the arm (East-West)."""
    beam = case["beam"].values[0]
    across = beam[:, [0, beam.shape[1] // 2]]
    return float(1.0 - beam[0].mean() / max(across.max(), beam[0].mean()))


@claim(
    "2.4",
    "the beam of 11 (North) is skewed North, so 11 and 33 are not degenerate",
    "not degenerate either, but skewed South: an arm 15 degrees above the horizontal is blind "
    "along itself, and no lander turns that round",
)
def _skewness(cases: Cases) -> Verdict:
    skew = [north_moment(case) for case in bands(cases, SHOWN_FREQUENCIES)]
    return grade(
        f"mean northward direction cosine of auto 00: {span(skew, '.2f')}",
        min(skew) > 0.05,
        min(np.abs(skew)) > 0.05,
    )


def north_moment(case: xr.Dataset) -> float:
    """Mean of sin theta sin phi (phi from East to North) over the power of auto 00."""
    beam = case["beam"].values[0]
    weights = HemisphereGrid.gauss_legendre(*beam.shape).weights[:, None] * beam
    north = np.outer(np.sin(case["theta"].values), np.sin(case["phi"].values))
    return float((weights * north).sum() / weights.sum())


@claim(
    "2.4",
    "all 16 products are non-zero and independent",
    "short arms without coupling respond along three directions of space only (arms 0 + 2 point "
    "like 1 + 3), which makes nine products; their length adds some but not all of the others",
)
def _independence(cases: Cases) -> Verdict:
    case = cases["fiducial"]
    signal = case["data"].values / case["noise_std"].values
    rms = np.sqrt((signal**2).mean(axis=1))
    # noise alone gives about 1
    combinations = np.linalg.svd(signal, compute_uv=False) / np.sqrt(signal.shape[1])
    n_independent = int((combinations > 3).sum())
    return grade(
        f"weakest product {rms.min():.0f} sigma rms; {n_independent} independent combinations "
        "above 3 sigma",
        rms.min() > 3 and n_independent == 16,
        rms.min() > 3,
    )


@claim("2.4", "one sidereal rotation, about 27.3 days, sampled every 2 h", "another run was made")
def _duration(cases: Cases) -> Verdict:
    case = cases["fiducial"]
    step = entry(case, "observation.step_s")
    days = case.sizes["time"] * step / 86400
    return grade(
        f"{case.sizes['time']} samples of {step / 3600:g} h: {days:.1f} days",
        abs(days - SIDEREAL_MONTH_DAYS) < 0.15 and step == 7200,
    )


@claim("2.4, 4.2", "the receiver works at high signal to noise", "the noise is not negligible")
def _signal_dominated(cases: Cases) -> Verdict:
    case = cases["fiducial"]
    relative = middle((case["noise_std"] / np.abs(case["data"])).values.ravel())
    return grade(f"median noise over signal {relative:.1e}", relative < 1e-3, relative < 1e-2)


@claim("2.4", "a duty cycle of 50 % raises the noise by sqrt 2", "the noise scales otherwise")
def _duty_noise(cases: Cases) -> Verdict:
    ratio = float((cases["duty_cycle_50"]["noise_std"] / cases["fiducial"]["noise_std"]).mean())
    return grade(f"noise ratio {ratio:.4f}", abs(ratio - np.sqrt(2)) < 1e-3)


@claim(
    "2.4",
    "that does not significantly affect the maps",
    "SNR stays near 1 over many multipoles, so the first one below moves by several though rho "
    "hardly does",
)
def _duty_map(cases: Cases) -> Verdict:
    fiducial, duty = cases["fiducial"], cases["duty_cycle_50"]
    change = float(np.abs(duty["rho"] - fiducial["rho"])[1:21].max())
    return grade(
        f"rho at ell <= 20 moves by at most {change:.3f}, SNR < 1 from ell {cross(duty)} "
        f"(fiducial {cross(fiducial)})",
        change < 0.1 and abs(cross(duty) - cross(fiducial)) <= 3,
        abs(cross(duty) - cross(fiducial)) <= 3,
    )
