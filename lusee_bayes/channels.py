"""The channels of a run, one after the other: each leaves a file, so that memory stays bounded and
an interrupted run goes on where it was.

``DIR/channels/25.information.nc`` holds what a channel's data say (:class:`Information`) with its
sky and prior, ``25.result.nc`` its posterior. Files of other scenarios or data are made anew.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from threading import Event, Lock
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr
from jaxtyping import Array, Float

from lusee_bayes.checks import InputError
from lusee_bayes.data_files import read_data
from lusee_bayes.devices import Fleet
from lusee_bayes.experiment import Experiment
from lusee_bayes.harmonics import sum_over_m
from lusee_bayes.information import Information
from lusee_bayes.joint import ChannelSky
from lusee_bayes.metrics import highest_altitude
from lusee_bayes.pixel_variance import pixel_std
from lusee_bayes.posterior import Posterior
from lusee_bayes.progress import Stages
from lusee_bayes.scenario import Scenario
from lusee_bayes.staging import replacing
from lusee_bayes.version import __version__

FOLDER = "channels"
# threads that share a device
LANES = 2
T = TypeVar("T")
# what the seed of a channel is folded with for its draws and its perturbations
DRAWS, PERTURBATIONS = 1, 7


@dataclass(frozen=True)
class Channel:
    """One frequency: its scenario, and the file that its data are in (None: they are simulated).

    truth : the data of the file are of the scenario's own sky
    """

    scenario: Scenario
    data: Path | None = None
    truth: bool = False

    @property
    def name(self) -> str:
        """Of its files: the frequency in MHz."""
        return f"{self.scenario.frequency_mhz:g}"

    def key(self, purpose: int) -> Array:
        """The key of one kind of draws."""
        return jax.random.fold_in(jax.random.key(self.scenario.seed), purpose)


@dataclass(frozen=True)
class Told:
    """What a channel's data say, with what it takes to make a posterior of it and to judge it.

    posterior : of these data alone (None once read from a file); sky : the scenario's model sky
    (modes,), in K; spectrum : C_ell of the channel's own prior; truth : None where it is not known;
    never_observed : share of the sky
    """

    information: Information
    posterior: Posterior | None
    sky: Float[np.ndarray, " modes"]
    spectrum: Float[np.ndarray, " ells"]
    truth: Float[np.ndarray, " modes"] | None
    n_missing: int
    never_observed: float

    @classmethod
    def of(cls, channel: Channel, n_perturbations: int = 0) -> Told:
        """Read or simulate the data of a channel, and work out what they say."""
        scenario = channel.scenario
        measured = None if channel.data is None else read_data(channel.data, scenario)
        experiment = Experiment.from_scenario(scenario, measured)
        data = experiment.simulate() if measured is None else measured
        gain = scenario.noise.gain
        if gain is not None and gain.visibilities == "posterior":
            model = experiment.infer(data)[0]
        else:
            model = experiment.model(data)
        truth = data.truth if not channel.truth else experiment.sky.modes
        hidden = highest_altitude(data.observation, scenario.map_nside) < 0
        return cls(
            *model.inform(data.data, channel.key(PERTURBATIONS), n_perturbations),
            np.asarray(experiment.sky.modes),
            np.asarray(experiment.prior.spectrum),
            None if truth is None else np.asarray(truth),
            data.n_missing,
            float(hidden.mean()),
        )

    def to_dataset(self) -> xr.Dataset:
        """All of it, for :meth:`from_dataset`."""
        told = self.information
        variables = {
            "matrix": (("mode", "mode_2"), np.asarray(told.matrix)),
            "vector": ("mode", np.asarray(told.vector)),
            "about": ("mode", np.asarray(told.about)),
            "sky": ("mode", self.sky),
            "spectrum": ("ell", self.spectrum),
        }
        if self.truth is not None:
            variables["truth"] = ("mode", self.truth)
        if told.perturbations is not None:
            variables["perturbations"] = (("draw", "mode"), np.asarray(told.perturbations))
        numbers = {
            "misfit": float(told.misfit),
            "log_det": float(told.log_det),
            "n_data": float(told.n_data),
            "n_missing": self.n_missing,
            "never_observed": self.never_observed,
        }
        return xr.Dataset(variables, attrs=numbers)

    @classmethod
    def from_dataset(cls, dataset: xr.Dataset) -> Told:
        """The inverse of :meth:`to_dataset`."""
        arrays = {name: np.asarray(values) for name, values in dataset.data_vars.items()}
        noise = arrays.get("perturbations")
        information = Information(
            *(jnp.asarray(arrays[name]) for name in ("matrix", "vector", "about")),
            *(jnp.asarray(float(dataset.attrs[n])) for n in ("misfit", "log_det", "n_data")),
            None if noise is None else jnp.asarray(noise),
        )
        return cls(
            information,
            None,
            arrays["sky"],
            arrays["spectrum"],
            arrays.get("truth"),
            int(dataset.attrs["n_missing"]),
            float(dataset.attrs["never_observed"]),
        )

    def alone(self, channel: Channel, n_draws: int) -> ChannelSky:
        """The posterior of this channel's data alone, just worked out."""
        found = self.posterior
        covariance = found.covariance()
        expected = self.information.n_data - (self.information.matrix * covariance).sum()
        return ChannelSky(
            found.mean,
            covariance,
            found.sample(channel.key(DRAWS), n_draws),
            self.information.chi2(found.mean),
            expected,
        )


