"""Drifts of the antennas' gains."""

from __future__ import annotations

import jax
from jaxtyping import Float, PRNGKeyArray

from lusee_bayes.core.arrays import Array
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.lazy import numpyro
from lusee_bayes.experiment.setup import Setup
from lusee_bayes.experiment.terms.noise_about import gains_about, noise_visibilities
from lusee_bayes.experiment.terms.term import Around, Term, Truth
from lusee_bayes.noise import GainDrift, with_gains
from lusee_bayes.systematics import GainDrifts, Systematic

# what the scenario's seed is folded with: for the drifts, and for their scales
DRAW, SCALE_DRAW = 2, 6


class GainTerm(Term):
    """``noise.gain``; simulated data hold drawn drifts."""

    key = "noise.gain"

    def build(self, setup: Setup, around: Around) -> list[tuple[str, Systematic]]:
        gain = setup.scenario.noise.gain
        if gain is None or gain.treatment == "ignored":
            return []
        return [(gain.treatment, gain_drifts(setup, around))]

    def truth(self, setup: Setup, key: PRNGKeyArray) -> Truth:
        if setup.scenario.noise.gain is None:
            return {}
        # the scales where they are not known; the prior is the program's own
        with numpyro.handlers.seed(rng_seed=jax.random.fold_in(key, SCALE_DRAW)):
            drift = gain_drifts(setup, Around()).scales()
        return {"gain_sigma": float(drift.sigma), "gain_correlation_h": float(drift.correlation_h)}

    def distort(
        self,
        visibilities: Float[Array, "products times"],
        setup: Setup,
        truth: Truth,
        key: PRNGKeyArray,
    ) -> Float[Array, "products times"]:
        if "gain_sigma" not in truth:
            return visibilities
        drift = GainDrift(truth["gain_sigma"], truth["gain_correlation_h"])
        gains = drift.sample(jax.random.fold_in(key, DRAW), setup.observation.hours)
        return with_gains(visibilities, gains)


def gain_drifts(setup: Setup, around: Around) -> GainDrifts:
    """The gain drifts. InputError if the scenario has none."""
    gain = setup.scenario.noise.gain
    if gain is None:
        raise InputError("the scenario has no noise.gain that could be sampled")
    return GainDrifts.of(
        GainDrift(gain.sigma, gain.correlation_h),
        noise_visibilities(setup, around, gains_about(setup)),
        setup.observation.hours,
        setup.layout,
        gain.log_sigma_std,
        gain.log_correlation_std,
    )
