"""How sessions of the spectrometer become visibilities."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from lusee_bayes.experiment.schema.flight_simulated import FlightSimulatedSection
from lusee_bayes.experiment.schema.section import Angle, Positive, Section

# probabilities of a false alarm
Rare = Annotated[float, Field(ge=1e-12, le=0.1)]


class FlightSection(Section):
    """How sessions of the spectrometer become visibilities, where --data are sessions.

    Attributes
    ----------
    gain_table : str
        Folder of luseepy's gain model, or a gain table in netCDF.
    gain_model : {"quadratic", "linear"}
        Which coefficients of luseepy's folder.
    component_std : tuple of float
        Standard deviations of the strengths of the two components of the gains, of each level of
        each port on its own, where the gain table does not have them.
    gain_std : float
        Standard deviation of the power gain of each level of each port, relative, besides; of each
        port, if simulated with ``noise.gain_table`` as anything but sessions.
    bin_origin : {"centre", "edge"}
        What of channel k lies at k times 25 kHz. It is not settled, and has to be said.
    clock : str
        Clock reference in JSON, for files with no absolute time, or to correct the UTC that they
        state.
    site : {"file", "scenario"}
        Whose site counts: luseepy writes one that nobody has established if it is told none.
    bandwidth_hz : float
        Width of the band about the frequency of a map.
    degree : int
        Of the polynomial that is fitted to the spectrum in the band, and taken in its middle.
    filter_taps : int
        Taps of the filter bank: how much noise neighbouring channels share; 0 for none.
    filter_window : {"rectangular", "hann", "hamming", "blackman"}
        Its window.
    convention : {"s_i conj(s_j)", "conj(s_i) s_j"}
        What the complex products are the mean of.
    per_kelvin_v2_hz : float
        V^2/Hz that 1 K makes at each port, for beams that know no volts.
    turntable_deg : float
        Angle of the turntable, from East towards North.
    lines : str
        CSV table of known lines: frequency_mhz, source.
    comb : {"found", "always", "never"}
        Whether the calibrator's comb is looked for in every spectrum, or known to be on or off.
    false_alarm : float
        Chance that a value of pure noise is flagged, of each kind of test.
    leave_out : bool
        Flag bins of time, single values, products and days that do not fit what all others predict
        for them.
    simulated : FlightSimulatedSection
        Sessions that are simulated, and what disturbs them.
    """

    gain_table: str | None = None
    gain_model: Literal["quadratic", "linear"] = "quadratic"
    component_std: Annotated[tuple[Positive, ...], Field(min_length=2, max_length=2)] | None = None
    gain_std: Positive | None = None
    bin_origin: Literal["centre", "edge"] | None = None
    clock: str | None = None
    site: Literal["file", "scenario"] = "file"
    bandwidth_hz: Positive = 1.0e6
    degree: Annotated[int, Field(ge=0, le=6)] = 2
    filter_taps: Annotated[int, Field(ge=0, le=64)] = 0
    filter_window: Literal["rectangular", "hann", "hamming", "blackman"] = "hann"
    convention: Literal["s_i conj(s_j)", "conj(s_i) s_j"] = "s_i conj(s_j)"
    per_kelvin_v2_hz: Positive | None = None
    turntable_deg: Angle = 0.0
    lines: str | None = None
    comb: Literal["found", "always", "never"] = "found"
    false_alarm: Rare = 1e-4
    leave_out: bool = True
    simulated: FlightSimulatedSection | None = None

    @model_validator(mode="after")
    def _one_kind_of_error(self) -> FlightSection:
        if self.gain_std is not None and self.gain_std >= 1.0:
            raise ValueError("gain_std is relative to the gain; give a number below 1")
        return self
