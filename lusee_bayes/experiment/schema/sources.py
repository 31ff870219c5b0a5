"""Point sources that are not part of the map."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, model_validator

from lusee_bayes.experiment.schema.section import Positive, Section, Treatment


class SourceSection(Section):
    """A point source, apart from the map: one of the catalogue, a body of the solar system, or own.

    Attributes
    ----------
    name : str
        Of the catalogue (Cas A, ...), of a body (Sun, Jupiter, ...), or any other with a position.
    flux_jy : float
        Mean of the prior on its flux density; by default the catalogue's.
    relative_std : float
        Standard deviation of that prior over its mean.
    ra_deg : float
        Right ascension of an own source (ICRS).
    dec_deg : float
        Declination of an own source (ICRS).
    stokes_v : float
        Circularly polarised fraction V / I, positive if right-handed (IAU).
    block_h : float
        Length of blocks of time that have independent amplitudes; by default one for all times.
    """

    name: str
    flux_jy: Positive | None = None
    relative_std: Positive = 0.5
    ra_deg: Annotated[float, Field(ge=-360, le=360)] | None = None
    dec_deg: Annotated[float, Field(ge=-90, le=90)] | None = None
    stokes_v: Annotated[float, Field(ge=-1, le=1)] = 0.0
    block_h: Positive | None = None

    @model_validator(mode="after")
    def _both_coordinates(self) -> SourceSection:
        if (self.ra_deg is None) != (self.dec_deg is None):
            raise ValueError("give both ra_deg and dec_deg, or none")
        return self


class SourcesSection(Section):
    """Point sources that are not part of the map: in N, sampled, or ignored.

    Attributes
    ----------
    list : tuple of SourceSection
        The sources.
    treatment : {"marginalised", "sampled", "ignored"}
        Their covariance is added to N, their fluxes are sampled with the map, or they are left out
        of the model.
    """

    list: tuple[SourceSection, ...] = ()
    treatment: Treatment = "marginalised"

    @model_validator(mode="after")
    def _names_differ(self) -> SourcesSection:
        names = [source.name for source in self.list]
        if len(set(names)) < len(names):
            twice = next(name for name in names if names.count(name) > 1)
            raise ValueError(f"the source '{twice}' is there twice")
        return self
