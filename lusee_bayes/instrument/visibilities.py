"""The data set d: visibilities of one frequency with their times, products and flags."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import xarray as xr
from astropy.time import Time
from jaxtyping import Float

from lusee_bayes.core import formats
from lusee_bayes.core.arrays import Array
from lusee_bayes.core.checks import require_finite, require_float64, require_shape
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.files import replacing
from lusee_bayes.core.version import __version__
from lusee_bayes.instrument.layout import DataLayout
from lusee_bayes.instrument.observation import Observation, unannounced_leap_seconds
from lusee_bayes.instrument.products import labels


@dataclass(frozen=True)
class Visibilities:
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

    def __post_init__(self):
        require_float64("the data", self.data)
        require_shape("the data", self.data, (self.layout.size,))
        require_finite("the data", self.data)
        if self.layout.n_times != self.observation.n_times:
            raise InputError(
                f"the data have {self.layout.n_times} times, the observation "
                f"{self.observation.n_times}"
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
    path = Path(path)
    if not path.is_file():
        raise InputError(f"no data at '{path}'; make some with: lusee-bayes simulate SCENARIO")
    try:
        with xr.open_dataset(path, engine="h5netcdf", decode_times=False) as file:
            dataset = file.load()
    except OSError as error:
        raise InputError(f"{path} is not a netCDF file of visibilities ({error})") from error
    if dataset.attrs.get("format") != formats.VISIBILITIES:
        raise InputError(
            f"{path} is not a file of visibilities: its format is "
            f"'{dataset.attrs.get('format', 'absent')}', expected '{formats.VISIBILITIES}'"
        )
    n = round(np.sqrt(dataset.sizes["product"]))
    found = tuple(str(p) for p in dataset["product"].values)
    if found != labels(n):
        raise InputError(f"{path} has products {', '.join(found)}; expected {', '.join(labels(n))}")
    flags = dataset["flag"].values.astype(bool)
    values = dataset["visibility"].values
    require_finite(f"{path}: visibility (where not flagged)", np.where(flags, 0.0, values))
    try:
        layout = DataLayout.from_flags(flags)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    with unannounced_leap_seconds():
        times = Time(dataset["jd1"].values, dataset["jd2"].values, format="jd", scale="utc")
    observation = Observation(
        float(dataset.attrs["lon_deg"]),
        float(dataset.attrs["lat_deg"]),
        times,
        dataset["run"].values,
        tuple(float(t) for t in dataset["turntable_deg"].values),
        float(dataset.attrs["step_s"]),
    )
    truth = dataset["truth"].values if "truth" in dataset else None
    return Visibilities(
        layout.gather(np.where(flags, 0.0, values)),
        layout,
        observation,
        float(dataset.attrs["frequency_mhz"]),
        truth,
    )
