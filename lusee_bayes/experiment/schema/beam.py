"""The beams: one section for each kind, selected by ``model``.

A new kind is a class here, with its :class:`BeamSource`, and its name in ``BEAM_SECTIONS``.
"""

from __future__ import annotations

from dataclasses import replace
from functools import reduce
from operator import or_
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from pydantic import BeforeValidator, Field

from lusee_bayes.experiment.schema.receiver import ReceiverSection
from lusee_bayes.experiment.schema.section import (
    Angle,
    Positive,
    Section,
    Temperature,
    without_other_kinds,
)
from lusee_bayes.instrument.beams import (
    BeamSource,
    EmbeddedBeams,
    Monopoles,
    Regolith,
    ResponseBeams,
    SampledFileBeams,
    ScalarFileBeams,
)
from lusee_bayes.instrument.beams.files import kind_of, read_sampled
from lusee_bayes.instrument.beams.gridded import Interpolation
from lusee_bayes.instrument.beams.response_file import read_response
from lusee_bayes.instrument.beams.scalar_file import read_scalar_beam
from lusee_bayes.instrument.products import N_ANTENNAS


class MonopoleBeamSection(Section):
    """The embedded antennas: four monopoles over layered regolith.

    Attributes
    ----------
    length_m : float
        Length of an arm.
    zenith_angle_deg : float
        Angle of the arms from the zenith.
    height_m : float
        Height of the feed over the ground.
    surface_permittivity : float
        Permittivity of the regolith at the surface.
    deep_permittivity : float
        Permittivity of the regolith 100 m deep.
    loss_tangent : float
        Loss tangent of the regolith.
    turntable_offset_deg : float
        Added to every angle of the turntable, from East towards North.
    """

    is_file: ClassVar[bool] = False

    model: Literal["monopole"] = "monopole"
    length_m: Positive = 3.0
    zenith_angle_deg: Annotated[float, Field(gt=0, lt=180)] = 75.0
    height_m: Positive = 2.0
    surface_permittivity: Annotated[float, Field(ge=1, le=1e6)] = 3.7
    deep_permittivity: Annotated[float, Field(ge=1, le=1e6)] = 6.1
    loss_tangent: Annotated[float, Field(ge=0, le=1e6)] = 0.01
    turntable_offset_deg: Angle = 0.0

    @property
    def label(self) -> str:
        """Which antennas, for the header of a file."""
        return self.model

    @property
    def n_ports(self) -> int:
        """Number of antennas."""
        return N_ANTENNAS

    def source(self) -> BeamSource:
        """The antennas."""
        return EmbeddedBeams(
            Monopoles(
                regolith=Regolith(
                    self.surface_permittivity, self.deep_permittivity, self.loss_tangent
                ),
                length_m=self.length_m,
                zenith_angle_deg=self.zenith_angle_deg,
                height_m=self.height_m,
                turntable_offset_deg=self.turntable_offset_deg,
            )
        )


class _FileSection(Section):
    """What the beams of luseepy's files have in common."""

    is_file: ClassVar[bool] = True

    file: str
    turntable_offset_deg: Angle = 0.0
    quadrature: Literal["exact", "luseepy"] = "exact"
    interpolation: Interpolation = "linear"
    moon_temperature_k: Temperature = 0.0

    @property
    def label(self) -> str:
        """Which antennas, for the header of a file."""
        return Path(self.file).name


class ScalarBeamSection(_FileSection):
    """A scalar beam of luseepy: the pattern of one arm, used once for every port.

    Attributes
    ----------
    file : str
        FITS version 2.
    rotations_deg : tuple of float
        Angle of the pattern for each port, from East towards North; ``turntable_offset_deg`` is
        added.
    taper : bool
        Fade out towards the horizon as luseepy does.
    turntable_offset_deg : float
        Added to every angle of the turntable, from East towards North.
    quadrature : {"exact", "luseepy"}
        ``luseepy`` is luseepy's own rule, for data that luseepy has made.
    interpolation : {"linear", "spline"}
        Between the file's frequencies: products of fields linearly as in luseepy, or fields by
        cubic splines.
    moon_temperature_k : float
        Temperature of the ground, which adds its own radiation.
    """

    model: Literal["luseepy"] = "luseepy"
    taper: bool = True
    rotations_deg: Annotated[tuple[Angle, ...], Field(min_length=1)] = (0.0, 90.0, 180.0, 270.0)

    @property
    def n_ports(self) -> int:
        """Number of ports."""
        return len(self.rotations_deg)

    def source(self) -> BeamSource:
        """The pattern of the file, turned to every angle."""
        return ScalarFileBeams(
            replace(read_scalar_beam(self.file), interpolation=self.interpolation),
            turntable_offset_deg=self.turntable_offset_deg,
            taper=self.taper,
            rotations_deg=self.rotations_deg,
            luseepy_quadrature=self.quadrature == "luseepy",
            moon_k=self.moon_temperature_k,
        )


