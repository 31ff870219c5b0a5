"""Averages over longer times, of data and of model predictions.

**The functions of time in A** are the fewest that give every sample's mean over its window.
With W_p the tilted copies of a beam (``harmonics.tilts``), a row of A at one instant is the sum
over p and the orders m of e_p(t) exp(i m phi(t)) W_p,m. Its mean over a window, where phi is
phi_mean + delta, has the factors ::

    < e_p exp(i m delta) > exp(i m phi_mean),    < e_p exp(i m delta) > = sum_k (i m)^k / k! mu_pk,

with mu_pk = < e_p delta^k > the moments. Over time they are nearly linearly dependent: a singular
value decomposition yields u_j(t) and G_j(p, m), few of each, with ::

    < e_p exp(i m delta) >(t) = sum_j u_j(t) G_j(p, m).

G is absorbed into the beams, so time enters A only through u_j(t) and exp(i m phi_mean). For
windows of equal length the first function describes the mean over a turn about a fixed axis, a
factor for each order m. The others describe the wandering axis and partly filled windows.

**Means of data over longer times.** A is exact for a mean if all products of a sample have the same
window. In each bin:

1. samples in which every product is flagged are dropped;
2. a product that is present for less than half of the bin's live time is flagged in the bin;
3. samples that lack one of the other products are dropped.

A bin's value is the mean of the remaining samples, weighted by live time; their windows form the
bin's window. Empty bins are dropped.
"""

from dataclasses import replace
from math import factorial, lgamma

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.linalg import block_diag
from threadpoolctl import threadpool_limits

from lusee_bayes.core import checks, harmonics
from lusee_bayes.core.arrays import Array, GridFlags, TimeFlags, Times
from lusee_bayes.core.errors import InputError
from lusee_bayes.instrument import products, visibilities
from lusee_bayes.instrument.observation import Observation
from lusee_bayes.instrument.times import ROUNDING_S, Nodes, Numbers, Windows, later, seconds_from

# numbers of samples; ex and ey; u_j and G_j of the module's equations
Samples, Tilts = Int[np.ndarray, " samples"], Float[np.ndarray, "nodes 2"]
Functions = Float[np.ndarray, "times functions"]
Series, Importance = Float[np.ndarray, "moments columns"], Float[np.ndarray, "powers orders"]
BinFlags = Bool[np.ndarray, "products bins"]

# error of any sample relative to its visibility, if the sky that a beam sees falls as ell to this
# power: less than 1e-6 of the radiometer noise in the fiducial case
TOLERANCE, FALLING = 5e-11, -3.5
# error of the quadrature over a piece, and of the series in moments
ROUNDING = 1e-14


def sufficient_nodes(angle: float) -> int:
    """Return the number of Gauss-Legendre instants that a piece needs.

    Parameters
    ----------
    angle : float
        ``lmax`` times half the angle, in radians, by which the Moon turns in the longest piece.

    Returns
    -------
    int
        The lowest number whose mean of cos(angle x) over -1 < x < 1 errs by less than 1e-14 (from
        the remainder of the quadrature).
    """
    n, error, smallest = 0, 1.0, np.finfo(np.float64).tiny
    while error > ROUNDING:
        n += 1
        # half of 2^(2n+1) n!^4 / ((2n+1) (2n)!^3) times the largest 2n-th derivative
        log = 2 * n * np.log(2.0 * max(angle, smallest)) + 4 * lgamma(n + 1) - 3 * lgamma(2 * n + 1)
        error = np.exp(log) / (2 * n + 1)
    return n


def windowed(
    sample: Numbers, weight: Nodes, azimuth: Nodes, tilt: Tilts, order: int, lmax: int
) -> tuple[Times, Functions, Float[np.ndarray, "functions powers orders 2"]]:
    """Average A's functions of time over windows.

    Parameters
    ----------
    sample : (nodes,) array of int
        Sample number of every instant, non-decreasing.
    weight : (nodes,) array
        Weights that sum to 1 for each sample.
    azimuth : (nodes,) array
        phi, in radians.
    tilt : (nodes, 2) array
        (ex, ey), in radians.
    order : int
        Order of the expansion in the tilt.
    lmax : int
        Highest order m of the beams.

    Returns
    -------
    azimuth : (times,) array
        phi_mean, in radians.
    functions : (times, functions) array
        u_j, the most important first.
    factors : (functions, powers, orders, 2) array
        Real and imaginary part of G_j(p, m), for the powers in the order of
        :func:`.tilt_powers` and m = 0 .. lmax.
    """
    first = np.searchsorted(sample, np.arange(sample[-1] + 1))
    delta = azimuth - azimuth[first][sample]
    delta = np.remainder(delta + np.pi, 2.0 * np.pi) - np.pi
    mean = np.add.reduceat(weight * delta, first)
    delta = delta - mean[sample]
    largest = float(np.abs(delta).max())
    n_moments = terms_of_exponential(lmax * largest, ROUNDING)
    scaled, powers = delta / (largest or 1.0), harmonics.tilt_powers(order)
    ex, ey = -tilt[:, 0], -tilt[:, 1]
    # the transpose of the exponential has the opposite sign
    e = weight[:, None] * np.stack([ex**a * ey**b / factorial(a + b) for a, b in powers], axis=1)
    of_power = [e * scaled[:, None] ** k for k in range(n_moments)]
    moments = np.stack([np.add.reduceat(x, first, axis=0) for x in of_power], axis=2)
    moments, importance = moments.reshape(len(first), -1), _importance(powers, lmax)
    # small matrices: several threads would wait for one another
    with threadpool_limits(1, "blas"):
        functions, factors = _fewest(moments, _series(importance, n_moments, largest))
    factors = factors.reshape(-1, *importance.shape, 2) / importance[..., None]
    return azimuth[first] + mean, functions, factors


