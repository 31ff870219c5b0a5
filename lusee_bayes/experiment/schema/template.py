"""The template that a prior's entries name."""

from __future__ import annotations

from lusee_bayes.core.reading import require_file
from lusee_bayes.sky.template import EmbeddedTemplate, Template, read_template

# the template that no file is needed for
EMBEDDED = "embedded"


def template_of(
    name: str,
    frequency_mhz: float,
    lmax: int,
    *,
    file_frequency_mhz: float | None,
    spectral_index: float,
    smoothing_deg: float,
) -> Template:
    """The embedded diffuse Galaxy, or what :func:`.read_template` makes of a file.

    Parameters
    ----------
    name : str
        ``embedded``, or the path of the file.
    frequency_mhz : float
    lmax : int
    file_frequency_mhz, spectral_index, smoothing_deg
        As :func:`.read_template`.

    Raises
    ------
    InputError
        If there is no such file, and as :func:`.read_template`.
    """
    if name == EMBEDDED:
        return EmbeddedTemplate(frequency_mhz)
    return read_template(
        require_file(name, "template of the prior", "check prior.template"),
        frequency_mhz,
        lmax,
        file_frequency_mhz=file_frequency_mhz,
        spectral_index=spectral_index,
        smoothing_deg=smoothing_deg,
    )
