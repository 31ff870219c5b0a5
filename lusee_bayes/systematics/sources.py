"""Point sources with known positions and unknown fluxes, which are not part of the map.

A source of x K sr adds x times the response to it. Fluxes have independent Gaussian priors; a
source may have one for each block of time.
"""

from __future__ import annotations

from typing import Annotated, Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float, Int
from pydantic import Field, model_validator

from lusee_bayes.core.arrays import Array, Grid
from lusee_bayes.core.errors import InputError, nearest
from lusee_bayes.core.section import Positive, Section, Treatment, requires
from lusee_bayes.instrument.beams.monopoles import source_response
from lusee_bayes.instrument.beams.source import BeamSource
from lusee_bayes.instrument.observation import BODIES, Observation, body_direction
from lusee_bayes.sky.galaxy import BRIGHT_SOURCES, galactic_unit_vector, kelvin_steradian
from lusee_bayes.systematics.context import Around, Setup
from lusee_bayes.systematics.systematic import Systematic, Unknown, with_added

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
            f"the source '{self.name}' is not in the catalogue; give flux_jy, the mean of its prior"
        )

    def direction(self, observation: Observation) -> Float[np.ndarray, "..."]:
        """Galactic unit vector(s): from its coordinates, the catalogue, or the ephemeris."""
        if self.ra_deg is not None:
            return galactic_unit_vector(self.ra_deg, self.dec_deg)
        if self.name in BODIES:
            return body_direction(self.name, observation)
        if (source := CATALOGUE.get(self.name)) is None:
            raise InputError(
                f"unknown source '{self.name}' without ra_deg and dec_deg;"
                f" {nearest(self.name, [*CATALOGUE, *BODIES])}"
            )
        return galactic_unit_vector(source.ra_deg, source.dec_deg)

    def blocks(self, observation: Observation) -> Int[np.ndarray, " times"]:
        """Number of the amplitude that belongs to each time."""
        if self.block_h is None:
            return np.zeros(observation.n_times, dtype=int)
        return np.unique(np.floor(observation.hours / self.block_h), return_inverse=True)[1]


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
        sites = [source.name.replace(" ", "_") for source in self.list]
        for source, site in zip(self.list, sites, strict=True):
            if sites.count(site) > 1:
                raise ValueError(f"the source '{source.name}' is listed twice")
        return self


class PointSources(Systematic):
    """Sources with independent Gaussian priors for their fluxes.

    The map is then the sky without them.

    Attributes
    ----------
    unknowns : tuple of Unknown
        A site for each source, ``flux_Cas_A``, with its flux in K sr, or that of each block.
    columns : (data, fluxes) array
        Response to 1 K sr of each source in each of its blocks of time, in K per K sr.
    """

    key, words, unit, draw = "sources", "the sources", "K sr", 5
    changes_coupling, has_table = False, True

    unknowns: tuple[Unknown, ...] = eqx.field()
    columns: Float[Array, "data fluxes"]

    @classmethod
    def treatment(cls, scenario: Any) -> str | None:
        return scenario.sources.treatment if scenario.sources.list else None

    @classmethod
    def build(cls, section: SourcesSection, setup: Setup, around: Around) -> PointSources:
        columns, unknowns = [], []
        for one, response in zip(section.list, setup.responses, strict=True):
            flux = np.float64(one.mean_flux(setup.frequency_mhz))
            n_blocks = int((block := one.blocks(setup.observation)).max()) + 1
            for number in range(n_blocks):
                columns.append(setup.layout.gather(np.where(block == number, response, 0.0)))
            site, size = f"flux_{one.name.replace(' ', '_')}", None if n_blocks == 1 else n_blocks
            unknowns.append(Unknown(site, flux, one.relative_std * flux, size))
        return cls(tuple(unknowns), np.stack(columns, axis=1))

    def drawn(self, key):
        """Draw the fluxes of every source with a separate key."""
        keys = zip(jax.random.split(key, len(self.unknowns)), self.unknowns, strict=True)
        return np.concatenate([jax.random.normal(one, (u.size or 1,)) for one, u in keys])

    def effect(self, model, values):
        """Add every source, with the flux of each block in K sr."""
        return with_added(model, self.columns @ self.stacked(values))


def source_responses(
    scenario: Any, observation: Observation, beams: BeamSource, frequency_mhz: float
) -> tuple[Grid, ...]:
    """Response to 1 K sr of each of a scenario's sources, with these beams, in K.

    Responses are means over instants of each window, in which a source may rise and set.
    """
    if not scenario.sources.list:
        return ()
    instants, sample, weight = observation.at_nodes(SOURCE_NODES)
    first, responses = np.searchsorted(sample, np.arange(observation.n_times)), []
    for one in scenario.sources.list:
        towards = one.direction(instants)
        seen = source_response(instants, towards, frequency_mhz, beams, stokes_v=one.stokes_v)
        responses.append(np.add.reduceat(np.asarray(seen) * weight, first, axis=1))
    return tuple(responses)
