"""The map of one channel: its posterior, tests of its data, and the result.

A channel is conditioned on its own data (:func:`conditioned`). They are examined once: chi^2 (group
by group if requested or needed), unknowns, and the usual mistakes if the data do not fit.
:func:`channel_result` then makes the result from the posterior of the sky, given this channel's
data or those of all channels.
"""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float, Int8

from lusee_bayes.core import harmonics
from lusee_bayes.core.arrays import Modes, ModesMatrix, Pixels
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.lazy import healpy
from lusee_bayes.core.linalg import mirrored, scaled, solve_lower
from lusee_bayes.core.progress import Stages
from lusee_bayes.experiment import diagnosis, rounds, validity
from lusee_bayes.experiment.experiment import Experiment, doubts, infer, posterior_draws, rounds_of
from lusee_bayes.experiment.unknowns import SkyAbove, Unknowns, flux_table, pointing_report
from lusee_bayes.instrument.beams.fields import HemisphereGrid
from lusee_bayes.judge import coverage, measures
from lusee_bayes.judge.plausibility import about_information
from lusee_bayes.judge.residuals import Residuals, residuals
from lusee_bayes.judge.split import Split
from lusee_bayes.linear.information import Information
from lusee_bayes.linear.posterior import Posterior, pixel_std, prior_pixel_std
from lusee_bayes.results.channel import ChannelData, ChannelResult, Details, Judged
from lusee_bayes.results.finished_runs import SavedInformation, taken
from lusee_bayes.results.map_result import prior_sentence
from lusee_bayes.results.sky_spectrum import Above, Columns, Departure, RegionTemperatures, WithSky
from lusee_bayes.sky.prior import DensePrior, Prior
from lusee_bayes.systematics.beam import beam_rms_difference

STRONGER_ABOVE = """The sky above lmax is not as its prior expects: data fit only if any is allowed
there, and error bars may be too small. Raise lmax, or use prior.model=local_scales."""
APART = "With earlier data, each channel has its own sky above lmax: errors may be too small."
# standard deviation of modes without prior variance, relative to the widest
EXACT = 1e-12
# of several channels, groups of data are tested where p of instrument and noise is below this
DOUBTFUL = 0.01
REGION_NSIDE = 8
# number of draws in a report
FEW = 4
# largest value of a signed byte
LARGEST_STEP = 127
# nodes of the drawn beams, and the products drawn: an auto, and its crosses with the opposite and
# the adjacent antenna
BEAM_NODES, BEAMS = (48, 120), (0, 2, 1)


def conditioned(
    experiment: Experiment, earlier: SavedInformation | None = None, stages: Stages | None = None
) -> "Conditioned":
    """Condition an experiment's model on its data, and on earlier data.

    Parameters
    ----------
    experiment : Experiment
    earlier : SavedInformation, optional
        Information in earlier data, to be combined with these.
    stages : Stages, optional
        Reports progress.

    Raises
    ------
    InputError
        If the earlier data already include these, and as :func:`infer`.
    """
    with rounds_of(experiment, stages or Stages(), "posterior") as report:
        new, data = infer(experiment, report), experiment.data
        setup, kept, times = experiment.setup, None, taken(data.observation)
        digest = f"{data.digest()} {times['first']} {times['last']}"
        if earlier is not None or experiment.scenario.output.information:
            kept = rounds.of_whole_sky(setup, new)
        if earlier is None:
            return Conditioned(experiment, new, new, new, (digest,), kept)
        kept = earlier.with_more(kept, digest)
        information, prior = rounds.of_map(setup, kept), new.model.prior
        posterior = information.posterior(prior)
        information = information.recentred(posterior.mean)
        before, whole = earlier.information, rounds.model_of_whole_sky(setup, new)
        if whole is None:
            judge = new.under(_given_earlier(before.posterior(prior))).solution
        else:  # the sky above lmax is the same in the earlier data
            before = replace(before, reference=before.reference - rounds.expected_sky(setup))
            whole = replace(whole, prior=_given_earlier(before.posterior(whole.prior)))
            judge = whole.condition(data.data).less(new.solution.excess)
        parts = {"posterior": posterior, "kept_information": information, "excess": 0.0}
        total = replace(new, solution=replace(new.solution, **parts))
        judged = replace(new, solution=judge)
        return Conditioned(experiment, new, total, judged, (*earlier.digests, digest), kept)


