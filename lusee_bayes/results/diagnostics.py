"""What a report shows beyond the map itself, computed once and kept in diagnostics.nc.

Residuals of data against the prediction of the rest, draws as maps, the prior's share of every
pixel, posterior of regions, and point-spread functions.
"""

from __future__ import annotations

from pathlib import Path

import healpy
import jax
import numpy as np
import xarray as xr
from jaxtyping import Float

from lusee_bayes.core import formats
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.harmonics import modes_to_map, pixel_matrix
from lusee_bayes.experiment.experiment import Experiment
from lusee_bayes.experiment.inference import Inference
from lusee_bayes.experiment.model import base_model
from lusee_bayes.linear.residuals import Group, residuals
from lusee_bayes.linear.resolution import resolution_rows
from lusee_bayes.results.channel import ChannelResult, draw_key

# regions and the directions of point-spread functions, and the maps these are drawn on
REGION_NSIDE, KERNEL_NSIDE = 8, 16
N_DRAWS = 4
# point-spread functions are kept in units of this part of their peak
KERNEL_STEP = 1.0 / 127.0


def require_judgeable(experiment: Experiment) -> None:
    """InputError for more data than can be judged one by one, which needs the whole of A."""
    if base_model(experiment.setup, experiment.data).too_large:
        raise InputError(
            f"{experiment.data.layout.size} data are too many to judge each by all others, which "
            f"needs the whole of A; use --frequencies {experiment.scenario.frequency_mhz:g} for a "
            "map without that"
        )


def diagnostics(
    experiment: Experiment, inference: Inference, judged: Inference, channel: ChannelResult
) -> xr.Dataset:
    """Work out what a report shows beyond the map itself.

    Parameters
    ----------
    experiment : Experiment
    inference : Inference
        The model and its posterior, given all data.
    judged : Inference
        The model that predicts the data: given the earlier ones, where there are any.
    channel : ChannelResult

    Returns
    -------
    xarray.Dataset
        On dims pixel (HEALPix RING of the maps), region, kernel_pixel, draw, product, time, group.
    """
    scenario, posterior, data = experiment.scenario, inference.posterior, experiment.data
    nside = channel.nside
    found = residuals(judged.model, judged.posterior, data)
    layout = data.layout
    draws = np.asarray(posterior.sample(draw_key(scenario), N_DRAWS))
    rows = region_rows(nside, scenario.lmax)
    rows_std = np.asarray(posterior.std_of(rows))
    centres = pixel_matrix(region_nside(nside), scenario.lmax)
    kernels = np.asarray(resolution_rows(posterior, centres))
    kernels = kernels @ pixel_matrix(KERNEL_NSIDE, scenario.lmax).T
    peaks = np.abs(kernels).max(axis=1)
    safe = np.where(peaks > 0, peaks, 1.0)

    def on_grid(values: Float[np.ndarray, " data"]) -> Float[np.ndarray, "products times"]:
        grid = np.asarray(layout.scatter(jax.numpy.asarray(values)))
        return np.where(np.asarray(layout.present), grid, np.nan)

    kelvin = {"units": "K"}
    variables = {
        "prior_fraction": ("pixel", prior_fraction(inference, pixel_matrix(nside, scenario.lmax))),
        "highest_altitude": ("pixel", channel.highest_altitude, {"units": "sin"}),
        "draws": (("draw", "pixel"), np.stack([modes_to_map(d, nside) for d in draws]), kelvin),
        "region_mean": ("region", rows @ np.asarray(posterior.mean), kelvin),
        "region_std": ("region", rows_std, kelvin),
        "region_prior_fraction": ("region", prior_fraction(inference, rows)),
        "psf": (("region", "kernel_pixel"), kernels / safe[:, None]),
        "psf_peak": ("region", peaks, {"units": "1/sr"}),
        "data": (("product", "time"), data.grid(), kelvin),
        "predicted": (("product", "time"), on_grid(found.predicted), kelvin),
        "z": (("product", "time"), on_grid(found.z), {"units": "standard deviations"}),
        **_groups({"product": found.products, "day": found.days, "angle": found.angles}),
    }
    return xr.Dataset(
        variables,
        coords={"product": list(data.labels), "hours": ("time", data.observation.hours)},
        attrs={
            "format": formats.DIAGNOSTICS,
            "verdict": found.verdict(),
            "chi2": found.chi2,
            "p": found.p,
            "suspects": [f"{kind} {group.name}" for kind, group in found.suspects()] or "none",
            "frequency_mhz": scenario.frequency_mhz,
        },
    )


