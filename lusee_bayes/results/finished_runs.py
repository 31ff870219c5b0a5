"""Files of finished runs: writing them, and reading them back for comparisons.

A map writes posterior.nc, diagnostics.nc, and HEALPix FITS files with their origin in the header.
The provenance of a run records its data, site, dates and command, and when it was made.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from astropy.io import fits
from jaxtyping import Bool, Float
from pydantic import BaseModel

from lusee_bayes.core import arrays, formats, harmonics, lazy
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.files import recover, require_files, user_path
from lusee_bayes.core.reading import read_model, require_file
from lusee_bayes.core.trees import from_tree, opened_tree, to_tree
from lusee_bayes.core.version import COMMAND, __version__, release, versions
from lusee_bayes.experiment.data_files import Data, names_of_data
from lusee_bayes.experiment.experiment import Experiment
from lusee_bayes.experiment.scenario import Scenario
from lusee_bayes.instrument.observation import Observation
from lusee_bayes.judge.coverage import LEVELS
from lusee_bayes.linear.information import Information
from lusee_bayes.results.channel import ChannelResult
from lusee_bayes.results.map_result import MapResult, spectrum_of
from lusee_bayes.results.sky_spectrum import SkySpectrum


def cards(name: str, scenario: Scenario) -> dict[str, tuple]:
    """Header cards of a result: content, frequency if there is one, beam, site and scenario.

    Values are (value, comment), or (value,) for text that leaves no room for a comment.
    """
    beam, site = scenario.beam, scenario.observation
    one = {"FREQ": (scenario.frequency_mhz, "frequency in MHz")} if scenario.single else {}
    return {
        "CONTENT": (name, "of the posterior over the sky"),
        **one,
        "LMAX": (scenario.lmax, "highest ell included"),
        "FRAME": ("galactic", "of directions"),
        "BEAM": (beam.label, "the antennas"),
        "SITELON": (site.lon_deg, "selenographic longitude in degrees"),
        "SITELAT": (site.lat_deg, "selenographic latitude in degrees"),
        "SCENHASH": (text_hash(scenario.to_yaml()),),
        "CREATOR": (f"lusee_bayes {__version__}",),
        # FITS keys have eight letters
        **{f"V_{re.split('[-_]', n)[0][:6].upper()}": (v, n) for n, v in versions().items()},
    }


def text_hash(text: str) -> str:
    """SHA-256 of a text, such as a resolved scenario in YAML."""
    return hashlib.sha256(text.encode()).hexdigest()


def write_map(
    path: Path,
    maps: Mapping[str, arrays.Pixels],
    observed: Bool[np.ndarray, " pixels"],
    scenario: Scenario,
) -> None:
    """Write maps as the columns of a HEALPix file, for ``healpy.read_map(path, field=...)``.

    Parameters
    ----------
    path : Path
    maps : mapping of (pixels,) arrays
        In K, RING, Galactic, by column name: the mean first.
    observed : (pixels,) array of bool
        Whether the pixel ever rose above the horizon: the third column, OBSERVED, 1 or 0.
    scenario : Scenario
    """
    columns = [(name, pixels, "K") for name, pixels in maps.items()]
    columns.insert(2, ("observed", observed.astype(np.uint8), ""))
    _write_columns(path, columns, cards("maps", scenario))


def write_index_maps(result: MapResult, folder: Path) -> None:
    """Write maps of the spectral index as index.fits, the columns of a HEALPix file."""
    units, found = {"turnover": "MHz", "turnover_std": "MHz"}, result.index_maps()
    columns = [(name, pixels, units.get(name, "")) for name, pixels in found.maps.items()]
    more = {"FREQREF": (found.reference_mhz, "frequency of the index in MHz")}
    more["FWHM"] = harmonics.taper_fwhm_deg(result.scenario.lmax), "smoothing beam in degrees"
    _write_columns(folder / "index.fits", columns, cards("index", result.scenario) | more)


def _write_columns(
    path: Path, columns: Sequence[tuple[str, np.ndarray, str]], header: Mapping[str, tuple]
) -> None:
    """Write a HEALPix file, RING and Galactic, from columns (name, pixels, unit)."""
    names, pixels, units = zip(*columns, strict=True)
    named = {"column_names": [name.upper() for name in names], "column_units": units}
    extra = [(key, *card) for key, card in header.items()]
    dtypes = [one.dtype for one in pixels]
    lazy.healpy.write_map(path, pixels, coord="G", dtype=dtypes, extra_header=extra, **named)


def write_cubes(
    folder: Path,
    cubes: Mapping[str, Float[np.ndarray, "frequencies pixels"]],
    frequencies_mhz: Float[np.ndarray, " frequencies"],
    scenario: Scenario,
) -> None:
    """Write maps at a scenario's frequencies as NAME.fits, in the layout of ``sky.cubes``.

    Each file has one image (frequency, pixel), HEALPix RING, Galactic, K, float64. A table after it
    lists the frequencies, because the header can only give even steps.
    """
    steps = np.diff(frequencies_mhz) if len(frequencies_mhz) > 1 else np.ones(1)
    for name, pixels in cubes.items():
        image = fits.PrimaryHDU(np.asarray(pixels, dtype=np.float64))
        header = image.header
        header.update(cards(name, scenario))
        header["BUNIT"], header["COORDSYS"], header["ORDERING"] = "K", "G", "RING"
        header["NSIDE"] = scenario.map_nside
        if np.allclose(steps, steps[0], rtol=1e-9):
            header["HIERARCH FREQ_START"] = (frequencies_mhz[0], "MHz")
            header["FREQ_END"] = (frequencies_mhz[-1], "MHz")
            header["HIERARCH FREQ_STEP"] = (steps[0], "MHz")
        column = fits.Column("FREQUENCY", "D", unit="MHz", array=frequencies_mhz)
        table = fits.BinTableHDU.from_columns([column], name="FREQUENCIES")
        fits.HDUList([image, table]).writeto(folder / f"{name}.fits")


def posterior_tree(result: MapResult) -> xr.DataTree:
    """Contents of posterior.nc, for xarray and, if draws were requested, for ArviZ.

    The root has the sky of every channel, in K, on ``frequency`` and ``mode`` with coordinates
    ``ell`` and ``m``. ``posterior`` (draws), ``log_likelihood``, ``observed_data`` and
    ``constant_data`` follow ArviZ; ``information``, if requested, has a group for each frequency.
    """
    scenario, joint, channels = result.scenario, result.joint, result.channels
    ell, m = harmonics.mode_numbers(scenario.lmax)
    skies = {name: result.stacked(name) for name in ("mean", "std", "prior_std", "truth")}
    skies["independent_mean"] = result.stacked("independent")
    on_modes, kelvin = ("frequency", "mode"), {"units": "K"}
    variables = {n: (on_modes, values, kelvin) for n, values in skies.items() if values is not None}
    if (covariance := result.stacked("covariance")) is not None:
        variables["covariance"] = ((*on_modes, "mode_2"), covariance, {"units": "K2"})
    if joint is not None:
        # fields of positive skies may have more modes than the maps
        dims = ("component", "mode" if joint.mode is None else "field_mode")
        unit = "K" if joint.mode is None else "1"
        variables["component_mean"] = (dims, joint.maps, {"units": unit})
        mixing = np.asarray(joint.prior.mixing)
        variables["mixing"] = (("frequency", "component"), mixing, {"units": "1"})
    axis = {"frequency": ("frequency", result.frequencies_mhz, {"units": "MHz"})}
    coords = {**axis, "ell": ("mode", ell), "m": ("mode", m)}
    unmapped = {"unmapped": "\n".join(result.gaps())} if result.unmapped else {}
    attrs = formats.header(formats.POSTERIOR) | attributes_of(scenario) | unmapped
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
    """The data and their times; NaN at times that a channel lacks."""
    parts, first = [], [np.datetime64(channel.taken["first"]) for channel in channels]
    for channel, begin in zip(channels, first, strict=True):
        hours = channel.hours + (begin - min(first)) / np.timedelta64(1, "h")
        coords = {"product": list(channel.labels), "time": ("time", np.round(hours, 6), HOURS)}
        grid = (("product", "time"), channel.data, {"units": "K"})
        angle = ("time", channel.turntable_deg, {"units": "degree"})
        parts.append(xr.Dataset({"visibility": grid, "turntable_deg": angle}, coords))
    whole = xr.concat(parts, xr.Variable(*axis["frequency"]).to_index_variable(), join="outer")
    return {"observed_data": whole[["visibility"]], "constant_data": whole[["turntable_deg"]]}


INFORMATION = "information"
HOURS = {"units": "h", "long_name": "time since the first sample"}


@dataclass(frozen=True)
class SavedInformation:
    """The information in data about the sky at one frequency, and the digests of these data.

    A digest is a hash, and the times of the first and the last sample.
    """

    information: Information
    digests: tuple[str, ...]

    def with_more(self, information: Information, digest: str) -> Information:
        """Add the information of other data.

        Raises
        ------
        InputError
            If they are already included.
        """
        if digest.split()[0] in (known.split()[0] for known in self.digests):
            wrong = "the earlier posterior already includes these data; give only new ones"
            raise InputError(wrong)
        return information + self.information


def read_draws(folder: str | Path, frequency_mhz: float | None = None) -> arrays.Draws:
    """Read the posterior draws of a finished map (``lusee-bayes map --draws N``).

    Parameters
    ----------
    folder : str or Path
        Folder of the run.
    frequency_mhz : float, optional
        The channel; required if there are several.

    Returns
    -------
    (draws, modes) array
        Real harmonic coefficients, Galactic, in K.

    Raises
    ------
    InputError
        If the run has saved no draws, or there is no such channel.
    """
    path = require_file(user_path(folder) / "posterior.nc", "a posterior of lusee-bayes map")
    with opened_tree(path, formats.POSTERIOR, "a posterior of lusee-bayes map") as tree:
        if "posterior" not in tree.children:
            raise InputError(f"{path} has no draws; map again with --draws N")
        mhz = np.asarray(tree.variables["frequency"])
        near = np.isclose(mhz, mhz if frequency_mhz is None else frequency_mhz)
        if near.sum() != 1:
            names = ", ".join(f"{f:g}" for f in mhz)
            raise InputError(f"{path} has channels of {names} MHz; give one as frequency_mhz")
        skies = np.asarray(tree.children["posterior"].variables["sky"])
        return skies[0, :, np.flatnonzero(near)[0]]


KEPT = "a posterior of lusee-bayes map --information"


def information_file(folder: str | Path) -> Path:
    """The file with a run's saved information. InputError if the folder has none."""
    recover(folder)
    return require_file(user_path(folder).resolve() / "posterior.nc", KEPT, "give a map's folder")


