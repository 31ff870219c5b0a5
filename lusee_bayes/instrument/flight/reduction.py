"""Reduce sessions of any length: calibrate, flag and average, one piece after the other.

All spectra of a few bins of time are read at once; no more of the spectra is ever in memory.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import astropy.units as u
import numpy as np
from jaxtyping import Bool, Float, Int

from lusee_bayes.core.errors import InputError
from lusee_bayes.core.progress import Stages
from lusee_bayes.core.threads import in_threads
from lusee_bayes.instrument.averaging import by_the_rule
from lusee_bayes.instrument.flight.bursts import burst_flags
from lusee_bayes.instrument.flight.gain_table import LETTERS
from lusee_bayes.instrument.flight.recipe import Recipe
from lusee_bayes.instrument.flight.reduced import (
    BURST,
    COMB,
    NO_DATA,
    PRODUCT,
    SATURATED,
    TOO_MANY,
    USED,
    Curves,
    Reduced,
)
from lusee_bayes.instrument.flight.session import Read, Session
from lusee_bayes.instrument.flight.slab import AUTOS, BandValues, Slab, State
from lusee_bayes.instrument.flight.spectrometer import PORTS
from lusee_bayes.instrument.flight.timeline import Timeline, timeline
from lusee_bayes.instrument.products import all_products
from lusee_bayes.instrument.times import unannounced_leap_seconds

# spectra that are worked on at once, and at least how many make a piece between two bins
SLAB, PIECE = 128, 1024
# of the curves of gains: first, last, and how many
CURVE_MHZ = (0.5, 51.0, 203)
N_PRODUCTS = len(all_products())


def reduce_sessions(
    sessions: Sequence[Session], recipe: Recipe, stages: Stages | None = None
) -> Reduced:
    """Reduce sessions.

    Parameters
    ----------
    sessions : sequence of Session
    recipe : Recipe
    stages : Stages, optional
        Told how far it is.

    Returns
    -------
    Reduced

    Raises
    ------
    InputError
        If clocks, sites or times are not known or contradict each other, a session lacks telemetry,
        or bands have too few channels.
    """
    stages = stages or Stages()
    line = timeline(sessions, recipe)
    if recipe.average_s is not None and recipe.average_s < line.observation.step_s:
        raise InputError(
            f"the spectra are to be averaged over {recipe.average_s:g} s, and last for "
            f"{line.observation.step_s:g} s; use a longer observation.average_s, or none"
        )
    made = _Made.empty(line, recipe)
    pieces = _pieces(line)
    numbers = range(len(recipe.frequencies_mhz))
    with (
        stages.progress("spectra", len(line.bin_of)) as done,
        ExitStack() as files,
        ThreadPoolExecutor(1) as ahead,
    ):
        for piece, slabs in _read_ahead(ahead, files, pieces, line, recipe):
            bands = [[slab[k] for slab in slabs] for k in numbers]
            in_threads(partial(_put, made, piece, bands, line, recipe), numbers)
            done(piece.stop)
    return made.reduced(line, recipe)


@dataclass
class _Made:
    """Results as they grow."""

    values: Float[np.ndarray, "bands products bins"]
    before: Float[np.ndarray, "bands products bins"]
    n_averaged: Float[np.ndarray, "bands bins"]
    gain: Float[np.ndarray, "bands ports bins"]
    slope: Float[np.ndarray, "bands ports components bins"]
    reason: np.ndarray
    lines: np.ndarray
    further: Float[np.ndarray, "bands ports bins"]
    scatter: list[list[float]] = field(default_factory=list)
    line_scatter: list[list[float]] = field(default_factory=list)

    @classmethod
    def empty(cls, line: Timeline, recipe: Recipe) -> _Made:
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
            _curves(line, recipe),
            tuple(_origin(s) for s in line.sessions),
        )


def _medians(found: list[list[float]]) -> Float[np.ndarray, " bands"]:
    clean = [np.array(one)[np.isfinite(one)] for one in found]
    return np.array([float(np.median(one)) if one.size else np.nan for one in clean])


def _mean_abs(off: Float[np.ndarray, "ports bins"]) -> float:
    """Size of a common offset: the mean over bins, which noise does not have, of each port."""
    known = np.isfinite(off).any(axis=1)
    return float(np.abs(np.nanmean(off[known], axis=1)).max()) if known.any() else np.nan


def _curves(line: Timeline, recipe: Recipe) -> Curves:
    """Gains of every level of every port that some spectrum has."""
    mhz = np.linspace(*CURVE_MHZ)
    shape = (len(LETTERS), PORTS, len(mhz))
    gain, std = np.full(shape, np.nan), np.zeros(shape)
    levels = np.concatenate([s.level for s in line.sessions])
    telemetry = {
        name: np.array([np.concatenate([s.telemetry[name] for s in line.sessions]).mean()])
        for name in line.sessions[0].telemetry
    }
    table = recipe.table
    for number, level in enumerate(LETTERS):
        for port in np.flatnonzero((levels == level).any(axis=0)).tolist():
            basis = table.basis(level, port, mhz)
            strengths = table.strengths(level, port, telemetry)[0]
            gain[number, port] = basis[0] + strengths @ basis[1:]
            variance = (0.0 if recipe.gain_std is None else recipe.gain_std) ** 2 * np.square(
                gain[number, port]
            )
            if table.component_std is not None:
                variance = variance + np.square(
                    table.component_std[number, port][:, None] * basis[1:]
                ).sum(axis=0)
            std[number, port] = np.sqrt(variance)
    return Curves(mhz, gain, std)


def _origin(session: Session) -> Mapping[str, Any]:
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
        "clock": "clock file" if session.clock is None else "session",
        "first_s": float(session.raw_s[0]),
        "last_s": float(session.raw_s[-1]),
    }


def _pieces(line: Timeline) -> list[slice]:
    """Rows of whole bins of one state, as few as ``PIECE`` allows."""
    run, bin_of = line.observation.run, line.bin_of
    ends = np.flatnonzero(np.append(np.diff(bin_of) != 0, True)) + 1
    pieces, start = [], 0
    for k, end in enumerate(ends):
        last = k + 1 == len(ends)
        if last or end - start >= PIECE or run[ends[k + 1] - 1] != run[start]:
            pieces.append(slice(start, int(end)))
            start = int(end)
    return pieces


def _read_ahead(
    ahead: ThreadPoolExecutor,
    files: ExitStack,
    pieces: list[slice],
    line: Timeline,
    recipe: Recipe,
) -> Iterator[tuple[slice, list[list[BandValues]]]]:
    """Values of every piece, a list for each slab; the next counts are read meanwhile."""
    reads: dict[int, Read] = {}
    states: dict[Any, State] = {}
    slabs = [
        (number, slice(start, min(start + SLAB, piece.stop)))
        for number, piece in enumerate(pieces)
        for start in range(piece.start, piece.stop, SLAB)
    ]

    def counts(rows: slice) -> np.ndarray:
        session = int(line.session[rows.start])
        if session not in reads:
            reads[session] = files.enter_context(line.sessions[session].spectra())
        first = int(line.row[rows.start])
        return reads[session](first, first + rows.stop - rows.start)

    following: Future[np.ndarray] = ahead.submit(counts, slabs[0][1])
    found: list[list[BandValues]] = []
    for k, (number, rows) in enumerate(slabs):
        spectra = following.result()
        if k + 1 < len(slabs):
            following = ahead.submit(counts, slabs[k + 1][1])
        slab = _slab(line, recipe, states, rows, spectra)
        found.append(in_threads(slab.values, range(len(recipe.frequencies_mhz))))
        if k + 1 == len(slabs) or slabs[k + 1][0] != number:
            yield pieces[number], found
            found = []


def _slab(
    line: Timeline,
    recipe: Recipe,
    states: dict[Any, State],
    rows: slice,
    counts: np.ndarray,
) -> Slab:
    session = line.sessions[int(line.session[rows.start])]
    here = slice(int(line.row[rows.start]), int(line.row[rows.stop - 1]) + 1)
    levels = tuple(str(level) for level in session.level[here.start])
    key = (int(session.navgf[here.start]), levels)
    if key not in states:
        states[key] = State.of(recipe, *key)
    state = states[key]
    telemetry = {name: values[here] for name, values in session.telemetry.items()}
    n = rows.stop - rows.start
    notched = np.zeros(n, dtype=bool) if session.notch is None else _notched(session.notch[here])
    try:
        strengths = state.strengths(telemetry, n)
    except InputError as error:
        raise InputError(f"{session.path}: {error}") from error
    return Slab.of(state, counts, session.frames[here], strengths, session.saturated[here], notched)


def _notched(notch: Int[np.ndarray, " rows"]) -> Bool[np.ndarray, " rows"]:
    """Whether the mean of the comb's channels is subtracted: bit 4 says that it is not."""
    return ((notch & 0b111) > 0) & ((notch & 0b10000) == 0)


