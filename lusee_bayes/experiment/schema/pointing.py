"""What is not known about clock and pointing."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from lusee_bayes.experiment.schema.section import Positive, Section, Treatment
from lusee_bayes.instrument.pointing_offsets import OFFSETS

# wider priors are none: the sky looks nothing like it did
Offset = Annotated[Positive, Field(le=45)]


class PointingSection(Section):
    """Offsets of clock and pointing: prior standard deviations of what has to be added.

    Attributes
    ----------
    clock_s : float
        Samples were taken later than their times say by so many seconds.
    clock_drift_s_per_day : float
        And later by so much more every day from the first sample on.
    turntable_deg : float
        Angle of the turntable, of every run on its own.
    lon_deg : float
        Longitude of the site.
    lat_deg : float
        Latitude of the site.
    tilt_east_deg : float
        Lean of the lander towards East.
    tilt_north_deg : float
        Lean of the lander towards North.
    treatment : {"marginalised", "sampled", "ignored"}
        Their covariance is added to N to first order, they are sampled with the map, or they are
        left out of the model.
    around : {"posterior", "model"}
        The sky and the offsets about which data depend on offsets to first order: those that the
        data tell, found in rounds, or the scenario's sky and none.
    true_values : dict
        What simulated data hold, by name (turntable_0_deg, ... where there are several runs);
        the others are drawn from their priors.
    """

    clock_s: Annotated[Positive, Field(le=1e6)] | None = None
    clock_drift_s_per_day: Annotated[Positive, Field(le=1e4)] | None = None
    turntable_deg: Offset | None = None
    lon_deg: Offset | None = None
    lat_deg: Offset | None = None
    tilt_east_deg: Offset | None = None
    tilt_north_deg: Offset | None = None
    treatment: Treatment = "marginalised"
    around: Literal["posterior", "model"] = "posterior"
    true_values: dict[str, Annotated[float, Field(ge=-1e6, le=1e6)]] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _something_is_not_known(self) -> PointingSection:
        if not self.kinds:
            raise ValueError(f"give a standard deviation of at least one of {', '.join(OFFSETS)}")
        return self

    @property
    def kinds(self) -> tuple[str, ...]:
        """What is not known."""
        return tuple(kind for kind in OFFSETS if getattr(self, kind) is not None)
