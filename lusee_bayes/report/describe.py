"""Recognising files and describing their contents."""

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from pkgutil import resolve_name

import numpy as np
from jaxtyping import Float

from lusee_bayes.core import files, formats, reading, trees
from lusee_bayes.core.checks import counted
from lusee_bayes.core.errors import InputError


def _has_image(*names: str) -> Callable[[Path], bool]:
    """Whether a FITS file has one of these images."""
    return lambda path: formats.is_fits(path) and bool({*names} & {*formats.image_names(path)})


BEAM = "instrument.beams.sampled:read_beam"
# readers of the package's own netCDF files, by their attribute ``format``, and tests that recognise
# other files; a file that fails all of them is a sky. Readers are named by path and imported only
# for their files, because each needs other libraries
READERS = {
    formats.VISIBILITIES: "instrument.visibilities:read_visibilities",
    formats.BEAMS: BEAM,
    formats.REDUCED: "flight.reduced:read_reduced",
    formats.GAINS: "flight.gain_model:read_gain_table",
}
KINDS: tuple[tuple[Callable[[Path], bool], str], ...] = (
    (_has_image("h_theta_real", "etheta_real", "e_theta_real", "product_beam"), BEAM),
    (lambda path: formats.has_words(path, formats.UVBEAM_WORDS), BEAM),
    (_has_image("combinations", "products"), "instrument.waterfalls:read_waterfall"),
    (formats.is_session, "flight.session_files:read_session"),
    (lambda path: path.suffix == ".csv", "instrument.beams.grid:read_beam_grid"),
    (lambda path: True, "sky.sky_source:read_sky_file"),
)


# coefficient of a uniform sky of 1 K
MONOPOLE = np.sqrt(4.0 * np.pi)
HOLDS = ("truth", "covariance", "independent_mean")
HOLDS += ("posterior", "log_likelihood", "observed_data", "constant_data", "information")


def describe_diagnostics(path: Path) -> list[str]:
    """Describe the diagnostics of a map."""
    lines = []
    with trees.opened_tree(path, formats.DIAGNOSTICS, "diagnostics of lusee-bayes map") as tree:
        for frequency, channel in sorted(tree.children.items(), key=lambda one: float(one[0])):
            lines.append(f"diagnostics of a map at {frequency} MHz")
            if (judged := channel.children.get("judged")) is None:
                lines.append("the data fit as a whole; their groups were not tested")
                continue
            kinds, n = np.unique(judged.children["groups"].variables["kind"], return_counts=True)
            counts = ", ".join(counted(k, kind) for kind, k in zip(kinds, n.tolist(), strict=True))
            lines += [str(judged.attrs["verdict"]), f"residuals by {counts}"]
    return lines


@dataclass(frozen=True)
class _Skies:
    """Contents of a posterior's file that are described: skies in K, frame and versions."""

    frequency: Float[np.ndarray, " frequency"]
    mean: Float[np.ndarray, "frequency mode"]
    std: Float[np.ndarray, "frequency mode"]
    prior_std: Float[np.ndarray, "frequency mode"]
    lmax: int
    frame: str
    versions: dict[str, str]
    unmapped: str = ""


def describe_posterior(path: Path) -> list[str]:
    """Describe a posterior at one or several frequencies."""
    with trees.opened_tree(path, formats.POSTERIOR, "a posterior of lusee-bayes map") as tree:
        skies = trees.from_tree(_Skies, tree, str(path))
        held = [name for name in HOLDS if name in tree.variables or name in tree.children]
        joint = "component_mean" in tree.variables
    if not skies.mean.size:
        raise InputError(f"{path} contains no sky; rerun that map")
    frequencies, (n, n_modes) = skies.frequency, skies.mean.shape
    where = f"{frequencies[0]:g} MHz"
    if n > 1:
        kind = "one joint posterior" if joint else "independent posteriors"
        where = f"{n} frequencies from {frequencies[0]:g} to {frequencies[-1]:g} MHz, {kind}"
    ends = np.stack([skies.mean[[0, -1], 0], skies.std[[0, -1], 0]], axis=1) / MONOPOLE
    temperatures = [f"{mean:.6g} K +- {std:.3g} K" for mean, std in ends]
    count = (skies.std < 0.5 * skies.prior_std).sum(axis=1)
    return [
        f"posterior over {n_modes} modes (lmax {skies.lmax}) at {where}, {skies.frame}",
        f"mean temperature {' to '.join(dict.fromkeys(temperatures))}",
        f"{' to '.join(dict.fromkeys((str(count.min()), str(count.max()))))} modes constrained to "
        "better than half their prior width",
        *skies.unmapped.splitlines(),
        f"also contains: {', '.join(held) or 'nothing else'}",
        f"versions: {json.dumps(skies.versions)}",
    ]


