"""From a scenario to the objects of d = A m + n."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import numpy as np
from jaxtyping import Array, Float

from lusee_bayes.beams import Monopoles, ProductBeams, Regolith, monopole_beams
from lusee_bayes.checks import InputError
from lusee_bayes.coupling import CouplingMatrix
from lusee_bayes.covariance import Covariance
from lusee_bayes.layout import DataLayout
from lusee_bayes.linear_gaussian import LinearGaussian
from lusee_bayes.noise import radiometer_noise
from lusee_bayes.observation import Observation, Run
from lusee_bayes.pointing import Pointing
from lusee_bayes.prior import HarmonicPrior
from lusee_bayes.progress import Stages
from lusee_bayes.scenario import Scenario
from lusee_bayes.sky import BRIGHT_SOURCES, Sky, galaxy_sky, sky_from_file
from lusee_bayes.visibilities import Visibilities


@dataclass(frozen=True)
class Experiment:
    """The pieces a scenario stands for, ready to simulate data or to make a map of them."""

    scenario: Scenario
    observation: Observation
    sky: Sky
    coupling: CouplingMatrix
    prior: HarmonicPrior
    signal: Float[Array, "products times"]

    @classmethod
    def from_scenario(
        cls, scenario: Scenario, data: Visibilities | None = None, stages: Stages | None = None
    ) -> Experiment:
        """Build everything; with ``data``, for the times and samples that the data have.

        InputError if the data are of another frequency.
        """
        stages = stages or Stages()
        if data is not None and not np.isclose(data.frequency_mhz, scenario.frequency_mhz, 1e-9):
            raise InputError(
                f"the data are at {data.frequency_mhz} MHz, the scenario at "
                f"{scenario.frequency_mhz}; use --set frequency_mhz={data.frequency_mhz}"
            )
        with stages("sky"):
            sky = build_sky(scenario)
            spectrum = sky.spectrum() * scenario.prior.scale
        with stages("orientation"):
            observation = build_observation(scenario) if data is None else data.observation
            pointing = Pointing.of(observation, scenario.lmax)
        with stages("beams"):
            beams = jax.block_until_ready(build_beams(scenario))
        with stages("coupling"):
            layout = DataLayout(beams.n_products, pointing.n_times)
            complete = CouplingMatrix.build(beams, pointing, layout)
            signal = layout.scatter(complete @ sky.modes)
            coupling = complete
            if data is not None:
                coupling = CouplingMatrix.build(beams, pointing, data.layout)
        return cls(scenario, observation, sky, coupling, HarmonicPrior(spectrum), signal)

    def noise(self, data: Visibilities | None = None) -> Covariance:
        """N; its level comes from the modelled sky, or from ``data`` if the scenario says so."""
        radiometer = self.scenario.noise.radiometer
        visibilities = self.signal
        if radiometer.temperature == "measured" and data is not None:
            visibilities = measured_visibilities(data, self.signal)
        return radiometer_noise(
            visibilities,
            self.coupling.layout,
            bandwidth_hz=radiometer.bandwidth_hz,
            step_s=self.observation.step_s,
            form=radiometer.form,
            duty_cycle=radiometer.duty_cycle,
            factor=radiometer.factor,
        )

    def model(self, data: Visibilities | None = None) -> LinearGaussian:
        """d = A m + n of this experiment."""
        return LinearGaussian(self.coupling, self.prior, self.noise(data))

    def simulate(self) -> Visibilities:
        """Visibilities of the scenario's sky with noise drawn from its seed."""
        noise = self.noise().sample(jax.random.key(self.scenario.seed))
        layout = self.coupling.layout
        return Visibilities(
            layout.gather(self.signal) + noise,
            layout,
            self.observation,
            self.scenario.frequency_mhz,
            self.sky.modes,
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
            f"time {first} lacks some of its products, so the antenna temperatures cannot be "
            "measured there; use noise.radiometer.temperature=model"
        )
    return jax.numpy.where(complete[None], data.layout.scatter(data.data), model)


def build_observation(scenario: Scenario) -> Observation:
    """Site, times and turntable angles."""
    section = scenario.observation
    return Observation.from_runs(
        tuple(Run(r.cycles, r.turntable_deg, r.night_only) for r in section.runs),
        start=section.start,
        step_s=section.step_s,
        lon_deg=section.lon_deg,
        lat_deg=section.lat_deg,
    )


def build_monopoles(scenario: Scenario) -> Monopoles:
    """The embedded antennas with the scenario's parameters."""
    beam = scenario.beam
    return Monopoles(
        regolith=Regolith(beam.surface_permittivity, beam.deep_permittivity, beam.loss_tangent),
        length_m=beam.length_m,
        zenith_angle_deg=beam.zenith_angle_deg,
        height_m=beam.height_m,
    )


def build_beams(scenario: Scenario) -> ProductBeams:
    """Beams of all products at the scenario's frequency."""
    return monopole_beams(scenario.frequency_mhz, scenario.lmax, build_monopoles(scenario))


def build_sky(scenario: Scenario) -> Sky:
    """The scenario's sky up to lmax."""
    section = scenario.sky
    if section.file is None:
        sources = BRIGHT_SOURCES if section.sources else ()
        return galaxy_sky(scenario.frequency_mhz, scenario.lmax, seed=section.seed, sources=sources)
    return sky_from_file(
        section.file,
        scenario.frequency_mhz,
        scenario.lmax,
        dataset=section.dataset,
        file_frequency_mhz=section.file_frequency_mhz,
        spectral_index=section.spectral_index,
    )
