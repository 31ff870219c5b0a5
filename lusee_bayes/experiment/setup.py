"""A scenario's instrument pointed at its sky: all that is fixed before there are data.

That is A, S, the sky, and what antennas and receivers add to every visibility, whatever the sky.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int

from lusee_bayes.core.arrays import Array, DataVector, Grid
from lusee_bayes.core.errors import InputError, nearest
from lusee_bayes.core.progress import Stages
from lusee_bayes.experiment.scenario import Scenario
from lusee_bayes.experiment.sky_sections import PriorSection, SourceSection
from lusee_bayes.instrument.beams.fields import SAME_FREQUENCY_MHZ, ProductBeams
from lusee_bayes.instrument.beams.monopoles import Monopoles, Receiver
from lusee_bayes.instrument.beams.source import BeamSource
from lusee_bayes.instrument.coupling import CouplingMatrix
from lusee_bayes.instrument.instrument import Instrument
from lusee_bayes.instrument.observation import BODIES, Observation, body_direction
from lusee_bayes.instrument.pointing import Pointing
from lusee_bayes.instrument.products import DataLayout, auto_indices
from lusee_bayes.instrument.source_response import source_response
from lusee_bayes.instrument.visibilities import Calibration, Visibilities
from lusee_bayes.priors.families import PriorFamily
from lusee_bayes.sky.galaxy import BRIGHT_SOURCES, galactic_unit_vector, kelvin_steradian
from lusee_bayes.sky.prior import Prior
from lusee_bayes.sky.sky_source import Sky


def background_of(scenario: Scenario, source: BeamSource) -> Float[Array, " products"]:
    """Visibilities without any sky: ground, antennas, and receivers with their mean noise; in K.

    Parameters
    ----------
    scenario : Scenario
    source : BeamSource
        Its beams, behind the receivers of the data.

    Raises
    ------
    InputError
        If the scenario's receivers or ground need to know of the beams what these do not say.
    """
    background = np.array(source.background(scenario.frequency_mhz))
    if scenario.noise.regolith is not None:
        ground_per_kelvin(source, scenario.frequency_mhz)  # refuses what has no ground
    background[auto_indices(source.n_ports)] += receiver_powers(scenario, source)
    return background


def receiver_powers(scenario: Scenario, source: BeamSource) -> Float[np.ndarray, " ports"]:
    """Mean noise of every port's receiver in K; zeros where the scenario has none.

    Raises
    ------
    InputError
        If it is given in V^2/Hz, and the beams know no volts.
    """
    section, frequency = scenario.noise.receiver, scenario.frequency_mhz
    if section is None:
        return np.zeros(source.n_ports)
    rise = (frequency / section.reference_mhz) ** section.slope
    if section.power_k is not None:
        return np.full(source.n_ports, section.power_k * rise)
    circuit = source.circuit(frequency)
    if circuit is None:
        raise InputError(
            "noise.receiver.power_v2_hz needs antennas that know volts, which are those of a "
            "response file; give that as beam.file, or use noise.receiver.power_k"
        )
    return section.power_v2_hz * rise / circuit.per_kelvin.diagonal().real


def ground_per_kelvin(source: BeamSource, frequency_mhz: float) -> Float[Array, " products"]:
    """Visibilities that each kelvin of the ground's temperature adds, in K per K.

    Raises
    ------
    InputError
        If the beams do not say what the ground emits.
    """
    if not hasattr(source, "moon_k"):
        raise InputError(
            "noise.regolith needs antennas that receive from the ground, which are those of a "
            "response file or of a scalar beam file; give one as beam.file, or leave out "
            "noise.regolith"
        )
    warm, cold = (replace(source, moon_k=kelvin) for kelvin in (1.0, 0.0))
    return np.asarray(warm.background(frequency_mhz)) - np.asarray(cold.background(frequency_mhz))


CATALOGUE = {source.name: source for source in BRIGHT_SOURCES}
# instants in each piece of a window for the response to a source: antennas see nothing smaller
# than some degrees, and nothing at the horizon, where a source appears within a window
SOURCE_NODES = 8
# two sites closer than that are one: 30 m
SAME_SITE_DEG = 1e-3


@dataclass(frozen=True)
class Setup:
    """The pieces of d = A m + n that a scenario stands for.

    Attributes
    ----------
    scenario : Scenario
    observation : Observation
    sky : Sky
        The scenario's model sky, up to lmax.
    beam_source : BeamSource
    instrument : Instrument
        Orientations and samples, of which A is made for given beams.
    beams : ProductBeams
    coupling : CouplingMatrix
        A.
    prior : Prior
        S. Where it is to be learned, what is expected before there are data.
    responses : tuple of (products, times) arrays
        Of each point source beside the map, to 1 K sr.
    background : (products,) array
        Visibilities without any sky, of ground, antennas and the mean receiver, in K.
    signal : (products, times) array
        Visibilities of sky, background and sources through the modelled beams, in K.
    receiver : Receiver or None
        The receivers that the data say; None for others.
    family : PriorFamily or None
        Of which data choose the prior; None for a prior that is given.
    calibration : Calibration or None
        Of data that are averages of a spectrometer's spectra; None for others.
    measured : bool
        Whether the data were given, so that their sky is not the modelled one.
    """

    scenario: Scenario
    observation: Observation
    sky: Sky
    beam_source: BeamSource
    instrument: Instrument
    beams: ProductBeams
    coupling: CouplingMatrix
    prior: Prior
    responses: tuple[Grid, ...]
    background: Float[Array, " products"]
    signal: Grid
    receiver: Receiver | None = None
    family: PriorFamily | None = None
    calibration: Calibration | None = None
    measured: bool = False

    @property
    def pointing(self) -> Pointing:
        """The orientation of the lander at every sample."""
        return self.instrument.pointing

    @property
    def layout(self) -> DataLayout:
        """The product and the time of every datum."""
        return self.coupling.layout

    @property
    def offset(self) -> DataVector | None:
        """The background in every datum, in K; None where there is none."""
        if not np.any(self.background):
            return None
        grid = (self.layout.n_products, self.layout.n_times)
        return self.layout.gather(np.broadcast_to(self.background[:, None], grid))

    @cached_property
    def prepared(self) -> Instrument:
        """The instrument, prepared for A to be made of many beams."""
        return self.instrument.prepared()

    def with_prior(self, section: PriorSection) -> Setup:
        """Return the same with another prior, or family of priors.

        Parameters
        ----------
        section : PriorSection
            The scenario's section, in place of its own.
        """
        scenario = self.scenario.model_copy(update={"prior": section})
        prior, family = prior_and_family(scenario, self.sky)
        return replace(self, scenario=scenario, prior=prior, family=family)

    def under(self, sky: Sky) -> Setup:
        """Point the instrument at another sky; the prior stays that of the scenario.

        Parameters
        ----------
        sky : Sky
            Of the same frequency and lmax.
        """
        complete = CouplingMatrix.build(self.beams, self.pointing)
        change = complete.layout.scatter(complete @ (sky.modes - self.sky.modes))
        return replace(self, sky=sky, signal=self.signal + change)


def set_up(
    scenario: Scenario, data: Visibilities | None = None, stages: Stages | None = None
) -> Setup:
    """Build everything that does not depend on the values of data.

    Parameters
    ----------
    scenario : Scenario
    data : Visibilities, optional
        Take the times and the samples that these data have, not the scenario's.
    stages : Stages, optional
        Told what is being done.

    Raises
    ------
    InputError
        If the data are of another frequency, another site or other ports, or do not say what
        their times are.
    """
    stages = stages or Stages()
    if data is not None:
        require_fitting(data, scenario)
    with stages("sky"):
        sky = scenario.sky.source().at(scenario.frequency_mhz, scenario.lmax)
        prior, family = prior_and_family(scenario, sky)
    with stages("orientation"):
        if data is None:
            observation = scenario.observation.observation()
        else:
            fixed_axis = scenario.observation.fixed_axis
            observation = replace(data.observation, fixed_axis=fixed_axis)
        pointing = Pointing.of(observation, scenario.lmax)
    with stages("beams"):
        receiver = None if data is None else data.receiver
        source = scenario.beam.source().behind(receiver)
        beams = source.beams(scenario.frequency_mhz, scenario.lmax)
        background = background_of(scenario, source)
        responses = source_responses(scenario, observation, source)
    if data is not None and data.layout.n_products != beams.n_products:
        raise InputError(
            f"the data have {data.layout.n_products} products, the beams supply "
            f"{beams.n_products}; give beam.rotations_deg an angle for every port"
        )
    with stages("coupling"):
        complete = CouplingMatrix.build(beams, pointing)
        layout = complete.layout if data is None else data.layout
        signal = expected_signal(scenario, complete, sky, background, responses)
        # those of a file have no parameters
        antennas = Monopoles() if scenario.beam.is_file else source.monopoles
        instrument = Instrument(antennas, pointing, layout, scenario.frequency_mhz, scenario.lmax)
        coupling = replace(complete, layout=layout)
    return Setup(
        scenario,
        observation,
        sky,
        source,
        instrument,
        beams,
        coupling,
        prior,
        responses,
        background,
        signal,
        receiver,
        family,
        None if data is None else data.calibration,
        data is not None,
    )


def prior_and_family(scenario: Scenario, sky: Sky) -> tuple[Prior, PriorFamily | None]:
    """The scenario's prior, or what is expected of it before there are data, and its family."""
    family = scenario.prior.family(scenario.frequency_mhz, scenario.lmax)
    return (scenario.prior.prior(sky) if family is None else family.expected()), family


