"""Noise of the receivers."""

from __future__ import annotations

import jax
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from lusee_bayes.core.arrays import Array
from lusee_bayes.experiment.emission import receiver_powers
from lusee_bayes.experiment.setup import Setup
from lusee_bayes.experiment.terms.term import Around, Term, Truth
from lusee_bayes.instrument.products import auto_indices
from lusee_bayes.systematics import LinearUnknowns, Systematic

# what the scenario's seed is folded with
DRAW = 8


class ReceiverTerm(Term):
    """``noise.receiver``; simulated data hold a drawn power for each port.

    Its mean is part of the setup's background, and so of the radiometer noise.
    """

    key = "noise.receiver"

    def build(self, setup: Setup, around: Around) -> list[tuple[str, Systematic]]:
        section = setup.scenario.noise.receiver
        if section is None or section.treatment == "ignored":
            return []
        return [(section.treatment, _receivers(setup))]

    def truth(self, setup: Setup, key: PRNGKeyArray) -> Truth:
        section = setup.scenario.noise.receiver
        if section is None:
            return {}
        mean = receiver_powers(setup.scenario, setup.beam_source)
        z = np.asarray(jax.random.normal(jax.random.fold_in(key, DRAW), mean.shape))
        powers = mean * (1.0 + section.relative_std * z)
        return dict(zip(_names(len(mean)), powers.tolist(), strict=True))

    def distort(
        self,
        visibilities: Float[Array, "products times"],
        setup: Setup,
        truth: Truth,
        key: PRNGKeyArray,
    ) -> Float[Array, "products times"]:
        if setup.scenario.noise.receiver is None:
            return visibilities
        n_ports = setup.beam_source.n_ports
        added = np.zeros((n_ports**2, 1))
        added[auto_indices(n_ports), 0] = [truth[name] for name in _names(n_ports)]
        return visibilities + added


def _names(n_ports: int) -> tuple[str, ...]:
    return tuple(f"receiver_{port}_k" for port in range(n_ports))


def _receivers(setup: Setup) -> LinearUnknowns:
    means = receiver_powers(setup.scenario, setup.beam_source)
    stds = setup.scenario.noise.receiver.relative_std * means
    autos = auto_indices(len(means))
    own = np.asarray(setup.layout.product)[:, None] == autos[None]
    return LinearUnknowns(_names(len(means)), means, stds, own * stds[None])
