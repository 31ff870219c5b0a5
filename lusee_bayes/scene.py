"""From a scenario to the objects of d = A m + n."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from lusee_bayes.beams import ProductBeams
from lusee_bayes.building import (
    build_background,
    build_beams,
    build_gain_drift,
    build_monopoles,
    build_observation,
    build_sky,
    build_source_responses,
    source_flux,
)
from lusee_bayes.checks import InputError
from lusee_bayes.coupling import CouplingMatrix
from lusee_bayes.covariance import Covariance
from lusee_bayes.layout import DataLayout
from lusee_bayes.noise import radiometer_noise
from lusee_bayes.observation import Observation
from lusee_bayes.pointing import Pointing
from lusee_bayes.prior import HarmonicPrior
from lusee_bayes.progress import Stages
from lusee_bayes.scenario import Scenario
from lusee_bayes.sections import SourceSection
from lusee_bayes.sky import Sky
from lusee_bayes.systematics import GainDrifts, Instrument, PointSources, Source
from lusee_bayes.visibilities import Visibilities

# two sites closer than that are one: 30 m
SAME_SITE_DEG = 1e-3

# a Scene, or what is built upon it
Kind = TypeVar("Kind")


@dataclass(frozen=True)
class Scene:
    """The pieces that a scenario stands for.

    responses : (products, times) of each point source to 1 K sr
    background : (products,) visibilities without any sky, in K; None where nothing emits
    signal : (products, times) visibilities of all of it through the modelled beams, in K
    """

    scenario: Scenario
    observation: Observation
    sky: Sky
    instrument: Instrument
    beams: ProductBeams
    coupling: CouplingMatrix
    prior: HarmonicPrior
    responses: tuple[Float[Array, "products times"], ...]
    background: Float[Array, " products"] | None
    signal: Float[Array, "products times"]

    @classmethod
    def from_scenario(
        cls: type[Kind],
        scenario: Scenario,
        data: Visibilities | None = None,
        stages: Stages | None = None,
    ) -> Kind:
        """Build everything; with ``data``, for the times and samples that the data have.

        InputError if the data are of another frequency, another site or other ports.
        """
        stages = stages or Stages()
        if data is not None:
            require_fitting(data, scenario)
        with stages("sky"):
            sky = build_sky(scenario)
            spectrum = sky.spectrum() * scenario.prior.scale
        with stages("orientation"):
            if data is None:
                observation = build_observation(scenario)
            else:
                axis = scenario.observation.fixed_axis
                observation = replace(data.observation, fixed_axis=axis)
            pointing = Pointing.of(observation, scenario.lmax)
        with stages("beams"):
            antennas = build_monopoles(scenario)
            beams = jax.block_until_ready(build_beams(scenario))
            background = build_background(scenario)
            responses = build_source_responses(scenario, observation, antennas)
        if data is not None and data.layout.n_products != beams.n_products:
            raise InputError(
                f"the data have {data.layout.n_products} products, the beams supply "
                f"{beams.n_products}; give beam.rotations_deg an angle for every port"
            )
        with stages("coupling"):
            layout = (
                data.layout
                if data is not None
                else DataLayout(beams.n_products, observation.n_times)
            )
            instrument = Instrument(
                antennas, pointing, layout, scenario.frequency_mhz, scenario.lmax
            )
            complete = CouplingMatrix.build(beams, pointing)
            signal = complete.layout.scatter(complete @ sky.modes)
            if background is not None:
                signal = signal + background[:, None]
            for source, response in zip(scenario.sources.list, responses, strict=True):
                signal = signal + source_flux(source, scenario.frequency_mhz) * response
            coupling = instrument.coupling_of(beams)
        return cls(
            scenario,
            observation,
            sky,
            instrument,
            beams,
            coupling,
            HarmonicPrior(spectrum),
            responses,
            background,
            signal,
        )

    @property
    def pointing(self) -> Pointing:
        """The orientation of the lander at every sample."""
        return self.instrument.pointing

    def radiometer(self, data: Visibilities | None = None) -> Covariance:
        """Radiometer term of N, from the modelled sky or, if the scenario says so, ``data``."""
        section = self.scenario.noise.radiometer
        visibilities = self.signal
        if section.temperature == "measured" and data is not None:
            visibilities = measured_visibilities(data, self.signal)
        return radiometer_noise(
            visibilities,
            self.coupling.layout,
            bandwidth_hz=section.bandwidth_hz,
            step_s=self.observation.step_s,
            form=section.form,
            duty_cycle=section.duty_cycle,
            factor=section.factor,
        )

    @property
    def offset(self) -> Float[Array, " data"] | None:
        """The background in every datum; None where there is none."""
        if self.background is None:
            return None
        layout = self.coupling.layout
        return layout.gather(
            jnp.broadcast_to(self.background[:, None], (layout.n_products, layout.n_times))
        )

    @cached_property
    def prepared(self) -> Instrument:
        """The instrument, prepared for A to be made of many beams."""
        return self.instrument.prepared()

    def gain_drifts(
        self,
        data: Visibilities | None = None,
        around: Float[Array, "products times"] | None = None,
    ) -> GainDrifts:
        """The gain drifts. InputError if the scenario has none."""
        gain, drift = self.scenario.noise.gain, build_gain_drift(self.scenario)
        if gain is None or drift is None:
            raise InputError("the scenario has no noise.gain that could be sampled")
        if around is None:
            measured = gain.visibilities != "model" and data is not None
            around = measured_visibilities(data, self.signal) if measured else self.signal
        return GainDrifts.of(
            drift,
            around,
            self.observation.hours,
            self.coupling.layout,
            gain.log_sigma_std,
            gain.log_correlation_std,
        )

    def sources(self) -> PointSources:
        """The point sources beside the map. InputError if the scenario has none."""
        if not self.responses:
            raise InputError("the scenario has no sources.list that could be fitted")
        sources = []
        for section, response in zip(self.scenario.sources.list, self.responses, strict=True):
            flux = source_flux(section, self.scenario.frequency_mhz)
            block = self.blocks(section)
            columns = [
                self.coupling.layout.gather(jnp.where(jnp.asarray(block == b)[None], response, 0.0))
                for b in range(block.max() + 1)
            ]
            sources.append(
                Source(jnp.stack(columns, axis=1), flux, section.relative_std * flux, section.name)
            )
        return PointSources(tuple(sources))

    def blocks(self, section: SourceSection) -> Int[np.ndarray, " times"]:
        """Which of a source's amplitudes belongs to each time."""
        if section.block_h is None:
            return np.zeros(self.observation.n_times, dtype=int)
        _, block = np.unique(
            np.floor(self.observation.hours / section.block_h), return_inverse=True
        )
        return block


