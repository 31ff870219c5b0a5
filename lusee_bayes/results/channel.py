"""The posterior over the sky at one frequency: what every kind of run has in common.

A map is one channel, a cube several; samples and the paper's cases stand beside one. It is made of
an information with its covariance, or of a posterior with its model, and tells how far it is from a
known truth, by latitude and at some multipoles.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float, Shaped

from lusee_bayes.core.arrays import Array, Ells, Modes, ModesMatrix, Pixels
from lusee_bayes.core.checks import Described, extent
from lusee_bayes.core.harmonics import mean_over_m, modes_to_map, power_spectrum
from lusee_bayes.experiment.draws import deviations, doubts, posterior_draws
from lusee_bayes.experiment.experiment import Experiment
from lusee_bayes.experiment.rounds import Inference
from lusee_bayes.experiment.unknowns import Unknowns, UnknownsReport
from lusee_bayes.judge.chi2 import ChiSquare
from lusee_bayes.judge.coverage import Counts, Coverage, latitudes
from lusee_bayes.judge.measures import (
    correlation,
    ell_cross,
    expected_chi2,
    highest_altitude,
    signal_to_noise,
)
from lusee_bayes.judge.plausibility import about_information
from lusee_bayes.linear.information import Information
from lusee_bayes.linear.posterior import pixel_std


@dataclass(frozen=True)
class Observed:
    """What is known of a channel besides its posterior: for :func:`channel_of_information`.

    Attributes
    ----------
    frequency_mhz : float
    prior_std : (modes,) array
        Of the channel's own prior, in K.
    truth : (modes,) array or None
    highest_altitude : (pixels,) array
    n_missing, rounds : int
    instrument : ChiSquare
        What no sky explains of the channel's own data.
    doubts : tuple of str
    unknowns : Unknowns or None
        Receivers, ground and gain table, where the model has them.
    """

    frequency_mhz: float
    prior_std: Modes
    truth: Modes | None
    highest_altitude: Pixels
    n_missing: int
    rounds: int
    instrument: ChiSquare
    doubts: tuple[str, ...] = ()
    unknowns: Unknowns | None = None

    @classmethod
    def of(
        cls,
        experiment: Experiment,
        inference: Inference,
        instrument: ChiSquare,
        unknowns: Unknowns | None = None,
    ) -> Observed:
        """Of an experiment, and what no sky explains of its data."""
        data, nside = experiment.data, experiment.scenario.map_nside
        return cls(
            experiment.scenario.frequency_mhz,
            np.sqrt(np.asarray(experiment.setup.prior.variance())),
            None if data.truth is None else np.asarray(data.truth),
            highest_altitude(data.observation, nside),
            data.n_missing,
            inference.rounds,
            instrument,
            doubts(experiment, inference),
            unknowns,
        )


@dataclass(frozen=True, repr=False)
class ChannelResult(Described):
    """The posterior over the sky at one frequency, and what judges it. Skies in K, Galactic.

    Attributes
    ----------
    frequency_mhz : float
    mean, std, prior_std : (modes,) array
        Of the real harmonic coefficients.
    prior_fraction : (ells,) array
        Share of the variance that the prior supplies, mean over m.
    pixel_std : (pixels,) array
        Standard deviation of HEALPix RING pixels.
    highest_altitude : (pixels,) array
        sin of the highest altitude that each pixel reached.
    draws : (n, modes) array
        Of the posterior; none, if none were asked for.
    truth : (modes,) array or None
        The sky behind simulated data.
    independent : (modes,) array or None
        Mean given this channel's data alone, where ``mean`` is given those of all.
    log_evidence, information_bits : float
        NaN for a channel of a joint posterior, where only those of all channels are known. Where
        receivers tie channels, ln p of the channel's own data alone.
    chi2, chi2_expected : float
        Of the residuals about the mean, and its mean if the model holds.
    chi2_model : float
        Of the data under the model, sky included: a chi^2 distribution of ``n_data`` degrees of
        freedom. NaN for a channel of a joint posterior, which has no model of its own.
    instrument_chi2, instrument_chi2_expected : float
        Of the channel's own data, what no sky explains (:mod:`.chi2`). NaN for a map of its own,
        whose diagnostics have it.
    refinement : float
        Last correction of the mean, in standard deviations.
    n_data, n_missing, rounds : int
        Data, samples left out, and how often the gain term was built.
    doubts : tuple of str
        What is doubtful about measured data, a sentence each.
    coverage : tuple of Coverage
        How often error bars hold the truth, by latitude; empty where it is not known.
    unknowns : UnknownsReport or None
        Of receivers, ground and gain table, where the model has them. None for a map of its own,
        which has it beside its channel.
    """

    frequency_mhz: float
    mean: Modes
    std: Modes
    prior_std: Modes
    prior_fraction: Ells
    pixel_std: Pixels
    highest_altitude: Pixels
    draws: Float[np.ndarray, "n modes"]
    truth: Modes | None
    independent: Modes | None
    log_evidence: float
    information_bits: float
    chi2: float
    chi2_expected: float
    chi2_model: float
    refinement: float
    n_data: int
    n_missing: int
    rounds: int
    doubts: tuple[str, ...] = ()
    coverage: tuple[Coverage, ...] = ()
    instrument_chi2: float = np.nan
    instrument_chi2_expected: float = np.nan
    unknowns: UnknownsReport | None = None

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

    def snr(self, mean: Modes | None = None) -> np.ndarray | None:
        """SNR_ell of the map, or of another mean; None where the truth is not known."""
        if self.truth is None:
            return None
        return signal_to_noise(self.mean if mean is None else mean, self.truth)

    @property
    def ell_cross(self) -> int | None:
        """First ell >= 1 with SNR < 1; None if there is none, or no truth."""
        snr = self.snr()
        return None if snr is None else ell_cross(snr)

    def spectra(self) -> dict[str, Shaped[np.ndarray, " ells"]]:
        """Columns of spectra.csv; rho, snr and cl_truth only where the truth is known."""
        truth, alone = self.truth, self.independent
        columns = {
            "ell": np.arange(len(self.prior_fraction)),
            "rho": None if truth is None else correlation(self.mean, truth),
            "snr": self.snr(),
            "cl_prior": power_spectrum(self.prior_std),
            "cl_mean": power_spectrum(self.mean),
            "cl_truth": None if truth is None else power_spectrum(truth),
            "cl_posterior_variance": power_spectrum(self.std),
            "prior_fraction": self.prior_fraction,
            "snr_independent": None if alone is None else self.snr(alone),
        }
        return {name: values for name, values in columns.items() if values is not None}

    def coverage_rows(self) -> list[dict[str, float | str]] | None:
        """:attr:`coverage` for summary.json; None where the truth is not known."""
        return [band.row() for band in self.coverage] or None

    def maps(self) -> dict[str, Pixels]:
        """HEALPix RING maps by name, in K: mean, std and, where known, truth and residual."""
        maps = {"mean": modes_to_map(self.mean, self.nside), "std": self.pixel_std}
        if self.truth is not None:
            truth = modes_to_map(self.truth, self.nside)
            maps |= {"truth": truth, "residual": maps["mean"] - truth}
        return maps

    def variables(self) -> dict[str, tuple[tuple[str, ...], np.ndarray]]:
        """What posterior.nc holds of a channel, on dims ``mode`` and ``draw``; in K."""
        known = {
            "mean": self.mean,
            "std": self.std,
            "prior_std": self.prior_std,
            "truth": self.truth,
            "independent_mean": self.independent,
        }
        found = {name: (("mode",), values) for name, values in known.items() if values is not None}
        return found | ({"draws": (("draw", "mode"), self.draws)} if len(self.draws) else {})


def channel_of_information(
    observed: Observed,
    information: Information,
    mean: Modes,
    covariance: ModesMatrix,
    draws: Float[Array, "n modes"],
    *,
    compared: Float[np.ndarray, "more modes"] | None = None,
    independent: Modes | None = None,
    log_evidence: float = np.nan,
    information_bits: float = np.nan,
    chi2_model: float = np.nan,
    refinement: float = np.nan,
) -> ChannelResult:
    """The channel of a mean and a covariance.

    Parameters
    ----------
    observed : Observed
    information : Information
        What the channel's own data say.
    mean : (modes,) array
        In K.
    covariance : (modes, modes) array
        In K^2.
    draws : (n, modes) array
        In K.
    compared : (more, modes) array, optional
        Draws less mean for :class:`.Counts`, where the truth is known, in K.
    independent, log_evidence, information_bits, chi2_model, refinement
        See :class:`ChannelResult`.
    """
    variance, unknowns = np.diagonal(np.asarray(covariance)), observed.unknowns
    joint = independent is not None
    return _channel(
        observed,
        np.asarray(mean),
        covariance,
        compared,
        prior_fraction=mean_over_m(np.sqrt(variance) ** 2 / observed.prior_std**2),
        draws=np.asarray(draws),
        independent=np.asarray(independent) if joint else None,
        log_evidence=log_evidence,
        information_bits=information_bits,
        chi2=float(information.chi2(mean)),
        chi2_expected=float(information.n_data - np.vdot(information.matrix, covariance)),
        chi2_model=chi2_model,
        refinement=refinement,
        n_data=int(information.n_data),
        unknowns=None if unknowns is None else unknowns.report(mean, covariance, joint=joint),
    )


def _channel(
    observed: Observed,
    mean: Modes,
    covariance: ModesMatrix,
    compared: Float[np.ndarray, "more modes"] | None,
    **figures: Any,
) -> ChannelResult:
    """A channel with what follows from its observation, a mean and a covariance."""
    width, found = pixel_std(covariance, round(np.sqrt(observed.highest_altitude.size / 12))), ()
    if compared is not None and observed.truth is not None:
        found = Counts.of_pixels(width, observed.truth - mean, compared).coverage()
    names = ("frequency_mhz", "prior_std", "highest_altitude", "truth", "n_missing", "rounds")
    return ChannelResult(
        mean=mean,
        std=np.sqrt(np.diagonal(np.asarray(covariance))),
        pixel_std=width,
        doubts=(*observed.doubts, *about_information(figures["information_bits"])),
        coverage=found,
        instrument_chi2=observed.instrument.chi2,
        instrument_chi2_expected=observed.instrument.degrees,
        **{name: getattr(observed, name) for name in names},
        **figures,
    )


def channel_of_posterior(
    experiment: Experiment,
    inference: Inference,
    covariance: ModesMatrix,
    *,
    n_draws: int = 0,
    judged: Inference | None = None,
) -> ChannelResult:
    """The channel of a posterior over harmonic coefficients.

    Parameters
    ----------
    experiment : Experiment
    inference : Inference
        The posterior, and the model of the data.
    covariance : (modes, modes) array
        In K^2.
    n_draws : int
        How many draws of the posterior to keep.
    judged : Inference, optional
        The model that predicts the data and its posterior, where earlier data were there.
    """
    model, posterior, data = inference.model, inference.posterior, experiment.data
    judged = inference if judged is None else judged
    prior_variance = np.asarray(model.prior.variance())
    variance = np.sqrt(np.diagonal(covariance)) ** 2
    fraction = np.divide(
        variance, prior_variance, out=np.zeros(len(variance)), where=prior_variance > 0
    )
    observed = Observed.of(experiment, inference, ChiSquare(np.nan, np.nan))
    misfit = float(judged.model.chi2(judged.posterior.mean, data.data))
    return _channel(
        replace(observed, prior_std=np.sqrt(prior_variance)),
        np.asarray(posterior.mean),
        covariance,
        None if data.truth is None else deviations(experiment, posterior),
        prior_fraction=mean_over_m(fraction),
        draws=posterior_draws(experiment, posterior, n_draws),
        independent=None,
        log_evidence=float(posterior.log_evidence),
        information_bits=float(posterior.information_bits()),
        chi2=float(model.chi2(posterior.mean, data.data)),
        chi2_expected=expected_chi2(judged.posterior, model.n_data),
        chi2_model=misfit + float(judged.posterior.prior_chi2()),
        refinement=float(posterior.refinement),
        n_data=model.n_data,
    )


# at which SNR is told
ELLS = (5, 10, 20, 30)


def errors_by_latitude(channel: ChannelResult) -> list[dict[str, float | str]]:
    """By latitude: rms error in K, and the width of error bars over the sky's brightness.

    Parameters
    ----------
    channel : ChannelResult
        With its truth.
    """
    truth, mean = (modes_to_map(m, channel.nside) for m in (channel.truth, channel.mean))
    return [
        {
            "name": name,
            "rms_error_k": float(np.sqrt(((mean - truth)[inside] ** 2).mean())),
            "std_over_sky": float(channel.pixel_std[inside].mean() / truth[inside].mean()),
        }
        for name, inside in latitudes(channel.nside).items()
    ]


def snr_at_some_ell(channel: ChannelResult) -> dict[int, float]:
    """SNR_ell at 5, 10, 20 and 30, as far as the map goes.

    Parameters
    ----------
    channel : ChannelResult
        With its truth.
    """
    snr = channel.snr()
    return {ell: float(snr[ell]) for ell in ELLS if ell < len(snr)}
