"""Flags: channels off a smooth spectrum, combs, and spectra off a smooth curve in time.

Points off a curve are found iteratively: the worst are removed and the curve is fitted again, until
none deviates by more than noise allows. Points that then lie on the curve are restored. A point is
flagged if it stands out in any of the autos.

**Lines.** The calibrator sends a comb at 50 kHz + n 100 kHz, in channels 2, 6, 10, ... counted from
0 (coreloop's ``lusee_commands.h`` has the notch index 2 by default, for 50 + 100 n kHz), and the
notch filter subtracts the mean of the same channels. Layout 3 does not record when either is on. So
every spectrum is tested: the difference of these channels from their neighbours, over the whole
band, detects a comb far below the noise of a channel, and also a notch, which makes it negative.
Where four channels are averaged nothing looks like a line, and only tests in time remain.

**Bursts** of Jupiter and the Sun, and interference. The sky's visibilities change smoothly within a
few hours. A polynomial in time is fitted to the autos of a band; spectra off it, or stretches that
are off together, are flagged. The noise is the radiometer's, or the scatter of the data if that is
larger.
"""

from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from lusee_bayes.core.arrays import RowFlags, Rows
from lusee_bayes.core.layouts import Layout, Variable
from lusee_bayes.core.lazy import special
from lusee_bayes.core.reading import read_table
from lusee_bayes.flight.bands import Basis, ChannelBand, Points, PointValues, inverse_normals
from lusee_bayes.flight.session import CHANNEL_MHZ, Averaging, Middles

# of spectra in bands: rows, autos and points of a curve; in time: one span, with rows as points
Autos = Float[np.ndarray, "rows autos points"]
BinFlags = Bool[np.ndarray, " bins"]
Levels = Float[np.ndarray, "rows ports"]
Span = Bool[np.ndarray, " span"]
OneRow = Float[np.ndarray, "1 ports span"]
Distances = Float[np.ndarray, "ports span"]
Sums = Float[np.ndarray, "ports ends"]
Ends = Float[np.ndarray, " ends"]

# of the points beyond the threshold, one round removes those within this share of the worst
WORST = 0.5
MAX_ROUNDS = 60
# standard deviation of a Gaussian over the median of its absolute values
MAD = 1.4826


def threshold(false_alarm: float, n_tests: int) -> float:
    """Return the threshold for outliers, in standard deviations.

    Parameters
    ----------
    false_alarm : float
        Probability that a point of pure noise exceeds it in any of its tests.
    n_tests : int
        Number of two-sided tests of a point.
    """
    return float(-special.ndtri(false_alarm / (2.0 * n_tests)))


def outliers(
    values: Autos, noise: Autos, good: Points, basis: Basis, limit: float
) -> tuple[Points, Autos]:
    """Find points off a curve, in every row independently.

    Parameters
    ----------
    values : (rows, autos, points) array
    noise : (rows, autos, points) array
        Standard deviations.
    good : (rows, points) array of bool
        Points to test.
    basis : (points, terms) array
        Terms of the curve.
    limit : float
        :func:`threshold`.

    Returns
    -------
    (rows, points) array of bool
        Points that stand out.
    (rows, autos, points) array
        Distances from the curve through the others in standard deviations, 0 where not good.
    """
    kept, z = good.copy(), np.zeros_like(values)
    active = np.arange(len(values))
    for _ in range(MAX_ROUNDS):
        z[active] = distances(values[active], noise[active], good[active], kept[active], basis)
        among = np.where(kept[active], np.abs(z[active]).max(axis=1), 0.0)
        out = (among > limit) & (among >= WORST * among.max(axis=1, keepdims=True))
        # a curve needs more points than terms
        out &= (kept[active] & ~out).sum(axis=1, keepdims=True) > basis.shape[1]
        if not out.any():
            break
        kept[active] &= ~out
        active = active[out.any(axis=1)]
    kept |= good & ~kept & (np.abs(z).max(axis=1) <= limit)
    return good & ~kept, z


def distances(values: Autos, noise: Autos, good: Points, kept: Points, basis: Basis) -> Autos:
    """Return the distances of points from the curve through some of them.

    Parameters
    ----------
    values, noise, good, basis
        As :func:`outliers`.
    kept : (rows, points) array of bool
        Points that the curve is fitted to.

    Returns
    -------
    (rows, autos, points) array
        In standard deviations, including the curve's own uncertainty; 0 where not good.
    """
    curve, leverage = fitted_curves(values, kept, basis)
    factor = np.where(kept, 1.0 - leverage, 1.0 + leverage)
    scale = noise * np.sqrt(np.maximum(factor, 1e-3))[:, None]
    return np.where(good[:, None], (values - curve) / scale, 0.0)


