"""The information in an observation, from the posterior covariance alone: no data are needed.

C = Lambda^-1 does not depend on d. It gives three numbers:

- information, ln|S C^-1| / 2 = ln|Lambda| / 2 of the white posterior: the mean of
  ln p(m | d) / p(m) over skies and data of the model;
- modes with SNR > 1: independent directions of the sky with (S - C) / C > 1, i.e. whose posterior
  variance is less than half of the prior's. They are eigenvectors of C relative to S, so their
  number does not depend on the basis of m;
- the expected SNR_ell. Over skies and data of the model, S = Cov(mean) + C: the mean map has
  covariance S - C and its error C. SNR_ell^2 (:func:`.measures.signal_to_noise`) is the ratio of
  sum_m mean^2 to sum_m (mean - m)^2, whose expectations are sum_m (S - C) and sum_m C.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

from lusee_bayes.core.arrays import Ells
from lusee_bayes.experiment.scenario import Scenario
from lusee_bayes.judge.measures import ell_cross

AS_GIVEN = "as given"


@dataclass(frozen=True)
class Variation:
    """A scenario to be compared with others.

    source : original scenario; family, name : what differs; lost : dead ports, whose products are
    all flagged
    """

    source: str
    family: str
    name: str
    scenario: Scenario
    lost: tuple[int, ...] = ()


@dataclass(frozen=True)
class Forecast:
    """The information in a variation.

    days : of observing; n_data : samples of all products; information_bits : about the whole sky;
    modes : how many have SNR > 1; snr_squared : (ells,) expected SNR_ell^2 for ell = 0..lmax;
    resolution_deg : as in a map's summary, 180 degrees over the first ell whose variance comes
    mostly from the prior, or None; offsets : expected standard deviations of the model's clock and
    pointing offsets, by name; unnoticed : largest instrument errors outside the model that the
    residual chi^2 would not reveal, each with the rms shift of the map in standard deviations
    """

    variation: Variation
    days: float
    n_data: int
    information_bits: float
    modes: int
    snr_squared: Ells
    resolution_deg: float | None
    offsets: dict[str, float] = field(default_factory=dict)
    unnoticed: str = ""

    def offsets_line(self) -> str:
        """Expected errors of clock and pointing; empty if the model has no such offsets."""
        return ", ".join(f"{name} +- {std:.2g}" for name, std in self.offsets.items())

    @property
    def ell_cross(self) -> int | None:
        """The first ell >= 1 with an expected SNR_ell below 1; None if there is none."""
        return ell_cross(self.snr_squared)


def forecast_lines(forecasts: Sequence[Forecast]) -> list[str]:
    """The information in a scenario as given, and its most informative variation.

    Parameters
    ----------
    forecasts : sequence of Forecast
        All of one source, the unchanged scenario first.
    """
    first, best = forecasts[0], max(forecasts, key=lambda one: one.information_bits)
    source = first.variation.source
    text = f"{source}: {first.information_bits:.0f} bits, {first.modes} modes with expected SNR > 1"
    if best.information_bits > first.information_bits:
        more = best.information_bits - first.information_bits
        text += f"; most: {best.variation.family}, {best.variation.name}: +{more:.0f} bits"
    offsets = first.offsets_line()
    lines = [text, f"{source}: {offsets}"] if offsets else [text]
    if first.variation.scenario.prior.is_learned:
        learned = "with the expected prior; a map, which learns it, may differ by 40 %"
        lines.append(f"{source}: {learned}")
    return lines + [
        f"{source}, {one.variation.name}: residual chi2 would not reveal errors up to these (in "
        f"brackets, the map's error in standard deviations, rms over directions): {one.unnoticed}"
        for one in forecasts
        if one.unnoticed
    ]


def forecast_rows(forecasts: Sequence[Forecast]) -> list[dict[str, object]]:
    """Rows of plan.csv; ``difference_bits`` is relative to the same source's first variation."""
    rows, first = [], {row.variation.source: row for row in reversed(forecasts)}
    for row in forecasts:
        it, resolution = row.variation, row.resolution_deg
        columns = {
            "scenario": it.source,
            "family": it.family,
            "variation": it.name,
            "days": f"{row.days:.2f}",
            "n_data": row.n_data,
            "information_bits": f"{row.information_bits:.2f}",
            "difference_bits": f"{row.information_bits - first[it.source].information_bits:.2f}",
            "modes_snr_above_1": row.modes,
            "ell_cross": "none" if row.ell_cross is None else row.ell_cross,
            "resolution_deg": "none" if resolution is None else f"{resolution:.2f}",
            "clock_and_pointing": row.offsets_line().replace(",", ";"),
            "unnoticed_errors": row.unnoticed.replace(",", ";"),
        }
        rows.append(columns)
    return rows
