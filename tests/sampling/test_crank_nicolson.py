"""Turns of white coordinates, whose density has another shape, against sums over the unknown."""

import jax.numpy as jnp
import numpy as np
import numpyro
import pytest
from assertions import refuse
from numpyro import distributions as dist
from reference_linear import assert_draws_follow, posterior
from scipy.stats import norm
from small_models import Case, assert_mean, per_mode

import lusee_bayes as lb
from lusee_bayes.linear.linear_gaussian import InData
from lusee_bayes.noise.covariance import KnownFactor

CASE = Case.drawn(np.array([4.0, 1.0, 0.5]), 12, 5, noise=2.0)


def with_gain(coupling, prior, noise, data=None):
    """The sky integrated out: d = g A m + n, with a gain g that is not known."""
    gain = numpyro.sample("gain", dist.Normal(1.0, 0.4))
    gaussian = lb.LinearGaussian(gain * coupling, prior, noise)
    numpyro.sample("data", lb.Marginal(gaussian), obs=data)
    return gaussian


def drawn(white):
    arguments = {name: value for name, value in CASE.arguments().items() if name != "offset"}
    sampler = lb.Sampler(draws=3000, algorithm="crank-nicolson", seed=3)
    return lb.sample(with_gain, {**arguments, "data": jnp.asarray(CASE.data)}, sampler, white)


@pytest.mark.parametrize(("off", "width"), [(0.5, 1.3), (0.0, 6.0)])
def test_turns_find_gain_and_sky(off, width):
    """In coordinates that are shifted, or so wide that turns have to be short."""
    gains, s = np.linspace(0.01, 3.0, 600), np.diag(per_mode(CASE.base))
    found = [posterior(g * CASE.a, s, CASE.n, CASE.data) for g in gains]
    evidence = np.array([one.log_prob for one in found])
    weights = norm(1.0, 0.4).pdf(gains) * np.exp(evidence - evidence.max())
    weights /= weights.sum()
    mean = weights @ gains
    std = np.sqrt(weights @ (gains - mean) ** 2)
    skies = weights @ np.array([one.mean for one in found])
    squares = weights @ np.array([one.std**2 + one.mean**2 for one in found])
    place, root = jnp.array([mean + off * std]), jnp.array([[width * std]])
    chains = drawn(lb.Whitening(place, root, jnp.log(root[0, 0]), (("gain", ()),)))
    gain, sky = chains.sites["gain"], chains.sites["sky"]
    assert_mean(np.stack([gain, (gain - mean) ** 2], -1), [mean, std**2], "the gain")
    assert_mean(np.concatenate([sky, sky**2], -1), np.concatenate([skies, squares]), "the sky")
    accepted, turn = (chains.statistics[name] for name in ("acceptance_rate", "step_size"))
    assert 0.5 < accepted.mean() < 0.95 and not chains.statistics["diverging"].any()
    assert (turn < 1.0).all() == (width > 2.0)


def test_every_turn_is_taken_where_the_coordinates_are_the_posteriors():
    """All chains at once, as programs run that predict the data; quarter turns forget."""
    program, arguments = lb.load_program("sky"), CASE.arguments()
    noise = KnownFactor(arguments["noise"], arguments.pop("noise").factor())
    arguments |= {"fixed_noise": noise, "data": jnp.asarray(CASE.data)}
    model = lb.LinearGaussian(arguments["coupling"], arguments["prior"], noise)
    known = model.condition(arguments["data"], InData).posterior
    sampler = lb.Sampler(draws=500, warmup=20, algorithm="crank-nicolson", seed=1)
    chains = lb.sample(program.model, arguments, sampler, lb.Whitening.of(known))
    assert (chains.statistics["acceptance_rate"] > 1.0 - 1e-9).all()
    assert_draws_follow(chains.sites["sky"].reshape(-1, 9), known.mean, known.covariance())


def test_turns_need_white_coordinates():
    refuse("found no coordinates.*use nuts", drawn, None)
