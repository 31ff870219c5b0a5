"""What is connected to the ports of a response: one section for each kind, told by ``model``."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field

from lusee_bayes.experiment.schema.section import LARGEST, Positive, Section
from lusee_bayes.instrument.beams.receiver import (
    CapacitorReceiver,
    JFETReceiver,
    Receiver,
    read_receiver,
)
from lusee_bayes.instrument.products import N_ANTENNAS


def _each_port(value: Any) -> Any:
    """One number stands for all ports."""
    number = isinstance(value, int | float) and not isinstance(value, bool)
    return (value,) * N_ANTENNAS if number else value


def _ports(entry: Any) -> Any:
    four = Field(min_length=N_ANTENNAS, max_length=N_ANTENNAS)
    return Annotated[tuple[entry, ...], four, BeforeValidator(_each_port)]


NotNegative = Annotated[float, Field(ge=0, le=LARGEST)]
_JFET, _CAPACITOR = JFETReceiver(), CapacitorReceiver()


class JFETSection(Section):
    """luseepy's preamplifiers; every entry is one number, or one for each port.

    Attributes
    ----------
    capacitance_pf : tuple of float
        Capacitance.
    inductance_nh : tuple of float
        Inductance.
    parallel_ohm : tuple of float
        Parallel resistance.
    series_ohm : tuple of float
        Series resistance.
    skin_ohm : tuple of float
        Resistance of the skin effect.
    skin_power : tuple of float
        Power of the frequency in the skin effect.
    """

    model: Literal["jfet"] = "jfet"
    capacitance_pf: _ports(Positive) = _JFET.capacitance_pf
    inductance_nh: _ports(NotNegative) = _JFET.inductance_nh
    parallel_ohm: _ports(Positive) = _JFET.parallel_ohm
    series_ohm: _ports(NotNegative) = _JFET.series_ohm
    skin_ohm: _ports(NotNegative) = _JFET.skin_ohm
    skin_power: _ports(Annotated[float, Field(ge=-10, le=10)]) = _JFET.skin_power

    def receiver(self) -> Receiver | None:
        """The receiver, or None for open ports."""
        return JFETReceiver(**self.model_dump(exclude={"model"}))


class CapacitorSection(Section):
    """Capacitors: one number, or one for each port.

    Attributes
    ----------
    capacitance_pf : tuple of float
        Capacitance.
    """

    model: Literal["capacitor"] = "capacitor"
    capacitance_pf: _ports(Positive) = _CAPACITOR.capacitance_pf

    def receiver(self) -> Receiver | None:
        """The receiver, or None for open ports."""
        return CapacitorReceiver(self.capacitance_pf)


class ReceiverFileSection(Section):
    """Loads from a file: images ``freq``, ``ZL_real`` and ``ZL_imag``.

    Attributes
    ----------
    file : str
        Path of the file.
    """

    model: Literal["file"] = "file"
    file: str

    def receiver(self) -> Receiver | None:
        """The receiver, or None for open ports."""
        return read_receiver(self.file)


class OpenSection(Section):
    """Nothing."""

    model: Literal["open"] = "open"

    def receiver(self) -> Receiver | None:
        """The receiver, or None for open ports."""
        return None


def _named(value: Any) -> Any:
    """``receiver: open`` is ``receiver: {model: open}``."""
    return {"model": value} if isinstance(value, str) else value


ReceiverSection = Annotated[
    JFETSection | CapacitorSection | ReceiverFileSection | OpenSection,
    Field(discriminator="model"),
    BeforeValidator(_named),
]
