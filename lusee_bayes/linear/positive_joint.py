"""One posterior for positive skies of several frequencies, by the Gauss-Newton method.

With the exponents phi_f = sum_c s_fc a_c + r_f of :mod:`.positive_skies`, ::

    E = sum_f chi^2_f(m_f(phi_f)) + sum_c a_c^T (C^c)^-1 a_c + sum_f r_f^T (R^f)^-1 r_f.

The sky is linear about given exponents, m_f + W_f (phi - phi_f), so that a channel's information
about phi is a quadratic form: W^T M W, W^T v. A round thus solves for a joint posterior
(:mod:`.joint`) of maps without unit, and of shared unknowns w of the instrument, whose w^T w is
part of E. The step to its mean is halved until E falls, and rounds are repeated until a step would
gain nothing. Meanwhile A and tilt of the fields may be learned.
The last posterior is the Gaussian about the mode; its evidence is Laplace's approximation.

The laws of the fields are learned in about twenty rounds from the large scales of all channels. A
and tilt define a power law, which modes of low ell determine almost completely. Modes of higher ell
are integrated out, with the power of the template.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, PRNGKeyArray
from scipy.linalg import block_diag

from lusee_bayes.core.arrays import Vector
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.harmonics import n_modes, per_mode, power_spectrum, sum_over_m
from lusee_bayes.core.linalg import inverse_from_cholesky, symmetric_product
from lusee_bayes.linear import joint
from lusee_bayes.linear.amplitudes import Patterns
from lusee_bayes.linear.information import Information, integrated_out
from lusee_bayes.linear.posterior import Posterior
from lusee_bayes.sky.positive_skies import FieldLaws, PositiveSkies
from lusee_bayes.sky.spectral_prior import SpectralPrior

# arrays that recur; exponents are followed by the values of the shared unknowns
Exponents = Float[np.ndarray, "channels whole"]

OfLaws = Float[np.ndarray, "laws ells"]
# converged if a round moves all unknowns together by less than SETTLED standard deviations, and
# every ln A and tilt by less than SETTLED_LAW
SETTLED, SETTLED_LAW = 0.1, 0.05
MAX_ROUNDS, HALVINGS = 60, 20


# arrays by name
Arrays = dict[str, np.ndarray]
# called with the number of every round, and how far it moved
Report = Callable[[int, str], None]
# functions of a channel's number and information
OfChannel = Callable[[int, Information], Any]
Linearised = Callable[[int, Information], Information]


@runtime_checkable
class Channels(Protocol):
    """The channels of a joint posterior, wherever their data are."""

    def each(self, function: OfChannel) -> list[Any]:
        """Call a function with number and information of every channel."""

    def summed(
        self, prior: SpectralPrior, reference: Exponents, function: Linearised
    ) -> Information:
        """Information about the component maps from a function of every channel's information."""


@dataclass(frozen=True)
class ChannelsInMemory:
    """Channels whose information is in memory.

    Attributes
    ----------
    informations : tuple of Information
        In the prior's order.
    """

    informations: tuple[Information, ...]

    def each(self, function: OfChannel) -> list[Any]:
        """Call a function with number and information of every channel."""
        return [function(k, information) for k, information in enumerate(self.informations)]

    def summed(
        self, prior: SpectralPrior, reference: Exponents, function: Linearised
    ) -> Information:
        """Information about the component maps from a function of every channel's information."""
        sums = joint.ComponentSums.empty(prior, reference)
        for k, information in enumerate(self.informations):
            sums = joint.summed_information(sums, prior, k, function(k, information))
        return sums.information()


@dataclass(frozen=True)
class PositiveMode:
    """The most probable skies, and the Gaussian about them.

    Attributes
    ----------
    skies : PositiveSkies
    laws : FieldLaws
    exponents : (channels, modes + shared) array
        phi_f about which the skies are linear, and the shared unknowns.
    posterior : Posterior
        Of the fields in one vector, the first field first, then the shared unknowns; no unit.
    energy : float
        E: chi^2 of all data under the model, prior included.
    moved : float
        Length of the last step, in standard deviations of all unknowns together.
    rounds : int
        Number of rounds.
    """

    skies: PositiveSkies
    laws: FieldLaws
    exponents: Exponents
    posterior: Posterior
    energy: float
    moved: float
    rounds: int

    @property
    def prior(self) -> SpectralPrior:
        """Prior of the fields."""
        return self.laws.prior(self.skies)


