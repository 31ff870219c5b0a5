"""Contents of the JSON files in run folders: written by runs, read back by pages."""

from typing import Any

from pydantic import BaseModel, field_validator

from lusee_bayes.experiment.diagnosis import Diagnosis
from lusee_bayes.experiment.unknowns import InstrumentPosterior, PointingReport, UnknownsReport
from lusee_bayes.judge.chi2 import ChiSquare, Level
from lusee_bayes.judge.coverage import Coverage
from lusee_bayes.judge.cube_fit import JointTest, SharedTest


class JudgedSummary(BaseModel, from_attributes=True):
    """How well the data of a channel fit, in summary.json."""

    level: Level
    verdict: str
    prior: ChiSquare
    extremes: list[str]
    suspects: list[str]


class ChannelSummary(BaseModel, from_attributes=True):
    """Figures of a channel in summary.json; null where unknown."""

    frequency_mhz: float
    instrument: ChiSquare
    judged: JudgedSummary | None
    diagnosis: Diagnosis | None
    ell_cross: int | None
    resolution_deg: float | None
    log_evidence: float | None
    information_bits: float | None
    chi2: float
    chi2_expected: float
    chi2_model: float | None
    refinement: float | None
    n_data: int
    n_missing: int
    rounds: int
    never_observed: float
    beam_rms_difference: float | None
    prior: str
    parameters: list[dict[str, Any]]
    log_evidence_learned: float | None
    coverage: tuple[Coverage, ...]
    unknowns: dict[str, Any] | None
    theta: dict[str, Any] | None = None
    pointing: list[dict[str, Any]] | None
    doubts: list[str]

    @field_validator("unknowns", "theta", "pointing", mode="before")
    @classmethod
    def _as_rows(cls, value: Any) -> Any:
        if isinstance(value, PointingReport):
            return None if value.offsets is None else value.offsets.to_dict("records")
        return value.summary() if isinstance(value, UnknownsReport | InstrumentPosterior) else value


class JointSummary(BaseModel, from_attributes=True):
    """Figures of a joint posterior in summary.json."""

    prior: str
    components: tuple[str, ...]
    solver: str
    iterations: int
    chi2: float
    log_evidence: float
    information_bits: float
    refinement: float


class PullSummary(BaseModel):
    """How far the spectrum of a direction is from the truth, in standard deviations."""

    direction: str
    rms: float
    worst: float
    worst_mhz: float


class MapSummary(BaseModel):
    """Contents of summary.json of a map run."""

    frequencies_mhz: list[float]
    unmapped: list[str]
    joint: JointSummary | None
    tied: bool
    level: Level
    verdict: str
    log_evidence: float
    n_data: int
    n_modes: int
    doubts: list[str]
    notes: list[str] = []
    tests: list[JointTest]
    shared: list[SharedTest] = []
    pulls: list[PullSummary]
    unknowns: list[str]
    channels: list[ChannelSummary]
    seconds: dict[str, float]
    peak_memory_gb: float
    versions: dict[str, str]


class SamplingSummary(BaseModel):
    """Contents of sampling.json of a sampled run."""

    program: str
    chains: int
    draws: int
    divergences: int
    mean_acceptance: float
    doubts: list[str]
    step_size: list[float]
    mean_steps: float
    steps_per_second: float | None
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
    """Contents of validation.json: every check, and the statistics of each mode."""

    passed: bool
    checks: list[CheckSummary]
    modes: dict[str, list[float | None]]
    coverage: dict[str, dict[float, float]]
    p_values: dict[str, float]
