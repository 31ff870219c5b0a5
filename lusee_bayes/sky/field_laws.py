"""C_ell of the fields in the logarithm of skies: a power law in ell for each.

::

    C_ell = A^2 ((ell + 1) / 10)^tilt

of every field and of every channel's residual; the mean of a field over the sky has a width of its
own. A and tilt may be learned: their logarithm and themselves are normal around what is expected.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from lusee_bayes.sky.positive_skies import PositiveSkies
from lusee_bayes.sky.prior_family import PIVOT
from lusee_bayes.sky.spectral_prior import SpectralPrior

# A of each field, whose rms over the sky is seven times that, and the width of its mean: a template
# good to a fifth (its mean to a half), indices that differ by 0.06, optical depths by a fifth
EXPECTED = {
    "level": (0.03, 0.5),
    "index": (0.01, 0.2),
    "curvature": (0.005, 0.1),
    "absorption": (0.03, 0.5),
}
RESIDUAL, TILT = 0.003, -2.4
# how far ln A and the tilt may be from that
LOG_WIDTH, TILT_WIDTH = 1.5, 0.5


@dataclass(frozen=True)
class FieldLaws:
    """C_ell of all fields and residuals.

    Attributes
    ----------
    parameters : (fields + channels, 2) array
        ln A and tilt, of the fields first.
    means : (fields,) array
        Standard deviation of each field's mean over the sky.
    expected : (fields + channels, 2) array
        What is expected of the parameters before there are data.
    """

    parameters: Float[np.ndarray, "laws 2"]
    means: Float[np.ndarray, " fields"]
    expected: Float[np.ndarray, "laws 2"]

    @classmethod
    def of(cls, skies: PositiveSkies) -> FieldLaws:
        """Those that are expected of skies before there are data."""
        amplitudes, means = np.array([EXPECTED[name] for name in skies.names]).T
        levels = np.concatenate([amplitudes, np.full(len(skies.levels), RESIDUAL)])
        parameters = np.column_stack([np.log(levels), np.full(len(levels), TILT)])
        return cls(parameters, means, parameters)

    def with_parameters(self, parameters: Float[np.ndarray, "laws 2"]) -> FieldLaws:
        """The same with other parameters."""
        return replace(self, parameters=parameters)

    def log_density(self) -> float:
        """ln p of the parameters, but for a constant."""
        away = (self.parameters - self.expected) / [LOG_WIDTH, TILT_WIDTH]
        return -0.5 * float((away**2).sum())

    def prior(self, skies: PositiveSkies) -> SpectralPrior:
        """The prior of the fields: a spectral prior whose maps have no unit."""
        lmax = skies.grid.lmax
        spectra = np.exp(2.0 * self.parameters @ slopes(lmax))
        fields = len(self.means)
        spectra[:fields, 0] = 4.0 * np.pi * self.means**2
        return SpectralPrior(
            skies.frequencies_mhz,
            skies.mixing,
            spectra[:fields],
            spectra[fields:],
            skies.names,
        )

    def matched(
        self,
        found: Float[np.ndarray, "laws ells"],
        known: Float[np.ndarray, "laws ells"],
    ) -> FieldLaws:
        """Compute the parameters under which the fields have as much power as they should.

        At the maximum of the evidence sum_m u^2 = sum_m (1 - var u) in units of the prior, for
        all that a parameter changes (MacKay 1992, Neural Comp. 4, 415).

        Parameters
        ----------
        found : (fields + channels, ells) array
            sum_m u^2, u being the posterior mean in units of the prior.
        known : (fields + channels, ells) array
            sum_m (1 - var u).
        """
        slope = slopes(found.shape[1] - 1)
        narrow = np.array([LOG_WIDTH, TILT_WIDTH]) ** -2.0
        parameters = np.empty_like(self.parameters)
        for k, (power, left) in enumerate(zip(found, known, strict=True)):
            # the mean over the sky has a width that is given
            ells = slice(1 if k < len(self.means) else 0, None)
            step, s = np.zeros(2), slope[:, ells]
            away = self.parameters[k] - self.expected[k]
            for _ in range(NEWTON):
                scaled = power[ells] * np.exp(-2.0 * (step @ s))
                gradient = s @ (scaled - left[ells]) - narrow * (away + step)
                curvature = 2.0 * (s * np.maximum(scaled, left[ells])) @ s.T + np.diag(narrow)
                step = step + np.linalg.solve(curvature, gradient)
            parameters[k] = self.parameters[k] + np.clip(step, -REACH, REACH)
        return self.with_parameters(parameters)


# steps of Newton's method, of which each closes in on the root; longest change of a parameter
NEWTON, REACH = 30, 2.0


def slopes(lmax: int) -> Float[np.ndarray, "2 ells"]:
    """Return d ln C_ell^(1/2) by ln A and by the tilt."""
    ell = np.arange(lmax + 1.0)
    return np.stack([np.ones(lmax + 1), 0.5 * np.log((ell + 1.0) / PIVOT)])
