"""What a map run writes besides its maps."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from lusee_bayes.experiment.schema.section import Section


class OutputSection(Section):
    """Results that are written on request.

    Attributes
    ----------
    draws : int
        Number of posterior draws ``posterior.nc`` keeps.
    covariance : bool
        Keep the posterior covariance in ``posterior.nc``.
    updatable : bool
        Keep in ``posterior.nc`` what new data need to be added later.
    """

    draws: Annotated[int, Field(ge=0)] = 0
    covariance: bool = False
    updatable: bool = False
