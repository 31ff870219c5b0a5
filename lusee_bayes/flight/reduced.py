"""Spectra reduced to a number for each band, product and bin of time, with what was flagged."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from jaxtyping import Bool, Float, Float32, Int, Shaped, UInt8

from lusee_bayes.core import formats
from lusee_bayes.core.checks import Described, counted
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.files import replacing, user_path
from lusee_bayes.core.formats import read_netcdf
from lusee_bayes.core.layouts import Attribute, Layout, Variable
from lusee_bayes.core.reading import naming
from lusee_bayes.core.version import __version__
from lusee_bayes.flight.gain_model import LETTERS, N_COMPONENTS, Curves
from lusee_bayes.flight.session import AUTOS, FIRST_PORT, N_PRODUCTS, NO_LEVEL, PORTS, SECOND_PORT
from lusee_bayes.instrument.averaging import binned
from lusee_bayes.instrument.beams.fields import SAME_FREQUENCY_MHZ
from lusee_bayes.instrument.observation import Observation
from lusee_bayes.instrument.products import DataLayout, labels, runs_of
from lusee_bayes.instrument.times import Windows, utc_of_jd
from lusee_bayes.instrument.visibilities import (
    PLACE_AND_TIME,
    Calibration,
    Visibilities,
    observation_of,
)

# why a spectrum is not used in a band; the first is that it is
REASONS = (
    "used",
    "saturated",
    "no gain or no data",
    "comb",
    "too many channels flagged",
    "burst",
    "lacks a product of its bin",
    "does not fit the map",
)
USED, SATURATED, NO_DATA, COMB, TOO_MANY, BURST, PRODUCT, NO_FIT = range(len(REASONS))

# whose clock a session has whose own is corrected by a clock file
CORRECTED = "session, corrected by the clock file"

# beyond these, something is said: scatter over the radiometer noise, and what two more powers of
# the frequency change, in standard deviations of a bin
NOISY, CURVED = 1.2, 0.5
# likewise, the share of the spectra that is flagged
MUCH = 0.2


@dataclass(frozen=True, repr=False, eq=False)
class Reduced(Described):
    """Spectra in bands, at every stage from single spectra to averages over time.

    Numbers are for bands, products and bins of time. To begin with every spectrum is a bin of its
    own; in the end a bin has all spectra of a few hours. Flags are those of spectra ("rows").

    Attributes
    ----------
    frequencies_mhz : (bands,) array
    bandwidth_mhz : float
    observation : Observation
        A sample for each spectrum; a run for each state of the spectrometer.
    bin_of : (rows,) array of int
        The bin of time of each spectrum.
    average_s : float or None
        Length of the bins; None if each spectrum is one.
    reason : (bands, rows) array of uint8
        Why a spectrum is not used, of :data:`REASONS`.
    values : (bands, products, bins) array
        In V^2/Hz at the receivers' inputs, NaN where nothing is left.
    before : (bands, products, bins) array
        The mean before anything was flagged, for figures.
    n_averaged : (bands, bins) array
        Independent samples of voltages behind each value; 0 where nothing is left.
    level : (bins, ports) array of str
        Of the gain.
    gain : (bands, ports, bins) array
        Counts for 1 nV^2/Hz.
    slope : (bands, ports, components, bins) array
        Change of the power gain with each component of the gain table, relative to it.
    bend : (bands, ports, bins) array
        What two further powers of the frequency would add to the autos, in standard deviations.
        Of a file one number for a band, its :attr:`curvature`; so are the next two.
    span_scatter : (bands, spans) array
        Scatter in time over the radiometer noise, of spans of a few hours; NaN if not known.
    slab_scatter : (bands, slabs) array
        Scatter of the channels about a smooth spectrum over the radiometer noise, of some spectra.
    lines : (bands, rows) array
        Share of a spectrum's channels in a band that are flagged.
    component_std : (levels, ports, components) array or None
        By how much the components may be off.
    gain_std : float or None
        By how much the gains of a level of a port may be off, relative.
    curves : Curves
        Of the gains, for figures.
    sessions : tuple of mapping
        Where the spectra come from.
    recipe : mapping of str to str
        How they were reduced, in words; empty where an older file does not say it.
    """

    frequencies_mhz: Float[np.ndarray, " bands"]
    bandwidth_mhz: float
    observation: Observation
    bin_of: Int[np.ndarray, " rows"]
    average_s: float | None
    reason: UInt8[np.ndarray, "bands rows"]
    values: Float[np.ndarray, "bands products bins"]
    before: Float[np.ndarray, "bands products bins"]
    n_averaged: Float[np.ndarray, "bands bins"]
    level: Shaped[np.ndarray, "bins ports"]
    gain: Float[np.ndarray, "bands ports bins"]
    slope: Float[np.ndarray, "bands ports components bins"]
    bend: Float[np.ndarray, "bands _ _"]
    span_scatter: Float[np.ndarray, "bands spans"]
    slab_scatter: Float[np.ndarray, "bands slabs"]
    lines: Float32[np.ndarray, "bands rows"]
    component_std: Float[np.ndarray, "levels ports components"] | None
    gain_std: float | None
    curves: Curves
    sessions: tuple[Mapping[str, Any], ...]
    recipe: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def blank(
        cls,
        like: Mapping[str, Any],
        observation: Observation,
        bin_of: Int[np.ndarray, " rows"],
        level: Shaped[np.ndarray, "bins ports"],
        n_slabs: int = 0,
    ) -> Reduced:
        """Begin with no numbers, to be filled in place.

        Parameters
        ----------
        like : mapping of str to object
            All that does not depend on the spectra.
        observation : Observation
        bin_of : (rows,) array of int
        level : (bins, ports) array of str
        n_slabs : int
            Spectra are looked at in so many parts.
        """
        bands, rows, bins = len(like["frequencies_mhz"]), len(bin_of), len(level)
        return cls(
            observation=observation,
            bin_of=bin_of,
            level=level,
            reason=np.zeros((bands, rows), dtype=np.uint8),
            lines=np.zeros((bands, rows), dtype=np.float32),
            values=np.full((bands, N_PRODUCTS, bins), np.nan),
            before=np.full((bands, N_PRODUCTS, bins), np.nan),
            n_averaged=np.zeros((bands, bins)),
            gain=np.full((bands, PORTS, bins), np.nan),
            slope=np.zeros((bands, PORTS, N_COMPONENTS, bins)),
            bend=np.full((bands, PORTS, bins), np.nan),
            span_scatter=np.empty((bands, 0)),
            slab_scatter=np.full((bands, n_slabs), np.nan),
            **like,
        )

    @cached_property
    def scatter(self) -> Float[np.ndarray, " bands"]:
        """Scatter of the spectra in time over the radiometer noise, median; NaN if not known."""
        return _medians(self.span_scatter)

    @cached_property
    def line_scatter(self) -> Float[np.ndarray, " bands"]:
        """Likewise of the channels about a smooth spectrum."""
        return _medians(self.slab_scatter)

    @cached_property
    def curvature(self) -> Float[np.ndarray, " bands"]:
        """The mean of :attr:`bend` over bins, which noise does not have, of the worst port."""
        return np.array([_mean_abs(one) for one in self.bend])

    def noise(self, band: int) -> Float[np.ndarray, "ports bins"]:
        """Return the standard deviations of the autos, by the radiometer equation."""
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.abs(self.values[band, AUTOS]) / np.sqrt(self.n_averaged[band])

    def description(self) -> tuple[str, ...]:
        f = self.frequencies_mhz
        used = self.reason == USED
        between = f"{f[0]:g} MHz" if len(f) == 1 else f"{f[0]:g} to {f[-1]:g} MHz"
        return (
            f"{counted(len(self.bin_of), 'spectrum', 'spectra')} of "
            f"{counted(len(self.sessions), 'session')} in {counted(self.values.shape[2], 'bin')}",
            f"{counted(len(f), 'band')} of {self.bandwidth_mhz:g} MHz at {between}",
            f"{used.mean():.2%} of the spectra are used",
        )

    def notes(self) -> tuple[str, ...]:
        """Return what has been taken from elsewhere than the sessions, a sentence each."""
        corrected = {s["clock_file"] for s in self.sessions if s["clock"] == CORRECTED}
        if corrected:
            return (f"The UTC that the sessions state is corrected by {corrected.pop()}.",)
        told = [s for s in self.sessions if s["clock"] == "clock file" and s.get("clock_file")]
        if not told:
            return ()
        who = Path(told[0]["file"]).name if len(told) == 1 else f"{len(told)} sessions"
        verb = "does" if len(told) == 1 else "do"
        return (
            f"{who} {verb} not say which UTC the clock stands for: its scale "
            f"({told[0]['scale'].upper()}) and epoch are those of the clock file "
            f"{told[0]['clock_file']}.",
        )

    def band(self, frequency_mhz: float) -> int:
        """Return the number of the band at a frequency. InputError if there is none."""
        nearest = int(np.argmin(np.abs(self.frequencies_mhz - frequency_mhz)))
        if abs(self.frequencies_mhz[nearest] - frequency_mhz) > SAME_FREQUENCY_MHZ:
            known = ", ".join(f"{f:.9g}" for f in self.frequencies_mhz)
            raise InputError(
                f"the spectra were reduced to bands at {known} MHz, not at {frequency_mhz:.15g}; "
                f"use --set frequency_mhz={self.frequencies_mhz[nearest]:.15g}, or reduce them "
                "again"
            )
        return nearest

    def bins_at(self, band: int) -> Int[np.ndarray, " left"]:
        """Return the bins of which a band has something left: the times of :meth:`at`."""
        return np.flatnonzero(np.isfinite(self.values[band]).any(axis=0))

    def shares(self, band: int) -> dict[str, float]:
        """Return the share of the spectra that are used, and that are not for each reason."""
        counts = np.bincount(self.reason[band], minlength=len(REASONS)) / self.reason.shape[1]
        return {
            name: float(share)
            for k, (name, share) in enumerate(zip(REASONS, counts, strict=True))
            if share or not k
        }

    def flagged(self, band: int | None = None, misfit: float = 0.0) -> dict[str, float]:
        """Return the share that each rule has flagged of the values that there were.

        Parameters
        ----------
        band : int, optional
            By default all of them.
        misfit : float
            Share of the values left by the other rules that does not fit the map.
        """
        rows = self.reason if band is None else self.reason[band]
        counts = np.bincount(rows.ravel(), minlength=len(REASONS))
        counts[[USED, NO_DATA]] = counts[USED] + counts[NO_FIT], 0
        shares = counts / max(counts.sum() - counts[NO_FIT], 1)
        shares[NO_FIT] = misfit * shares[USED]
        return {REASONS[k]: float(shares[k]) for k in range(1, len(REASONS)) if shares[k]}

    def flag_line(self, band: int | None = None, misfit: float = 0.0) -> str:
        """Say how much was flagged, as :meth:`flagged`."""
        found = self.flagged(band, misfit)
        rules = ", ".join(f"{name} {share:.2%}" for name, share in found.items())
        return f"flagged {sum(found.values()):.2%} of the values" + (f": {rules}" if rules else "")

    def doubts(self, band: int) -> tuple[str, ...]:
        """Return what is doubtful about a band, a sentence each."""
        found = []
        if sum(self.flagged(band).values()) > MUCH:
            found.append(
                f"The rules of the reduction {self.flag_line(band)}. That is more than a fifth: "
                "check the sessions, flight.false_alarm, flight.lines and flight.comb."
            )
        noise, curvature = float(self.scatter[band]), float(self.curvature[band])
        if noise > NOISY:
            found.append(
                f"Spectra scatter {noise:.2g} times as much in time as the radiometer's noise: "
                "gains drift, or something else than the sky changes; consider noise.gain."
            )
        if curvature > CURVED:
            found.append(
                f"The spectrum within the band is no polynomial of that degree: two more powers "
                f"move a value by {curvature:.2g} standard deviations; use a smaller "
                "flight.bandwidth_hz, or a higher flight.degree."
            )
        return tuple(found)

    def at(self, frequency_mhz: float, per_kelvin: Float[np.ndarray, " ports"]) -> Visibilities:
        """Return one band.

        Parameters
        ----------
        frequency_mhz : float
        per_kelvin : (ports,) array
            V^2/Hz that an enclosure of 1 K makes at each port.

        Returns
        -------
        Visibilities
            In K, with their calibration.

        Raises
        ------
        InputError
            If there is no such band, or nothing is left of it.
        """
        band = self.band(frequency_mhz)
        present = np.isfinite(self.values[band])
        bins = self.bins_at(band)
        if not bins.size:
            counts = ", ".join(
                f"{name} {int((self.reason[band] == k).sum())}"
                for k, name in enumerate(REASONS)
                if k and (self.reason[band] == k).any()
            )
            raise InputError(
                f"nothing is left of the spectra at {frequency_mhz:g} MHz: of "
                f"{self.reason.shape[1]}, {counts}"
            )
        left = np.flatnonzero((self.reason[band] == USED) & np.isin(self.bin_of, bins))
        _, bin_of_left = np.unique(self.bin_of[left], return_inverse=True)
        if self.average_s is None:
            keep = np.zeros(len(self.bin_of), dtype=bool)
            keep[left] = True
            observation = self.observation.select(keep)
        else:
            observation = binned(self.observation, left, bin_of_left, self.average_s)
        scale = np.sqrt(per_kelvin[FIRST_PORT] * per_kelvin[SECOND_PORT])
        values = np.where(present, self.values[band], 0.0)[:, bins] / scale[:, None]
        layout = DataLayout.from_flags(~present[:, bins])
        return Visibilities(
            layout.gather(values),
            layout,
            _one_run_an_angle(observation),
            float(self.frequencies_mhz[band]),
            calibration=self._calibration(band, bins),
        )

    def _calibration(self, band: int, bins: Int[np.ndarray, " left"]) -> Calibration:
        names, ports, slopes = [], [], []
        lost = float(sum(self.flagged(band).values()))
        levels = self.level[bins]
        for level in LETTERS:
            for port in range(levels.shape[1]):
                here = levels[:, port] == level
                for name, slope in self._errors(band, bins, level, port):
                    if here.any() and np.any(slope[here]):
                        names.append(name)
                        ports.append(port)
                        slopes.append(np.where(here, slope, 0.0))
        n_averaged = self.n_averaged[band, bins]
        if not names:
            return Calibration(n_averaged, lost=lost)
        return Calibration(n_averaged, tuple(names), np.array(ports), np.array(slopes), lost)

    def _errors(
        self, band: int, bins: Int[np.ndarray, " left"], level: str, port: int
    ) -> list[tuple[str, Float[np.ndarray, " left"]]]:
        """What may be off about a level of a port, by one standard deviation."""
        found = []
        if self.gain_std is not None:
            found.append((f"{level}{port}", np.full(len(bins), self.gain_std)))
        if self.component_std is not None:
            std = self.component_std[LETTERS.index(level), port]
            slope = self.slope[band, port][:, bins]
            found += [(f"{level}{port} PC{r + 1}", std[r] * slope[r]) for r in range(len(std))]
        return found

    def without(self, band: int, gone: Bool[np.ndarray, "products bins"]) -> Reduced:
        """Return the same without some values of a band, which do not fit the map."""
        values, n_averaged, reason = self.values.copy(), self.n_averaged.copy(), self.reason.copy()
        values[band][gone] = np.nan
        bins = ~np.isfinite(values[band]).any(axis=0)
        n_averaged[band, bins] = 0.0
        reason[band, bins[self.bin_of] & (reason[band] == USED)] = NO_FIT
        changed = {"values": values, "n_averaged": n_averaged, "reason": reason}
        return replace(self, **changed)


def _medians(found: Float[np.ndarray, "bands parts"]) -> Float[np.ndarray, " bands"]:
    clean = [one[np.isfinite(one)] for one in found]
    return np.array([float(np.median(one)) if one.size else np.nan for one in clean])


def _mean_abs(bend: Float[np.ndarray, "ports bins"]) -> float:
    known = np.isfinite(bend).any(axis=1)
    return float(np.abs(np.nanmean(bend[known], axis=1)).max()) if known.any() else np.nan


def _one_run_an_angle(observation: Observation) -> Observation:
    """The same with a run for each stretch of one turntable angle, whatever the gains were."""
    angles = np.array(observation.turntable_deg)[observation.run]
    run, turntable_deg = runs_of(angles, observation.n_times)
    return replace(observation, run=run, turntable_deg=turntable_deg)


HINT = "make it with: lusee-bayes reduce SCENARIO SESSION..."
# what a run calls its file of them
REDUCED = "reduced.nc"
F, ROW, LEVELS = "frequency", "spectrum", len(LETTERS)
# what lengths that are given are called in files
LENGTHS = {PORTS: "port", LEVELS: "level_3"}


def _at(place: str, *dims: str | int, **rules: Any) -> tuple[str, Variable]:
    """Where a :class:`Reduced` has an array, and what a file has to hold of it."""
    return place, Variable(dims, **rules)


ARRAYS = {
    F: _at("frequencies_mhz", F, low=0.0, grows=True, unit="MHz"),
    "visibility": _at("values", F, "product", "bin", missing=True, unit="V^2/Hz"),
    "before_flags": _at("before", F, "product", "bin", missing=True, unit="V^2/Hz"),
    "n_averaged": _at("n_averaged", F, "bin", low=0.0),
    "level": _at("level", "bin", PORTS, kind="text", choices=(*LETTERS, NO_LEVEL)),
    "gain": _at("gain", F, PORTS, "bin", missing=True),
    "gain_slope": _at("slope", F, PORTS, "component", "bin", missing=True),
    "component_std": _at("component_std", LEVELS, PORTS, "component", low=0.0, optional=True),
    "curve_mhz": _at("curves.frequencies_mhz", "curve", low=0.0, grows=True, unit="MHz"),
    "curve_gain": _at("curves.gain", LEVELS, PORTS, "curve", missing=True),
    "curve_std": _at("curves.std", LEVELS, PORTS, "curve", missing=True),
    "scatter": _at("scatter", F, missing=True),
    "line_scatter": _at("line_scatter", F, missing=True),
    "curvature": _at("curvature", F, missing=True),
    "jd1": _at("observation.times.jd1", ROW),
    "jd2": _at("observation.times.jd2", ROW),
    "run": _at("observation.run", ROW, kind="integer", low=0.0),
    "bin_of": _at("bin_of", ROW, kind="integer", low=0.0),
    "window_start_s": _at("observation.windows.start_s", ROW, optional=True),
    "window_end_s": _at("observation.windows.end_s", ROW, optional=True),
    "live_s": _at("observation.windows.live_s", ROW, low=0.0, optional=True),
    "turntable_deg": _at("observation.turntable_deg", "run_number"),
    "reason": _at("reason", F, ROW, kind="integer", low=0.0, high=len(REASONS) - 1.0),
    "line_share": _at("lines", F, ROW, low=0.0, high=1.0),
}
STORED_AS = {"before_flags": np.float32, "level": object, "run": np.int32, "bin_of": np.int32}
COUNTS, UTC = {"units": "count / (nV^2/Hz)"}, {"scale": "utc"}
SAID = {"gain": COUNTS, "curve_gain": COUNTS, "curve_std": COUNTS, "jd1": UTC, "jd2": UTC}
SAID["reason"] = {"flag_meanings": ", ".join(REASONS)}
LAYOUT = Layout(
    "reduced spectra",
    {"product": Variable(("product",), "text")} | {name: one for name, (_, one) in ARRAYS.items()},
    {
        **PLACE_AND_TIME,
        "bandwidth_mhz": Attribute(low=0.0),
        "average_s": Attribute(low=0.0, optional=True),
        "gain_std": Attribute(low=0.0, optional=True),
        "sessions": Attribute("text"),
        # files of older versions do not say it
        "recipe": Attribute("text", optional=True),
    },
)


def write_reduced(path: str | Path, reduced: Reduced, scenario: str = "") -> Path:
    """Write reduced spectra, whole or not at all.

    Parameters
    ----------
    path : str or Path
    reduced : Reduced
    scenario : str
        Text of the scenario that they were reduced with.
    """
    variables = {}
    for name, (place, variable) in ARRAYS.items():
        value = reduced
        for part in place.split("."):
            value = None if value is None else getattr(value, part)
        if value is not None:
            dims = [LENGTHS.get(dim, dim) for dim in variable.dims]
            units = {"units": variable.unit} if variable.unit else {}
            stored = np.asarray(value, dtype=STORED_AS.get(name))
            variables[name] = (dims, stored, units | SAID.get(name, {}))
    seen, names = reduced.observation, ("bandwidth_mhz", "average_s", "gain_std")
    numbers = {name: getattr(reduced, name) for name in names}
    dataset = xr.Dataset(
        variables,
        coords={"product": list(labels())},
        attrs={
            "format": formats.REDUCED,
            "lon_deg": seen.lon_deg,
            "lat_deg": seen.lat_deg,
            "step_s": seen.step_s,
            "sessions": json.dumps([dict(one) for one in reduced.sessions]),
            "recipe": json.dumps(dict(reduced.recipe)),
            "scenario": scenario,
            "lusee_bayes_version": __version__,
            **{name: value for name, value in numbers.items() if value is not None},
        },
    )
    small = {"zlib": True, "complevel": 1}
    encoding = dict.fromkeys(("before_flags", "reason", "line_share", "visibility"), small)
    with replacing(path) as partial:
        dataset.to_netcdf(partial, engine="h5netcdf", encoding=encoding)
    return user_path(path)


def read_reduced(path: str | Path) -> Reduced:
    """Read reduced spectra.

    Parameters
    ----------
    path : str or Path

    Raises
    ------
    InputError
        If the file is missing, of another kind or damaged.
    """
    found = read_netcdf(path, formats.REDUCED, LAYOUT, HINT)
    here, said = found.arrays, found.values
    if tuple(map(str, here["product"])) != labels():
        raise InputError(f"{path} has other products than {', '.join(labels())}")
    told: dict[str, Any] = {}
    for name in ("sessions", "recipe"):
        try:
            told[name] = json.loads(said.get(name, "{}"))
        except json.JSONDecodeError as error:
            raise InputError(f"{path}: the attribute {name} is no JSON: {error}") from error
    windows = None
    with naming(path):
        if "window_start_s" in here and "window_end_s" in here:
            windows = Windows.whole(
                here["window_start_s"], here["window_end_s"], here.get("live_s")
            )
        observation = observation_of(found, utc_of_jd(found), windows)
    if here["bin_of"].max() >= found.sizes["bin"]:
        raise InputError(f"{path}: bin_of goes beyond the {found.sizes['bin']} bins")
    own = {place: here.get(name) for name, (place, _) in ARRAYS.items() if "." not in place}
    bend, scatter = own.pop("curvature")[:, None, None], own.pop("scatter")[:, None]
    return Reduced(
        bend=bend,
        span_scatter=scatter,
        slab_scatter=own.pop("line_scatter")[:, None],
        reason=own.pop("reason").astype(np.uint8),
        lines=own.pop("lines").astype(np.float32),
        **own,
        bandwidth_mhz=said["bandwidth_mhz"],
        observation=observation,
        average_s=said.get("average_s"),
        gain_std=said.get("gain_std"),
        curves=Curves(here["curve_mhz"], here["curve_gain"], here["curve_std"]),
        sessions=tuple(told["sessions"]),
        recipe=told["recipe"],
    )