def terms_of_exponential(size: float, tolerance: float) -> int:
    """Return how many terms of exp(x) are needed up to ``|x|`` = size: size^n / n! < tolerance."""
    n, term = 1, size
    while term > tolerance:
        n += 1
        term *= size / n
    return n


def _importance(powers: list[tuple[int, int]], lmax: int) -> Importance:
    """Weight of each power of the tilt in the harmonics of each order."""
    ell = np.arange(1.0, max(lmax, 1) + 1.0)
    above = [ell[ell >= max(m, 1)] for m in range(lmax + 1)]
    return np.array([[(x ** (a + b + FALLING)).sum() for x in above] for a, b in powers])


def _series(importance: Importance, n_moments: int, largest: float) -> Series:
    """(i m)^k / k! for scaled moments, real and imaginary parts, weighted by their importance."""
    angle = 1j * np.arange(importance.shape[1]) * largest
    terms = np.array([angle**k / factorial(k) for k in range(n_moments)])
    blocks = importance[:, None, :, None] * np.stack([terms.real, terms.imag], axis=-1)
    return block_diag(*blocks.reshape(len(blocks), n_moments, -1))


def _fewest(moments: Float[np.ndarray, "times moments"], series: Series) -> tuple[Functions, Array]:
    """Functions u and factors G with u G = moments x series at every time, to ``TOLERANCE``."""
    q, r = np.linalg.qr(moments)
    across, left = np.linalg.qr(series.T)
    u, s, vt = np.linalg.svd(r @ left.T, full_matrices=False)
    contributions = (q @ u) * s
    size = np.sqrt((contributions**2).sum(1).max())
    # remainder of each sample without the last functions
    missing = np.sqrt(np.cumsum((contributions**2)[:, ::-1], axis=1)[:, ::-1].max(0))
    keep = max(1, int((missing > TOLERANCE * size).sum()))
    return contributions[:, :keep], vt[:keep] @ across.T


# the sky turns once in 27 days: a longer mean is a mistake, for instance in units
LONGEST_S = 30.0 * 86400.0
# a product present for a smaller share of a bin's live time is flagged in the bin
LEAST_SHARE = 0.5


def averaged(data: visibilities.Visibilities, to_s: float) -> visibilities.Visibilities:
    """Average data over bins of a given length.

    Bins start with the first window of each run and end with the run. If samples do not fit (after
    a gap, or if the length is not a multiple of theirs), a bin ends before the sample that would
    make it longer than ``to_s``.

    Parameters
    ----------
    data : Visibilities
        Their samples must have windows.
    to_s : float
        Length of the bins, in seconds; the step of the result.

    Returns
    -------
    Visibilities
        Each time is midway between the start and the end of its bin.

    Raises
    ------
    InputError
        For instants, for bins that are shorter than the samples or longer than 30 days, and if no
        data remain.
    """
    checks.require_positive("the time to average over, in seconds,", to_s)
    observation, live_s = data.observation, data.observation.live_s
    bin_of = bins_of(observation, to_s)
    kept, used = by_the_rule(np.asarray(data.layout.present), bin_of, live_s)
    if not used.any():
        wrong = f"averages over {to_s:g} s leave no data: products share no samples; average less"
        raise InputError(wrong)
    # renumber the bins that are not empty
    bins, bin_of_left = np.unique(bin_of[used], return_inverse=True)
    weight = live_s[used] / np.bincount(bin_of_left, live_s[used])[bin_of_left]
    grid = np.asarray(data.layout.scatter(data.data))[:, used] * weight
    first = np.searchsorted(bin_of_left, np.arange(len(bins)))
    layout = products.DataLayout.from_flags(~kept[:, bins])
    means = layout.gather(np.add.reduceat(grid, first, axis=1))
    seen, calibration = binned(observation, used, bin_of, to_s), data.calibration
    if calibration is not None:
        fine = calibration.select(used)
        n_averaged = 1.0 / np.add.reduceat(weight**2 / fine.n_averaged, first)
        slope = fine.gain_slope
        slope = None if slope is None else np.add.reduceat(slope * weight, first, axis=1)
        calibration = replace(fine, n_averaged=n_averaged, gain_slope=slope)
    return replace(data, data=means, layout=layout, observation=seen, calibration=calibration)


