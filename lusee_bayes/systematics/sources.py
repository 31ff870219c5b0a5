"""Point sources with known positions and unknown fluxes, which are not part of the map.

A source of x K sr adds x times the response to it. Fluxes have independent Gaussian priors; a
source may have one for each block of time.
"""

from __future__ import annotations

from typing import Annotated, Any, ClassVar

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float, Int, PRNGKeyArray
from pydantic import Field, model_validator

from lusee_bayes.core.arrays import Array, Grid, namespace, scalar
from lusee_bayes.core.checks import require_finite, require_positive, require_shape
from lusee_bayes.core.errors import InputError, nearest
from lusee_bayes.core.section import Positive, Section, Treatment, requires
from lusee_bayes.instrument.beams.monopoles import source_response
from lusee_bayes.instrument.beams.source import BeamSource
from lusee_bayes.instrument.coupling import CouplingMatrix
from lusee_bayes.instrument.observation import BODIES, Observation, body_direction
from lusee_bayes.sky.galaxy import BRIGHT_SOURCES, galactic_unit_vector, kelvin_steradian
from lusee_bayes.sky.sky_source import Sky
from lusee_bayes.systematics.context import Around, Setup
from lusee_bayes.systematics.systematic import Systematic, Truth, Unknown, with_added

CATALOGUE = {source.name: source for source in BRIGHT_SOURCES}
# instants in each piece of a window for the response to a source: antennas resolve nothing smaller
# than some degrees, and see nothing at the horizon, where a source appears within a window
SOURCE_NODES = 8


class SourceSection(Section):
    """A point source outside the map: from the catalogue, a solar-system body, or your own.

    Attributes
    ----------
    name : str
        Catalogue source (Cas A, ...), body (Sun, Jupiter, ...), or any other name with a position.
    flux_jy : float
        Prior mean of its flux density; default: the catalogue's value.
    relative_std : float
        Prior standard deviation of the flux density, relative to its mean.
    ra_deg : float
        Right ascension of your own source (ICRS).
    dec_deg : float
        Declination of your own source (ICRS).
    stokes_v : float
        Circularly polarised fraction V / I, positive if right-handed (IAU).
    block_h : float
        Length of time blocks with independent amplitudes; default: one block for all times.
    """

    name: str
    flux_jy: Positive | None = None
    relative_std: Positive = 0.5
    ra_deg: Annotated[float, Field(ge=-360, le=360)] | None = None
    dec_deg: Annotated[float, Field(ge=-90, le=90)] | None = None
    stokes_v: Annotated[float, Field(ge=-1, le=1)] = 0.0
    block_h: Positive | None = None

    _both_coordinates = requires(
        lambda section: (section.ra_deg is None) == (section.dec_deg is None),
        "give both ra_deg and dec_deg, or none",
    )

    def mean_flux(self, frequency_mhz: float) -> float:
        """Prior mean of its flux, in K sr; InputError if the flux is unknown."""
        if self.flux_jy is not None:
            return float(kelvin_steradian(self.flux_jy, frequency_mhz))
        if self.name in CATALOGUE:
            return float(CATALOGUE[self.name].kelvin_steradian(frequency_mhz))
        raise InputError(
            f"the source '{self.name}' is not in the catalogue, so that its flux is unknown; give "
            "flux_jy, the mean of its prior"
        )

    def direction(self, observation: Observation) -> Float[np.ndarray, "..."]:
        """Galactic unit vector(s): from its coordinates, the catalogue, or the ephemeris."""
        if self.ra_deg is not None:
            return galactic_unit_vector(self.ra_deg, self.dec_deg)
        if self.name in BODIES:
            return body_direction(self.name, observation)
        source = CATALOGUE.get(self.name)
        if source is None:
            raise InputError(
                f"unknown source '{self.name}'; {nearest(self.name, [*CATALOGUE, *BODIES])} (or "
                "give ra_deg and dec_deg)"
            )
        return galactic_unit_vector(source.ra_deg, source.dec_deg)

    def blocks(self, observation: Observation) -> Int[np.ndarray, " times"]:
        """Number of the amplitude that belongs to each time."""
        if self.block_h is None:
            return np.zeros(observation.n_times, dtype=int)
        hours = observation.hours / self.block_h
        return np.unique(np.floor(hours), return_inverse=True)[1]


class SourcesSection(Section):
    """Point sources that are not part of the map: marginalised, sampled or ignored.

    Attributes
    ----------
    list : tuple of SourceSection
        The sources.
    treatment : {"marginalised", "sampled", "ignored"}
        Add their covariance to N, sample their fluxes with the map, or leave them out of the
        model.
    """

    list: tuple[SourceSection, ...] = ()
    treatment: Treatment = "marginalised"

    @model_validator(mode="after")
    def _names_differ(self) -> SourcesSection:
        names = [source.name for source in self.list]
        for name in names:
            if names.count(name) > 1:
                raise ValueError(f"the source '{name}' is listed twice")
        return self


