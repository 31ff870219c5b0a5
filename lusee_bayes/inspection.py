"""Recognising files and saying what is in them."""

from __future__ import annotations

from pathlib import Path

import h5py
import healpy
import numpy as np
import xarray as xr

from lusee_bayes import cube, datatree, diagnostics, results, visibilities
from lusee_bayes.beams import PortResponse, read_beam
from lusee_bayes.checks import InputError
from lusee_bayes.compact import is_compact, read_compact
from lusee_bayes.fits_images import image_names, is_fits, opened
from lusee_bayes.products import N_ANTENNAS, auto_indices, labels
from lusee_bayes.sky import read_alms, read_cube, read_map, sky_kind
from lusee_bayes.waterfalls import read_waterfall


def describe(path: str | Path) -> str:
    """A few lines on a file of visibilities, a posterior, samples, or a sky map (FITS or HDF5).

    InputError if it is missing or none of these.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"no file at '{path}'")
    kind = _netcdf_format(path)
    if kind == visibilities.FORMAT:
        return _describe_visibilities(path)
    if kind == results.FORMAT:
        return _describe_posterior(path)
    if kind == cube.FORMAT:
        return _describe_posterior_cube(path)
    if kind == datatree.FORMAT:
        return _describe_samples(path)
    if kind == diagnostics.FORMAT:
        return _describe_diagnostics(path)
    if is_fits(path):
        names = set(image_names(path))
        if {"etheta_real", "h_theta_real"} & names:
            return _describe_beam(path)
        if {"combinations", "products"} & names:
            return _describe_waterfall(path)
    if path.suffix == ".npz" and is_compact(path):
        return _describe_compact(path)
    kind = sky_kind(path)
    if kind == "cube":
        return _describe_cube(path)
    return _describe_alms(path) if kind == "alms" else _describe_map(path)


def _netcdf_format(path: Path) -> str | None:
    if not h5py.is_hdf5(path):
        return None
    with h5py.File(path) as file:
        kind = file.attrs.get("format")
    return kind.decode() if isinstance(kind, bytes) else kind


def _describe_beam(path: Path) -> str:
    beam = read_beam(path)
    known = beam.frequencies_mhz
    lines = [
        f"  {len(known)} frequencies from {known[0]:g} to {known[-1]:g} MHz",
        f"  {len(beam.theta)} angles from the zenith to the horizon, {beam.n_phi} azimuths",
    ]
    middle = float(known[len(known) // 2])
    if isinstance(beam, PortResponse):
        title = f"{path}: the response of {N_ANTENNAS} coupled ports (luseepy)"
        kelvin = beam.per_kelvin(middle)
        emitted = beam.background(middle, 1.0)[auto_indices()]
        lines += [
            f"  at {middle:g} MHz: impedance {_ohm(beam.impedance[len(known) // 2][0, 0])}, 1 K is "
            f"{kelvin.min():.4g} to {kelvin.max():.4g} V^2/Hz behind the receivers",
            f"  {float(emitted.mean()):.3f} of an auto comes from the Moon",
        ]
    else:
        title = f"{path}: the beam of one arm (luseepy, scalar)"
        lines.append(f"  gain {beam.gain.min():.4g} to {beam.gain.max():.4g}")
        if beam.impedance is not None:
            lines.append(f"  impedance {_ohm(beam.impedance[len(known) // 2])} at {middle:g} MHz")
        ground = float(beam.background(middle, 1.0)[0])
        lines.append(f"  {ground:.3f} of the beam ends on the ground at {middle:g} MHz")
    return "\n".join([title, *lines])


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


def _describe_map(path: Path) -> str:
    pixels = read_map(path)
    lines = [
        f"{path}: HEALPix sky map, NSIDE {healpy.npix2nside(pixels.size)}, RING, Galactic",
        f"  mean {pixels.mean():.6g} K, from {pixels.min():.4g} to {pixels.max():.4g} K",
    ]
    return "\n".join(lines + (_describe_cards(path) if is_fits(path) else []))


def _describe_cards(path: Path) -> list[str]:
    """What a FITS file of the package says of itself."""
    with opened(path) as hdus:
        header = hdus[1].header
        if "SCENHASH" not in header:
            return []
        return [
            f"  {header['CONTENT']} at {header['FREQ']:g} MHz up to ell = {header['LMAX']}, beam "
            f"{header['BEAM']}, site {header['SITELON']:g}, {header['SITELAT']:g} degrees",
            f"  {header['CREATOR']}, scenario {header['SCENHASH'][:12]}",
        ]


def _describe_cube(path: Path) -> str:
    cube = read_cube(path)
    known, pixels = cube.frequencies_mhz, cube.pixels
    return "\n".join(
        [
            f"{path}: {len(pixels)} HEALPix sky maps, NSIDE {healpy.npix2nside(pixels.shape[1])}, "
            "taken to be RING and Galactic",
            f"  {known[0]:g} to {known[-1]:g} MHz, means {pixels[0].mean():.6g} to "
            f"{pixels[-1].mean():.6g} K, least pixel {pixels.min():.4g} K",
        ]
    )


def _describe_alms(path: Path) -> str:
    alms = read_alms(path)
    known, means = alms.frequencies_mhz, alms.modes[:, 0] / np.sqrt(4 * np.pi)
    where = "frequency not said"
    if known is not None:
        where = f"{', '.join(f'{f:g}' for f in known)} MHz"
    return "\n".join(
        [
            f"{path}: coefficients of {len(means)} skies up to ell = {alms.lmax}, {where}",
            f"  means {means[0]:.6g} to {means[-1]:.6g} K",
            *(_describe_cards(path) if is_fits(path) else []),
        ]
    )