def product_live_s(data: visibilities.Visibilities) -> float:
    """Return the live time of data in seconds, summed over products."""
    return float(data.observation.live_s[data.layout.time].sum())


def bins_of(observation: Observation, to_s: float) -> Samples:
    """Return the bin number of every sample.

    Parameters
    ----------
    observation : Observation
    to_s : float
        Length of the bins, in seconds.

    Raises
    ------
    InputError
        For instants, and for bins that are shorter than the samples or longer than 30 days.
    """
    if observation.windows is None:
        raise InputError(
            "the samples are instants, which cannot be averaged; give samples with windows "
            "(observation.window=mean in a simulation, observation.timestamp=start, middle or end "
            "for other data), or remove observation.average_s"
        )
    if to_s < observation.step_s - ROUNDING_S:
        raise InputError(
            f"the averaging time of {to_s:g} s is shorter than the samples ({observation.step_s:g} "
            "s); give at least that, or do not average"
        )
    if to_s > LONGEST_S:
        raise InputError(
            f"the averaging time is {to_s:g} s, i.e. {to_s / 86400.0:g} days; give at most "
            f"{LONGEST_S / 86400.0:g} days, one rotation of the Moon"
        )
    seconds = seconds_from(observation.times[0], observation.times)
    start, end = seconds + observation.windows.bounds_s.T
    origin = start[np.searchsorted(observation.run, observation.run)]
    place = np.floor((start - origin + ROUNDING_S) / to_s)
    bin_of, begins = np.zeros(len(start), dtype=np.int64), 0
    for k in range(1, len(start)):
        same = observation.run[k] == observation.run[begins] and place[k] == place[begins]
        if same and end[k] - start[begins] <= to_s + ROUNDING_S:
            bin_of[k] = bin_of[k - 1]
        else:
            bin_of[k], begins = bin_of[k - 1] + 1, k
    return bin_of


def by_the_rule(present: GridFlags, bin_of: Samples, live_s: Times) -> tuple[BinFlags, TimeFlags]:
    """Return which products each bin contains, and which samples it averages.

    Parameters
    ----------
    present : (products, times) array of bool
    bin_of : (times,) array of int
        :func:`bins_of`.
    live_s : (times,) array
        Live time of the samples, in seconds.
    """
    some, first = present.any(axis=0), np.searchsorted(bin_of, np.arange(bin_of[-1] + 1))
    total = np.add.reduceat(live_s * some, first)
    share = np.add.reduceat(live_s * present, first, axis=1)
    # rounding may put an exact half slightly below it
    kept = (share >= LEAST_SHARE * total * (1.0 - 1e-12)) & (total > 0.0)
    return kept, some & kept.any(axis=0)[bin_of] & (present | ~kept[:, bin_of]).all(axis=0)


def binned(observation: Observation, keep: TimeFlags, bin_of: Samples, to_s: float) -> Observation:
    """Return the times and windows of bins.

    Parameters
    ----------
    observation : Observation
        Its samples have windows.
    keep : (times,) array of bool
        The samples that the bins average; bins without any are dropped.
    bin_of : (times,) array of int
        :func:`bins_of`.
    to_s : float
        Length of the bins, in seconds.
    """
    bins, bin_of = np.unique(bin_of[keep], return_inverse=True)
    first, kept = np.searchsorted(bin_of, np.arange(len(bins))), observation.select(keep)
    windows, seconds = kept.windows, seconds_from(kept.times[0], kept.times)
    offset = seconds[windows.sample]
    start, end = windows.start_s + offset, windows.end_s + offset
    bin_of_piece, share = bin_of[windows.sample], windows.live_s / (end - start)
    # by how much the piece's live time would change with the share of the previous piece
    differ = np.abs(np.diff(share)) * (end - start)[1:]
    same, touching = np.diff(bin_of_piece) == 0, start[1:] - end[:-1] <= ROUNDING_S
    at = np.flatnonzero(np.append(True, ~(same & touching & (differ <= ROUNDING_S))))
    start, bin_of_piece = start[at], bin_of_piece[at]
    end = end[np.append(at[1:], len(end)) - 1]
    # pieces touch up to rounding
    live = np.minimum(np.add.reduceat(windows.live_s, at), end - start)
    begin = np.searchsorted(bin_of_piece, np.arange(len(first)))
    middle = (start[begin] + end[np.append(begin[1:], len(start)) - 1]) / 2.0
    times, offset = later(kept.times[first], middle - seconds[first]), middle[bin_of_piece]
    windows = Windows(bin_of_piece, start - offset, end - offset, live)
    return replace(kept, times=times, run=kept.run[first], step_s=to_s, windows=windows)
