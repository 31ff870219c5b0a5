"""What a map run leaves behind: files that others can open, written whole or not at all."""

from __future__ import annotations

import csv
import json
from dataclasses import dataclass, field
from pathlib import Path

import jax
import numpy as np
import pandas as pd
import xarray as xr
from jaxtyping import Float, Shaped

from lusee_bayes.checks import AnyArray, InputError
from lusee_bayes.compact import CompactPosterior
from lusee_bayes.experiment import Experiment
from lusee_bayes.harmonics import mode_numbers, modes_to_map, power_spectrum
from lusee_bayes.linear_gaussian import LinearGaussian
from lusee_bayes.map_files import cards, write_map
from lusee_bayes.metrics import (
    correlation,
    effective_resolution_deg,
    ell_cross,
    expected_chi2,
    highest_altitude,
    prior_fraction_per_ell,
    signal_to_noise,
    whitened_residuals,
)
from lusee_bayes.pixel_variance import pixel_std as pixel_deviations
from lusee_bayes.posterior import Posterior
from lusee_bayes.progress import Stages, peak_memory_gb
from lusee_bayes.sky import kelvin_steradian, write_alms
from lusee_bayes.staging import staged
from lusee_bayes.updatable import Updatable
from lusee_bayes.updating import composed, given
from lusee_bayes.version import versions
from lusee_bayes.visibilities import Visibilities

FORMAT = "lusee_bayes posterior 1"


