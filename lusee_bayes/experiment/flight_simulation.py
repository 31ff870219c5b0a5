"""Simulated spectrometer sessions: counts, gains, telemetry and clock for a scenario's sky.

This inverts :mod:`lusee_bayes.flight`: visibilities become spectra of all channels, with radiometer
noise and disturbances, and spectra become counts.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
from jaxtyping import Float, Float32, Int

from lusee_bayes.core import engine, progress
from lusee_bayes.core.errors import InputError
from lusee_bayes.experiment.data_files import gain_table_of, per_kelvin_of
from lusee_bayes.experiment.model import set_up, true_signal, true_values
from lusee_bayes.experiment.scenario import Scenario
from lusee_bayes.flight import session_files, synthesis
from lusee_bayes.flight.clock import DAY_S, MJD_ZERO, Clock
from lusee_bayes.flight.gain_model import Errors, GainModel, draw_gains
from lusee_bayes.flight.recipe import FlightSection, FlightSimulatedSection
from lusee_bayes.flight.session import ADC_HIGH, ADC_LOW, FRAME_S, PORTS, BinOrigin, channel_mhz
from lusee_bayes.instrument.observation import Observation
from lusee_bayes.instrument.products import DataLayout, ports, to_matrix, to_real
from lusee_bayes.instrument.times import Windows
from lusee_bayes.instrument.visibilities import Visibilities
from lusee_bayes.noise.radiometer import sample_covariances

# number of spectra whose A is in memory at once
PIECE = 2048
# number of spectra that a thread processes at once
BLOCK = 16
# days before the observation when the clock was set, and its reading then
CLOCK_DAYS, CLOCK_S = 100, 1000.0
# rms of the ADC at each gain, its extremes in units of the rms, and its numbers when saturated
ADC_RMS, ADC_PEAK = {"L": 55.0, "M": 310.0, "H": 1700.0}, 4.6
SATURATED_RMS, OUT_OF_RANGE = 6200.0, 1000
SOFTWARE = 0x307
# telemetry: mean, amplitude and period in hours
TELEMETRY = {
    "THERM_FPGA": (30.0, 2.0, 700.0),
    "SPE_ADC0_T": (29.5, 1.5, 650.0),
    "SPE_ADC1_T": (28.5, 1.5, 600.0),
    "SPE_1VAD8_V": (1.8, 2e-3, 90.0),
    "VMON_1V2D": (1.2, 2e-3, 130.0),
    "SPE_1VAD8_C": (0.045, 1e-3, 110.0),
}


@dataclass(frozen=True, eq=False)
class FlightSimulation:
    """Simulated sessions, computed on demand.

    Attributes
    ----------
    scenario : Scenario
    section : FlightSimulatedSection
    observation : Observation
        With one sample per spectrum.
    frequencies_mhz : (nodes,) array
        Frequencies of the visibilities; other channels are interpolated smoothly.
    visibilities : (nodes, products, rows) array
        Without noise, in V^2/Hz.
    disturbances : synthesis.Disturbances
    table : GainModel
        Gains to divide the counts by.
    gains : GainModel
        True gains, which multiply the spectra: the table's, or drawn around them.
    gain_errors : dict
        Drawn gain errors in standard deviations, by names such as M0 and M0 PC1.
    origin : {"centre", "edge"}
        Part of channel k that lies at k times 25 kHz.
    navg_shift : int
        Base-2 logarithm of the number of frames averaged in a spectrum.
    clock : Clock
    """

    scenario: Scenario
    section: FlightSimulatedSection
    observation: Observation
    frequencies_mhz: Float[np.ndarray, " nodes"]
    visibilities: Float[np.ndarray, "nodes products rows"]
    disturbances: synthesis.Disturbances
    table: GainModel
    gains: GainModel
    gain_errors: Errors
    origin: BinOrigin
    navg_shift: int
    clock: Clock

    @property
    def frames(self) -> float:
        """Number of frames averaged in each spectrum."""
        return 2.0**self.navg_shift

    @cached_property
    def _in_channels(self) -> synthesis.ChannelSpectra:
        """Gives spectra of all channels without noise or disturbances, in V^2/Hz."""
        return synthesis.ChannelSpectra.of(self.frequencies_mhz, channel_mhz(self.origin))

    @cached_property
    def sessions(self) -> tuple[slice, ...]:
        """The spectra of each session."""
        hours = self.observation.hours
        number = np.floor((hours - hours[0]) / self.section.session_h + 1e-9)
        edges = np.flatnonzero(np.diff(number, prepend=-1.0, append=np.inf)).tolist()
        return tuple(slice(start, end) for start, end in pairwise(edges))

    def rows(self, session: slice) -> session_files.SessionRows:
        """Return the metadata of a session's spectra.

        Parameters
        ----------
        session : slice
            One of :attr:`sessions`.
        """
        level = self.disturbances.level[session]
        saturated, n = self.disturbances.saturated[session, None], len(level)
        rms = np.vectorize(ADC_RMS.__getitem__, otypes=[np.float64])(level)
        peak = np.rint(ADC_PEAK * rms).astype(np.int64)
        times = self.observation.times[session]
        days = (times.jd1 - self.clock.jd1) + (times.jd2 - self.clock.jd2)
        return session_files.SessionRows(
            raw_s=self.clock.raw_s + days * DAY_S,
            navgf=np.full(n, self.section.navgf, dtype=np.int64),
            navg_shift=np.full(n, self.navg_shift, dtype=np.int64),
            level=level,
            bitslice=np.array([self._slices["".join(one)] for one in level]),
            adc_low=np.where(saturated, ADC_LOW, -peak),
            adc_high=np.where(saturated, ADC_HIGH, peak),
            adc_invalid=np.where(saturated, OUT_OF_RANGE, np.zeros((n, PORTS), dtype=np.int64)),
            adc_rms=np.where(saturated, SATURATED_RMS, rms),
            telemetry=self._telemetry(session),
            clock=self.clock if self.section.clock == "known" else None,
            lon_deg=self.observation.lon_deg,
            lat_deg=self.observation.lat_deg,
            software=SOFTWARE,
        )

    def blocks(self, session: slice) -> Iterator[Float32[np.ndarray, "_ products bins"]]:
        """Yield the counts of a session, a few spectra at a time.

        Parameters
        ----------
        session : slice
            One of :attr:`sessions`.

        Raises
        ------
        InputError
            If no voltages can have these visibilities.
        """
        level = self.disturbances.level
        changes = np.flatnonzero((level[1:] != level[:-1]).any(axis=1)) + 1
        changes = changes[(changes > session.start) & (changes < session.stop)]
        ends = {*range(session.start, session.stop, BLOCK), session.stop, *changes.tolist()}
        blocks = [slice(a, b) for a, b in pairwise(sorted(ends))]
        together = 2 * engine.processors()
        for k in range(0, len(blocks), together):
            yield from engine.in_threads(self._block, blocks[k : k + together])

    def _block(self, rows: slice) -> Float32[np.ndarray, "_ products bins"]:
        t = to_matrix(self._in_channels(self.visibilities[..., rows]))
        self.disturbances.add(t, rows, self.frames)
        if self.section.radiometer:
            generator = np.random.default_rng([self.scenario.seed, 2, rows.start])
            factor = self.scenario.noise.radiometer.factor
            t = sample_covariances(t, self.frames / factor, generator)
        levels = "".join(self.disturbances.level[rows.start])
        counts = self._counts(levels, to_real(t), rows)
        counts[self.disturbances.saturated[rows]] *= synthesis.SATURATED_FACTOR
        rounded = synthesis.rounded(counts, np.broadcast_to(self._slices[levels], counts.shape[:2]))
        rounded[self.disturbances.absent[rows]] = np.nan
        return rounded

    @cached_property
    def _slices(self) -> dict[str, Int[np.ndarray, " products"]]:
        """Bit slices for each state of the gains."""
        first = slice(0, 1)
        spectra = self._in_channels(self.visibilities[..., first])
        states = {"".join(one) for one in np.unique(self.disturbances.level, axis=0)}
        counts = {levels: self._counts(levels, spectra, first) for levels in states}
        return {levels: synthesis.bit_slices(one) for levels, one in counts.items()}

    def _counts(self, levels: str, spectra: synthesis.AllChannels, rows: slice) -> synthesis.Counts:
        settings = self.section.navgf, self.origin, flight_of(self.scenario).sign
        return synthesis.in_counts(spectra, self._telemetry(rows), self.gains, levels, *settings)

    def _telemetry(self, rows: slice) -> Mapping[str, Float[np.ndarray, " _"]]:
        turns = 2.0 * np.pi * self.observation.hours[rows]
        return {name: m + a * np.sin(turns / period) for name, (m, a, period) in TELEMETRY.items()}


def flight_of(scenario: Scenario) -> FlightSection:
    """Return a scenario's section on flight data, or its defaults."""
    return scenario.flight or FlightSection()


