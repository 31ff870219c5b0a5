"""What a report shows beyond the map: computed once, kept in diagnostics.nc.

Residuals of data against the prediction of the rest, draws as maps, the prior's share of every
pixel, posterior of regions, and point-spread functions.
"""

from __future__ import annotations

import numpy as np
import xarray as xr
from jaxtyping import Float, Int8

from lusee_bayes.core import formats
from lusee_bayes.core.arrays import DataVector, Grid, Modes, ModesMatrix, on_host
from lusee_bayes.core.harmonics import (
    azimuth_functions,
    lmax_of,
    mean_over_m,
    mode_numbers,
    modes_to_map,
    polar_functions,
)
from lusee_bayes.core.lazy import healpy
from lusee_bayes.experiment.draws import posterior_draws
from lusee_bayes.experiment.experiment import Experiment
from lusee_bayes.experiment.rounds import Inference
from lusee_bayes.judge.chi2 import ChiSquare
from lusee_bayes.judge.measures import strengths, strengths_in_words
from lusee_bayes.judge.residuals import Residuals
from lusee_bayes.linear.posterior import prior_pixel_std
from lusee_bayes.results.channel import ChannelResult
from lusee_bayes.results.diagnostics_file import group_variables
from lusee_bayes.sky.prior import Prior

REGION_NSIDE = 8
N_DRAWS = 4
# of a byte with its sign
LARGEST_STEP = 127


def diagnostics(
    experiment: Experiment,
    inference: Inference,
    found: Residuals,
    channel: ChannelResult,
    covariance: ModesMatrix,
) -> xr.Dataset:
    """Work out what a report shows beyond the map itself.

    Parameters
    ----------
    experiment : Experiment
    inference : Inference
        The model and its posterior, given all data.
    found : Residuals
        Of the data, in the model that predicts them.
    channel : ChannelResult
    covariance : (modes, modes) array
        Of the posterior, in K^2.

    Returns
    -------
    xarray.Dataset
        On dims pixel (HEALPix RING of the maps), region, kernel_pixel, draw, product, time, group.
    """
    scenario, data = experiment.scenario, experiment.data
    posterior, nside, lmax = on_host(inference.posterior), channel.nside, experiment.scenario.lmax
    skies = posterior_draws(experiment, posterior, N_DRAWS)
    draws = np.stack([modes_to_map(sky, nside) for sky in skies])
    prior = on_host(inference.model.prior)
    usual = 0.0 if prior.white_mean is None else prior.colour(prior.white_mean)
    deviation = channel.mean - usual
    known, steps, widths = packed_resolution(covariance, prior)
    monopole = 1.0 / np.sqrt(4.0 * np.pi)
    with_monopole = 2.0 * modes_to_map(covariance[0], nside) - monopole * covariance[0, 0]
    left = channel.pixel_std**2 - monopole * with_monopole
    # the prior leaves the monopole wide open, which any data settle; with it the prior's share
    # would be close to zero everywhere
    rest_prior = prior_pixel_std(prior, nside) ** 2
    share = left / rest_prior
    expected = prior.variance() - np.diagonal(covariance)
    strong = strengths_in_words(strengths(deviation, expected, rest_prior - left))
    fit = found.fit(strong)
    rows = region_rows(nside, lmax)
    seen = rows @ covariance
    region_variance = (seen * rows).sum(1)
    with_monopole = 2.0 * seen[:, 0] - rows[:, 0] * covariance[0, 0]
    without = np.where(np.arange(len(covariance)) > 0, rows, 0.0)
    region_prior = (prior.colour_columns(without) ** 2).sum(1)
    region_share = (region_variance - rows[:, 0] * with_monopole) / region_prior

    def on_grid(values: DataVector) -> Grid:
        return np.where(data.layout.present, data.layout.scatter(values), np.nan)

    kelvin = {"units": "K"}
    variables = {
        "prior_fraction": ("pixel", share),
        "highest_altitude": ("pixel", channel.highest_altitude, {"units": "sin"}),
        "draws": (("draw", "pixel"), draws, kelvin),
        "region_mean": ("region", rows @ channel.mean, kelvin),
        "region_std": ("region", np.sqrt(region_variance), kelvin),
        "region_prior_fraction": ("region", region_share),
        "resolution": (("mode", "mode_2"), known),
        "resolution_step": (("ell", "ell_2"), steps),
        "prior_std": ("mode", widths, kelvin),
        "data": (("product", "time"), data.grid(), kelvin),
        "predicted": (("product", "time"), on_grid(found.predicted), kelvin),
        "z": (("product", "time"), on_grid(found.z), {"units": "standard deviations"}),
        **group_variables(found.groups),
    }
    return xr.Dataset(
        variables,
        coords={"product": list(data.labels), "hours": ("time", data.observation.hours)},
        attrs={
            "format": formats.DIAGNOSTICS,
            "level": fit.level,
            "verdict": fit.text,
            **_chi2("instrument", found.split.instrument),
            **_chi2("prior", found.split.prior),
            "extremes": list(map(str, found.extremes())) or "none",
            "suspects": list(map(str, found.suspects())) or "none",
            "frequency_mhz": scenario.frequency_mhz,
        },
    )