def _given_earlier(posterior: Posterior) -> DensePrior:
    """The posterior given earlier data, as the prior for new data."""
    width = np.sqrt(np.asarray(posterior.prior.variance()))
    # a prior without variance in a mode has no density
    exact = np.diag(EXACT * width.max() * (width == 0))[:, width == 0]
    root = np.concatenate([np.asarray(posterior.root()), exact], axis=1)
    return DensePrior.of_root(root, np.asarray(posterior.mean))


@dataclass(frozen=True)
class Conditioned:
    """A channel conditioned on its own data, and on earlier data at the same frequency.

    Attributes
    ----------
    experiment : Experiment
    from_data : rounds.Inference
        Given these data alone.
    from_all : rounds.Inference
        The model of these data, and the posterior given all data.
    judged : rounds.Inference
        The model that predicts these data: its prior is the posterior given the earlier data.
    digests : tuple of str
        Digests of all data.
    kept : Information or None
        In all data, to be saved or added (:func:`.of_whole_sky`).
    """

    experiment: Experiment
    from_data: rounds.Inference
    from_all: rounds.Inference
    judged: rounds.Inference
    digests: tuple[str, ...]
    kept: Information | None = None

    @property
    def onto(self) -> bool:
        """Whether there are earlier data."""
        return self.from_all is not self.from_data

    @property
    def information(self) -> Information:
        """The information in all data."""
        return self.from_all.solution.information

    @property
    def posterior(self) -> Posterior:
        """The posterior given all data."""
        return self.from_all.posterior

    @property
    def covariance(self) -> ModesMatrix:
        """Covariance of the posterior, in K^2."""
        return self.from_all.solution.covariance

    @cached_property
    def pixel_std(self) -> Pixels:
        """Standard deviations of the map's pixels, in K."""
        return pixel_std(self.covariance, self.experiment.scenario.map_nside)

    @cached_property
    def without_monopole(self) -> tuple[Pixels, Pixels]:
        """Variances of pixels under posterior and prior, monopole excluded.

        The prior of the monopole is very wide, but any data measure it: including it would bring
        the prior's share close to zero everywhere.
        """
        covariance, nside = self.covariance, self.experiment.scenario.map_nside
        monopole = 1.0 / np.sqrt(4.0 * np.pi)
        with_mean = harmonics.modes_to_map(covariance[0], nside)
        with_monopole = 2.0 * with_mean - monopole * covariance[0, 0]
        before = prior_pixel_std(self.from_all.model.prior, nside) ** 2
        return self.pixel_std**2 - monopole * with_monopole, before

    @cached_property
    def unknowns(self) -> Unknowns | None:
        """Receivers, ground and gain table given the sky, from these data alone."""
        return Unknowns.of(self.experiment, self.from_data)

    @cached_property
    def split(self) -> Split:
        """chi^2 of these data in its two parts."""
        judge = self.judged.solution
        return Split.of(judge.posterior, judge.chi2, self.from_data.model.n_data, judge.matrix)

    @cached_property
    def split_of_all(self) -> Split:
        """chi^2 of all data in its two parts."""
        posterior, information = self.posterior, self.information
        chi2 = float(information.chi2(posterior.mean) + posterior.prior_chi2())
        return Split.of(posterior, chi2, int(information.n_data))

    @cached_property
    def above(self) -> SkyAbove | None:
        """The sky above lmax given the sky; None if the model ends there, or of earlier data."""
        if self.onto:
            return None
        return SkyAbove.of(self.experiment.setup, self.from_data, self.split.wide)

    @cached_property
    def expected(self) -> float:
        """Expected chi^2 of these data about the mean, if the model is right."""
        variance = None if self.onto else np.diagonal(self.covariance)
        return measures.expected_chi2(self.judged.posterior, self.from_data.model.n_data, variance)

    @cached_property
    def drawn(self) -> Float[np.ndarray, "n modes"]:
        """All draws, in K, so that the prior's parameters are drawn only once."""
        with_truth = self.experiment.data.truth is not None
        n = max(self.experiment.scenario.output.draws, FEW) + with_truth * coverage.N_DRAWS
        return posterior_draws(self.experiment, self.posterior, lambda: self.information, n)

    @property
    def draws(self) -> Float[np.ndarray, "n modes"]:
        """The number of draws that the scenario's output requests, in K."""
        return self.drawn[: self.experiment.scenario.output.draws]

    def log_likelihood(self) -> Float[np.ndarray, " n"]:
        """ln p(d | m) of these data for every draw."""
        if not len(self.draws):
            return np.zeros(0)
        solution = self.from_data.solution
        # without the correction for unknowns whose prior means have moved
        return solution.information.log_likelihood(self.draws) - 0.5 * solution.excess

    def of_all(self, data: ChannelData) -> ChannelData:
        """Replace n_data and chi^2 by those of all data, which a joint posterior uses."""
        if not self.onto:
            return data
        n_data, split = int(self.information.n_data), self.split_of_all
        return replace(data, n_data=n_data, instrument=split.instrument)

    def compared(self) -> Float[np.ndarray, "more modes"] | None:
        """Draws minus the mean for :class:`.Counts`, in K; None if the truth is unknown."""
        if self.experiment.data.truth is None:
            return None
        return self.drawn[-coverage.N_DRAWS :] - self.posterior.mean

    def figures(self) -> dict[str, float | bool]:
        """Further arguments of :func:`channel_result`: numbers, and whether C is kept."""
        posterior, judge = self.posterior, self.judged.solution
        return {
            "log_evidence": float(posterior.log_evidence),
            "information_bits": float(posterior.information_bits()),
            "chi2": float(judge.model.chi2(judge.posterior.mean, judge.data)) - judge.excess,
            "chi2_expected": self.expected,
            "chi2_model": judge.chi2,
            "refinement": float(posterior.refinement),
            "covariance_kept": self.experiment.scenario.output.covariance,
        }

    def result(self, data: ChannelData, stages: Stages | None = None) -> ChannelResult:
        """The channel's result under this posterior."""
        with (stages or Stages())("standard deviations"):
            given = data, self.posterior.mean, self.covariance, self.compared()
            more = {"pixels": self.pixel_std, "instrument": self.unknowns, **self.figures()}
            more |= {"draws": self.draws, "log_likelihood": self.log_likelihood()}
            made = channel_result(*given, **more)
            if not self.onto or made.unknowns is None:
                return made
            alone = self.from_data.solution
            report = self.unknowns.report(alone.posterior.mean, alone.covariance)
            return replace(made, unknowns=replace(report, onto=True))

    def overlap(self) -> tuple[str, ...]:
        """A doubt if earlier data were taken during the same time."""
        *earlier, (_, first, last) = (digest.split() for digest in self.digests)
        same = [times for _, *times in earlier if times and times[0] <= last and first <= times[1]]
        return tuple(
            f"These data ({first} to {last}) overlap in time with earlier ones ({begin} to {end}): "
            "samples in both count twice."
            for begin, end in same[:1]
        )

    def channel_data(
        self,
        stages: Stages | None = None,
        *,
        alone: bool = True,
        joint: bool = False,
        thorough: bool = False,
    ) -> ChannelData:
        """Examine these data.

        Parameters
        ----------
        stages : Stages, optional
            Reports progress.
        alone : bool
            Whether this is the only channel: the report then shows more.
        joint : bool
            Whether its sky will be that of a joint posterior: this one's covariance is not needed.
        thorough : bool
            Test groups of data and try the usual mistakes even if the data fit.
        """
        experiment, inference, stages = self.experiment, self.from_data, stages or Stages()
        thorough = thorough or inference.size_of_fields > rounds.LARGER
        scenario, data, learned = experiment.scenario, experiment.data, experiment.learned
        found: dict[str, Any] = {}
        judge, unused, left, stronger = self.judged.solution, inference.unused(), None, ()
        if experiment.setup.responses and scenario.sources.treatment != "ignored":
            with stages("fluxes"):
                found["fluxes"] = flux_table(experiment, inference)
        with stages("diagnostics"):
            if not (alone or thorough):
                instrument = self.split.instrument.allowing(unused)
            if alone or thorough or instrument.p < DOUBTFUL:
                left = residuals(judge, data, unused, learned=learned is not None)
                instrument = left.split.instrument
            if self.onto:  # the sky is the same, so its prior is judged by all data
                prior = found["prior_of_all"] = self.split_of_all.prior
                left = left and replace(left, split=replace(left.split, prior=prior))
            found["details"] = _details(self) if alone else None
        bad = left is not None and left.level() == "does not fit"
        if bad or thorough:
            with stages("usual mistakes"):
                named = found["diagnosis"] = diagnosis.diagnose(experiment.setup, inference, left)
                # no mistake: a prior above lmax that is wrong blames no data
                blameless = bad and (not named.proposals or named.is_truncation)
                if blameless and (other := self._under_any_sky_above(left, unused)):
                    left, instrument = other, other.split.instrument
                    stronger = (" ".join(STRONGER_ABOVE.split()),)
        if left is not None:
            truncated = "diagnosis" in found and found["diagnosis"].is_truncation
            found["judged"] = self._judged(left, truncated=truncated)
        if scenario.noise.pointing is not None or bad:
            with stages("clock and pointing"):
                found["pointing"] = pointing_report(experiment, inference)
        notes = [] if left is None else validity.about_sky_above(experiment.setup)
        with stages("first order"):
            not_gaussian, harmless = validity.reach(experiment, inference, alone)
        fitting = experiment.fitting
        altitude = experiment.highest_altitude
        if not joint:
            found["departure"] = Departure.of(altitude, self.posterior, self._shared(alone))
        stronger += (APART,) * (joint and self.onto and experiment.setup.above is not None)
        return ChannelData(
            frequency_mhz=scenario.frequency_mhz,
            taken=taken(data.observation),
            labels=tuple(data.labels),
            hours=np.asarray(data.observation.hours),
            turntable_deg=np.asarray(data.observation.turntable_deg)[data.observation.run],
            data=np.asarray(data.grid()),
            n_data=inference.model.n_data,
            n_missing=data.n_missing,
            rounds=inference.rounds,
            flagged=None if fitting is None or not fitting.flagged.any() else fitting.flagged,
            flagged_share=0.0 if fitting is None else fitting.share,
            prior_std=np.sqrt(np.asarray(inference.model.prior.variance())),
            truth=None if data.truth is None else np.asarray(data.truth),
            highest_altitude=altitude,
            instrument=instrument,
            prior=prior_sentence(experiment),
            parameters=() if learned is None else tuple(learned.as_rows()),
            log_evidence_learned=None if learned is None else learned.log_evidence,
            beam_rms_difference=beam_rms_difference(experiment.setup),
            doubts=(*doubts(experiment, inference), *stronger, *not_gaussian, *self.overlap()),
            notes=(*notes, *harmless),
            digests=self.digests,
            information=self.kept if scenario.output.information else None,
            seen_above=0.0 if alone or self.above is None else self.above.told,
            **found,
        )

    def _under_any_sky_above(self, left: Residuals, unused: float) -> Residuals | None:
        """The residuals if any sky above lmax is allowed; None if the data do not fit even then."""
        data = self.experiment.data
        model = rounds.model_of_whole_sky(self.experiment.setup, self.from_data)
        # data that do not fit may need a sky for which float64 has too few digits
        with suppress(InputError):
            if model is not None:
                other = residuals(model.condition(data.data), data, unused, learned=left.learned)
                other = replace(other, split=replace(other.split, prior=left.split.prior))
                return None if other.level() == "does not fit" else other
        return None

    def _shared(self, alone: bool) -> tuple[WithSky, Columns, Above]:
        """Parts of a :class:`.Departure`, in K^2 and K."""
        above = None if alone else self.above
        unknowns, sources, n = self.unknowns, self.covariance[:0], 0
        shared, none = np.zeros(0, dtype=int), np.zeros((len(self.covariance), 0))
        if unknowns is None and above is None:
            return self.covariance, none, none
        amplitudes = unknowns.amplitudes if above is None else above.amplitudes
        given = amplitudes.integrated(self.posterior.mean, self.covariance)
        with_all = given.with_sky
        if unknowns is not None:
            fluxes, shared, n = unknowns.fluxes(given), unknowns.shared, len(unknowns.rows)
            sources, with_all = fluxes.with_sky, fluxes.with_all
        lower = np.linalg.cholesky(given.covariance[np.ix_(shared, shared)])
        both = np.concatenate([with_all, given.covariance[n:]])[:, shared]
        w, inner = np.split(solve_lower(lower, both.T, transpose=False).T, [len(with_all)])
        beyond = with_all[:, n:] - w @ inner.T  # without columns if the model ends at lmax
        beyond = beyond if above is None else beyond @ above.directions.T
        return np.concatenate([self.covariance, sources]), w, beyond

    def _judged(self, misfit: Residuals, *, truncated: bool) -> Judged:
        """Describe the residuals, with the verdict in words."""
        layout, prior = self.experiment.data.layout, self.from_all.model.prior
        expected = prior.variance() - np.diagonal(self.covariance)
        left, before = self.without_monopole
        moved = self.posterior.mean - prior.colour(prior.white_mean)
        strong = measures.strengths(moved, expected, before - left)
        fit = misfit.fit(measures.strengths_in_words(strong), truncated=truncated)
        return Judged(
            level=fit.level,
            verdict=fit.text,
            prior=misfit.split.prior,
            extremes=tuple(map(str, misfit.extremes())),
            suspects=tuple(map(str, misfit.suspects())),
            z=np.where(layout.present, layout.scatter(misfit.z), np.nan),
            groups=misfit.groups,
        )


