"""The power spectrum of the prior, where it is not known."""

from __future__ import annotations

from lusee_bayes.experiment.setup import Setup
from lusee_bayes.experiment.terms.term import Around, Term
from lusee_bayes.systematics import PowerSpectrum, SpectrumBands, Systematic


class PriorSpectrumTerm(Term):
    """Amplitude and tilt of C_ell, or its bands; nothing of it is in the data."""

    key = "prior"

    def build(self, setup: Setup, around: Around) -> list[tuple[str, Systematic]]:
        prior = setup.scenario.prior
        if not prior.samples:
            return []
        if prior.band_edges:
            return [("sampled", SpectrumBands(prior.band_edges, prior.log_band_std))]
        return [("sampled", PowerSpectrum(prior.log_amplitude_std, prior.tilt_std))]