def diffuse_part(skies: PositiveSkies, channel: int, information: Information) -> Patterns:
    """A channel's information, separated into point sources and the diffuse sky."""
    sources = skies.sources[channel]
    beside = np.zeros((len(sources), max(information.n_modes - sources.shape[1], 0)))
    return Patterns.of(np.concatenate([sources, beside], axis=1), information)


def _whole(skies: PositiveSkies, channel: int, exponent: np.ndarray) -> np.ndarray:
    """The sky of an exponent, in K, and the shared unknowns."""
    n = skies.n_fields
    return np.concatenate([skies.modes(channel, exponent[..., :n]), exponent[..., n:]], axis=-1)


def _slope(skies: PositiveSkies, channel: int, exponent: Vector) -> np.ndarray:
    """The derivative of :func:`_whole`."""
    n = skies.n_fields
    return block_diag(skies.jacobian(channel, exponent[:n]), np.eye(len(exponent) - n))


def linearised(
    skies: PositiveSkies, channel: int, information: Information, exponent: Vector
) -> Information:
    """Compute a channel's information about its exponent, with the sky linear about a given one.

    Parameters
    ----------
    skies : PositiveSkies
    channel : int
    information : Information
        Of the channel's sky, in K, and the shared unknowns.
    exponent : (modes + shared,) array
        phi_f, and the shared unknowns.

    Returns
    -------
    Information
        Without unit; point sources are integrated out.
    """
    diffuse = diffuse_part(skies, channel, information).without()
    local = diffuse.recentred(_whole(skies, channel, exponent))
    slope = _slope(skies, channel, exponent)
    matrix, vector = symmetric_product(slope.T @ local.matrix, slope), local.vector @ slope
    return replace(local, matrix=matrix, vector=vector, reference=exponent)


@dataclass(frozen=True)
class _Point:
    """All unknowns, exponents of all channels, and chi^2 of their skies."""

    unknowns: Vector
    exponents: Exponents
    chi2: float

    def energy(self, prior: SpectralPrior) -> float:
        """E under a prior."""
        k, n = np.shape(prior.roots)
        fields, shared = self.unknowns[: k * n].reshape(k, n), self.unknowns[k * n :]
        residuals = self.exponents[:, :n] - np.asarray(prior.mixing) @ fields
        roots = np.stack([prior.residual_root(k) for k in range(prior.n_channels)])
        parts = (fields / np.asarray(prior.roots), residuals / roots, shared)
        return self.chi2 + sum(float((part**2).sum()) for part in parts)


def find_joint_mode(
    skies: PositiveSkies,
    laws: FieldLaws,
    channels: Channels,
    shared: Vector | tuple[()] = (),
    *,
    learn: bool = False,
    report: Report = lambda rounds, moved: None,
) -> PositiveMode:
    """Find the most probable skies, starting from the templates.

    Parameters
    ----------
    skies : PositiveSkies
    laws : FieldLaws
        C_ell of the fields, or where to begin to learn them.
    channels : Channels
        Their data.
    shared : (shared,) array, optional
        Start of the shared unknowns, if the channels' information includes them.
    learn : bool
        Learn A and tilt of every field and residual, by maximising the evidence.
    report : callable, optional
        Called with the number of every round, and how far it moved.

    Raises
    ------
    InputError
        If the rounds do not converge, or the data are too precise to solve for.
    """
    start = np.concatenate([np.zeros(len(skies.names) * skies.n_fields), shared])
    exponents = np.tile(np.append(np.zeros(skies.n_fields), shared), (len(skies.levels), 1))
    point = _Point(start, exponents, _chi2(skies, channels, exponents))
    last = np.zeros_like(laws.parameters)
    for rounds in range(MAX_ROUNDS):
        prior = laws.prior(skies)
        posterior, mean, arrays = _linear_round(skies, channels, prior, point, learn)
        energy = point.energy(prior)
        moved = np.sqrt(max(energy - mean.energy(prior), 0.0))
        report(rounds, f"{moved:.2g} sigma")
        change = np.zeros_like(laws.parameters)
        if learn:
            change = laws.matched(*_powers(posterior, prior, arrays)).parameters - laws.parameters
            # a law without influence may oscillate
            change = np.where(change * last < 0, 0.5, 1.0) * change
        if moved < SETTLED and np.abs(change).max() < SETTLED_LAW:
            result = skies, laws, point.exponents, posterior
            return PositiveMode(*result, energy, float(moved), rounds)
        point = _descended(skies, channels, prior, point, mean)
        laws, last = replace(laws, parameters=laws.parameters + change), change
    raise InputError(
        f"the positive skies did not converge in {MAX_ROUNDS} rounds: the last step was "
        f"{moved:.2g} standard deviations; use spectral.model=components"
    )


