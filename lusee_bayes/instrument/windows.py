"""The windows over which samples were integrated: what a visibility is the mean of.

A sample has one or more pieces, within each of which its live time is spread evenly: one piece
where the spectrometer integrated without a gap, or with a duty cycle far faster than the sky turns;
several where something was left out. The mean over a window is that over its pieces, each with the
weight of its live time.
"""

from __future__ import annotations

from dataclasses import dataclass

import astropy.units as u
import numpy as np
from astropy.time import Time
from jaxtyping import Bool, Float, Int

from lusee_bayes.core.checks import Described, require_finite
from lusee_bayes.core.errors import InputError
from lusee_bayes.instrument.times import unannounced_leap_seconds

# times of a Julian date in two parts are exact to less than a nanosecond, others to a few of them
ROUNDING_S = 1e-6


@dataclass(frozen=True, repr=False)
class Windows(Described):
    """Start, end and live time of every piece of every sample.

    Attributes
    ----------
    sample : (pieces,) array of int
        The sample that each piece belongs to: 0, 1, ... without going back.
    start_s, end_s : (pieces,) array
        In seconds from the sample's time.
    live_s : (pieces,) array
        What was integrated between them, in seconds.

    Raises
    ------
    InputError
        For a piece that ends before it begins, overlaps the one before it, or was live for longer
        than it lasts or not at all, and for a sample without a piece.
    """

    sample: Int[np.ndarray, " pieces"]
    start_s: Float[np.ndarray, " pieces"]
    end_s: Float[np.ndarray, " pieces"]
    live_s: Float[np.ndarray, " pieces"]

    def __post_init__(self):
        lengths = {x.shape for x in (self.sample, self.start_s, self.end_s, self.live_s)}
        if len(lengths) > 1 or self.sample.ndim != 1 or not self.sample.size:
            raise InputError(
                "sample, start_s, end_s and live_s of windows must be lists of the same length, "
                f"with at least one piece; got the shapes {sorted(lengths)}"
            )
        steps = np.diff(self.sample)
        if self.sample[0] != 0 or not ((steps == 0) | (steps == 1)).all():
            raise InputError(
                "pieces of windows must count the samples 0, 1, ... without going back, with at "
                "least one piece for each"
            )
        for name in ("start_s", "end_s", "live_s"):
            require_finite(f"{name} of the windows", getattr(self, name))
        length = self.end_s - self.start_s
        self._refuse(
            ~(length > 0.0),
            "ends {0:g} s from its time, not after its start at {1:g} s; windows need a start and "
            "then an end",
            self.end_s,
            self.start_s,
        )
        self._refuse(
            self.live_s > length + ROUNDING_S,
            "was live for {0:g} s of a window of {1:g} s; live time cannot be longer than the "
            "window",
            self.live_s,
            length,
        )
        self._refuse(
            ~(self.live_s > 0.0),
            "has a live time of {0:g} s; leave out samples in which nothing was integrated",
            self.live_s,
        )
        same = np.zeros(len(length), dtype=bool)
        same[1:] = (steps == 0) & (self.start_s[1:] < self.end_s[:-1] - ROUNDING_S)
        self._refuse(
            same,
            "has a piece that begins at {0:g} s, before the one before it has ended; pieces of a "
            "window must not overlap",
            self.start_s,
        )

    def _refuse(self, wrong: Bool[np.ndarray, " pieces"], text: str, *values: np.ndarray) -> None:
        if wrong.any():
            first = int(np.argmax(wrong))
            what = text.format(*(float(value[first]) for value in values))
            raise InputError(f"sample {self.sample[first]} {what}")

    @classmethod
    def whole(
        cls,
        start_s: Float[np.ndarray, " samples"],
        end_s: Float[np.ndarray, " samples"],
        live_s: Float[np.ndarray, " samples"] | None = None,
    ) -> Windows:
        """Return windows of one piece each, live all of the time unless ``live_s`` says less."""
        live_s = end_s - start_s if live_s is None else live_s
        return cls(np.arange(len(start_s)), start_s, end_s, live_s)

    def description(self) -> tuple[str, ...]:
        live, bounds = self.live_per_sample_s, self.bounds_s
        share = live.sum() / (bounds[:, 1] - bounds[:, 0]).sum()
        return (
            f"{self.n_samples} windows in {len(self.sample)} pieces, live for {live.min():g} to "
            f"{live.max():g} s, {share:.1%} of the time",
        )

    @property
    def n_samples(self) -> int:
        """Number of samples."""
        return int(self.sample[-1]) + 1

    @property
    def live_per_sample_s(self) -> Float[np.ndarray, " samples"]:
        """Live time of every sample, in seconds."""
        return np.add.reduceat(self.live_s, self._first)

    @property
    def bounds_s(self) -> Float[np.ndarray, "samples 2"]:
        """Start and end of every sample, in seconds from its time."""
        last = np.append(self._first[1:], len(self.sample)) - 1
        return np.stack([self.start_s[self._first], self.end_s[last]], axis=1)

    @property
    def _first(self) -> Int[np.ndarray, " samples"]:
        return np.searchsorted(self.sample, np.arange(self.n_samples))

    def require_fitting(self, times: Time, step_s: float) -> None:
        """Check that windows are those of samples at these times, a step apart.

        Raises
        ------
        InputError
            If there are more or fewer of them, and if one is longer than a step or overlaps the
            next.
        """
        if self.n_samples != len(times):
            raise InputError(
                f"there are windows of {self.n_samples} samples for {len(times)} times"
            )
        bounds = self.bounds_s
        length = bounds[:, 1] - bounds[:, 0]
        if (length > step_s * (1.0 + 1e-9) + ROUNDING_S).any():
            longest = int(np.argmax(length))
            raise InputError(
                f"the window of sample {longest} lasts {length[longest]:g} s, longer than the step "
                f"of {step_s:g} s from sample to sample; check the bounds, or give the step"
            )
        with unannounced_leap_seconds():
            seconds = (times - times[0]).to_value(u.s)
        gaps = np.diff(seconds) + bounds[1:, 0] - bounds[:-1, 1]
        if (gaps < -ROUNDING_S).any():
            first = int(np.argmax(gaps < -ROUNDING_S))
            raise InputError(
                f"the windows of samples {first} and {first + 1} ({times[first].isot[:19]}) "
                f"overlap by {-gaps[first]:g} s; give each stretch of time to one sample"
            )

    def select(self, keep: Bool[np.ndarray, " samples"]) -> Windows:
        """Return the windows of the samples where ``keep`` is True."""
        here = keep[self.sample]
        _, sample = np.unique(self.sample[here], return_inverse=True)
        return Windows(sample, self.start_s[here], self.end_s[here], self.live_s[here])

    def nodes(
        self, n: int
    ) -> tuple[Int[np.ndarray, " nodes"], Float[np.ndarray, " nodes"], Float[np.ndarray, " nodes"]]:
        """Return instants whose weighted means are those over the windows (Gauss-Legendre).

        Parameters
        ----------
        n : int
            Instants in each piece: exact for polynomials in time up to degree 2 n - 1.

        Returns
        -------
        sample : (nodes,) array of int
            The sample of every instant, growing.
        offset_s : (nodes,) array
            Seconds from the sample's time, growing within each sample.
        weight : (nodes,) array
            One in total for each sample.
        """
        x, w = np.polynomial.legendre.leggauss(n)
        middle, half = (self.start_s + self.end_s) / 2.0, (self.end_s - self.start_s) / 2.0
        offset = middle[:, None] + half[:, None] * x
        share = self.live_s / self.live_per_sample_s[self.sample]
        weight = share[:, None] * (w / 2.0)
        return np.repeat(self.sample, n), offset.ravel(), weight.ravel()