@dataclass(frozen=True)
class MapResult:
    """A posterior map with everything needed to judge it.

    fluxes : of the point sources beside the map, one row each (:func:`flux_table`), if any;
    pixel_std : (pixels,) posterior standard deviation of HEALPix RING pixels, in K;
    highest_altitude : (pixels,) sin of the highest altitude each reached; seconds : per stage;
    update : where earlier data were there, the model of the deviation from their posterior, and the
    posterior of that; digests : of all data behind the posterior
    """

    experiment: Experiment
    data: Visibilities
    model: LinearGaussian
    posterior: Posterior
    std: Float[np.ndarray, " modes"]
    pixel_std: Float[np.ndarray, " pixels"]
    highest_altitude: Float[np.ndarray, " pixels"]
    chi2: float
    rounds: int = 1
    fluxes: pd.DataFrame | None = None
    seconds: dict[str, float] = field(default_factory=dict)
    update: tuple[LinearGaussian, Posterior] | None = None
    digests: tuple[str, ...] = ()

    @classmethod
    def from_experiment(
        cls,
        experiment: Experiment,
        data: Visibilities,
        stages: Stages | None = None,
        earlier: Updatable | None = None,
        *,
        root: bool = False,
    ) -> MapResult:
        """Condition the experiment's model on ``data`` and work out the uncertainties.

        ``earlier``: what other data have told, to which these are added; ``root``: by the form that
        can be updated itself. InputError for data that ``earlier`` holds already.
        """
        stages = stages or Stages()
        update, digests = None, (data.digest(),)
        with stages("posterior"):
            model, posterior, rounds = experiment.infer(data)
            if earlier is not None:
                if data.digest() in earlier.digests:
                    raise InputError(
                        "these data are behind the earlier posterior already; a second time they "
                        "would count double"
                    )
                deviations = given(earlier.posterior, model)
                deviation = deviations.condition(data.data, form="root")
                posterior = composed(earlier.posterior, deviation)
                update, digests = (deviations, deviation), (*earlier.digests, *digests)
            elif root:
                posterior = model.condition(data.data, form="root")
            jax.block_until_ready(posterior.white_mean)
        nside = experiment.scenario.map_nside
        with stages("standard deviations"):
            std = np.asarray(posterior.std())
            pixel_std = pixel_deviations(posterior.covariance(), nside)
            residuals = np.asarray(whitened_residuals(model, posterior, data.data))
        fluxes = None
        if experiment.responses and experiment.scenario.sources.treatment != "ignored":
            with stages("fluxes"):
                fluxes = flux_table(experiment, data, posterior)
        return cls(
            experiment=experiment,
            data=data,
            model=model,
            posterior=posterior,
            std=std,
            pixel_std=pixel_std,
            highest_altitude=highest_altitude(data.observation, nside),
            chi2=float(residuals @ residuals),
            rounds=rounds,
            fluxes=fluxes,
            seconds=stages.seconds,
            update=update,
            digests=digests,
        )

    @property
    def judged(self) -> LinearGaussian:
        """The model that predicts the data: given the earlier ones, where there are any."""
        return self.model if self.update is None else self.update[0]

    @property
    def nside(self) -> int:
        """NSIDE of the maps."""
        return self.experiment.scenario.map_nside

    @property
    def truth(self) -> Float[AnyArray, " modes"] | None:
        """The sky behind simulated data; None for real data."""
        return self.data.truth

    def mean_map(self) -> Float[np.ndarray, " pixels"]:
        """Posterior mean in K, HEALPix RING, Galactic."""
        return modes_to_map(self.posterior.mean, self.nside)

    def truth_map(self) -> Float[np.ndarray, " pixels"] | None:
        """The true sky up to lmax in K, where it is known."""
        return None if self.truth is None else modes_to_map(self.truth, self.nside)

    def spectra(self) -> dict[str, Shaped[np.ndarray, " ells"]]:
        """Columns of spectra.csv; rho, snr and cl_truth only where the truth is known."""
        mean = np.asarray(self.posterior.mean)
        columns = {"ell": np.arange(self.experiment.scenario.lmax + 1)}
        if self.truth is not None:
            columns["rho"] = correlation(mean, self.truth)
            columns["snr"] = signal_to_noise(mean, self.truth)
        columns["cl_prior"] = np.asarray(self.experiment.prior.spectrum)
        columns["cl_mean"] = power_spectrum(mean)
        if self.truth is not None:
            columns["cl_truth"] = power_spectrum(self.truth)
        columns["cl_posterior_variance"] = power_spectrum(self.std)
        columns["prior_fraction"] = prior_fraction_per_ell(self.posterior)
        return columns

    def summary(self) -> dict[str, object]:
        """Figures of summary.json; null where a truth would be needed and is not known."""
        spectra = self.spectra()
        return {
            "frequency_mhz": self.experiment.scenario.frequency_mhz,
            "ell_cross": ell_cross(spectra["snr"]) if "snr" in spectra else None,
            "effective_resolution_deg": effective_resolution_deg(spectra["prior_fraction"]),
            "log_evidence": float(self.posterior.log_evidence),
            "information_bits": float(self.posterior.information_bits()),
            "chi2": self.chi2,
            "chi2_expected": expected_chi2(
                self.posterior if self.update is None else self.update[1], self.model.n_data
            ),
            "n_data": self.model.n_data,
            "n_missing": self.data.n_missing,
            "n_modes": self.model.prior.size,
            "rounds": self.rounds,
            "beam_rms_difference": self.experiment.beam_rms_difference(),
            "mean_refinement_sigma": float(self.posterior.refinement),
            "never_observed_fraction": float((self.highest_altitude < 0).mean()),
            "seconds": {name: round(s, 3) for name, s in self.seconds.items()},
            "peak_memory_gb": round(peak_memory_gb(), 3),
            "versions": versions(),
        }

    def to_dataset(
        self, n_draws: int = 0, covariance: bool = False, updatable: bool = False
    ) -> xr.Dataset:
        """posterior.nc: on dim ``mode`` with coords ``ell``, ``m``; all in K (K^2).

        ``updatable``: with L of the precision in units of the prior, for :func:`read_updatable`.
        """
        scenario = self.experiment.scenario
        ell, m = mode_numbers(scenario.lmax)
        variables = {
            "mean": ("mode", np.asarray(self.posterior.mean)),
            "std": ("mode", self.std),
            "prior_std": ("mode", np.sqrt(np.asarray(self.model.prior.variance()))),
        }
        if self.truth is not None:
            variables["truth"] = ("mode", np.asarray(self.truth))
        if n_draws:
            key = jax.random.fold_in(jax.random.key(scenario.seed), 1)
            variables["draws"] = (("draw", "mode"), np.asarray(self.posterior.sample(key, n_draws)))
        variables = {name: (*value, {"units": "K"}) for name, value in variables.items()}
        if covariance:
            matrix = np.asarray(self.posterior.covariance())
            variables["covariance"] = (("mode", "mode_2"), matrix, {"units": "K2"})
        attrs = {"format": FORMAT, **self.about()}
        if updatable:
            lower = np.tril(np.asarray(self.posterior.lower))
            variables["precision_root"] = (("mode", "mode_2"), lower)
            variables["white_mean"] = ("mode", np.asarray(self.posterior.white_mean))
            attrs["log_evidence"] = float(self.posterior.log_evidence)
            attrs["data_digests"] = json.dumps(self.digests)
        return xr.Dataset(variables, coords={"ell": ("mode", ell), "m": ("mode", m)}, attrs=attrs)

    def about(self) -> dict[str, object]:
        """What a file has to say of its numbers: frequency, frame, versions, scenario."""
        scenario = self.experiment.scenario
        return {
            "frequency_mhz": scenario.frequency_mhz,
            "lmax": scenario.lmax,
            "frame": "galactic",
            "basis": "real orthonormal spherical harmonics, index ell^2 + ell + m",
            "versions": json.dumps(versions()),
            "scenario": scenario.to_yaml(),
        }

    def write(
        self,
        folder: str | Path,
        n_draws: int = 0,
        covariance: bool = False,
        compact: bool = False,
        updatable: bool = False,
    ) -> list[Path]:
        """Write all files but the figures into ``folder``; see :func:`staged`."""
        with staged(folder) as stage:
            self.to_dataset(n_draws, covariance, updatable).to_netcdf(
                stage / "posterior.nc", engine="h5netcdf"
            )
            scenario = self.experiment.scenario
            for name, pixels in self.maps().items():
                write_map(stage / f"{name}.fits", name, pixels, scenario)
            write_alms(stage / "mean_alm.fits", self.posterior.mean, cards("mean", scenario))
            if compact:
                CompactPosterior.of(self.posterior).write(
                    stage / "posterior_compact.npz", self.about()
                )
            with (stage / "spectra.csv").open("w", newline="") as file:
                writer = csv.writer(file)
                columns = self.spectra()
                writer.writerow(columns)
                writer.writerows(zip(*(c.tolist() for c in columns.values()), strict=True))
            if self.fluxes is not None:
                self.fluxes.to_csv(stage / "sources.csv", index=False)
            (stage / "scenario.yaml").write_text(self.experiment.scenario.to_yaml())
            (stage / "summary.json").write_text(json.dumps(self.summary(), indent=2) + "\n")
            written = sorted(p.name for p in stage.iterdir())
        return [Path(folder) / name for name in written]

    def maps(self) -> dict[str, Float[np.ndarray, " pixels"]]:
        """The maps by name, in K: mean, std and, where the truth is known, truth and residual."""
        mean, truth = self.mean_map(), self.truth_map()
        maps = {"mean": mean, "std": self.pixel_std}
        if truth is not None:
            maps |= {"truth": truth, "residual": mean - truth}
        return maps