def channel_result(
    data: ChannelData,
    mean: Modes,
    covariance: ModesMatrix,
    compared: Float[np.ndarray, "more modes"] | None = None,
    *,
    pixels: Pixels | None = None,
    instrument: Unknowns | None = None,
    common: Callable[[np.ndarray], np.ndarray] | None = None,
    joint: Float[np.ndarray, "all modes"] | None = None,
    covariance_kept: bool = False,
    information_bits: float = np.nan,
    **figures: Any,
) -> ChannelResult:
    """Make a channel's result from a mean and a covariance.

    Parameters
    ----------
    data : ChannelData
        The channel's own data.
    mean, covariance : (modes,) and (modes, modes) array
        In K and K^2.
    compared : (more, modes) array, optional
        Draws minus mean for :class:`.Counts`, in K, if the truth is known.
    pixels : (pixels,) array, optional
        Standard deviations of pixels in K; computed if omitted.
    instrument : Unknowns, optional
        Unknowns of the instrument given the sky, where the model has them.
    common : callable, optional
        Gives the covariance with other channels, as of :meth:`.RegionTemperatures.of`.
    joint : (all, modes) array, optional
        Draws of the sky in a posterior of all channels, in K.
    covariance_kept : bool
        Keep the covariance with the result.
    information_bits, **figures
        Other attributes of :class:`.ChannelResult`: ``chi2``, ``draws``, ``log_likelihood`` ...
    """
    mean, covariance = np.asarray(mean), np.asarray(covariance)
    width, held, variance = pixels, (), np.diagonal(covariance)
    if width is None:
        width = pixel_std(covariance, round(np.sqrt(data.highest_altitude.size / 12)))
    if compared is not None and data.truth is not None:
        held = coverage.Counts.of_pixels(width, data.truth - mean, np.asarray(compared)).coverage()
    power = data.prior_std**2
    share = np.divide(variance, power, out=np.zeros(len(variance)), where=power > 0)
    report, theta, roots, fluxes = None, None, {}, None
    if instrument is not None:
        report = instrument.report(mean, covariance, joint=joint is not None)
        theta, roots, fluxes = instrument.instrument(mean, covariance, width)
    options = {"truth": data.truth, "roots": roots, "common": common, "draws": joint}
    options |= {"departure": data.departure, "fluxes": fluxes if joint is None else None}
    return ChannelResult(
        **(vars(data) | {"doubts": (*data.doubts, *about_information(information_bits))}),
        **figures,
        mean=mean,
        std=np.sqrt(variance),
        prior_fraction=harmonics.mean_over_m(share),
        pixel_std=width,
        covariance=covariance if covariance_kept else None,
        information_bits=information_bits,
        coverage=held,
        unknowns=report,
        theta=theta,
        temperatures=RegionTemperatures.of(data.highest_altitude, mean, covariance, **options),
    )


