"""What sampled runs and validations leave in JSON: it is read without what samples."""

from __future__ import annotations

from pydantic import BaseModel


class SamplingSummary(BaseModel):
    """sampling.json of a sampled run."""

    program: str
    chains: int
    draws: int
    divergences: int
    mean_acceptance: float
    doubts: list[str]
    step_size: list[float]
    mean_steps: float
    gradients_per_second: float | None
    seconds: dict[str, float]
    peak_memory_gb: float
    versions: dict[str, str]


class CheckSummary(BaseModel, from_attributes=True):
    """A check in validation.json; bounds that are not finite are null."""

    name: str
    value: float
    lower: float | None
    upper: float | None
    passed: bool
    meaning: str


class ValidationSummary(BaseModel):
    """validation.json: every check, and mode by mode what there is."""

    passed: bool
    checks: list[CheckSummary]
    modes: dict[str, list[float | None]]
    coverage: dict[str, dict[str, float]]
    p_values: dict[str, float]
