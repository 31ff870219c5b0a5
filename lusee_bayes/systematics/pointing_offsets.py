"""Offsets of clock and pointing: A for antennas that are tilted, turned, and sampled later.

The clock is expanded, too: a deviation from :attr:`PointingOffsets.expansion_point` turns the Moon
at a constant rate (:func:`.turned_by_offsets`). All angles are exact.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Annotated

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int
from pydantic import Field

from lusee_bayes.core import harmonics, reading
from lusee_bayes.core.arrays import Array, DataVector, namespace, on_device
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.section import NOT_TINY, Section, Treatment, requires
from lusee_bayes.instrument import pointing as pointings
from lusee_bayes.instrument.beams.monopoles import Monopoles
from lusee_bayes.instrument.beams.source import BeamSource
from lusee_bayes.instrument.products import DataLayout
from lusee_bayes.systematics.context import Around, Setup
from lusee_bayes.systematics.sources import SOURCE_NODES, source_responses
from lusee_bayes.systematics.systematic import Systematic, Unknown, Values, with_added

# a wider prior is no constraint: the sky would look entirely different
Offset = Annotated[float, Field(gt=0, le=45), NOT_TINY]


class PointingSection(Section):
    """Clock and pointing offsets: prior standard deviations of the corrections to add.

    Attributes
    ----------
    clock_s : float
        Delay of the samples relative to their recorded times, during which the Moon is taken to
        turn uniformly.
    clock_drift_s_per_day : float
        Increase of this delay per day since the first sample.
    turntable_deg : float
        Turntable angle, independent for every run.
    lon_deg : float
        Longitude of the site.
    lat_deg : float
        Latitude of the site.
    tilt_east_deg : float
        Tilt of the lander towards East.
    tilt_north_deg : float
        Tilt of the lander towards North.
    treatment : {"marginalised", "sampled", "ignored"}
        Add their covariance to N to first order, sample them with the map, or leave them out of the
        model.
    true_values : dict
        True values in simulated data, by name (turntable_0_deg, ... if there are several runs);
        the others are drawn from their priors.
    """

    clock_s: Annotated[float, Field(gt=0, le=1000.0), NOT_TINY] | None = None
    clock_drift_s_per_day: Annotated[float, Field(gt=0, le=1e4), NOT_TINY] | None = None
    turntable_deg: Offset | None = None
    lon_deg: Offset | None = None
    lat_deg: Offset | None = None
    tilt_east_deg: Offset | None = None
    tilt_north_deg: Offset | None = None
    treatment: Treatment = "marginalised"
    true_values: dict[str, Annotated[float, Field(ge=-1e6, le=1e6)]] = Field(default_factory=dict)

    _something_is_not_known = requires(
        lambda section: section.kinds,
        f"give a standard deviation for at least one of {', '.join(pointings.OFFSETS)}",
    )

    @property
    def kinds(self) -> tuple[str, ...]:
        """Kinds of the unknown offsets."""
        return tuple(kind for kind in pointings.OFFSETS if getattr(self, kind) is not None)


class PointingOffsets(Systematic):
    """Offsets of clock and pointing with independent Gaussian priors about zero.

    Attributes
    ----------
    unknowns : tuple of Unknown
        With the names of :func:`.offset_names`, in the units that these end with.
    expansion_point : (2,) array
        Offsets of clock and drift in :attr:`pointing`.
    pointing : Pointing
        With these offsets, and otherwise as in the observation.
    hours : (times,) array
        Since the first sample.
    mcmf_from_lander : (3, 3) array
        Without offsets.
    layout : DataLayout
        The data.
    sources : MovingSources or None
        The point sources; None if the model has none.
    """

    key, section, words, draw = "noise.pointing", PointingSection, "clock and pointing", 7
    moves, moves_setup, in_common, has_table = (True,) * 4

    unknowns: tuple[Unknown, ...] = eqx.field()
    expansion_point: Float[Array, "2"]
    pointing: pointings.Pointing
    hours: Float[Array, " times"]
    mcmf_from_lander: Float[Array, "3 3"]
    layout: DataLayout
    sources: MovingSources | None = None

    @classmethod
    def build(cls, section: PointingSection, setup: Setup, around: Around) -> PointingOffsets:
        names = pointings.offset_names(section.kinds, setup.observation.n_runs)
        stds = {name: float(getattr(section, pointings.offset_kind(name))) for name in names}
        return cls.of(setup, stds, {name: (around.values or {}).get(name, 0.0) for name in names})

    @classmethod
    def of(
        cls, setup: Setup, stds: Mapping[str, float], values: Mapping[str, float]
    ) -> PointingOffsets:
        """Build it for a setup moved to values, with these prior standard deviations."""
        back = {name: -value for name, value in values.items() if name not in pointings.CLOCK}
        observation = pointings.with_offsets(setup.observation, back)
        pointing = setup.pointing.placed(observation)
        ignored = not setup.responses or setup.scenario.sources.treatment == "ignored"
        return cls(
            tuple(Unknown(name, 0.0, std) for name, std in stds.items()),
            np.array([values.get(name, 0.0) for name in pointings.CLOCK]),
            pointing,
            setup.observation.hours,
            observation.lander_from_mcmf().T,
            setup.layout,
            None if ignored else MovingSources.of(setup),
        )

    @classmethod
    def moved(cls, section: PointingSection, setup: Setup, values: Values) -> Setup:
        """Change times and places: A, the responses to sources, and the signal."""
        names = pointings.offset_names(section.kinds, setup.observation.n_runs)
        offsets = {name: value for name, value in values.items() if name in names}
        return shifted(setup, offsets) if offsets else setup

    def turned(self, values: Values) -> pointings.Pointing:
        """The pointing for values by name."""
        clock = dict(zip(pointings.CLOCK, self.expansion_point, strict=True))
        left = {name: values[name] - clock.get(name, 0.0) for name in self.names}
        return pointings.turned_by_offsets(self.pointing, self.hours, left)

    def effect(self, model, values):
        """Use A with the offsets; sources with their mean fluxes move, too."""
        model = replace(model, coupling=model.coupling.of(pointing=self.turned(values)))
        if self.sources is None:
            return model
        seen = self.sources.seen(self.orientation(values), self.layout)
        return with_added(model, seen - self.sources.in_signal)

    def linearised(self, model, centre):
        """Differentiate the turns of the antennas.

        ::

            A(z) m = sum_k w_k A_k m to first order,    A_k of the beams K_k b,

        with the rotation vector w(t) by which the antennas turn, in their frame, and the generators
        K_k of turns about its axes. JAX differentiates only w(z), which compiles quickly.
        """
        pointing = self.turned(self.values(centre))
        device, of_sources = on_device(self), 0.0
        orientation, slopes = _slopes(*on_device((self, centre)))
        if self.sources is not None:  # the derivative of their beams would compile for a minute

            def seen(at):
                return device.sources.seen(at, device.layout)

            seen = eqx.filter_jit(seen) if isinstance(self.sources.beams, Monopoles) else seen
            ways = self.differences(lambda values: seen(device.orientation(values)), centre)
            of_sources = np.stack([*ways], axis=1)
        turn = np.einsum("tji,tjkn->tikn", np.asarray(orientation), np.asarray(slopes))
        beams, ways = [], []
        for axis in range(3):
            blocks = (harmonics.generators(ell)[axis] for ell in range(model.coupling.lmax + 1))
            beams.append(harmonics.Rotation(tuple(blocks))(np.asarray(model.coupling.modes)))
            ways.append(turn[:, (axis + 2) % 3, (axis + 1) % 3][np.asarray(self.layout.time)])
        see = model.coupling.along(beams, pointing)

        def columns(sky):
            turned = zip(see(sky), ways, strict=True)
            return of_sources + sum(self.layout.gather(one)[:, None] * way for one, way in turned)

        return columns

    def orientation(self, values: Values) -> Float[Array, "times 3 3"]:
        """The rotation from the antennas' frame to the Moon-fixed one at every sample.

        The Moon turns about its z axis, 0.04 degrees from the pole.
        """
        pointing = self.turned(values)
        lon, lat, east, north = (pointing.turns[k] for k in range(4))
        spans = [span.stop - span.start for _, span in pointing.runs()]
        turntable = pointing.turntable[np.repeat(np.arange(len(spans)), spans)]
        lean = _about(0, -lat) @ _about(1, east) @ _about(0, -north)
        later = pointing.azimuth - self.pointing.azimuth
        return _about(2, lon - later) @ self.mcmf_from_lander @ lean @ _about(2, turntable)


@eqx.filter_jit
def _slopes(offsets: PointingOffsets, centre: Array) -> tuple[Array, Array]:
    """The orientation, and its derivative by the offsets."""

    def at(z: Array) -> Array:
        return offsets.orientation(offsets.values(z))

    return at(centre), jax.jacfwd(at)(centre)


def _about(axis: int, angle: float | Array) -> Float[Array, "*batch 3 3"]:
    """Rotations about an axis by angles in radians: about x, from y towards z."""
    xp, unit = namespace(angle), np.eye(3)
    slope = np.cross(unit, unit[axis])
    factors = xp.stack([xp.ones_like(angle), xp.sin(angle), 1.0 - xp.cos(angle)], axis=-1)
    return xp.tensordot(factors, np.stack([unit, slope, slope @ slope]), 1)


class MovingSources(eqx.Module):
    """Point sources with their mean fluxes, as seen by turned antennas.

    Between the clock's :attr:`PointingOffsets.expansion_point` and other values, solar-system
    bodies stay fixed among the stars.

    Attributes
    ----------
    directions : (sources, instants, 3) array
        Unit vectors in the Moon-fixed frame, at all instants of all samples.
    fluxes : (sources,) array
        In K sr.
    stokes_v : (sources,) array or None
        V / I; None if all are zero.
    sample : (instants,) array
        The sample of each instant.
    weight : (instants,) array
        Of each in the mean over its sample.
    beams : BeamSource
    frequency_mhz : float
    in_signal : (data,) array
        Their part of the data that the signal already contains, in K.
    """

    directions: Float[Array, "sources instants 3"]
    fluxes: Float[Array, " sources"]
    stokes_v: Float[Array, " sources"] | None
    sample: Int[Array, " instants"]
    weight: Float[Array, " instants"]
    beams: BeamSource
    frequency_mhz: float = eqx.field(static=True)
    in_signal: Float[Array, " data"]

    @classmethod
    def of(cls, setup: Setup) -> MovingSources:
        """The sources of a setup. InputError if they have to be differentiable, but are not."""
        sampled = PointingOffsets.treatment(setup.scenario) == "sampled"
        if sampled and not isinstance(setup.beam_source, Monopoles):
            raise InputError(
                "sources seen by beams of files cannot be sampled with clock and pointing; use "
                "noise.pointing.treatment=marginalised"
            )
        instants, sample, weight = setup.observation.at_nodes(SOURCE_NODES)
        sections = setup.scenario.sources.list
        vectors = [np.broadcast_to(s.direction(instants), (len(sample), 3)) for s in sections]
        circular = np.array([s.stokes_v for s in sections])
        fluxes = np.array([s.mean_flux(setup.frequency_mhz) for s in sections])
        return cls(
            np.einsum("tij,stj->sti", instants.mcmf_from_galactic, np.stack(vectors)),
            fluxes,
            circular if circular.any() else None,
            sample,
            weight,
            setup.beam_source,
            setup.beams.frequency_mhz,
            setup.layout.gather(np.tensordot(fluxes, np.stack(setup.responses), 1)),
        )

    def seen(self, orientation: Float[Array, "times 3 3"], layout: DataLayout) -> DataVector:
        """Their signal in the data, in K; differentiable except where a source rises or sets."""
        turned = jnp.einsum("sti,tij->stj", self.directions, orientation[self.sample])
        shape = (layout.n_products, *turned.shape[:2])
        inputs = self.frequency_mhz, turned.reshape(-1, 3)
        response = self.beams.response(*inputs).reshape(shape)
        if self.stokes_v is not None:
            circular = self.beams.response(*inputs, "V").reshape(shape)
            response = response + self.stokes_v[None, :, None] * circular
        both = jnp.einsum("kst,s,t->kt", response, self.fluxes, self.weight)
        grid = jnp.zeros((layout.n_products, layout.n_times)).at[:, self.sample].add(both)
        return layout.gather(grid)


def shifted(setup: Setup, values: Mapping[str, float]) -> Setup:
    """The setup with another observation, its A and its responses to sources."""
    given = ", ".join(f"{name} = {value:g}" for name, value in values.items() if value)
    with reading.naming(f"noise.pointing, with {given or 'no offsets'}"):
        observation = pointings.with_offsets(setup.observation, values)
    if any(values.get(name) for name in pointings.CLOCK):
        frame = np.asarray(setup.pointing.pole_frame)
        pointing = pointings.Pointing.of(observation, setup.sky.lmax, pole_frame=frame)
    else:  # the sky turns as before
        pointing = setup.pointing.placed(observation)
    inputs = setup.scenario, observation, setup.beam_source, setup.frequency_mhz
    return replace(
        setup,
        observation=observation,
        coupling=setup.coupling.of(pointing=pointing),
        responses=source_responses(*inputs),
    )
