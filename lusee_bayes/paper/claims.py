"""Tests of the paper's quantitative claims, which are listed in claims.yaml.

A claim's judge computes a result from the cases, and decides whether it agrees: yes, partly or no,
by the two conditions given to :func:`grade`. All numbers are computed here from the cases.
"""

from collections.abc import Mapping

import numpy as np
import xarray as xr
from astropy.coordinates import SkyCoord
from jaxtyping import Bool, Float, Shaped

from lusee_bayes.core import lazy, reading
from lusee_bayes.instrument.beams.fields import HemisphereGrid

Cases = Mapping[str, xr.Dataset]

FREQUENCIES = tuple(range(5, 51, 5))
SHOWN_FREQUENCIES = (5, 15, 25, 35, 45)
SIDEREAL_MONTH_DAYS = 27.3


# each with its section, what the paper says, why it may fail here (``otherwise``), and the function
# of this module that judges it, without its underscore
CLAIMS = reading.table_beside(__file__)
# the result obtained, and whether it agrees with the paper: yes, partly or no
Verdict = dict[str, str]


def grade(obtained: str, agrees: bool | np.bool_, partly: bool | np.bool_ = False) -> Verdict:
    """A verdict; a NaN in a condition makes it false."""
    return {"obtained": obtained, "agrees": "yes" if agrees else "partly" if partly else "no"}


def frequency_case(frequency_mhz: int) -> str:
    """Name of the fiducial experiment's case at some frequency."""
    return "fiducial" if frequency_mhz == 25 else f"at_{frequency_mhz}MHz"


def bands(cases: Cases, frequencies: tuple[int, ...] = FREQUENCIES) -> list[xr.Dataset]:
    """Cases of the fiducial experiment at these frequencies."""
    return [cases[frequency_case(f)] for f in frequencies]


def cross(case: xr.Dataset) -> int:
    """First ell >= 1 with SNR < 1; lmax + 1 if there is none."""
    return first_below(case["snr"].values, 1.0)


def first_below(values: Float[np.ndarray, " ells"], level: float) -> int:
    """First ell >= 1 at which ``values`` fall below ``level``; lmax + 1 if there is none."""
    below = np.flatnonzero(~(values[1:] >= level))
    return int(below[0]) + 1 if below.size else values.size


def middle(values: Shaped[np.ndarray, " n"]) -> float:
    """Median; NaN for no values (ells beyond lmax)."""
    return float(np.median(values)) if values.size else float("nan")


def snr_ratio(cases: Cases, name: str, low: int, high: int) -> float:
    """Median over low <= ell <= high of a case's SNR relative to the fiducial one."""
    return middle((cases[name]["snr"].values / cases["fiducial"]["snr"].values)[low : high + 1])


def power_ratio(case: xr.Dataset, low: int, high: int) -> float:
    """Median over low <= ell <= high of the map's power relative to the true sky's."""
    return middle((case["cl_mean"].values / case["cl_truth"].values)[low : high + 1])


def ever_up(case: xr.Dataset) -> Bool[np.ndarray, " pixels"]:
    """Pixels that were ever above the horizon."""
    return case["highest_altitude"].values > 0


def residual_percent(case: xr.Dataset) -> float:
    """Median of |mean - truth| over the observed sky, in per cent of the true sky's mean."""
    mean, truth = case["mean"].values, case["truth"].values
    return 100.0 * middle(np.abs(mean - truth)[ever_up(case)]) / float(truth.mean())


def likeness(case: xr.Dataset) -> float:
    """Correlation of map and truth over the observed pixels, with means removed."""
    seen = ever_up(case)
    return float(np.corrcoef(case["mean"].values[seen], case["truth"].values[seen])[0, 1])


def span(values: list[float] | list[int], form: str = "d") -> str:
    """The smallest and the largest value, as text."""
    return f"{min(values):{form}} to {max(values):{form}}"


def entry(case: xr.Dataset, path: str) -> float:
    """An entry of the case's scenario, by its dotted path."""
    node = reading.parse_yaml(case.attrs["scenario"], "the scenario of a case")
    for key in path.split("."):
        node = node[key]
    return float(node)