class Source(eqx.Module):
    """The response of the data to one source, and the prior of its flux.

    Attributes
    ----------
    columns : (data, blocks) array
        Response to 1 K sr in each block of time, in K per K sr.
    mean, std : () array
        Of the flux's Gaussian prior, in K sr.
    name : str
        The source's name.

    Raises
    ------
    InputError
        If the response is not finite or not a matrix, or if ``std`` is not positive.
    """

    columns: Float[Array, "data blocks"]
    mean: Float[Array, ""] = eqx.field(converter=scalar)
    std: Float[Array, ""] = eqx.field(converter=scalar)
    name: str = eqx.field(static=True)

    def __check_init__(self):
        require_finite(f"the response to {self.name}", self.columns)
        require_shape(f"the response to {self.name}", self.columns, (None, None))
        require_positive(f"the prior standard deviation of {self.name}'s flux", self.std)

    @property
    def n_blocks(self) -> int:
        """Number of amplitudes."""
        return self.columns.shape[1]

    @property
    def unknown(self) -> Unknown:
        """Its flux in K sr, or one for each block: ``flux_Cas_A``."""
        size = None if self.n_blocks == 1 else self.n_blocks
        return Unknown(f"flux_{self.name.replace(' ', '_')}", self.mean, self.std, size)

    def seen(self) -> np.ndarray:
        """Whether the source is ever above the horizon in each block: (blocks,) booleans.

        If not, only the prior constrains its flux.
        """
        return np.abs(np.asarray(self.columns)).max(0) > 0


class PointSources(Systematic):
    """Sources with independent Gaussian priors for their fluxes.

    The map is then the sky without them.

    Attributes
    ----------
    sources : tuple of Source
        The sources.
    """

    key: ClassVar[str] = "sources"
    words: ClassVar[str] = "the sources"
    unit: ClassVar[str] = "K sr"
    draw: ClassVar[int] = 5
    changes_coupling: ClassVar[bool] = False
    has_table: ClassVar[bool] = True

    sources: tuple[Source, ...]

    @classmethod
    def treatment(cls, scenario: Any) -> str | None:
        return scenario.sources.treatment if scenario.sources.list else None

    @classmethod
    def build(cls, section: SourcesSection, setup: Setup, around: Around) -> PointSources:
        sources = []
        for one, response in zip(section.list, setup.responses, strict=True):
            flux = one.mean_flux(setup.frequency_mhz)
            block = one.blocks(setup.observation)
            of_blocks = [
                np.where((block == b)[None], response, 0.0) for b in range(block.max() + 1)
            ]
            columns = np.stack([setup.layout.gather(seen) for seen in of_blocks], axis=1)
            sources.append(Source(columns, flux, one.relative_std * flux, one.name))
        return cls(tuple(sources))

    @classmethod
    def truth(cls, section: SourcesSection, setup: Setup, key: PRNGKeyArray) -> Truth:
        sources = cls.build(section, setup, Around()).sources
        keys = jax.random.split(cls.own_key(key), len(sources))
        truth: Truth = {}
        for source, k in zip(sources, keys, strict=True):
            z = np.asarray(jax.random.normal(k, (source.n_blocks,), dtype=np.float64))
            flux = float(source.mean) + float(source.std) * z
            truth[source.unknown.name] = flux if source.unknown.size else float(flux[0])
        return truth

    @property
    def unknowns(self) -> tuple[Unknown, ...]:
        return tuple(source.unknown for source in self.sources)

    def columns(self) -> Float[Array, "data amplitudes"]:
        """Return the responses of all sources and blocks side by side, in K per K sr."""
        columns = [source.columns for source in self.sources]
        return namespace(*columns).concatenate(columns, axis=1)

    def effect(self, model, values):
        """Add every source, with the flux of each block in K sr."""
        return with_added(model, self.columns() @ self.stacked(values))


def source_responses(
    sources: tuple[SourceSection, ...],
    observation: Observation,
    beams: BeamSource,
    frequency_mhz: float,
) -> tuple[Grid, ...]:
    """Response to 1 K sr of each of a scenario's sources, with these beams, in K.

    Sources need the exact pattern, which only the embedded antennas have.

    Responses are means over instants of each window, in which a source may rise and set.
    """
    if not sources:
        return ()
    instants, sample, weight = observation.at_nodes(SOURCE_NODES)
    first = np.searchsorted(sample, np.arange(observation.n_times))
    responses = (
        source_response(
            instants, one.direction(instants), frequency_mhz, beams.monopoles, stokes_v=one.stokes_v
        )
        for one in sources
    )
    return tuple(np.add.reduceat(np.asarray(r) * weight, first, axis=1) for r in responses)


def expected_signal(
    sources: tuple[SourceSection, ...],
    complete: CouplingMatrix,
    sky: Sky,
    background: Float[Array, "products *times"],
    responses: tuple[Grid, ...],
) -> Grid:
    """Visibilities of sky, background and sources with their mean fluxes, in K.

    Parameters
    ----------
    sources : tuple of SourceSection
    complete : CouplingMatrix
        A, for all products at all times.
    sky : Sky
    background : (products,) or (products, times) array
        In K.
    responses : tuple of (products, times) arrays
        As in :class:`.Setup`.
    """
    signal = complete.layout.scatter(complete @ sky.modes) + background.reshape(len(background), -1)
    for section, response in zip(sources, responses, strict=True):
        signal = signal + section.mean_flux(sky.frequency_mhz) * response
    return signal
