"""A scenario's instrument pointed at its sky: all that is fixed before there are data.

That is A, S, the sky, and what antennas and receivers add to every visibility, whatever the sky.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lusee_bayes.core.errors import InputError
from lusee_bayes.core.progress import Stages
from lusee_bayes.experiment.scenario import Scenario
from lusee_bayes.instrument.beams.fields import SAME_FREQUENCY_MHZ
from lusee_bayes.instrument.beams.monopoles import Monopoles
from lusee_bayes.instrument.coupling import CouplingMatrix, Instrument
from lusee_bayes.instrument.pointing import Pointing
from lusee_bayes.instrument.products import auto_indices
from lusee_bayes.instrument.visibilities import Visibilities
from lusee_bayes.systematics.context import Setup, prior_and_family
from lusee_bayes.systematics.regolith import ground_per_kelvin
from lusee_bayes.systematics.sources import expected_signal, source_responses

# two sites closer than that are one: 30 m
SAME_SITE_DEG = 1e-3


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
        their times are, or the scenario's receivers or ground need to know of the beams what these
        do not say.
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
        background = np.array(source.background(scenario.frequency_mhz))
        if scenario.noise.regolith is not None:
            ground_per_kelvin(source, scenario.frequency_mhz)  # refuses what has no ground
        if (noise := scenario.noise.receiver) is not None:
            autos = auto_indices(source.n_ports)
            background[autos] += noise.powers(source, scenario.frequency_mhz)
        sources = scenario.sources.list
        responses = source_responses(sources, observation, source, scenario.frequency_mhz)
    if data is not None and data.layout.n_products != beams.n_products:
        raise InputError(
            f"the data have {data.layout.n_products} products, the beams supply "
            f"{beams.n_products}; give beam.rotations_deg an angle for every port"
        )
    with stages("coupling"):
        complete = CouplingMatrix.build(beams, pointing)
        layout = complete.layout if data is None else data.layout
        signal = expected_signal(sources, complete, sky, background, responses)
        # those of a file have no parameters
        antennas = Monopoles() if scenario.beam.is_file else source.monopoles
        instrument = Instrument(antennas, pointing, layout, scenario.frequency_mhz, scenario.lmax)
        coupling = replace(complete, layout=layout)
    pieces = observation, sky, source, instrument, beams, coupling, prior, responses, background
    of_data = None if data is None else data.calibration, data is not None
    return Setup(scenario, *pieces, signal, receiver, *of_data, family)


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
