"""Values of bands and bins as they grow, piece by piece."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import astropy.units as u
import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8

from lusee_bayes.instrument.averaging import by_the_rule
from lusee_bayes.instrument.flight.bursts import burst_flags
from lusee_bayes.instrument.flight.gain_curves import gain_curves
from lusee_bayes.instrument.flight.recipe import Recipe
from lusee_bayes.instrument.flight.reduced import (
    BURST,
    COMB,
    CORRECTED,
    NO_DATA,
    PRODUCT,
    SATURATED,
    TOO_MANY,
    USED,
    Reduced,
)
from lusee_bayes.instrument.flight.session import Session
from lusee_bayes.instrument.flight.slab import AUTOS, BandValues
from lusee_bayes.instrument.flight.spectrometer import PORTS
from lusee_bayes.instrument.flight.timeline import Timeline
from lusee_bayes.instrument.products import all_products
from lusee_bayes.instrument.times import unannounced_leap_seconds

N_PRODUCTS = len(all_products())


@dataclass
class Accumulated:
    """Results as they grow; see :class:`.Reduced`.

    Attributes
    ----------
    values, before : (bands, products, bins) array
    n_averaged : (bands, bins) array
    gain : (bands, ports, bins) array
    slope : (bands, ports, components, bins) array
    reason : (bands, rows) array of uint8
    lines : (bands, rows) array
    further : (bands, ports, bins) array
        What two more powers of the frequency would add to the autos.
    scatter, line_scatter : list of list of float
        Of every band, as they were found.
    """

    values: Float[np.ndarray, "bands products bins"]
    before: Float[np.ndarray, "bands products bins"]
    n_averaged: Float[np.ndarray, "bands bins"]
    gain: Float[np.ndarray, "bands ports bins"]
    slope: Float[np.ndarray, "bands ports components bins"]
    reason: UInt8[np.ndarray, "bands rows"]
    lines: Float32[np.ndarray, "bands rows"]
    further: Float[np.ndarray, "bands ports bins"]
    scatter: list[list[float]] = field(default_factory=list)
    line_scatter: list[list[float]] = field(default_factory=list)

    @classmethod
    def empty(cls, line: Timeline, recipe: Recipe) -> Accumulated:
        """Begin with nothing."""
        f, n, rows = len(recipe.frequencies_mhz), line.n_bins, len(line.bin_of)
        return cls(
            np.full((f, N_PRODUCTS, n), np.nan),
            np.full((f, N_PRODUCTS, n), np.nan),
            np.zeros((f, n)),
            np.full((f, PORTS, n), np.nan),
            np.zeros((f, PORTS, 2, n)),
            np.zeros((f, rows), dtype=np.uint8),
            np.zeros((f, rows), dtype=np.float32),
            np.full((f, PORTS, n), np.nan),
            [[] for _ in range(f)],
            [[] for _ in range(f)],
        )

    def reduced(self, line: Timeline, recipe: Recipe) -> Reduced:
        """Return what has been found."""
        first = np.searchsorted(line.bin_of, np.arange(line.n_bins))
        level = np.concatenate([s.level for s in line.sessions])[first]
        autos = self.values[:, AUTOS]
        with np.errstate(invalid="ignore", divide="ignore"):
            noise = np.abs(autos) / np.sqrt(self.n_averaged)[:, None]
            off = np.where(np.isfinite(self.further) & (noise > 0.0), self.further / noise, np.nan)
        return Reduced(
            np.array(recipe.frequencies_mhz),
            recipe.bandwidth_mhz,
            line.observation,
            line.bin_of,
            recipe.average_s,
            self.reason,
            self.values,
            self.before,
            self.n_averaged,
            level,
            self.gain,
            self.slope,
            recipe.table.component_std,
            recipe.gain_std,
            _medians(self.scatter),
            _medians(self.line_scatter),
            np.array([_mean_abs(one) for one in off]),
            self.lines,
            gain_curves(line, recipe),
            tuple(_origin(s, recipe) for s in line.sessions),
            recipe.words(),
        )

    def put(
        self,
        piece: slice,
        bands: list[list[BandValues]],
        line: Timeline,
        recipe: Recipe,
        number: int,
    ) -> None:
        """Flag bursts in a band's values of a piece, and average each of its bins."""
        parts = bands[number]

        def whole(name: str) -> np.ndarray:
            return np.concatenate([getattr(part, name) for part in parts])

        session = line.sessions[int(line.session[piece.start])]
        here = slice(int(line.row[piece.start]), int(line.row[piece.stop - 1]) + 1)
        frames, window = session.frames[here], session.window_s[here]
        values, variance = whole("values"), whole("variance")
        reason = np.full(len(values), USED, dtype=np.uint8)
        reason[~np.isfinite(variance)] = TOO_MANY
        reason[~whole("clean")] = COMB
        reason[~whole("whole")] = NO_DATA
        reason[session.saturated[here]] = SATURATED
        good = reason == USED
        with unannounced_leap_seconds():
            times = line.observation.times[piece]
            seconds = (times - times[0]).to_value(u.s)
        autos = values[:, AUTOS]
        # what is absent neither stands out nor tells
        there = np.isfinite(autos)
        filled = np.where(there, autos, 0.0)
        with np.errstate(invalid="ignore"):
            noise = np.abs(filled) * np.sqrt(np.where(good, variance, 1.0) / frames)[:, None]
        noise = np.where(there & (noise > 0.0), noise, np.inf)
        burst, scatter = burst_flags(seconds, filled, noise, good, recipe.false_alarm)
        reason[burst] = BURST
        self.scatter[number].extend(scatter.tolist())
        self.line_scatter[number].extend(part.scatter for part in parts)
        live = window * session.share[here]
        bin_of = line.bin_of[piece]
        first = int(bin_of[0])
        good = reason == USED
        present = np.isfinite(values).T & good
        kept, used = by_the_rule(present, bin_of - first, live)
        reason[good & ~used] = PRODUCT
        self.reason[number, piece] = reason
        self.lines[number, piece] = whole("lines")
        self._average(number, bin_of, kept, used, live, frames, variance, parts)

    def _average(
        self,
        number: int,
        bin_of: Int[np.ndarray, " rows"],
        kept: Bool[np.ndarray, "products bins"],
        used: Bool[np.ndarray, " rows"],
        live: Float[np.ndarray, " rows"],
        frames: Float[np.ndarray, " rows"],
        variance: Float[np.ndarray, " rows"],
        parts: list[BandValues],
    ) -> None:
        """Means over the spectra of each bin, each with the weight of its live time."""

        def mean(name: str, weights: Float[np.ndarray, " rows"]) -> np.ndarray:
            values = np.concatenate([getattr(part, name) for part in parts])
            weights = weights.reshape(-1, *(1,) * (values.ndim - 1))
            known = np.isfinite(values) * weights
            total, summed = (np.zeros((n, *values.shape[1:])) for _ in range(2))
            np.add.at(total, at, known)
            np.add.at(summed, at, np.where(known > 0.0, values, 0.0) * weights)
            with np.errstate(invalid="ignore", divide="ignore"):
                return summed / total

        first, n = int(bin_of[0]), int(bin_of[-1] - bin_of[0]) + 1
        at = bin_of - first
        bins = slice(first, first + n)
        weights = np.where(used, live, 0.0)
        some = np.bincount(at, weights, n) > 0.0
        self.values[number][:, bins] = np.where(kept & some, mean("values", weights).T, np.nan)
        self.before[number][:, bins] = mean("before", live).T
        self.further[number][:, bins] = np.where(some, mean("further", weights).T, np.nan)
        self.gain[number][..., bins] = np.moveaxis(mean("gain", live), 0, -1)
        self.slope[number][..., bins] = np.moveaxis(mean("slope", live), 0, -1)
        # the variance of a weighted mean of spectra, each of frames / variance independent samples
        with np.errstate(invalid="ignore", divide="ignore"):
            squares = np.where(used, weights**2 * variance / frames, 0.0)
            n_averaged = np.bincount(at, weights, n) ** 2 / np.bincount(at, squares, n)
        self.n_averaged[number, bins] = np.where(some, n_averaged, 0.0)


