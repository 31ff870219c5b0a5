"""The files of a map: posterior.nc, diagnostics.nc, and HEALPix FITS with their origin in them."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import xarray as xr
from astropy.io import fits
from jaxtyping import Float

from lusee_bayes.core import formats
from lusee_bayes.core.arrays import Pixels
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.files import recover, user_path
from lusee_bayes.core.harmonics import mode_numbers, n_modes
from lusee_bayes.core.lazy import healpy
from lusee_bayes.core.reading import require_file
from lusee_bayes.core.trees import from_tree, opened_tree, to_tree
from lusee_bayes.core.version import __version__, versions
from lusee_bayes.experiment.scenario import Scenario
from lusee_bayes.linear.information import Information
from lusee_bayes.results.channel import ChannelResult
from lusee_bayes.results.map_result import MapResult


def cards(name: str, scenario: Scenario) -> dict[str, tuple]:
    """Header cards of a result: what it is, of which frequency, beam, site and scenario.

    Values are (value, comment), or for text that would not fit a value alone.
    """
    beam, site = scenario.beam, scenario.observation
    return {
        "CONTENT": (name, "of the posterior over the sky"),
        "FREQ": (scenario.frequency_mhz, "frequency in MHz"),
        "LMAX": (scenario.lmax, "highest ell that is covered"),
        "FRAME": ("galactic", "of directions"),
        "BEAM": (beam.label, "the antennas"),
        "SITELON": (site.lon_deg, "selenographic longitude in degrees"),
        "SITELAT": (site.lat_deg, "selenographic latitude in degrees"),
        "SCENHASH": (text_hash(scenario.to_yaml()),),
        "CREATOR": (f"lusee_bayes {__version__}",),
        # FITS keys have eight letters
        **{
            f"V_{re.split('[-_]', name)[0][:6].upper()}": (v, name)
            for name, v in versions().items()
        },
    }


def text_hash(text: str) -> str:
    """SHA-256 of a resolved scenario in YAML."""
    return hashlib.sha256(text.encode()).hexdigest()


def write_maps(folder: Path, maps: Mapping[str, Pixels], scenario: Scenario) -> None:
    """Write NAME.fits of maps: HEALPix RING, Galactic, K, float64, for healpy.read_map."""
    for name, pixels in maps.items():
        extra = [(key, *value) for key, value in cards(name, scenario).items()]
        column = {"column_names": [name.upper()], "column_units": "K", "dtype": np.float64}
        healpy.write_map(folder / f"{name}.fits", pixels, coord="G", extra_header=extra, **column)


def write_cubes(
    folder: Path,
    cubes: Mapping[str, Float[np.ndarray, "frequencies pixels"]],
    frequencies_mhz: Float[np.ndarray, " frequencies"],
    scenario: Scenario,
) -> None:
    """Write NAME.fits of maps at a scenario's frequencies, in the layout of ``sky.cubes``.

    One image (frequency, pixel), HEALPix RING, Galactic, K, float64; the frequencies, which its
    header can only give in even steps, are in a table behind it.
    """
    steps = np.diff(frequencies_mhz)
    for name, pixels in cubes.items():
        image = fits.PrimaryHDU(np.asarray(pixels, dtype=np.float64))
        header = image.header
        for key, value in cards(name, scenario).items():
            if key != "FREQ":
                header[key] = value
        header["BUNIT"], header["COORDSYS"], header["ORDERING"] = "K", "G", "RING"
        header["NSIDE"] = scenario.map_nside
        if not len(steps) or np.allclose(steps, steps[0], rtol=1e-9):
            header["HIERARCH FREQ_START"] = (frequencies_mhz[0], "MHz")
            header["FREQ_END"] = (frequencies_mhz[-1], "MHz")
            header["HIERARCH FREQ_STEP"] = (steps[0] if len(steps) else 1.0, "MHz")
        column = fits.Column("FREQUENCY", "D", unit="MHz", array=frequencies_mhz)
        table = fits.BinTableHDU.from_columns([column], name="FREQUENCIES")
        fits.HDUList([image, table]).writeto(folder / f"{name}.fits")


def posterior_tree(result: MapResult) -> xr.DataTree:
    """What posterior.nc holds, for xarray and, where draws were asked for, for ArviZ.

    At its root the sky of every channel, in K, on ``frequency`` and ``mode`` with coordinates
    ``ell`` and ``m``; ``posterior`` (draws), ``log_likelihood``, ``observed_data`` and
    ``constant_data`` as ArviZ has them; ``information``, where it was asked for, a group for each
    frequency.
    """
    scenario, joint, channels = result.scenario, result.joint, result.channels
    ell, m = mode_numbers(scenario.lmax)
    named = {"independent_mean": "independent", **{n: n for n in ("mean", "std", "prior_std")}}
    skies = {name: result.stacked(kept) for name, kept in (*named.items(), ("truth", "truth"))}
    on_modes, kelvin = ("frequency", "mode"), {"units": "K"}
    variables = {n: (on_modes, values, kelvin) for n, values in skies.items() if values is not None}
    covariance = result.stacked("covariance")
    if covariance is not None:
        variables["covariance"] = ((*on_modes, "mode_2"), covariance, {"units": "K2"})
    if joint is not None:
        # fields of positive skies may have more modes than the maps
        dims = ("component", "mode" if joint.mode is None else "field_mode")
        unit = "K" if joint.mode is None else "1"
        variables["component_mean"] = (dims, np.asarray(joint.mean), {"units": unit})
        mixing = np.asarray(joint.prior.mixing)
        variables["mixing"] = (("frequency", "component"), mixing, {"units": "1"})
    axis = {"frequency": ("frequency", result.frequencies_mhz, {"units": "MHz"})}
    coords = {**axis, "ell": ("mode", ell), "m": ("mode", m)}
    unmapped = {"unmapped": "\n".join(result.gaps())} if result.unmapped else {}
    attrs = formats.header(formats.POSTERIOR) | about(scenario) | unmapped
    groups = {"/": xr.Dataset(variables, coords, attrs), **_observed(channels, axis)}
    draws, likely = result.stacked("draws"), result.stacked("log_likelihood")
    if draws.size:
        chains = {"chain": [0], "draw": np.arange(draws.shape[1])}
        dims = ("chain", "draw", "frequency")
        sky = ((*dims, "mode"), draws.swapaxes(0, 1)[None], kelvin)
        groups["posterior"] = xr.Dataset({"sky": sky}, {**chains, **coords})
        data = (dims, likely.T[None], {"units": "1"})
        groups["log_likelihood"] = xr.Dataset({"visibility": data}, {**chains, **axis})
    for channel in channels:
        if channel.information is not None:
            kept = SavedInformation(channel.information, channel.digests)
            groups[f"{INFORMATION}/{channel.frequency_mhz:.15g}"] = to_tree(kept)
    return xr.DataTree.from_dict(groups)


def _observed(channels: Sequence[ChannelResult], axis: dict) -> dict[str, xr.Dataset]:
    """The data, and when they were taken; of channels that have other times, NaN between."""
    parts, turns = [], []
    for channel in channels:
        coords = {"product": list(channel.labels), "time": ("time", channel.hours, HOURS)}
        grid = (("product", "time"), channel.data, {"units": "K"})
        parts.append(xr.Dataset({"visibility": grid}, coords))
        angle = ("time", channel.turntable_deg, {"units": "degree"})
        turns.append(xr.Dataset({"turntable_deg": angle}, {"time": coords["time"]}))
    along = xr.Variable(*axis["frequency"][:2], axis["frequency"][2])
    return {
        name: xr.concat(each, along.to_index_variable(), join="outer")
        for name, each in {"observed_data": parts, "constant_data": turns}.items()
    }


INFORMATION = "information"
HOURS = {"units": "h", "long_name": "time since the first sample"}


@dataclass(frozen=True)
class SavedInformation:
    """What data say of the sky at one frequency, and the digests of these data."""

    information: Information
    digests: tuple[str, ...]

    def with_more(self, information: Information, digest: str) -> Information:
        """Add the information of other data.

        Raises
        ------
        InputError
            If they are among these.
        """
        if digest in self.digests:
            raise InputError(
                "these data are behind the earlier posterior already; used again, they would count "
                "twice"
            )
        return information + self.information


KEPT = "a posterior of lusee-bayes map --information"


def information_file(folder: str | Path) -> Path:
    """The file in which a run has kept its information. InputError if the folder has none."""
    recover(folder)
    return require_file(user_path(folder).resolve() / "posterior.nc", KEPT)


def read_information(path: Path, channel: Scenario) -> SavedInformation:
    """The information of a channel that a run has kept (:func:`information_file`).

    InputError if there is none, or none of this frequency or lmax.
    """
    name = f"{channel.frequency_mhz:.15g}"
    with opened_tree(path, formats.POSTERIOR, KEPT) as tree:
        kept = tree.children.get(INFORMATION)
        if kept is None:
            raise InputError(
                f"{path} does not hold the information of its data; make that map again with "
                "--information"
            )
        if name not in kept.children:
            raise InputError(
                f"{path} is of {', '.join(kept.children)} MHz, the scenario of {name} MHz; use "
                f"--set frequency_mhz={next(iter(kept.children))}"
            )
        found = from_tree(SavedInformation, kept.children[name], str(path))
    if found.information.n_modes != n_modes(channel.lmax):
        lmax = round(np.sqrt(found.information.n_modes)) - 1
        raise InputError(
            f"{path} is of lmax {lmax}, the scenario of {channel.lmax}; use --set lmax={lmax}"
        )
    return found


def diagnostics_tree(result: MapResult) -> xr.DataTree:
    """What diagnostics.nc holds: everything else that was found, a group for each frequency."""
    groups = {}
    for channel in result.channels:
        kept = replace(channel, draws=channel.draws[:0], log_likelihood=channel.log_likelihood[:0])
        kept = replace(kept, covariance=None, information=None)
        groups[f"{channel.frequency_mhz:.15g}"] = to_tree(kept)
    root = xr.Dataset(attrs=formats.header(formats.DIAGNOSTICS) | about(result.scenario))
    return xr.DataTree(root, children=groups)


def read_channels(path: str | Path) -> tuple[ChannelResult, ...]:
    """The channels of a finished run, of its diagnostics.nc. InputError for anything else."""
    what = "diagnostics of lusee-bayes map"
    with opened_tree(path, formats.DIAGNOSTICS, what, "lusee-bayes map writes one") as tree:
        named = sorted(tree.children.items(), key=lambda one: float(one[0]))
        return tuple(from_tree(ChannelResult, one, f"{path}: {f} MHz") for f, one in named)


def about(scenario: Scenario) -> dict[str, object]:
    """What a file has to say of its numbers: frame, versions, scenario."""
    return {
        "lmax": scenario.lmax,
        "frame": "galactic",
        "basis": "real orthonormal spherical harmonics, index ell^2 + ell + m",
        "versions": json.dumps(versions()),
        "scenario": scenario.to_yaml(),
    }
