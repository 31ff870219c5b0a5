"""Recognising files and saying what is in them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import xarray as xr

from lusee_bayes.core.checks import InputError
from lusee_bayes.core.fits_files import image_names, is_fits, opened
from lusee_bayes.instrument import visibilities
from lusee_bayes.instrument.beams import PortResponse, ScalarBeam
from lusee_bayes.instrument.beams.files import is_response
from lusee_bayes.instrument.beams.response_file import read_response
from lusee_bayes.instrument.beams.scalar_file import read_scalar_beam
from lusee_bayes.instrument.products import N_ANTENNAS, auto_indices, labels
from lusee_bayes.instrument.waterfalls import read_waterfall
from lusee_bayes.linear.compact import is_compact, read_compact
from lusee_bayes.results import cube, diagnostics, posterior_file
from lusee_bayes.sampling import datatree
from lusee_bayes.sky import read_sky_file


def describe(path: str | Path) -> str:
    """A few lines on a file: visibilities, a posterior, samples, beams, or a sky.

    Raises
    ------
    InputError
        If the file is missing, or of none of these kinds.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"no file at '{path}'")
    own = OWN_FORMATS.get(_netcdf_format(path) or "")
    if own is not None:
        return own(path)
    for recognises, of_kind in KINDS:
        if recognises(path):
            return of_kind(path)
    return _describe_sky(path)


def _netcdf_format(path: Path) -> str | None:
    if not h5py.is_hdf5(path):
        return None
    with h5py.File(path) as file:
        kind = file.attrs.get("format")
    return kind.decode() if isinstance(kind, bytes) else kind


def _has_image(*names: str) -> Callable[[Path], bool]:
    """Whether a FITS file has one of these images."""
    return lambda path: is_fits(path) and bool(set(names) & set(image_names(path)))


def _describe_response(path: Path) -> str:
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


def _describe_scalar_beam(path: Path) -> str:
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


def _grid_lines(beam: ScalarBeam | PortResponse) -> list[str]:
    known = beam.frequencies_mhz
    return [
        f"  {len(known)} frequencies from {known[0]:g} to {known[-1]:g} MHz",
        f"  {len(beam.theta)} angles from the zenith to the horizon, {beam.n_phi} azimuths",
    ]


def _ohm(z: complex) -> str:
    return f"{z.real:.4g} {'-' if z.imag < 0 else '+'} {abs(z.imag):.4g} i Ohm"


def _describe_waterfall(path: Path) -> str:
    waterfall = read_waterfall(path)
    grid, observation = waterfall.grid, waterfall.observation
    four_port = waterfall.per_kelvin is not None
    here = ~np.isnan(grid).all((1, 2))
    names = [name for name, there in zip(labels(), here, strict=True) if there]
    gaps = int(np.isnan(grid[here]).sum())
    four_port_lines = []
    if four_port:
        kelvin = waterfall.per_kelvin
        four_port_lines = [
            f"  in V^2/Hz: 1 K is {kelvin.min():.4g} to {kelvin.max():.4g} of them",
            f"  with the emission of the Moon at {waterfall.moon_k:g} K",
        ]
    return "\n".join(
        [
            f"{path}: a waterfall of luseepy" + (", four ports" if four_port else ""),
            f"  channels at {', '.join(f'{f:g}' for f in waterfall.frequencies_mhz)} MHz",
            f"  {len(names)} products ({' '.join(names)}), {observation.n_times} times of "
            f"{observation.step_s:g} s, {gaps} samples missing",
            f"  {observation.times[0].isot} to {observation.times[-1].isot} UTC",
            f"  site: longitude {observation.lon_deg}, latitude {observation.lat_deg} degrees",
            *four_port_lines,
        ]
    )


def _describe_visibilities(path: Path) -> str:
    data = visibilities.read_visibilities(path)
    observation = data.observation
    grid = data.grid()
    autos = grid[[k for k, label in enumerate(data.labels) if label[0] == label[1]]]
    return "\n".join(
        [
            f"{path}: visibilities at {data.frequency_mhz:g} MHz",
            f"  {data.layout.n_products} products ({data.labels[0]} ... {data.labels[-1]}), "
            f"{data.layout.n_times} times of {observation.step_s:g} s, {data.n_missing} samples "
            "missing",
            f"  {observation.times[0].isot} to {observation.times[-1].isot} UTC, "
            f"{observation.n_runs} run(s) at turntable {observation.turntable_deg} degrees",
            f"  site: longitude {observation.lon_deg}, latitude {observation.lat_deg} degrees",
            f"  autos {np.nanmin(autos):.4g} to {np.nanmax(autos):.4g} K",
            f"  true sky {'included' if data.truth is not None else 'not known'}",
        ]
    )