def _chi2(skies: PositiveSkies, channels: Channels, exponents: Exponents) -> float:
    def chi2(channel: int, information: Information) -> float:
        diffuse = diffuse_part(skies, channel, information).without()
        return float(diffuse.chi2(_whole(skies, channel, exponents[channel])))

    return float(np.sum(channels.each(chi2)))


def _linear_round(
    skies: PositiveSkies, channels: Channels, prior: SpectralPrior, point: _Point, learn: bool
) -> tuple[Posterior, _Point, Arrays]:
    """Posterior of skies that are linear about a point, its mean, and every channel there."""

    def relative(channel: int, information: Information) -> Information:
        return linearised(skies, channel, information, point.exponents[channel])

    posterior = joint.component_posterior(channels.summed(prior, point.exponents, relative), prior)
    mean = np.asarray(posterior.mean)
    spread = joint.paired(posterior.covariance(), prior) if learn else None

    def judged(channel: int, information: Information) -> Arrays:
        """Exponent and chi^2 of a channel at the mean, and its residual's power."""
        information, none = relative(channel, information), np.zeros((0, len(mean)))
        sky = joint.channel_sky(prior, channel, information, mean, None, none, jax.random.key(0))
        found = {"exponent": sky.mean, "chi2": information.chi2(sky.mean)}
        if spread is None:
            return found
        root = prior.residual_root(channel)
        inverse = inverse_from_cholesky(joint.residual_lower(information, root))
        common = joint.common_covariance(prior, channel, spread)
        # variance of the residual given the common part, and of its part that follows it
        pull = (inverse * root[None]) @ information.matrix[: len(root)]
        variance = np.diagonal(inverse) + np.einsum("ij,ij->i", pull @ common, pull)
        white = ((sky.mean - joint.common_of(prior, channel, mean))[: len(root)]) / root
        return {**found, "power": sum_over_m(white**2), "known": sum_over_m(1.0 - variance)}

    parts = channels.each(judged)
    arrays = {name: np.stack([part[name] for part in parts]) for name in parts[0]}
    return posterior, _Point(mean, arrays["exponent"], float(arrays["chi2"].sum())), arrays


def _powers(posterior: Posterior, prior: SpectralPrior, arrays: Arrays) -> tuple[OfLaws, OfLaws]:
    """sum_m u^2 and sum_m (1 - var u) of all fields and residuals."""
    shape = prior.n_components, -1
    variance = np.diagonal(inverse_from_cholesky(np.asarray(posterior.lower))).reshape(shape)
    power = sum_over_m(np.asarray(posterior.white_mean).reshape(shape) ** 2)
    known = sum_over_m(1.0 - variance)
    return np.concatenate([power, arrays["power"]]), np.concatenate([known, arrays["known"]])


def _descended(
    skies: PositiveSkies, channels: Channels, prior: SpectralPrior, point: _Point, end: _Point
) -> _Point:
    """The end of a step, or of a half, a quarter, ... of it, if E is not higher there."""
    part, energy = 1.0, point.energy(prior)
    for _ in range(HALVINGS):
        unknowns = point.unknowns + part * (end.unknowns - point.unknowns)
        exponents = point.exponents + part * (end.exponents - point.exponents)
        trial = _Point(unknowns, exponents, _chi2(skies, channels, exponents))
        # the gain of a short step may be rounding
        if trial.energy(prior) < energy + SETTLED**2:
            return trial
        part /= 2.0
    return point


