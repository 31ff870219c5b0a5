"""What disturbs simulated sessions: drawn for every spectrum, and known for tests of the flags."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Complex, Float, Shaped

from lusee_bayes.core.errors import InputError
from lusee_bayes.experiment.schema import FlightSimulatedSection
from lusee_bayes.instrument.flight.lines import COMB_FIRST, COMB_SPACING
from lusee_bayes.instrument.flight.spectrometer import (
    AVERAGING,
    CHANNEL_MHZ,
    FLIGHT_PRODUCTS,
    N_CHANNELS,
    PORTS,
    BinOrigin,
    channel_mhz,
)

# disturbances come in stretches of so many spectra, but those of single ones
STRETCH = 5
# a saturated spectrum has so many times its counts
SATURATED = 40.0
# bursts are measured against the noise in so many channels
BURST_CHANNELS = 1.0 / CHANNEL_MHZ


@dataclass(frozen=True, eq=False)
class Disturbances:
    """What was put into each spectrum.

    Attributes
    ----------
    level : (rows, ports) array of str
        Of the gains.
    absent : (rows, 16) array of bool
        Products that are NaN, in the spectrometer's order.
    saturated, tone, comb : (rows,) array of bool
    tone_channel : (channels,) array of bool
        Channels that have a tone in these spectra.
    burst : (rows,) array of bool
    phase : (rows, ports) array
        Of bursts at the ports, in radians.
    section : FlightSimulatedSection
        How strong all of it is.
    """

    level: Shaped[np.ndarray, "rows ports"]
    absent: Bool[np.ndarray, "rows products"]
    saturated: Bool[np.ndarray, " rows"]
    tone: Bool[np.ndarray, " rows"]
    tone_channel: Bool[np.ndarray, " channels"]
    comb: Bool[np.ndarray, " rows"]
    burst: Bool[np.ndarray, " rows"]
    phase: Float[np.ndarray, "rows ports"]
    section: FlightSimulatedSection

    @classmethod
    def drawn(
        cls,
        section: FlightSimulatedSection,
        hours: Float[np.ndarray, " rows"],
        step_s: float,
        origin: BinOrigin,
        seed: int,
    ) -> Disturbances:
        """Draw them.

        Parameters
        ----------
        section : FlightSimulatedSection
        hours : (rows,) array
            Of the spectra, since the first.
        step_s : float
            From spectrum to spectrum.
        origin : {"centre", "edge"}
            What of channel k lies at k times 25 kHz.
        seed : int

        Raises
        ------
        InputError
            If a tone is in a channel that no bin holds.
        """
        n, generator = len(hours), np.random.default_rng([seed, 1])
        level = np.array([list(section.levels)] * n, dtype="U1")
        if section.switch_h is not None:
            level[hours >= section.switch_h] = list(section.switch_levels)
        absent = np.zeros((n, len(FLIGHT_PRODUCTS)), dtype=bool)
        for row in np.flatnonzero(_stretches(generator, n, section.absent_share, 1)):
            absent[row, generator.integers(len(FLIGHT_PRODUCTS))] = True
        saturated = _stretches(generator, n, section.saturated_share, 1)
        tones = _tone_channels(section, origin)
        tone = _stretches(generator, n, section.tone_share if section.tones_mhz else 0.0, STRETCH)
        comb = _stretches(generator, n, section.comb_share, STRETCH)
        burst, phase = np.zeros(n, dtype=bool), np.zeros((n, PORTS))
        at = 0.0
        while section.burst_every_h is not None:
            at += generator.exponential(section.burst_every_h)
            if at > hours[-1]:
                break
            length_s = step_s * max(section.burst_s / step_s, 1.0) ** generator.uniform()
            # at least one spectrum, up to the end of the burst
            first = int(np.searchsorted(hours, at))
            here = slice(first, max(first + 1, np.searchsorted(hours, at + length_s / 3600.0)))
            burst[here] = True
            phase[here] = generator.uniform(0.0, 2.0 * np.pi, PORTS)
        return cls(level, absent, saturated, tone, tones, comb, burst, phase, section)

    def add(
        self,
        t: Complex[np.ndarray, "antennas antennas rows channels"],
        rows: slice,
        frames: float,
    ) -> None:
        """Add tones, comb and bursts to the covariance of the voltages of some spectra, in place.

        Parameters
        ----------
        t : (antennas, antennas, rows, channels) array
        rows : slice
            Which spectra.
        frames : float
            Frames that each averages.
        """
        level = np.einsum("iirc->rc", t).real / (PORTS * np.sqrt(frames))
        comb = np.arange(N_CHANNELS) % COMB_SPACING == COMB_FIRST
        section = self.section
        lines = section.tone_factor * (self.tone[rows, None] & self.tone_channel)
        lines = lines + section.comb_factor * (self.comb[rows, None] & comb)
        t += level * lines
        here = np.flatnonzero(self.burst[rows])
        if here.size:
            wave = np.exp(1j * self.phase[rows][here]).T
            power = level[here] * section.burst_factor / np.sqrt(BURST_CHANNELS)
            t[:, :, here] += wave[:, None, :, None] * wave.conj()[None, :, :, None] * power

    def truth(self) -> dict[str, np.ndarray]:
        """Return the table of what is where."""
        names = ("level", "absent", "saturated", "tone", "tone_channel", "comb", "burst")
        return {name: getattr(self, name) for name in names}


def _tone_channels(
    section: FlightSimulatedSection, origin: BinOrigin
) -> Bool[np.ndarray, " channels"]:
    """The channels nearest to the tones. InputError if the averaging leaves one of them out."""
    mhz, tones, kept = channel_mhz(origin), *(np.zeros(N_CHANNELS, dtype=bool) for _ in range(2))
    kept[AVERAGING[section.navgf].channels()] = True
    for tone_mhz in section.tones_mhz:
        far = np.abs(mhz - tone_mhz)
        channel = int(far.argmin())
        if not kept[channel]:
            there = mhz[np.where(kept, far, np.inf).argmin()]
            raise InputError(
                f"the tone at {tone_mhz:g} MHz is in channel {channel}, which Navgf "
                f"{section.navgf} leaves out, so that no spectrum would have it; use {there:.6g} "
                "MHz in flight.simulated.tones_mhz, or another flight.simulated.navgf"
            )
        tones[channel] = True
    return tones


def _stretches(
    generator: np.random.Generator, n: int, share: float, length: int
) -> Bool[np.ndarray, " rows"]:
    """About this share of the spectra, in stretches."""
    found = np.zeros(n, dtype=bool)
    if share == 0.0:
        return found
    for start in np.flatnonzero(generator.uniform(size=n) < share / length):
        found[start : start + length] = True
    return found
