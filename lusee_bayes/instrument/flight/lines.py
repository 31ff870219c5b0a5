"""Channels that hold something else than the sky: known lines, the calibrator's comb, and others.

The calibrator sends a comb at 50 kHz + n 100 kHz, in channels 2, 6, 10, ... counted from 0
(coreloop's ``lusee_commands.h`` has the notch index 2 by default, for 50 + 100 n kHz), and the
notch filter subtracts the mean of the same channels. Layout 3 does not say when either is on.
So every spectrum is asked: the difference of these channels from their neighbours, over the whole
band, finds a comb of a small part of the noise in a channel, and a notch as well, which makes it
negative. Where four channels are averaged nothing looks like a line, and only time tells.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from lusee_bayes.core.layouts import Layout, Variable
from lusee_bayes.core.reading import read_table
from lusee_bayes.instrument.flight.band import Band
from lusee_bayes.instrument.flight.outliers import outliers
from lusee_bayes.instrument.flight.spectrometer import CHANNEL_MHZ, Averaging

# of the calibrator: every fourth channel, from this one on
COMB_FIRST, COMB_SPACING = 2, 4
# where the spectrum is smooth enough for neighbours to tell a channel
COMB_MHZ = (5.0, 45.0)
# neighbours by which a channel is predicted to third order, none of which is of the comb
AROUND = ((-3, -1.0 / 16.0), (-1, 9.0 / 16.0), (1, 9.0 / 16.0), (3, -1.0 / 16.0))
# standard deviations of a whole spectrum: no chance, since neighbours never tell it exactly
COMB_LIMIT = 8.0
# a line is in its channel and those beside it; half-way between two, in four
BESIDE_MHZ = 1.5 * CHANNEL_MHZ + 1e-9
TABLE = Layout(
    "known lines",
    {
        "frequency_mhz": Variable(("line",), low=0.0, high=60.0),
        "source": Variable(("line",), "text"),
    },
)


@dataclass(frozen=True)
class KnownLines:
    """Lines that are there all of the time.

    Attributes
    ----------
    frequency_mhz : (lines,) array
    source : tuple of str
        Who says so.
    """

    frequency_mhz: Float[np.ndarray, " lines"]
    source: tuple[str, ...]

    def bins(
        self, averaging: Averaging, middles_mhz: Float[np.ndarray, " channels"]
    ) -> Bool[np.ndarray, " bins"]:
        """Return the bins that hold a line, or a channel beside one."""
        near = np.abs(middles_mhz[:, None] - self.frequency_mhz) <= BESIDE_MHZ
        return near.any(axis=1)[averaging.channels()].any(axis=1)


NO_LINES = KnownLines(np.zeros(0), ())


def read_lines(path: str | Path) -> KnownLines:
    """Read a CSV table of lines: ``frequency_mhz``, and the ``source`` of each.

    Raises
    ------
    InputError
        If it cannot be read.
    """
    found = read_table(path, TABLE, "write a line 'frequency_mhz,source' and one for each")
    return KnownLines(found["frequency_mhz"], tuple(map(str, found["source"])))


def comb_bins(averaging: Averaging) -> Bool[np.ndarray, " bins"]:
    """Return the bins that hold a channel of the comb."""
    return (averaging.channels() % COMB_SPACING == COMB_FIRST).any(axis=1)


def comb_strength(
    autos: Float[np.ndarray, "rows ports bins"],
    frames: Float[np.ndarray, " rows"],
    averaging: Averaging,
    middles_mhz: Float[np.ndarray, " channels"],
) -> Float[np.ndarray, " rows"]:
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
        Of the port where it is most; 0 where every bin holds a channel of the comb.
    """
    comb = comb_bins(averaging)
    if comb.all():
        return np.zeros(len(autos))
    mhz = middles_mhz[averaging.channels()].mean(axis=1)
    at = np.flatnonzero(comb & (mhz > COMB_MHZ[0]) & (mhz < COMB_MHZ[1]))
    around = sum(weight * autos[..., at + offset] for offset, weight in AROUND)
    spread = np.sqrt(1.0 + sum(weight**2 for _, weight in AROUND))
    noise = np.abs(around) * spread / np.sqrt(frames * averaging.members)[:, None, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        z = (autos[..., at] - around) / noise
    known = np.isfinite(z)
    count = np.maximum(known.sum(axis=2), 1)
    # a strong line of its own is no comb
    clipped = np.clip(np.where(known, z, 0.0), -COMB_LIMIT, COMB_LIMIT)
    strength = clipped.sum(axis=2) / np.sqrt(count)
    most = np.abs(strength).argmax(axis=1)
    return np.take_along_axis(strength, most[:, None], axis=1)[:, 0]


def line_flags(
    band: Band,
    autos: Float[np.ndarray, "rows ports bins"],
    frames: Float[np.ndarray, " rows"],
    good: Bool[np.ndarray, "rows bins"],
    limit: float,
) -> tuple[Bool[np.ndarray, "rows bins"], Float[np.ndarray, "rows ports bins"]]:
    """Find bins of a band that do not lie on a smooth spectrum, in each spectrum on its own.

    Parameters
    ----------
    band : Band
    autos : (rows, ports, bins) array
        Of the band, in V^2/Hz.
    frames : (rows,) array
    good : (rows, bins) array of bool
        Bins to be looked at.
    limit : float
        :func:`.threshold`.

    Returns
    -------
    (rows, bins) array of bool
    (rows, ports, bins) array
        Distances from the spectrum, in standard deviations.
    """
    # the level of the spectrum, which a strong line must not raise; ports that are absent are zero
    usable = np.where((good | ~good.any(axis=1)[:, None])[:, None], autos, np.nan)
    level = np.nanmedian(usable, axis=2)
    own = np.sqrt(np.diagonal(band.shared))
    noise = np.abs(level)[..., None] * own / np.sqrt(frames)[:, None, None]
    return outliers(autos, np.where(noise > 0.0, noise, 1.0), good, band.finer, limit)