def read_information(path: Path, channel: Scenario) -> SavedInformation:
    """Read a channel's information that a run has saved (:func:`information_file`).

    InputError if there is none, or none for this frequency or lmax.
    """
    name = f"{channel.frequency_mhz:.15g}"
    with opened_tree(path, formats.POSTERIOR, KEPT) as tree:
        if (kept := tree.children.get(INFORMATION)) is None:
            raise InputError(
                f"{path} lacks the information of its data; make that map again with --information"
            )
        if name not in kept.children:
            raise InputError(
                f"{path} is for {', '.join(kept.children)} MHz, the scenario for {name} MHz; use "
                "its frequencies, or map without --add"
            )
        saved = from_tree(SavedInformation, kept.children[name], str(path))
    above = channel.noise.above_lmax
    ends = channel.lmax, channel.lmax if above is None else above.top(channel.lmax)
    if saved.information.n_modes not in map(harmonics.n_modes, ends):
        lmax = round(np.sqrt(saved.information.n_modes)) - 1
        why = f"{path} has lmax = {lmax}, the scenario lmax = {channel.lmax}; use --set lmax={lmax}"
        raise InputError(why)
    return saved


def diagnostics_tree(result: MapResult) -> xr.DataTree:
    """Contents of diagnostics.nc: all other results, a group for each frequency."""
    groups = {}
    for channel in result.channels:
        kept = replace(channel, draws=channel.draws[:0], log_likelihood=channel.log_likelihood[:0])
        kept = replace(kept, covariance=None, information=None)
        groups[f"{channel.frequency_mhz:.15g}"] = to_tree(kept)
    root = xr.Dataset(attrs=formats.header(formats.DIAGNOSTICS) | attributes_of(result.scenario))
    return xr.DataTree(root, children=groups)


