"""Visibilities in all channels of the spectrometer, through those that are known.

Logarithms of autos are cubic splines of the logarithm of the frequency. So are the entries of the
Cholesky factors of the matrices of correlation coefficients, the diagonal by its logarithm: then
what lies between is a matrix of correlations, too. Beyond the known frequencies autos go on as
power laws, and correlations become constant; a single known frequency makes power laws of index
-2.5.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.interpolate import CubicSpline

from lusee_bayes.core.checks import require_positive
from lusee_bayes.core.errors import InputError
from lusee_bayes.instrument.products import all_products, auto_indices, to_matrix, to_real

INDEX = -2.5
# below this share of the lowest known frequency spectra are held: what would rise further there
# would be rounded coarsely elsewhere
HELD_BELOW = 0.5
# beyond the known frequencies splines go on for this much of the logarithm, longer than a band, and
# are then held; the larger the power, the less bends before
BEYOND, POWER = 0.2, 8
AUTOS = auto_indices()
FIRST = np.array([p.i for p in all_products()])
SECOND = np.array([p.j for p in all_products()])


@dataclass(frozen=True, eq=False)
class ChannelSpectra:
    """Interpolates visibilities in frequency.

    Attributes
    ----------
    autos : (channels, nodes) array
        Takes logarithms of autos.
    offset : (channels,) array
        Added to what that makes.
    correlations : (channels, nodes) array
        Takes factors of correlations.
    """

    autos: Float[np.ndarray, "channels nodes"]
    offset: Float[np.ndarray, " channels"]
    correlations: Float[np.ndarray, "channels nodes"]

    @classmethod
    def of(
        cls, nodes_mhz: Float[np.ndarray, " nodes"], channels_mhz: Float[np.ndarray, " channels"]
    ) -> ChannelSpectra:
        """Prepare the interpolation.

        Parameters
        ----------
        nodes_mhz : (nodes,) array
            Known frequencies, growing.
        channels_mhz : (channels,) array
        """
        nodes = np.log(nodes_mhz)
        at = np.log(np.maximum(channels_mhz, HELD_BELOW * nodes_mhz[0]))
        if len(nodes) == 1:
            ones = np.ones((len(at), 1))
            return cls(ones, INDEX * (at - nodes[0]), ones)
        spline = CubicSpline(nodes, np.eye(len(nodes)))
        inside = np.clip(at, nodes[0], nodes[-1])
        beyond = (at - inside) / BEYOND
        held = inside + BEYOND * beyond / (1.0 + beyond**POWER) ** (1.0 / POWER)
        values = spline(held)
        autos = values + (at - held)[:, None] * spline(inside, 1)
        return cls(autos, np.zeros(len(at)), values)

    def __call__(
        self, known: Float[np.ndarray, "nodes products rows"]
    ) -> Float[np.ndarray, "products rows channels"]:
        """Return visibilities in all channels.

        Parameters
        ----------
        known : (nodes, products, rows) array
            In the package's order.

        Raises
        ------
        InputError
            If an auto is not positive, or a matrix of visibilities not positive definite.
        """
        autos = known[:, AUTOS]
        require_positive("the autos of the visibilities", autos)
        scale = np.sqrt(autos[:, FIRST] * autos[:, SECOND])
        matrices = np.moveaxis(to_matrix(np.moveaxis(known / scale, 1, 0)), (0, 1), (-2, -1))
        try:
            factors = np.linalg.cholesky(matrices)
        except np.linalg.LinAlgError as error:
            raise InputError(
                "the visibilities of a time are not positive definite: voltages cannot be so "
                "correlated; check beams and sky"
            ) from error
        low = _at(self.correlations, factors)
        ports = np.arange(len(AUTOS))
        low[ports, ports] = np.exp(_at(self.correlations, np.log(factors[..., ports, ports].real)))
        # rows of length one make correlation coefficients
        logs = _at(self.autos, np.log(np.moveaxis(autos, 1, -1)))
        length = np.sqrt((np.abs(low) ** 2).sum(axis=1))
        low *= (np.exp((logs + self.offset) / 2.0) / length)[:, None]
        full = np.empty_like(low)
        for i in ports:
            for j in ports[: i + 1]:
                full[i, j] = sum(low[i, k] * low[j, k].conj() for k in ports[: j + 1])
                full[j, i] = full[i, j].conj()
        return to_real(full)


def _at(weights: Float[np.ndarray, "channels nodes"], values: np.ndarray) -> np.ndarray:
    """Values (nodes, rows, ...) in all channels: (..., rows, channels)."""
    found = np.tensordot(values, weights, axes=(0, 1))
    return np.moveaxis(found, 0, -2)