def simulate_flight(scenario: Scenario, stages: progress.Stages | None = None) -> FlightSimulation:
    """Simulate sessions of a scenario.

    Parameters
    ----------
    scenario : Scenario
        With one frequency, or several.
    stages : Stages, optional
        Shows the progress.

    Raises
    ------
    InputError
        If the beams are not calibrated in volts, the scenario's samples or noise cannot be those of
        spectra, the gain table cannot be read, or a tone is in no bin.
    """
    stages, flight = stages or progress.Stages(), flight_of(scenario)
    section = flight.simulated or FlightSimulatedSection()
    radiometer, step_s = scenario.noise.radiometer, scenario.observation.step_s
    if radiometer.duty_cycle != 1.0 or radiometer.log_factor_std is not None:
        why = "noise follows from frames; remove duty_cycle and log_factor_std of noise.radiometer"
        raise InputError(why)
    if flight.filter_taps:
        wrong = "channels of simulated spectra have independent noise; set flight.filter_taps to 0"
        raise InputError(wrong)
    if step_s < FRAME_S:
        raise InputError(
            f"a frame of the spectrometer lasts {FRAME_S:g} s, but a sample {step_s:g} s; use a "
            "longer observation.step_s (42 s in flight)"
        )
    shift = int(np.floor(np.log2(step_s / FRAME_S * (1.0 + 1e-12))))
    gains = _drawn_gains(scenario, flight)
    observation = spectra_observation(scenario, FRAME_S * 2.0**shift)
    origin = flight.bin_origin or "centre"
    hours = observation.hours - observation.hours[0]
    made = synthesis.Disturbances.drawn(section, hours, step_s, origin, scenario.seed)
    nodes = np.array(scenario.frequencies_mhz or (scenario.frequency_mhz,))
    seen = observation, nodes, true_visibilities(scenario, observation, stages)
    mjd = float(np.floor(observation.times[0].mjd)) - CLOCK_DAYS
    clock = Clock("the simulation", MJD_ZERO, mjd, "utc", CLOCK_S)
    return FlightSimulation(scenario, section, *seen, made, *gains, origin, shift, clock)