# draws whose fields are synthesised at once
CHUNK = 32


def positive_sky(
    mode: PositiveMode,
    channel: int,
    information: Information,
    spread: joint.Blocks,
    draws: Float[np.ndarray, "count unknowns"],
    key: PRNGKeyArray,
) -> joint.ChannelSky:
    """Compute the sky of one channel.

    The mean is the sky of the mean exponent, and the covariance C_s = W C W^T, with the exponent's
    C. A draw is the sky s of a drawn exponent less C_s M (s - s_1), with s_1 linear in the
    exponent: what the exponential adds against the data. It is positive where they say little.

    Parameters
    ----------
    mode : PositiveMode
    channel : int
        Number of the channel.
    information : Information
        Of the channel's data, in K.
    spread : tuple of arrays
        Covariance of the fields and the shared unknowns, as packed by :func:`.paired`.
    draws : (n, unknowns) array
        Draws of them.
    key : PRNGKeyArray
        For draws of residuals and fluxes. Give the same key for all channels of a run.

    Returns
    -------
    joint.ChannelSky
        In K, with the shared unknowns.
    """
    skies, exponent = mode.skies, mode.exponents[channel]
    relative = linearised(skies, channel, information, exponent)
    unknowns = np.asarray(mode.posterior.mean)
    joint_sky = joint.channel_sky(mode.prior, channel, relative, unknowns, spread, draws, key)
    beside = diffuse_part(skies, channel, information)
    slope = _slope(skies, channel, exponent)
    of_diffuse = symmetric_product(slope @ joint_sky.covariance, slope.T)
    covariance = beside.whole_covariance(of_diffuse)
    shape = len(draws), len(beside.patterns)
    flux_key = jax.random.fold_in(jax.random.fold_in(key, channel), 1)
    z = np.asarray(jax.random.normal(flux_key, shape, dtype=jnp.float64))
    # for the mean and every draw
    found = np.concatenate([joint_sky.mean[None], joint_sky.draws])
    chunks = [found[first : first + CHUNK] for first in range(0, len(found), CHUNK)]
    diffuse = np.concatenate([_whole(skies, channel, chunk) for chunk in chunks])
    # the exponential adds to the linear sky only what the data leave open
    more = diffuse - diffuse[:1] - (found - found[:1]) @ slope.T
    diffuse -= more @ np.asarray(beside.without().matrix) @ of_diffuse
    whole = beside.whole_skies(diffuse, np.pad(z, ((1, 0), (0, 0))))
    return joint.ChannelSky(whole[0], covariance, whole[1:])


# highest ell of the maps from which laws are learned
COARSE_LMAX = 16


def learn_laws(
    skies: PositiveSkies, channels: Channels, *, lmax_fields: int, report: Report
) -> FieldLaws:
    """Learn C_ell of all fields and residuals by maximising the evidence.

    Parameters
    ----------
    skies : PositiveSkies
    channels : Channels
        Their data.
    lmax_fields : int
        Highest ell of the exponents while laws are learned, at least that of the coarse maps.
    report : callable
        Called with the number of every round, and how far it moved.

    Raises
    ------
    InputError
        As :func:`.find_joint_mode`.
    """
    lmax = min(skies.lmax, COARSE_LMAX)
    coarse, n = skies.coarser(lmax, lmax_fields), n_modes(lmax)

    def large_scales(channel: int, information: Information) -> Information:
        if information.n_modes == n:
            return information
        # small scales have the power of the template and its sources
        template = skies.modes(channel, np.zeros(skies.n_fields))
        power = power_spectrum(template) + power_spectrum(skies.sources[channel]).sum(0)
        return integrated_out(information, n, per_mode(power)[n:])

    parts = ChannelsInMemory(tuple(channels.each(large_scales)))
    return find_joint_mode(coarse, FieldLaws.of(coarse), parts, learn=True, report=report).laws
