"""Receivers, ground and gain table of a run of several frequencies, channel by channel."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import pandas as pd

from lusee_bayes.results.channel import ChannelResult
from lusee_bayes.results.unknowns import UnknownsReport


@dataclass(frozen=True)
class CubeUnknowns:
    """What is told of the unknowns of every channel.

    Attributes
    ----------
    reports : dict of UnknownsReport
        By frequency in MHz.
    octaves : float or None
        Over which receivers' spectra are smooth; None where every frequency has its own power.
    """

    reports: dict[float, UnknownsReport]
    octaves: float | None = None

    @classmethod
    def of(
        cls, channels: Iterable[ChannelResult], octaves: float | None = None
    ) -> CubeUnknowns | None:
        """Of a run's channels; None if they have no such unknowns."""
        reports = {c.frequency_mhz: c.unknowns for c in channels if c.unknowns is not None}
        return cls(reports, octaves) if reports else None

    @property
    def table(self) -> pd.DataFrame:
        """unknowns.csv: the channels' tables, one below the other, with ``frequency_mhz``."""
        tables = [report.table.copy() for report in self.reports.values()]
        for frequency, table in zip(self.reports, tables, strict=True):
            table.insert(0, "frequency_mhz", frequency)
        return pd.concat(tables, ignore_index=True)

    def lines(self) -> list[str]:
        """What a terminal shows: which of them, and which combination, the data do not tell."""
        n, untold = len(self.reports), dict[str, int]()
        for report in self.reports.values():
            for name in report.table["unknown"][~report.told]:
                untold[name] = untold.get(name, 0) + 1
        counts = [f"{name} (at {k} of {n} frequencies)" for name, k in untold.items()]
        what = f"do not tell {', '.join(counts)}" if counts else "tell all of them"
        first = f"Receivers, ground and gain table: the data {what}."
        found = [first]
        if self.octaves is not None:
            found.append(
                f"Powers of receivers are smooth over {self.octaves:g} octaves: every channel is "
                "given what the others tell of them."
            )
        sentence = self._null_sentence()
        return [*found, sentence] if sentence else found

    def _null_sentence(self) -> str:
        """Of the channel whose data leave most open; empty where all tell most of it."""
        nulls = {f: report.null for f, report in self.reports.items() if report.null is not None}
        left_open = [f for f, null in nulls.items() if null.sentence()]
        if not left_open:
            return ""
        worst = left_open[int(np.argmax([nulls[f].share for f in left_open]))]
        words, share = nulls[worst].words(), nulls[worst].share
        return (
            f"One combination of what looks alike is hardly told at {len(left_open)} of "
            f"{len(nulls)} frequencies. At {worst:g} MHz ({words}, in prior standard deviations) "
            f"it keeps {share:.0%} of its prior variance."
        )