def _put(
    made: _Made,
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
    made.scatter[number].extend(scatter.tolist())
    made.line_scatter[number].extend(part.scatter for part in parts)
    live = window * session.share[here]
    bin_of = line.bin_of[piece]
    first = int(bin_of[0])
    good = reason == USED
    present = np.isfinite(values).T & good
    kept, used = by_the_rule(present, bin_of - first, live)
    reason[good & ~used] = PRODUCT
    made.reason[number, piece] = reason
    made.lines[number, piece] = whole("lines")
    _average(made, number, bin_of, kept, used, live, frames, variance, parts)


def _average(
    made: _Made,
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
    made.values[number][:, bins] = np.where(kept & some, mean("values", weights).T, np.nan)
    made.before[number][:, bins] = mean("before", live).T
    made.further[number][:, bins] = np.where(some, mean("further", weights).T, np.nan)
    made.gain[number][..., bins] = np.moveaxis(mean("gain", live), 0, -1)
    made.slope[number][..., bins] = np.moveaxis(mean("slope", live), 0, -1)
    # the variance of a weighted mean of spectra, each of frames / variance independent samples
    with np.errstate(invalid="ignore", divide="ignore"):
        squares = np.where(used, weights**2 * variance / frames, 0.0)
        n_averaged = np.bincount(at, weights, n) ** 2 / np.bincount(at, squares, n)
    made.n_averaged[number, bins] = np.where(some, n_averaged, 0.0)
