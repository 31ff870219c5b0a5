"""luseepy's waterfalls: files of many frequencies, read and written.

They contain visibilities of all times, products and frequencies.

**LUNAR_DAY** gives the start of luseepy's ranges of time. It is "UTC to UTC"; a calendar year,
CY2026 or CY26, which in luseepy begins at one o'clock on the first of January; a fiscal year,
FY2026 or FY26, from the first of October of the year before; or the number of a lunar day: 2603 is
the fourth that begins in 2026. A lunar day begins when the Sun is highest at 180 degrees of
longitude on the Moon's equator. Both luseepy and this module compute that to a few seconds.

**Files of its scalar simulator** are in K. FITS: image ``data`` (time, product, frequency),
``freq`` in MHz, ``combinations`` (pairs of ports; an auto has one column, a cross two, Re and Im).
Header: LUNAR_DAY, DELTAT_SEC, LUN_LAT_DEG, LUN_LONG_DEG; times are start + k DELTAT_SEC. The ports'
impedances in Ohm, ZRe_i and ZIm_i, serve luseepy's conversion to V^2/Hz.

**Files of its four-port simulator** are covariances at the receivers' inputs, in V^2/Hz. FITS
version 3: image ``data`` (time, product, frequency); ``freq`` in MHz; ``time`` (JD1, JD2) in the
scale TIMESYS; table ``products`` with a column ``label``; U (frequency, port, port), the covariance
in an enclosure at 1 K, as ``blackbody_normalization``; the receivers' loads ZL (frequency, port,
port) in Ohm. Header: LUN_LAT_DEG, LUN_LONG_DEG, DELTAT_SEC, TMOON_K, TANT_K and FREQINT, the
interpolation of the response between its frequencies. Visibilities divided by sqrt(U_aa U_bb) are
in K.
"""

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import scipy
from astropy.io import fits
from astropy.time import Time
from jaxtyping import Complex, Float

from lusee_bayes.core import checks, files, formats, reading
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.layouts import Attribute, Layout, Variable
from lusee_bayes.core.version import __version__
from lusee_bayes.instrument import products, times
from lusee_bayes.instrument.beams import source
from lusee_bayes.instrument.beams.fields import Interpolation, place_of
from lusee_bayes.instrument.observation import Observation, body_direction
from lusee_bayes.instrument.visibilities import Visibilities

ByTime, Hdu = Float[np.ndarray, "times products frequencies"], fits.ImageHDU | fits.BinTableHDU
# header entries that both kinds of files have
SITE_AND_STEP = {
    "LUN_LONG_DEG": Attribute(low=-360.0, high=360.0),
    "LUN_LAT_DEG": Attribute(low=-90.0, high=90.0),
    "DELTAT_SEC": Attribute(low=1e-6, high=1e9),
}


