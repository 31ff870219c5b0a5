"""What info says of data, sessions, gain tables and beams, as lines."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from lusee_bayes.flight.gain_model import read_gain_table
from lusee_bayes.flight.reduced import read_reduced
from lusee_bayes.flight.session_files import read_session
from lusee_bayes.instrument.beams import luseepy_files
from lusee_bayes.instrument.beams.sampled import read_sampled
from lusee_bayes.instrument.products import N_ANTENNAS, auto_indices, labels
from lusee_bayes.instrument.visibilities import Visibilities, read_visibilities
from lusee_bayes.instrument.waterfalls import read_waterfall


def describe_response(path: Path) -> list[str]:
    """A four-port response."""
    response = luseepy_files.read_response(path)
    known = response.frequencies_mhz
    middle = float(known[len(known) // 2])
    kelvin = response.per_kelvin(middle)
    emitted = replace(response, moon_k=1.0).background(middle)[auto_indices()]
    return [
        f"the response of {N_ANTENNAS} coupled ports (luseepy)",
        *_grid_lines(response),
        f"at {middle:g} MHz: impedance {_ohm(response.impedance_ohm[len(known) // 2][0, 0])}, "
        f"1 K is {kelvin.min():.4g} to {kelvin.max():.4g} V^2/Hz behind the receivers",
        f"{float(emitted.mean()):.3f} of an auto comes from the Moon",
    ]


def describe_scalar_beam(path: Path) -> list[str]:
    """A scalar beam."""
    beam = luseepy_files.read_scalar_beam(path)
    known = beam.frequencies_mhz
    middle = float(known[len(known) // 2])
    lines = [
        "the beam of one arm (luseepy, scalar)",
        *_grid_lines(beam),
        f"gain {beam.gain.min():.4g} to {beam.gain.max():.4g}",
    ]
    if beam.impedance_ohm is not None:
        lines.append(f"impedance {_ohm(beam.impedance_ohm[len(known) // 2])} at {middle:g} MHz")
    ground = float(replace(beam, moon_k=1.0).background(middle)[0])
    lines.append(f"{ground:.3f} of the beam ends on the ground at {middle:g} MHz")
    return lines


def describe_sampled_beams(path: Path) -> list[str]:
    """Fields or beams in directions."""
    return [str(read_sampled(path))]


def _grid_lines(beam: luseepy_files.ScalarBeam | luseepy_files.PortResponse) -> list[str]:
    known = beam.frequencies_mhz
    return [
        f"{len(known)} frequencies from {known[0]:g} to {known[-1]:g} MHz",
        f"{len(beam.theta)} angles from the zenith to the horizon, {beam.n_phi} azimuths",
    ]


def _ohm(z: complex) -> str:
    return f"{z.real:.4g} {'-' if z.imag < 0 else '+'} {abs(z.imag):.4g} i Ohm"


def describe_visibilities(path: Path) -> list[str]:
    """Visibilities at one frequency."""
    data = read_visibilities(path)
    observation = data.observation
    grid = data.grid()
    autos = grid[[k for k, label in enumerate(data.labels) if label[0] == label[1]]]
    return [
        f"visibilities at {data.frequency_mhz:g} MHz",
        f"{data.layout.n_products} products ({data.labels[0]} ... {data.labels[-1]}), "
        f"{data.layout.n_times} times of {observation.step_s:g} s, {data.n_missing} samples "
        "missing",
        _windows(data),
        f"{observation.times[0].isot} to {observation.times[-1].isot} UTC, "
        f"{observation.n_runs} run(s) at turntable {observation.turntable_deg} degrees",
        f"site: longitude {observation.lon_deg}, latitude {observation.lat_deg} degrees",
        f"autos {np.nanmin(autos):.4g} to {np.nanmax(autos):.4g} K",
        f"true sky {'included' if data.truth is not None else 'not known'}",
    ]


def _windows(data: Visibilities) -> str:
    """What its times are."""
    windows = data.observation.windows
    if not data.says_window:
        return "the file does not say what its times are: --set observation.timestamp=..."
    if windows is None:
        return "times are instants"
    bounds, live = windows.bounds_s, windows.live_per_sample_s
    length = bounds[:, 1] - bounds[:, 0]
    several = len(windows.sample) - windows.n_samples
    in_pieces = f" in {len(windows.sample)} pieces" if several else ""
    return (
        f"times are middles of windows of {_range(length)} s{in_pieces}, live for "
        f"{live.sum() / length.sum():.1%} of them"
    )


def _range(values: Float[np.ndarray, " samples"]) -> str:
    low, high = (f"{x:.6g}" for x in (values.min(), values.max()))
    return low if low == high else f"{low} to {high}"


def describe_waterfall(path: Path) -> list[str]:
    """A waterfall of luseepy."""
    waterfall = read_waterfall(path)
    grid, observation = waterfall.grid, waterfall.observation
    here = ~np.isnan(grid).all((1, 2))
    names = [name for name, there in zip(labels(), here, strict=True) if there]
    gaps = int(np.isnan(grid[here]).sum())
    four_port = []
    if (kelvin := waterfall.per_kelvin) is not None:
        four_port = [
            f"in V^2/Hz: 1 K is {kelvin.min():.4g} to {kelvin.max():.4g} of them",
            f"with the emission of the Moon at {waterfall.moon_k:.15g} K",
        ]
    return [
        "a waterfall of luseepy" + (", four ports" if four_port else ""),
        f"channels at {', '.join(f'{f:.9g}' for f in waterfall.frequencies_mhz)} MHz",
        f"{len(names)} products ({' '.join(names)}), {observation.n_times} times of "
        f"{observation.step_s:g} s, {gaps} samples missing",
        "times are instants, unless observation.timestamp says otherwise",
        f"{observation.times[0].isot} to {observation.times[-1].isot} UTC",
        f"site: longitude {observation.lon_deg}, latitude {observation.lat_deg} degrees",
        *four_port,
    ]


def describe_session(path: Path) -> list[str]:
    """A session of luseepy's lusee.ingest."""
    return [*read_session(path).description()]


def describe_reduced(path: Path) -> list[str]:
    """Spectra reduced to bands and bins of time."""
    reduced = read_reduced(path)
    seen = reduced.observation
    lines = ["reduced spectra", *reduced.description()]
    lines.append(
        f"{seen.times[0].isot[:19]} to {seen.times[-1].isot[:19]} UTC, longitude "
        f"{seen.lon_deg:g}, latitude {seen.lat_deg:g} degrees"
    )
    lines += [f"{name}: {text}" for name, text in reduced.recipe.items()]
    lines += reduced.notes()
    for band, frequency in enumerate(reduced.frequencies_mhz):
        parts = [f"{name} {share:.2%}" for name, share in reduced.shares(band).items()]
        lines.append(f"{frequency:g} MHz: {', '.join(parts)}")
    return lines


def describe_gains(path: Path) -> list[str]:
    """A gain table."""
    table = read_gain_table(path)
    errors = "errors not known" if table.component_std is None else "errors known"
    mhz = table.anchor_mhz
    return [
        f"gains of levels L, M, H of {table.mean.shape[1]} ports, {mhz.min():g} to "
        f"{mhz.max():g} MHz, mean {np.median(table.mean):.3g} counts for 1 nV^2/Hz, {errors}"
    ]