def write_diagnostics(dataset: xr.Dataset, path: Path) -> None:
    """Write to netCDF; point-spread functions with a byte for each value, of their peak."""
    byte = {"dtype": "int8", "scale_factor": KERNEL_STEP, "_FillValue": -128, "zlib": True}
    single = {name: {"dtype": "float32"} for name in ("draws", "prior_fraction")}
    dataset.to_netcdf(path, engine="h5netcdf", encoding={"psf": byte, **single})


def read_diagnostics(path: str | Path) -> xr.Dataset:
    """What :func:`write_diagnostics` wrote. InputError for anything else."""
    try:
        with xr.open_dataset(path, engine="h5netcdf") as file:
            dataset = file.load()
    except (OSError, ValueError) as error:
        raise InputError(f"'{path}' cannot be read as diagnostics: {error}") from error
    if dataset.attrs.get("format") != formats.DIAGNOSTICS:
        raise InputError(
            f"'{path}' is not a file of diagnostics: its format is "
            f"'{dataset.attrs.get('format')}', expected '{formats.DIAGNOSTICS}' (lusee-bayes map "
            "writes one)"
        )
    return dataset


def region_nside(nside: int) -> int:
    """NSIDE of the regions of a map: REGION_NSIDE, or the map's own if that is coarser."""
    return min(REGION_NSIDE, nside)


def region_of(nside: int) -> np.ndarray:
    """The region (HEALPix RING of :func:`region_nside`) that each pixel (RING) belongs to."""
    nested = healpy.ring2nest(nside, np.arange(healpy.nside2npix(nside)))
    coarse = region_nside(nside)
    return healpy.nest2ring(coarse, nested // (nside // coarse) ** 2)


def region_rows(nside: int, lmax: int) -> Float[np.ndarray, "regions modes"]:
    """Rows that average the pixels of a map over each region."""
    of = region_of(nside)
    n = healpy.nside2npix(region_nside(nside))
    rows = np.zeros((n, (lmax + 1) ** 2))
    np.add.at(rows, of, pixel_matrix(nside, lmax))
    return rows / np.bincount(of, minlength=n)[:, None]


def prior_fraction(
    inference: Inference, rows: Float[np.ndarray, "directions modes"]
) -> Float[np.ndarray, " directions"]:
    """Share of the variance that is left from the prior, of what is not the monopole.

    The prior leaves the monopole wide open, which any data settle; with it the share would be close
    to zero everywhere.

    Parameters
    ----------
    inference : Inference
    rows : (directions, modes) array
        Linear combinations of the coefficients, such as pixels.
    """
    rows = rows.copy()
    rows[:, 0] = 0.0
    prior = rows**2 @ np.asarray(inference.model.prior.variance())
    return np.asarray(inference.posterior.std_of(rows)) ** 2 / prior


def _groups(kinds: dict[str, tuple[Group, ...]]) -> dict[str, tuple[str, np.ndarray]]:
    """One row for every group that was left out."""
    groups = [(kind, group) for kind, found in kinds.items() for group in found]
    return {
        "group_kind": ("group", np.array([kind for kind, _ in groups])),
        "group_name": ("group", np.array([group.name for _, group in groups])),
        "group_n": ("group", np.array([group.n for _, group in groups])),
        "group_chi2": ("group", np.array([group.chi2 for _, group in groups])),
        "group_p": ("group", np.array([group.p for _, group in groups])),
        "group_others_p": ("group", np.array([group.others_p for _, group in groups])),
    }
