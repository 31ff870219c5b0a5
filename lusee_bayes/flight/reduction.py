"""Reduce sessions of any length: calibrate, flag and average, piece by piece.

Counts are read in slabs. All spectra of a few bins of time form a piece. They are calibrated and
put into bands, each spectrum as a separate bin, and bursts are flagged; then they are averaged into
the final bins. In memory are the bands of one piece, and two slabs, the second being read ahead.
"""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from functools import lru_cache, partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from lusee_bayes.core import engine, progress, reading
from lusee_bayes.core.arrays import Rows
from lusee_bayes.core.lazy import xarray
from lusee_bayes.flight import flags, gain_model, reduced, session
from lusee_bayes.flight.bands import ChannelBand, shared_noise
from lusee_bayes.flight.recipe import Recipe, Timeline, timeline
from lusee_bayes.instrument.averaging import by_the_rule
from lusee_bayes.instrument.products import labels
from lusee_bayes.instrument.times import seconds_from

# spectra in a slab, and fewest spectra of a piece that ends between two bins
SLAB, PIECE = 128, 1024
# numbers of a band by their names in Reduced, without the axis of bands: of some spectra, each of
# which is a bin, or of the bins of a piece. Also "bend", the change of the autos by two further
# powers of the frequency in standard deviations (ports, bins). "scatter" has a value for every span
# of a few hours, "line_scatter" one for every slab
Parts = dict[str, np.ndarray]


def reduce_sessions(
    sessions: Sequence[session.Session], recipe: Recipe, stages: progress.Stages | None = None
) -> reduced.Reduced:
    """Reduce sessions.

    Parameters
    ----------
    sessions : sequence of Session
    recipe : Recipe
    stages : Stages, optional
        Receives the progress.

    Raises
    ------
    InputError
        If clocks, sites or times are unknown or contradict each other, a session lacks telemetry,
        or bands have too few channels.
    """
    stages, line = stages or progress.Stages(), timeline(sessions, recipe)
    level = np.concatenate([s.level for s in line.sessions])
    first = np.searchsorted(line.bin_of, np.arange(line.bin_of[-1] + 1))
    live_s, times = line.observation.live_s, line.observation.times
    numbers, averages = range(len(recipe.frequencies_mhz)), []
    with (
        stages.progress("spectra", len(line.bin_of)) as done,
        ExitStack() as files,
        ThreadPoolExecutor(1) as ahead,
    ):
        pieces = _pieces(line)
        counts = _read_ahead(ahead, files, line, [rows for slabs in pieces for rows in slabs])
        for slabs in pieces:
            piece = slice(slabs[0].start, slabs[-1].stop)
            calibrators = (_slab(line, recipe, rows.start, next(counts)) for rows in slabs)
            parts = [engine.in_threads(calibrate, numbers) for calibrate in calibrators]
            spectra = [_joined(band) for band in zip(*parts, strict=True)]
            seconds = seconds_from(times[piece.start], times[piece])
            of_piece = seconds, live_s[piece], line.bin_of[piece], recipe.section.false_alarm
            averages.append(engine.in_threads(partial(_finish, *of_piece), spectra))
            done(piece.stop)
    bands = [_joined(band) for band in zip(*averages, strict=True)]
    whole = {name: np.stack([band[name] for band in bands]) for name in bands[0]}
    bend = xarray.DataArray(whole.pop("bend"), dims=("band", "port", "bin")).mean("bin")
    for name in ("scatter", "line_scatter"):
        whole[name] = xarray.DataArray(whole[name], dims=("band", "part")).median("part").values
    window, windows = {}, line.observation.windows
    if windows is not None:
        window = {"window_start_s": windows.start_s, "window_end_s": windows.end_s}
        window["live_s"] = windows.live_s
    names = line.sessions[0].telemetry
    telemetry = {n: np.concatenate([s.telemetry[n] for s in line.sessions]) for n in names}
    return reduced.Reduced(
        frequencies_mhz=np.array(recipe.frequencies_mhz),
        bandwidth_mhz=recipe.section.bandwidth_mhz,
        average_s=recipe.average_s,
        product=np.array(labels()),
        before=whole.pop("before").astype(np.float32),
        bin_of=line.bin_of,
        level=level[first],
        component_std=recipe.table.component_std,
        gain_std=recipe.section.gain_std,
        curves=gain_model.gain_curves(recipe.table, recipe.section.gain_std, level, telemetry),
        sessions=tuple(_said_of(s, recipe) for s in line.sessions),
        recipe=recipe.words(),
        curvature=np.abs(bend).max("port").values,
        **whole,
        jd1=times.jd1,
        jd2=times.jd2,
        run=line.observation.run,
        turntable_deg=np.array(line.observation.turntable_deg),
        **{name: getattr(line.observation, name) for name in ("lon_deg", "lat_deg", "step_s")},
        **window,
    )