def require_fitting(data: Visibilities, scenario: Scenario) -> None:
    """InputError unless data are of the scenario's frequency and site, with known times."""
    if not data.says_window:
        raise InputError(
            "the data do not say what their times are; use data.stamped('start') (or 'middle', "
            "'end', 'instant'), or read_data with observation.timestamp"
        )
    if scenario.observation.fixed_axis and data.observation.windows is not None:
        raise InputError(
            "the data are means over windows, and a fixed axis of the Moon is for data of "
            "luseepy's croissant, which are instants; leave out observation.fixed_axis"
        )
    if abs(data.frequency_mhz - scenario.frequency_mhz) > SAME_FREQUENCY_MHZ:
        raise InputError(
            f"the data are at {data.frequency_mhz} MHz, the scenario at "
            f"{scenario.frequency_mhz}; use --set frequency_mhz={data.frequency_mhz}"
        )
    here, there = data.observation, scenario.observation
    east = (here.lon_deg - there.lon_deg + 180.0) % 360.0 - 180.0
    if max(abs(east), abs(here.lat_deg - there.lat_deg)) > SAME_SITE_DEG:
        # luseepy writes a site of its own where it is told none
        unsettled = (
            ", or, where nobody has established the site in the sessions, --set "
            "flight.site=scenario when they are reduced"
        )
        raise InputError(
            f"the data were taken at longitude {here.lon_deg:g}, latitude {here.lat_deg:g} "
            f"degrees, the scenario's site is {there.lon_deg:g}, {there.lat_deg:g}; use --set "
            f"observation.lon_deg={here.lon_deg:.15g} --set observation.lat_deg={here.lat_deg:.15g}"
            + ("" if data.calibration is None else unsettled)
        )