def spectrum_tree(result: MapResult) -> xr.DataTree:
    """Contents of spectrum.nc: temperatures of regions with the covariance of all frequencies."""
    tree = to_tree(result.sky_spectrum())
    tree.attrs |= {"Conventions": "CF-1.13", "format": formats.SPECTRUM}
    tree.attrs |= attributes_of(result.scenario)
    return tree


def read_channels(path: str | Path) -> tuple[ChannelResult, ...]:
    """Read the channels of a finished run from its diagnostics.nc. InputError for anything else."""
    what = "diagnostics of lusee-bayes map"
    with opened_tree(path, formats.DIAGNOSTICS, what, "lusee-bayes map writes one") as tree:
        named = sorted(tree.children.items(), key=lambda one: float(one[0]))
        if not named:
            raise InputError(f"{path} has no channels; map again")
        return tuple(from_tree(ChannelResult, one, f"{path}: {f} MHz") for f, one in named)


def attributes_of(scenario: Scenario) -> dict[str, object]:
    """Metadata of a file's numbers: lmax, frame, basis, versions, scenario."""
    return {
        "lmax": scenario.lmax,
        "frame": "galactic",
        "basis": "real orthonormal spherical harmonics, index ell^2 + ell + m",
        "versions": json.dumps(versions()),
        "scenario": scenario.to_yaml(),
    }


