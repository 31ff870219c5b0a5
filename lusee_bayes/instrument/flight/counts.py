"""From V^2/Hz to what the spectrometer sends: gains, averages over channels, whole numbers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float, Float32, Int

from lusee_bayes.instrument.flight.channel_spectra import FIRST, SECOND
from lusee_bayes.instrument.flight.gain_table import LETTERS, NANO2, GainTable
from lusee_bayes.instrument.flight.spectrometer import (
    AVERAGING,
    OF_FLIGHT,
    PORTS,
    BinOrigin,
    channel_mhz,
)
from lusee_bayes.instrument.products import all_products

IMAGINARY = np.array([p.part == "I" for p in all_products()])
# of the 31 bits of a number, so many hold the largest of a spectrum. What is rounded then is far
# below the noise, also where a spectrum has fallen to a thousandth
BITS = 27
REFERENCE = 31


@dataclass(frozen=True, eq=False)
class Counting:
    """How spectra become counts, for one state of the spectrometer.

    Attributes
    ----------
    table : GainTable
        Channels beyond its frequencies have the gain at its ends.
    levels : str
        Of the gains of the ports, as MMMM.
    navgf : int
        Averaging over channels.
    origin : {"centre", "edge"}
        What of channel k lies at k times 25 kHz.
    sign : {1, -1}
        Of the imaginary parts of the spectrometer, in those of <s_i conj(s_j)>.
    """

    table: GainTable
    levels: str
    navgf: int
    origin: BinOrigin
    sign: int = 1

    @cached_property
    def _basis(self) -> Float[np.ndarray, "ports 3 channels"]:
        found = []
        for port, level in enumerate(self.levels):
            anchors = self.table.anchor_mhz[LETTERS.index(level), port]
            inside = np.clip(channel_mhz(self.origin), anchors[0], anchors[-1])
            found.append(self.table.basis(level, port, inside))
        return np.array(found)

    def __call__(
        self,
        spectra: Float[np.ndarray, "products rows channels"],
        telemetry: Mapping[str, Float[np.ndarray, " rows"]],
    ) -> Float[np.ndarray, "rows products bins"]:
        """Return counts before they are rounded.

        Parameters
        ----------
        spectra : (products, rows, channels) array
            In V^2/Hz, in the package's order.
        telemetry : mapping of str to (rows,) array

        Returns
        -------
        (rows, products, bins) array
            In the spectrometer's order.
        """
        root = []
        for port in range(PORTS):
            q = self.table.strengths(self.levels[port], port, telemetry)
            gain = self._basis[port, 0] + q @ self._basis[port, 1:]
            # where a table has none, nothing is sent
            root.append(np.sqrt(np.maximum(gain, 0.0)))
        averaging = AVERAGING[self.navgf]
        members = averaging.channels()
        found = np.empty((spectra.shape[1], len(spectra), averaging.n_bins))
        for k, product in enumerate(spectra):
            counts = product * (root[FIRST[k]] * root[SECOND[k]]) / NANO2
            counts = counts[:, members].sum(axis=2) / averaging.divisor
            found[:, OF_FLIGHT[k]] = counts * (self.sign if IMAGINARY[k] else 1)
        return found


def bit_slices(counts: Float[np.ndarray, "rows products bins"]) -> Int[np.ndarray, " products"]:
    """Return the slices for spectra like the first of some.

    Parameters
    ----------
    counts : (rows, products, bins) array
        In the spectrometer's order. Crosses have a slice by their autos, which bound them.
    """
    top = np.empty(counts.shape[1])
    autos = OF_FLIGHT[[k for k in range(len(FIRST)) if FIRST[k] == SECOND[k]]]
    largest = np.abs(counts[0, autos]).max(axis=1)
    top[OF_FLIGHT] = np.sqrt(largest[FIRST] * largest[SECOND])
    bits = np.ceil(np.log2(top)) + REFERENCE - BITS
    return np.clip(bits, 0, REFERENCE).astype(np.int64)


def rounded(
    counts: Float[np.ndarray, "rows products bins"], bitslice: Int[np.ndarray, "rows products"]
) -> Float32[np.ndarray, "rows products bins"]:
    """Return multiples of 2^(slice - 31).

    Parameters
    ----------
    counts : (rows, products, bins) array
    bitslice : (rows, products) array of int
    """
    step = 2.0 ** (bitslice - REFERENCE)[..., None]
    return (np.rint(counts / step) * step).astype(np.float32)