def _medians(found: list[list[float]]) -> Float[np.ndarray, " bands"]:
    clean = [np.array(one)[np.isfinite(one)] for one in found]
    return np.array([float(np.median(one)) if one.size else np.nan for one in clean])


def _mean_abs(off: Float[np.ndarray, "ports bins"]) -> float:
    """Size of a common offset: the mean over bins, which noise does not have, of each port."""
    known = np.isfinite(off).any(axis=1)
    return float(np.abs(np.nanmean(off[known], axis=1)).max()) if known.any() else np.nan


def _origin(session: Session, recipe: Recipe) -> Mapping[str, Any]:
    clock = recipe.clock or session.clock
    return {
        "file": str(session.path),
        "kind": session.kind,
        "layout": session.layout,
        "spectra": session.n_rows,
        "software": session.software,
        "navgf": sorted({int(n) for n in session.navgf}),
        "levels": sorted({"".join(row) for row in session.level}),
        "window_s": float(session.window_s.max()),
        "saturated": int(session.saturated.sum()),
        "errors": int((session.errors != 0).sum()),
        "clock": _whose(session, recipe),
        "clock_file": None if recipe.clock is None else Path(recipe.clock.source).name,
        "scale": None if clock is None else clock.scale,
        "rate": 1.0 if clock is None else clock.rate,
        "first_s": float(session.raw_s[0]),
        "last_s": float(session.raw_s[-1]),
    }


def _whose(session: Session, recipe: Recipe) -> str:
    """Who says which UTC a session's clock stands for."""
    if session.clock is None:
        return "clock file"
    corrected = recipe.clock is not None and recipe.clock.stated is not None
    return CORRECTED if corrected else "session"