def _products(cases: Cases) -> Verdict:
    names = [str(name) for name in cases["fiducial"]["product"].values]
    autos = sum(name[0] == name[1] for name in names)
    text = f"{autos} autos, {len(names) - autos} parts of crosses, {len(names)} in all"
    return grade(text, (autos, len(names)) == (4, 16))


def _broadening(cases: Cases) -> Verdict:
    low, high = (half_power_share(cases[frequency_case(f)]) for f in (5, 45))
    text = f"above half power: {low:.2f} of the hemisphere at 5 MHz, {high:.2f} at 45 MHz"
    return grade(text, low > 1.2 * high, low > high)


def half_power_share(case: xr.Dataset) -> float:
    """Share of the hemisphere where auto 00 exceeds half of its peak."""
    beam = case["beam"].values[0]
    weights = HemisphereGrid.gauss_legendre(*beam.shape).weights
    return float(weights @ (beam > 0.5 * beam.max()).mean(axis=1) / weights.sum())


def _bifurcation(cases: Cases) -> Verdict:
    dip = {f: zenith_dip(cases[frequency_case(f)]) for f in SHOWN_FREQUENCIES}
    by = ", ".join(f"{100 * d:.0f} % ({f} MHz)" for f, d in dip.items())
    text = f"zenith below the lobes beside the arm by {by}"
    above_25 = all((d > 0.1) == (f > 25) for f, d in dip.items())
    return grade(text, above_25, max(dip.values()) == dip[45] and dip[45] > 0.1)