def source_responses(
    scenario: Scenario,
    observation: Observation,
    beams: BeamSource,
    frequency_mhz: float | None = None,
) -> tuple[Grid, ...]:
    """Response to 1 K sr of each of the scenario's sources, with these beams, in K.

    Sources need the exact pattern, which only the embedded antennas have.

    Their means over the windows, by instants: a source may rise and set within one.
    """
    if not scenario.sources.list:
        return ()
    frequency_mhz = scenario.frequency_mhz if frequency_mhz is None else frequency_mhz
    instants, sample, weight = observation.at_nodes(SOURCE_NODES)
    first = np.searchsorted(sample, np.arange(observation.n_times))
    responses = (
        source_response(
            instants,
            _direction(one, instants),
            frequency_mhz,
            beams.monopoles,
            stokes_v=one.stokes_v,
        )
        for one in scenario.sources.list
    )
    return tuple(np.add.reduceat(np.asarray(r) * weight, first, axis=1) for r in responses)


def _direction(source: SourceSection, observation: Observation) -> Float[np.ndarray, "..."]:
    """Galactic unit vector(s) of a source: its own, the catalogue's, or the ephemeris'."""
    if source.ra_deg is not None:
        return galactic_unit_vector(source.ra_deg, source.dec_deg)
    if source.name in BODIES:
        return body_direction(source.name, observation)
    known = CATALOGUE.get(source.name)
    if known is None:
        raise InputError(
            f"unknown source '{source.name}'; {nearest(source.name, [*CATALOGUE, *BODIES])} "
            "(or give ra_deg and dec_deg of your own)"
        )
    return galactic_unit_vector(known.ra_deg, known.dec_deg)


def expected_signal(
    scenario: Scenario,
    complete: CouplingMatrix,
    sky: Sky,
    background: Float[Array, " products"],
    responses: tuple[Grid, ...],
) -> Grid:
    """Visibilities of sky, background and sources with their mean fluxes, in K.

    Parameters
    ----------
    scenario : Scenario
    complete : CouplingMatrix
        A, for all products at all times.
    sky : Sky
    background : (products,) array
        In K.
    responses : tuple of (products, times) arrays
        As in :class:`Setup`.
    """
    signal = complete.layout.scatter(complete @ sky.modes) + background[:, None]
    for section, response in zip(scenario.sources.list, responses, strict=True):
        signal = signal + mean_flux(section, scenario.frequency_mhz) * response
    return signal


def mean_flux(source: SourceSection, frequency_mhz: float) -> float:
    """Mean of the prior of a source's flux, in K sr. InputError if nothing is known about it."""
    if source.flux_jy is not None:
        return float(kelvin_steradian(source.flux_jy, frequency_mhz))
    if source.name in CATALOGUE:
        return float(CATALOGUE[source.name].kelvin_steradian(frequency_mhz))
    raise InputError(
        f"the source '{source.name}' is not in the catalogue, so that its flux is not known; give "
        "flux_jy, the mean of its prior"
    )


def block_of_times(section: SourceSection, observation: Observation) -> Int[np.ndarray, " times"]:
    """Which of a source's amplitudes belongs to each time."""
    if section.block_h is None:
        return np.zeros(observation.n_times, dtype=int)
    _, block = np.unique(np.floor(observation.hours / section.block_h), return_inverse=True)
    return block
