"""Point sources that are not part of the map."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, model_validator

from lusee_bayes.experiment.schema.section import Positive, Section, Treatment


class SourceSection(Section):
    """A point source, apart from the map: one of the catalogue, a body of the solar system, or own.

    ``flux_jy`` is the mean of its prior (the catalogue's, if left out), ``relative_std`` its
    standard deviation in units of the mean. Own sources give ``ra_deg`` and ``dec_deg`` (ICRS).
    ``stokes_v``: circularly polarised part V / I, positive if right-handed (IAU). ``block_h``: an
    amplitude for each block of so many hours, independently; without it one for all times.
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
    """Point sources that are not part of the map: in N, sampled, or ignored."""

    list: tuple[SourceSection, ...] = ()
    treatment: Treatment = "marginalised"

    @model_validator(mode="after")
    def _names_differ(self) -> SourcesSection:
        names = [source.name for source in self.list]
        if len(set(names)) < len(names):
            twice = next(name for name in names if names.count(name) > 1)
            raise ValueError(f"the source '{twice}' is there twice")
        return self
