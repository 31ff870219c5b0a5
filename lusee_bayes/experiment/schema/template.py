"""What priors about a template have in common: which one, and that data may tell C_ell."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from lusee_bayes.core.reading import require_file
from lusee_bayes.experiment.schema.section import Megahertz, Positive, Section
from lusee_bayes.sky.template import EmbeddedTemplate, Template, read_template

# the template that no file is needed for
EMBEDDED = "embedded"
# where C_ell comes from
LEARNED, GIVEN = "learned from these data", "given in the scenario"


class TemplateSection(Section):
    """A template, and deviations whose C_ell is learned unless their amplitude is given."""

    model: str
    template: str = EMBEDDED
    file_frequency_mhz: Megahertz | None = None
    spectral_index: Annotated[float, Field(ge=-20, le=20)] = -2.5
    smoothing_deg: Annotated[float, Field(ge=0, le=180)] = 0.0
    amplitude: Positive | None = None

    def template_at(self, frequency_mhz: float, lmax: int) -> Template:
        """The embedded diffuse Galaxy, or what :func:`.read_template` makes of the file.

        Parameters
        ----------
        frequency_mhz : float
        lmax : int

        Raises
        ------
        InputError
            If there is no such file, and as :func:`.read_template`.
        """
        if not self.has_files:
            return EmbeddedTemplate(frequency_mhz)
        return read_template(
            require_file(self.template, "template of the prior", "check prior.template"),
            frequency_mhz,
            lmax,
            file_frequency_mhz=self.file_frequency_mhz,
            spectral_index=self.spectral_index,
            smoothing_deg=self.smoothing_deg,
        )

    @property
    def is_learned(self) -> bool:
        """Whether the data tell C_ell."""
        return self.amplitude is None

    @property
    def origin(self) -> str:
        """Where C_ell comes from."""
        return LEARNED if self.is_learned else GIVEN

    @property
    def has_files(self) -> bool:
        """Whether the prior is read from files, which are of one frequency."""
        return self.template != EMBEDDED

    @property
    def samples(self) -> bool:
        """Whether something besides the sky and its C_ell is to be sampled."""
        return False
