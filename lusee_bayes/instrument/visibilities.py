"""The data set d: visibilities of one frequency with their times, products and flags."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from jaxtyping import Float

from lusee_bayes.core import formats
from lusee_bayes.core.arrays import Array
from lusee_bayes.core.checks import require_finite, require_float64, require_positive, require_shape
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.files import replacing
from lusee_bayes.core.harmonics import lmax_of
from lusee_bayes.core.layouts import Attribute, Layout, Variable
from lusee_bayes.core.netcdf_files import read_netcdf
from lusee_bayes.core.reading import naming, require_file
from lusee_bayes.core.representation import Described, extent, listed
from lusee_bayes.core.version import __version__
from lusee_bayes.instrument.beams.receiver import MeasuredReceiver
from lusee_bayes.instrument.correlations import (
    real_products,
    runs_of,
    site_of,
)
from lusee_bayes.instrument.layout import DataLayout
from lusee_bayes.instrument.observation import Observation
from lusee_bayes.instrument.products import N_ANTENNAS, labels
from lusee_bayes.instrument.times import step_of, utc_of, utc_times

LOADS = ("load_ohm_real", "load_ohm_imag")
# what a file of visibilities holds
LAYOUT = Layout(
    "visibilities",
    {
        "product": Variable(("product",), "text"),
        "visibility": Variable(("product", "time"), finite=False),
        "flag": Variable(("product", "time"), "boolean"),
        "jd1": Variable(("time",)),
        "jd2": Variable(("time",)),
        "run": Variable(("time",), "integer", low=0.0),
        "turntable_deg": Variable(("run_number",)),
        "truth": Variable(("mode",), optional=True),
        # the receivers' loads ZL, where they are known
        "load_frequency_mhz": Variable(("load_frequency",), low=0.0, grows=True, optional=True),
        **{name: Variable(("load_frequency", "port", "port_2"), optional=True) for name in LOADS},
    },
    {
        "frequency_mhz": Attribute(low=0.0),
        "lon_deg": Attribute(low=-360.0, high=360.0),
        "lat_deg": Attribute(low=-90.0, high=90.0),
        "step_s": Attribute(low=0.0),
    },
)
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
        The sky of simulated data in K, Galactic; None for real data.
    receiver : MeasuredReceiver or None
        The loads through which they were taken, for data of luseepy's four ports.

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

    def __post_init__(self):
        require_float64("the data", self.data)
        require_shape("the data", self.data, (self.layout.size,))
        require_finite("the data", self.data)
        if self.layout.n_times != self.observation.n_times:
            raise InputError(
                f"the data have {self.layout.n_times} times, the observation "
                f"{self.observation.n_times}"
            )

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
            Middles of the samples, growing: datetimes, ISO dates (UTC) or an astropy Time.
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
        step_s : float, optional
            Integration time in seconds; by default the median step from sample to sample.
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
        lon_deg, lat_deg = site_of(site)
        run, angles = runs_of(turntable_deg, len(utc))
        observation = Observation(lon_deg, lat_deg, utc, run, angles, step_of(utc, step_s))
        layout = DataLayout.from_flags(missing)
        return cls(layout.gather(values), layout, observation, float(frequency_mhz))

    def description(self) -> tuple[str, ...]:
        first, *dates = self.observation.description()
        missing = f", {self.n_missing} absent" if self.n_missing else ""
        truth = "" if self.truth is None else f"; simulated, lmax = {lmax_of(len(self.truth))}"
        return (
            f"{self.layout.n_products} products x {self.layout.n_times} times at "
            f"{self.frequency_mhz:g} MHz, {self.layout.size} data{missing}",
            f"{extent(self.data, 'K')}{truth}; products {listed(self.labels)}",
            f"{dates[0]}, at {first}",
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
        """Return a hash of the data, their layout and their times, which tells data sets apart."""
        content = hashlib.sha256(np.ascontiguousarray(self.data).tobytes())
        content.update(self.layout.product.tobytes() + self.layout.time.tobytes())
        content.update(self.observation.times.jd.tobytes())
        return content.hexdigest()

    def grid(self) -> Float[np.ndarray, "products times"]:
        """Return the full grid in K, NaN where a sample is missing: for files and figures only."""
        present = np.asarray(self.layout.present)
        return np.where(present, np.asarray(self.layout.scatter(self.data)), np.nan)

    def to_dataset(self) -> xr.Dataset:
        """Return a Dataset with dims product, time and run_number, and mode if truth is known."""
        observation = self.observation
        variables = {
            "visibility": (("product", "time"), self.grid(), {"units": "K"}),
            "flag": (("product", "time"), ~np.asarray(self.layout.present)),
            "run": (("time",), observation.run),
            "turntable_deg": (("run_number",), np.array(observation.turntable_deg)),
        }
        if self.truth is not None:
            variables["truth"] = (("mode",), np.asarray(self.truth), {"units": "K"})
        if self.receiver is not None:
            dims, ohm = ("load_frequency", "port", "port_2"), self.receiver.load_ohm
            variables["load_frequency_mhz"] = (dims[:1], self.receiver.frequencies_mhz)
            variables |= {n: (dims, x) for n, x in zip(LOADS, (ohm.real, ohm.imag), strict=True)}
        # two parts keep the times exact; datetime64 is for the reader's eye
        variables["jd1"] = (("time",), observation.times.jd1, {"scale": "utc"})
        variables["jd2"] = (("time",), observation.times.jd2, {"scale": "utc"})
        return xr.Dataset(
            variables,
            coords={
                "product": list(self.labels),
                "time": observation.times.isot.astype("datetime64[ms]"),
            },
            attrs={
                "format": formats.VISIBILITIES,
                "frequency_mhz": self.frequency_mhz,
                "lon_deg": observation.lon_deg,
                "lat_deg": observation.lat_deg,
                "step_s": observation.step_s,
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
        return Path(path)


def read_visibilities(path: str | Path) -> Visibilities:
    """Read a file that :meth:`Visibilities.write` has written.

    Parameters
    ----------
    path : str or Path

    Returns
    -------
    Visibilities

    Raises
    ------
    InputError
        If the file is missing or of another kind, holds NaN that is not flagged, or has nothing
        but flagged samples.
    """
    require_file(path, "data", HINT)
    found = read_netcdf(path, formats.VISIBILITIES, LAYOUT, HINT)
    here = found.arrays
    n, products = round(np.sqrt(found.sizes["product"])), tuple(map(str, here["product"]))
    if products != labels(n):
        raise InputError(
            f"{path} has products {', '.join(products)}; expected {', '.join(labels(n))}"
        )
    flags = here["flag"]
    values = np.where(flags, 0.0, here["visibility"])
    require_finite(f"{path}: visibility (where not flagged)", values)
    if here["run"].max() >= found.sizes["run_number"]:
        raise InputError(
            f"{path}: run numbers go up to {here['run'].max()}, and turntable_deg has "
            f"{found.sizes['run_number']} runs"
        )
    with naming(path):
        layout = DataLayout.from_flags(flags)
        observation = Observation(
            found.values["lon_deg"],
            found.values["lat_deg"],
            utc_of(here["jd1"], here["jd2"]),
            here["run"],
            tuple(here["turntable_deg"].tolist()),
            found.values["step_s"],
        )
        return Visibilities(
            layout.gather(values),
            layout,
            observation,
            found.values["frequency_mhz"],
            here.get("truth"),
            _receiver(path, here),
        )


def _receiver(path: str | Path, here: dict[str, np.ndarray]) -> MeasuredReceiver | None:
    names = ("load_frequency_mhz", *LOADS)
    if not set(names) <= set(here):
        return None
    frequencies, real, imaginary = (here[name] for name in names)
    return MeasuredReceiver(str(path), frequencies, real + 1j * imaginary)
