"""Spectra reduced to a number for each band, product and bin of time, with their flags."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float32, Int, Shaped, UInt8

from lusee_bayes.core import formats, reading
from lusee_bayes.core.checks import Described, counted, require_shape
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.trees import from_tree, opened_tree, quantity, write_tree
from lusee_bayes.flight.gain_model import COUNTS, LEAD, LETTERS, PLACES, Curves
from lusee_bayes.flight.session import FIRST_PORT, NO_LEVEL, PORTS, SECOND_PORT
from lusee_bayes.instrument import averaging, products
from lusee_bayes.instrument.beams.fields import place_of
from lusee_bayes.instrument.observation import Observation, runs_of
from lusee_bayes.instrument.times import Windows, utc_of
from lusee_bayes.instrument.visibilities import Calibration, Visibilities

# bins that are not empty
Left = Int[np.ndarray, " left"]

# why a spectrum is not used in a band; the first means that it is used
REASONS = (
    "used", "saturated", "no gain or no data", "comb", "too many channels flagged", "burst",
    "lacks a product of its bin", "does not fit the map",
)  # fmt: skip
USED, SATURATED, NO_DATA, COMB, TOO_MANY, BURST, PRODUCT, NO_FIT = range(len(REASONS))

# clock of a session whose own clock a clock file corrects
CORRECTED = "session, corrected by the clock file"

# limits for warnings: scatter over the radiometer noise, and the change by two more powers of the
# frequency, in standard deviations of a bin
NOISY, CURVED = 1.2, 0.5
# likewise, share of the spectra that is flagged
MUCH = 0.2


in_volts = partial(quantity, "V2 Hz-1", packed=True)


@dataclass(frozen=True, kw_only=True, repr=False, eq=False)
class Reduced(Described):
    """Spectra in bands, averaged over time.

    Numbers are for bands, products and bins of time; flags are for spectra ("rows").

    Attributes
    ----------
    jd1, jd2, run, window_start_s, window_end_s, live_s, turntable_deg, lon_deg, lat_deg, step_s
        The observation's, in the terms of :class:`.Observation` and :class:`.Windows`, with windows
        of one piece each; None for instants.
    frequencies_mhz : (bands,) array
    product : (products,) array of str
        Names of the package's products, in order.
    values : (bands, products, bins) array
        In V^2/Hz at the receivers' inputs, NaN where no data remain.
    before : (bands, products, bins) array
        Means before flagging, for figures.
    lines : (bands, rows) array
        Share of a spectrum's channels in a band that are flagged.
    n_averaged : (bands, bins) array
        Independent samples of voltages behind each value; 0 where no data remain.
    level : (bins, ports) array of str
        Levels of the gain.
    gain : (bands, ports, bins) array
        Counts for 1 nV^2/Hz.
    gain_slope : (bands, ports, components, bins) array
        Relative change of the power gain with each component of the gain table.
    component_std : (levels, ports, components) array or None
        Standard deviations of the components.
    curves : Curves
        The gains over frequency, for figures.
    scatter : (bands,) array
        Median scatter of the spectra in time over the radiometer noise; NaN if unknown.
    line_scatter : (bands,) array
        Median scatter of the channels about a smooth spectrum, likewise.
    curvature : (bands,) array
        Change of the autos by two further powers of the frequency, in standard deviations: the mean
        over bins, where noise averages out, for the worst port.
    bin_of : (rows,) array of int
        Time bin of each spectrum.
    reason : (bands, rows) array of uint8
        Why a spectrum is not used, as an index of :data:`REASONS`.
    bandwidth_mhz : float
    average_s : float or None
        Length of the bins; None if each spectrum is one.
    gain_std : float or None
        Relative standard deviation of the gains of a level of a port.
    sessions : tuple of dict
        Origin of the spectra.
    recipe : dict of str to str
        How they were reduced, in words.
    """

    jd1: Float[np.ndarray, " spectrum"] = quantity("d", "Julian date, UTC", checks={})
    jd2: Float[np.ndarray, " spectrum"] = quantity("d", "its second part", checks={})
    run: Int[np.ndarray, " spectrum"] = quantity("1", checks={"low": 0.0})
    window_start_s: Float[np.ndarray, " spectrum"] | None = quantity("s", checks={}, default=None)
    window_end_s: Float[np.ndarray, " spectrum"] | None = quantity("s", checks={}, default=None)
    live_s: Float[np.ndarray, " spectrum"] | None = quantity("s", checks={"low": 0.0}, default=None)
    turntable_deg: Float[np.ndarray, " state"] = quantity("degree", checks={})
    lon_deg: float
    lat_deg: float
    step_s: float
    frequencies_mhz: Float[np.ndarray, " frequency"] = quantity(
        "MHz", checks={"low": 0.0, "grows": True, "unit": "MHz"}, stored="frequency"
    )
    product: Shaped[np.ndarray, " product"] = quantity("", checks={"choices": products.labels()})
    values: Float[np.ndarray, "frequency product bin"] = in_volts(stored="visibility")
    before: Float32[np.ndarray, "frequency product bin"] = in_volts(stored="before_flags")
    lines: Float32[np.ndarray, "frequency spectrum"] = quantity(
        "1", "flagged channels", checks={"low": 0.0, "high": 1.0}, packed=True, stored="line_share"
    )
    n_averaged: Float[np.ndarray, "frequency bin"] = quantity("1", checks={"low": 0.0})
    level: Shaped[np.ndarray, "bin port"] = quantity("", checks={"choices": (*LETTERS, NO_LEVEL)})
    gain: Float[np.ndarray, "frequency port bin"] = quantity(COUNTS)
    gain_slope: Float[np.ndarray, "frequency port component bin"] = quantity("1")
    component_std: Float[np.ndarray, "letter port component"] | None = quantity(
        "1", checks={"low": 0.0}
    )
    curves: Curves
    scatter: Float[np.ndarray, " frequency"] = quantity("1", "over radiometer noise, in time")
    line_scatter: Float[np.ndarray, " frequency"] = quantity("1", "of channels, likewise")
    curvature: Float[np.ndarray, " frequency"] = quantity("1", "in standard deviations")
    bin_of: Int[np.ndarray, " spectrum"] = quantity("1", checks={"low": 0.0})
    reason: UInt8[np.ndarray, "frequency spectrum"] = quantity(
        "1",
        checks={"low": 0.0, "high": len(REASONS) - 1.0},
        attributes={
            "flag_values": np.arange(len(REASONS), dtype=np.uint8),
            "flag_meanings": " ".join(reason.replace(" ", "_") for reason in REASONS),
        },
        packed=True,
    )
    bandwidth_mhz: float
    average_s: float | None
    gain_std: float | None
    sessions: tuple[dict[str, Any], ...]
    recipe: dict[str, str]

    @cached_property
    def observation(self) -> Observation:
        """A sample for each spectrum; a run for each state of the spectrometer."""
        windows = None
        if self.window_start_s is not None and self.window_end_s is not None:
            windows = Windows.whole(self.window_start_s, self.window_end_s, self.live_s)
        place, times = (self.lon_deg, self.lat_deg), utc_of(self.jd1, self.jd2)
        runs = self.run, tuple(self.turntable_deg.tolist()), self.step_s
        return Observation(*place, times, *runs, windows=windows)

    def description(self) -> tuple[str, ...]:
        f = self.frequencies_mhz
        between = f"{f[0]:g} MHz" if len(f) == 1 else f"{f[0]:g} to {f[-1]:g} MHz"
        return (
            f"{counted(len(self.bin_of), 'spectrum', 'spectra')} of "
            f"{counted(len(self.sessions), 'session')} in {counted(self.values.shape[2], 'bin')}",
            f"{counted(len(f), 'band')} of {self.bandwidth_mhz:g} MHz at {between}",
            f"{(self.reason == USED).mean():.2%} of the spectra are used",
            *self.observation.description(),
            *(f"{name}: {text}" for name, text in self.recipe.items()),
            *self.notes(),
            *(f"{mhz:g} MHz: {_percent(self.shares(band))}" for band, mhz in enumerate(f)),
        )

    def notes(self) -> tuple[str, ...]:
        """Return the inputs that do not come from the sessions, a sentence each."""
        if corrected := {s["clock_file"] for s in self.sessions if s["clock"] == CORRECTED}:
            return (f"The UTC stated in the sessions is corrected by {corrected.pop()}.",)
        by_file = [s for s in self.sessions if s["clock"] == "clock file" and s.get("clock_file")]
        if not by_file:
            return ()
        who = Path(by_file[0]["file"]).name if len(by_file) == 1 else f"{len(by_file)} sessions"
        verb = "does" if len(by_file) == 1 else "do"
        return (
            f"{who} {verb} not specify the UTC of the clock: its scale "
            f"({by_file[0]['scale'].upper()}) and epoch come from the clock file "
            f"{by_file[0]['clock_file']}.",
        )

    def band(self, frequency_mhz: float) -> int:
        """Return the number of the band at a frequency; InputError if there is none."""
        return place_of("the reduction has no band", self.frequencies_mhz, frequency_mhz)

    def bins_at(self, band: int) -> Left:
        """Return the bins in which a band has data: the times of :meth:`at`."""
        return np.flatnonzero(np.isfinite(self.values[band]).any(axis=0))

    def shares(self, band: int) -> dict[str, float]:
        """Return the share of the spectra that are used, and that are rejected for each reason."""
        shares = self._counts(band) / self.reason.shape[1]
        return {name: float(shares[k]) for k, name in enumerate(REASONS) if shares[k] or not k}

    def _counts(self, band: int | None) -> Int[np.ndarray, " reasons"]:
        rows = self.reason if band is None else self.reason[band]
        return np.bincount(rows.ravel(), minlength=len(REASONS))

    def flagged(self, band: int | None = None, misfit: float = 0.0) -> dict[str, float]:
        """Return the share of the existing values that each rule flagged.

        Parameters
        ----------
        band : int, optional
            By default all bands.
        misfit : float
            Share of the values left by the other rules that is inconsistent with the map.
        """
        counts = self._counts(band)
        counts[[USED, NO_DATA]] = counts[USED] + counts[NO_FIT], 0
        shares = counts / max(counts.sum() - counts[NO_FIT], 1)
        shares[NO_FIT] = misfit * shares[USED]
        return {REASONS[k]: float(shares[k]) for k in range(1, len(REASONS)) if shares[k]}

    def flag_line(self, band: int | None = None, misfit: float = 0.0) -> str:
        """Return the flagged shares in words; see :meth:`flagged`."""
        shares = self.flagged(band, misfit)
        rules = f": {_percent(shares)}" if shares else ""
        return f"flagged {sum(shares.values()):.2%} of the values{rules}"

    def doubts(self, band: int) -> tuple[str, ...]:
        """Return the doubts about a band, a sentence each."""
        sentences = []
        if sum(self.flagged(band).values()) > MUCH:
            sentences.append(
                f"The reduction {self.flag_line(band)}. This is more than 20 %: check the "
                "sessions, flight.false_alarm, flight.lines and flight.comb."
            )
        noise, curvature = float(self.scatter[band]), float(self.curvature[band])
        if noise > NOISY:
            sentences.append(
                f"The scatter of spectra in time is {noise:.2g} times the radiometer noise: gains "
                "drift, or something other than the sky changes; consider noise.gain."
            )
        if curvature > CURVED:
            sentences.append(
                "A polynomial of degree flight.degree does not fit the band: two more powers "
                f"change a value by {curvature:.2g} standard deviations; use a smaller "
                "flight.bandwidth_hz, or a higher flight.degree."
            )
        return tuple(sentences)

    def at(self, frequency_mhz: float, per_kelvin: Float[np.ndarray, " ports"]) -> Visibilities:
        """Return one band.

        Parameters
        ----------
        frequency_mhz : float
        per_kelvin : (ports,) array
            V^2/Hz at each port in an enclosure at 1 K.

        Returns
        -------
        Visibilities
            In K, with their calibration.

        Raises
        ------
        InputError
            If there is no such band, or it has no data.
        """
        band = self.band(frequency_mhz)
        present = np.isfinite(self.values[band])
        if not (bins := self.bins_at(band)).size:
            counts = zip(REASONS[1:], self._counts(band)[1:], strict=True)
            raise InputError(
                f"no spectra are left at {frequency_mhz:g} MHz: of {self.reason.shape[1]}, "
                f"{', '.join(f'{name} {n}' for name, n in counts if n)}"
            )
        keep = (self.reason[band] == USED) & np.isin(self.bin_of, bins)
        if self.average_s is None:
            observation = self.observation.select(keep)
        else:
            observation = averaging.binned(self.observation, keep, self.bin_of, self.average_s)
        scale = np.sqrt(per_kelvin[FIRST_PORT] * per_kelvin[SECOND_PORT])
        values = np.where(present, self.values[band], 0.0)[:, bins] / scale[:, None]
        layout = products.DataLayout.from_flags(~present[:, bins])
        # whatever the gains, a run lasts while the turntable stands still
        angle = np.array(observation.turntable_deg)[observation.run]
        run, angles = runs_of(angle, observation.n_times)
        observation = replace(observation, run=run, turntable_deg=angles)
        mhz = float(self.frequencies_mhz[band])
        stds = {n: x for place in PLACES for n, x in self._errors(band, bins, place) if x.any()}
        n_averaged, lost = self.n_averaged[band, bins], float(sum(self.flagged(band).values()))
        calibration = Calibration(n_averaged, lost=lost)
        if stds:
            ports, slopes = [PLACES[name[:2]][1] for name in stds], np.array(list(stds.values()))
            calibration = Calibration(n_averaged, tuple(stds), np.array(ports), slopes, lost)
        data = layout.gather(values)
        return Visibilities(data, layout, observation, mhz, calibration=calibration)

    def _errors(self, band: int, bins: Left, place: str) -> Iterator[tuple[str, np.ndarray]]:
        """Errors of a level of a port (one standard deviation), at the times when it is used."""
        port = PLACES[place][1]
        at_level = self.level[bins, port] == place[0]
        if self.gain_std is not None:
            yield place, np.where(at_level, self.gain_std, 0.0)
        if self.component_std is not None:
            for r, std in enumerate(self.component_std[PLACES[place]]):
                slope = std * self.gain_slope[band, port, r, bins]
                yield f"{place} PC{r + 1}", np.where(at_level, slope, 0.0)

    def without(self, band: int, gone: Bool[np.ndarray, "products bins"]) -> "Reduced":
        """Return the reduction without some values of a band, which do not fit the map."""
        values, n_averaged, reason = self.values.copy(), self.n_averaged.copy(), self.reason.copy()
        values[band][gone] = np.nan
        bins = ~np.isfinite(values[band]).any(axis=0)
        n_averaged[band, bins] = 0.0
        reason[band, bins[self.bin_of] & (reason[band] == USED)] = NO_FIT
        return replace(self, values=values, n_averaged=n_averaged, reason=reason)


def _percent(shares: Mapping[str, float]) -> str:
    return ", ".join(f"{name} {share:.2%}" for name, share in shares.items())


HINT = "make it with: lusee-bayes reduce SCENARIO SESSION..."
# name of the file of reduced spectra in a run
REDUCED = "reduced.nc"


def write_reduced(path: str | Path, reduced: Reduced, scenario: str = "") -> Path:
    """Write reduced spectra, complete or not at all.

    Parameters
    ----------
    path : str or Path
    reduced : Reduced
    scenario : str
        Text of the scenario of the reduction.
    """
    return write_tree(path, reduced, formats.REDUCED, {"scenario": scenario})


def read_reduced(path: str | Path) -> "Reduced":
    """Read reduced spectra.

    Parameters
    ----------
    path : str or Path

    Raises
    ------
    InputError
        If the file is missing, of another kind or damaged.
    """
    with opened_tree(path, formats.REDUCED, "reduced spectra", HINT) as tree:
        read = from_tree(Reduced, tree, str(path))
    if tuple(read.product) != products.labels():
        raise InputError(f"{path} does not have the products {', '.join(products.labels())}")
    with reading.naming(path):
        require_shape("level", read.level, (None, PORTS))
        require_shape("curves", read.curves.gain, (*LEAD, None))
        if read.component_std is not None:
            require_shape("component_std", read.component_std, (*LEAD, None))
        require_shape("the times", read.observation.times, read.bin_of.shape)
    if read.bin_of.max() >= read.n_averaged.shape[1]:
        raise InputError(f"{path}: bin_of exceeds the {read.n_averaged.shape[1]} bins")
    return read
