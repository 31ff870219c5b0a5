"""The sites of a NumPyro program: which are sampled, which observed, which predict."""

from __future__ import annotations

from collections.abc import Callable

import equinox as eqx
import jax
from numpyro import handlers

from lusee_bayes.sampling.distributions import Prediction
from lusee_bayes.sampling.promotion import numpyro_promotion


def predicts(program: Callable, arguments: dict, kind: type[Prediction] = Prediction) -> bool:
    """Tell whether a program has a site CorrelatedNormal or TimesStudentT, or of one ``kind``.

    It then samples everything that they depend on, and its density needs matrix products only.
    """
    return any(isinstance(site["fn"], kind) for site in _sites(program, arguments))


def latent_sites(program: Callable, arguments: dict) -> list[str]:
    """Return the names of the sites that a program samples and does not observe."""
    return site_names(program, arguments)[0]


def site_names(program: Callable, arguments: dict) -> tuple[list[str], list[str]]:
    """Return the names of a program's latent and of its observed sites."""
    latent, observed = [], []
    for site in _sites(program, arguments):
        (observed if site["is_observed"] else latent).append(site["name"])
    return latent, observed


def _sites(program: Callable, arguments: dict) -> list[dict]:
    """The sample sites of a program, without running it."""
    found = []

    def run(dynamic):
        trace = handlers.trace(handlers.seed(program, 0)).get_trace(**eqx.combine(dynamic, static))
        found.extend(site for site in trace.values() if site["type"] == "sample")

    dynamic, static = eqx.partition(arguments, eqx.is_array)
    with numpyro_promotion():
        jax.eval_shape(run, dynamic)
    return found
