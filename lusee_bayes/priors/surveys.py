"""Surveys of the sky: the template of a prior, and what the data say about them.

A survey s, scaled to the frequency of a channel, and the sky m are related by ::

    s = a (B m) + b + errors,    or    B m = s / a - b / a + e,

where B is the survey's beam. The prior takes the mean of all surveys as its template, with unknown
scale and zero level (:mod:`.local_scales`); e are the deviations from it, whose strength is learned
by position and scale. The weights of the surveys, and of the embedded template, are unknown, too: a
survey that contradicts the visibilities loses its weight.

a and b follow from the map without surveys, N(mu, C), ::

    s ~ N(B mu, B (C + E) B + scale_std^2 s s^T + zero_std^2 (4 pi y_0 y_0^T)),

where E is the covariance of the learned deviations. Where the survey has no data, white noise
brighter than any sky is added.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from lusee_bayes.core import harmonics, sphere_grid
from lusee_bayes.core.arrays import Modes, ModesMatrix
from lusee_bayes.core.lazy import healpy
from lusee_bayes.core.linalg import checked_cholesky, gram_matrix, scaled, solve_lower

# brightness of unseen parts of the sky, over the survey's mean
BRIGHTEST = 10.0
# the beam is taken off where it leaves more than this part of the sky
LEAST_BEAM = 0.2


@dataclass(frozen=True)
class Survey:
    """A survey, scaled to the frequency of a channel.

    Attributes
    ----------
    name : str
    modes : (modes,) array
        s, Galactic, in K; any values where it has no data.
    beam : (modes,) array
        B, a diagonal.
    scale_std, zero_std : float
        Prior standard deviations of a, and of b in K.
    unseen : (pixels,) array of bool or None
        HEALPix RING: where it has no data.
    """

    name: str
    modes: Modes
    beam: Modes
    scale_std: float
    zero_std: float
    unseen: Bool[np.ndarray, " pixels"] | None = None

    def sharpened(self, template: Modes) -> Modes:
        """s without its beam; what the beam removes is that of a template of the same mean."""
        seen = self.beam > LEAST_BEAM
        scaled_template = template * (self.modes[0] / template[0])
        return np.where(seen, self.modes / np.where(seen, self.beam, 1.0), scaled_template)

    @property
    def shapes(self) -> Float[np.ndarray, "2 modes"]:
        """Changes of s with a and b, each times its prior standard deviation, in K."""
        zero = np.zeros_like(self.modes)
        zero[0] = np.sqrt(4.0 * np.pi) * self.zero_std
        return np.stack([self.scale_std * self.modes, zero])

    def calibrated(
        self, mean: Modes, covariance: ModesMatrix, errors: ModesMatrix
    ) -> list[dict[str, float | str]]:
        """Infer a and b.

        Parameters
        ----------
        mean, covariance : (modes,) and (modes, modes) array
            Of the sky, from other data, in K and K^2.
        errors : (modes, modes) array
            E, in K^2.

        Returns
        -------
        list of dict
            Name, value and standard deviation of a, and of b in K.
        """
        off = self.modes - self.beam * mean
        whole = scaled(covariance + errors, self.beam, overwrite=True) + gram_matrix(self.shapes)
        if self.unseen is not None:
            whole += self._blind()
        # on scales that the beam removes, white errors would be all there is
        n = int((self.beam > LEAST_BEAM).sum())
        root = checked_cholesky("the covariance of a survey", whole[:n, :n])
        half = solve_lower(root, np.stack([off, *self.shapes]).T[:n], transpose=False)
        # unknowns 1 / a - 1 and -b / a
        widths = np.array([self.scale_std, self.zero_std])
        shift = -widths * (half[:, 1:].T @ half[:, 0])
        covariance = scaled(np.eye(2) - gram_matrix(half[:, 1:]), widths)
        scale = 1.0 / (1.0 + shift[0])
        # a and b by these unknowns
        slopes = np.array([[-(scale**2), 0.0], [shift[1] * scale**2, -scale]])
        std = np.sqrt(np.diagonal(slopes @ covariance @ slopes.T))
        values = {"scale": scale, "zero level (K at the map's frequency)": -shift[1] * scale}
        return [
            {"name": f"{name} of {self.name}", "value": float(value), "std": float(width)}
            for (name, value), width in zip(values.items(), std, strict=True)
        ]

    def _blind(self) -> ModesMatrix:
        top = harmonics.lmax_of(len(self.modes))
        grid = sphere_grid.SphereGrid.of(top, 2 * top)
        near, _ = healpy.get_interp_weights(healpy.npix2nside(len(self.unseen)), *grid.directions())
        blind = self.unseen[near].any(axis=0).reshape(grid.shape)
        return grid.product_matrix(BRIGHTEST**2 * self.modes[0] ** 2 * blind)
