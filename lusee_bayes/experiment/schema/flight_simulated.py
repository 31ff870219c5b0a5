"""Sessions of the spectrometer that are simulated, and what disturbs them."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field

from lusee_bayes.experiment.schema.section import LARGEST, Frequency, Positive, Section

Share = Annotated[float, Field(ge=0, le=0.5)]
Levels = Annotated[str, Field(pattern="^[LMH]{4}$")]


class FlightSimulatedSection(Section):
    """Sessions that ``simulate --flight`` writes; by default nothing disturbs them.

    Attributes
    ----------
    kind : {"hdf5", "fits"}
        Of file.
    navgf : {1, 2, 3, 4}
        Averaging over channels.
    levels : str
        Gains of the four ports, of L, M and H.
    session_h : float
        Length of a session.
    clock : {"known", "unknown"}
        Whether the files say which UTC their clock stands for; if not, a clock file does.
    radiometer : bool
        Add the radiometer noise of every channel.
    switch_h : float
        When the gains change to ``switch_levels``, from the beginning of the observation.
    switch_levels : str
        Gains from then on.
    absent_share : float
        Share of the spectra that lack one of the products.
    saturated_share : float
        Share of the spectra in which the ADCs are at their ends.
    tones_mhz : tuple of float
        Frequencies of tones, each in one channel.
    tone_share : float
        Share of the spectra that have the tones.
    tone_factor : float
        Power of a tone, in multiples of the radiometer noise of a channel.
    comb_share : float
        Share of the spectra in which the calibrator's comb is on.
    comb_factor : float
        Power of each of its lines, in multiples of the radiometer noise of a channel.
    burst_every_h : float
        Mean time from burst to burst, as those of Jupiter and the Sun.
    burst_s : float
        Length of the longest; the shortest last for a spectrum.
    burst_factor : float
        Power of a burst, in multiples of the radiometer noise of a spectrum in 1 MHz.
    """

    kind: Literal["hdf5", "fits"] = "hdf5"
    navgf: Literal[1, 2, 3, 4] = 1
    levels: Levels = "MMMM"
    session_h: Positive = 24.0
    clock: Literal["known", "unknown"] = "known"
    radiometer: bool = True
    switch_h: Positive | None = None
    switch_levels: Levels = "LLLL"
    absent_share: Share = 0.0
    saturated_share: Share = 0.0
    tones_mhz: Annotated[tuple[Frequency, ...], Field(max_length=100)] = ()
    tone_share: Share = 0.1
    tone_factor: Positive = 30.0
    comb_share: Share = 0.0
    comb_factor: Positive = 3.0
    # a month with a burst every 4 s takes 10 s to draw
    burst_every_h: Annotated[float, Field(ge=1e-3, le=LARGEST)] | None = None
    burst_s: Positive = 600.0
    burst_factor: Positive = 30.0

    def disturbances(self) -> dict[str, Any]:
        """Return gains and disturbances, as :meth:`.Disturbances.drawn` takes them."""
        return self.model_dump(exclude={"kind", "session_h", "clock", "radiometer"})
