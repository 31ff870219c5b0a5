"""Saved posteriors to which new data can be added (``map --updatable``, ``--onto``)."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from lusee_bayes.core import formats
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.files import recover, user_path
from lusee_bayes.core.formats import read_netcdf
from lusee_bayes.core.harmonics import n_modes, power_spectrum
from lusee_bayes.core.reading import reading
from lusee_bayes.experiment.scenario import Scenario
from lusee_bayes.linear.posterior import Posterior
from lusee_bayes.results.saved import HINT, UPDATABLE
from lusee_bayes.sky.prior import DensePrior, HarmonicPrior, Prior


@dataclass(frozen=True)
class Updatable:
    """A saved posterior to which new data can be added, and the digests of the data behind it."""

    posterior: Posterior
    digests: tuple[str, ...]


def read_updatable(folder: str | Path, scenario: Scenario) -> Updatable:
    """The posterior of an updatable run (``map --updatable``) at the scenario's frequency.

    InputError if the folder has none, or one of another frequency or lmax.
    """
    recover(folder)
    path = user_path(folder) / "posterior.nc"
    saved = read_netcdf(path, formats.POSTERIOR, UPDATABLE, HINT)
    here, said = saved.arrays, saved.values
    needed = {"precision_root", "white_mean", "log_evidence", "data_digests"}
    if not needed <= {*here, *said}:
        raise InputError(
            f"{path} does not hold what an update needs; make that map again with --updatable"
        )
    for name in ("frequency_mhz", "lmax"):
        if said[name] != getattr(scenario, name):
            raise InputError(
                f"{path} is of {name} {said[name]:.12g}, the scenario of "
                f"{getattr(scenario, name):.12g}; use --set {name}={said[name]!r}"
            )
    n = n_modes(scenario.lmax)
    if here["precision_root"].shape != (n, n) or len(here["mean"]) != n:
        raise InputError(
            f"{path} holds {len(here['mean'])} modes, expected {n} for lmax = {scenario.lmax}"
        )
    none = jnp.zeros(())
    posterior = Posterior(
        _prior(here),
        jnp.asarray(here["white_mean"]),
        jnp.asarray(here["precision_root"]),
        None,
        none + said["log_evidence"],
        none,
    )
    with reading(path, UPDATABLE.what):
        digests = tuple(str(digest) for digest in json.loads(said["data_digests"]))
    return Updatable(posterior, digests)


def _prior(arrays: Mapping[str, Float[np.ndarray, "..."]]) -> Prior:
    """The prior that :func:`.posterior_dataset` wrote."""
    mean = jnp.asarray(arrays["prior_mean"]) if "prior_mean" in arrays else None
    if "prior_root" in arrays:
        return DensePrior(jnp.asarray(arrays["prior_root"]), mean=mean)
    return HarmonicPrior(jnp.asarray(power_spectrum(arrays["prior_std"])), mean=mean)
