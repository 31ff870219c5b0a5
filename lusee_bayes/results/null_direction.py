"""What data cannot tell of unknowns that look alike.

A uniform sky, warmer ground and noisier receivers look much alike. Of their joint posterior, each
in units of its prior's standard deviation, the *null direction* is the one with the largest
variance, which is 1 where the data say nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

# a null direction is worth a sentence where it keeps more than that of the prior's variance, and a
# part of it a word where its weight is that large
WORTH, PART = 0.5, 0.2


@dataclass(frozen=True)
class NullDirection:
    """The combination of the sky's monopole and unknowns that the data tell least of.

    Attributes
    ----------
    names : tuple of str
        Of its parts.
    weights : (parts,) array
        A unit vector, in prior standard deviations of each; the largest is positive.
    share : float
        Its posterior variance over its prior variance.
    """

    names: tuple[str, ...]
    weights: Float[np.ndarray, " parts"]
    share: float

    @classmethod
    def of(
        cls, names: Sequence[str], covariance: Float[np.ndarray, "parts parts"]
    ) -> NullDirection:
        """Find it in a posterior covariance.

        Parameters
        ----------
        names : sequence of str
            Of the parts.
        covariance : (parts, parts) array
            In prior standard deviations of each; the prior is the unit matrix.
        """
        variances, directions = np.linalg.eigh(covariance)
        weights = directions[:, -1]
        weights = weights * np.sign(weights[np.argmax(np.abs(weights))])
        return cls(tuple(names), weights, float(variances[-1]))

    def words(self) -> str:
        """Its larger parts with their weights, the largest first."""
        order = np.argsort(-np.abs(self.weights))
        large = [k for k in order if abs(self.weights[k]) >= PART]
        return ", ".join(f"{self.names[k]} {self.weights[k]:+.2f}" for k in large)

    def sentence(self) -> str:
        """What the data cannot tell; empty where they tell most of it."""
        if self.share <= WORTH:
            return ""
        return (
            f"These data hardly tell one combination of what looks alike ({self.words()}, in prior "
            f"standard deviations): it keeps {self.share:.0%} of its prior variance."
        )
