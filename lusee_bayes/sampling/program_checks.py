"""What a program must be, checked before anything is sampled."""

from __future__ import annotations

import re
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Float
from numpyro import handlers
from numpyro.infer.util import log_density

from lusee_bayes.core.arrays import Array
from lusee_bayes.core.errors import InputError
from lusee_bayes.linear.linear_gaussian import LinearGaussian
from lusee_bayes.sampling.datatree import DATA
from lusee_bayes.sampling.hmc import WHITE_SUFFIX
from lusee_bayes.sampling.programs import Program, numpyro_promotion, traced
from lusee_bayes.systematics.systematic import SKY

# names that samples.nc uses for something else
TAKEN = ("chain", "draw", "mode", "datum", "ell", "m", "product", "time")
# what netCDF, summaries and tables can name without quotes
NAME = re.compile(r"[^\W\d][\w.\-]*")


def require_sampleable(
    program: Program, arguments: dict[str, Any], data: Float[Array, " data"], n_modes: int
) -> list[str]:
    """Check that a program can be sampled, and that draws of the sky come of it.

    The program is traced, not run: no density is computed.

    Parameters
    ----------
    program : Program
    arguments : dict
        What it asks for, without the data.
    data : (data,) array
        d, in K.
    n_modes : int
        Harmonic coefficients of the sky.

    Returns
    -------
    list of str
        The sites that it samples.

    Raises
    ------
    InputError
        If it fails when it is called, with or without data; if one of its sites cannot be sampled
        or kept; if ``data`` is not what it observes; or if it neither samples or computes the sky
        nor returns a LinearGaussian to draw it from.
    """
    who = f"the program '{program.path or program.name}'"
    sites, collapsed = _traced(program, arguments, data, who)
    for site in sites.values():
        _require_site(site, who)
    observed = [name for name, site in sites.items() if site.get("is_observed")]
    latent = [name for name, site in sites.items() if _is_sampled(site)]
    if DATA not in observed:
        raise InputError(f"{who} has no observed site 'data'; sample('data', ..., obs=data)")
    _require_shape(sites[DATA], data.shape, f"{who} observes")
    if not latent:
        raise InputError(f"{who} samples nothing: it has no site that is not observed")
    if SKY in latent:
        _require_shape(sites[SKY], (n_modes,), f"{who} samples")
    elif SKY in sites and sites[SKY]["type"] == "deterministic":
        found = jnp.shape(sites[SKY]["value"])
        if found != (n_modes,):
            raise InputError(f"{who} computes 'sky' with shape {found}; expected {(n_modes,)}")
    elif not collapsed:
        raise InputError(
            f"{who} has no site 'sky', and returns no LinearGaussian to draw the sky from; do one "
            "or the other"
        )
    predicted, _ = _traced(program, arguments, None, who)
    drawn = {name for name, site in predicted.items() if _is_sampled(site)}
    if DATA not in drawn:
        raise InputError(
            f"{who} draws no data where data=None; sample('data', ..., obs=data) in both cases"
        )
    if differing := drawn ^ {*latent, DATA}:
        raise InputError(
            f"{who} samples '{min(differing)}' only with data, or only without; sample the same "
            "sites in both cases"
        )
    _require_density(program, {**arguments, DATA: data}, latent, who)
    return latent


@contextmanager
def _blaming(who: str, doing: str) -> Iterator[None]:
    """Whatever a user's program may raise: it is not our failure, and it is said in a sentence."""
    try:
        yield
    except InputError:
        raise
    except (Exception, SystemExit) as error:
        frames = traceback.extract_tb(error.__traceback__)
        own = [frame.lineno for frame in frames if f"'{frame.filename}'" in who]
        at = f" (line {own[-1]})" if own else ""
        text = " ".join(str(error).split())
        text = text if len(text) <= 300 else f"{text[:297]}..."
        kind = type(error).__name__
        raise InputError(f"{who} fails {doing}{at}: {kind}: {text}") from error


def _traced(
    program: Program, arguments: dict[str, Any], data: Array | None, who: str
) -> tuple[dict[str, dict[str, Any]], bool]:
    """The sample and deterministic sites of a program, by name; whether it returns a model."""
    how = "when it is called" if data is not None else "when it is called with data=None"
    with _blaming(who, how):
        sites, returned = traced(program.model, {**arguments, DATA: data})
    kept = {n: s for n, s in sites.items() if s["type"] in ("sample", "deterministic")}
    return kept, isinstance(returned, LinearGaussian)


def _is_sampled(site: dict[str, Any]) -> bool:
    return site.get("type") == "sample" and not site["is_observed"]


def _require_site(site: dict[str, Any], who: str) -> None:
    name = site["name"]
    if not NAME.fullmatch(name):
        raise InputError(
            f"{who} has a site '{name}'; names are letters, digits, '_', '.' and '-', and begin "
            "with a letter or '_'"
        )
    if name in TAKEN or name.endswith(WHITE_SUFFIX):
        raise InputError(f"{who} has a site '{name}', a name that is taken; give it another")
    if _is_sampled(site):
        if site["fn"].support.is_discrete:
            raise InputError(
                f"{who} has the discrete site '{name}'; Hamiltonian Monte Carlo needs continuous "
                "ones: sum it out, or put a continuous distribution in its place"
            )
        if jnp.issubdtype(jnp.result_type(site["value"]), jnp.complexfloating):
            raise InputError(f"{who} has the complex site '{name}'; sample its two parts")


def _require_shape(site: dict[str, Any], shape: tuple[int, ...], what: str) -> None:
    of_density = tuple(site["fn"].shape())
    for found in (tuple(jnp.shape(site["value"])), of_density):
        if found != shape:
            raise InputError(f"{what} '{site['name']}' with shape {found}; expected {shape}")


def _require_density(
    program: Program, arguments: dict[str, Any], latent: list[str], who: str
) -> None:
    """InputError if the density has no gradient, or is not real."""

    def density(dynamic):
        together = eqx.combine(dynamic, static)
        drawn = handlers.trace(handlers.seed(program.model, 0)).get_trace(**together)
        values = {name: drawn[name]["value"] for name in latent}

        def of(values):
            return log_density(program.model, (), together, values)[0]

        return jax.value_and_grad(of)(values)

    dynamic, static = eqx.partition(arguments, eqx.is_array)
    with _blaming(who, "when its density is differentiated"), numpyro_promotion():
        jax.eval_shape(density, dynamic)
