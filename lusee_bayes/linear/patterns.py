"""Patterns of unknown strength beside a sky, such as point sources: integrated out and put back.

::

    m = d + sum_j (1 + g_j) t_j,    g_j ~ N(0, 1)

With T the patterns as rows and K = 1 + T M T^T = L L^T, the information about d is that about m at
d + sum_j t_j with ::

    M' = M - M T^T K^-1 T M,    v' = v - M T^T K^-1 T v,

and given d, g ~ N(K^-1 T v(d + sum_j t_j), K^-1).
"""

from __future__ import annotations

from dataclasses import replace

import equinox as eqx
import numpy as np
from jaxtyping import Float

from lusee_bayes.core.checks import require_shape
from lusee_bayes.core.linalg import checked_cholesky, solve_lower
from lusee_bayes.linear.information import Information


class Patterns(eqx.Module):
    """Patterns beside a sky, as far as data know them.

    Attributes
    ----------
    patterns : (patterns, modes) array
        T: each as strong as expected, and as it is uncertain; in K.
    information : Information
        Of the whole sky m.
    lower : (patterns, patterns) array
        L.
    """

    patterns: Float[np.ndarray, "patterns modes"]
    information: Information
    lower: Float[np.ndarray, "patterns patterns"]

    @classmethod
    def of(
        cls, patterns: Float[np.ndarray, "patterns modes"], information: Information
    ) -> Patterns:
        """Make it of patterns and of what data say of the whole sky.

        Raises
        ------
        InputError
            If they have other numbers of modes.
        """
        require_shape("the patterns", patterns, (None, information.n_modes))
        lower = np.eye(len(patterns))
        if len(patterns):
            seen = patterns @ information.matrix @ patterns.T
            lower = checked_cholesky("the patterns' precision", seen + lower)
        return cls(patterns, information, lower)

    @property
    def expected(self) -> Float[np.ndarray, " modes"]:
        """sum_j t_j, in K."""
        return self.patterns.sum(0)

    def without(self) -> Information:
        """Integrate the patterns out: what the data say of d."""
        whole = self.information
        if not len(self.patterns):
            return whole
        across = solve_lower(self.lower, self.patterns @ whole.matrix, transpose=False)
        pull = solve_lower(self.lower, (self.patterns @ whole.vector)[:, None], transpose=False)
        return replace(
            whole,
            matrix=whole.matrix - across.T @ across,
            vector=whole.vector - across.T @ pull[:, 0],
            reference=whole.reference - self.expected,
            misfit=np.asarray(whole.misfit - (pull**2).sum()),
            log_det=np.asarray(whole.log_det + 2.0 * np.log(np.diagonal(self.lower)).sum()),
        )

    def whole_sky(self, diffuse: Float[np.ndarray, " modes"]) -> Float[np.ndarray, " modes"]:
        """Compute the mean of m given d, in K.

        Parameters
        ----------
        diffuse : (modes,) array
            d, in K.
        """
        return self.whole_skies(diffuse[None], np.zeros((1, len(self.patterns))))[0]

    def whole_skies(
        self,
        diffuse: Float[np.ndarray, "skies modes"],
        z: Float[np.ndarray, "skies patterns"],
    ) -> Float[np.ndarray, "skies modes"]:
        """Compute draws of m given draws of d, in K.

        Parameters
        ----------
        diffuse : (skies, modes) array
            d, in K.
        z : (skies, patterns) array
            Draws of independent unit normals; zero for the mean.
        """
        there = diffuse + self.expected
        if not len(self.patterns):
            return there
        pull = self.information.vector - (there - self.information.reference) @ (
            self.information.matrix
        )
        half = solve_lower(self.lower, self.patterns @ pull.T, transpose=False) + z.T
        return there + solve_lower(self.lower, half, transpose=True).T @ self.patterns

    def whole_covariance(
        self, covariance: Float[np.ndarray, "modes modes"]
    ) -> Float[np.ndarray, "modes modes"]:
        """Compute the covariance of m from that of d, in K^2.

        Parameters
        ----------
        covariance : (modes, modes) array
            Of d, in K^2.
        """
        if not len(self.patterns):
            return covariance
        white = solve_lower(self.lower, self.patterns, transpose=False)
        # m = d - back (d - mean) + white^T z
        back = white.T @ (white @ self.information.matrix)
        left = covariance - back @ covariance
        return left - left @ back.T + white.T @ white