@dataclass(frozen=True, repr=False)
class Waterfall(checks.Described):
    """Visibilities of several frequencies.

    Attributes
    ----------
    path : str
        The file, for error messages.
    grid : (products, times, frequencies) array
        In K, in the package's order of products; NaN where a sample is missing.
    frequencies_mhz : (frequencies,) array
    observation : Observation
        Its samples are instants: luseepy's simulators evaluate the sky at the times, and neither
        layout has windows.
    per_kelvin : (frequencies, ports) array or None
        V^2/Hz for 1 K at each port; None unless the file is in V^2/Hz.
    moon_k, antenna_k : float
        Temperatures in K of the Moon and of the antennas, whose emission the visibilities contain.
    receiver : MeasuredReceiver or None
        The receivers' loads at the channels; None if the file lacks them.
    interpolation : str or None
        luseepy's name of its interpolation of the response between channels; None if not stated.
    """

    path: str
    grid: Float[np.ndarray, "products times frequencies"]
    frequencies_mhz: Float[np.ndarray, " frequencies"]
    observation: Observation
    per_kelvin: Float[np.ndarray, "frequencies ports"] | None = None
    moon_k: float = 0.0
    antenna_k: float = 0.0
    receiver: source.MeasuredReceiver | None = None
    interpolation: str | None = None

    def description(self) -> tuple[str, ...]:
        measured = ~np.isnan(self.grid).all((1, 2))
        names = [name for name, seen in zip(products.labels(), measured, strict=True) if seen]
        lines = (
            f"{len(names)} products ({' '.join(names)}) x {self.observation.n_times} times, "
            f"{np.isnan(self.grid[measured]).sum()} samples missing",
            f"channels at {', '.join(f'{f:.9g}' for f in self.frequencies_mhz)} MHz",
            *self.observation.description(),
        )
        if self.per_kelvin is None:
            return lines
        volts = checks.extent(self.per_kelvin, "V^2/Hz")
        return *lines, f"1 K is {volts}; including emission of the Moon at {self.moon_k:.15g} K"

    def channel(self, frequency_mhz: float) -> int:
        """Return the number of the channel at a frequency.

        Raises
        ------
        InputError
            If the file has no such channel.
        """
        return place_of(f"{self.path} has no channel", self.frequencies_mhz, frequency_mhz)

    def at(self, frequency_mhz: float, n_ports: int = products.N_ANTENNAS) -> Visibilities:
        """Return one channel, without the samples that are missing or not finite.

        Parameters
        ----------
        frequency_mhz : float
        n_ports : int
            Number of ports of the instrument.

        Returns
        -------
        Visibilities

        Raises
        ------
        InputError
            If the file has no such channel, has products of other ports, or no data remain.
        """
        channel = self.channel(frequency_mhz)
        values = self.grid[:, :, channel]
        present = np.isfinite(values)
        within = np.array([p.j < n_ports for p in products.all_products()])
        if (beyond := present.any(1) & ~within).any():
            label = products.labels()[int(np.argmax(beyond))]
            raise InputError(
                f"{self.path} has the product {label}, but the beams have {n_ports} ports; give "
                "beam.rotations_deg an angle for every port"
            )
        with reading.naming(f"{self.path} at {frequency_mhz:g} MHz"):
            layout = products.DataLayout.from_flags(~present[within])
        data, mhz = layout.gather(values[within]), float(self.frequencies_mhz[channel])
        return Visibilities(data, layout, self.observation, mhz, receiver=self.receiver)


YEAR = re.compile(r"(CY|FY)([0-9]{2}|[0-9]{4})")
LUNAR_DAY = re.compile(r"[0-9]{3,4}")
# luseepy looks for noons day by day until the end of January of the next year
DAYS_AFTER_NEW_YEAR = 30
# tolerance of the noon of a lunar day: a tenth of a second
NOON_JD = 1e-6


def start_of(text: str) -> Time:
    """Return the start of a range of time, in UTC.

    Parameters
    ----------
    text : str
        LUNAR_DAY.

    Raises
    ------
    InputError
        If the kind of range is unknown, or it starts outside the ephemeris.
    """
    word = text.strip()
    if named := YEAR.fullmatch(word):
        kind, year = named[1], int(named[2])
        year += 2000 if year < 100 else 0
        begins = f"{year:04d}-01-01T01:00" if kind == "CY" else f"{year - 1:04d}-10-01"
        return times.time_of_text("LUNAR_DAY", begins)
    if LUNAR_DAY.fullmatch(word):
        return _noon(int(word))
    first, to, _ = word.partition(" to ")
    if not to:
        raise InputError(
            f"LUNAR_DAY '{text}' is invalid; expected a range of dates (2027-01-15 00:00:00 to "
            "2027-02-01), a year (CY2027, FY27) or the number of a lunar day (2700)"
        )
    return times.time_of_text("LUNAR_DAY", first)


def _noon(number: int) -> Time:
    year, place = 2000 + number // 100, number % 100
    years = (f"{year}-01-01", f"{year + 1}-01-01")
    new_year, next_year = (times.time_of_text("LUNAR_DAY", first).jd for first in years)
    days = np.arange(new_year, next_year + DAYS_AFTER_NEW_YEAR)
    height = _sun_height(days)
    highest = (height[1:-1] > height[:-2]) & (height[1:-1] > height[2:])
    # a lunar day needs an end, too
    beginning, noon = days[1:-1][highest][:-1], np.inf
    if place < len(beginning):
        around = (beginning[place] - 1.0, beginning[place] + 1.0)
        given = {"bounds": around, "options": {"xatol": NOON_JD}}
        noon = scipy.optimize.minimize_scalar(lambda jd: -_sun_height(np.array([jd]))[0], **given).x
    if noon >= next_year:
        raise InputError(
            f"LUNAR_DAY {number}: expected a number from {number - place}, the first lunar day of "
            f"{year}; 12 or 13 of them begin in a year"
        )
    return times.utc_of(np.array([noon]), np.zeros(1))[0]


