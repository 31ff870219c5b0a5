"""The posterior of a log-normal sky by draws in straight coordinates, each with its weight.

A draw is u(x), x = u* + R z with z ~ N(0, 1) in the coordinates of :mod:`.straight`. Its weight is
the ratio of the posterior's density to that of the Gaussian: all are nearly one where the data
determine the sky well, and weighted draws are those of the posterior in any case. Draws come in
pairs z and -z: whatever is odd in z cancels in means, but for the weights.

Where A and the tilt of C_ell are unknowns, too, they are drawn with u, and the weight is that of
all three.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from lusee_bayes.core.arrays import Array, on_device
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.linalg import solve_lower
from lusee_bayes.core.representation import Described
from lusee_bayes.linear.information import Information
from lusee_bayes.sampling.log_normal.gauss_newton import LogNormalMode
from lusee_bayes.sampling.log_normal.learning import LearnedSpectrum
from lusee_bayes.sampling.log_normal.prior import AMPLITUDE, STRUCTURE, TILT, LogNormalPrior
from lusee_bayes.sampling.log_normal.straight import straight_coordinates
from lusee_bayes.sampling.whitening import Whitening

# draws made at once: more take more memory, and no less time
BATCH = 8
# A and the tilt are drawn from a wider normal distribution: theirs is skewed, and draws out there
# would be few and heavy
WIDER = 1.3
# draws made by one call of the compiled program, which is the same for any number of them
CALL = 200


@dataclass(frozen=True, repr=False)
class SkyDraws(Described):
    """Draws of a log-normal sky in pairs about the mode.

    Attributes
    ----------
    white : (draws, unknowns) array
        u of every draw, with the mode's C_ell; the second half are the partners of the first.
    linear : (draws, unknowns) array
        x - u*, what u - u* would be if the posterior were Gaussian.
    skies : (draws, modes) array
        Real packed coefficients, Galactic, in K.
    log_weights : (draws,) array
        ln of the posterior's density over that which draws were made with, up to the evidence that
        Laplace's formula gives.
    parameters : (draws, parameters) array
        ln A and the tilt, where they are unknowns.
    """

    white: Float[np.ndarray, "draws unknowns"]
    linear: Float[np.ndarray, "draws unknowns"]
    skies: Float[np.ndarray, "draws modes"]
    log_weights: Float[np.ndarray, " draws"]
    parameters: Float[np.ndarray, "draws parameters"]

    def description(self) -> tuple[str, ...]:
        return (
            f"{len(self.white)} draws of {self.white.shape[1]} white unknowns, "
            f"{self.effective:.0f} effective",
            f"ln evidence over that of Laplace: {self.evidence_gain:.3f} +- "
            f"{self.evidence_error:.3f}",
        )

    @classmethod
    def joined(cls, parts: Sequence[SkyDraws]) -> SkyDraws:
        """Put draws of one posterior together."""

        def of(name: str) -> Float[np.ndarray, "draws *n"]:
            halves = [np.array_split(getattr(part, name), 2) for part in parts]
            return np.concatenate([half for side in zip(*halves, strict=True) for half in side])

        return cls(of("white"), of("linear"), of("skies"), of("log_weights"), of("parameters"))

    @property
    def weights(self) -> Float[np.ndarray, " draws"]:
        """Weights of the draws, one on average.

        None counts for more than the root of their number (Ionides 2008): by chance one draw in
        10,000 would carry a tenth of a mean.
        """
        relative = np.exp(self.log_weights - self.log_weights.max())
        relative = np.minimum(relative, np.sqrt(len(relative)) * relative.mean())
        return relative / relative.mean()

    @property
    def effective(self) -> float:
        """How many draws of equal weight say as much."""
        return float(len(self.weights) ** 2 / (self.weights**2).sum())

    def mean(self, values: Float[np.ndarray, "draws n"]) -> Float[np.ndarray, " n"]:
        """Compute the posterior mean of what was computed of every draw."""
        return self.weights @ values / len(values)

    def variance(self, values: Float[np.ndarray, "draws n"]) -> Float[np.ndarray, " n"]:
        """Compute the posterior variance of what was computed of every draw."""
        return self.mean((values - self.mean(values)[None]) ** 2)

    def resampled(
        self, values: Float[np.ndarray, "draws n"], key: PRNGKeyArray, n: int
    ) -> Float[np.ndarray, "m n"]:
        """Choose draws of equal weight.

        Parameters
        ----------
        values : (draws, n) array
            What was computed of every draw.
        key : PRNG key
        n : int
            How many.

        Raises
        ------
        InputError
            If they are more than the effective number of draws: too many would be the same.
        """
        if n > self.effective:
            raise InputError(
                f"{n} draws are asked for, and those of the log-normal sky are worth "
                f"{self.effective:.0f}; make more"
            )
        chance = jnp.asarray(self.weights / len(self.weights))
        chosen = jax.random.choice(key, len(self.weights), (n,), replace=False, p=chance)
        return values[np.asarray(chosen)]

    @property
    def evidence_gain(self) -> float:
        """ln p(d) less what Laplace's formula gives."""
        top = self.log_weights.max()
        return float(top + np.log(np.exp(self.log_weights - top).mean()))

    @property
    def evidence_error(self) -> float:
        """Standard error of ln p(d), from the pairs."""
        pairs = self.weights.reshape(2, -1).mean(0)
        return float(pairs.std(ddof=1) / np.sqrt(len(pairs)))