def _details(channel: Conditioned) -> Details:
    """Extra quantities that a report shows for a single map."""
    setup, covariance = channel.experiment.setup, channel.covariance
    lmax, nside = setup.scenario.lmax, setup.scenario.map_nside
    prior = channel.from_all.model.prior
    resolution, steps, widths = packed_resolution(covariance, prior)
    left, before = channel.without_monopole
    rows = region_rows(nside, lmax)
    seen = rows @ covariance
    of_regions = (seen * rows).sum(1)
    with_monopole = 2.0 * seen[:, 0] - rows[:, 0] * covariance[0, 0]
    without = np.where(np.arange(len(covariance)) > 0, rows, 0.0)
    region_prior = (prior.colour_columns(without) ** 2).sum(1)
    grid = HemisphereGrid.gauss_legendre(*BEAM_NODES)
    patterns = np.asarray(setup.beam_source.patterns(setup.scenario.frequency_mhz, grid))[0]
    names = ["auto 00", "|cross 02|", "|cross 01|"]
    if not setup.scenario.beam.is_file:
        names = ["auto 00 (North)", "|cross 02| (opposite)", "|cross 01| (perpendicular)"]
    drawn = [(name, patterns[k]) for name, k in zip(names, BEAMS, strict=True) if k < len(patterns)]
    return Details(
        pattern_names=tuple(name for name, _ in drawn),
        draws=channel.drawn[:FEW],
        prior_fraction=left / before,
        region_mean=rows @ channel.posterior.mean,
        region_std=np.sqrt(of_regions),
        region_prior_fraction=(of_regions - rows[:, 0] * with_monopole) / region_prior,
        resolution=resolution,
        resolution_step=steps,
        prior_width=widths,
        patterns=np.stack([np.abs(pattern) for _, pattern in drawn]),
    )


