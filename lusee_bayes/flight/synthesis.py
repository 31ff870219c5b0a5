"""From V^2/Hz at a few frequencies to the spectrometer's counts, with disturbances.

Spectra of all channels are interpolated between known frequencies. Logarithms of autos are cubic
splines of the logarithm of the frequency. So are the entries of the Cholesky factors of the
correlation matrices (the diagonal by its logarithm), so that interpolated matrices are correlation
matrices, too. Beyond the known frequencies autos continue as power laws, and correlations become
constant; a single known frequency gives power laws of index -2.5.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Complex, Float, Float32, Int, Shaped
from scipy.interpolate import CubicSpline

from lusee_bayes.core.arrays import RowFlags, Vector
from lusee_bayes.core.checks import require_positive
from lusee_bayes.core.errors import InputError, refusing
from lusee_bayes.flight import flags, recipe, session
from lusee_bayes.flight.gain_model import LETTERS, NANO2, GainModel
from lusee_bayes.instrument.products import to_matrix, to_real

# spectra; counts before rounding; covariances of the antennas' voltages
AllChannels = Float[np.ndarray, "products rows channels"]
Counts = Float[np.ndarray, "rows products bins"]
Covariances = Complex[np.ndarray, "antennas antennas rows channels"]
Rounded = Float32[np.ndarray, "rows products bins"]
INDEX = -2.5
# below this share of the lowest known frequency spectra stay constant: a further rise there would
# coarsen the rounding elsewhere
HELD_BELOW = 0.5
# beyond the known frequencies splines go on for this much of the logarithm, longer than a band, and
# then become constant; the larger the power, the less they bend before
BEYOND, POWER = 0.2, 8


@dataclass(frozen=True, eq=False)
class ChannelSpectra:
    """Interpolation of visibilities in frequency.

    Attributes
    ----------
    autos : (channels, nodes) array
        Matrix for logarithms of autos.
    offset : (channels,) array
        Added to the result.
    correlations : (channels, nodes) array
        Matrix for factors of correlations.
    """

    autos: Float[np.ndarray, "channels nodes"]
    offset: Float[np.ndarray, " channels"]
    correlations: Float[np.ndarray, "channels nodes"]

    @classmethod
    def of(cls, nodes_mhz: Vector, channels_mhz: session.Middles) -> ChannelSpectra:
        """Prepare the interpolation.

        Parameters
        ----------
        nodes_mhz : (nodes,) array
            Known frequencies, increasing.
        channels_mhz : (channels,) array
        """
        nodes = np.log(nodes_mhz)
        at = np.log(np.maximum(channels_mhz, HELD_BELOW * nodes_mhz[0]))
        if len(nodes) == 1:
            ones = np.ones((len(at), 1))
            return cls(ones, INDEX * (at - nodes[0]), ones)
        spline = CubicSpline(nodes, np.eye(len(nodes)))
        inside = np.clip(at, nodes[0], nodes[-1])
        beyond = (at - inside) / BEYOND
        held = inside + BEYOND * beyond / (1.0 + beyond**POWER) ** (1.0 / POWER)
        values = spline(held)
        return cls(values + (at - held)[:, None] * spline(inside, 1), np.zeros(len(at)), values)

    def __call__(self, visibilities: Float[np.ndarray, "nodes products rows"]) -> AllChannels:
        """Return visibilities in all channels.

        Parameters
        ----------
        visibilities : (nodes, products, rows) array
            In the package's order.

        Raises
        ------
        InputError
            If an auto is not positive, or a matrix of visibilities not positive definite.
        """
        autos = visibilities[:, session.AUTOS]
        require_positive("the autos of the visibilities", autos)
        scale = np.sqrt(autos[:, session.FIRST_PORT] * autos[:, session.SECOND_PORT])
        matrices = np.moveaxis(to_matrix(np.moveaxis(visibilities / scale, 1, 0)), (0, 1), (-2, -1))
        advice = "voltages cannot have these correlations; check beams and sky"
        wrong = f"the visibilities of a time are not positive definite: {advice}"
        with refusing(wrong, np.linalg.LinAlgError):
            factors = np.linalg.cholesky(matrices)
        low = _at_channels(self.correlations, factors)
        ports = np.arange(len(session.AUTOS))
        diagonal = np.log(factors[..., ports, ports].real)
        low[ports, ports] = np.exp(_at_channels(self.correlations, diagonal))
        # rows of length one give correlation coefficients
        logs = _at_channels(self.autos, np.log(np.moveaxis(autos, 1, -1)))
        length = np.sqrt((np.abs(low) ** 2).sum(axis=1))
        low *= (np.exp((logs + self.offset) / 2.0) / length)[:, None]
        return to_real(np.einsum("ikrc,jkrc->ijrc", low, low.conj()))


def _at_channels(weights: Float[np.ndarray, "channels nodes"], values: np.ndarray) -> np.ndarray:
    """Values (nodes, rows, ...) in all channels: (..., rows, channels)."""
    return np.moveaxis(np.tensordot(values, weights, axes=(0, 1)), 0, -2)


# bits, of the 31 of a number, for the largest value of a spectrum; rounding errors are then far
# below the noise, also where a spectrum has fallen to a thousandth
BITS = 27
REFERENCE = 31


def in_counts(
    spectra: AllChannels,
    telemetry: session.Telemetry,
    table: GainModel,
    levels: str,
    navgf: int,
    origin: session.BinOrigin,
    sign: int,
) -> Counts:
    """Return the counts of spectra before rounding, for one state of the spectrometer.

    Parameters
    ----------
    spectra : (products, rows, channels) array
        In V^2/Hz, in the package's order.
    telemetry : mapping of str to (rows,) array
    table : GainModel
        Channels beyond its frequencies have the gain at its ends.
    levels : str
        Gain levels of the ports, such as MMMM.
    navgf : int
        Averaging over channels.
    origin : {"centre", "edge"}
        Part of channel k that lies at k times 25 kHz.
    sign : {1, -1}
        Sign of the spectrometer's imaginary parts, relative to those of <s_i conj(s_j)>.

    Returns
    -------
    (rows, products, bins) array
        In the spectrometer's order.
    """
    root, mhz = [], session.channel_mhz(origin)
    for port, level in enumerate(levels):
        anchors = table.anchor_mhz[LETTERS.index(level), port]
        basis = table.basis(level, port, np.clip(mhz, anchors[0], anchors[-1]))
        gain = basis[0] + table.strengths(level, port, telemetry) @ basis[1:]
        # nothing is sent where a table has no gain
        root.append(np.sqrt(np.maximum(gain, 0.0)))
    averaging = session.AVERAGING[navgf]
    members = averaging.channels()
    summed = np.empty((spectra.shape[1], len(spectra), averaging.n_bins))
    for k, product in enumerate(spectra):
        counts = product * (root[session.FIRST_PORT[k]] * root[session.SECOND_PORT[k]]) / NANO2
        counts = counts[:, members].sum(axis=2) / averaging.stride
        summed[:, session.OF_FLIGHT[k]] = counts * (sign if session.IMAGINARY[k] else 1)
    return summed


def bit_slices(counts: Counts) -> Int[np.ndarray, " products"]:
    """Return the bit slices for spectra like the first.

    Parameters
    ----------
    counts : (rows, products, bins) array
        In the spectrometer's order. The slice of a cross follows from its autos, which bound it.
    """
    top = np.empty(counts.shape[1])
    largest = np.abs(counts[0, session.OF_FLIGHT[session.AUTOS]]).max(axis=1)
    top[session.OF_FLIGHT] = np.sqrt(largest[session.FIRST_PORT] * largest[session.SECOND_PORT])
    return np.clip(np.ceil(np.log2(top)) + REFERENCE - BITS, 0, REFERENCE).astype(np.int64)


def rounded(counts: Counts, bitslice: Int[np.ndarray, "rows products"]) -> Rounded:
    """Return counts rounded to multiples of 2^(slice - 31).

    Parameters
    ----------
    counts : (rows, products, bins) array
    bitslice : (rows, products) array of int
    """
    step = 2.0 ** (bitslice - REFERENCE)[..., None]
    return (np.rint(counts / step) * step).astype(np.float32)


# length of disturbances in spectra, except those of single spectra
STRETCH = 5
# factor of the counts of a saturated spectrum
SATURATED_FACTOR = 40.0
# bursts are measured against the noise in this many channels
BURST_CHANNELS = 1.0 / session.CHANNEL_MHZ


@dataclass(frozen=True, eq=False)
class Disturbances:
    """Disturbances of each spectrum.

    Attributes
    ----------
    section : FlightSimulatedSection
        Their strengths.
    level : (rows, ports) array of str
        Levels of the gains.
    absent : (rows, 16) array of bool
        Products that are NaN, in the spectrometer's order.
    saturated, tone, comb : (rows,) array of bool
    tone_channel : (channels,) array of bool
        Channels with a tone in these spectra.
    burst : (rows,) array of bool
    phase : (rows, ports) array
        Phases of bursts at the ports, in radians.
    """

    section: recipe.FlightSimulatedSection
    level: Shaped[np.ndarray, "rows ports"]
    absent: Bool[np.ndarray, "rows products"]
    saturated: RowFlags
    tone: RowFlags
    tone_channel: Bool[np.ndarray, " channels"]
    comb: RowFlags
    burst: RowFlags
    phase: Float[np.ndarray, "rows ports"]

    @classmethod
    def drawn(
        cls,
        section: recipe.FlightSimulatedSection,
        hours: Float[np.ndarray, " rows"],
        step_s: float,
        origin: session.BinOrigin,
        seed: int,
    ) -> Disturbances:
        """Draw disturbances.

        Parameters
        ----------
        section : FlightSimulatedSection
            Rates and strengths of the disturbances.
        hours : (rows,) array
            Times of the spectra since the first.
        step_s : float
            Time from spectrum to spectrum.
        origin : {"centre", "edge"}
            Part of channel k that lies at k times 25 kHz.
        seed : int

        Raises
        ------
        InputError
            If a tone is in a channel that is in no bin.
        """
        n, generator = len(hours), np.random.default_rng([seed, 1])
        level = np.array([list(section.levels)] * n, dtype="U1")
        if section.switch_h is not None:
            level[hours >= section.switch_h] = list(section.switch_levels)
        absent = np.zeros((n, len(session.FLIGHT_PRODUCTS)), dtype=bool)
        for row in np.flatnonzero(_drawn_stretches(generator, n, section.absent_share, 1)):
            absent[row, generator.integers(len(session.FLIGHT_PRODUCTS))] = True
        saturated = _drawn_stretches(generator, n, section.saturated_share, 1)
        tones = _tone_channels(section.tones_mhz, section.navgf, origin)
        tone_share = section.tone_share if section.tones_mhz else 0.0
        tone = _drawn_stretches(generator, n, tone_share, STRETCH)
        comb = _drawn_stretches(generator, n, section.comb_share, STRETCH)
        burst, phase = np.zeros(n, dtype=bool), np.zeros((n, session.PORTS))
        at = 0.0
        while section.burst_every_h is not None:
            at += generator.exponential(section.burst_every_h)
            if at > hours[-1]:
                break
            length_s = step_s * max(section.burst_s / step_s, 1.0) ** generator.uniform()
            # at least one spectrum, up to the end of the burst
            first = int(np.searchsorted(hours, at))
            stretch = slice(first, max(first + 1, np.searchsorted(hours, at + length_s / 3600.0)))
            burst[stretch] = True
            phase[stretch] = generator.uniform(0.0, 2.0 * np.pi, session.PORTS)
        return cls(section, level, absent, saturated, tone, tones, comb, burst, phase)

    def add(self, t: Covariances, rows: slice, frames: float) -> None:
        """Add tones, comb and bursts to the covariance of the voltages of some spectra, in place.

        Parameters
        ----------
        t : (antennas, antennas, rows, channels) array
        rows : slice
            The spectra.
        frames : float
            Frames in each spectrum.
        """
        level = np.einsum("iirc->rc", t).real / (session.PORTS * np.sqrt(frames))
        comb = np.arange(session.N_CHANNELS) % flags.COMB_SPACING == flags.COMB_FIRST
        lines = self.section.tone_factor * (self.tone[rows, None] & self.tone_channel)
        t += level * (lines + self.section.comb_factor * (self.comb[rows, None] & comb))
        if (bursts := np.flatnonzero(self.burst[rows])).size:
            wave = np.exp(1j * self.phase[rows][bursts]).T
            power = level[bursts] * self.section.burst_factor / np.sqrt(BURST_CHANNELS)
            t[:, :, bursts] += wave[:, None, :, None] * wave.conj()[None, :, :, None] * power

    def truth(self) -> dict[str, np.ndarray]:
        """Return the table of disturbances."""
        names = ("level", "absent", "saturated", "tone", "tone_channel", "comb", "burst")
        return {name: getattr(self, name) for name in names}


def _tone_channels(
    tones_mhz: tuple[float, ...], navgf: int, origin: session.BinOrigin
) -> Bool[np.ndarray, " channels"]:
    """The channels nearest to the tones; InputError if the averaging leaves one of them out."""
    mhz = session.channel_mhz(origin)
    tones, kept = np.zeros((2, session.N_CHANNELS), dtype=bool)
    kept[session.AVERAGING[navgf].channels()] = True
    for tone_mhz in tones_mhz:
        far = np.abs(mhz - tone_mhz)
        channel = int(far.argmin())
        if not kept[channel]:
            nearest = mhz[np.where(kept, far, np.inf).argmin()]
            raise InputError(
                f"the tone at {tone_mhz:g} MHz is in channel {channel}, which Navgf {navgf} drops, "
                f"so that it would be in no spectrum; use {nearest:.6g} MHz in "
                "flight.simulated.tones_mhz, or another flight.simulated.navgf"
            )
        tones[channel] = True
    return tones


def _drawn_stretches(generator: np.random.Generator, n: int, share: float, length: int) -> RowFlags:
    """Stretches of spectra, about this share of all."""
    if share == 0.0:
        return np.zeros(n, dtype=bool)
    return np.convolve(generator.uniform(size=n) < share / length, np.ones(length))[:n] > 0.0
