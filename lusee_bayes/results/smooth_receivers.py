"""Channels whose receivers have smooth spectra: each worked out alone, then all tied together.

What port i's power is off by, z_i(f) in prior standard deviations, is a Gaussian process::

    K(f, f') = exp(-(log2 f - log2 f')^2 / (2 smooth_octaves^2)),    ports independent.

A channel alone has z ~ N(0, 1), as its diagonal says. Its posterior of sky m and powers z, with
means E and covariance V of z, becomes that given all data (:mod:`.tied_amplitudes`) by ::

    mean of m + G (E' - E),    covariance of m + G (V' - V) G^T,    G = Cov(m, z) V^-1,

since m depends on other channels through z alone, and so do ground and gains.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import jax
import numpy as np
import xarray as xr
from jaxtyping import Float, Int, PRNGKeyArray

from lusee_bayes.experiment.scenario import Scenario
from lusee_bayes.experiment.terms.receiver import is_receiver
from lusee_bayes.linear.templates import Amplitudes
from lusee_bayes.linear.tied_amplitudes import Tied, information_given, tie, told_by_others
from lusee_bayes.results.channel import ChannelResult, channel_of_information
from lusee_bayes.results.channel_files import ChannelFiles
from lusee_bayes.results.channel_information import ChannelInformation
from lusee_bayes.results.draws import draw_key

# numbers of a channel's own posterior
NUMBERS = ("log_evidence", "information_bits", "chi2_model", "refinement")
# what the key of draws is folded with: numbers of channels are smaller
TIED = 1 << 20


@dataclass(frozen=True)
class ChannelAlone:
    """A channel's posterior given its own data, as it is kept until all channels are known.

    Attributes
    ----------
    known : ChannelInformation
    mean : (modes,) array
        In K.
    covariance : (modes, modes) array
        In K^2.
    draws : (n, modes) array
        Less the mean, in K.
    compared : (more, modes) array
        Draws less the mean that coverage is compared with, in K; none where no truth is known.
    numbers : dict of float
        ``NUMBERS``, as in :class:`.ChannelResult`.
    """

    known: ChannelInformation
    mean: Float[np.ndarray, " modes"]
    covariance: Float[np.ndarray, "modes modes"]
    draws: Float[np.ndarray, "n modes"]
    compared: Float[np.ndarray, "more modes"]
    numbers: dict[str, float]

    def receivers(self) -> tuple[Float[np.ndarray, " ports"], Float[np.ndarray, "ports ports"]]:
        """E and V of the receivers' powers, in prior standard deviations."""
        told, own = self._told(), self._own()
        return told.mean[own], told.covariance[np.ix_(own, own)]

    def _told(self) -> Amplitudes:
        return self.known.observed.unknowns.amplitudes.integrated(self.mean, self.covariance)

    def _own(self) -> Int[np.ndarray, " ports"]:
        """Which unknowns are powers of receivers."""
        rows = self.known.observed.unknowns.rows
        return np.flatnonzero([is_receiver(row["unknown"]) for row in rows])

    def tied(
        self,
        mean: Float[np.ndarray, " ports"],
        covariance: Float[np.ndarray, "ports ports"],
        draws: Float[np.ndarray, "all ports"],
        key: PRNGKeyArray,
    ) -> ChannelResult:
        """The channel given all data.

        Parameters
        ----------
        mean, covariance : (ports,) and (ports, ports) array
            E' and V' of its receivers' powers.
        draws : (all, ports) array
            Of these, for ``draws`` and ``compared``.
        key : PRNG key
            For the powers that go with the channel's own draws.
        """
        told, own = self._told(), self._own()
        e, v = told.mean[own], told.covariance[np.ix_(own, own)]
        gain = np.linalg.solve(v, told.with_sky[:, own].T).T
        moved = self.mean + gain @ (mean - e)
        left = self.covariance + gain @ (covariance - v) @ gain.T
        # powers that go with the channel's own draws, less their mean
        amplitudes = self.known.observed.unknowns.amplitudes
        inner = amplitudes.covariance[np.ix_(own, own)]
        deviations = np.concatenate([self.draws, self.compared])
        normals = np.asarray(jax.random.normal(key, (len(deviations), len(own))))
        variances, axes = np.linalg.eigh(inner)
        normals = (normals * np.sqrt(np.maximum(variances, 0.0))) @ axes.T
        with_them = normals - deviations @ amplitudes.pull[own].T
        deviations = deviations + (draws - mean - with_them) @ gain.T
        # what the other channels tell of this one's unknowns
        n = len(amplitudes.mean)
        precision, vector = np.zeros((n, n)), np.zeros(n)
        precision[np.ix_(own, own)], vector[own] = told_by_others(e, v, mean, covariance)
        unknowns = replace(
            self.known.observed.unknowns, amplitudes=amplitudes.given(precision, vector)
        )
        sky_share = np.linalg.solve(v, (np.linalg.solve(v, v - inner)).T)
        gained = np.linalg.slogdet(np.eye(len(own)) + (covariance - v) @ sky_share)[1]
        n_draws = len(self.draws)
        bits = self.numbers["information_bits"] - 0.5 * gained / np.log(2.0)
        return channel_of_information(
            replace(self.known.observed, unknowns=unknowns),
            information_given(self.known.information, amplitudes, precision, vector),
            moved,
            left,
            moved + deviations[:n_draws],
            compared=deviations[n_draws:] if len(self.compared) else None,
            **(self.numbers | {"information_bits": float(bits)}),
        )

    def to_dataset(self) -> xr.Dataset:
        """All of it, for :meth:`from_dataset`."""
        found = self.known.to_dataset()
        own = xr.Dataset(
            {
                "alone_mean": ("mode", self.mean),
                "alone_covariance": (("mode", "mode_2"), self.covariance),
                "alone_draws": (("alone_draw", "mode"), self.draws),
                "alone_compared": (("alone_more", "mode"), self.compared),
            }
        )
        numbers = {f"alone_{name}": self.numbers[name] for name in NUMBERS}
        return found.merge(own).assign_attrs(found.attrs | numbers)

    @classmethod
    def from_dataset(cls, dataset: xr.Dataset) -> ChannelAlone:
        """The inverse of :meth:`to_dataset`."""
        names = ("mean", "covariance", "draws", "compared")
        arrays = (np.asarray(dataset[f"alone_{name}"]) for name in names)
        numbers = {name: float(dataset.attrs[f"alone_{name}"]) for name in NUMBERS}
        return cls(ChannelInformation.from_dataset(dataset), *arrays, numbers)