def _joined(parts: Sequence[Parts]) -> Parts:
    """Join numbers in order of time."""
    return {name: np.concatenate([x[name] for x in parts], axis=-1) for name in parts[0]}


def _pieces(line: Timeline) -> list[list[slice]]:
    """Rows of whole bins of one state, as few as ``PIECE`` allows, in slabs, for each piece."""
    run, bin_of = line.observation.run, line.bin_of
    ends = (np.flatnonzero(np.append(np.diff(bin_of) != 0, True)) + 1).tolist()
    pieces, start = [], 0
    for k, end in enumerate(ends):
        if k + 1 == len(ends) or end - start >= PIECE or run[ends[k + 1] - 1] != run[start]:
            edges = [*range(start, end, SLAB), end]
            pieces.append([slice(first, last) for first, last in pairwise(edges)])
            start = end
    return pieces


def _read_ahead(
    ahead: ThreadPoolExecutor, files: ExitStack, line: Timeline, slabs: list[slice]
) -> Iterator[np.ndarray]:
    """Yield the counts of every slab; the next slab is read meanwhile."""
    reads: dict[int, session.Read] = {}

    def counts(rows: slice) -> np.ndarray:
        if (number := int(line.session[rows.start])) not in reads:
            reads[number] = files.enter_context(line.sessions[number].spectra())
        first = int(line.row[rows.start])
        return reads[number](first, first + rows.stop - rows.start)

    following: Future[np.ndarray] = ahead.submit(counts, slabs[0])
    for rows in slabs[1:]:
        read, following = following.result(), ahead.submit(counts, rows)
        yield read
    yield following.result()


@lru_cache(maxsize=16)
def _prepared(
    recipe: Recipe, navgf: int, levels: tuple[str, ...]
) -> tuple[tuple[ChannelBand, ...], Float[np.ndarray, "ports 3 bins"], flags.BinFlags]:
    """Return what many spectra share: the bands, the gains, and the bins with known lines.

    The gains are mean and components, averaged over the channels of every bin; NaN where there are
    none.
    """
    section, averaging = recipe.section, session.AVERAGING[navgf]
    middles = session.channel_mhz(section.bin_origin)
    shared = shared_noise(section.filter_taps, section.filter_window)
    channels = averaging.channels()
    gains = np.full((session.PORTS, 3, averaging.n_bins), np.nan)
    for port, level in enumerate(levels):
        if level != session.NO_LEVEL:
            gains[port] = recipe.table.basis(level, port, middles)[:, channels].mean(axis=2)
    of_all = section.bandwidth_mhz, section.degree, averaging, middles, shared
    bands = tuple(ChannelBand.of(f, *of_all) for f in recipe.frequencies_mhz)
    lines = flags.line_bins(recipe.lines_mhz, averaging, middles)
    if section.comb == "always":
        lines = lines | flags.comb_bins(averaging)
    return bands, gains, lines


