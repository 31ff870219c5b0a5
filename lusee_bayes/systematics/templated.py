"""Unknowns whose part in the data is linear, or taken to first order: columns of N's square root.

N gets T T^T, a column of T for each unknown: what one prior standard deviation of it does to the
data. Where gains multiply what the data are of (:meth:`Templated.behind`), they multiply T, too.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from lusee_bayes.core.arrays import Array
from lusee_bayes.systematics.base import Systematic


class Templated(Systematic):
    """Unknowns with independent Gaussian priors, and a column of N's square root for each.

    Subclasses have the attributes ``names``, ``stds`` (n,), ``templates`` (data, n) and
    ``response`` ((data,) or None).
    """

    @property
    def unit(self) -> str:
        """Unit of all values; empty for numbers, and where their names tell it."""
        return ""

    @property
    def labels(self) -> tuple[str, ...]:
        """The unknowns in words."""
        return self.names

    @property
    def columns(self) -> Float[Array, "data n"]:
        """The columns that are in N: the templates behind the gains, in K."""
        if self.response is None:
            return self.templates
        return self.templates * self.response[:, None]

    @property
    def expected(self) -> Float[Array, " n"]:
        """What :meth:`marginalised` takes the prior mean for, in prior standard deviations."""
        return np.zeros(len(self.names))

    def behind(self, response: Float[Array, " data"]) -> Systematic:
        return replace(self, response=response)

    def in_units(self, z: Float[np.ndarray, " n"]) -> dict[str, float]:
        """Values by name, of numbers in prior standard deviations from the prior mean."""
        return dict(zip(self.names, (np.asarray(self.stds) * z).tolist(), strict=True))

    def true(self, truth: Mapping[str, float | np.ndarray]) -> dict[str, float]:
        """True values by name, of those by site."""
        return {name: float(truth[name]) for name in self.names}


class Expanded(Templated):
    """Unknowns taken to first order about values.

    Subclasses have the attributes ``centre`` (n,), the values in prior standard deviations, and
    ``moves``: whether these are those that the data tell, found in rounds.
    """
