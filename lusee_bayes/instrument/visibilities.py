"""The data set d: visibilities of one frequency with their times, products and flags."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from jaxtyping import Float

from lusee_bayes.core import formats
from lusee_bayes.core.arrays import Array
from lusee_bayes.core.checks import (
    Described,
    extent,
    listed,
    require_finite,
    require_float64,
    require_positive,
    require_shape,
)
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.files import replacing, user_path
from lusee_bayes.core.harmonics import lmax_of, n_modes
from lusee_bayes.core.layouts import require_mhz
from lusee_bayes.core.version import __version__
from lusee_bayes.instrument import window_variables
from lusee_bayes.instrument.beams.receiver import MeasuredReceiver
from lusee_bayes.instrument.calibration import Calibration
from lusee_bayes.instrument.correlations import numbers_of_times, real_products, runs_of, site_of
from lusee_bayes.instrument.layout import DataLayout
from lusee_bayes.instrument.observation import Observation
from lusee_bayes.instrument.products import N_ANTENNAS, labels
from lusee_bayes.instrument.times import step_of, utc_times
from lusee_bayes.instrument.timestamps import bounded, stamped, utc_bounds

LOADS = ("load_ohm_real", "load_ohm_imag")
# what to do where there is no file of them
HINT = "make some with: lusee-bayes simulate SCENARIO"


@dataclass(frozen=True, repr=False)
class Visibilities(Described):
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
        The loads through which they were taken, for data of luseepy's four ports.
    says_window : bool
        Whether it is known what the times are. False for data of a file that says neither windows
        nor instants: they are of no use before :meth:`stamped`.
    calibration : Calibration or None
        Of averages of a spectrometer's spectra; None for other data.

    Raises
    ------
    InputError
        If data, layout and observation do not fit each other, or data are not finite.
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
        require_float64("the data", self.data)
        require_shape("the data", self.data, (self.layout.size,))
        require_finite("the data", self.data)
        if self.layout.n_times != self.observation.n_times:
            raise InputError(
                f"the data have {self.layout.n_times} times, the observation "
                f"{self.observation.n_times}"
            )
        if self.calibration is not None:
            n_averaged = self.calibration.n_averaged
            require_shape("n_averaged of the calibration", n_averaged, (self.layout.n_times,))

    @classmethod
    def from_arrays(
        cls,
        data: Any,
        times: Any,
        frequency_mhz: float,
        *,
        products: Any = None,
        site: Any = "LuSEE-Night",
        flags: Any = None,
        turntable_deg: Any = 0.0,
        convention: str = "s_i conj(s_j)",
        timestamp: str = "middle",
        bounds: Any = None,
        live_s: Any = None,
        step_s: float | None = None,
        n_antennas: int = N_ANTENNAS,
    ) -> Visibilities:
        """Make a data set of arrays.

        Parameters
        ----------
        data : (times, products) array
            In K. Complex correlations V_ij of pairs of ports, or their real and imaginary parts as
            real columns; NaN, or masked, where a sample is absent.
        times : (times,) sequence
            Of the samples, growing: datetimes, ISO dates (UTC) or an astropy Time.
        frequency_mhz : float
        products : sequence of str, optional
            The name of each column, in any order: "01" for complex data, "01R" and "01I" for real
            data, and "10" for the correlation of port 1 with port 0. By default all products in
            the order 00, 01, 02, ..., 11, 12, ... Those without a column are absent.
        site : str or (float, float)
            Name, or selenographic longitude and latitude in degrees.
        flags : (times, products) or (times,) array of bool, optional
            True where a sample is not to be used.
        turntable_deg : float or (times,) array
            Turntable angle in degrees, from East towards North.
        convention : {"s_i conj(s_j)", "conj(s_i) s_j"}
            What "ij" is the mean of, with voltages that go as exp(+i w t). Software that has
            exp(-i w t) has the other sign of the imaginary part, too.
        timestamp : {"middle", "start", "end", "instant"}
            What the times are. Samples are means over windows of ``step_s``, unless they are
            instants.
        bounds : (times, 2) sequence, optional
            Start and end of every sample, of any kind of times, where they are not those of
            ``timestamp`` and ``step_s``. The times then may be anywhere between.
        live_s : (times,) array, optional
            How long each sample was integrated, in seconds; by default all of its window.
        step_s : float, optional
            From sample to sample, in seconds; by default the median of the times.
        n_antennas : int
            Number of ports.

        Returns
        -------
        Visibilities

        Raises
        ------
        InputError
            If arrays do not fit each other or cannot be what they are said to be.
        """
        values, missing = real_products(data, products, flags, convention, n_antennas)
        utc = utc_times(times)
        if len(utc) != values.shape[1]:
            raise InputError(
                f"there are {len(utc)} times for data of {values.shape[1]} times (their first axis)"
            )
        require_positive("frequency_mhz", frequency_mhz)
        require_mhz("frequency_mhz", frequency_mhz)
        lon_deg, lat_deg = site_of(site)
        run, angles = runs_of(turntable_deg, len(utc))
        live_s = None if live_s is None else numbers_of_times("live_s", live_s, len(utc))
        if bounds is None:
            step_s = step_of(utc, step_s)
            middles, windows = stamped(utc, timestamp, step_s, live_s)
        elif timestamp == "instant":
            raise InputError("instants have no bounds; leave out bounds, or timestamp='instant'")
        else:
            middles, step_s, windows = bounded(utc, utc_bounds(bounds, len(utc)), step_s, live_s)
        observation = Observation(lon_deg, lat_deg, middles, run, angles, step_s, windows=windows)
        layout = DataLayout.from_flags(missing)
        return cls(layout.gather(values), layout, observation, float(frequency_mhz))

    def description(self) -> tuple[str, ...]:
        first, *dates = self.observation.description()
        missing = f", {self.n_missing} absent" if self.n_missing else ""
        unsaid = "" if self.says_window else "; it is not known what the times are"
        truth = "" if self.truth is None else f"; simulated, lmax = {lmax_of(len(self.truth))}"
        return (
            f"{self.layout.n_products} products x {self.layout.n_times} times at "
            f"{self.frequency_mhz:g} MHz, {self.layout.size} data{missing}",
            f"{extent(self.data, 'K')}{truth}; products {listed(self.labels)}",
            f"{dates[0]}, at {first}{unsaid}",
        )

    @property
    def n_missing(self) -> int:
        """Number of samples of the grid that are flagged or were never taken."""
        return self.layout.n_products * self.layout.n_times - self.layout.size

    @property
    def labels(self) -> tuple[str, ...]:
        """Labels of the products, in order."""
        return labels(round(np.sqrt(self.layout.n_products)))

    def digest(self) -> str:
        """Return a hash of data, layout, times and windows, which tells data sets apart."""
        content = hashlib.sha256(np.ascontiguousarray(self.data).tobytes())
        content.update(self.layout.product.tobytes() + self.layout.time.tobytes())
        content.update(self.observation.times.jd.tobytes())
        windows = self.observation.windows
        if windows is not None:
            for values in (windows.sample, windows.start_s, windows.end_s, windows.live_s):
                content.update(np.ascontiguousarray(values).tobytes())
        if self.calibration is not None:
            content.update(np.ascontiguousarray(self.calibration.n_averaged).tobytes())
        return content.hexdigest()

    def grid(self) -> Float[np.ndarray, "products times"]:
        """Return the full grid in K, NaN where a sample is missing: for files and figures only."""
        present = np.asarray(self.layout.present)
        return np.where(present, np.asarray(self.layout.scatter(self.data)), np.nan)

    def stamped(self, timestamp: str) -> Visibilities:
        """Return the same data, their times being what is said; windows last for a step.

        Parameters
        ----------
        timestamp : {"start", "middle", "end", "instant"}

        Raises
        ------
        InputError
            If the data have windows, and as :class:`Observation`.
        """
        observation = self.observation
        if observation.windows is not None:
            raise InputError("the data have windows, so that their times are the middles of these")
        times, windows = stamped(observation.times, timestamp, observation.step_s)
        seen = replace(observation, times=times, windows=windows)
        return replace(self, observation=seen, says_window=True)

    def with_truth_up_to(self, lmax: int) -> Visibilities:
        """Return the same with the truth of a map of this lmax: cut, or zero above its own."""
        if self.truth is None or len(self.truth) == n_modes(lmax):
            return self
        truth = np.zeros(n_modes(lmax))
        known = np.asarray(self.truth)[: len(truth)]
        truth[: len(known)] = known
        return replace(self, truth=truth)

    def to_dataset(self) -> xr.Dataset:
        """Return a Dataset with dims product, time and run_number.

        With the dims piece and bounds for windows, and mode if the truth is known.
        """
        observation = self.observation
        variables = {
            "visibility": (("product", "time"), self.grid(), {"units": "K"}),
            "flag": (("product", "time"), ~np.asarray(self.layout.present)),
            "run": (("time",), observation.run),
            "turntable_deg": (("run_number",), np.array(observation.turntable_deg)),
            **window_variables.variables(observation),
        }
        if self.truth is not None:
            variables["truth"] = (("mode",), np.asarray(self.truth), {"units": "K"})
        if self.receiver is not None:
            dims, ohm = ("load_frequency", "port", "port_2"), self.receiver.load_ohm
            variables["load_frequency_mhz"] = (dims[:1], self.receiver.frequencies_mhz)
            variables |= {n: (dims, x) for n, x in zip(LOADS, (ohm.real, ohm.imag), strict=True)}
        # two parts keep the times exact
        variables["jd1"] = (("time",), observation.times.jd1, {"scale": "utc"})
        variables["jd2"] = (("time",), observation.times.jd2, {"scale": "utc"})
        return xr.Dataset(
            variables,
            coords={
                "product": list(self.labels),
                "time": window_variables.coordinate(observation),
            },
            attrs={
                "format": formats.VISIBILITIES,
                "frequency_mhz": self.frequency_mhz,
                "lon_deg": observation.lon_deg,
                "lat_deg": observation.lat_deg,
                "step_s": observation.step_s,
                **(window_variables.attributes(observation) if self.says_window else {}),
                "lusee_bayes_version": __version__,
            },
        )

    def write(self, path: str | Path, attrs: dict[str, str] | None = None) -> Path:
        """Write a netCDF file, whole or not at all.

        Parameters
        ----------
        path : str or Path
        attrs : dict of str to str, optional
            Further attributes of the file.

        Returns
        -------
        Path
        """
        with replacing(path) as partial:
            self.to_dataset().assign_attrs(attrs or {}).to_netcdf(partial, engine="h5netcdf")
        return user_path(path)
