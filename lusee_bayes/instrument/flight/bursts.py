"""Spectra that do not fit those before and after them: bursts of Jupiter and the Sun, interference.

Within a few hours the sky's visibilities change smoothly. A polynomial in time is fitted to the
autos of a band; spectra off it, or stretches of them that are off together, are flagged. Noise is
that of the radiometer, or what the data show where that is more.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from lusee_bayes.instrument.flight.outliers import (
    MAX_ROUNDS,
    WORST,
    curves,
    distances,
    outliers,
    robust_scale,
    threshold,
)

# a polynomial of this degree takes up what the sky does within four hours, to less than the noise
# of a spectrum: 2e-5 of what ell = 47 has
DEGREE, SPAN_S = 5, 14400.0
# with fewer spectra within a span, there is no telling
LEAST = 16
# lengths of stretches that are tested, in spectra
LENGTHS = (1, 2, 4, 8, 16)


def n_tests(ports: int) -> int:
    """Return how many tests a spectrum has to pass."""
    return ports * len(LENGTHS)


def burst_flags(
    seconds: Float[np.ndarray, " rows"],
    autos: Float[np.ndarray, "rows ports"],
    noise: Float[np.ndarray, "rows ports"],
    good: Bool[np.ndarray, " rows"],
    false_alarm: float,
) -> tuple[Bool[np.ndarray, " rows"], Float[np.ndarray, " spans"]]:
    """Find spectra off a smooth curve in time.

    Parameters
    ----------
    seconds : (rows,) array
        Times.
    autos : (rows, ports) array
        Of a band.
    noise : (rows, ports) array
        Their standard deviations; infinite for autos that are absent.
    good : (rows,) array of bool
        Spectra to be looked at.
    false_alarm : float
        Chance that one of pure noise is flagged, shared by all tests.

    Returns
    -------
    (rows,) array of bool
    (spans,) array
        Scatter over the noise expected, of every span of four hours; NaN where there are not enough
        spectra.
    """
    flagged, scatter = np.zeros(len(seconds), dtype=bool), []
    limit = threshold(false_alarm, n_tests(autos.shape[1]))
    autos = _filled(seconds, autos, np.isfinite(noise) & good[:, None])
    for at in _spans(seconds):
        scale = np.nan
        if good[at].sum() >= LEAST:
            flagged[at], scale = _one_span(seconds[at], autos[at], noise[at], good[at], limit)
        scatter.append(scale)
    return flagged, np.array(scatter)


def _filled(
    seconds: Float[np.ndarray, " rows"],
    autos: Float[np.ndarray, "rows ports"],
    known: Bool[np.ndarray, "rows ports"],
) -> Float[np.ndarray, "rows ports"]:
    """Autos with what lies between their neighbours in place of others, so as to bend no curve."""
    found = autos.copy()
    for port, at in enumerate(known.T):
        if at.any():
            found[~at, port] = np.interp(seconds[~at], seconds[at], autos[at, port])
    return found


def _spans(seconds: Float[np.ndarray, " rows"]) -> list[np.ndarray]:
    """Rows of spans of equal length, none longer than ``SPAN_S``."""
    whole = seconds[-1] - seconds[0]
    n = max(1, int(np.ceil(whole / SPAN_S - 1e-9)))
    number = np.minimum((seconds - seconds[0]) * n // max(whole, 1.0), n - 1).astype(int)
    return [found for k in range(n) if (found := np.flatnonzero(number == k)).size]


def _one_span(
    seconds: Float[np.ndarray, " span"],
    autos: Float[np.ndarray, "span ports"],
    noise: Float[np.ndarray, "span ports"],
    good: Bool[np.ndarray, " span"],
    limit: float,
) -> tuple[Bool[np.ndarray, " span"], float]:
    x = np.polynomial.chebyshev.chebvander(
        2.0 * (seconds - seconds[0]) / max(seconds[-1] - seconds[0], 1.0) - 1.0, DEGREE
    )
    values = np.where(good[:, None], autos, 0.0).T[None]
    sigma = np.where(good[:, None], noise, 1.0).T[None]
    # noise from spectrum to spectrum, which a burst changes at its ends alone
    scale = _from_neighbours(values[0] / sigma[0], good)
    kept = _without_the_highest(values, sigma * np.maximum(scale, 1.0)[:, None], good, x, limit)
    # and about the curve
    z = distances(values, sigma, good[None], kept[None], x)
    about = np.array([robust_scale(z[:, p], kept[None]) for p in range(autos.shape[1])])
    scale = np.maximum(scale, about)
    sigma = sigma * np.maximum(scale, 1.0)[None, :, None]
    kept = _with_what_fits(values, sigma, good, kept, x, limit)
    while kept.sum() >= LEAST // 2:
        out, z = outliers(values, sigma, kept[None], x, limit)
        found = out[0] | _about_stretches(z[0], kept & ~out[0], limit)
        if not found.any():
            break
        kept &= ~found
    kept = _with_what_fits(values, sigma, good, kept, x, limit)
    # what lies between spectra that are flagged, each of them far off
    z = distances(values, sigma, good[None], kept[None], x)[0]
    known = good & _curve_is_known(values, kept, x)
    kept &= ~_stretches(z, kept | known, limit)
    return good & ~kept, float(np.median(scale))


def _from_neighbours(
    z: Float[np.ndarray, "ports span"], good: Bool[np.ndarray, " span"]
) -> Float[np.ndarray, " ports"]:
    """Standard deviation of each port, by differences of one spectrum and the next."""
    both = (good[1:] & good[:-1])[None]
    steps = np.diff(z, axis=1) / np.sqrt(2.0)
    return np.array([robust_scale(port[None], both) for port in steps])


def _without_the_highest(
    values: Float[np.ndarray, "1 ports span"],
    sigma: Float[np.ndarray, "1 ports span"],
    good: Bool[np.ndarray, " span"],
    x: Float[np.ndarray, "span terms"],
    limit: float,
) -> Bool[np.ndarray, " span"]:
    """Good spectra but those above the curve, which bursts pull up when they are long."""
    kept = good.copy()
    for _ in range(MAX_ROUNDS):
        z = distances(values, sigma, good[None], kept[None], x)[0].max(axis=0)
        above = np.where(kept, z, 0.0)
        left = kept & ~((above > limit) & (above >= WORST * above.max()))
        if (left == kept).all() or left.sum() < LEAST // 2:
            break
        kept = left
    return kept


def _with_what_fits(
    values: Float[np.ndarray, "1 ports span"],
    sigma: Float[np.ndarray, "1 ports span"],
    good: Bool[np.ndarray, " span"],
    kept: Bool[np.ndarray, " span"],
    x: Float[np.ndarray, "span terms"],
    limit: float,
) -> Bool[np.ndarray, " span"]:
    """Spectra that are kept, and others on the curve through them, alone and in stretches.

    Where the curve is not known well, as at the ends of a span, they come back one after the other.
    """
    for _ in range(MAX_ROUNDS):
        curve, _ = curves(values, kept[None], x)
        z = ((values - curve) / sigma)[0]
        more = good & ~kept & (np.abs(z).max(axis=0) <= limit)
        known = good & _curve_is_known(values, kept, x)
        more = kept | (more & ~_stretches(z, kept | more | known, limit))
        if (more == kept).all():
            break
        kept = more
    return kept


def _curve_is_known(
    values: Float[np.ndarray, "1 ports span"],
    kept: Bool[np.ndarray, " span"],
    x: Float[np.ndarray, "span terms"],
) -> Bool[np.ndarray, " span"]:
    """Where the error of the curve, which a stretch has in common, is below its sum's noise."""
    _, leverage = curves(values, kept[None], x)
    return leverage[0] <= 1.0 / LENGTHS[-1]


