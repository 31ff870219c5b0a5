"""Recognising files and saying what is in them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from pkgutil import resolve_name

from lusee_bayes.core import formats
from lusee_bayes.core.formats import has_words, image_names, is_fits
from lusee_bayes.core.reading import require_file

# the package's own netCDF files, by their attribute ``format``. What describes a kind is named by
# path and imported when there is such a file: each needs libraries that others do not
OWN_FORMATS = {
    formats.VISIBILITIES: "describe_data:describe_visibilities",
    formats.POSTERIOR: "describe_results:describe_posterior",
    formats.BEAMS: "describe_data:describe_sampled_beams",
    formats.DIAGNOSTICS: "describe_results:describe_diagnostics",
    formats.SAMPLES: "describe_runs:describe_samples",
    formats.REDUCED: "describe_data:describe_reduced",
    formats.GAINS: "describe_data:describe_gains",
}


def _has_image(*names: str) -> Callable[[Path], bool]:
    """Whether a FITS file has one of these images."""
    return lambda path: is_fits(path) and bool(set(names) & set(image_names(path)))


# other files: how each kind is recognised; what is none of them is a sky
KINDS: tuple[tuple[Callable[[Path], bool], str], ...] = (
    (_has_image("h_theta_real"), "describe_data:describe_response"),
    (_has_image("etheta_real"), "describe_data:describe_scalar_beam"),
    (_has_image("e_theta_real", "product_beam"), "describe_data:describe_sampled_beams"),
    (lambda path: has_words(path, formats.UVBEAM_WORDS), "describe_data:describe_sampled_beams"),
    (_has_image("combinations", "products"), "describe_data:describe_waterfall"),
    (formats.is_session, "describe_data:describe_session"),
    (lambda path: True, "describe_sky:describe_sky"),
)


def describe(path: str | Path) -> str:
    """A few lines on a file (visibilities, a posterior, samples, beams, a sky), or a run's folder.

    Raises
    ------
    InputError
        If the file is missing, or of none of these kinds; for a folder that no run has written.
    """
    if Path(path).is_dir():
        path, kind = Path(path), "describe_runs:describe_folder"
    else:
        path = require_file(path, "file")
        kind = OWN_FORMATS.get(formats.format_of(path) or "")
        if kind is None:
            kind = next(kind for recognises, kind in KINDS if recognises(path))
    first, *further = resolve_name(f"lusee_bayes.report.{kind}")(path)
    return "\n".join([f"{path}: {first}", *(f"  {line}" for line in further)])