def fitted_curves(values: Autos, kept: Points, basis: Basis) -> tuple[Autos, PointValues]:
    """Return the curve through some points, and its variance in units of a point's variance.

    Parameters
    ----------
    values, kept, basis
        As :func:`distances`.
    """
    inverse, _ = inverse_normals(basis, kept)
    pulled = np.einsum("rpk,ka->rpa", np.where(kept[:, None], values, 0.0), basis)
    curve = np.einsum("rab,rpb,ka->rpk", inverse, pulled, basis, optimize=True)
    return curve, np.einsum("rab,ka,kb->rk", inverse, basis, basis, optimize=True)


def robust_scale(z: PointValues, good: Points) -> float:
    """Return the standard deviation of distances, by their median; NaN if there are none."""
    return float(MAD * np.median(np.abs(z[good]))) if good.any() else np.nan


# the calibrator's comb: every fourth channel, from this one on
COMB_FIRST, COMB_SPACING = 2, 4
# range in which the spectrum is smooth enough to predict a channel from its neighbours
COMB_MHZ = (5.0, 45.0)
# neighbours that predict a channel to third order, none of them in the comb
AROUND = ((-3, -1.0 / 16.0), (-1, 9.0 / 16.0), (1, 9.0 / 16.0), (3, -1.0 / 16.0))
# in standard deviations of a whole spectrum: high, since the prediction is never exact
COMB_LIMIT = 8.0
# a line affects its channel and those beside it; half-way between two, it affects four
BESIDE_MHZ = 1.5 * CHANNEL_MHZ + 1e-9
LINE_COLUMNS = {
    "frequency_mhz": Variable(("line",), low=0.0, high=60.0),
    "source": Variable(("line",), "text"),
}
TABLE = Layout("known lines", LINE_COLUMNS)


def read_lines(path: str | Path) -> tuple[float, ...]:
    """Read a CSV table of lines: ``frequency_mhz``, and the ``source`` of each.

    Returns
    -------
    tuple of float
        The frequencies, in MHz, of lines that are always present.

    Raises
    ------
    InputError
        If it cannot be read.
    """
    columns = read_table(path, TABLE, "write a header 'frequency_mhz,source' and one line for each")
    return tuple(columns["frequency_mhz"].tolist())


def line_bins(lines_mhz: tuple[float, ...], averaging: Averaging, middles_mhz: Middles) -> BinFlags:
    """Return the bins that contain a known line, or a channel beside one."""
    near = np.abs(middles_mhz[:, None] - np.array(lines_mhz)) <= BESIDE_MHZ
    return near.any(axis=1)[averaging.channels()].any(axis=1)


def comb_bins(averaging: Averaging) -> BinFlags:
    """Return the bins that contain a channel of the comb."""
    return (averaging.channels() % COMB_SPACING == COMB_FIRST).any(axis=1)


