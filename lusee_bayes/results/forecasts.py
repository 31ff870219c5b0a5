"""Forecasts of many variations, each kept in a file as soon as it is made."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np

from lusee_bayes.core.engine import Engine, Tasks
from lusee_bayes.core.files import replacing
from lusee_bayes.core.progress import Stages
from lusee_bayes.core.version import __version__
from lusee_bayes.results.cost import duration
from lusee_bayes.results.forecast import Forecast, Variation
from lusee_bayes.runs.forecasting import forecast


@dataclass(frozen=True)
class ForecastFiles:
    """Unfinished work of a plan: a JSON file for each forecast that is made.

    Attributes
    ----------
    folder : Path
    """

    folder: Path

    def forecast(self, variation: Variation) -> Forecast:
        """Read the forecast of a variation, or make it and write it, whole or not at all."""
        path = self.folder / f"{_digest(variation)}.json"
        if path.is_file():
            kept = json.loads(path.read_text(encoding="utf-8"))
            kept["snr_squared"] = np.array(kept["snr_squared"], dtype=np.float64)
            return Forecast(variation=variation, **kept)
        made = forecast(variation)
        names = (field.name for field in fields(Forecast) if field.name != "variation")
        kept = {name: getattr(made, name) for name in names}
        kept["snr_squared"] = np.asarray(made.snr_squared).tolist()
        with replacing(path) as partial:
            partial.write_text(json.dumps(kept), encoding="utf-8")
        return made


def _digest(variation: Variation) -> str:
    """Of all that a forecast depends on."""
    parts = [variation.scenario.to_yaml(), list(variation.lost), __version__]
    return hashlib.sha256(json.dumps(parts).encode()).hexdigest()[:32]


def forecasts_of(
    variations: Sequence[Variation], files: ForecastFiles, engine: Engine, stages: Stages
) -> list[Forecast]:
    """Make a forecast of every variation; what is there twice is computed once.

    Parameters
    ----------
    variations : sequence of Variation
    files : ForecastFiles
        What an interrupted plan has made is taken from them.
    engine : Engine
    stages : Stages
        Told how many there are, and after the first about how long the others take.

    Returns
    -------
    list of Forecast
        In the order of the variations.

    Raises
    ------
    InputError
        As :func:`.forecast`.
    """
    # workers may have other folders of their own
    anchored = [replace(v, scenario=v.scenario.anchored()) for v in variations]
    different: dict[str, Variation] = {}
    for variation in anchored:
        different.setdefault(_digest(variation), variation)
    stages.say(f"  {len(variations)} variations, {len(different)} of them different")
    first, *others = different.values()
    start = time.perf_counter()
    with stages("first forecast"):
        found = [files.forecast(first)]
    if others:
        longest = len(others) * (time.perf_counter() - start)
        stages.say(f"  the other {len(others)} take about {duration(longest)}, or less")
        names = [f"{other.source}, {other.name}" for other in others]
        found += engine.each(Tasks(files.forecast, others, names), stages, "planning")
    known = {_digest(one.variation): one for one in found}
    return [
        replace(known[_digest(there)], variation=here)
        for here, there in zip(variations, anchored, strict=True)
    ]
