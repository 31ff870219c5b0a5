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
        Scatter over the noise expected, of every span of four hours that has enough spectra.
    """
    flagged, scatter = np.zeros(len(seconds), dtype=bool), []
    limit = threshold(false_alarm, n_tests(autos.shape[1]))
    autos = _filled(seconds, autos, np.isfinite(noise) & good[:, None])
    for at in _spans(seconds):
        if good[at].sum() < LEAST:
            continue
        here, scale = _one_span(seconds[at], autos[at], noise[at], good[at], limit)
        flagged[at] = here
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
        found = out[0] | _stretches(z[0], kept & ~out[0], limit)
        if not found.any():
            break
        kept &= ~found
    kept = _with_what_fits(values, sigma, good, kept, x, limit)
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
        more = kept | (more & ~_stretches(z, more, limit))
        if (more == kept).all():
            break
        kept = more
    return kept


def _stretches(
    z: Float[np.ndarray, "ports span"], kept: Bool[np.ndarray, " span"], limit: float
) -> Bool[np.ndarray, " span"]:
    """Those in stretches whose sum is beyond the limit."""
    found = np.zeros(len(kept), dtype=bool)
    clean, one = np.where(kept, z, 0.0), kept.astype(float)
    for length in LENGTHS[1:]:
        if length > len(kept) // 2:
            break
        window = np.ones(length)
        count = np.convolve(one, window, "valid")
        for port in clean:
            total = np.convolve(port, window, "valid") / np.sqrt(np.maximum(count, 1.0))
            for start in np.flatnonzero((np.abs(total) > limit) & (count > length / 2)):
                found[start : start + length] = True
    return found & kept
