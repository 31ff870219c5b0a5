"""The paper on the recovered maps, their resolution and fidelity (sections 4, 4.1, 4.2)."""

from __future__ import annotations

import numpy as np
from astropy import units as u
from astropy.coordinates import SkyCoord

from lusee_bayes.core.lazy import healpy
from lusee_bayes.paper.claims.base import (
    SHOWN_FREQUENCIES,
    Cases,
    Claim,
    Verdict,
    bands,
    cross,
    entry,
    first_below,
    frequency_case,
    grade,
    likeness,
    middle,
    observed,
    power_ratio,
    registrar,
    residual_percent,
    span,
)

CLAIMS: list[Claim] = []
claim = registrar(CLAIMS)


@claim("4", "lmax = 47 is a resolution of 3.8 degrees", "another lmax was asked for")
def _lmax_resolution(cases: Cases) -> Verdict:
    degrees = 180 / entry(cases["fiducial"], "lmax")
    return grade(f"180 / lmax = {degrees:.2f} degrees", abs(degrees - 3.8) < 0.05)


@claim("4", "N_modes ~ lmax^2 is smaller than N_data", "there are fewer data than modes")
def _overdetermined(cases: Cases) -> Verdict:
    data, modes = (int(cases["fiducial"].attrs[key]) for key in ("n_data", "n_modes"))
    return grade(f"{modes} modes, {data} data", modes < data)


@claim(
    "4",
    "with C_0 of the sky the mean temperature is robustly recovered",
    "most of the error is in the cap that is never observed, whose mean the data do not constrain",
)
def _mean_temperature(cases: Cases) -> Verdict:
    off = [100 * abs(float(c["mean"].mean() / c["truth"].mean()) - 1) for c in bands(cases)]
    seen = [
        100 * abs(float(c["mean"][observed(c)].mean() / c["truth"][observed(c)].mean()) - 1)
        for c in bands(cases)
    ]
    return grade(
        f"off by {span(off, '.2f')} % at 5 to 50 MHz (over the observed sky {span(seen, '.2f')} %)",
        max(off) < 1,
        max(off) < 5,
    )


@claim(
    "4",
    "the prior S has a minor impact in the signal-dominated regime",
    "some large scales rest on the prior",
)
def _prior_impact(cases: Cases) -> Verdict:
    change = float(np.abs(cases["prior_x10"]["rho"] - cases["fiducial"]["rho"])[1:11].max())
    return grade(
        f"ten times the prior variance moves rho at ell <= 10 by at most {change:.4f}",
        change < 0.02,
        change < 0.1,
    )


@claim(
    "4.1",
    "large-scale features are recovered at 5 to 45 MHz",
    "at some frequency the beams constrain less",
)
def _features(cases: Cases) -> Verdict:
    alike = [likeness(case) for case in bands(cases, SHOWN_FREQUENCIES)]
    return grade(
        f"correlation of the maps with the truth {span(alike, '.3f')}",
        min(alike) > 0.9,
        min(alike) > 0.7,
    )


@claim(
    "4.1",
    "differences are more noticeable at lower frequencies",
    "the embedded beam is not broadest at low frequency, where the ground's fringes are wide",
)
def _low_frequencies(cases: Cases) -> Verdict:
    low, high = (residual_percent(cases[frequency_case(f)]) for f in (5, 45))
    return grade(
        f"median |residual| {low:.1f} % of the mean at 5 MHz, {high:.1f} % at 45 MHz", low > high
    )


@claim(
    "4.1, fig. 4",
    "residuals are typically a few per cent of the mean",
    "the bright plane holds structure beyond the resolution reached, which the map lacks",
)
def _residuals(cases: Cases) -> Verdict:
    percent = [residual_percent(case) for case in bands(cases, SHOWN_FREQUENCIES)]
    return grade(
        f"median |residual| {span(percent, '.1f')} % at 5 to 45 MHz",
        max(percent) < 5,
        max(percent) < 10,
    )


@claim(
    "4.1",
    "about 24 degrees round the North Celestial Pole are unobserved",
    "the cap has that radius, but the orientation from the ephemeris puts it round the Moon's own "
    "pole, next to the ecliptic pole and not the Earth's",
)
def _unobserved_cap(cases: Cases) -> Verdict:
    hidden = ~observed(cases["fiducial"])
    nside = healpy.npix2nside(hidden.size)
    radius = float(np.degrees(np.arccos(1 - 2 * hidden.mean())))
    centre = np.array(healpy.pix2vec(nside, np.flatnonzero(hidden))).sum(axis=1)
    pole = SkyCoord(0 * u.deg, 90 * u.deg, frame="icrs").galactic.cartesian.xyz.value
    away = float(np.degrees(np.arccos(centre @ pole / max(np.linalg.norm(centre), 1e-30))))
    return grade(
        f"a cap of {radius:.1f} degrees, its centre {away:.1f} degrees from that pole",
        abs(radius - 24) < 1.5 and away < 3,
        abs(radius - 24) < 1.5,
    )


