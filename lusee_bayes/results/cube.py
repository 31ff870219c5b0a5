"""The posterior over the skies of several frequencies: a channel each, or one for all."""

from __future__ import annotations

import json
from dataclasses import dataclass, field

import numpy as np
import xarray as xr
from jaxtyping import Float
from scipy.special import chdtrc

from lusee_bayes.core import formats
from lusee_bayes.core.harmonics import mode_numbers, synthesis_matrix
from lusee_bayes.core.lazy import healpy
from lusee_bayes.core.progress import peak_memory_gb
from lusee_bayes.core.representation import Described, extent
from lusee_bayes.core.version import versions
from lusee_bayes.experiment.scenario import Scenario
from lusee_bayes.linear.residuals import SIGNIFICANCE, probability
from lusee_bayes.results.channel import (
    ChannelResult,
)
from lusee_bayes.results.joint_components import (
    Components,
)
from lusee_bayes.sky.landmarks import LANDMARKS

# chi^2 of a channel that is further from its mean, in standard deviations of the widest
# distribution it can have, is called bad
SIGNIFICANT = 6.0


@dataclass(frozen=True, repr=False)
class CubeResult(Described):
    """The posterior of every channel's sky, in K.

    Attributes
    ----------
    scenario : Scenario
        Of several frequencies.
    channels : tuple of ChannelResult
    components : Components or None
        The component maps that all channels share; None where each has a posterior of its own.
    seconds : dict
        By stage.
    """

    scenario: Scenario
    channels: tuple[ChannelResult, ...]
    components: Components | None
    seconds: dict[str, float] = field(default_factory=dict)

    def description(self) -> tuple[str, ...]:
        kind = "independent" if self.components is None else "joint"
        return (
            f"{len(self.channels)} {kind} channels, {extent(self.frequencies_mhz, 'MHz')}, "
            f"lmax = {self.scenario.lmax}",
            self.verdict(),
        )

    @property
    def frequencies_mhz(self) -> Float[np.ndarray, " channels"]:
        """Of the channels."""
        return np.array(self.scenario.frequencies_mhz)

    def stacked(self, name: str) -> np.ndarray | None:
        """An attribute of the channels, channels first; None where it is not known of all."""
        values = [getattr(channel, name) for channel in self.channels]
        return None if any(v is None for v in values) else np.stack(values)

    def snr(self, *, independent: bool = False) -> Float[np.ndarray, "channels ells"] | None:
        """SNR_ell of every channel, or of the means given its own data alone; None if unknown."""
        if self.stacked("truth") is None or (independent and self.stacked("independent") is None):
            return None
        return np.stack([c.snr(c.independent if independent else None) for c in self.channels])

    def deviation(self, channel: int) -> float:
        """How far chi^2 is from its mean under the model, over sqrt(2 N_data); NaN if unknown."""
        it = self.channels[channel]
        return (it.chi2 - it.chi2_expected) / np.sqrt(2.0 * it.n_data)

    def bad_channels(self) -> list[int]:
        """Channels whose data do not fit."""
        return [k for k in range(len(self.channels)) if abs(self.deviation(k)) > SIGNIFICANT]

    @property
    def p(self) -> float | None:
        """Probability of a larger chi^2 of all data under the joint model; None if unknown."""
        if self.components is None or np.isnan(self.components.chi2):
            return None
        n_data = sum(channel.n_data for channel in self.channels)
        return float(chdtrc(n_data, self.components.chi2))

    def verdict(self) -> str:
        """What the residuals say, in a sentence."""
        bad, p = self.bad_channels(), self.p
        if np.isnan(self.deviation(0)):
            return "Conjugate gradients leave the expected chi^2 unknown: fit not judged."
        if not bad and p is not None and p < SIGNIFICANCE:
            return (
                "Residuals of all channels are as expected, but their skies do not follow the "
                f"spectral prior (p {probability(p)}): error bars may be too small. Compare the "
                "evidence of other spectral.components and of a larger spectral.residual."
            )
        if not bad:
            return "The data of all channels fit the model."
        names = ", ".join(f"{self.frequencies_mhz[k]:g}" for k in bad)
        worst = max(bad, key=lambda k: abs(self.deviation(k)))
        channel = self.channels[worst]
        hint = ""
        if self.components is not None:
            hint = " Skies may not obey the spectral prior: see spectral.residual."
        return (
            f"The data of {len(bad)} of {len(self.channels)} channels do not fit the model: "
            f"{names} MHz (worst {channel.frequency_mhz:g} MHz: chi2 {channel.chi2:.0f}, expected "
            f"{channel.chi2_expected:.0f}).{hint}"
        )

    def headline(self) -> str:
        """The few figures that matter, in one line."""
        kind = "each on its own" if self.components is None else "one posterior"
        parts = [f"{len(self.channels)} frequencies, {kind}"]
        crosses = [c.ell_cross for c in self.channels if c.ell_cross is not None]
        if crosses:
            parts.append(f"SNR < 1 first at ell {min(crosses)} to {max(crosses)}")
        if self.log_evidence is not None:
            parts.append(f"ln evidence {self.log_evidence:.1f}")
        components = self.components
        if components is not None and components.iterations:
            parts.append(
                f"{components.iterations} iterations, {components.refinement:.1g} sigma left"
            )
        return ", ".join(parts)

    def lines(self) -> list[str]:
        """What a terminal shows."""
        doubts = [f"{c.frequency_mhz:g} MHz: {d}" for c in self.channels for d in c.doubts]
        return [self.headline(), self.verdict(), *doubts]

    @property
    def log_evidence(self) -> float | None:
        """ln p of all data; None where it is not known."""
        if self.components is None:
            return float(np.sum([channel.log_evidence for channel in self.channels]))
        found = self.components.log_evidence
        return None if np.isnan(found) else found

    def landmarks(self) -> dict[str, dict[str, np.ndarray]]:
        """Brightness, its standard deviation and, if known, the truth of some directions."""
        nside = self.scenario.map_nside
        mean, pixel_std, truth = (self.stacked(n) for n in ("mean", "pixel_std", "truth"))
        found = {}
        for name, (lon, lat) in LANDMARKS.items():
            pixel = healpy.ang2pix(nside, lon, lat, lonlat=True)
            theta, phi = healpy.pix2ang(nside, pixel)
            y = synthesis_matrix(np.array([theta]), np.array([phi]), self.scenario.lmax)[0]
            found[name] = {"mean": mean @ y, "std": pixel_std[:, pixel]}
            if truth is not None:
                found[name]["truth"] = truth @ y
        return found

    def summary(self) -> dict[str, object]:
        """Figures of summary.json."""
        channels = []
        for channel in self.channels:
            numbers = {
                "chi2": channel.chi2,
                "chi2_expected": channel.chi2_expected,
                "n_data": channel.n_data,
                "n_missing": channel.n_missing,
                "never_observed": channel.never_observed,
                "log_evidence": channel.log_evidence,
                "information_bits": channel.information_bits,
            }
            known = {name: value for name, value in numbers.items() if not np.isnan(value)}
            known |= {"doubts": list(channel.doubts)} if channel.doubts else {}
            channels.append(
                {"frequency_mhz": channel.frequency_mhz, "ell_cross": channel.ell_cross, **known}
            )
        return {
            "frequencies_mhz": self.frequencies_mhz.tolist(),
            "joint": self._joint_summary(),
            "log_evidence": self.log_evidence,
            "n_data": sum(channel.n_data for channel in self.channels),
            "n_modes": len(self.channels[0].mean),
            "verdict": self.verdict(),
            "channels": channels,
            "seconds": {name: round(s, 3) for name, s in self.seconds.items()},
            "peak_memory_gb": round(peak_memory_gb(), 3),
            "versions": versions(),
        }

    def _joint_summary(self) -> dict[str, object] | None:
        components = self.components
        if components is None:
            return None
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
        return joint if self.p is None else joint | {"p": self.p}

    def spectra(self) -> list[dict[str, float]]:
        """Rows of spectra.csv: one for every channel and ell."""
        rows = []
        for channel in self.channels:
            columns = channel.spectra()
            for ell in range(len(columns["ell"])):
                values = {name: float(column[ell]) for name, column in columns.items()}
                rows.append({"frequency_mhz": channel.frequency_mhz, **values, "ell": ell})
        return rows

    def to_dataset(self) -> xr.Dataset:
        """posterior.nc: on dims ``frequency`` and ``mode`` (``draw``), in K."""
        scenario, components = self.scenario, self.components
        ell, m = mode_numbers(scenario.lmax)
        parts = [channel.variables() for channel in self.channels]
        variables = {
            name: (
                ("frequency", *dims),
                np.stack([part[name][1] for part in parts]),
                {"units": "K"},
            )
            for name, (dims, _) in parts[0].items()
        }
        if components is not None:
            maps, mixing = np.asarray(components.mean), np.asarray(components.prior.mixing)
            variables["component_mean"] = (("component", "mode"), maps, {"units": "K"})
            variables["mixing"] = (("frequency", "component"), mixing, {"units": "1"})
        return xr.Dataset(
            variables,
            coords={
                "frequency": ("frequency", self.frequencies_mhz, {"units": "MHz"}),
                "ell": ("mode", ell),
                "m": ("mode", m),
            },
            attrs={
                "format": formats.POSTERIOR_CUBE,
                "lmax": scenario.lmax,
                "frame": "galactic",
                "basis": "real orthonormal spherical harmonics, index ell^2 + ell + m",
                "versions": json.dumps(versions()),
                "scenario": scenario.to_yaml(),
            },
        )

    def maps(self) -> dict[str, Float[np.ndarray, "channels pixels"]]:
        """Cubes by name, in K: mean, std and, where the truth is known, truth and residual."""
        parts = [channel.maps() for channel in self.channels]
        return {name: np.stack([part[name] for part in parts]) for name in parts[0]}
