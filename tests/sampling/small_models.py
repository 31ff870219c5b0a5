"""Small Gaussian models as dense matrices, and means of draws against what is known otherwise."""

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from arviz_stats.base import array_stats
from reference_linear import Answer, posterior, random_covariance, z_of

import lusee_bayes as lb
from lusee_bayes.experiment.scenario import Scenario
from lusee_bayes.noise.covariance import DenseCovariance

# kinds of N
NOISES = {"paper": ("fiducial",), "exact": ("fiducial", "noise.radiometer.form=exact")}
NOISES |= {"gain": ("gain_1e-2",), "beam": ("beam_4MHz",)}


def noisy(noise: str, *more: str) -> Scenario:
    """96 data of 49 modes with a kind of N."""
    scenario, *overrides = NOISES[noise]
    small = ["lmax=6", "observation.runs.0.cycles=0.02", *overrides, *more]
    return lb.load_scenario(scenario, small)


def random_gaussian(spectrum, n_data: int, seed: int, noise: float = 1.0) -> lb.LinearGaussian:
    """A random dense A, and noise that is correlated."""
    rng, prior = np.random.default_rng(seed), lb.HarmonicPrior(jnp.asarray(spectrum))
    a = rng.normal(size=(n_data, prior.size))
    n = DenseCovariance(jnp.asarray(noise * random_covariance(rng, n_data)))
    return lb.LinearGaussian(jnp.asarray(a), prior, n)


def spectrum_of(base, amplitude, tilt):
    """C_ell of the program prior_amplitude, from its docstring."""
    return base * amplitude * ((np.arange(len(base)) + 1) / 10) ** tilt


@dataclass(frozen=True, eq=False)
class Case:
    """Data of a sky in correlated noise, as dense matrices."""

    a: np.ndarray
    base: np.ndarray
    n: np.ndarray
    data: np.ndarray

    @classmethod
    def drawn(cls, base, n_data, seed, noise, level=1.0, amplitude=1.0, tilt=0.0) -> "Case":
        """Data of a random A; N is too small by a factor ``level``."""
        rng, base = np.random.default_rng(seed), np.asarray(base)
        a = rng.normal(size=(n_data, len(base) ** 2))
        n = noise * random_covariance(rng, n_data)
        width = np.sqrt(per_mode(spectrum_of(base, amplitude, tilt)))
        sky = width * rng.normal(size=len(width))
        root = np.sqrt(level) * np.linalg.cholesky(n)
        return cls(a, base, n, a @ sky + root @ rng.normal(size=n_data))

    def given(self, amplitude=1.0, tilt=0.0, level=1.0) -> Answer:
        """Textbook posterior of the sky, with the evidence; N times a level."""
        s = np.diag(per_mode(spectrum_of(self.base, amplitude, tilt)))
        return posterior(self.a, s, level * self.n, self.data)

    def arguments(self) -> dict[str, object]:
        """What programs are called with, but for the data."""
        return {
            "coupling": jnp.asarray(self.a),
            "offset": jnp.zeros(len(self.a)),
            "prior": lb.HarmonicPrior(jnp.asarray(self.base)),
            "noise": DenseCovariance(jnp.asarray(self.n)),
        }


def per_mode(spectrum) -> np.ndarray:
    """A number for each ell at every mode."""
    return np.repeat(spectrum, 2 * np.arange(len(spectrum)) + 1)


def assert_mean(draws, expected, what, slack=1.1):
    """Mean of every column (chains, draws, columns), in Monte Carlo errors by ArviZ's ESS.

    ESS itself scatters by a tenth at these lengths, hence a tenth on top of the false alarm rate's.
    """
    ess = array_stats.ess(draws, chain_axis=0, draw_axis=1, method="mean")
    assert ess.min() > 150, f"{what}: too few effective draws to judge"
    z = np.abs(draws.mean((0, 1)) - expected) / (draws.std((0, 1)) / np.sqrt(ess))
    assert z.max() < slack * z_of(z.size), f"{what} off by {z.max():.1f} Monte Carlo errors"