def kernel(
    frequencies_mhz: Float[np.ndarray, " channels"], octaves: float
) -> Float[np.ndarray, "channels channels"]:
    """K of the module's equations, with a port's values at all frequencies."""
    x = np.log2(frequencies_mhz) / octaves
    return np.exp(-0.5 * (x[:, None] - x[None]) ** 2)


def tie_receivers(scenario: Scenario, channels: Sequence[Scenario], files: ChannelFiles) -> Tied:
    """The receivers' powers given the data of all channels, from what is kept of each alone.

    Parameters
    ----------
    scenario : Scenario
        Of several frequencies.
    channels : sequence of Scenario
        That could be mapped.
    files : ChannelFiles

    Raises
    ------
    InputError
        As :func:`.tie`.
    """
    means, covariances, n_draws = [], [], 0
    for channel in channels:
        alone = ChannelAlone.from_dataset(files.read(channel, "alone"))
        mean, covariance = alone.receivers()
        means.append(mean)
        covariances.append(covariance)
        n_draws = len(alone.draws) + len(alone.compared)
    own = jax.random.fold_in(draw_key(scenario), TIED)
    normals = np.asarray(jax.random.normal(own, (n_draws, sum(map(len, means)))))
    frequencies = np.array([channel.frequency_mhz for channel in channels])
    ties = kernel(frequencies, scenario.noise.receiver.smooth_octaves)
    return tie(np.stack(means), np.stack(covariances), ties, normals)


def write_tied_sky(
    number: int,
    channels: Sequence[Scenario],
    tied: Tied,
    files: ChannelFiles,
) -> None:
    """Write the result of one channel, unless it is there."""
    channel = channels[number]
    if files.has(channel, "result"):
        return
    alone = ChannelAlone.from_dataset(files.read(channel, "alone"))
    key = jax.random.fold_in(draw_key(channel), TIED + 1)
    found = alone.tied(tied.mean[number], tied.covariance[number], tied.draws[:, number], key)
    files.write(channel, "result", found.to_dataset())