def _slab(line: Timeline, recipe: Recipe, start: int, counts: np.ndarray) -> Callable[[int], Parts]:
    """Return a function that puts the counts of some spectra, from a row on, into a band."""
    source, first = line.sessions[int(line.session[start])], int(line.row[start])
    rows_read = slice(first, first + len(counts))
    navgf, levels = int(source.navgf[first]), tuple(map(str, source.level[first]))
    averaging, (bands, gains, lines) = session.AVERAGING[navgf], _prepared(recipe, navgf, levels)
    share, saturated = source.share[rows_read], source.saturated[rows_read]
    # a spectrum of no frames has no finite values
    frames, comb = np.maximum(source.frames[rows_read], 1.0), source.notched[rows_read]
    if recipe.section.comb == "found":
        autos = counts[:, : session.PORTS].astype(np.float64)
        middles = session.channel_mhz(recipe.section.bin_origin)
        strength = flags.comb_strength(autos, frames, averaging, middles)
        comb = comb | (np.abs(strength) > flags.COMB_LIMIT)
    lines = lines | (comb[:, None] & flags.comb_bins(averaging))
    telemetry = {name: values[rows_read] for name, values in source.telemetry.items()}
    # 1, q_1 and q_2 of every port; NaN if the port has no level
    strengths = np.full((len(counts), session.PORTS, 3), np.nan)
    with reading.naming(source.path):
        for port, level in enumerate(levels):
            if level != session.NO_LEVEL:
                strengths[:, port, 0] = 1.0
                strengths[:, port, 1:] = recipe.table.strengths(level, port, telemetry)

    def calibrate(number: int) -> Parts:
        """Calibrate, flag and average the channels of a band."""
        band = bands[number]
        at = slice(band.first, band.last)
        basis = gains[:, :, at]
        gain = np.einsum("rpc,pck->rpk", strengths, basis)
        factor = gain_model.NANO2 * averaging.stride / averaging.members
        with np.errstate(invalid="ignore", divide="ignore"):
            root = np.sqrt(np.where(gain > 0.0, gain, np.nan))
            # what is sent is a sum over the accepted frames, divided by the number of all frames
            raw = counts[:, session.OF_FLIGHT, at].astype(np.float64) / share[:, None, None]
        channels = raw * factor / (root[:, session.FIRST_PORT] * root[:, session.SECOND_PORT])
        if recipe.section.sign < 0:
            channels[:, session.IMAGINARY] *= -1.0
        finite, autos = np.isfinite(channels), channels[:, session.AUTOS]
        # a port whose auto is nowhere positive has no data, as one without an auto
        dead = ((autos <= 0.0) & np.isfinite(autos)).any(axis=2) & ~(autos > 0.0).any(axis=2)
        finite &= ~(dead[:, session.FIRST_PORT] | dead[:, session.SECOND_PORT])[..., None]
        present, with_auto = finite.any(axis=2), finite[:, session.AUTOS]
        # a bin is whole if all products that are present are finite in it
        whole = (finite | ~present[..., None]).all(axis=1) & with_auto.any(axis=(1, 2))[:, None]
        good = whole & ~lines[:, at] & ~saturated[:, None]
        # absent autos are zero, and show no lines
        filled = np.where(with_auto, channels[:, session.AUTOS], 0.0)
        limit = flags.threshold(recipe.section.false_alarm, session.PORTS)
        outliers, z = flags.line_flags(band, filled, frames, good, limit)
        kept = good & ~outliers
        mean_auto = filled.sum(axis=1) / np.maximum(with_auto.sum(axis=1), 1)
        clean = np.where(finite, channels, 0.0)
        values, variance, further = band.values(clean, mean_auto, kept)
        before, _, _ = band.values(clean, mean_auto, whole)
        reason = np.full(len(counts), reduced.USED, dtype=np.uint8)
        reason[~np.isfinite(variance)] = reduced.TOO_MANY
        reason[~good.any(axis=1)] = reduced.COMB
        reason[~whole.any(axis=1)] = reduced.NO_DATA
        reason[saturated] = reduced.SATURATED
        values, n_averaged = np.where(present, values, np.nan).T, frames / variance
        # bins beyond the table have no gain
        known, port = np.isfinite(basis).any(axis=(0, 1)), with_auto.any(axis=(0, 2)).argmax()
        middle = known / (known.sum() or np.nan)
        centre = np.einsum("rpk,k->pr", np.where(known, gain, 0.0), middle)
        components = np.einsum("pck,k->pc", np.where(known, basis[:, 1:], 0.0), middle)
        return {
            "reason": reason,
            "lines": (1.0 - kept.sum(axis=1) / len(band.basis)).astype(np.float32),
            "values": values,
            "before": np.where(present, before, np.nan).T,
            "n_averaged": n_averaged,
            "gain": centre,
            "gain_slope": components[..., None] / centre[:, None],
            "bend": _over(further[:, session.AUTOS].T, _noise(values, n_averaged)),
            "line_scatter": np.array([flags.robust_scale(z[:, port], kept)]),
        }

    return calibrate


