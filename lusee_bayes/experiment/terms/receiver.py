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
# cosines and sines of which a smooth spectrum is made
N_WAVES = 512


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
        if section.smooth_octaves is None:
            z = np.asarray(jax.random.normal(jax.random.fold_in(key, DRAW), mean.shape))
        else:
            shared = key if section.smooth_seed is None else jax.random.key(section.smooth_seed)
            octave = float(np.log2(setup.scenario.frequency_mhz))
            own = jax.random.fold_in(shared, DRAW)
            z = _smooth_spectra(own, len(mean), octave / section.smooth_octaves)
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


def _smooth_spectra(key: PRNGKeyArray, n_ports: int, x: float) -> Float[np.ndarray, " ports"]:
    """Values at x of functions of covariance exp(-(x - x')^2 / 2), one for each port.

    ::

        z(x) = sum_k (a_k cos w_k x + b_k sin w_k x) / sqrt(K),    a, b, w ~ N(0, 1),

    whose covariance over keys is the mean of cos w (x - x'), and whose values are N(0, 1) for
    any w.
    """
    waves, cosines, sines = np.asarray(jax.random.normal(key, (3, n_ports, N_WAVES)))
    values = cosines * np.cos(waves * x) + sines * np.sin(waves * x)
    return values.sum(1) / np.sqrt(N_WAVES)


def is_receiver(name: str) -> bool:
    """Tell whether an unknown's name is that of a receiver's power."""
    return name.startswith("receiver_") and name.endswith("_k")


def _names(n_ports: int) -> tuple[str, ...]:
    return tuple(f"receiver_{port}_k" for port in range(n_ports))


def _receivers(setup: Setup) -> LinearUnknowns:
    means = receiver_powers(setup.scenario, setup.beam_source)
    stds = setup.scenario.noise.receiver.relative_std * means
    autos = auto_indices(len(means))
    own = np.asarray(setup.layout.product)[:, None] == autos[None]
    return LinearUnknowns(_names(len(means)), means, stds, own * stds[None])