@claim(
    "4.2, fig. 5",
    "rho > 0.9 for ell <~ 10 in all bands",
    "a few low multipoles of this sky have little power of their own",
)
def _rho_large_scales(cases: Cases) -> Verdict:
    first = [first_below(case["rho"].values, 0.9) for case in bands(cases)]
    return grade(
        f"first ell below 0.9: {span(first)} at 5 to 50 MHz", min(first) >= 10, min(first) >= 7
    )


@claim(
    "4.2, fig. 5",
    "rho > 0.5 up to ell ~ 20-35 in all bands",
    "single multipoles dip below earlier, where the embedded ground's fringes weaken the beams",
)
def _rho_small_scales(cases: Cases) -> Verdict:
    first = [first_below(case["rho"].values, 0.5) for case in bands(cases)]
    return grade(
        f"first ell below 0.5: {span(first)} at 5 to 50 MHz",
        min(first) >= 20,
        middle(np.array(first)) >= 20,
    )


@claim(
    "4.2, fig. 6",
    "SNR > 1 up to ell ~ 20 in all bands",
    "single multipoles dip below earlier, where the embedded ground's fringes weaken the beams",
)
def _snr_above_one(cases: Cases) -> Verdict:
    first = [cross(case) for case in bands(cases)]
    return grade(
        f"first ell below 1: {span(first)}, median {middle(np.array(first)):g}",
        min(first) >= 18,
        middle(np.array(first)) >= 18,
    )


@claim(
    "4.2",
    "beyond ell ~ 20-35 the filter pulls the map to zero",
    "the data still constrain these scales",
)
def _suppression(cases: Cases) -> Verdict:
    inside = [power_ratio(case, 1, 15) for case in bands(cases)]
    beyond = [power_ratio(case, 36, 47) for case in bands(cases)]
    return grade(
        f"map over true power: {span(inside, '.2f')} at ell <= 15, {span(beyond, '.2f')} at "
        "ell > 35",
        max(beyond) < 0.5 < min(inside),
        max(beyond) < min(inside),
    )


@claim(
    "2.4, 4.2",
    "reconstruction is robust to ten times the noise variance, smoother in fine detail",
    "the fiducial map already lives on modes of low signal to noise, which ten times the noise "
    "takes away",
)
def _noise_x10(cases: Cases) -> Verdict:
    case = cases["noise_x10"]
    low = first_below(case["rho"].values, 0.9)
    drop = cross(cases["fiducial"]) - cross(case)
    fine = power_ratio(case, 25, 47) / power_ratio(cases["fiducial"], 25, 47)
    return grade(
        f"rho > 0.9 below ell {low}, SNR < 1 {drop} multipoles earlier, power at ell >= 25 times "
        f"{fine:.2f}",
        low >= 10 and abs(drop) <= 5 and fine < 1,
        low >= 10 and abs(drop) <= 10,
    )


@claim(
    "4.2",
    "at 100 times the noise only the brightest, largest features remain",
    "more remains: the largest scales are measured far above the noise",
)
def _noise_x100(cases: Cases) -> Verdict:
    case = cases["noise_x100"]
    large, fine = middle(case["rho"].values[1:6]), power_ratio(case, 25, 47)
    return grade(
        f"rho {large:.3f} at ell <= 5; map over true power {fine:.2f} at ell >= 25",
        large > 0.9 and fine < 0.2,
        large > 0.9 and fine < power_ratio(cases["fiducial"], 25, 47),
    )


@claim(
    "4.2, 5",
    "effective resolution of ell ~ 20-35, 5 to 10 degrees, over 5-50 MHz",
    "where SNR stays near 1 over many multipoles, the first one below it depends on the noise draw",
)
def _resolution(cases: Cases) -> Verdict:
    first = [cross(case) for case in bands(cases)]
    inside = sum(18 <= ell <= 37 for ell in first)
    degrees = [180 / ell for ell in first]
    return grade(
        f"SNR < 1 from ell {span(first)}, {span(degrees, '.1f')} degrees; {inside} of "
        f"{len(first)} bands in the range",
        inside == len(first),
        2 * inside >= len(first),
    )


@claim(
    "abstract, 5",
    "high rho and SNR > 1 up to ell ~ 35: a resolution of about 5 degrees",
    "the fiducial cycle reaches the lower part of the paper's own range of 20-35",
)
def _five_degrees(cases: Cases) -> Verdict:
    best = max(cross(case) for case in bands(cases))
    longest = cross(cases["three_cycles"])
    return grade(
        f"best band ell {best} ({180 / best:.1f} degrees); three cycles at 25 MHz: {longest} "
        f"({180 / longest:.1f} degrees)",
        best >= 32,
        max(best, longest) >= 25,
    )