def _about_stretches(
    z: Float[np.ndarray, "ports span"], kept: Bool[np.ndarray, " span"], limit: float
) -> Bool[np.ndarray, " span"]:
    """All stretches whose sum is beyond the limit, and so more than is off."""
    sums, counts = _sums(z, kept)
    found = np.zeros(len(kept), dtype=bool)
    for length in LENGTHS[1:]:
        if length <= len(kept) // 2:
            for start in np.flatnonzero((_sizes_of(sums, counts, length) > limit).any(axis=0)):
                found[start : start + length] = True
    return found & kept


def _stretches(
    z: Float[np.ndarray, "ports span"], good: Bool[np.ndarray, " span"], limit: float
) -> Bool[np.ndarray, " span"]:
    """Those in stretches whose sum is beyond the limit, the furthest first, and no more."""
    left = good.copy()
    lengths = [length for length in LENGTHS[1:] if length <= len(good) // 2]
    while lengths:
        sums, counts = _sums(z, left)
        sizes = [_sizes_of(sums, counts, length) for length in lengths]
        most = int(np.argmax([size.max() for size in sizes]))
        if sizes[most].max() <= limit:
            break
        port, start = np.unravel_index(sizes[most].argmax(), sizes[most].shape)
        ends = slice(start, start + lengths[most] + 1)
        first, last = _part(sums[port, ends], counts[ends], limit)
        left[start + first : start + last] = False
    return good & ~left


def _sums(
    z: Float[np.ndarray, "ports span"], good: Bool[np.ndarray, " span"]
) -> tuple[Float[np.ndarray, "ports ends"], Float[np.ndarray, " ends"]]:
    """Of all before each spectrum, and their number."""
    sums = np.cumsum(np.pad(np.where(good, z, 0.0), ((0, 0), (1, 0))), axis=1)
    return sums, np.cumsum(np.pad(good, (1, 0)).astype(float))


def _sizes_of(
    sums: Float[np.ndarray, "ports ends"], counts: Float[np.ndarray, " ends"], length: int
) -> Float[np.ndarray, "ports starts"]:
    """By how much stretches of a length stand out; 0 where half of them are missing."""
    n = counts[length:] - counts[:-length]
    return _sizes(sums[:, length:] - sums[:, :-length], np.where(n > length / 2, n, np.inf))


def _part(
    sums: Float[np.ndarray, " ends"], counts: Float[np.ndarray, " ends"], limit: float
) -> tuple[int, int]:
    """First and last end of the part of a stretch that stands out most.

    Not of two parts with a gap between them that fits, if they lower chi^2 by more than the limit
    squared where each has a mean of its own: then the one of them that stands out more.
    """
    drop = np.triu(_sizes(sums - sums[:, None], counts - counts[:, None]) ** 2)
    first, last = (int(k) for k in np.unravel_index(drop.argmax(), drop.shape))
    apart = np.triu(drop[first, : last + 1, None] + drop[None, : last + 1, last], 1)
    if apart.max() - drop[first, last] > limit**2:
        left, right = (int(k) for k in np.unravel_index(apart.argmax(), apart.shape))
        return (first, left) if drop[first, left] > drop[right, last] else (right, last)
    return first, last


def _sizes(total: Float[np.ndarray, "*n"], count: Float[np.ndarray, "..."]) -> np.ndarray:
    return np.abs(total) / np.sqrt(np.maximum(count, 1.0))
