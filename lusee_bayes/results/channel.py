"""The posterior over the sky at one frequency, with its tests; a map has one or more channels.

A channel reports its distance from a known truth, by latitude and at some multipoles, and whether
instrument, noise and prior agree with the data.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Bool, Float, Int8, Shaped

from lusee_bayes.core.arrays import Ells, Pixels
from lusee_bayes.core.checks import Described, extent
from lusee_bayes.core.harmonics import modes_to_map, power_spectrum
from lusee_bayes.core.trees import quantity
from lusee_bayes.experiment import unknowns as reports
from lusee_bayes.experiment.diagnosis import Diagnosis
from lusee_bayes.judge import measures, residuals
from lusee_bayes.judge.chi2 import HEADLINES, ChiSquare, Fit, Level
from lusee_bayes.judge.coverage import Coverage
from lusee_bayes.linear.information import Information
from lusee_bayes.results.sky_spectrum import Departure, RegionTemperatures

# recurring types of NumPy arrays
SkyModes = Float[np.ndarray, " mode"]
SkyMatrix = Float[np.ndarray, "mode mode_2"]
OnGrid = Float[np.ndarray, "product time"]


@dataclass(frozen=True)
class Judged:
    """The data of a channel compared, group by group, with predictions from all other data.

    Attributes
    ----------
    level, verdict : str
        Whether they fit, as a level and in sentences.
    prior : ChiSquare
        The part of chi^2 that tests the prior.
    extremes, suspects : tuple of str
        Groups that stand out, and those without which the others fit.
    z : (products, times) array
        z of each datum given all others; NaN if missing.
    groups : tuple of Group
        Products, days and turntable angles; empty if groups are not judged.
    """

    level: Level
    verdict: str
    prior: ChiSquare
    extremes: tuple[str, ...]
    suspects: tuple[str, ...]
    z: OnGrid = quantity("1", "data minus prediction from all other data, in standard deviations")
    groups: tuple[residuals.Group, ...] = ()

    @property
    def fit(self) -> Fit:
        """The verdict."""
        return Fit(self.level, self.verdict.removeprefix(f"{HEADLINES[self.level]} "))

    def of_kind(self, kind: str) -> list[residuals.Group]:
        """Return the groups of one kind, e.g. the products."""
        return [group for group in self.groups if group.kind == kind]


@dataclass(frozen=True)
class Details:
    """Extra quantities that a report shows for a single map.

    Attributes
    ----------
    prior_fraction : (pixels,) array
        The prior's share of each pixel's variance, monopole excluded.
    region_mean, region_std, region_prior_fraction : (regions,) array
        Statistics of coarse HEALPix RING pixels; the first two in K.
    resolution, resolution_step, prior_width : array
        The resolution matrix (:func:`.packed_resolution`).
    patterns : (patterns, nodes, azimuths) array
        Beams relative to their peaks, on the nodes of ``HemisphereGrid.gauss_legendre``.
    pattern_names : tuple of str
    draws : (draws, modes) array
        A few samples from the posterior, in K.
    """

    pattern_names: tuple[str, ...]
    draws: Float[np.ndarray, "few mode"] = quantity("K", "draws of the posterior")
    prior_fraction: Pixels = quantity("1", "share of the variance that the prior supplies")
    region_mean: Float[np.ndarray, " region"] = quantity("K", "posterior mean of regions")
    region_std: Float[np.ndarray, " region"] = quantity("K", "standard deviation of regions")
    region_prior_fraction: Float[np.ndarray, " region"] = quantity("1")
    resolution: Int8[np.ndarray, "mode mode_2"] = quantity("1", "resolution matrix, in steps")
    resolution_step: Float[np.ndarray, "ell ell_2"] = quantity("1", "steps of the resolution")
    prior_width: SkyModes = quantity("K", "prior standard deviation, or rms over m")
    patterns: Float[np.ndarray, "pattern node azimuth"] = quantity("1", "beams over their peaks")


@dataclass(frozen=True, kw_only=True, repr=False)
class ChannelData:
    """Everything about a channel except its sky.

    Attributes
    ----------
    frequency_mhz : float
    taken : dict
        When and where its data were observed (:func:`.taken`).
    labels : tuple of str
        Names of the products.
    hours, turntable_deg : (times,) array
        Time since the first sample, and the turntable's angle.
    data : (products, times) array
        In K; NaN where a sample is missing.
    n_data, n_missing, rounds : int
        Numbers of data, of missing samples, and of rounds, each of which builds N.
    flagged : (products, times) array or None
        Flight data that do not fit and are left out.
    flagged_share : float
        Fraction of the values that is flagged.
    prior_std : (modes,) array
        Standard deviation of the channel's own prior, in K.
    truth : (modes,) array or None
        The sky behind simulated data, in K.
    highest_altitude : (pixels,) array
        sin of the highest altitude that each pixel (HEALPix RING) reached.
    instrument : ChiSquare
        The part of its data's chi^2 that tests instrument and noise (:mod:`.chi2`).
    prior : str
        Where its prior comes from, in a sentence.
    parameters : tuple of dict
        Learned parameters of the prior: name, value and std.
    log_evidence_learned : float or None
        ln p with the prior's parameters integrated out.
    beam_rms_difference : float or None
        Rms difference between true and modelled beams, where they differ.
    doubts : tuple of str
        Doubts about the data, a sentence each.
    notes : tuple of str
        Limits of the model that are no doubts, a sentence each.
    judged : Judged or None
        Tests group by group; None for one of several channels if it fits.
    details : Details or None
        For a map of one frequency.
    pointing : PointingReport or None
        Clock and pointing, if the scenario has them or the data do not fit.
    fluxes : DataFrame or None
        Point sources in addition to the map, a row each.
    diagnosis : Diagnosis or None
        Usual mistakes that would explain the data, if they were tried.
    digests : tuple of str
        Digests of all data behind the map.
    information : Information or None
        Information in all these data, if it is kept for updates with new data.
    prior_of_all : ChiSquare or None
        The part of chi^2 that tests the prior, with earlier data; None without these.
    seen_above : float
        Number of directions of the sky above lmax that its data measure, if there are others.
    departure : Departure or None
        Its sky's departure from the prior, and the error in common with other frequencies.
    """

    frequency_mhz: float
    taken: dict[str, Any]
    labels: tuple[str, ...]
    hours: Float[np.ndarray, " time"] = quantity("h", "time since the first sample")
    turntable_deg: Float[np.ndarray, " time"] = quantity("degree", "angle of the turntable")
    data: OnGrid = quantity("K", "visibilities")
    n_data: int
    n_missing: int
    rounds: int
    flagged: Bool[np.ndarray, "product time"] | None = None
    flagged_share: float = 0.0
    prior_std: SkyModes = quantity("K", "prior standard deviation")
    truth: SkyModes | None = quantity("K", "true sky")
    highest_altitude: Pixels = quantity("1", "sine of the highest altitude")
    instrument: ChiSquare
    prior: str
    parameters: tuple[dict[str, Any], ...] = ()
    log_evidence_learned: float | None = None
    beam_rms_difference: float | None = None
    doubts: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    judged: Judged | None = None
    details: Details | None = None
    pointing: reports.PointingReport | None = None
    fluxes: pd.DataFrame | None = None
    diagnosis: Diagnosis | None = None
    digests: tuple[str, ...] = ()
    information: Information | None = None
    prior_of_all: ChiSquare | None = None
    seen_above: float = 0.0
    departure: Departure | None = None

    def given(self, table: pd.DataFrame) -> "ChannelData":
        """Replace offsets and fluxes by those in a table of unknowns, given all channels."""
        pointing, fluxes = self.pointing, self.fluxes
        if pointing is not None and pointing.offsets is not None:
            pointing = pointing.given(table)
        if fluxes is not None:
            fluxes = fluxes.assign(**reports.in_both_units(table, self.frequency_mhz))
        return replace(self, pointing=pointing, fluxes=fluxes)


@dataclass(frozen=True, kw_only=True, repr=False)
class ChannelResult(ChannelData, Described):
    """The posterior over the sky at one frequency, with its tests. Skies in K, Galactic.

    Attributes
    ----------
    mean, std : (modes,) array
        Mean and standard deviation of the real harmonic coefficients.
    prior_fraction : (ells,) array
        Share of the variance that comes from the prior, mean over m.
    pixel_std : (pixels,) array
        Standard deviation of HEALPix RING pixels.
    draws : (n, modes) array
        Samples from the posterior; empty unless requested.
    log_likelihood : (n,) array
        ln p(d | m) of each draw, with the full N.
    covariance : (modes, modes) array or None
        In K^2, if requested.
    independent : (modes,) array or None
        Mean given this channel's data alone, if ``mean`` is given the data of all.
    log_evidence, information_bits : float
        NaN for a channel of a joint posterior, which has one value for all channels. Where
        channels share unknowns, ln p of the channel's own data alone.
    chi2, chi2_expected : float
        chi^2 of the residuals about the mean, and its expectation if the model is right.
    chi2_model : float
        chi^2 of the data under the model, sky included: a chi^2 distribution of ``n_data`` degrees
        of freedom. NaN for a channel of a joint posterior, which has no separate model.
    refinement : float
        Last correction of the mean, in standard deviations.
    coverage : tuple of Coverage
        How often error bars cover the truth, by latitude; empty if the truth is unknown.
    unknowns : UnknownsReport or None
        Receivers, ground and gain table, where the model has them.
    theta : InstrumentPosterior or None
        All unknowns of the instrument, and their effect on the map.
    temperatures : RegionTemperatures
        Of regions of the sky.
    """

    mean: SkyModes = quantity("K", "posterior mean")
    std: SkyModes = quantity("K", "posterior standard deviation")
    prior_fraction: Ells = quantity("1", "share of the variance that the prior supplies")
    pixel_std: Pixels = quantity("K", "posterior standard deviation of pixels")
    draws: Float[np.ndarray, "draw mode"] = quantity("K", "draws of the posterior")
    log_likelihood: Float[np.ndarray, " draw"] = quantity("1", "ln p(d | m) of each draw")
    covariance: SkyMatrix | None = quantity("K2", "posterior covariance", default=None)
    independent: SkyModes | None = quantity("K", "mean given only its own data", default=None)
    log_evidence: float = np.nan
    information_bits: float = np.nan
    chi2: float
    chi2_expected: float
    chi2_model: float = np.nan
    refinement: float = np.nan
    coverage: tuple[Coverage, ...] = ()
    unknowns: reports.UnknownsReport | None = None
    theta: reports.InstrumentPosterior | None = None
    temperatures: RegionTemperatures

    def description(self) -> tuple[str, ...]:
        return (
            f"{self.frequency_mhz:g} MHz, {self.n_data} data, NSIDE {self.nside}",
            f"mean {extent(modes_to_map(self.mean, self.nside), 'K')}",
            f"standard deviation {extent(self.pixel_std, 'K')}",
        )

    @property
    def nside(self) -> int:
        """NSIDE of the maps."""
        return round(np.sqrt(self.pixel_std.size / 12))

    @property
    def never_observed(self) -> float:
        """Share of the sky that was never above the horizon."""
        return float((self.highest_altitude < 0).mean())

    @property
    def snr(self) -> np.ndarray | None:
        """SNR_ell of the map; None if the truth is unknown."""
        return None if self.truth is None else measures.signal_to_noise(self.mean, self.truth)

    @property
    def ell_cross(self) -> int | None:
        """First ell >= 1 with SNR < 1; None if there is none, or no truth."""
        return None if self.snr is None else measures.ell_cross(self.snr)

    @property
    def resolution_deg(self) -> float | None:
        """180 degrees over the first ell whose variance comes mostly from the prior."""
        return measures.effective_resolution_deg(self.prior_fraction)

    def spectra(self) -> dict[str, Shaped[np.ndarray, " ells"]]:
        """Columns of power_spectra.ecsv; rho, snr and cl_truth only if the truth is known."""
        truth, alone = self.truth, self.independent
        columns = {
            "ell": np.arange(len(self.prior_fraction)),
            "rho": None if truth is None else measures.correlation(self.mean, truth),
            "snr": self.snr,
            "cl_prior": power_spectrum(self.prior_std),
            "cl_mean": power_spectrum(self.mean),
            "cl_truth": None if truth is None else power_spectrum(truth),
            "cl_posterior_variance": power_spectrum(self.std),
            "prior_fraction": self.prior_fraction,
        }
        if truth is not None and alone is not None:
            columns["snr_independent"] = measures.signal_to_noise(alone, truth)
        return {name: values for name, values in columns.items() if values is not None}

    def maps(self) -> dict[str, Pixels]:
        """HEALPix RING maps by name, in K: mean, std and, if known, truth and residual."""
        maps = {"mean": modes_to_map(self.mean, self.nside), "std": self.pixel_std}
        if self.truth is not None:
            truth = modes_to_map(self.truth, self.nside)
            maps |= {"truth": truth, "residual": maps["mean"] - truth}
        return maps

    def figures(self) -> list[str]:
        """The main figures, in words."""
        parts = []
        if self.truth is not None:
            cross = self.ell_cross
            parts = ["SNR > 1 at every ell" if cross is None else f"SNR < 1 first at ell {cross}"]
        if self.resolution_deg is not None:
            parts.append(f"resolution {self.resolution_deg:.1f} deg")
        parts.append(f"chi2 {self.chi2:.0f} (expected {self.chi2_expected:.0f})")
        return [*parts, f"{self.information_bits:.0f} bits"]