@dataclass(frozen=True, repr=False)
class LogNormalPosterior(Described):
    """p(u | d) about its mode.

    Attributes
    ----------
    mode : LogNormalMode
    coordinates : Whitening
        Straight ones, in which it is nearly N(0, 1).
    unknown : LogNormalPrior or None
        What is expected of A and the tilt where they are unknowns; None where they are known.
    """

    mode: LogNormalMode
    coordinates: Whitening
    unknown: LogNormalPrior | None = None

    @classmethod
    def about(cls, mode: LogNormalMode) -> LogNormalPosterior:
        """Make that of u, C_ell being known."""
        return cls(mode, straight_coordinates(mode))

    @classmethod
    def learned(cls, found: LearnedSpectrum, prior: LogNormalPrior) -> LogNormalPosterior:
        """Make that of u, A and the tilt.

        Parameters
        ----------
        found : LearnedSpectrum
            Where A and the tilt are most probable.
        prior : LogNormalPrior
            What was expected of them.
        """
        at = float(np.log(found.prior.amplitude)), float(found.prior.tilt)
        return cls(found.mode, straight_coordinates(found.mode, at, found.covariance), prior)

    def description(self) -> tuple[str, ...]:
        chart = self.coordinates.chart
        return (
            f"{self.mode.sky.size} white unknowns of a log-normal sky",
            f"{chart.across.shape[1]} stiff directions in {len(chart.bounds) - 1} groups",
            *self.mode.description()[1:],
        )

    def sample(self, key: PRNGKeyArray, n: int) -> SkyDraws:
        """Draw skies.

        Parameters
        ----------
        key : PRNG key
        n : int
            How many; even.

        Raises
        ------
        InputError
            If ``n`` is odd or less than 2.
        """
        if n < 2 or n % 2:
            raise InputError(
                f"draws of a log-normal sky come in pairs, got {n}; give an even number"
            )
        z = jax.random.normal(key, (n // 2, self.coordinates.root.shape[1]), dtype=jnp.float64)
        z = jnp.concatenate([z, -z])
        known = z.shape[1] - self.mode.sky.size
        drawn, z = np.asarray(z), z.at[:, :known].multiply(WIDER)
        given = on_device((self.mode.information, self.unknown))
        full = jnp.concatenate([z, jnp.zeros((-n % CALL, z.shape[1]))])
        calls = [
            _draw(self.coordinates, *given, part) for part in jnp.split(full, len(full) // CALL)
        ]
        white, skies, energies = (np.concatenate(rows)[:n] for rows in zip(*calls, strict=True))
        # so far out that numbers overflow there is no density
        outside = ~np.isfinite(energies)
        white[outside], skies[outside], energies[outside] = self.mode.white, self.mode.modes, np.inf
        least = 0.5 * (float(self.mode.information.misfit) + self.mode.white @ self.mode.white)
        if self.unknown is not None:
            least -= float(self.unknown.log_density(*np.asarray(self.coordinates.mean[:2])))
        log_weights = 0.5 * (drawn**2).sum(1) + known * np.log(WIDER) - (energies - least)
        moved = np.asarray(z) @ np.asarray(self.coordinates.root).T
        parameters = moved[:, :known] + np.asarray(self.coordinates.mean[:known])
        return SkyDraws(white, moved[:, known:], skies, log_weights, parameters)

    def covariance(self) -> Float[np.ndarray, "modes modes"]:
        """Compute that of the sky to first order about the mode, J H^-1 J^T, in K^2."""
        half = solve_lower(self.mode.lower, self.mode.jacobian.T, transpose=False)
        return half.T @ half

    def std(self, draws: SkyDraws) -> Float[np.ndarray, " modes"]:
        """Compute the standard deviation of m.

        Draws only tell by how much it differs from that to first order, which is known: for the
        same z, both are off by nearly the same factor.

        Parameters
        ----------
        draws : SkyDraws

        Returns
        -------
        (modes,) array
            In K.
        """
        first_order = draws.linear @ self.mode.jacobian.T
        known = np.diagonal(self.covariance())
        return np.sqrt(known * draws.variance(draws.skies) / first_order.var(0))


@eqx.filter_jit
def _draw(
    coordinates: Whitening,
    information: Information,
    unknown: LogNormalPrior | None,
    z: Float[Array, "draws unknowns"],
) -> tuple[Array, Array, Array]:
    """u with the mode's C_ell, m, and minus the log density of z, without constants."""

    def one(z):
        values, log_det = coordinates.to_values(coordinates.mean + coordinates.root @ z)
        white, reference = values[STRUCTURE], coordinates.chart.sky
        energy = 0.5 * white @ white - log_det
        if unknown is not None:
            power_law = values[AMPLITUDE], values[TILT]
            sky = reference.with_power_law(jnp.exp(power_law[0]), power_law[1])
            energy = energy - unknown.log_density(*power_law)
            white = white * sky.root() / reference.root()
        modes = reference.modes(white)
        return white, modes, energy + 0.5 * information.chi2(modes)

    return jax.lax.map(one, z, batch_size=BATCH)
