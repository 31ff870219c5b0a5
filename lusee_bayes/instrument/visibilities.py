"""Visibilities: the data set d of one frequency with its times, products and flags, and its file.

The file is netCDF. Windows of samples are stored twice. ``time_bounds`` follows the CF conventions,
for people and other software, and ``live_time`` goes with it. The pieces are exact: seconds from
the time of their sample. The attribute ``window`` declares instants. In a file with none of these
the meaning of the times is open.

A :class:`Calibration` describes averages of a spectrometer's spectra. An average over channels and
spectra has the radiometer noise of the independent voltage samples behind it. Its gain has the
errors of the gain table, which all spectra of one level of one port share.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from astropy.time import Time
from jaxtyping import Bool, Float, Int

from lusee_bayes.core import checks, files, formats, reading
from lusee_bayes.core.arrays import Array
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.harmonics import lmax_of, n_modes
from lusee_bayes.core.layouts import Attribute, Content, Layout, Variable, require_mhz
from lusee_bayes.instrument import times as at
from lusee_bayes.instrument.beams.source import MeasuredReceiver, receiver_of
from lusee_bayes.instrument.observation import Observation, numbers_of_times, runs_of, site_of
from lusee_bayes.instrument.products import N_ANTENNAS, DataLayout, labels_of, real_products
from lusee_bayes.instrument.times import Windows, later, scale_of, utc_of, utc_times, windows_of

PIECES = ("piece_sample", "piece_start_s", "piece_end_s", "piece_live_s")
# attributes of Julian dates in two parts, jd1 and jd2, in a file
JD_SCALES = {name: Attribute("text", optional=True) for name in ("jd1.scale", "jd2.scale")}
# times for people are written to the millisecond
SINCE = "milliseconds since 1970-01-01"
ENCODING = {"units": SINCE, "calendar": "proleptic_gregorian", "dtype": "int64"}


def _utc_of_jd(content: Content) -> Time:
    """Return times of a file's ``jd1`` and ``jd2``, in UTC.

    Their scale is the one that the file states (:data:`JD_SCALES`), or UTC.

    Raises
    ------
    InputError
        If the scale is unknown or differs between the two, and as :func:`utc_of`.
    """
    scales = {scale_of(n, content.values[n]) for n in JD_SCALES if n in content.values} or {"utc"}
    if len(scales) > 1:
        raise InputError(f"jd1 and jd2 have different scales, {' and '.join(sorted(scales))}")
    return utc_of(content.arrays["jd1"], content.arrays["jd2"], scales.pop())


def _datetimes(times: Time) -> np.ndarray:
    # of the standard form, whatever that of the given times; datetime64 has no leap seconds
    plain = Time(times.jd1, times.jd2, format="jd", scale=times.scale, precision=3)
    return np.char.replace(plain.isot, ":60.", ":59.").astype("datetime64[ms]")


def read_windows(content: Content, times: Time) -> tuple[Time, Windows | None]:
    """Return the windows of samples that a file specifies.

    Parameters
    ----------
    content : Content
        Content of a file with :data:`LAYOUT`.
    times : (times,) Time
        Times of its samples.

    Returns
    -------
    Time
        The middles of the windows; the unchanged times if there are no windows.
    Windows or None

    Raises
    ------
    InputError
        If variables that belong together are incomplete or contradict each other, and as
        :class:`.Windows`.
    """
    arrays, said = content.arrays, content.values.get("window")
    given = [name for name in (*PIECES, "time_bounds", "live_time") if name in arrays]
    lost = [name for name in PIECES if name not in arrays]
    if said == "instant" and given:
        wrong = f"the attribute window declares instants, but {given[0]} gives windows; remove one"
        raise InputError(wrong)
    if 0 < len(lost) < len(PIECES):
        raise InputError(f"{given[0]} without {lost[0]}; pieces of windows need both")
    if not lost:
        windows = Windows(*(arrays[name] for name in PIECES))
        windows.require_same(times, arrays.get("time_bounds"), arrays.get("live_time"))
        return times, windows
    if "time_bounds" in arrays:
        step_s, live_s = content.values["step_s"], arrays.get("live_time")
        middles, _, windows = windows_of(times, "middle", step_s, live_s, arrays["time_bounds"])
        return middles, windows
    if given or said == "mean":
        what = "live_time" if given else "the attribute window = 'mean'"
        raise InputError(f"{what} without time_bounds; add the start and the end of every sample")
    return times, None


@dataclass(frozen=True)
class Calibration:
    """Number of samples behind every time, and errors of its gains.

    Attributes
    ----------
    n_averaged : (times,) array
        Independent samples of complex voltages behind every time: bandwidth times live time, minus
        the loss by unequal weights and overlapping channels.
    gain_names : tuple of str
        Errors of the gain table, such as "M0 PC1": level, port and component.
    gain_port : (errors,) array of int
        Port of each error.
    gain_slope : (errors, times) array
        Relative excess of a port's power gain over the table's, for an error of one prior standard
        deviation; 0 at times when the port has another level.
    lost : float
        Share of the spectra that the reduction's rules flagged.

    Raises
    ------
    InputError
        If lengths do not match, ``n_averaged`` is not positive, or ``gain_slope`` not finite.
    """

    n_averaged: Float[np.ndarray, " times"]
    gain_names: tuple[str, ...] = ()
    gain_port: Int[np.ndarray, " errors"] | None = None
    gain_slope: Float[np.ndarray, "errors times"] | None = None
    lost: float = 0.0

    def __post_init__(self):
        checks.require_positive("the number of samples averaged", self.n_averaged)
        n, times = len(self.gain_names), len(self.n_averaged)
        if n:
            checks.require_shape("gain_port", self.gain_port, (n,))
            checks.require_shape("gain_slope", self.gain_slope, (n, times))
            checks.require_finite("gain_slope", self.gain_slope)

    def select(self, keep: Bool[np.ndarray, " times"]) -> Calibration:
        """Return the calibration of the times where ``keep`` is True."""
        slope = None if self.gain_slope is None else self.gain_slope[:, keep]
        return replace(self, n_averaged=self.n_averaged[keep], gain_slope=slope)


CALIBRATION = "n_averaged", "gain_names", "gain_port", "gain_slope"
LOADS, LOAD = ("load_ohm_real", "load_ohm_imag"), ("load_frequency", "port", "port_2")
# advice if there is no file
HINT = "make some with: lusee-bayes simulate SCENARIO"


@dataclass(frozen=True, repr=False)
class Visibilities(checks.Described):
    """Measured or simulated data.

    Attributes
    ----------
    data : (data,) array
        In K, product by product with time running fastest, without missing samples.
    layout : DataLayout
        Product and time of each entry.
    observation : Observation
    frequency_mhz : float
    truth : (modes,) array or None
        The sky of simulated data in K, Galactic, of any lmax (:meth:`with_truth_up_to`); None for
        real data.
    receiver : MeasuredReceiver or None
        The loads of the receivers, for data of luseepy's four ports.
    says_window : bool
        Whether the meaning of the times is known. False for data of a file that specifies neither
        windows nor instants: call :meth:`stamped` before use.
    calibration : Calibration or None
        Of averages of a spectrometer's spectra; None for other data.

    Raises
    ------
    InputError
        If data, layout and observation do not match, or data are not finite.
    """

    data: Float[Array, " data"]
    layout: DataLayout
    observation: Observation
    frequency_mhz: float
    truth: Float[Array, " modes"] | None = None
    receiver: MeasuredReceiver | None = None
    says_window: bool = True
    calibration: Calibration | None = None

    def __post_init__(self):
        checks.require_array("the data", self.data, (self.layout.size,))
        n_times, seen = self.layout.n_times, self.observation
        if n_times != seen.n_times:
            raise InputError(f"the data have {n_times} times, the observation {seen.n_times}")
        if (said := self.calibration) is not None:
            checks.require_shape("n_averaged of the calibration", said.n_averaged, (n_times,))

    @classmethod
    def from_arrays(
        cls,
        data: Any,
        times: Any,
        frequency_mhz: Any,
        *,
        products: Any = None,
        site: Any = "LuSEE-Night",
        flags: Any = None,
        turntable_deg: Any = 0.0,
        convention: str = "s_i conj(s_j)",
        timestamp: str = "middle",
        bounds: Any = None,
        live_s: Any = None,
        step_s: Any = None,
        n_antennas: int = N_ANTENNAS,
    ) -> Visibilities:
        """Create a data set from arrays; numbers with a unit may be astropy Quantities of any unit.

        Parameters
        ----------
        data : (times, products) array
            In K. Complex correlations V_ij of pairs of ports, or their real and imaginary parts as
            real columns; NaN, or masked, where a sample is absent.
        times : (times,) sequence
            Times of the samples, increasing: datetimes, ISO dates (UTC) or an astropy Time.
        frequency_mhz : float
        products : sequence of str, optional
            The name of each column, in any order: "01" for complex data, "01R" and "01I" for real
            data, and "10" for the correlation of port 1 with port 0. By default all products in
            the order 00, 01, 02, ..., 11, 12, ... Those without a column are absent.
        site : str or (float, float)
            Name, or selenographic longitude and latitude in degrees.
        flags : (times, products) or (times,) array of bool, optional
            True where a sample is not used.
        turntable_deg : float or (times,) array
            Turntable angle in degrees, from East towards North.
        convention : {"s_i conj(s_j)", "conj(s_i) s_j"}
            The quantity averaged as "ij", for voltages that vary as exp(+i w t). With exp(-i w t),
            the imaginary part changes sign.
        timestamp : {"middle", "start", "end", "instant"}
            Meaning of the times. Samples are means over windows of ``step_s``, unless they are
            instants.
        bounds : (times, 2) sequence, optional
            Start and end of every sample, as any kind of times, if ``timestamp`` and ``step_s`` do
            not give them. The times may then lie anywhere between.
        live_s : float or (times,) array, optional
            Time integrated in each sample, in seconds; by default all of its window.
        step_s : float, optional
            Time between samples, in seconds; by default the median.
        n_antennas : int
            Number of ports.

        Returns
        -------
        Visibilities

        Raises
        ------
        InputError
            If arrays are inconsistent with each other or with their description.
        """
        data = checks.in_unit("the data", data, "K")
        frequency_mhz = checks.in_unit("frequency_mhz", frequency_mhz, "MHz")
        live_s, step_s = (checks.in_unit("a length of time", x, "s") for x in (live_s, step_s))
        turntable_deg = checks.in_unit("turntable_deg", turntable_deg, "deg")
        values = real_products(data, products, flags, convention, n_antennas)
        utc = utc_times(times)
        if len(utc) != values.shape[1]:
            wrong = f"got {len(utc)} times for data of {values.shape[1]} times (their first axis)"
            raise InputError(wrong)
        checks.require_shape("frequency_mhz", np.asarray(frequency_mhz), ())
        checks.require_positive("frequency_mhz", frequency_mhz)
        require_mhz("frequency_mhz", frequency_mhz)
        run, angles = runs_of(turntable_deg, len(utc))
        live_s = None if live_s is None else numbers_of_times("live_s", live_s, len(utc))
        middles, step_s, windows = windows_of(utc, timestamp, step_s, live_s, bounds)
        observation = Observation(*site_of(site), middles, run, angles, step_s, windows=windows)
        layout = DataLayout.from_flags(np.isnan(values))
        return cls(layout.gather(values), layout, observation, float(frequency_mhz))

    def description(self) -> tuple[str, ...]:
        truth = "" if self.truth is None else f"; simulated, lmax = {lmax_of(len(self.truth))}"
        unsaid = "meaning of the times unknown: --set observation.timestamp=..."
        return (
            f"{self.layout.description()[0]} at {self.frequency_mhz:g} MHz",
            f"{checks.extent(self.data, 'K')}{truth}; products {checks.listed(self.labels)}",
            *self.observation.description(),
            *([] if self.says_window else [unsaid]),
        )

    @property
    def n_missing(self) -> int:
        """Number of samples of the grid that are flagged or missing."""
        return self.layout.n_products * self.layout.n_times - self.layout.size

    @property
    def labels(self) -> tuple[str, ...]:
        """Labels of the products, in order."""
        return labels_of(self.layout.n_products)

    def digest(self) -> str:
        """Return a hash of data, layout, times, angles and windows, which identifies them."""
        seen = self.observation
        parts = [self.data, self.layout.product, self.layout.time, seen.times.jd]
        parts.append(np.array(seen.turntable_deg)[seen.run])
        if (windows := seen.windows) is not None:
            parts += vars(windows).values()
        if self.calibration is not None:
            parts.append(self.calibration.n_averaged)
        content = b"".join(np.ascontiguousarray(part).tobytes() for part in parts)
        return hashlib.sha256(content).hexdigest()

    def grid(self) -> Float[np.ndarray, "products times"]:
        """Return the full grid in K, NaN where a sample is missing: for files and figures only."""
        present = np.asarray(self.layout.present)
        return np.where(present, np.asarray(self.layout.scatter(self.data)), np.nan)

    def stamped(self, timestamp: str) -> Visibilities:
        """Return the same data with this meaning of their times; each window lasts for a step.

        Parameters
        ----------
        timestamp : {"start", "middle", "end", "instant"}

        Raises
        ------
        InputError
            If the data have windows, and as :class:`Observation`.
        """
        if (observation := self.observation).windows is not None:
            raise InputError("the data have windows, and their times are the middles of these")
        times, _, windows = windows_of(observation.times, timestamp, observation.step_s)
        seen = replace(observation, times=times, windows=windows)
        return replace(self, observation=seen, says_window=True)

    def select(self, keep: Bool[np.ndarray, " times"]) -> Visibilities:
        """Return the data at the times where ``keep`` is True."""
        layout = DataLayout.from_flags(~np.asarray(self.layout.present)[:, keep])
        data = layout.gather(self.layout.scatter(self.data)[:, keep])
        said = None if self.calibration is None else self.calibration.select(keep)
        seen = self.observation.select(keep)
        return replace(self, data=data, layout=layout, observation=seen, calibration=said)

    def with_truth_up_to(self, lmax: int) -> Visibilities:
        """Return the same data with the truth cut, or padded with zeros, to this lmax."""
        if self.truth is None or len(self.truth) == n_modes(lmax):
            return self
        truth = np.asarray(self.truth)[: n_modes(lmax)]
        return replace(self, truth=np.pad(truth, (0, n_modes(lmax) - len(truth))))

    def to_dataset(self) -> xr.Dataset:
        """Return a Dataset with dims product, time and run_number.

        Windows add the dims piece and bounds, a known truth adds mode.
        """
        seen, windows, receiver = self.observation, self.observation.windows, self.receiver
        arrays = {
            "product": list(self.labels),
            "visibility": self.grid(),
            "flag": ~np.asarray(self.layout.present),
            "run": seen.run,
            "turntable_deg": np.array(seen.turntable_deg),
            "truth": self.truth,
            # two parts keep the times exact
            "jd1": seen.times.jd1,
            "jd2": seen.times.jd2,
        }
        if windows is not None:
            arrays |= {f"piece_{name}": numbers for name, numbers in vars(windows).items()}
            arrays["live_time"] = windows.live_per_sample_s
        if receiver is not None:
            ohm = receiver.load_ohm
            arrays["load_frequency_mhz"] = receiver.frequencies_mhz
            arrays |= dict(zip(LOADS, (ohm.real, ohm.imag), strict=True))
        said = {name: getattr(seen, name) for name in ("lon_deg", "lat_deg", "step_s")}
        if (counts := self.calibration) is not None:
            said["lost"] = counts.lost
            names = CALIBRATION if counts.gain_names else CALIBRATION[:1]
            arrays |= {name: np.asarray(getattr(counts, name)) for name in names}
        said |= {"frequency_mhz": self.frequency_mhz, "jd1.scale": "utc", "jd2.scale": "utc"}
        said["window"] = None if not self.says_window else "instant" if windows is None else "mean"
        dataset = formats.as_dataset(formats.VISIBILITIES, LAYOUT, arrays, said)
        dataset = dataset.assign_coords(time=("time", _datetimes(seen.times), {}, ENCODING))
        if windows is None:
            return dataset
        dataset["time"].attrs["bounds"] = "time_bounds"
        bounds = _datetimes(later(seen.times[:, None], windows.bounds_s))
        return dataset.assign(time_bounds=(("time", "bounds"), bounds, {}, ENCODING))

    def write(self, path: str | Path, attrs: dict[str, str] | None = None) -> Path:
        """Write a netCDF file, complete or not at all.

        Parameters
        ----------
        path : str or Path
        attrs : dict of str to str, optional
            Further attributes of the file.

        Returns
        -------
        Path
        """
        with files.replacing(path) as partial:
            formats.write_netcdf(self.to_dataset().assign_attrs(attrs or {}), partial)
        return files.user_path(path)


ARRAYS = {
    "product": Variable(("product",), "text"),
    "visibility": Variable(("product", "time"), finite=False, unit="K"),
    "flag": Variable(("product", "time"), "boolean"),
    **{name: Variable(("time",), unit="d") for name in ("jd1", "jd2")},
    "run": Variable(("time",), "integer", low=0.0),
    "turntable_deg": Variable(("run_number",), unit="deg"),
    "time": Variable(("time",), "time", optional=True),
    "time_bounds": Variable(("time", 2), "time", optional=True),
    "live_time": Variable(("time",), optional=True, unit="s"),
    "piece_sample": Variable(("piece",), "integer", low=0.0, optional=True),
    **{name: Variable(("piece",), optional=True, unit="s") for name in PIECES[1:]},
    "truth": Variable(("mode",), optional=True, unit="K"),
    # the receivers' loads ZL, if known
    "load_frequency_mhz": Variable(LOAD[:1], low=0.0, grows=True, optional=True, unit="MHz"),
    **dict.fromkeys(LOADS, Variable(LOAD, optional=True, unit="Ohm")),
    "n_averaged": Variable(("time",), low=0.0, optional=True),
    "gain_names": Variable(("gain_error",), "text", optional=True),
    "gain_port": Variable(("gain_error",), "integer", low=0.0, optional=True),
    "gain_slope": Variable(("gain_error", "time"), optional=True),
}
NUMBERS = {
    "frequency_mhz": Attribute(low=0.0, unit="MHz"),
    "lon_deg": Attribute(low=-360.0, high=360.0),
    "lat_deg": Attribute(low=-90.0, high=90.0),
    "step_s": Attribute(low=0.0),
    **JD_SCALES,
    "window": Attribute("text", choices=("mean", "instant"), optional=True),
    "lost": Attribute(low=0.0, high=1.0, optional=True),
}
LAYOUT = Layout("visibilities", ARRAYS, NUMBERS)


def read_visibilities(path: str | Path) -> Visibilities:
    """Read a file written by :meth:`Visibilities.write`.

    Parameters
    ----------
    path : str or Path

    Returns
    -------
    Visibilities

    Raises
    ------
    InputError
        If the file is missing or of another kind, contains NaN that is not flagged, or only flagged
        samples.
    """
    reading.require_file(path, "data", HINT)
    content = formats.read_netcdf(path, formats.VISIBILITIES, LAYOUT, HINT)
    arrays, said = content.arrays, content.values
    given, expected = tuple(map(str, arrays["product"])), labels_of(len(arrays["product"]))
    if given != expected:
        raise InputError(f"{path} has products {', '.join(given)}; expected {', '.join(expected)}")
    flags = arrays["flag"]
    values = np.where(flags, 0.0, arrays["visibility"])
    checks.require_finite(f"{path}: visibility (where not flagged)", values)
    with reading.naming(path):
        layout = DataLayout.from_flags(flags)
        times = _utc_of_jd(content)
        if "time" in arrays:
            off = np.abs(at.seconds_from(times, utc_times(arrays["time"])))
            at.require_same_times("time and jd1 + jd2", off, "time")
        times, windows = read_windows(content, times)
        says_window = windows is not None or said.get("window") == "instant"
        runs = arrays["run"], tuple(arrays["turntable_deg"].tolist()), said["step_s"]
        seen = Observation(said["lon_deg"], said["lat_deg"], times, *runs, windows=windows)
        receiver = receiver_of(path, arrays, "load_frequency_mhz", *LOADS)
        calibration = None
        if "n_averaged" in arrays:
            names = tuple(map(str, arrays.get("gain_names", ())))
            gains = names, arrays.get("gain_port"), arrays.get("gain_slope")
            calibration = Calibration(arrays["n_averaged"], *gains, said.get("lost", 0.0))
        details = said["frequency_mhz"], arrays.get("truth"), receiver, says_window, calibration
        return Visibilities(layout.gather(values), layout, seen, *details)