def flux_table(experiment: Experiment, data: Visibilities, posterior: Posterior) -> pd.DataFrame:
    """Posterior of every source's flux in Jy and in K sr, with its prior and, if known, its truth.

    ``posterior``: of the map, around which the gain term is built where the scenario says so.
    ``above_horizon``: whether it is ever up; if not, its flux is known from the prior only.
    """
    sources, gain = experiment.sources(), experiment.scenario.noise.gain
    settled = gain is not None and gain.visibilities == "posterior"
    around = experiment.prediction(posterior) if settled else None
    posterior = experiment.with_fluxes(data, around).condition(data.data)
    n = sources.mean().shape[0]
    mean = np.asarray(sources.mean() + posterior.mean[-n:])
    std = np.asarray(posterior.std())[-n:]
    jansky = 1.0 / kelvin_steradian(1.0, experiment.scenario.frequency_mhz)
    truth = experiment.truth() if data.truth is not None else {}
    rows, at = [], 0
    for source in sources.sources:
        true = np.broadcast_to(truth.get(source.site, np.nan), source.n_blocks)
        for block, up in enumerate(source.seen()):
            row = {
                "source": source.name,
                "block": block,
                "above_horizon": bool(up),
                "flux_jy": mean[at] * jansky,
                "std_jy": std[at] * jansky,
                "flux_k_sr": mean[at],
                "std_k_sr": std[at],
                "prior_jy": source.mean * jansky,
                "prior_std_jy": source.std * jansky,
            }
            rows.append(row if data.truth is None else row | {"true_jy": true[block] * jansky})
            at += 1
    return pd.DataFrame(rows)
