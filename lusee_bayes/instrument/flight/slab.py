"""Some spectra of one state of the spectrometer: from counts to a value for a band."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Bool, Float, Float32

from lusee_bayes.instrument.flight.band import Band
from lusee_bayes.instrument.flight.gain_table import NANO2, GainTable
from lusee_bayes.instrument.flight.lines import COMB_LIMIT, comb_bins, comb_strength, line_flags
from lusee_bayes.instrument.flight.outliers import robust_scale, threshold
from lusee_bayes.instrument.flight.recipe import Recipe
from lusee_bayes.instrument.flight.spectrometer import (
    AVERAGING,
    NO_LEVEL,
    OF_FLIGHT,
    PORTS,
    channel_mhz,
)
from lusee_bayes.instrument.products import all_products, auto_indices

AUTOS = auto_indices()
FIRST_PORT = np.array([p.i for p in all_products()])
SECOND_PORT = np.array([p.j for p in all_products()])
IMAGINARY = np.array([p.part == "I" for p in all_products()])


@dataclass(frozen=True, eq=False)
class State:
    """What is the same for many spectra: the bands, the gains' splines, the known lines.

    Attributes
    ----------
    recipe : Recipe
    navgf : int
    levels : tuple of str
        Of the ports.
    bands : tuple of Band
    basis : (ports, 3, bins) array
        Mean and components of the gains, averaged over the channels of every bin; NaN where there
        are none.
    known : (bins,) array of bool
        Bins with known lines.
    """

    recipe: Recipe
    navgf: int
    levels: tuple[str, ...]
    bands: tuple[Band, ...]
    basis: Float[np.ndarray, "ports 3 bins"]
    known: Bool[np.ndarray, " bins"]

    @classmethod
    def of(cls, recipe: Recipe, navgf: int, levels: tuple[str, ...]) -> State:
        """Prepare bands and gains.

        Raises
        ------
        InputError
            If a band has too few bins.
        """
        averaging, middles = AVERAGING[navgf], channel_mhz(recipe.origin)
        channels = averaging.channels()
        basis = np.full((PORTS, 3, averaging.n_bins), np.nan)
        for port, level in enumerate(levels):
            if level != NO_LEVEL:
                basis[port] = _spline(recipe.table, level, port, recipe.origin)[:, channels].mean(
                    axis=2
                )
        bands = tuple(
            Band.of(f, recipe.bandwidth_mhz, recipe.degree, averaging, middles, recipe.shared_noise)
            for f in recipe.frequencies_mhz
        )
        known = recipe.lines.bins(averaging, middles)
        if recipe.comb == "always":
            known = known | comb_bins(averaging)
        return cls(recipe, navgf, levels, bands, basis, known)

    def strengths(
        self, telemetry: Mapping[str, Float[np.ndarray, " rows"]], n_rows: int
    ) -> Float[np.ndarray, "rows ports 3"]:
        """Return 1, q_1 and q_2 of every port; NaN where it has no level."""
        found = np.full((n_rows, PORTS, 3), np.nan)
        for port, level in enumerate(self.levels):
            if level != NO_LEVEL:
                found[:, port, 0] = 1.0
                found[:, port, 1:] = self.recipe.table.strengths(level, port, telemetry)
        return found


@lru_cache(maxsize=64)
def _spline(table: GainTable, level: str, port: int, origin: str) -> np.ndarray:
    return table.basis(level, port, channel_mhz(origin))


@dataclass(frozen=True, eq=False)
class Slab:
    """Counts of some spectra, with what is needed to calibrate them.

    Attributes
    ----------
    state : State
    counts : (rows, products, channels) array
        As the file has them.
    frames : (rows,) array
        Frames that each averages.
    strengths : (rows, ports, 3) array
        :meth:`State.strengths`.
    saturated : (rows,) array of bool
    comb : (rows,) array of bool
        Whether the comb's channels differ from the others.
    """

    state: State
    counts: Float32[np.ndarray, "rows products channels"]
    frames: Float[np.ndarray, " rows"]
    strengths: Float[np.ndarray, "rows ports 3"]
    saturated: Bool[np.ndarray, " rows"]
    comb: Bool[np.ndarray, " rows"]

    @classmethod
    def of(
        cls,
        state: State,
        counts: Float32[np.ndarray, "rows products channels"],
        frames: Float[np.ndarray, " rows"],
        strengths: Float[np.ndarray, "rows ports 3"],
        saturated: Bool[np.ndarray, " rows"],
        notched: Bool[np.ndarray, " rows"],
    ) -> Slab:
        """Look for the comb.

        Parameters
        ----------
        notched : (rows,) array of bool
            Where the file says that the notch filter was on.
        """
        comb = notched
        if state.recipe.comb == "found":
            averaging, middles = AVERAGING[state.navgf], channel_mhz(state.recipe.origin)
            autos = counts[:, :PORTS].astype(np.float64)
            strength = comb_strength(autos, frames, averaging, middles)
            comb = comb | (np.abs(strength) > COMB_LIMIT)
        return cls(state, counts, frames, strengths, saturated, comb)

    def values(self, number: int) -> BandValues:
        """Calibrate, flag and average the channels of one band.

        Parameters
        ----------
        number : int
            Of the band.
        """
        state, recipe = self.state, self.state.recipe
        band, averaging = state.bands[number], AVERAGING[state.navgf]
        at = slice(band.first, band.last)
        basis = state.basis[:, :, at]
        gain = np.einsum("rpc,pck->rpk", self.strengths, basis)
        with np.errstate(invalid="ignore"):
            root = np.sqrt(np.where(gain > 0.0, gain, np.nan))
        raw = self.counts[:, OF_FLIGHT, at].astype(np.float64)
        factor = NANO2 * averaging.divisor / averaging.members
        spectra = raw * factor / (root[:, FIRST_PORT] * root[:, SECOND_PORT])
        if recipe.sign < 0:
            spectra[:, IMAGINARY] *= -1.0
        finite = np.isfinite(spectra)
        present = finite.any(axis=2)
        # where a product is there, all of it has to be
        whole = (finite | ~present[..., None]).all(axis=1) & present[:, AUTOS].any(axis=1)[:, None]
        autos = np.where(finite[:, AUTOS], spectra[:, AUTOS], np.nan)
        known = np.broadcast_to(state.known[at], whole.shape)
        if self.comb.any():
            known = known | (self.comb[:, None] & comb_bins(averaging)[at])
        good = whole & ~known & ~self.saturated[:, None]
        # products without an auto of their own do not tell lines
        filled = np.where(np.isfinite(autos), autos, 0.0)
        limit = threshold(recipe.false_alarm, PORTS)
        found, z = line_flags(band, filled, self.frames, good, limit)
        kept = good & ~found
        there = np.isfinite(autos)
        mean_auto = filled.sum(axis=1) / np.maximum(there.sum(axis=1), 1)
        clean = np.where(finite, spectra, 0.0)
        values, variance, further = band.values(clean, mean_auto, kept)
        before, _, _ = band.values(clean, mean_auto, whole)
        middle = band.basis[:, :1].T / len(band.basis)
        centre = np.einsum("rpk,k->rp", gain, middle[0])
        components = np.einsum("pck,k->pc", basis[:, 1:], middle[0])
        return BandValues(
            values=np.where(present, values, np.nan),
            before=np.where(present, before, np.nan),
            variance=variance,
            further=further[:, AUTOS],
            whole=whole.any(axis=1),
            clean=good.any(axis=1),
            lines=1.0 - kept.sum(axis=1) / len(band.basis),
            scatter=robust_scale(z[:, 0], kept),
            gain=centre,
            slope=components[None] / centre[..., None],
        )


@dataclass(frozen=True, eq=False)
class BandValues:
    """Values of one band for some spectra.

    Attributes
    ----------
    values, before : (rows, products) array
        In V^2/Hz; without flagged channels, and with all. NaN for absent products.
    variance : (rows,) array
        As :meth:`Band.values`.
    further : (rows, ports) array
        What two further powers would add to the autos.
    whole : (rows,) array of bool
        Whether there are gains and data.
    clean : (rows,) array of bool
        Whether there are bins without known lines.
    lines : (rows,) array
        Share of the bins that are not used.
    scatter : float
        Of the channels about a smooth spectrum, over the radiometer noise.
    gain : (rows, ports) array
    slope : (rows, ports, components) array
    """

    values: Float[np.ndarray, "rows products"]
    before: Float[np.ndarray, "rows products"]
    variance: Float[np.ndarray, " rows"]
    further: Float[np.ndarray, "rows ports"]
    whole: Bool[np.ndarray, " rows"]
    clean: Bool[np.ndarray, " rows"]
    lines: Float[np.ndarray, " rows"]
    scatter: float
    gain: Float[np.ndarray, "rows ports"]
    slope: Float[np.ndarray, "rows ports components"]
