"""Saved posteriors to which new data can be added (``map --updatable``, ``--onto``)."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import xarray as xr

from lusee_bayes.core.errors import InputError
from lusee_bayes.core.files import recover
from lusee_bayes.core.harmonics import power_spectrum
from lusee_bayes.experiment.scenario import Scenario
from lusee_bayes.linear.posterior import Posterior
from lusee_bayes.sky.priors import HarmonicPrior


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
    path = Path(folder) / "posterior.nc"
    if not path.is_file():
        raise InputError(f"'{folder}' has no posterior.nc; give the folder of a finished map run")
    with xr.open_dataset(path, engine="h5netcdf") as file:
        saved = file.load()
    if "precision_root" not in saved:
        raise InputError(
            f"{path} does not hold what an update needs; make that map anew with --updatable"
        )
    for name in ("frequency_mhz", "lmax"):
        if saved.attrs[name] != getattr(scenario, name):
            raise InputError(
                f"{path} is of {name} {saved.attrs[name]:g}, the scenario of "
                f"{getattr(scenario, name):g}; use --set {name}={saved.attrs[name]:g}"
            )
    spectrum = power_spectrum(np.asarray(saved["prior_std"]))
    none = jnp.zeros(())
    posterior = Posterior(
        HarmonicPrior(jnp.asarray(spectrum)),
        jnp.asarray(np.asarray(saved["white_mean"])),
        jnp.asarray(np.asarray(saved["precision_root"])),
        None,
        none + float(saved.attrs["log_evidence"]),
        none,
    )
    return Updatable(posterior, tuple(json.loads(saved.attrs["data_digests"])))
