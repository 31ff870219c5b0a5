"""What a run of several frequencies leaves behind: maps, spectra, and what judges them."""

from __future__ import annotations

import csv
import json
from dataclasses import dataclass
from pathlib import Path

import healpy
import numpy as np
import xarray as xr
from jaxtyping import Float
from scipy import stats as distributions

from lusee_bayes.channel_run import ChannelRun
from lusee_bayes.harmonics import mode_numbers, modes_to_map, power_spectrum, synthesis_matrix
from lusee_bayes.map_files import write_cube
from lusee_bayes.metrics import correlation, ell_cross, signal_to_noise
from lusee_bayes.progress import peak_memory_gb
from lusee_bayes.residuals import SIGNIFICANCE, probability
from lusee_bayes.staging import staged
from lusee_bayes.uncertainty import LANDMARKS
from lusee_bayes.version import versions

FORMAT = "lusee_bayes posterior cube 1"
# chi^2 of a channel that is further from its mean, in standard deviations of the widest
# distribution it can have, is called bad
SIGNIFICANT = 6.0


@dataclass(frozen=True)
class Cube:
    """The posterior of every channel's sky; first axis: channels; in K.

    mean, std, prior_std, truth (None where it is not known) : (channels, modes); independent : the
    mean of each channel's data alone, None where ``mean`` is that; draws : (channels, n, modes);
    pixel_std : (channels, pixels); figures : per channel
    """

    run: ChannelRun
    mean: Float[np.ndarray, "channels modes"]
    std: Float[np.ndarray, "channels modes"]
    prior_std: Float[np.ndarray, "channels modes"]
    prior_fraction: Float[np.ndarray, "channels ells"]
    truth: Float[np.ndarray, "channels modes"] | None
    independent: Float[np.ndarray, "channels modes"] | None
    draws: Float[np.ndarray, "channels n modes"]
    pixel_std: Float[np.ndarray, "channels pixels"]
    figures: list[dict[str, float]]

    @classmethod
    def of(cls, run: ChannelRun) -> Cube:
        """Out of the files of a run's channels."""
        parts = [run.files.read(channel, "result") for channel in run.channels]

        def stacked(name: str) -> np.ndarray | None:
            known = all(name in part for part in parts)
            return np.stack([np.asarray(part[name]) for part in parts]) if known else None

        return cls(
            run,
            *(stacked(name) for name in ("mean", "std", "prior_std", "prior_fraction")),
            stacked("truth"),
            stacked("independent"),
            stacked("draws"),
            stacked("pixel_std"),
            [
                {key: value.item() for key, value in part.attrs.items() if key != "identity"}
                for part in parts
            ],
        )

    @property
    def frequencies_mhz(self) -> Float[np.ndarray, " channels"]:
        """Of the channels."""
        return np.array(self.run.scenario.frequencies_mhz)

    def snr(self, mean: Float[np.ndarray, "channels modes"]) -> np.ndarray | None:
        """SNR_ell of every channel, (channels, ells); None where the truth is not known."""
        if self.truth is None:
            return None
        return np.stack([signal_to_noise(m, t) for m, t in zip(mean, self.truth, strict=True)])

    def deviation(self, channel: int) -> float:
        """How far chi^2 is from its mean under the model, over sqrt(2 N_data); NaN if unknown."""
        figures = self.figures[channel]
        return (figures["chi2"] - figures["chi2_expected"]) / np.sqrt(2.0 * figures["n_data"])

    def bad_channels(self) -> list[int]:
        """Channels whose data do not fit."""
        return [k for k in range(len(self.figures)) if abs(self.deviation(k)) > SIGNIFICANT]

    @property
    def p(self) -> float | None:
        """Probability of a larger chi^2 of all data under the joint model; None if unknown."""
        components = self.run.components
        if components is None or np.isnan(components.chi2):
            return None
        n_data = sum(figures["n_data"] for figures in self.figures)
        return float(distributions.chi2.sf(components.chi2, n_data))

    def verdict(self) -> str:
        """What the residuals say, in a sentence."""
        bad, p = self.bad_channels(), self.p
        if np.isnan(self.deviation(0)):
            return "Conjugate gradients leave the expected chi^2 unknown: fit not judged."
        if not bad and p is not None and p < SIGNIFICANCE:
            return (
                "Residuals of all channels are as they should be, but their skies do not obey the "
                f"spectral prior (p {probability(p)}): error bars may be too small. Compare the "
                "evidence of other spectral.components and of a larger spectral.residual."
            )
        if not bad:
            return "The data of all channels fit the model."
        names = ", ".join(f"{self.frequencies_mhz[k]:g}" for k in bad)
        worst = max(bad, key=lambda k: abs(self.deviation(k)))
        figures = self.figures[worst]
        hint = " Skies may not obey the spectral prior: see spectral.residual." * bool(
            self.run.components
        )
        return (
            f"The data of {len(bad)} of {len(self.figures)} channels do not fit the model: {names} "
            f"MHz (worst {self.frequencies_mhz[worst]:g} MHz: chi2 {figures['chi2']:.0f}, expected "
            f"{figures['chi2_expected']:.0f}).{hint}"
        )

    def spectra(self) -> list[dict[str, float]]:
        """Rows of spectra.csv: one for every channel and ell."""
        snr, alone = self.snr(self.mean), None
        if self.independent is not None:
            alone = self.snr(self.independent)
        rows = []
        for k, frequency in enumerate(self.frequencies_mhz):
            columns = {
                "cl_prior": power_spectrum(self.prior_std[k]),
                "cl_mean": power_spectrum(self.mean[k]),
                "cl_posterior_variance": power_spectrum(self.std[k]),
                "prior_fraction": self.prior_fraction[k],
            }
            if snr is not None:
                columns["cl_truth"] = power_spectrum(self.truth[k])
                columns["rho"] = correlation(self.mean[k], self.truth[k])
                columns["snr"] = snr[k]
            if alone is not None:
                columns["snr_independent"] = alone[k]
            for ell in range(self.run.scenario.lmax + 1):
                values = {name: float(column[ell]) for name, column in columns.items()}
                rows.append({"frequency_mhz": float(frequency), "ell": ell, **values})
        return rows

    def landmarks(self) -> dict[str, dict[str, np.ndarray]]:
        """Brightness, its standard deviation and, if known, the truth of some directions."""
        lmax = self.run.scenario.lmax
        nside = self.run.scenario.map_nside
        found = {}
        for name, (lon, lat) in LANDMARKS.items():
            pixel = healpy.ang2pix(nside, lon, lat, lonlat=True)
            theta, phi = healpy.pix2ang(nside, pixel)
            y = synthesis_matrix(np.array([theta]), np.array([phi]), lmax)[0]
            found[name] = {"mean": self.mean @ y, "std": self.pixel_std[:, pixel]}
            if self.truth is not None:
                found[name]["truth"] = self.truth @ y
        return found

    def summary(self) -> dict[str, object]:
        """Figures of summary.json."""
        snr, components = self.snr(self.mean), self.run.components
        channels = []
        for k, frequency in enumerate(self.frequencies_mhz):
            cross = None if snr is None else ell_cross(snr[k])
            known = {n: v for n, v in self.figures[k].items() if not np.isnan(v)}
            channels.append({"frequency_mhz": float(frequency), "ell_cross": cross, **known})
        joint = None
        if components is not None:
            numbers = {
                "chi2": components.chi2,
                "log_evidence": components.log_evidence,
                "information_bits": components.information_bits,
                "refinement_sigma": components.refinement,
            }
            joint = {
                "components": list(components.prior.names),
                "solver": components.solver,
                "iterations": components.iterations,
                **{name: v for name, v in numbers.items() if not np.isnan(v)},
            }
            if self.p is not None:
                joint["p"] = self.p
        evidences = [figures["log_evidence"] for figures in self.figures]
        return {
            "frequencies_mhz": self.frequencies_mhz.tolist(),
            "joint": joint,
            "log_evidence": joint["log_evidence"]
            if joint and "log_evidence" in joint
            else (None if joint else float(np.sum(evidences))),
            "n_data": int(sum(f["n_data"] for f in self.figures)),
            "n_modes": int(self.mean.shape[1]),
            "verdict": self.verdict(),
            "channels": channels,
            "seconds": {name: round(s, 3) for name, s in self.run.seconds.items()},
            "peak_memory_gb": round(peak_memory_gb(), 3),
            "versions": versions(),
        }

    def to_dataset(self) -> xr.Dataset:
        """posterior.nc: on dims ``frequency`` and ``mode`` (``draw``), in K."""
        scenario = self.run.scenario
        ell, m = mode_numbers(scenario.lmax)
        both = ("frequency", "mode")
        variables = {
            "mean": (both, self.mean),
            "std": (both, self.std),
            "prior_std": (both, self.prior_std),
        }
        if self.truth is not None:
            variables["truth"] = (both, self.truth)
        if self.independent is not None:
            variables["independent_mean"] = (both, self.independent)
        if self.draws.shape[1]:
            variables["draws"] = (("frequency", "draw", "mode"), self.draws)
        components = self.run.components
        if components is not None:
            maps = np.asarray(components.mean)
            variables["component_mean"] = (("component", "mode"), maps)
        variables = {name: (*value, {"units": "K"}) for name, value in variables.items()}
        if components is not None:
            mixing = np.asarray(components.prior.mixing)
            variables["mixing"] = (("frequency", "component"), mixing, {"units": "1"})
        return xr.Dataset(
            variables,
            coords={
                "frequency": ("frequency", self.frequencies_mhz, {"units": "MHz"}),
                "ell": ("mode", ell),
                "m": ("mode", m),
            },
            attrs={
                "format": FORMAT,
                "lmax": scenario.lmax,
                "frame": "galactic",
                "basis": "real orthonormal spherical harmonics, index ell^2 + ell + m",
                "versions": json.dumps(versions()),
                "scenario": scenario.to_yaml(),
            },
        )

    def maps(self) -> dict[str, Float[np.ndarray, "channels pixels"]]:
        """Cubes by name, in K: mean, std and, where the truth is known, truth and residual."""
        nside = self.run.scenario.map_nside
        mean = np.stack([modes_to_map(m, nside) for m in self.mean])
        found = {"mean": mean, "std": self.pixel_std}
        if self.truth is not None:
            truth = np.stack([modes_to_map(t, nside) for t in self.truth])
            found |= {"truth": truth, "residual": mean - truth}
        return found

    def write(self, folder: str | Path) -> list[Path]:
        """Write all files but figures and report into ``folder``, whole or not at all."""
        with staged(folder) as stage:
            self.to_dataset().to_netcdf(stage / "posterior.nc", engine="h5netcdf")
            for name, pixels in self.maps().items():
                write_cube(stage / f"{name}.fits", name, pixels, self.run.scenario)
            with (stage / "spectra.csv").open("w", newline="") as file:
                rows = self.spectra()
                writer = csv.DictWriter(file, rows[0])
                writer.writeheader()
                writer.writerows(rows)
            (stage / "scenario.yaml").write_text(self.run.scenario.to_yaml())
            (stage / "summary.json").write_text(json.dumps(self.summary(), indent=2) + "\n")
            written = sorted(p.name for p in stage.iterdir())
        return [Path(folder) / name for name in written]