class ChannelFiles:
    """The folder of a run's channels.

    identity : of the run, whose files alone are taken up again
    """

    def __init__(self, folder: Path, identity: str):
        self.folder = folder / FOLDER
        self.identity = identity

    def path(self, channel: Channel, kind: str) -> Path:
        """Of the ``information`` or the ``result`` of a channel."""
        return self.folder / f"{channel.name}.{kind}.nc"

    def has(self, channel: Channel, kind: str) -> bool:
        """Whether it is there, whole and of this run."""
        path = self.path(channel, kind)
        if not path.is_file():
            return False
        with xr.open_dataset(path, engine="h5netcdf") as file:
            return file.attrs.get("identity") == self.identity

    def write(self, channel: Channel, kind: str, dataset: xr.Dataset) -> None:
        """Whole or not at all."""
        with replacing(self.path(channel, kind)) as partial:
            dataset.assign_attrs(identity=self.identity).to_netcdf(partial, engine="h5netcdf")

    def read(self, channel: Channel, kind: str, names: list[str] | None = None) -> xr.Dataset:
        """All of it, or some variables."""
        with xr.open_dataset(self.path(channel, kind), engine="h5netcdf") as file:
            return (file if names is None else file[[n for n in names if n in file]]).load()

    def forget(self) -> None:
        """Remove the files of channels: the run's own results are complete."""
        for path in self.folder.glob("*.nc"):
            path.unlink()
        self.folder.rmdir()


def identity_of(scenario: Scenario, data: Path | None, truth: bool, n_draws: int) -> str:
    """Of all that the results of a run depend on: scenario, data, draws, and the package."""
    parts = [scenario.to_yaml(), str(truth), str(n_draws), __version__]
    if data is not None:
        if not data.is_file():
            raise InputError(f"no data at '{data}'; make some with: lusee-bayes simulate SCENARIO")
        parts.append(hashlib.sha256(data.read_bytes()).hexdigest())
    return hashlib.sha256(json.dumps(parts).encode()).hexdigest()


def result_dataset(sky: ChannelSky, told: Told, nside: int) -> xr.Dataset:
    """The posterior of a channel's sky: modes, pixels, draws and the figures that judge it.

    Of one that is joint, ``told`` has no posterior of its own any more, and evidence and
    information are those of all channels. Standard deviations are those of the draws where the
    covariance is not known.
    """
    posterior = told.posterior
    if sky.covariance is None:
        spread = np.asarray(sky.draws) - np.asarray(sky.mean)
        std = np.sqrt((spread**2).mean(0))
        covariance = jnp.asarray(spread.T @ spread / len(spread))
    else:
        covariance = sky.covariance
        std = np.sqrt(np.diagonal(np.asarray(covariance)))
    prior = np.repeat(told.spectrum, 2 * np.arange(len(told.spectrum)) + 1)
    variables = {
        "mean": ("mode", np.asarray(sky.mean)),
        "std": ("mode", std),
        "prior_std": ("mode", np.sqrt(prior)),
        "draws": (("draw", "mode"), np.asarray(sky.draws)),
        "pixel_std": ("pixel", pixel_std(covariance, nside)),
    }
    if told.truth is not None:
        variables["truth"] = ("mode", told.truth)
    if posterior is None:
        variables["independent"] = ("mode", np.asarray(told.information.about))
    shares = std**2 / prior
    numbers = {
        "chi2": float(sky.chi2),
        "chi2_expected": float(sky.chi2_expected),
        "n_data": int(told.information.n_data),
        "n_missing": told.n_missing,
        "never_observed": told.never_observed,
        "log_evidence": np.nan if posterior is None else float(posterior.log_evidence),
        "information_bits": np.nan if posterior is None else float(posterior.information_bits()),
    }
    fraction = sum_over_m(shares) / (2.0 * np.arange(len(told.spectrum)) + 1.0)
    variables["prior_fraction"] = ("ell", fraction)
    return xr.Dataset(variables, attrs=numbers)


def each_channel(
    function: Callable[[Channel], T],
    channels: list[Channel],
    fleet: Fleet,
    stages: Stages,
    name: str,
) -> list[T]:
    """``function`` of this process's channels, shared out among its devices.

    ``LANES`` threads for each device: while one waits for numbers the other makes some.
    """
    mine = fleet.mine(channels)
    n_lanes = min(LANES * len(jax.local_devices()), len(mine))
    results: list[T | None] = [None] * len(mine)
    stopped, counting, finished = Event(), Lock(), 0
    with stages.progress(name, len(mine)) as done:

        def run(lane: int) -> None:
            nonlocal finished
            with jax.default_device(fleet.device_of(lane)):
                for number in range(lane, len(mine), n_lanes):
                    if stopped.is_set():
                        return
                    results[number] = function(mine[number])
                    with counting:
                        finished += 1
                        done(finished, f"{mine[number].name} MHz")

        with ThreadPoolExecutor(max(n_lanes, 1)) as pool:
            lanes = [pool.submit(run, lane) for lane in range(n_lanes)]
            try:
                for lane in as_completed(lanes):
                    lane.result()
            finally:
                stopped.set()
    return results
