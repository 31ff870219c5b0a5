"""What a scenario says of one systematic: its treatment, and what simulated data hold of it."""

from __future__ import annotations

import zlib
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from operator import attrgetter
from typing import Any, ClassVar

import jax
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from lusee_bayes.core.arrays import Array
from lusee_bayes.experiment.scenario import Scenario
from lusee_bayes.experiment.setup import Setup
from lusee_bayes.instrument.visibilities import Visibilities
from lusee_bayes.systematics import AdditiveNoise, Systematic

# true values of what simulated data hold, by the names of their sites
Truth = dict[str, float | np.ndarray]


@dataclass(frozen=True)
class Around:
    """What a systematic may be built around, besides the setup.

    Attributes
    ----------
    data : Visibilities or None
        The measured data; None before there are any.
    visibilities : (products, times) array or None
        Visibilities for the gain term, in K; None for those that the scenario names.
    sky : (modes,) array or None
        For the templates of clock and pointing, in K; None for the scenario's.
    values : mapping of float or None
        Of unknowns that are taken to first order about values, clock and pointing or errors of
        the gain table, by name; None for their prior means.
    seen : (data,) array or None
        Visibilities before the gains of the gain table, in K; None for the measured ones.
    freedom : (data,) array or None
        Share of each datum that sky and others follow, for the gain table; None for none.
    """

    data: Visibilities | None = None
    visibilities: Float[Array, "products times"] | None = None
    sky: Float[Array, " modes"] | None = None
    values: Mapping[str, float] | None = None
    seen: Float[Array, " data"] | None = None
    freedom: Float[Array, " data"] | None = None


class Term(ABC):
    """One systematic of a scenario.

    Attributes
    ----------
    key : str
        Where a scenario says it, such as ``noise.gain``.
    remedy : str
        What may help where it :meth:`moves` and rounds do not settle.
    """

    key: ClassVar[str]
    remedy: ClassVar[str] = ""

    @abstractmethod
    def build(self, setup: Setup, around: Around) -> list[tuple[str, Systematic]]:
        """Treatment and systematic, for all that the scenario has of it and does not ignore."""

    def moves(self, scenario: Scenario) -> bool:
        """Tell whether it is to first order about values that the data tell, found in rounds."""
        return False

    def truth(self, setup: Setup, key: PRNGKeyArray) -> Truth:
        """True values in simulated data, drawn from their priors.

        Parameters
        ----------
        setup : Setup
        key : PRNG key
            Of the scenario's seed; each term folds it with a number of its own.
        """
        return {}

    def distort(
        self,
        visibilities: Float[Array, "products times"],
        setup: Setup,
        truth: Truth,
        key: PRNGKeyArray,
    ) -> Float[Array, "products times"]:
        """The visibilities in K that the true values make of those without them."""
        return visibilities


class AdditiveTerm(Term):
    """A noise term with a covariance of its own: it is built, drawn and added as all of them are.

    Parameters
    ----------
    key : str
        Path of its section in the scenario, an entry of which has to be ``treatment``.
    make : callable
        ``make(setup, section)``: the :class:`AdditiveNoise`.
    """

    def __init__(self, key: str, make: Callable[[Setup, Any], AdditiveNoise]):
        self.key = key
        self._make = make

    def build(self, setup: Setup, around: Around) -> list[tuple[str, Systematic]]:
        section = attrgetter(self.key)(setup.scenario)
        if section is None or section.treatment == "ignored":
            return []
        return [(section.treatment, self._make(setup, section))]

    def distort(
        self,
        visibilities: Float[Array, "products times"],
        setup: Setup,
        truth: Truth,
        key: PRNGKeyArray,
    ) -> Float[Array, "products times"]:
        section = attrgetter(self.key)(setup.scenario)
        if section is None:
            return visibilities
        own = jax.random.fold_in(key, zlib.crc32(self.key.encode()))
        return self._make(setup, section).distort(visibilities, own)