def spectra_observation(scenario: Scenario, window_s: float) -> Observation:
    """Return the scenario's observation, with windows as long as a spectrum.

    Parameters
    ----------
    scenario : Scenario
    window_s : float
        Length of each window in seconds, centred on the sample.

    Raises
    ------
    InputError
        If the Moon's axis is fixed, or no sample is live for this time.
    """
    # spectra are means, independent of the scenario's observation.window
    planned = scenario.observation.model_copy(update={"window": "mean"}).observation()
    bounds, live = planned.windows.bounds_s, planned.windows.live_per_sample_s
    whole, half = live > (bounds[:, 1] - bounds[:, 0]) * (1.0 - 1e-9), window_s / 2.0
    long = whole & (bounds[:, 0] <= -half + 1e-6) & (bounds[:, 1] >= half - 1e-6)
    if not long.any():
        raise InputError(
            f"no sample of the observation is live for the {window_s:.6g} s of a spectrum; check "
            "observation.schedule and observation.step_s"
        )
    observation = planned.select(long)
    edges = np.full(observation.n_times, half)
    return replace(observation, windows=Windows.whole(-edges, edges))


def true_visibilities(
    scenario: Scenario, observation: Observation, stages: progress.Stages
) -> Float[np.ndarray, "frequencies products times"]:
    """Return visibilities of the scenario's sky with the true instrument, in V^2/Hz.

    Errors of the gain table are not part of the instrument here: they enter the counts.

    Parameters
    ----------
    scenario : Scenario
        With one frequency, or several.
    observation : Observation
    stages : Stages
        Shows the progress.

    Raises
    ------
    InputError
        If the beams are not calibrated in volts.
    """
    scenario = scenario.with_section("noise", gain_table=None)
    channels = scenario.channels() or (scenario,)
    first, second, _ = ports()
    scales = [np.sqrt(v[first] * v[second]) for v in map(per_kelvin_of, channels)]
    # quantities that vary in time must be drawn for all times at once
    noise, n = scenario.noise, observation.n_times
    whole = noise.gain is not None or noise.pointing is not None or bool(scenario.sources.list)
    piece = n if whole else PIECE
    volts = np.empty((len(channels), len(first), n))
    with stages.progress("visibilities", n * len(channels)) as done:
        for start in range(0, n, piece):
            rows = np.arange(n) // piece == start // piece
            part = observation.select(rows)
            for number, (channel, scale) in enumerate(zip(channels, scales, strict=True)):
                nothing = np.zeros(len(first) * part.n_times)
                layout = DataLayout(len(first), part.n_times)
                setup = set_up(channel, Visibilities(nothing, layout, part, channel.frequency_mhz))
                kelvin = np.asarray(true_signal(setup, true_values(setup)))
                volts[number, :, rows] = (scale[:, None] * kelvin).T
                done(start * len(channels) + (number + 1) * part.n_times)
    return volts


def _drawn_gains(scenario: Scenario, flight: FlightSection) -> tuple[GainModel, GainModel, Errors]:
    """The gain table, true gains drawn around it, and their errors."""
    table, section = gain_table_of(flight), scenario.noise.gain_table
    if section is None:
        return table, table, {}
    if section.std is not None:
        raise InputError(
            "noise.gain_table.std is for data without a gain table, but spectra have one; remove "
            "it and give flight.gain_std, the error of the gains of each level of each port"
        )
    if flight.gain_std is None and table.component_std is None:
        why = "noise.gain_table needs errors of the gains: flight.gain_std or flight.component_std"
        raise InputError(why)
    return table, *draw_gains(table, flight.gain_std, np.random.default_rng([scenario.seed, 3]))