def require_fitting(data: Visibilities, scenario: Scenario) -> None:
    """InputError unless data are of the scenario's frequency and site."""
    if not np.isclose(data.frequency_mhz, scenario.frequency_mhz, 1e-9):
        raise InputError(
            f"the data are at {data.frequency_mhz} MHz, the scenario at "
            f"{scenario.frequency_mhz}; use --set frequency_mhz={data.frequency_mhz}"
        )
    here, there = data.observation, scenario.observation
    east = (here.lon_deg - there.lon_deg + 180.0) % 360.0 - 180.0
    if max(abs(east), abs(here.lat_deg - there.lat_deg)) > SAME_SITE_DEG:
        raise InputError(
            f"the data were taken at longitude {here.lon_deg:g}, latitude {here.lat_deg:g} "
            f"degrees, the scenario's site is {there.lon_deg:g}, {there.lat_deg:g}; use --set "
            f"observation.lon_deg={here.lon_deg:g} --set observation.lat_deg={here.lat_deg:g}"
        )


def measured_visibilities(
    data: Visibilities, model: Float[Array, "products times"]
) -> Float[Array, "products times"]:
    """Visibilities that set the noise level: the measured ones where a time has all products.

    A time without any sample takes the model's (it enters nothing). InputError for a time of
    which only some products are there.
    """
    present = data.layout.present
    complete, some = present.all(0), present.any(0)
    if bool((some & ~complete).any()):
        first = int((some & ~complete).argmax())
        raise InputError(
            f"time {first} lacks some of its products, so the noise cannot be built around what "
            "was measured there; use noise.radiometer.temperature=model and "
            "noise.gain.visibilities=model"
        )
    return jax.numpy.where(complete[None], data.layout.scatter(data.data), model)
