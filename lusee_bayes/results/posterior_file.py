"""posterior.nc of a map: mean, standard deviations, and what was asked for besides."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import xarray as xr

from lusee_bayes.core import formats
from lusee_bayes.core.harmonics import mode_numbers
from lusee_bayes.core.version import versions
from lusee_bayes.experiment.scenario import Scenario
from lusee_bayes.results.map_result import MapResult
from lusee_bayes.sky.priors import Prior


def write_posterior(result: MapResult, path: Path) -> None:
    """Write posterior.nc."""
    posterior_dataset(result).to_netcdf(path, engine="h5netcdf")


def posterior_dataset(result: MapResult) -> xr.Dataset:
    """What posterior.nc holds: on dim ``mode`` with coords ``ell``, ``m``; all in K (K^2).

    ``covariance`` and, for :func:`.read_updatable`, L of the precision in units of the prior are
    there where the scenario's ``output`` asks for them.
    """
    scenario, posterior = result.scenario, result.inference.posterior
    ell, m = mode_numbers(scenario.lmax)
    variables = {
        name: (*value, {"units": "K"}) for name, value in result.channel.variables().items()
    }
    attrs = {"format": formats.POSTERIOR, **about(scenario)}
    if scenario.output.covariance:
        matrix = np.asarray(posterior.covariance())
        variables["covariance"] = (("mode", "mode_2"), matrix, {"units": "K2"})
    if scenario.output.updatable:
        lower = np.tril(np.asarray(posterior.lower))
        variables["precision_root"] = (("mode", "mode_2"), lower)
        variables["white_mean"] = ("mode", np.asarray(posterior.white_mean))
        variables |= _prior_variables(posterior.prior)
        attrs["log_evidence"] = float(posterior.log_evidence)
        attrs["data_digests"] = json.dumps(result.digests)
    return xr.Dataset(variables, coords={"ell": ("mode", ell), "m": ("mode", m)}, attrs=attrs)


def _prior_variables(prior: Prior) -> dict[str, tuple]:
    """What ``prior_std`` does not tell of the prior."""
    variables = {}
    if not prior.independent:
        root = np.asarray(prior.colour(np.eye(prior.rank))).T
        variables["prior_root"] = (("mode", "mode_2"), root, {"units": "K"})
    if prior.white_mean is not None:
        mean = np.asarray(prior.colour(prior.white_mean))
        variables["prior_mean"] = ("mode", mean, {"units": "K"})
    return variables


def about(scenario: Scenario) -> dict[str, object]:
    """What a file has to say of its numbers: frequency, frame, versions, scenario."""
    return {
        "frequency_mhz": scenario.frequency_mhz,
        "lmax": scenario.lmax,
        "frame": "galactic",
        "basis": "real orthonormal spherical harmonics, index ell^2 + ell + m",
        "versions": json.dumps(versions()),
        "scenario": scenario.to_yaml(),
    }
