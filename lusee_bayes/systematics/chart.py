"""Coordinates of several sites in which a posterior's ridges are straight."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping

import equinox as eqx
from jaxtyping import Float

from lusee_bayes.core.arrays import Array


class Chart(eqx.Module):
    """One-to-one coordinates of several sites in which a posterior's ridges are straight.

    Values are unconstrained (numpyro's ``biject_to``). Sites that are not among :attr:`names` are
    handed on as they are.
    """

    @property
    @abstractmethod
    def names(self) -> tuple[str, ...]:
        """The sites whose coordinates it changes or needs."""

    @property
    def factorises(self) -> bool:
        """Whether it factorises matrices at every evaluation."""
        return False

    @abstractmethod
    def to_values(
        self, x: Mapping[str, Float[Array, "..."]]
    ) -> tuple[dict[str, Float[Array, "..."]], Float[Array, ""]]:
        """Compute the sites' values.

        Parameters
        ----------
        x : mapping of array
            Coordinates by site.

        Returns
        -------
        values : dict of array
            Unconstrained values by site.
        log_det : () array
            ln|det| of their derivative by x.
        """

    @abstractmethod
    def from_values(
        self, values: Mapping[str, Float[Array, "..."]]
    ) -> dict[str, Float[Array, "..."]]:
        """Compute the coordinates of unconstrained values by site."""
