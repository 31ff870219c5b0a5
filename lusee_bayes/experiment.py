"""From a scenario to the objects of d = A m + n."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import numpy as np
from jaxtyping import Array, Float

from lusee_bayes.beams import ProductBeams, monopole_beams
from lusee_bayes.building import (
    build_beams,
    build_gain_drift,
    build_monopoles,
    build_observation,
    build_sky,
)
from lusee_bayes.checks import InputError
from lusee_bayes.coupling import CouplingMatrix
from lusee_bayes.covariance import Covariance
from lusee_bayes.linear_gaussian import LinearGaussian
from lusee_bayes.noise import (
    beam_error_noise,
    derivative,
    difference,
    moved,
    radiometer_noise,
    rms_difference,
    with_gains,
)
from lusee_bayes.observation import Observation
from lusee_bayes.pointing import Pointing
from lusee_bayes.posterior import Posterior
from lusee_bayes.prior import HarmonicPrior
from lusee_bayes.progress import Stages
from lusee_bayes.scenario import Scenario
from lusee_bayes.sky import Sky
from lusee_bayes.visibilities import Visibilities

# what the scenario's seed is folded with for each kind of draw; the radiometer takes it as it is
GAIN_DRAW, BEAM_DRAW = 2, 3

# the gain term is rebuilt until the map moves by less than this (rms, in standard deviations)
SETTLED, MAX_ROUNDS = 1e-2, 20


@dataclass(frozen=True)
class Experiment:
    """The pieces a scenario stands for, ready to simulate data or to make a map of them.

    signal : (products, times) visibilities of the sky through the modelled beams, in K
    """

    scenario: Scenario
    observation: Observation
    pointing: Pointing
    sky: Sky
    beams: ProductBeams
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
            complete = CouplingMatrix.build(beams, pointing)
            signal = complete.layout.scatter(complete @ sky.modes)
            gain = build_gain_drift(scenario)
            layout = complete.layout if data is None else data.layout
            if gain is not None and scenario.noise.gain.treatment == "marginalised":
                response = gain.mean_response(beams.n_products)[:, None]
                mean_beams = ProductBeams(beams.modes * response, beams.frequency_mhz)
                coupling = CouplingMatrix.build(mean_beams, pointing, layout)
            else:
                coupling = CouplingMatrix.build(beams, pointing, layout)
        return cls(
            scenario, observation, pointing, sky, beams, coupling, HarmonicPrior(spectrum), signal
        )

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

    def noise(
        self,
        data: Visibilities | None = None,
        around: Float[Array, "products times"] | None = None,
    ) -> Covariance:
        """N: radiometer noise and every systematic that the scenario marginalises.

        ``around``: the visibilities for the gain term; by default those the scenario names.
        """
        noise = self.radiometer(data)
        gain, beam = self.scenario.noise.gain, self.scenario.noise.beam
        if gain is not None and gain.treatment == "marginalised":
            if around is None:
                measured = gain.visibilities != "model" and data is not None
                around = measured_visibilities(data, self.signal) if measured else self.signal
            drift = build_gain_drift(self.scenario)
            noise = noise + drift.covariance(around, self.observation.hours, self.coupling.layout)
        if beam is not None and beam.treatment == "marginalised":
            for direction in self.beam_directions():
                error = CouplingMatrix.build(direction, self.pointing, self.coupling.layout)
                noise = noise + beam_error_noise(error, self.prior)
        return noise

    def beam_directions(self) -> list[ProductBeams]:
        """One-sigma errors of the beams that the scenario allows for."""
        beam = self.scenario.noise.beam
        if beam is None:
            return []
        if beam.shift_mhz is not None:
            return [difference(self.shifted_beams(), self.beams)]
        frequency, lmax = self.scenario.frequency_mhz, self.scenario.lmax
        monopoles = build_monopoles(self.scenario)
        directions = []
        for name, sigma in beam.parameters.items():
            slope = derivative(name, frequency, lmax, monopoles)
            directions.append(ProductBeams(sigma * slope.modes, frequency))
        return directions

    def shifted_beams(self) -> ProductBeams:
        """The beams at frequency + shift, which the data are taken with."""
        frequency = self.scenario.frequency_mhz + self.scenario.noise.beam.shift_mhz
        return monopole_beams(frequency, self.scenario.lmax, build_monopoles(self.scenario))

    def true_beams(self) -> ProductBeams:
        """The beams that simulated data are taken with."""
        beam = self.scenario.noise.beam
        if beam is None:
            return self.beams
        if beam.shift_mhz is not None:
            return self.shifted_beams()
        key = jax.random.fold_in(jax.random.key(self.scenario.seed), BEAM_DRAW)
        draws = np.asarray(jax.random.normal(key, (len(beam.parameters),), dtype=np.float64))
        steps = {
            name: sigma * float(z)
            for (name, sigma), z in zip(beam.parameters.items(), draws, strict=True)
        }
        antennas = moved(build_monopoles(self.scenario), steps)
        return monopole_beams(self.scenario.frequency_mhz, self.scenario.lmax, antennas)

    def beam_rms_difference(self) -> float | None:
        """RMS difference of the true beams and the model's, over the model's; None if the same."""
        if self.scenario.noise.beam is None:
            return None
        return rms_difference(self.true_beams(), self.beams)

    def model(
        self,
        data: Visibilities | None = None,
        around: Float[Array, "products times"] | None = None,
    ) -> LinearGaussian:
        """d = A m + n of this experiment."""
        return LinearGaussian(self.coupling, self.prior, self.noise(data, around))

    def infer(self, data: Visibilities) -> tuple[LinearGaussian, Posterior, int]:
        """The model, its posterior given ``data``, and how many rounds that took.

        One round, unless the gain term is built around the posterior's own prediction: then N and
        the map are repeated until the map moves by less than 0.01 standard deviations (rms).
        InputError if it does not settle in 20 rounds.
        """
        model = self.model(data)
        posterior = model.condition(data.data)
        gain = self.scenario.noise.gain
        if gain is None or gain.treatment == "ignored" or gain.visibilities != "posterior":
            return model, posterior, 1
        complete = CouplingMatrix.build(self.beams, self.pointing)
        for rounds in range(2, MAX_ROUNDS + 1):
            predicted = complete.layout.scatter(complete @ posterior.mean)
            model = self.model(data, predicted)
            previous, posterior = posterior, model.condition(data.data)
            if float(posterior.rms_shift_from(previous)) < SETTLED:
                return model, posterior, rounds
        raise InputError(
            f"the map still moves after {MAX_ROUNDS} rounds of rebuilding the gain term around it; "
            "use noise.gain.visibilities=model"
        )

    def simulate(self) -> Visibilities:
        """Visibilities of the scenario's sky with every draw from its seed."""
        key = jax.random.key(self.scenario.seed)
        visibilities = self.signal
        if self.scenario.noise.beam is not None:
            true = CouplingMatrix.build(self.true_beams(), self.pointing)
            visibilities = true.layout.scatter(true @ self.sky.modes)
        drift = build_gain_drift(self.scenario)
        if drift is not None:
            gains = drift.sample(jax.random.fold_in(key, GAIN_DRAW), self.observation.hours)
            visibilities = with_gains(visibilities, gains)
        layout = self.coupling.layout
        return Visibilities(
            layout.gather(visibilities) + self.radiometer().sample(key),
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
            f"time {first} lacks some of its products, so the noise cannot be built around what "
            "was measured there; use noise.radiometer.temperature=model and "
            "noise.gain.visibilities=model"
        )
    return jax.numpy.where(complete[None], data.layout.scatter(data.data), model)