def _sun_height(jd: Float[np.ndarray, " times"]) -> Float[np.ndarray, " times"]:
    """Sine of the Sun's altitude at the centre of the far side."""
    zeros = np.zeros(len(jd), dtype=int)
    far_side = Observation(180.0, 0.0, times.utc_of(jd, np.zeros(len(jd))), zeros, (0.0,), 1.0)
    return np.einsum("ti,ti->t", body_direction("Sun", far_side), far_side.zenith_galactic())


UTC_ONLY = Attribute("text", choices=("UTC",), optional=True)
SCALAR_IMAGES = {
    "freq": Variable(("freq",), low=0.0, grows=True, unit="MHz"),
    # NaN where a sample is missing
    "data": Variable(("time", "product", "freq"), finite=False, unit="K"),
    "combinations": Variable(("pair", 2), "integer", low=0.0, high=products.N_ANTENNAS - 1.0),
}
SCALAR_WORDS = {"LUNAR_DAY": Attribute("word"), **SITE_AND_STEP, "TIMESYS": UTC_ONLY}
SCALAR_WATERFALL = Layout("a waterfall of luseepy's simulator", SCALAR_IMAGES, SCALAR_WORDS)


def read_scalar(path: Path) -> Waterfall:
    """Read a waterfall of luseepy's scalar simulator, with any products in any order.

    Parameters
    ----------
    path : Path

    Returns
    -------
    Waterfall

    Raises
    ------
    InputError
        For a truncated file, a missing image or header entry, columns that do not match the
        products, ports beyond 0..3, or a bad date.
    """
    content = formats.read_fits(path, SCALAR_WATERFALL)
    data, columns = content.arrays["data"], []
    for i, j in content.arrays["combinations"]:
        # V_ji is the conjugate of V_ij
        pair, sign = f"{min(i, j)}{max(i, j)}", 1.0 if i < j else -1.0
        columns += [(f"{pair}R", 1.0)] if i == j else [(f"{pair}R", 1.0), (f"{pair}I", sign)]
    if data.shape[1] != len(columns):
        why = f"{path}: data has {data.shape[1]} products, expected {len(columns)} by combinations"
        raise InputError(why)
    with reading.naming(path):
        said, values = content.values, np.moveaxis(data, 1, 0)
        signed = zip(columns, values, strict=True)
        grid = products.in_order([(label, sign * one) for (label, sign), one in signed])
        first, seconds = start_of(said["LUNAR_DAY"]), said["DELTAT_SEC"] * np.arange(len(data))
        times.require_ephemeris(first.jd + seconds[-1:] / 86400.0)
        observation = _observation(times.later(first, seconds), said)
    return Waterfall(str(path), grid, content.arrays["freq"], observation)


def _observation(at: Time, said: Mapping[str, Any]) -> Observation:
    site, run = (said["LUN_LONG_DEG"], said["LUN_LAT_DEG"]), np.zeros(len(at), dtype=int)
    return Observation(*site, at, run, (0.0,), said["DELTAT_SEC"])


