"""Point sources beside the map."""

from __future__ import annotations

import jax
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from lusee_bayes.core.arrays import Array
from lusee_bayes.core.errors import InputError
from lusee_bayes.experiment.setup import Setup, block_of_times, mean_flux, source_responses
from lusee_bayes.experiment.terms.beam_error import true_instrument
from lusee_bayes.experiment.terms.term import Around, Term, Truth
from lusee_bayes.systematics import PointSources, Source, Systematic

# what the scenario's seed is folded with
DRAW = 5


class SourcesTerm(Term):
    """``sources``; simulated data hold drawn fluxes, seen by the true antennas."""

    key = "sources"

    def build(self, setup: Setup, around: Around) -> list[tuple[str, Systematic]]:
        treatment = setup.scenario.sources.treatment
        if not setup.responses or treatment == "ignored":
            return []
        return [(treatment, point_sources(setup))]

    def truth(self, setup: Setup, key: PRNGKeyArray) -> Truth:
        if not setup.responses:
            return {}
        sources = point_sources(setup).sources
        keys = jax.random.split(jax.random.fold_in(key, DRAW), len(sources))
        truth: Truth = {}
        for source, k in zip(sources, keys, strict=True):
            z = np.asarray(jax.random.normal(k, (source.n_blocks,), dtype=np.float64))
            flux = float(source.mean) + float(source.std) * z
            truth[source.site] = float(flux[0]) if source.n_blocks == 1 else flux
        return truth

    def distort(
        self,
        visibilities: Float[Array, "products times"],
        setup: Setup,
        truth: Truth,
        key: PRNGKeyArray,
    ) -> Float[Array, "products times"]:
        sections = setup.scenario.sources.list
        if not sections:
            return visibilities
        true = true_instrument(setup)
        responses = source_responses(
            setup.scenario, setup.observation, true.source.monopoles, true.frequency_mhz
        )
        for section, response in zip(sections, responses, strict=True):
            flux = np.atleast_1d(truth[f"flux_{section.name.replace(' ', '_')}"])
            block = block_of_times(section, setup.observation)
            visibilities = visibilities + np.asarray(flux)[block][None] * response
        return visibilities


def point_sources(setup: Setup) -> PointSources:
    """The point sources beside the map. InputError if the scenario has none."""
    if not setup.responses:
        raise InputError("the scenario has no sources.list that could be fitted")
    sources = []
    for section, response in zip(setup.scenario.sources.list, setup.responses, strict=True):
        flux = mean_flux(section, setup.scenario.frequency_mhz)
        block = block_of_times(section, setup.observation)
        columns = [
            setup.layout.gather(np.where((block == b)[None], response, 0.0))
            for b in range(block.max() + 1)
        ]
        sources.append(
            Source(np.stack(columns, axis=1), flux, section.relative_std * flux, section.name)
        )
    return PointSources(tuple(sources))
