"""Draws of chains side by side, and statistics of every draw."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpyro.infer.hmc import HMCState

from lusee_bayes.core.arrays import Array

# statistics of every draw, by their ArviZ names
STATISTICS: dict[str, Callable[[HMCState], Array]] = {
    "lp": lambda s: -s.potential_energy,
    "energy": lambda s: s.energy,
    "diverging": lambda s: s.diverging,
    "acceptance_rate": lambda s: s.accept_prob,
    "step_size": lambda s: s.adapt_state.step_size,
    "n_steps": lambda s: s.num_steps,
}


@dataclass(frozen=True)
class Chains:
    """Draws, and statistics of every draw.

    Attributes
    ----------
    sites : dict of (chains, draws, ...) arrays
        Draws by site.
    statistics : dict of (chains, draws) arrays
        By the names of ``STATISTICS``.
    """

    sites: dict[str, np.ndarray]
    statistics: dict[str, np.ndarray]

    @property
    def gradients(self) -> int:
        """Gradient evaluations behind the draws, all chains together, warmup left out."""
        return int(self.statistics["n_steps"].sum())
