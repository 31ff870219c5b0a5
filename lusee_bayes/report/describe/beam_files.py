"""What is in beam files."""

from __future__ import annotations

from pathlib import Path

from lusee_bayes.instrument.beams import PortResponse, ScalarBeam
from lusee_bayes.instrument.beams.files import read_sampled
from lusee_bayes.instrument.beams.response_file import read_response
from lusee_bayes.instrument.beams.scalar_file import read_scalar_beam
from lusee_bayes.instrument.products import N_ANTENNAS, auto_indices


def describe_response(path: Path) -> str:
    """A four-port response."""
    response = read_response(path)
    known = response.frequencies_mhz
    middle = float(known[len(known) // 2])
    kelvin = response.per_kelvin(middle)
    emitted = response.background(middle, 1.0)[auto_indices()]
    return "\n".join(
        [
            f"{path}: the response of {N_ANTENNAS} coupled ports (luseepy)",
            *_grid_lines(response),
            f"  at {middle:g} MHz: impedance {_ohm(response.impedance[len(known) // 2][0, 0])}, "
            f"1 K is {kelvin.min():.4g} to {kelvin.max():.4g} V^2/Hz behind the receivers",
            f"  {float(emitted.mean()):.3f} of an auto comes from the Moon",
        ]
    )


def describe_scalar_beam(path: Path) -> str:
    """A scalar beam."""
    beam = read_scalar_beam(path)
    known = beam.frequencies_mhz
    middle = float(known[len(known) // 2])
    lines = [
        f"{path}: the beam of one arm (luseepy, scalar)",
        *_grid_lines(beam),
        f"  gain {beam.gain.min():.4g} to {beam.gain.max():.4g}",
    ]
    if beam.impedance is not None:
        lines.append(f"  impedance {_ohm(beam.impedance[len(known) // 2])} at {middle:g} MHz")
    ground = float(beam.background(middle, 1.0)[0])
    lines.append(f"  {ground:.3f} of the beam ends on the ground at {middle:g} MHz")
    return "\n".join(lines)


def describe_sampled_beams(path: Path) -> str:
    """Fields or beams in directions."""
    return f"{path}: {read_sampled(path)}"


def _grid_lines(beam: ScalarBeam | PortResponse) -> list[str]:
    known = beam.frequencies_mhz
    return [
        f"  {len(known)} frequencies from {known[0]:g} to {known[-1]:g} MHz",
        f"  {len(beam.theta)} angles from the zenith to the horizon, {beam.n_phi} azimuths",
    ]


def _ohm(z: complex) -> str:
    return f"{z.real:.4g} {'-' if z.imag < 0 else '+'} {abs(z.imag):.4g} i Ohm"
