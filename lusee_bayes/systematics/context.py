"""Inputs of systematics: an instrument pointed at a sky, and quantities that the data determine.

Radiometer noise and gain drifts are built around visibilities. Those of the modelled sky are
correct if it is the true one, as for simulated data. Measured visibilities contain their own noise:
N is small where an auto is low by chance, and pulls the map there. With n times of B tau samples
each, and the exact covariance of p antennas' products, a common amplitude moves by up to
4 p sqrt(n / (B tau)) of its standard deviation. Drifts are not small, and stay in the measured
visibilities. The map's own prediction, computed in rounds (:mod:`lusee_bayes.experiment.rounds`),
has neither problem.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float

from lusee_bayes.core.arrays import Array, DataVector, Grid, Modes, ModesMatrix
from lusee_bayes.core.errors import InputError
from lusee_bayes.instrument.beams import fields, source
from lusee_bayes.instrument.coupling import CouplingMatrix, Instrument
from lusee_bayes.instrument.observation import Observation
from lusee_bayes.instrument.pointing import Pointing
from lusee_bayes.instrument.products import DataLayout, ports, without_gaps
from lusee_bayes.instrument.visibilities import Calibration, Visibilities
from lusee_bayes.priors.families import PriorFamily
from lusee_bayes.sky.prior import Prior
from lusee_bayes.sky.sky_source import Sky

# skies of noise alone, in K, and the noise behind them, weighted
Volume = tuple[Float[Array, "terms modes"], Float[Array, "terms data"], float]
# visibilities around which a term of N is built: the modelled sky's, the data, or the map's
NoiseAbout = Literal["model", "measured", "posterior"]


@dataclass(frozen=True)
class Above:
    """The possible contribution of the sky above lmax to the data.

    Attributes
    ----------
    coupling : CouplingMatrix
        A of all modes up to the highest ell.
    modes : (modes,) array
        Those above lmax of the modelled sky, in K.
    family : PriorFamily or None
        Priors up to the highest ell, from which data choose one; None for a given prior.
    covariance : (others, others) array
        Their prior covariance S', in K^2.
    root : (all, rank) array
        Of the part of S' that the data can tell from zero, in K; zero up to lmax.
    mean : (all,) array
        Their mean, in K; zero up to lmax.
    power : (ells,) array
        Expected contribution of each ell from lmax + 1 on to chi^2 of a model without it.
    """

    coupling: CouplingMatrix
    modes: Modes
    family: PriorFamily | None
    covariance: ModesMatrix
    root: Float[np.ndarray, "all rank"]
    mean: Float[np.ndarray, " all"]
    power: Float[np.ndarray, " ells"]

    @cached_property
    def seen(self) -> tuple[Float[Array, "data rank"], DataVector]:
        """Root and mean of the contribution to the data, in K."""
        return self.coupling @ self.root, self.coupling @ self.mean


@dataclass(frozen=True)
class Setup:
    """The parts of d = A m + n that a scenario defines.

    Attributes
    ----------
    scenario : Scenario
        Each systematic reads its own section.
    observation : Observation
    sky : Sky
        The scenario's model sky, up to lmax.
    beam_source : BeamSource
    expected_source : BeamSource
        The antennas with the expected values of their parameters; those of ``beam_source`` may be
        true ones.
    beams : ProductBeams
    coupling : CouplingMatrix
        A.
    prior : Prior
        S; if it is to be learned, the expected one.
    responses : tuple of (products, times) arrays
        To 1 K sr of each point source outside the map.
    background : (products, times) array
        Visibilities without any sky, from ground, antennas, the mean receiver and terrain, in K.
    signal : (products, times) array
        Visibilities of sky, background and sources with their mean fluxes through the modelled
        beams, in K (:meth:`with_signal`).
    receiver : Receiver or None
        The receivers that the data name; None for other data.
    calibration : Calibration or None
        Of data that are averages of a spectrometer's spectra; None for other data.
    measured : bool
        Whether the data were given, so that their sky is not the modelled one.
    family : PriorFamily or None
        From which data choose the prior; None for a given prior.
    hidden : (runs, products, modes) array or None
        Effect of the known horizon on the beams (``beams`` is without it); None for flat ground.
    above : Above or None
        None if the model ends at lmax.
    """

    scenario: Any
    observation: Observation
    sky: Sky
    beam_source: source.BeamSource
    expected_source: source.BeamSource
    beams: fields.ProductBeams
    coupling: CouplingMatrix
    prior: Prior
    responses: tuple[Grid, ...]
    background: Grid
    signal: Grid | None = None
    receiver: source.Receiver | None = None
    calibration: Calibration | None = None
    measured: bool = False
    family: PriorFamily | None = None
    hidden: Float[Array, "runs products modes"] | None = None
    above: Above | None = None

    @property
    def frequency_mhz(self) -> float:
        """Frequency of the data."""
        return self.scenario.frequency_mhz

    @property
    def pointing(self) -> Pointing:
        """The orientation of the lander at every sample."""
        return self.coupling.pointing

    @property
    def layout(self) -> DataLayout:
        """The product and the time of every datum."""
        return self.coupling.layout

    @property
    def instrument(self) -> Instrument:
        """Expected antennas, orientations and samples, which give A for any beams."""
        of_data = self.pointing, self.layout, self.frequency_mhz, self.scenario.lmax
        return Instrument(self.expected_source, *of_data)

    @property
    def offset(self) -> DataVector | None:
        """The background in every datum, in K; None if there is none."""
        return self.layout.gather(self.background) if np.any(self.background) else None

    def with_prior(self, section: Any) -> Setup:
        """Return the same with another prior, or family of priors.

        Parameters
        ----------
        section : PriorSection
            Replaces the scenario's section.
        """
        scenario = self.scenario.model_copy(update={"prior": section})
        prior, family = prior_and_family(scenario, self.sky)
        return replace(self, scenario=scenario, prior=prior, family=family)

    def with_signal(self) -> Setup:
        """Return the same with :attr:`signal`, computed from everything else."""
        signal = self._of_sky(self.sky.modes) + self.background
        for section, response in zip(self.scenario.sources.list, self.responses, strict=True):
            signal = signal + section.mean_flux(self.sky.frequency_mhz) * response
        return replace(self, signal=signal)

    def under(self, sky: Sky) -> Setup:
        """Point the instrument at another sky; the prior stays that of the scenario.

        Parameters
        ----------
        sky : Sky
            Of the same frequency and lmax.
        """
        return replace(self, sky=sky, signal=self.signal + self._of_sky(sky.modes - self.sky.modes))

    def _of_sky(self, modes: Modes) -> Grid:
        """The visibilities of a sky, for all products at all times."""
        layout = DataLayout(self.layout.n_products, self.layout.n_times)
        return layout.scatter(replace(self.coupling, layout=layout) @ modes)

    def with_layout(self, layout: DataLayout) -> Setup:
        """Return the same for a subset of its data."""
        return self._with_couplings(lambda coupling: replace(coupling, layout=layout))

    def _with_couplings(self, changed: Callable[[CouplingMatrix], CouplingMatrix]) -> Setup:
        """Change A, also that of the sky above lmax."""
        if (above := self.above) is not None:
            above = replace(above, coupling=changed(above.coupling))
        return replace(self, coupling=changed(self.coupling), above=above)

    def select(self, keep: Bool[np.ndarray, " times"]) -> Setup:
        """Return the same at the times where ``keep`` is True, with some of every run."""
        observation, calibration = self.observation.select(keep), self.calibration
        ends = np.searchsorted(observation.run, np.arange(observation.n_runs + 1)).tolist()
        layout = DataLayout.from_flags(~np.asarray(self.layout.present)[:, keep])

        def changed(coupling: CouplingMatrix) -> CouplingMatrix:
            turns = coupling.pointing
            of_time = {"azimuth": turns.azimuth[keep], "functions": turns.functions[keep]}
            pointing = replace(turns, **of_time, run_starts=tuple(ends))
            return replace(coupling, pointing=pointing, layout=layout)

        return replace(
            self._with_couplings(changed),
            observation=observation,
            responses=tuple(grid[:, keep] for grid in self.responses),
            background=self.background[:, keep],
            signal=self.signal[:, keep],
            calibration=None if calibration is None else calibration.select(keep),
        )

    @property
    def n_averaged(self) -> Float[Array, " times"]:
        """Number of independent samples in a visibility of every time.

        Averages of spectra contain it; for other data, it follows from the scenario's bandwidth and
        duty cycle.
        """
        if self.calibration is not None:
            return self.calibration.n_averaged
        section = self.scenario.noise.radiometer
        return section.bandwidth_hz * self.observation.live_s * section.duty_cycle

    @property
    def noise_is_seen(self) -> bool:
        """Whether what the noise depends on was seen at some time.

        Of all ports used, it depends on the autos, and in the exact form on the crosses, too.
        """
        seen = np.asarray(self.layout.present).any(1)
        first, second, _ = ports(self.beam_source.n_ports)
        used = np.union1d(first[seen], second[seen])
        needed = np.isin(first, used) & np.isin(second, used)
        if self.scenario.noise.radiometer.form != "exact":
            needed &= first == second
        return bool(seen[needed].all())


def prior_and_family(scenario: Any, sky: Sky) -> tuple[Prior, PriorFamily | None]:
    """The scenario's prior, or the expected one if data choose it, and its family."""
    family = scenario.prior.family(scenario.frequency_mhz, scenario.lmax)
    return (scenario.prior.prior(sky) if family is None else family.expected()), family