def zenith_dip(case: xr.Dataset) -> float:
    """How far auto 00 at the zenith is below its peak in the plane across the arm (East-West)."""
    beam = case["beam"].values[0]
    return float(1.0 - beam[0].mean() / max(beam[:, [0, beam.shape[1] // 2]].max(), beam[0].mean()))


def _skewness(cases: Cases) -> Verdict:
    skew = [north_moment(case) for case in bands(cases, SHOWN_FREQUENCIES)]
    text = f"mean northward direction cosine of auto 00: {span(skew, '.2f')}"
    return grade(text, min(skew) > 0.05, min(np.abs(skew)) > 0.05)


def north_moment(case: xr.Dataset) -> float:
    """Mean of sin theta sin phi (phi from East to North) over the power of auto 00."""
    beam = case["beam"].values[0]
    weights = HemisphereGrid.gauss_legendre(*beam.shape).weights[:, None] * beam
    north = np.outer(np.sin(case["theta"].values), np.sin(case["phi"].values))
    return float((weights * north).sum() / weights.sum())


def _independence(cases: Cases) -> Verdict:
    case = cases["fiducial"]
    signal = case["data"].values / case["noise_std"].values
    rms = np.sqrt((signal**2).mean(axis=1))
    # noise alone gives about 1
    combinations = np.linalg.svd(signal, compute_uv=False) / np.sqrt(signal.shape[1])
    n_independent = int((combinations > 3).sum())
    text = f"weakest product {rms.min():.0f} sigma rms; "
    text += f"{n_independent} independent combinations above 3 sigma"
    return grade(text, rms.min() > 3 and n_independent == 16, rms.min() > 3)


def _duration(cases: Cases) -> Verdict:
    case = cases["fiducial"]
    step = entry(case, "observation.step_s")
    days = case.sizes["time"] * step / 86400
    text = f"{case.sizes['time']} samples of {step / 3600:g} h: {days:.1f} days"
    return grade(text, abs(days - SIDEREAL_MONTH_DAYS) < 0.15 and step == 7200)


def _signal_dominated(cases: Cases) -> Verdict:
    case = cases["fiducial"]
    relative = middle((case["noise_std"] / np.abs(case["data"])).values.ravel())
    return grade(f"median noise over signal {relative:.1e}", relative < 1e-3, relative < 1e-2)


def _duty_noise(cases: Cases) -> Verdict:
    ratio = float((cases["duty_cycle_50"]["noise_std"] / cases["fiducial"]["noise_std"]).mean())
    return grade(f"noise ratio {ratio:.4f}", abs(ratio - np.sqrt(2)) < 1e-3)


def _duty_map(cases: Cases) -> Verdict:
    fiducial, duty = cases["fiducial"], cases["duty_cycle_50"]
    change = float(np.abs(duty["rho"] - fiducial["rho"])[1:21].max())
    near = abs(cross(duty) - cross(fiducial)) <= 3
    text = f"rho at ell <= 20 moves by at most {change:.3f}, "
    text += f"SNR < 1 from ell {cross(duty)} (fiducial {cross(fiducial)})"
    return grade(text, change < 0.1 and near, near)


def _lmax_resolution(cases: Cases) -> Verdict:
    degrees = 180 / entry(cases["fiducial"], "lmax")
    return grade(f"180 / lmax = {degrees:.2f} degrees", abs(degrees - 3.8) < 0.05)


def _overdetermined(cases: Cases) -> Verdict:
    data, modes = (int(cases["fiducial"].attrs[key]) for key in ("n_data", "n_modes"))
    return grade(f"{modes} modes, {data} data", modes < data)


def _mean_temperature(cases: Cases) -> Verdict:
    pairs = [(case["mean"], case["truth"], ever_up(case)) for case in bands(cases)]
    off = [100 * abs(float(mean.mean() / truth.mean()) - 1) for mean, truth, _ in pairs]
    seen = [100 * abs(float(mean[up].mean() / truth[up].mean()) - 1) for mean, truth, up in pairs]
    text = f"off by {span(off, '.2f')} % at 5 to 50 MHz "
    text += f"(over the observed sky {span(seen, '.2f')} %)"
    return grade(text, max(off) < 1, max(off) < 5)


def _prior_impact(cases: Cases) -> Verdict:
    change = float(np.abs(cases["prior_x10"]["rho"] - cases["fiducial"]["rho"])[1:11].max())
    text = f"ten times the prior variance moves rho at ell <= 10 by at most {change:.4f}"
    return grade(text, change < 0.02, change < 0.1)


def _features(cases: Cases) -> Verdict:
    alike = [likeness(case) for case in bands(cases, SHOWN_FREQUENCIES)]
    text = f"correlation of the maps with the truth {span(alike, '.3f')}"
    return grade(text, min(alike) > 0.9, min(alike) > 0.7)


def _low_frequencies(cases: Cases) -> Verdict:
    low, high = (residual_percent(cases[frequency_case(f)]) for f in (5, 45))
    text = f"median |residual| {low:.1f} % of the mean at 5 MHz, {high:.1f} % at 45 MHz"
    return grade(text, low > high)


def _residuals(cases: Cases) -> Verdict:
    percent = [residual_percent(case) for case in bands(cases, SHOWN_FREQUENCIES)]
    text = f"median |residual| {span(percent, '.1f')} % at 5 to 45 MHz"
    return grade(text, max(percent) < 5, max(percent) < 10)


def _unobserved_cap(cases: Cases) -> Verdict:
    hidden = ~ever_up(cases["fiducial"])
    nside = lazy.healpy.npix2nside(hidden.size)
    radius = float(np.degrees(np.arccos(1 - 2 * hidden.mean())))
    centre = np.array(lazy.healpy.pix2vec(nside, np.flatnonzero(hidden))).sum(axis=1)
    pole = SkyCoord(0, 90, unit="deg", frame="icrs").galactic.cartesian.xyz.value
    away = float(np.degrees(np.arccos(centre @ pole / max(np.linalg.norm(centre), 1e-30))))
    text = f"a cap of {radius:.1f} degrees, its centre {away:.1f} degrees from that pole"
    return grade(text, abs(radius - 24) < 1.5 and away < 3, abs(radius - 24) < 1.5)


def _first_below(cases: Cases, column: str, level: float, least: int) -> Verdict:
    first = [first_below(case[column].values, level) for case in bands(cases)]
    median = middle(np.array(first))
    text = f"first ell below {level:g}: {span(first)}, median {median:g}, at 5 to 50 MHz"
    return grade(text, min(first) >= least, median >= least)


def _suppression(cases: Cases) -> Verdict:
    inside = [power_ratio(case, 1, 15) for case in bands(cases)]
    beyond = [power_ratio(case, 36, 47) for case in bands(cases)]
    text = f"map over true power: {span(inside, '.2f')} at ell <= 15, "
    text += f"{span(beyond, '.2f')} at ell > 35"
    return grade(text, max(beyond) < 0.5 < min(inside), max(beyond) < min(inside))


def _noise_x10(cases: Cases) -> Verdict:
    case = cases["noise_x10"]
    low, drop = first_below(case["rho"].values, 0.9), cross(cases["fiducial"]) - cross(case)
    fine = power_ratio(case, 25, 47) / power_ratio(cases["fiducial"], 25, 47)
    text = f"rho > 0.9 below ell {low}, SNR < 1 {drop} multipoles earlier, "
    text += f"power at ell >= 25 times {fine:.2f}"
    return grade(text, low >= 10 and abs(drop) <= 5 and fine < 1, low >= 10 and abs(drop) <= 10)


def _noise_x100(cases: Cases) -> Verdict:
    case = cases["noise_x100"]
    large, fine = middle(case["rho"].values[1:6]), power_ratio(case, 25, 47)
    text = f"rho {large:.3f} at ell <= 5; map over true power {fine:.2f} at ell >= 25"
    less = fine < power_ratio(cases["fiducial"], 25, 47)
    return grade(text, large > 0.9 and fine < 0.2, large > 0.9 and less)


def _resolution(cases: Cases) -> Verdict:
    first = [cross(case) for case in bands(cases)]
    inside = sum(18 <= ell <= 37 for ell in first)
    text = f"SNR < 1 from ell {span(first)}, {span([180 / ell for ell in first], '.1f')} degrees; "
    text += f"{inside} of {len(first)} bands in the range"
    return grade(text, inside == len(first), 2 * inside >= len(first))


def _five_degrees(cases: Cases) -> Verdict:
    best, longest = max(cross(case) for case in bands(cases)), cross(cases["three_cycles"])
    text = f"best band ell {best} ({180 / best:.1f} degrees); "
    text += f"three cycles at 25 MHz: {longest} ({180 / longest:.1f} degrees)"
    return grade(text, best >= 32, max(best, longest) >= 25)


def _kept(cases: Cases, *names: str) -> Verdict:
    """Whether cases keep rho > 0.9 up to ell 10 (partly: 5), with ell_cross within 10."""
    low = [first_below(cases[name]["rho"].values, 0.9) for name in names]
    first, fiducial = [cross(cases[name]) for name in names], cross(cases["fiducial"])
    near = all(abs(ell - fiducial) <= 10 for ell in first)
    each = zip(names, low, first, strict=True)
    text = ", ".join(f"{name}: rho < 0.9 from ell {a}, SNR < 1 from {b}" for name, a, b in each)
    return grade(f"{text} (fiducial {fiducial})", near and min(low) >= 10, min(low) >= 5)


def _linear_gain(cases: Cases) -> Verdict:
    # an auto: 4 C_g linear, 2 C_g^2 quadratic
    ratio = entry(cases["gain_1e-2"], "noise.gain.sigma") ** 2 / 2
    return grade(f"quadratic over linear term of the autos {ratio:.1e}", ratio < 1e-2, ratio < 0.5)


def _marginalising(cases: Cases) -> Verdict:
    pairs = [("gain_ignored", "gain_1e-2"), ("beam_ignored", "beam_4MHz")]
    crossings = [(bad, cross(cases[bad]), cross(cases[good])) for bad, good in pairs]
    text = ", ".join(f"{bad}: SNR < 1 from ell {a}, marginalised {b}" for bad, a, b in crossings)
    loss = [a < 0.5 * b for _, a, b in crossings]
    return grade(text, all(loss), any(loss))


def _rmsd(cases: Cases, case: str, percent: float) -> Verdict:
    """Whether a case's beams differ by ``percent`` rms, within 30 % (partly: a factor of two)."""
    rms = 100 * cases[case].attrs["beam_rms_difference"]
    near = 0.7 * percent <= rms <= 1.3 * percent
    return grade(f"{rms:.1f} %", near, 0.5 * percent <= rms <= 2 * percent)


def _beam_cross(cases: Cases) -> Verdict:
    first = [cross(cases[name]) for name in ("beam_4MHz", "beam_0.4MHz")]
    fiducial = cross(cases["fiducial"])
    off = max(abs(ell - fiducial) for ell in first)
    text = f"SNR < 1 from ell {first[0]} (4 MHz), {first[1]} (0.4 MHz), fiducial {fiducial}"
    return grade(text, off <= 3, off <= 10)


def _beam_snr(cases: Cases) -> Verdict:
    ratio = [snr_ratio(cases, name, 5, 20) for name in ("beam_4MHz", "beam_0.4MHz")]
    text = "SNR over the fiducial's, median of ell 5-20: "
    text += f"{ratio[0]:.2f} (4 MHz), {ratio[1]:.2f} (0.4 MHz)"
    return grade(text, max(ratio) < 0.9, min(ratio) < 0.9)


def _triple(cases: Cases) -> Verdict:
    ratio = cases["three_cycles"].attrs["n_data"] / cases["fiducial"].attrs["n_data"]
    return grade(f"{ratio:.2f} times the data", abs(ratio - 3) < 0.05)


def _cycles_cross(cases: Cases) -> Verdict:
    first = [cross(cases[name]) for name in ("fiducial", "two_cycles", "three_cycles")]
    inside = all(18 <= ell <= 37 for ell in first)
    text = f"1, 2, 3 cycles: SNR < 1 from ell {', '.join(map(str, first))}; "
    text += f"3 cycles without turning: {cross(cases['three_cycles_at_rest'])}"
    return grade(text, inside and max(first) - first[0] <= 3, inside)


def _cycles_snr(cases: Cases) -> Verdict:
    ratio = snr_ratio(cases, "three_cycles", 10, 30)
    return grade(f"factor {ratio:.2f} (median of ell 10-30)", 1.8 <= ratio <= 3.3, ratio > 1.2)


def _half_cycle(cases: Cases) -> Verdict:
    half, full = cases["half_cycle"], cases["fiducial"]
    share = ever_up(half).sum() / ever_up(full).sum()
    data, of_full = (case.attrs["n_data"] / case.attrs["n_modes"] for case in (half, full))
    text = f"half a cycle sees {100 * share:.1f} % of a full one's sky, {data:.2f} data "
    text += f"per mode (full {of_full:.2f}); SNR < 1 from ell {cross(half)}"
    return grade(text, bool(share > 0.98 and data > 1), bool(share > 0.9))


QUARTERS = ("quarter_cycle", "quarter_2nd", "quarter_3rd", "quarter_4th")


def _quarter_snr(cases: Cases) -> Verdict:
    first, *others = [1 / snr_ratio(cases, name, 1, 30) for name in QUARTERS]
    after = ", ".join(f"{ratio:.1f}" for ratio in others)
    text = f"lower by {first:.1f} (median of ell 1-30); the quarters after it: {after}"
    return grade(text, 3.5 <= first <= 7, 3.5 <= middle(np.array(others)) <= 7)


def _quarter_cross(cases: Cases) -> Verdict:
    first = [cross(cases[name]) for name in QUARTERS]
    text = f"SNR < 1 from ell {first[0]}; the quarters after it: {', '.join(map(str, first[1:]))}"
    return grade(text, 7 <= first[0] <= 13, 7 <= middle(np.array(first[1:])) <= 13)


def _quarter_galaxy(cases: Cases) -> Verdict:
    case = cases["quarter_cycle"]
    alike, seen = likeness(case), 100 * ever_up(case).mean()
    text = f"correlation with the truth {alike:.2f} over the {seen:.0f} % of the sky that it sees"
    return grade(text, alike > 0.7, alike > 0.4)


def claim_table(cases: Cases) -> list[dict[str, object]]:
    """Rows of claims.csv, in the order of the paper."""
    rows = []
    for claim in CLAIMS:
        verdict = globals()[f"_{claim['judge']}"](cases, *claim.get("of", ()))
        reason = "agrees" if verdict["agrees"] == "yes" else claim["otherwise"]
        said = {"section": claim["section"], "paper": claim["paper"]}
        rows.append(said | verdict | {"reason": reason})
    return rows