def _describe_posterior_cube(path: Path) -> str:
    with xr.open_dataset(path, engine="h5netcdf") as posterior:
        frequencies, attrs = posterior["frequency"].values, posterior.attrs
        temperature = posterior["mean"].values[:, 0] / np.sqrt(4 * np.pi)
        joint = "component_mean" in posterior
        extra = [name for name in ("truth", "draws", "independent_mean") if name in posterior]
        modes = posterior.sizes["mode"]
    kind = "one posterior for all" if joint else "each by itself"
    return "\n".join(
        [
            f"{path}: posterior over {modes} modes (lmax {attrs['lmax']}) at {len(frequencies)} "
            f"frequencies from {frequencies[0]:g} to {frequencies[-1]:g} MHz, {kind}, "
            f"{attrs['frame']}",
            f"  mean temperature {temperature[0]:.6g} K to {temperature[-1]:.6g} K",
            f"  also holds: {', '.join(extra) or 'nothing else'}",
            f"  versions: {attrs['versions']}",
        ]
    )


def _describe_posterior(path: Path) -> str:
    with xr.open_dataset(path, engine="h5netcdf") as posterior:
        mean, std = posterior["mean"].values, posterior["std"].values
        attrs = posterior.attrs
        extra = [name for name in ("truth", "draws", "covariance") if name in posterior]
        draws = posterior.sizes.get("draw", 0)
    constrained = int((std < 0.5 * posterior["prior_std"].values).sum())
    return "\n".join(
        [
            f"{path}: posterior over {mean.size} modes (lmax {attrs['lmax']}) at "
            f"{float(attrs['frequency_mhz']):g} MHz, {attrs['frame']}",
            f"  mean temperature {mean[0] / np.sqrt(4 * np.pi):.6g} K +- "
            f"{std[0] / np.sqrt(4 * np.pi):.3g} K",
            f"  {constrained} modes known to better than half their prior width",
            f"  also holds: {', '.join(extra) or 'nothing else'}"
            + (f" ({draws} draws)" if draws else ""),
            f"  versions: {attrs['versions']}",
        ]
    )


def _describe_samples(path: Path) -> str:
    tree = datatree.read_datatree(path)
    posterior, statistics = tree["posterior"], tree["sample_stats"]
    sites = ", ".join(f"{name} {v.shape[2:]}" for name, v in posterior.data_vars.items())
    return "\n".join(
        [
            f"{path}: {posterior.sizes['chain']} x {posterior.sizes['draw']} draws of the program "
            f"{tree.attrs['program']} at {float(tree.attrs['frequency_mhz']):g} MHz",
            f"  sites: {sites}",
            f"  {int(statistics['diverging'].sum())} divergences, "
            f"{float(statistics['n_steps'].mean()):.1f} steps a trajectory",
            f"  groups: {', '.join(tree.children)}",
        ]
    )


def _describe_compact(path: Path) -> str:
    posterior, about = read_compact(path)
    n, rank = posterior.directions.shape
    return "\n".join(
        [
            f"{path}: compact posterior over {n} modes (lmax {about['lmax']}) at "
            f"{about['frequency_mhz']:g} MHz, {about['frame']}",
            f"  {rank} directions known better than the prior, the best to "
            f"{np.sqrt(posterior.variances.min()):.2g} of its width",
            f"  versions: {about['versions']}",
        ]
    )


def _describe_diagnostics(path: Path) -> str:
    found = diagnostics.read_diagnostics(path)
    kinds = found["group_kind"].values
    counts = [f"{int((kinds == kind).sum())} {kind}s" for kind in ("product", "day", "angle")]
    return "\n".join(
        [
            f"{path}: diagnostics of a map at {found.attrs['frequency_mhz']:g} MHz",
            f"  {found.attrs['verdict']}",
            f"  residuals by {', '.join(counts)}; {found.sizes['draw']} draws, "
            f"{found.sizes['region']} point-spread functions",
        ]
    )


def _describe_sky(path: Path) -> str:
    first, *further = read_sky_file(path).summary()
    cards = _describe_cards(path) if is_fits(path) else []
    return "\n".join([f"{path}: {first}", *(f"  {line}" for line in further), *cards])


def _describe_cards(path: Path) -> list[str]:
    """What a FITS file of the package says of itself."""
    with opened(path) as hdus:
        header = hdus[1].header if len(hdus) > 1 else {}
        if "SCENHASH" not in header:
            return []
        return [
            f"  {header['CONTENT']} at {header['FREQ']:g} MHz up to ell = {header['LMAX']}, beam "
            f"{header['BEAM']}, site {header['SITELON']:g}, {header['SITELAT']:g} degrees",
            f"  {header['CREATOR']}, scenario {header['SCENHASH'][:12]}",
        ]


# the package's own netCDF files, by their attribute ``format``
OWN_FORMATS: dict[str, Callable[[Path], str]] = {
    visibilities.FORMAT: _describe_visibilities,
    posterior_file.FORMAT: _describe_posterior,
    cube.FORMAT: _describe_posterior_cube,
    datatree.FORMAT: _describe_samples,
    diagnostics.FORMAT: _describe_diagnostics,
}

# other files: how each kind is recognised; what is none of them is a sky
KINDS: tuple[tuple[Callable[[Path], bool], Callable[[Path], str]], ...] = (
    (is_response, _describe_response),
    (_has_image("etheta_real"), _describe_scalar_beam),
    (_has_image("combinations", "products"), _describe_waterfall),
    (lambda path: path.suffix == ".npz" and is_compact(path), _describe_compact),
)
