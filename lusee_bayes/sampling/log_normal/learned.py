"""A log-normal prior as the Gaussian that it is about the mode, with the posterior that it is not.

Linearised at the mode u* ::

    m = m* + J (u - u*),    u ~ N(0, 1),

the prior is Gaussian. Conditioned on the data it gives the mean m* and the covariance J H^-1 J^T:
what Laplace's approximation says of the sky. Draws are those of the posterior itself.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import jax
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from lusee_bayes.core.harmonics import modes_to_map
from lusee_bayes.linear.information import Information
from lusee_bayes.linear.learning import Learned
from lusee_bayes.sampling.log_normal.gauss_newton import find_mode
from lusee_bayes.sampling.log_normal.learning import learn_spectrum
from lusee_bayes.sampling.log_normal.posterior import LogNormalPosterior, SkyDraws
from lusee_bayes.sampling.log_normal.prior import LogNormalPrior

# weighted draws made at a time
PART = 600
# draws of equal weight that tell by how much standard deviations differ from those to first order
WIDTHS = 300
# those of equal weight are worth so many times their number: else the heaviest come too rarely
SPARE = 2
# weighted draws at most for every one of equal weight
MOST = 8
# what the seed is folded with for weighted draws
WEIGHTED = 9


@dataclass(frozen=True)
class LearnedLogNormal(Learned):
    """A log-normal prior, its C_ell learned or given, and the posterior over the sky.

    ``prior`` is the Gaussian of the module's equations. Without unknowns of C_ell there are no
    parameters.

    Attributes
    ----------
    posterior : LogNormalPosterior
        Of u, and of A and the tilt where they were learned.
    seed : int
        Of draws.
    """

    posterior: LogNormalPosterior
    seed: int

    def drawn(self, key: PRNGKeyArray, n: int) -> Drawn:
        """Draw positive skies of equal weight.

        Parameters
        ----------
        key : PRNG key
        n : int
            How many. If 8 n weighted draws are worth fewer, some come more than once
            (:meth:`doubts`).
        """
        sky = self.posterior.mode.sky
        if not n:
            none = np.empty((0, len(self.names)))
            return Drawn(np.empty((0, sky.n_modes)), np.empty((0, sky.size)), none)
        draws = self._worth(n)
        everything = np.concatenate([draws.skies, draws.white, draws.parameters], axis=1)
        chosen = draws.resampled(everything, key, min(n, int(draws.effective)))
        chosen = chosen[np.arange(n) % len(chosen)]
        return Drawn(*np.split(chosen, [sky.n_modes, sky.n_modes + sky.size], axis=1))

    def pixels(self, drawn: Drawn, nside: int) -> Float[np.ndarray, "draws pixels"]:
        """Compute drawn skies at the centres of HEALPix RING pixels: positive, in K."""
        return self.posterior.mode.sky.pixels(drawn.white, nside)

    @cached_property
    def _parts(self) -> list[SkyDraws]:
        return []

    def _worth(self, n: int) -> SkyDraws:
        """Weighted draws, made once, that are worth a few times n; else 8 n or more of them."""
        key, number = jax.random.fold_in(jax.random.key(self.seed), WEIGHTED), 1
        while True:
            if len(self._parts) < number:
                self._parts.append(self.posterior.sample(jax.random.fold_in(key, number), PART))
            draws = SkyDraws.joined(self._parts[:number])
            if draws.effective >= SPARE * n or number * PART >= MOST * n:
                return draws
            number += 1

    def std(self) -> Float[np.ndarray, " modes"]:
        """Compute the standard deviation of the sky's coefficients, in K."""
        return self.posterior.std(self._worth(WIDTHS))

    def pixel_std(
        self, first_order: Float[np.ndarray, " pixels"], nside: int
    ) -> Float[np.ndarray, " pixels"]:
        """Compute the standard deviation of pixels of the sky's coefficients.

        Parameters
        ----------
        first_order : (pixels,) array
            What J H^-1 J^T says, HEALPix RING, in K.
        nside : int
            Of the pixels.

        Returns
        -------
        (pixels,) array
            In K.
        """
        draws = self._worth(WIDTHS)
        linear = draws.linear @ self.posterior.mode.jacobian.T
        maps, known = (
            np.stack([modes_to_map(sky, nside) for sky in skies]) for skies in (draws.skies, linear)
        )
        return first_order * np.sqrt(draws.variance(maps) / known.var(0))

    def doubts(self) -> tuple[str, ...]:
        """Say where too few of the weighted draws count."""
        draws = self._worth(WIDTHS)
        if draws.effective * MOST > len(draws.white):
            return ()
        return (
            f"of {len(draws.white)} draws of the log-normal sky {draws.effective:.0f} count: its "
            "standard deviations and draws are rough; lusee-bayes sample has better ones",
        )


@dataclass(frozen=True)
class Drawn:
    """Drawn skies.

    Attributes
    ----------
    skies : (draws, modes) array
        Coefficients, in K.
    white : (draws, unknowns) array
        u, with the mode's C_ell.
    parameters : (draws, parameters) array
        ln A and the tilt, where they were learned.
    """

    skies: Float[np.ndarray, "draws modes"]
    white: Float[np.ndarray, "draws unknowns"]
    parameters: Float[np.ndarray, "draws parameters"]


def learn_log_normal(
    prior: LogNormalPrior, information: Information, seed: int = 1
) -> LearnedLogNormal:
    """Find the mode under a log-normal prior, where its C_ell is not known with that.

    Parameters
    ----------
    prior : LogNormalPrior
    information : Information
        What the data say of the sky.
    seed : int
        Of draws.

    Raises
    ------
    InputError
        As :func:`.find_mode` and :func:`.learn_spectrum`.
    """
    if not prior.is_learned:
        mode = find_mode(prior.sky, information)
        posterior, evidence, steps = LogNormalPosterior.about(mode), mode.log_evidence, mode.steps
        names, parameters, covariance = (), np.empty(0), np.empty((0, 0))
    else:
        found = learn_spectrum(prior, information)
        mode, covariance, steps = found.mode, found.covariance, found.steps
        posterior = LogNormalPosterior.learned(found, prior)
        parameters = np.array([np.log(found.prior.amplitude), found.prior.tilt])
        names = ("ln A", "tilt")
        around = 0.5 * np.linalg.slogdet(2.0 * np.pi * covariance)[1]
        evidence = mode.log_evidence + prior.log_density(*parameters) + around
    gaussian = mode.sky.linearised(mode.white)
    return LearnedLogNormal(
        gaussian, names, parameters, covariance, float(evidence), steps, posterior, seed
    )