def packed_resolution(
    covariance: ModesMatrix, prior: Prior
) -> tuple[Int8[np.ndarray, "modes modes"], Float[np.ndarray, "ells ells"], Modes]:
    """Pack the resolution matrix, for the point-spread function of any direction.

    The resolution matrix is R = 1 - C S^-1 = D K D^-1, with D the prior's standard deviations; if
    the prior correlates modes, D is the rms over each multipole, since one mode may be 60 times as
    wide as another. K is symmetric if S is diagonal. It is stored with one byte for each entry, in
    steps that depend on the pair of multipoles.

    Parameters
    ----------
    covariance : (modes, modes) array
        Posterior covariance, in K^2.
    prior : Prior
        S, over the same modes, with NumPy's arrays.

    Returns
    -------
    (modes, modes) array of int8
        K in steps; zero for modes without prior variance.
    (ells, ells) array
        The steps.
    (modes,) array
        D, in K.
    """
    variance = np.asarray(prior.variance())
    ell, _ = harmonics.mode_numbers(harmonics.lmax_of(len(variance)))
    width = np.sqrt(variance if prior.independent else harmonics.mean_over_m(variance)[ell])
    power = width > 0
    inverse = np.divide(1.0, width, out=np.zeros(len(width)), where=power)
    if prior.independent:
        white = mirrored(scaled(covariance, inverse))
    else:  # row by row, D^-1 C S^-1 D
        white = scaled(prior.whiten_columns(prior.whiten(covariance)), inverse, overwrite=True)
        white *= width[None] ** 2
    np.negative(white, out=white)
    white[np.diag_indices_from(white)] += power
    starts = np.flatnonzero(np.diff(ell, prepend=-1))
    largest = np.maximum.reduceat(np.abs(white), starts, axis=0)
    largest = np.maximum.reduceat(largest, starts, axis=1)
    steps = np.where(largest > 0, largest, 1.0) / LARGEST_STEP
    return np.rint(white / steps[np.ix_(ell, ell)]).astype(np.int8), steps, width


def region_rows(nside: int, lmax: int) -> Float[np.ndarray, "regions modes"]:
    """Rows that average a map's pixels over each region, a coarse pixel in RING order."""
    coarse = min(REGION_NSIDE, nside)
    in_ring_order = healpy.ring2nest(coarse, np.arange(healpy.nside2npix(coarse)))
    # in NESTED order, the pixels of a region follow one another
    angles = np.stack(healpy.pix2ang(nside, np.arange(healpy.nside2npix(nside)), nest=True), axis=1)
    regions = angles.reshape(len(in_ring_order), -1, 2)[in_ring_order]
    return np.stack([harmonics.synthesis_matrix(*of.T, lmax).mean(0) for of in regions])
