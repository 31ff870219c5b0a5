"""The programs of several channels as one, in which shared unknowns are tied.

A site of a channel is called ``CHANNEL/NAME``. In prior standard deviations from its prior mean, a
shared unknown is a Gaussian process z over frequency (:func:`.kernel`). Given z at the frequencies
of earlier channels, a later channel has ::

    z ~ N(k^T K^-1 z, 1 - k^T K^-1 k),

where K is the covariance of the earlier z, and k their covariance with the new one. If that
variance vanishes, as for values common to all channels, the channel has the mean instead of a site.

Skies of a joint posterior are integrated out together (:mod:`.joint_model`): the channels' own
evidences are left out, and one of all data takes their place.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
from numpyro import distributions as dist
from numpyro import infer, primitives

from lusee_bayes.core.arrays import Array
from lusee_bayes.linear.amplitudes import Amplitudes, kernel, tie
from lusee_bayes.linear.joint_model import JointModel
from lusee_bayes.linear.linear_gaussian import LinearGaussian
from lusee_bayes.sampling import hmc, programs
from lusee_bayes.sky.spectral_prior import SpectralPrior
from lusee_bayes.systematics.systematic import Unknown

# variances below this (1e-5 of a standard deviation) are rounding of K
NOTHING_LEFT = 1e-10
# number to fold into the seed for joint draws of skies
OF_SKIES = 2


def site_in(channel: str, name: str) -> str:
    """The name of a channel's site."""
    return f"{channel}/{name}"


def of_channel(chains: hmc.Chains, channel: str) -> hmc.Chains:
    """The draws of one channel, with site names without the channel."""
    start = site_in(channel, "")
    sites = {n.removeprefix(start): v for n, v in chains.sites.items() if n.startswith(start)}
    return hmc.Chains(sites, chains.statistics)


def gaussian_of_sites(
    amplitudes: Mapping[str, Amplitudes],
    unknowns: Sequence[Unknown],
    frequencies_mhz: Mapping[str, float],
    octaves: Mapping[str, float],
    latent: Sequence[str],
) -> hmc.Whitening:
    """Coordinates in which the Gaussian of sites, given the data of all channels, is N(0, 1).

    Parameters
    ----------
    amplitudes : mapping of Amplitudes
        Posterior of each channel's unknowns given its own data.
    unknowns : sequence of Unknown
        The same for every channel.
    frequencies_mhz, octaves : mapping of float
        As for :class:`SharedSites`.
    latent : sequence of str
        The sampled sites; for a single channel, names without the channel.
    """
    mhz = np.array([frequencies_mhz[channel] for channel in amplitudes])
    sizes, untied = [u.size or 1 for u in unknowns], np.eye(len(mhz))
    tying = [kernel(mhz, octaves[u.name]) if u.name in octaves else untied for u in unknowns]
    mean = np.stack([one.mean for one in amplitudes.values()])
    covariance = np.stack([one.covariance for one in amplitudes.values()])
    tied = tie(mean, covariance, np.repeat(tying, sizes, axis=0), np.zeros((0, mean.size)))
    sites, parts = [], []
    for number, channel in enumerate(amplitudes):
        ends = np.cumsum(sizes)
        for unknown, first, end in zip(unknowns, ends - sizes, ends, strict=True):
            name = unknown.name if unknown.name in latent else site_in(channel, unknown.name)
            if name not in latent:
                continue
            transform, z = dist.biject_to(unknown.prior().support), tied.mean[number, first:end]
            to_x, ones = lambda z, u=unknown, t=transform: t.inv(u.at(z)), np.ones(len(z))
            x, slope = jax.jvp(to_x, (jnp.asarray(z),), (jnp.asarray(ones),))
            sites.append((name, () if unknown.size is None else (unknown.size,)))
            parts.append((x, slope[:, None] * tied.root[number, first:end]))
    mean, root = (np.concatenate([np.asarray(part[k]) for part in parts]) for k in (0, 1))
    lower = np.linalg.cholesky(root @ root.T)
    log_det = np.asarray(np.log(np.diagonal(lower)).sum())
    return hmc.Whitening(*map(jnp.asarray, (mean, lower, log_det)), tuple(sites))