def _chi2(name: str, part: ChiSquare) -> dict[str, float]:
    return {f"{name}_chi2": part.chi2, f"{name}_chi2_expected": part.degrees, f"{name}_p": part.p}


def packed_resolution(
    covariance: ModesMatrix, prior: Prior
) -> tuple[Int8[np.ndarray, "modes modes"], Float[np.ndarray, "ells ells"], Modes]:
    """Pack what the data know of the modes, for point-spread functions of any direction.

    The resolution matrix is R = 1 - C S^-1 = D K D^-1, with D the prior's standard deviations; of
    modes that are correlated, those of whole multipoles, since one mode may be 60 times as wide as
    another. K, which is symmetric where S is diagonal, is kept with a byte for each entry, in steps
    of its pair of multipoles.

    Parameters
    ----------
    covariance : (modes, modes) array
        Of the posterior, in K^2.
    prior : Prior
        S, over the same modes, with NumPy's arrays.

    Returns
    -------
    (modes, modes) array of int8
        In steps; zero for modes without prior variance.
    (ells, ells) array
        The steps.
    (modes,) array
        D, in K.
    """
    variance = np.asarray(prior.variance())
    ell, _ = mode_numbers(lmax_of(len(variance)))
    width = np.sqrt(variance if prior.independent else mean_over_m(variance)[ell])
    power = width > 0
    # row by row, D^-1 C S^-1 D
    left = prior.whiten_columns(prior.whiten(covariance))
    left *= np.divide(width[None], width[:, None], out=np.zeros(left.shape), where=power[:, None])
    white = np.diag(power.astype(np.float64)) - left
    if prior.independent:  # but for rounding
        white = (white + white.T) / 2.0
    starts = np.flatnonzero(np.diff(ell, prepend=-1))
    largest = np.maximum.reduceat(np.abs(white), starts, axis=0)
    largest = np.maximum.reduceat(largest, starts, axis=1)
    steps = np.where(largest > 0, largest, 1.0) / LARGEST_STEP
    return np.rint(white / steps[np.ix_(ell, ell)]).astype(np.int8), steps, width


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
    theta, phi = healpy.pix2ang(nside, np.arange(len(of)))
    heights, ring = np.unique(theta, return_inverse=True)
    # pixels of a region on one ring have lambda_l|m|(theta) in common
    part = of * len(heights) + ring
    by_part = np.argsort(part, kind="stable")
    _, first = np.unique(part[by_part], return_index=True)
    parts = by_part[first]
    sums = np.add.reduceat(azimuth_functions(phi, lmax)[by_part], first)
    _, m = mode_numbers(lmax)
    rows = polar_functions(heights, lmax)[ring[parts]] * sums[:, m + lmax]
    _, first = np.unique(of[parts], return_index=True)
    return np.add.reduceat(rows, first) / np.bincount(of)[:, None]