class ResponseSection(_FileSection):
    """A four-port response of luseepy: coupled antennas with their receivers.

    Attributes
    ----------
    file : str
        FITS version 3.
    interpolation : {"linear", "spline"}
        Between the file's frequencies: impedances and products of fields linearly as in luseepy, or
        impedances and fields by cubic splines.
    receiver : {"jfet", "capacitor", "file", "open"} or mapping, optional
        What is connected to the ports, with its parameters (``experiment/schema/receiver.py``). If
        it is left out, that of the data where their file holds it, else luseepy's preamplifiers.
    turntable_offset_deg : float
        Added to every angle of the turntable, from East towards North.
    quadrature : {"exact", "luseepy"}
        ``luseepy`` is luseepy's own rule, for data that luseepy has made.
    moon_temperature_k : float
        Temperature of the ground, which adds its own radiation.
    antenna_temperature_k : float
        Temperature of the antennas' losses, which add their own radiation.
    """

    model: Literal["response"] = "response"
    receiver: ReceiverSection | None = None
    antenna_temperature_k: Temperature = 0.0

    @property
    def n_ports(self) -> int:
        """Number of ports."""
        return N_ANTENNAS

    def source(self) -> BeamSource:
        """The response of the file, with its receivers."""
        response = replace(read_response(self.file), interpolation=self.interpolation)
        if self.receiver is not None:
            response = replace(response, receiver=self.receiver.receiver())
        return ResponseBeams(
            response,
            receiver_said=self.receiver is not None,
            turntable_offset_deg=self.turntable_offset_deg,
            luseepy_quadrature=self.quadrature == "luseepy",
            moon_k=self.moon_temperature_k,
            antenna_k=self.antenna_temperature_k,
        )


class SampledBeamSection(Section):
    """Beams of one's own in directions: fields of antennas or beams of products, or a UVBeam.

    Attributes
    ----------
    file : str
        netCDF or FITS of :func:`lusee_bayes.sampled_beams`, or pyuvdata's beam FITS.
    turntable_offset_deg : float
        By how much the turntable is further round than it says, from East towards North.
    normalise : bool
        Scale the beams so that autos integrate to one on average; by default as the file says.
    """

    is_file: ClassVar[bool] = True

    model: Literal["sampled"] = "sampled"
    file: str
    turntable_offset_deg: float = 0.0
    normalise: bool | None = None

    @property
    def label(self) -> str:
        """Which antennas, for the header of a file."""
        return Path(self.file).name

    @property
    def n_ports(self) -> int:
        """Number of ports."""
        return read_sampled(self.file).n_ports

    def source(self) -> BeamSource:
        """The beams of the file."""
        return SampledFileBeams(read_sampled(self.file), self.turntable_offset_deg, self.normalise)


BEAM_SECTIONS = {
    section.model_fields["model"].default: section
    for section in (MonopoleBeamSection, ScalarBeamSection, ResponseSection, SampledBeamSection)
}


def _one_kind(value: Any) -> Any:
    """``beam: {file: ...}`` without a model, as scenarios had it before: the file tells."""
    if not isinstance(value, dict):
        return value
    tree = dict(value)
    default = MonopoleBeamSection.model_fields["model"].default
    tree["model"] = tree.get("model") or default
    file = tree.get("file")
    if tree["model"] == default and file is not None:
        tree["model"] = kind_of(file) if isinstance(file, str) else "luseepy"
    if tree["model"] != "response" and tree.get("receiver") == "jfet":
        del tree["receiver"]  # scenarios of 0.1 held all keys of all kinds
    temperatures = ("moon_temperature_k", "antenna_temperature_k")
    if tree["model"] == default and any(tree.get(name) for name in temperatures):
        raise ValueError(
            "the beams of the embedded antennas are scaled to the sky alone: temperatures of "
            "Moon and antennas need beam.file"
        )
    if tree["model"] == "luseepy" and tree.get("antenna_temperature_k"):
        raise ValueError(
            f"{file} is a scalar beam, which knows of no losses; leave out "
            "beam.antenna_temperature_k"
        )
    return without_other_kinds(tree, BEAM_SECTIONS, strict=True)


BeamSection = Annotated[
    reduce(or_, BEAM_SECTIONS.values()), Field(discriminator="model"), BeforeValidator(_one_kind)
]


def section_of_file(file: str, like: Any) -> Any:
    """The section of another beam file, turned as the beams of ``like`` are."""
    kind = BEAM_SECTIONS[kind_of(file)]
    shared = {
        name: value
        for name, value in like.model_dump().items()
        if name in kind.model_fields and name not in ("model", "file")
    }
    return kind(file=file, **shared)
