"""The sky: one section for each kind, selected by ``model``.

A new kind is a class here, with its :class:`SkySource`, and its name in ``SKY_SECTIONS``.
"""

from __future__ import annotations

from functools import reduce
from operator import or_
from typing import Annotated, Any, ClassVar, Literal

from pydantic import BeforeValidator, Field

from lusee_bayes.experiment.schema.section import Megahertz, Section, Seed, without_other_kinds
from lusee_bayes.sky import BRIGHT_SOURCES, FileSource, GalaxySource, SkySource


class GalaxySection(Section):
    """The embedded Galaxy.

    Attributes
    ----------
    seed : int
        Seed of the random small scales.
    sources : bool
        Add the brightest point sources.
    """

    has_sources: ClassVar[bool] = True

    model: Literal["galaxy"] = "galaxy"
    seed: Seed = 1
    sources: bool = True

    def source(self) -> SkySource:
        """The embedded Galaxy with these sources."""
        return GalaxySource(self.seed, BRIGHT_SOURCES if self.sources else ())


class FileSkySection(Section):
    """A sky from a file: ULSA's HDF5, HEALPix FITS, luseepy's FITS of many maps, coefficients.

    Attributes
    ----------
    file : str
        Path of the file.
    dataset : str
        Data set of an HDF5 file.
    file_frequency_mhz : float
        Frequency that the file was made for; by default the scenario's. Of a file with many
        frequencies, this one is taken.
    spectral_index : float
        Scales the sky from ``file_frequency_mhz`` to the scenario's frequency.
    """

    model: Literal["file"] = "file"
    file: str
    dataset: str | None = None
    file_frequency_mhz: Megahertz | None = None
    spectral_index: Annotated[float, Field(ge=-20, le=20)] = -2.5

    @property
    def sources(self) -> bool:
        """Whether the catalogue's sources are added: they are in the file, if at all."""
        return False

    def source(self) -> SkySource:
        """The file."""
        return FileSource(
            self.file,
            dataset=self.dataset,
            file_frequency_mhz=self.file_frequency_mhz,
            spectral_index=self.spectral_index,
        )


SKY_SECTIONS = {
    section.model_fields["model"].default: section for section in (GalaxySection, FileSkySection)
}


def _one_kind(value: Any) -> Any:
    """``sky: {file: ...}`` without a model, as scenarios had it before."""
    if not isinstance(value, dict):
        return value
    tree = dict(value)
    default = GalaxySection.model_fields["model"].default
    tree["model"] = tree.get("model") or default
    if tree["model"] == default and tree.get("file") is not None:
        tree["model"] = "file"
    # the sources of the embedded sky were said beside a file, too, where they had no effect
    return without_other_kinds(tree, SKY_SECTIONS, strict=False)


SkySection = Annotated[
    reduce(or_, SKY_SECTIONS.values()), Field(discriminator="model"), BeforeValidator(_one_kind)
]