NAME = "provenance.json"


def taken(observation: Observation) -> dict[str, Any]:
    """When and where data were observed: first and last time, step, number of times, site."""
    return {
        "first": str(observation.times[0].isot)[:19],
        "last": str(observation.times[-1].isot)[:19],
        "step_s": float(observation.step_s),
        "n_times": int(observation.n_times),
        "lon_deg": float(observation.lon_deg),
        "lat_deg": float(observation.lat_deg),
    }


def taken_together(channels: Sequence[ChannelResult]) -> dict[str, Any]:
    """The same for all channels: the first and the last time, and the largest number of times."""
    parts = [channel.taken for channel in channels]
    most = {"first": min, "last": max, "n_times": max}
    return parts[0] | {name: of(part[name] for part in parts) for name, of in most.items()}


class Provenance(BaseModel, frozen=True):
    """Where the results of a run come from.

    Attributes
    ----------
    file : str
        File of the data; empty if the run simulated them.
    known_sky : bool
        Whether the data are simulated, by this run or another, so that their sky is known.
    seed : int
        Seed of the scenario.
    first, last : str
        Times of the first and the last sample, UTC.
    step_s : float
    n_times : int
    lon_deg, lat_deg : float
        Selenographic coordinates of the site.
    lmax : int
    command : str
        The command line; empty for a call of the library.
    version : str
        Version of the package, with its commit if known.
    made : str
        When the results were made, UTC.
    """

    file: str
    known_sky: bool
    seed: int
    first: str
    last: str
    step_s: float
    n_times: int
    lon_deg: float
    lat_deg: float
    lmax: int
    command: str
    version: str
    made: str

    @classmethod
    def of(
        cls, scenario: Scenario, times: Mapping[str, Any], data: Data | None, *, known_sky: bool
    ) -> Provenance:
        """Provenance of a run with an observation's data (:func:`taken`), given or simulated."""
        return cls(
            file="" if data is None else ", ".join(names_of_data(data)),
            known_sky=known_sky,
            seed=scenario.seed,
            **times,
            lmax=scenario.lmax,
            command=COMMAND.get(),
            version=release(),
            made=datetime.now(UTC).isoformat(timespec="seconds").removesuffix("+00:00"),
        )

    @classmethod
    def of_experiment(cls, experiment: Experiment, data: Data | None) -> Provenance:
        """Provenance of a run with an experiment's data."""
        times = taken(experiment.data.observation)
        return cls.of(experiment.scenario, times, data, known_sky=experiment.data.truth is not None)

    @classmethod
    def read(cls, folder: Path) -> Provenance:
        """Read what :meth:`write` wrote. InputError if the file is missing or cannot be read."""
        return read_model(folder / NAME, cls, "the provenance of a run's results")

    def write(self, folder: Path) -> None:
        """Write provenance.json."""
        (folder / NAME).write_text(self.model_dump_json(indent=2) + "\n", encoding="utf-8")

    def data_line(self) -> str:
        """Whether the data are measured or simulated, and where they come from."""
        if not self.file:
            return f"simulated by this run, seed {self.seed}"
        if self.known_sky:
            return f"simulated: {self.file}, compared with its true sky"
        return f"measured: {self.file}"


@dataclass(frozen=True)
class FinishedRun:
    """A finished map run: the name of its folder, its channels, and their origin."""

    name: str
    channels: tuple[ChannelResult, ...]
    provenance: Provenance

    @property
    def channel(self) -> ChannelResult:
        """The first channel, which is the only one in a map of one frequency."""
        return self.channels[0]

    def cross_in_words(self) -> str:
        """First ell with SNR < 1, "> lmax" if there is none, or "no truth"."""
        if (cross := self.channel.ell_cross) is not None:
            return str(cross)
        lmax = len(self.channel.prior_fraction) - 1
        return "no truth" if self.channel.truth is None else f"> {lmax}"

    def log_evidence(self) -> float:
        """ln p(d) of the first channel, with the parameters of a learned prior integrated out."""
        learned = self.channel.log_evidence_learned
        return self.channel.log_evidence if learned is None else learned

    def against_truth(self) -> dict[str, float | None]:
        """Error of the first channel's map in K, pixels within 68 % intervals, and largest pull."""
        maps, error, held, largest = self.channel.maps(), None, None, None
        if "residual" in maps:
            error = float(np.sqrt((maps["residual"] ** 2).mean()))
            whole_sky = self.channel.coverage[-1]
            held, largest = whole_sky.held[LEVELS.index(0.68)], whole_sky.largest
        return {"rms_error_k": error, "held_68": held, "largest_pull": largest}

    def sky_spectrum(self) -> SkySpectrum:
        """The spectrum of the sky. InputError for one channel."""
        if len(self.channels) == 1:
            wrong = f"'{self.name}' has one frequency; make a map with --frequencies 5:50:1"
            raise InputError(wrong)
        return spectrum_of(self.channels)

    @classmethod
    def read(cls, folder: str | Path) -> FinishedRun:
        """Read a folder; InputError unless it is that of a finished map run."""
        folder = user_path(folder)
        recover(folder)
        require_files(folder, ("summary.json", "diagnostics.nc"), "map")
        channels = read_channels(folder / "diagnostics.nc")
        return cls(folder.resolve().name, channels, Provenance.read(folder))