def describe_samples(path: Path) -> list[str]:
    """Describe draws of a program."""
    # imported here because other files need no sampler
    tree = resolve_name("lusee_bayes.sampling.datatree:read_datatree")(path)
    posterior, statistics = tree["posterior"], tree["sample_stats"]
    return [
        f"{posterior.sizes['chain']} x {posterior.sizes['draw']} draws from the program "
        f"{tree.attrs['program']} at {float(tree.attrs['frequency_mhz']):g} MHz",
        f"sites: {', '.join(f'{name} {v.shape[2:]}' for name, v in posterior.data_vars.items())}",
        f"{int(statistics['diverging'].sum())} divergences, "
        f"{float(statistics['n_steps'].mean()):.1f} steps a trajectory",
        f"groups: {', '.join(tree.children)}",
    ]


def describe_spectrum(path: Path) -> list[str]:
    """Describe temperatures of regions."""
    with trees.opened_tree(path, formats.SPECTRUM, "temperatures of regions") as tree:
        cls = resolve_name("lusee_bayes.results.sky_spectrum:SkySpectrum")
        found = trees.from_tree(cls, tree, str(path))
    lines = [f"temperatures of regions from {found.frequency[0]:g} to {found.frequency[-1]:g} MHz"]
    each = zip(found.regions, found.temperature, strict=True)
    return lines + [f"{name}: {kelvin[0]:.6g} to {kelvin[-1]:.6g} K" for name, kelvin in each]


# the files that contain a verdict
VERDICTS = ("summary.json", "priors.json")


def describe_folder(folder: Path) -> list[str]:
    """Describe a finished run: its kind, origin, verdict and files.

    Raises
    ------
    InputError
        If the folder is not that of a finished run.
    """
    files.recover(folder)
    if (manifest := files.read_manifest(folder)) is None:
        wrong = f"'{folder}' is not the folder of a run: no manifest.json; give a file or a folder"
        raise InputError(wrong)
    lines = [f"results of lusee-bayes {manifest['kind']}"]
    if "provenance.json" in manifest["files"]:
        facts = resolve_name("lusee_bayes.results.finished_runs:Provenance").read(folder)
        lines += [
            f"data: {facts.data_line()}",
            f"{facts.first} to {facts.last} UTC, {facts.n_times} times, site {facts.lon_deg:g}, "
            f"{facts.lat_deg:g} degrees",
            f"up to ell = {facts.lmax}; made {facts.made} UTC by lusee_bayes {facts.version}",
        ]
        lines += [f"command: {facts.command}"] if facts.command else []
    for name in VERDICTS:
        if name in manifest["files"]:
            figures = reading.read_model(folder / name, dict, "the figures of a run")
            lines.append(str(figures.get("verdict")))
    return [*lines, f"files: {', '.join(sorted(manifest['files']))}"]


def _cards(path: Path) -> list[str]:
    """The header of the package's FITS files, in words."""
    with formats.opened(path) as hdus:
        header = next((hdu.header for hdu in hdus if "SCENHASH" in hdu.header), None)
        if header is None:
            return []
        where = f" at {header['FREQ']:g} MHz" if "FREQ" in header else ""
        return [
            f"{header['CONTENT']} of the posterior{where} up to ell = {header['LMAX']}, beam "
            f"{header['BEAM']}, site {header['SITELON']:g}, {header['SITELAT']:g} degrees",
            f"{header['CREATOR']}, scenario {header['SCENHASH'][:12]}",
        ]


DESCRIBED: dict[str, Callable[[Path], list[str]]] = {
    formats.POSTERIOR: describe_posterior,
    formats.DIAGNOSTICS: describe_diagnostics,
    formats.SAMPLES: describe_samples,
    formats.SPECTRUM: describe_spectrum,
}


def describe(path: str | Path) -> str:
    """Describe a file (visibilities, a posterior, samples, beams, a sky) or a run's folder.

    For most files this is the ``repr`` of the object that they contain.

    Raises
    ------
    InputError
        If the file is missing, or of none of these kinds; for a folder of no finished run.
    """
    if Path(path).is_dir():
        lines = describe_folder(Path(path))
    else:
        path = reading.require_file(path, "file")
        if (kind := formats.format_of(path) or "") in DESCRIBED:
            lines = DESCRIBED[kind](path)
        else:
            lines = _cards(path) if formats.is_fits(path) else []
            if not lines or not lines[0].startswith("index"):  # which is no sky
                reader = READERS.get(kind) or next(name for is_one, name in KINDS if is_one(path))
                lines = [repr(resolve_name(f"lusee_bayes.{reader}")(path)), *lines]
    first, *further = lines
    return "\n".join([f"{path}: {first}", *(f"  {line}" for line in further)])