@dataclass(frozen=True)
class Around:
    """Quantities around which a systematic may be built, besides its setup.

    Attributes
    ----------
    data : Visibilities or None
        The measured data; None before there are any.
    visibilities : (products, times) array or None
        Visibilities for the gain term, in K; None for those that the scenario names.
    sky : (modes,) array or None
        About which the model is linear in its unknowns, in K; None for the scenario's.
    values : mapping of float or None
        Of the unknowns about which it is linear, by name; None for their prior means.
    volume : ((terms, modes) array, (terms, data) array, float) or None
        Skies s, in K, and data w for which the mean of s w^T is C A^T N^-1, whose slopes are those
        of the volume of skies that fit; and the standard errors that this mean must exceed. None
        before there is a posterior.
    tempered : float
        Factor of radiometer noise in first rounds; above 1, its products are independent.
    still : bool
        Whether values stay where they are, in one round.
    gains, gain_slope : (antennas, times) arrays or None
        Drifts of the gains, and the slope of ln p by them that is due to the volume of skies and
        drifts that fit; None before they are inferred.
    """

    data: Visibilities | None = None
    visibilities: Grid | None = None
    sky: Modes | None = None
    values: Mapping[str, float | Float[Array, "..."]] | None = None
    volume: Volume | None = None
    tempered: float = 1.0
    still: bool = False
    gains: Float[Array, "antennas times"] | None = None
    gain_slope: Float[Array, "antennas times"] | None = None


def noise_visibilities(setup: Setup, around: Around, about: NoiseAbout) -> Grid:
    """The visibilities around which a term of N is built, in K.

    Before there is a prediction, they are the measured ones or, if products on which noise depends
    were never measured, the modelled sky's. Missing samples of measured ones are interpolated. A
    time without any sample gets the model's, which are not used.

    Raises
    ------
    InputError
        If an auto was never measured, but other products of its port were.
    """
    data = around.data
    if about == "model" or data is None:
        return setup.signal
    if about == "posterior" and around.visibilities is not None:
        return around.visibilities
    if about == "posterior" and not setup.noise_is_seen:
        return setup.signal
    try:
        measured = without_gaps(data.layout.scatter(data.data), data.layout)
    except InputError as error:
        why = f"{error}, or use noise.radiometer.temperature and noise.gain.visibilities: posterior"
        raise InputError(why) from error
    return np.where(data.layout.present.any(0)[None], measured, setup.signal)