@dataclass(frozen=True)
class SharedSites:
    """A NumPyro model of several channels; arguments and data are mappings by channel.

    Attributes
    ----------
    program : callable
        The NumPyro model of a channel.
    frequencies_mhz : dict of float
        By channel.
    octaves : dict of float
        Over which channels share a site, by name (:meth:`.Systematic.octaves`).
    skies : SpectralPrior or None
        Over the skies of all channels, which the program has to integrate out; None if channels
        have independent skies.
    """

    program: Callable
    frequencies_mhz: Mapping[str, float]
    octaves: Mapping[str, float]
    skies: SpectralPrior | None = None

    def __call__(self, channels: Mapping[str, dict], data: Mapping[str, Array]):
        """Sample all channels given their data; return the program's result for each."""
        site_values: dict[str, dict[str, Any]] = {}
        returned = []
        for channel, arguments in channels.items():
            with _Channel(self, channel, site_values):
                returned.append(self.program(**arguments, data=data[channel]))
        if self.skies is not None:
            numpyro.factor("evidence", self.together(returned, data).log_prob())
        return returned

    def together(self, models: Sequence[LinearGaussian], data: Mapping[str, Array]) -> JointModel:
        """Combine the channels' models, as the program returns them."""
        return JointModel.of(models, list(data.values()), self.skies)

    @programs.numpyro_promotion()
    def drawn_skies(
        self, channels: Mapping[str, dict], data: Mapping[str, Array], chains: hmc.Chains, seed: int
    ) -> dict[str, np.ndarray]:
        """Draw every channel's sky given each draw of its sites, (chains, draws, modes), in K."""

        def model():
            joint = self.together(self(channels, data), data)
            numpyro.deterministic("skies", joint.sample(numpyro.prng_key()))

        key = jax.random.fold_in(jax.random.key(seed), OF_SKIES)
        draw = infer.Predictive(model, chains.sites, batch_ndims=2, return_sites=["skies"])
        return dict(zip(channels, np.moveaxis(np.asarray(draw(key)["skies"]), 2, 0), strict=True))


class _Channel(primitives.Messenger):
    """Names a channel's sites, and ties shared ones to earlier channels.

    site_values : by site and channel: values, or z if channels differ; only of sites, not of values
        that follow from other channels
    """

    def __init__(self, shared: SharedSites, channel: str, site_values: dict[str, dict[str, Any]]):
        super().__init__()
        self.shared, self.channel, self.site_values = shared, channel, site_values
        # name and prior of shared unknowns, by site
        self.sites: dict[str, tuple[str, dist.Distribution]] = {}

    def process_message(self, msg: dict[str, Any]) -> None:
        if msg["type"] not in ("sample", "deterministic"):
            return
        name, prior = msg["name"], msg["fn"]
        msg["name"] = site_in(self.channel, name)
        msg["stop"] = name == programs.DATA and self.shared.skies is not None
        if msg["type"] != "sample" or name not in self.shared.octaves:
            return
        octaves, before = self.shared.octaves[name], self.site_values.setdefault(name, {})
        if before and np.isinf(octaves):
            (value,) = before.values()
            msg |= {"type": "deterministic", "value": value}
            return
        self.sites[msg["name"]] = name, prior
        if not before:
            return
        mhz = np.array([self.shared.frequencies_mhz[c] for c in (*before, self.channel)])
        *k, variance = kernel(mhz, octaves)[-1]
        weights = np.linalg.solve(kernel(mhz[:-1], octaves), k)
        variance -= weights @ k
        mean = prior.loc + prior.scale * (weights @ jnp.stack(list(before.values())))
        if variance < NOTHING_LEFT:
            del self.sites[msg["name"]]
            msg |= {"type": "deterministic", "value": mean}
        else:
            msg["fn"] = dist.Normal(mean, prior.scale * np.sqrt(variance))

    def postprocess_message(self, msg: dict[str, Any]) -> None:
        if msg["name"] in self.sites:
            name, prior = self.sites[msg["name"]]
            value = msg["value"]
            if np.isfinite(self.shared.octaves[name]):
                value = (value - prior.loc) / prior.scale
            self.site_values[name][self.channel] = value
