"""Reduce sessions of any length: calibrate, flag and average, one piece after the other.

All spectra of a few bins of time are read at once; no more of the spectra is ever in memory.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Bool, Int

from lusee_bayes.core.errors import InputError
from lusee_bayes.core.progress import Stages
from lusee_bayes.core.threads import in_threads
from lusee_bayes.instrument.flight.accumulated import Accumulated
from lusee_bayes.instrument.flight.recipe import Recipe
from lusee_bayes.instrument.flight.reduced import (
    Reduced,
)
from lusee_bayes.instrument.flight.session import Read, Session
from lusee_bayes.instrument.flight.slab import BandValues, Slab, State
from lusee_bayes.instrument.flight.timeline import Timeline, timeline

# spectra that are worked on at once, and at least how many make a piece between two bins
SLAB, PIECE = 128, 1024


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
    made = Accumulated.empty(line, recipe)
    pieces = _pieces(line)
    numbers = range(len(recipe.frequencies_mhz))
    with (
        stages.progress("spectra", len(line.bin_of)) as done,
        ExitStack() as files,
        ThreadPoolExecutor(1) as ahead,
    ):
        for piece, slabs in _read_ahead(ahead, files, pieces, line, recipe):
            bands = [[slab[k] for slab in slabs] for k in numbers]
            in_threads(partial(made.put, piece, bands, line, recipe), numbers)
            done(piece.stop)
    return made.reduced(line, recipe)


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