UNIT = "V^2/Hz"
# FREQINT's names of the interpolation of responses between their frequencies
INTERPOLATIONS: dict[Interpolation, str] = {"linear": "linear-native-alm", "spline": "cubic-spline"}
IMAGES = {
    "freq": Variable(("freq",), low=0.0, grows=True, unit="MHz"),
    "time": Variable(("time", 2), unit="d"),
    "products.label": Variable(("product",), "text"),
    # NaN where a sample is missing
    "data": Variable(("time", "product", "freq"), finite=False, unit=UNIT),
    "blackbody_normalization_real": Variable(source.BY_PORTS),
    **dict.fromkeys(source.LOADS, Variable(source.BY_PORTS, optional=True, unit="Ohm")),
}
WORDS = {
    **SITE_AND_STEP,
    "TMOON_K": Attribute(low=0.0),
    "TANT_K": Attribute(low=0.0, optional=True),
    **dict.fromkeys(("TIMESYS", "FREQINT"), Attribute("text", optional=True)),
    "TIMEUNIT": Attribute("text", choices=("d",), optional=True),
    "BUNIT": Attribute("text", choices=(UNIT,)),
}
FOUR_PORT_WATERFALL = Layout("a waterfall of luseepy's four-port simulator", IMAGES, WORDS)


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
        For a truncated file, a missing image or header entry, wrong shapes or a wrong unit, unknown
        products, or times that do not increase.
    """
    content = formats.read_fits(path, FOUR_PORT_WATERFALL)
    images, said = content.arrays, content.values
    per_kelvin = images["blackbody_normalization_real"].diagonal(axis1=1, axis2=2)
    checks.require_positive(f"{path}: the diagonal of blackbody_normalization_real", per_kelvin)
    root = np.sqrt(per_kelvin)
    scales = {p.label: root[:, p.i] * root[:, p.j] for p in products.all_products()}
    names = [str(label).strip() for label in images["products.label"]]
    named = zip(names, np.moveaxis(images["data"], 1, 0), strict=True)
    with reading.naming(path):
        grid = products.in_order([(name, volts / scales.get(name, 1.0)) for name, volts in named])
        scale = times.scale_of("TIMESYS", said.get("TIMESYS", "UTC"))
        observation = _observation(times.utc_of(*images["time"].T, scale), said)
    loads = source.receiver_of(path, images, "freq", *source.LOADS)
    details = per_kelvin, said["TMOON_K"], said.get("TANT_K", 0.0), loads, said.get("FREQINT")
    return Waterfall(str(path), grid, images["freq"], observation, *details)


def read_waterfall(path: str | Path) -> Waterfall:
    """Read a waterfall of luseepy's simulators, with all products or some.

    Parameters
    ----------
    path : str or Path

    Returns
    -------
    Waterfall

    Raises
    ------
    InputError
        If there is no file, or as :func:`read_scalar` and :func:`read_four_port`.
    """
    path = reading.require_file(path, "data")
    names = set(formats.image_names(path))
    return read_four_port(path) if "blackbody_normalization_real" in names else read_scalar(path)


HINT = "write netCDF (a name that does not end in .fits)"
NO_ROOM = (
    f"luseepy's waterfalls hold instants at the turntable angle 0; {HINT}, or simulate with --set "
    "observation.window=instant --set 'observation.runs=[{cycles: 1.0}]'"
)


def write_waterfall(
    path: str | Path,
    channels: Sequence[Visibilities],
    impedance_ohm: Complex[np.ndarray, " frequencies"] | None = None,
    scenario: str | None = None,
) -> Path:
    """Write channels of one observation like luseepy's scalar simulator, complete or not at all.

    Missing samples become NaN.

    Parameters
    ----------
    path : str or Path
    channels : sequence of Visibilities
    impedance_ohm : (frequencies,) complex array, optional
        Impedance of the arms; NaN where it is unknown.
    scenario : str, optional
        Text of the scenario, stored as an image of bytes that luseepy ignores.

    Returns
    -------
    Path

    Raises
    ------
    InputError
        For anything the layout cannot store: windows, times other than start + k step, turntable
        angles other than 0, other than four ports, channels of different observations, fewer than
        two channels.
    """
    path, first = files.user_path(path), channels[0].observation
    if len(channels) < 2:
        why = f"{path}: luseepy's reader needs at least two channels; give --frequencies, or {HINT}"
        raise InputError(why)
    data, seconds = _kelvin(path, channels), times.seconds_from(first.times[0], first.times)
    if np.abs(seconds - first.step_s * np.arange(first.n_times)).max() > times.ROUNDING_S:
        wrong = f"{path}: luseepy's waterfalls need samples every {first.step_s:g} s; {HINT}"
        raise InputError(wrong)
    pairs = np.array([(p.i, p.j) for p in products.all_products() if p.part == "R"])
    z = np.full(len(channels), np.nan + 1j * np.nan) if impedance_ohm is None else impedance_ohm
    mhz = np.array([channel.frequency_mhz for channel in channels])
    images = {"data": data, "freq": mhz, "combinations": pairs}
    for port in range(products.N_ANTENNAS):
        images |= {f"ZRe_{port}": z.real.copy(), f"ZIm_{port}": z.imag.copy()}
    hdus = [fits.ImageHDU(image, name=name) for name, image in images.items()]
    return _write(path, hdus, {"VERSION": 0.1} | _site_and_times(first), scenario)


def _kelvin(path: Path, channels: Sequence[Visibilities]) -> ByTime:
    """Samples of all channels, NaN where missing; InputError if the layout cannot store them."""
    first = channels[0].observation
    for channel in channels:
        observation = channel.observation
        if observation.windows is not None or observation.turntable_deg != (0.0,):
            raise InputError(f"{path}: {NO_ROOM}")
        if channel.layout.n_products != products.N_ANTENNAS**2:
            raise InputError(f"{path}: expected {products.N_ANTENNAS**2} products; {HINT}")
        if observation.n_times != first.n_times or (observation.times != first.times).any():
            raise InputError(f"{path}: the channels have different times; {HINT}")
    return np.moveaxis(np.stack([channel.grid() for channel in channels], axis=-1), 0, 1)


def _site_and_times(observation: Observation) -> dict[str, Any]:
    """Header entries for site and times."""
    # luseepy counts steps up to the end: half a step less makes rounding harmless
    last = times.later(observation.times[-1], -0.5 * observation.step_s)
    ends = [Time(t, format="iso", precision=9).value for t in (observation.times[0], last)]
    return {
        "LUNAR_DAY": " to ".join(ends),
        "LUN_LAT_DEG": observation.lat_deg,
        "LUN_LONG_DEG": observation.lon_deg,
        "LUN_HEIGHT_M": 0.0,
        "DELTAT_SEC": observation.step_s,
    }


def _write(path: Path, hdus: list[Hdu], header: dict[str, Any], scenario: str | None) -> Path:
    """Write a FITS file, complete or not at all; the first image, ``data``, is the primary."""
    primary = fits.PrimaryHDU(hdus[0].data)
    for key, value in ({"EXTNAME": "data"} | header).items():
        primary.header[key if len(key) <= 8 else f"HIERARCH {key}"] = value
    primary.header["CREATOR"] = f"lusee_bayes {__version__}"
    written = fits.HDUList([primary, *hdus[1:]])
    if scenario is not None:
        image = np.frombuffer(scenario.encode(), dtype=np.uint8)
        written.append(fits.ImageHDU(image, name="scenario"))
    with files.replacing(path) as partial:
        written.writeto(partial)
    return path


def write_four_port(
    path: str | Path,
    channels: Sequence[Visibilities],
    circuits: Sequence[source.Circuit],
    *,
    moon_k: float = 0.0,
    antenna_k: float = 0.0,
    interpolation: Interpolation = "linear",
    response: str = "unknown",
    scenario: str | None = None,
) -> Path:
    """Write channels of one observation in V^2/Hz, complete or not at all.

    Times are written unchanged. Missing samples become NaN, and so do all numbers computed from the
    covariance at their time.

    Parameters
    ----------
    path : str or Path
    channels : sequence of Visibilities
        In K, including the emission of Moon and antennas.
    circuits : sequence of Circuit
        Antennas and loads of each channel.
    moon_k, antenna_k : float
        Temperatures of the Moon and of the antennas.
    interpolation : {"linear", "spline"}
        Interpolation of the response between its own frequencies.
    response : str
        Name of the response's file.
    scenario : str, optional
        Text of the scenario, stored as an image of bytes that luseepy ignores.

    Returns
    -------
    Path

    Raises
    ------
    InputError
        For anything the layout cannot store: open ports, windows, turntable angles other than 0,
        other than four ports, channels of different observations.
    """
    path, observation = files.user_path(path), channels[0].observation
    if (receiver := circuits[0].receiver) is None:
        raise InputError(
            f"{path}: luseepy's four-port waterfalls include the loads of receivers, but the ports "
            f"are open; give another beam.receiver, or {HINT}"
        )
    enclosure = np.array([circuit.per_kelvin for circuit in circuits])
    root = np.sqrt(enclosure.diagonal(axis1=1, axis2=2).real)
    i, j, _ = products.ports()
    data = _kelvin(path, channels) * (root[:, i] * root[:, j]).T
    condition = np.linalg.cond([c.antenna_ohm + c.load_ohm for c in circuits])
    eigenvalues = _eigenvalues(data)
    largest = np.abs(eigenvalues).max(-1)
    ratio = np.divide(eigenvalues[..., 0], largest, out=np.zeros_like(largest), where=largest > 0)
    # visibilities are real products of a Hermitian matrix
    none, names = np.zeros_like(ratio), receiver.luseepy_parameters
    parameters = json.dumps({k: getattr(receiver, n) for k, n in names.items()}, sort_keys=True)
    images: list[tuple[str, Any, str]] = [
        ("data", data, UNIT),
        ("freq", [c.frequency_mhz for c in channels], "MHz"),
        ("time", np.stack([observation.times.jd1, observation.times.jd2], axis=-1), "d"),
        ("ZA", [c.antenna_ohm for c in circuits], "Ohm"),
        ("ZL", [c.load_ohm for c in circuits], "Ohm"),
        ("M", [c.loading for c in circuits], "1"),
        ("Rsky", [c.resistance_ohm - c.moon_ohm - c.loss_ohm for c in circuits], "Ohm"),
        ("Rmoon", [c.moon_ohm for c in circuits], "Ohm"),
        ("Rloss", [c.loss_ohm for c in circuits], "Ohm"),
        ("blackbody_normalization", enclosure, "V^2/(Hz K)"),
        ("loading_condition_number", condition, "1"),
        ("covariance_antihermitian_absolute", none, UNIT),
        ("covariance_antihermitian_relative", none, "1"),
        ("covariance_eigenvalues", eigenvalues, UNIT),
        ("covariance_minimum_eigenvalue_ratio", ratio, "1"),
        ("receiver_params", np.frombuffer(parameters.encode(), dtype=np.uint8), "1"),
    ]
    hdus = [hdu for image in images for hdu in _hdus(*image)]
    clock = {"TIMESYS": "UTC", "TIMEUNIT": "d", "CLOCKSRC": "supplied", "SCALEASM": False}
    hdus[2].header.update(TIMEFMT="JD1+JD2", **clock)
    label = fits.Column("label", "8A", unit="1", array=[p.label for p in products.all_products()])
    table = fits.Header([("EXTNAME", "products")])
    hdus.insert(3, fits.BinTableHDU.from_columns([label], header=table))
    header = {
        "VERSION": 3,
        "ENGINE": "lusee_bayes",
        **_site_and_times(observation),
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
    return _write(path, hdus, header, scenario)


def _hdus(name: str, values: Any, unit: str) -> list[fits.ImageHDU]:
    """An image, or two for the real and the imaginary part."""
    parts = {name: np.asarray(values)}
    if np.iscomplexobj(values):
        parts = {f"{name}_real": np.real(values).copy(), f"{name}_imag": np.imag(values).copy()}
    headers = [fits.Header([("EXTNAME", key), ("BUNIT", unit)]) for key in parts]
    return list(map(fits.ImageHDU, parts.values(), headers))


def _eigenvalues(data: ByTime) -> Float[np.ndarray, "times frequencies ports"]:
    """Eigenvalues of the ports' covariance at every time; NaN where a product is missing."""
    covariance = np.moveaxis(products.to_matrix(np.moveaxis(data, 1, 0)), (0, 1), (2, 3))
    complete = np.isfinite(data).all(1)
    values = np.full((*complete.shape, covariance.shape[-1]), np.nan)
    values[complete] = np.linalg.eigvalsh(covariance[complete])
    return values