def read_runs(folders: Sequence[str | Path]) -> list[FinishedRun]:
    """Read two or more runs with different names; InputError for fewer."""
    if len(folders) < 2:
        raise InputError(f"give at least two folders to compare, got {len(folders)}")
    runs = [FinishedRun.read(folder) for folder in folders]
    for number, run in enumerate(runs):
        if run.name in [other.name for other in runs[:number]]:
            raise InputError(f"two of the folders are named '{run.name}'; rename one of them")
        if len(run.channels) > 1 or run.channel.judged is None:
            wrong = f"'{run.name}' has several frequencies; give folders of single-frequency maps"
            raise InputError(wrong)
    return runs


def evidence_caveat(runs: Sequence[FinishedRun]) -> str | None:
    """State why the evidences of runs must not be compared: their data differ.

    Returns
    -------
    str or None
        None if all runs map the same data.
    """
    first, *others = runs
    reasons = [f"{run.name} {why}" for run in others if (why := _difference(first, run))]
    if not reasons:
        return None
    against = f"Compared with {first.name}, {'; '.join(reasons)}."
    return f"Do not compare the evidences: the runs used different data. {against}"


def _difference(first: FinishedRun, run: FinishedRun) -> str | None:
    """How the data of a run differ from those of the first, in words; None if they agree."""
    ours, theirs = (one.channel.data for one in (first, run))
    if first.channel.digests[:-1] != run.channel.digests[:-1]:
        return "was added to other earlier data (--add), or to none"
    frequencies = [one.channel.frequency_mhz for one in (first, run)]
    if frequencies[0] != frequencies[1]:
        return f"is at {frequencies[1]:g} MHz instead of {frequencies[0]:g}"
    if ours.shape != theirs.shape:
        sizes = [f"{a.shape[0]} products at {a.shape[1]} times" for a in (ours, theirs)]
        return f"has {sizes[1]} instead of {sizes[0]}"
    if (np.isnan(ours) != np.isnan(theirs)).any():
        counts = [int(np.isfinite(a).sum()) for a in (ours, theirs)]
        return f"uses {counts[1]} samples instead of {counts[0]}, or different ones"
    used = np.isfinite(ours)
    if np.array_equal(ours[used], theirs[used]):
        return None
    scale = float(np.vdot(ours[used], theirs[used]) / np.vdot(ours[used], ours[used]))
    if np.allclose(theirs[used], scale * ours[used], rtol=1e-6, atol=0.0):
        return f"has the same data in a different unit (factor {scale:.6g})"
    if not np.array_equal(first.channel.hours, run.channel.hours):
        return "was observed at different times"
    return "has different values at the same times (a different file, noise, sky or seed)"


# figures of channels that are compared
COMPARED = ("frequency_mhz", "n_data", "ell_cross", "resolution_deg", "information_bits")
COMPARED += ("chi2", "chi2_expected")


def comparison_rows(runs: Sequence[FinishedRun]) -> list[dict[str, object]]:
    """One row for each run, with the figures that show which map is better.

    ln p(d) has the parameters of a learned prior integrated out. Its difference is None if the data
    differ; error, coverage and largest pull are None unless the sky is known.
    """
    best = max(run.log_evidence() for run in runs)
    comparable = evidence_caveat(runs) is None
    return [
        {
            "run": run.name,
            "level": run.channel.judged.level,
            **{key: getattr(run.channel, key) for key in COMPARED},
            "log_evidence": run.log_evidence(),
            "log_evidence_less_best": run.log_evidence() - best if comparable else None,
            "instrument_p": run.channel.instrument.p,
            "prior_p": run.channel.judged.prior.p,
            "mean_std_k": float(run.channel.pixel_std.mean()),
            **run.against_truth(),
        }
        for run in runs
    ]