def _over(values: Float[np.ndarray, "*n"], noise: Float[np.ndarray, "*n"]) -> np.ndarray:
    """Values in standard deviations; NaN where there is no noise."""
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(np.isfinite(values) & (noise > 0.0), values / noise, np.nan)


def _noise(
    values: Float[np.ndarray, "products bins"], n_averaged: Float[np.ndarray, " bins"]
) -> Float[np.ndarray, "ports bins"]:
    """The standard deviations of the autos, from the radiometer equation."""
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.abs(values[session.AUTOS]) / np.sqrt(n_averaged)


def _finish(
    seconds: Rows, live: Rows, bin_of: session.RowCounts, false_alarm: float, spectra: Parts
) -> Parts:
    """Flag bursts, spectra that do not fit those before and after; average the others in bins."""
    all_values, reason = spectra["values"], spectra["reason"]
    noise = _noise(all_values, spectra["n_averaged"])
    # absent autos neither stand out nor constrain the curve
    autos = all_values[session.AUTOS].T
    finite = np.isfinite(autos)
    shown, sigma = np.where(finite, autos, 0.0), np.where(finite & (noise.T > 0.0), noise.T, np.inf)
    burst, scatter = flags.burst_flags(seconds, shown, sigma, reason == reduced.USED, false_alarm)
    reason = np.where(burst, np.uint8(reduced.BURST), reason)
    good, bin_of = reason == reduced.USED, bin_of - bin_of[0]
    n = int(bin_of[-1]) + 1
    kept, used = by_the_rule(np.isfinite(all_values) & good, bin_of, live)
    # weights are live times, both for the unflagged spectra and for all
    weights = np.where(used, live, 0.0)
    some = np.bincount(bin_of, weights, n) > 0.0
    with np.errstate(invalid="ignore", divide="ignore"):
        squares = np.where(used, weights**2 / spectra["n_averaged"], 0.0)
        n_averaged = np.bincount(bin_of, weights, n) ** 2 / np.bincount(bin_of, squares, n)
    n_averaged = np.where(some, n_averaged, 0.0)
    averaged = partial(_means, first=np.searchsorted(bin_of, np.arange(n)))
    values = np.where(kept & some, averaged(all_values, weights), np.nan)
    return spectra | {
        "reason": np.where(good & ~used, np.uint8(reduced.PRODUCT), reason),
        "values": values,
        "n_averaged": n_averaged,
        "bend": _over(averaged(spectra["bend"] * noise, weights), _noise(values, n_averaged)),
        "scatter": scatter,
        **{name: averaged(spectra[name], live) for name in ("before", "gain", "gain_slope")},
    }


def _means(
    values: Float[np.ndarray, "... rows"], weights: Rows, first: Int[np.ndarray, " bins"]
) -> Float[np.ndarray, "... bins"]:
    """Weighted means of the finite values of bins from these rows on; NaN if a bin has none."""
    weight = np.isfinite(values) * weights
    total = np.add.reduceat(weight, first, axis=-1)
    summed = np.add.reduceat(np.where(weight > 0.0, values, 0.0) * weights, first, axis=-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        return summed / total


def _said_of(source: session.Session, recipe: Recipe) -> dict[str, Any]:
    clock, whose = recipe.clock or source.clock, "session"
    if source.clock is None:
        whose = "clock file"
    elif recipe.clock is not None and recipe.clock.stated is not None:
        whose = reduced.CORRECTED
    return {
        "file": str(source.path),
        "kind": source.kind,
        "layout": source.layout,
        "spectra": source.n_rows,
        "software": source.software,
        "navgf": sorted({int(n) for n in source.navgf}),
        "levels": sorted({"".join(row) for row in source.level}),
        "window_s": float(source.window_s.max()),
        "saturated": int(source.saturated.sum()),
        "errors": int((source.errors != 0).sum()),
        "clock": whose,
        "clock_file": None if recipe.clock is None else Path(recipe.clock.source).name,
        "scale": None if clock is None else clock.scale,
        "rate": 1.0 if clock is None else clock.rate,
        "first_s": float(source.raw_s[0]),
        "last_s": float(source.raw_s[-1]),
    }
