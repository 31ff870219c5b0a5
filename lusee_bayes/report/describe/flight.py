"""What is in sessions of the spectrometer, reduced spectra and gain tables."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lusee_bayes.flight.reduced import read_reduced
from lusee_bayes.flight.session_files import read_session


def describe_session(path: Path) -> str:
    """A session of luseepy's lusee.ingest."""
    first, *rest = read_session(path).description()
    return "\n".join([f"{path}: {first}", *(f"  {line}" for line in rest)])


def describe_reduced(path: Path) -> str:
    """Spectra reduced to bands and bins of time."""
    reduced = read_reduced(path)
    seen = reduced.observation
    lines = [f"{path}: reduced spectra", *(f"  {line}" for line in reduced.description())]
    lines.append(
        f"  {seen.times[0].isot[:19]} to {seen.times[-1].isot[:19]} UTC, longitude "
        f"{seen.lon_deg:g}, latitude {seen.lat_deg:g} degrees"
    )
    lines += [f"  {name}: {text}" for name, text in reduced.recipe.items()]
    lines += [f"  {note}" for note in reduced.notes()]
    for band, frequency in enumerate(reduced.frequencies_mhz):
        parts = [f"{name} {share:.2%}" for name, share in reduced.shares(band).items()]
        lines.append(f"  {frequency:g} MHz: {', '.join(parts)}")
    return "\n".join(lines)


def describe_gains(path: Path) -> str:
    """A gain table."""
    from lusee_bayes.flight.gain_model import read_gain_table

    table = read_gain_table(path)
    errors = "errors not known" if table.component_std is None else "errors known"
    mhz = table.anchor_mhz
    return (
        f"{path}: gains of levels L, M, H of {table.mean.shape[1]} ports, {mhz.min():g} to "
        f"{mhz.max():g} MHz, mean {np.median(table.mean):.3g} counts for 1 nV^2/Hz, {errors}"
    )