def comb_strength(autos: Autos, frames: Rows, averaging: Averaging, middles_mhz: Middles) -> Rows:
    """Return by how many standard deviations the comb's channels differ from their neighbours.

    Parameters
    ----------
    autos : (rows, ports, bins) array
        In V^2/Hz; the gain's steps from level to level do not matter.
    frames : (rows,) array
    averaging : Averaging
    middles_mhz : (channels,) array

    Returns
    -------
    (rows,) array
        For the port with the largest difference; 0 if every bin contains a channel of the comb.
    """
    if (comb := comb_bins(averaging)).all():
        return np.zeros(len(autos))
    mhz = middles_mhz[averaging.channels()].mean(axis=1)
    at = np.flatnonzero(comb & (mhz > COMB_MHZ[0]) & (mhz < COMB_MHZ[1]))
    around = sum(weight * autos[..., at + offset] for offset, weight in AROUND)
    spread = np.sqrt(1.0 + sum(weight**2 for _, weight in AROUND))
    noise = np.abs(around) * spread / np.sqrt(frames * averaging.members)[:, None, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        z = (autos[..., at] - around) / noise
    finite = np.isfinite(z)
    # a single strong line is no comb
    clipped = np.clip(np.where(finite, z, 0.0), -COMB_LIMIT, COMB_LIMIT)
    strength = clipped.sum(axis=2) / np.sqrt(np.maximum(finite.sum(axis=2), 1))
    return np.take_along_axis(strength, np.abs(strength).argmax(axis=1)[:, None], axis=1)[:, 0]


def line_flags(
    band: ChannelBand, autos: Autos, frames: Rows, good: Points, limit: float
) -> tuple[Points, Autos]:
    """Find bins of a band off a smooth spectrum, in each spectrum independently.

    Parameters
    ----------
    band : ChannelBand
    autos : (rows, ports, bins) array
        Autos in the band, in V^2/Hz.
    frames : (rows,) array
    good : (rows, bins) array of bool
        Bins to test.
    limit : float
        :func:`.threshold`.

    Returns
    -------
    (rows, bins) array of bool
    (rows, ports, bins) array
        Distances from the spectrum, in standard deviations.
    """
    # level of the spectrum: a median, which a strong line does not raise; absent ports are zero
    usable = np.where((good | ~good.any(axis=1)[:, None])[:, None], autos, np.nan)
    level, root = np.nanmedian(usable, axis=2), np.sqrt(np.diagonal(band.shared))
    noise = np.abs(level)[..., None] * root / np.sqrt(frames)[:, None, None]
    return outliers(autos, np.where(noise > 0.0, noise, 1.0), good, band.finer, limit)


# a polynomial of this degree follows the sky over four hours, to less than the noise of a spectrum:
# 2e-5 of the signal at ell = 47
DEGREE, SPAN_S = 5, 14400.0
# with fewer spectra in a span, no test is possible
LEAST = 16
# lengths of the tested stretches, in spectra
LENGTHS = (1, 2, 4, 8, 16)


def burst_flags(
    seconds: Rows, autos: Levels, noise: Levels, good: RowFlags, false_alarm: float
) -> tuple[RowFlags, Float[np.ndarray, " spans"]]:
    """Find spectra off a smooth curve in time.

    Parameters
    ----------
    seconds : (rows,) array
        Times.
    autos : (rows, ports) array
        Autos of a band.
    noise : (rows, ports) array
        Their standard deviations; infinite for autos that are absent.
    good : (rows,) array of bool
        Spectra to test.
    false_alarm : float
        Probability that a spectrum of pure noise is flagged, over all tests.

    Returns
    -------
    (rows,) array of bool
    (spans,) array
        Scatter over the expected noise, for every span of four hours; NaN if there are too few
        spectra.
    """
    flagged, scatter = np.zeros(len(seconds), dtype=bool), []
    limit = threshold(false_alarm, autos.shape[1] * len(LENGTHS))
    autos = _filled(seconds, autos, np.isfinite(noise) & good[:, None])
    for at in _spans(seconds):
        scale = np.nan
        if good[at].sum() >= LEAST:
            flagged[at], scale = _one_span(seconds[at], autos[at], noise[at], good[at], limit)
        scatter.append(scale)
    return flagged, np.array(scatter)


def _filled(seconds: Rows, autos: Levels, known: Bool[np.ndarray, "rows ports"]) -> Levels:
    """Autos with unknown ones interpolated from their neighbours, so as not to bend the curve."""
    filled = autos.copy()
    for port, at in enumerate(known.T):
        if at.any():
            filled[~at, port] = np.interp(seconds[~at], seconds[at], autos[at, port])
    return filled


def _spans(seconds: Rows) -> list[np.ndarray]:
    """Rows of spans of equal length, none longer than ``SPAN_S``."""
    whole = seconds[-1] - seconds[0]
    n = max(1, int(np.ceil(whole / SPAN_S - 1e-9)))
    number = np.minimum((seconds - seconds[0]) * n // max(whole, 1.0), n - 1).astype(int)
    return [rows for k in range(n) if (rows := np.flatnonzero(number == k)).size]


def _one_span(
    seconds: Rows, autos: Levels, noise: Levels, good: RowFlags, limit: float
) -> tuple[RowFlags, float]:
    t = 2.0 * (seconds - seconds[0]) / max(seconds[-1] - seconds[0], 1.0) - 1.0
    x = np.polynomial.chebyshev.chebvander(t, DEGREE)
    values = np.where(good[:, None], autos, 0.0).T[None]
    sigma = np.where(good[:, None], noise, 1.0).T[None]
    # noise from spectrum to spectrum, which a burst changes only at its ends
    both = (good[1:] & good[:-1])[None]
    steps = np.diff(values[0] / sigma[0], axis=1) / np.sqrt(2.0)
    scale = np.array([robust_scale(port[None], both) for port in steps])
    kept = _without_the_highest(values, sigma * np.maximum(scale, 1.0)[:, None], good, x, limit)
    # scatter about the curve
    z = distances(values, sigma, good[None], kept[None], x)
    scatter = np.array([robust_scale(z[:, p], kept[None]) for p in range(autos.shape[1])])
    scale = np.maximum(scale, scatter)
    sigma = sigma * np.maximum(scale, 1.0)[None, :, None]
    kept = _with_what_fits(values, sigma, good, kept, x, limit)
    while kept.sum() >= LEAST // 2:
        out, z = outliers(values, sigma, kept[None], x, limit)
        off = out[0] | _about_stretches(z[0], kept & ~out[0], limit)
        if not off.any():
            break
        kept &= ~off
    kept = _with_what_fits(values, sigma, good, kept, x, limit)
    # stretches that include flagged spectra: also flag those in between
    z = distances(values, sigma, good[None], kept[None], x)[0]
    kept &= ~_flagged_stretches(z, kept | (good & _curve_is_known(values, kept, x)), limit)
    return good & ~kept, float(np.median(scale[scale > 0.0])) if scale.any() else 0.0


def _without_the_highest(values: OneRow, sigma: OneRow, good: Span, x: Basis, limit: float) -> Span:
    """Good spectra except those above the curve, which long bursts pull up."""
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
    values: OneRow, sigma: OneRow, good: Span, kept: Span, x: Basis, limit: float
) -> Span:
    """Kept spectra, and others on the curve through them, singly and in stretches.

    Where the curve is poorly determined, as at the ends of a span, they return one after the other.
    """
    for _ in range(MAX_ROUNDS):
        curve, _ = fitted_curves(values, kept[None], x)
        z = ((values - curve) / sigma)[0]
        more = good & ~kept & (np.abs(z).max(axis=0) <= limit)
        on_curve = good & _curve_is_known(values, kept, x)
        more = kept | (more & ~_flagged_stretches(z, kept | more | on_curve, limit))
        if (more == kept).all():
            break
        kept = more
    return kept


def _curve_is_known(values: OneRow, kept: Span, x: Basis) -> Span:
    """Where the curve's error, common to a stretch, is below the noise of the stretch's sum."""
    _, leverage = fitted_curves(values, kept[None], x)
    return leverage[0] <= 1.0 / LENGTHS[-1]


def _about_stretches(z: Distances, kept: Span, limit: float) -> Span:
    """All stretches whose sum exceeds the limit, which cover more spectra than are off."""
    sums, counts = _sums(z, kept)
    beyond = np.zeros(len(kept), dtype=bool)
    for length in LENGTHS[1:]:
        if length <= len(kept) // 2:
            starts = (_sizes_of(sums, counts, length) > limit).any(axis=0)
            beyond |= np.convolve(starts, np.ones(length)) > 0.0
    return beyond & kept


def _flagged_stretches(z: Distances, good: Span, limit: float) -> Span:
    """Only the spectra in stretches whose sum exceeds the limit, the furthest first."""
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


def _sums(z: Distances, good: Span) -> tuple[Sums, Ends]:
    """Sum of the distances before each spectrum, and their number."""
    sums = np.cumsum(np.pad(np.where(good, z, 0.0), ((0, 0), (1, 0))), axis=1)
    return sums, np.cumsum(np.pad(good, (1, 0)).astype(float))


def _sizes_of(sums: Sums, counts: Ends, length: int) -> Float[np.ndarray, "ports starts"]:
    """Significance of every stretch of a length; 0 where half of it is missing."""
    n = counts[length:] - counts[:-length]
    return _sizes(sums[:, length:] - sums[:, :-length], np.where(n > length / 2, n, np.inf))


def _part(sums: Ends, counts: Ends, limit: float) -> tuple[int, int]:
    """First and last end of the most significant part of a stretch.

    Two parts with a good gap between them, each with its own mean, may lower chi^2 further by more
    than the limit squared. Then the more significant of the two is returned.
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
