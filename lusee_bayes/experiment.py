"""From a scenario to the objects of d = A m + n."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from numpyro import handlers

from lusee_bayes.beams import Monopoles, ProductBeams, monopole_beams, placed
from lusee_bayes.building import (
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
from lusee_bayes.linear_gaussian import LinearGaussian
from lusee_bayes.noise import (
    GainDrift,
    derivative,
    difference,
    radiometer_noise,
    rms_difference,
    with_gains,
)
from lusee_bayes.observation import Observation
from lusee_bayes.pointing import Pointing
from lusee_bayes.posterior import Posterior
from lusee_bayes.prior import HarmonicPrior
from lusee_bayes.progress import Stages
from lusee_bayes.scenario import Scenario, SourceSection
from lusee_bayes.sky import Sky
from lusee_bayes.systematics import (
    BeamError,
    GainDrifts,
    Instrument,
    InstrumentParameters,
    Marginalised,
    NoiseLevel,
    PointSources,
    PowerSpectrum,
    Source,
    SpectrumBands,
    Systematic,
    uncertain_scale,
)
from lusee_bayes.visibilities import Visibilities

# what the scenario's seed is folded with for each kind of draw; the radiometer takes it as it is
GAIN_DRAW, BEAM_DRAW, LEVEL_DRAW, SOURCE_DRAW, SCALE_DRAW = 2, 3, 4, 5, 6

# where the treatment of a systematic is said
SECTIONS = {GainDrifts: "noise.gain", BeamError: "noise.beam", PointSources: "sources"}

# the gain term is rebuilt until the map moves by less than this (rms, in standard deviations)
SETTLED, MAX_ROUNDS = 1e-2, 20


@dataclass(frozen=True)
class Experiment:
    """The pieces a scenario stands for, ready to simulate data or to make a map of them.

    responses : (products, times) of each point source to 1 K sr
    signal : (products, times) visibilities of sky and sources through the modelled beams, in K
    """

    scenario: Scenario
    observation: Observation
    sky: Sky
    instrument: Instrument
    beams: ProductBeams
    coupling: CouplingMatrix
    prior: HarmonicPrior
    responses: tuple[Float[Array, "products times"], ...]
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
            antennas = build_monopoles(scenario)
            beams = jax.block_until_ready(build_beams(scenario))
            responses = build_source_responses(scenario, observation, antennas)
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

    # --- what is not known --------------------------------------------------------------------

    def systematics(
        self,
        data: Visibilities | None = None,
        around: Float[Array, "products times"] | None = None,
    ) -> list[tuple[str, Systematic]]:
        """Treatment and systematic, for all that the scenario does not ignore, in their order.

        ``around``: the visibilities for the gain term; by default those the scenario names.
        """
        noise, prior = self.scenario.noise, self.scenario.prior
        found: list[tuple[str, Systematic]] = []
        if noise.radiometer.log_factor_std is not None:
            found.append(("sampled", NoiseLevel(noise.radiometer.log_factor_std)))
        if prior.band_edges:
            found.append(("sampled", SpectrumBands(prior.band_edges, prior.log_band_std)))
        if prior.log_amplitude_std is not None or prior.tilt_std is not None:
            found.append(("sampled", PowerSpectrum(prior.log_amplitude_std, prior.tilt_std)))
        beam = noise.beam
        if beam is not None and beam.treatment == "sampled" and beam.parameters:
            found.append(("sampled", InstrumentParameters.about(self.prepared, beam.parameters)))
        elif beam is not None and beam.treatment != "ignored":
            for direction in self.beam_directions():
                error = BeamError(self.instrument.coupling_of(direction))
                found.append((beam.treatment, error))
        if self.responses and self.scenario.sources.treatment != "ignored":
            found.append((self.scenario.sources.treatment, self.sources()))
        if noise.gain is not None and noise.gain.treatment != "ignored":
            found.append((noise.gain.treatment, self.gain_drifts(data, around)))
        return found

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

    def base(self, data: Visibilities | None = None) -> LinearGaussian:
        """d = A m + n with radiometer noise only."""
        return LinearGaussian(self.coupling, self.prior, self.radiometer(data))

    def model(
        self,
        data: Visibilities | None = None,
        around: Float[Array, "products times"] | None = None,
    ) -> LinearGaussian:
        """d = A m + n of this experiment, with every systematic in N that is not ignored.

        Those that are to be sampled, too, to first order: what a Gaussian can say about them.
        """
        model = self.base(data)
        for _, systematic in self.systematics(data, around):
            model = systematic.marginalised(model)
        return model

    def noise(self, data: Visibilities | None = None) -> Covariance:
        """N of :meth:`model`: radiometer noise and every systematic that is not ignored."""
        return self.model(data).noise

    def with_fluxes(
        self,
        data: Visibilities | None = None,
        around: Float[Array, "products times"] | None = None,
    ) -> LinearGaussian:
        """:meth:`model`, but with the sources' fluxes among the unknowns, behind the sky's.

        InputError if the scenario has no sources.
        """
        model, sources = self.base(data), self.sources()
        for _, systematic in self.systematics(data, around):
            if not isinstance(systematic, PointSources):
                model = systematic.marginalised(model)
        return sources.joint(model)

    def unsolved(
        self, data: Visibilities | None = None
    ) -> tuple[LinearGaussian, tuple[Systematic, ...]]:
        """The model before anything is sampled, and what is then to be applied to it.

        Systematics that are marginalised come in their place in the order, as sampled ones without
        a site.
        """
        model, rest = self.base(data), []
        for treatment, systematic in self.systematics(data):
            if treatment == "sampled":
                rest.append(systematic)
            elif rest:
                rest.append(Marginalised(systematic))
            else:
                model = systematic.marginalised(model)
        if rest and not any(systematic.changes_coupling for systematic in rest):
            model = replace(model, coupling=model.coupling.dense())
        return model, tuple(rest)

    def pieces(self, data: Visibilities) -> dict[str, Callable[[], Any]]:
        """What makes the pieces of this experiment that programs can ask for, by name.

        InputError, once made, for a systematic that the scenario marginalises as well.
        """

        def free(kind: type[Systematic], made: Callable[[], Systematic]) -> Callable:
            def make():
                piece = made()
                if any(t == "marginalised" and isinstance(s, kind) for t, s in self.systematics()):
                    raise InputError(
                        "the program samples what the scenario marginalises, so that it would "
                        f"count twice; set {SECTIONS[kind]}.treatment=sampled"
                    )
                return piece

            return make

        unsolved = cache(lambda: self.unsolved(data))
        return {
            "gaussian": lambda: unsolved()[0],
            "systematics": lambda: unsolved()[1],
            "gain_drifts": free(GainDrifts, lambda: self.gain_drifts(data)),
            "instrument": free(BeamError, lambda: self.prepared),
            "sources": free(PointSources, self.sources),
        }

    # --- the truth ----------------------------------------------------------------------------

    def beam_directions(self) -> list[ProductBeams]:
        """One-sigma errors of the beams that the scenario allows for."""
        beam = self.scenario.noise.beam
        if beam is None:
            return []
        if beam.shift_mhz is not None:
            return [difference(self.true_beams(), self.beams)]
        frequency, lmax = self.scenario.frequency_mhz, self.scenario.lmax
        directions = []
        for name, sigma in beam.parameters.items():
            slope = derivative(name, frequency, lmax, self.instrument.monopoles)
            directions.append(ProductBeams(sigma * slope.modes, frequency))
        return directions

    def truth(self) -> dict[str, float | np.ndarray]:
        """True values of what simulated data hold, by the names of their sites.

        Drawn with the scenario's seed from their priors.
        """
        key = jax.random.key(self.scenario.seed)
        truth: dict[str, float | np.ndarray] = {}
        radiometer, gain = self.scenario.noise.radiometer, self.scenario.noise.gain
        if radiometer.log_factor_std is not None:
            prior = uncertain_scale(1.0, radiometer.log_factor_std)
            truth["noise_level"] = float(prior.sample(jax.random.fold_in(key, LEVEL_DRAW)))
        beam = self.scenario.noise.beam
        if beam is not None and beam.parameters:
            priors = InstrumentParameters.about(self.instrument, beam.parameters).priors()
            keys = jax.random.split(jax.random.fold_in(key, BEAM_DRAW), len(priors))
            for (name, prior), k in zip(priors.items(), keys, strict=True):
                truth[name] = float(prior.sample(k))
        elif beam is not None:
            truth["beam_amplitude"] = 1.0
        if gain is not None:
            # the scales where they are not known; the prior is the program's own
            with handlers.seed(rng_seed=jax.random.fold_in(key, SCALE_DRAW)):
                drift = self.gain_drifts().scales()
            truth["gain_sigma"] = float(drift.sigma)
            truth["gain_correlation_h"] = float(drift.correlation_h)
        if self.responses:
            sources = self.sources().sources
            keys = jax.random.split(jax.random.fold_in(key, SOURCE_DRAW), len(sources))
            for source, k in zip(sources, keys, strict=True):
                z = np.asarray(jax.random.normal(k, (source.n_blocks,), dtype=np.float64))
                flux = source.mean + source.std * z
                truth[source.site] = float(flux[0]) if source.n_blocks == 1 else flux
        return truth

    def true_antennas(self) -> tuple[float, Monopoles]:
        """Frequency and antennas of the beams that simulated data are taken with."""
        beam, frequency = self.scenario.noise.beam, self.scenario.frequency_mhz
        antennas = self.instrument.monopoles
        if beam is None:
            return frequency, antennas
        if beam.shift_mhz is not None:
            return frequency + beam.shift_mhz, antennas
        truth = self.truth()
        return frequency, placed(antennas, {name: truth[name] for name in beam.parameters})

    def true_beams(self) -> ProductBeams:
        """The beams that simulated data are taken with."""
        if self.scenario.noise.beam is None:
            return self.beams
        frequency, antennas = self.true_antennas()
        return monopole_beams(frequency, self.scenario.lmax, antennas)

    def beam_rms_difference(self) -> float | None:
        """RMS difference of the true beams and the model's, over the model's; None if the same."""
        if self.scenario.noise.beam is None:
            return None
        return rms_difference(self.true_beams(), self.beams)

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
        for rounds in range(2, MAX_ROUNDS + 1):
            model = self.model(data, self.prediction(posterior))
            previous, posterior = posterior, model.condition(data.data)
            if float(posterior.rms_shift_from(previous)) < SETTLED:
                return model, posterior, rounds
        raise InputError(
            f"the map still moves after {MAX_ROUNDS} rounds of rebuilding the gain term around it; "
            "use noise.gain.visibilities=model"
        )

    def prediction(self, posterior: Posterior) -> Float[Array, "products times"]:
        """Visibilities of the mean map, with the sources' mean fluxes, at every time; in K."""
        complete = CouplingMatrix.build(self.beams, self.pointing)
        difference_of_skies = posterior.mean - self.sky.modes
        return self.signal + complete.layout.scatter(complete @ difference_of_skies)

    def simulate(self) -> Visibilities:
        """Visibilities of the scenario's sky with every draw from its seed."""
        key = jax.random.key(self.scenario.seed)
        truth = self.truth()
        visibilities = self.true_signal(truth)
        if "gain_sigma" in truth:
            drift = GainDrift(truth["gain_sigma"], truth["gain_correlation_h"])
            gains = drift.sample(jax.random.fold_in(key, GAIN_DRAW), self.observation.hours)
            visibilities = with_gains(visibilities, gains)
        layout = self.coupling.layout
        noise = self.radiometer().scaled(truth.get("noise_level", 1.0))
        return Visibilities(
            layout.gather(visibilities) + noise.sample(key),
            layout,
            self.observation,
            self.scenario.frequency_mhz,
            self.sky.modes,
        )

    def true_signal(self, truth: dict[str, float | np.ndarray]) -> Float[Array, "products times"]:
        """Visibilities of sky and sources with the true antennas and fluxes, in K."""
        true = CouplingMatrix.build(self.true_beams(), self.pointing)
        visibilities = true.layout.scatter(true @ self.sky.modes)
        frequency, antennas = self.true_antennas()
        responses = build_source_responses(self.scenario, self.observation, antennas, frequency)
        for section, response in zip(self.scenario.sources.list, responses, strict=True):
            flux = np.atleast_1d(truth[f"flux_{section.name.replace(' ', '_')}"])
            visibilities = visibilities + jnp.asarray(flux)[self.blocks(section)][None] * response
        return visibilities


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
