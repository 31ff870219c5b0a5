"""An experiment: what is known and not known of a scene, and the map that follows from data."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

from jaxtyping import Array, Float

from lusee_bayes.beams import ProductBeams
from lusee_bayes.checks import InputError
from lusee_bayes.coupling import CouplingMatrix
from lusee_bayes.covariance import Covariance
from lusee_bayes.linear_gaussian import LinearGaussian
from lusee_bayes.noise import derivative, difference
from lusee_bayes.posterior import Posterior
from lusee_bayes.simulation import Simulation
from lusee_bayes.systematics import (
    BeamError,
    GainDrifts,
    Instrument,
    InstrumentParameters,
    Marginalised,
    NoiseLevel,
    PointSources,
    PowerSpectrum,
    SpectrumBands,
    Systematic,
)
from lusee_bayes.visibilities import Visibilities

# where the treatment of a systematic is said
SECTIONS = {GainDrifts: "noise.gain", BeamError: "noise.beam", PointSources: "sources"}

# the gain term is rebuilt until the map moves by less than this (rms, in standard deviations)
SETTLED, MAX_ROUNDS = 1e-2, 20


class Experiment(Simulation):
    """The pieces a scenario stands for, ready to simulate data or to make a map of them."""

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

    def beam_directions(self) -> list[ProductBeams]:
        """One-sigma errors of the beams that the scenario allows for."""
        beam = self.scenario.noise.beam
        if beam is None:
            return []
        if not beam.parameters:
            return [difference(self.true_beams(), self.beams)]
        frequency, lmax = self.scenario.frequency_mhz, self.scenario.lmax
        directions = []
        for name, sigma in beam.parameters.items():
            slope = derivative(name, frequency, lmax, self.instrument.monopoles)
            directions.append(ProductBeams(sigma * slope.modes, frequency))
        return directions

    def base(self, data: Visibilities | None = None) -> LinearGaussian:
        """d = A m + background + n with radiometer noise only."""
        return LinearGaussian(self.coupling, self.prior, self.radiometer(data), self.offset)

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

    def embedded(self) -> Instrument:
        """The embedded antennas, prepared. InputError where the beams are those of a file."""
        if self.scenario.beam.file is not None:
            raise InputError(
                "the program asks for the embedded antennas, which beam.file replaces; leave out "
                "beam.file"
            )
        return self.prepared

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
            "instrument": free(BeamError, self.embedded),
            "sources": free(PointSources, self.sources),
        }

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
