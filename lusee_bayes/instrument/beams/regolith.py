"""Reflection of a plane wave off the layered lunar ground."""

from __future__ import annotations

import equinox as eqx
import numpy as np
from jaxtyping import Complex, Float

from lusee_bayes.core.arrays import Array, as_complex, namespace
from lusee_bayes.core.checks import is_traced, require_positive
from lusee_bayes.core.errors import InputError
from lusee_bayes.instrument.beams.fields import wavenumber

N_LAYERS = 8
DEPTH_M = 100.0


def _scalar(x) -> Float[Array, ""]:
    return namespace(x).asarray(x, dtype=np.float64)


class Regolith(eqx.Module):
    """Eight homogeneous layers, the last one infinitely deep; differentiable in all parameters.

    The real permittivity rises linearly over 100 m. Time convention exp(+i w t), so that
    eps = eps' (1 - i tan delta).

    Attributes
    ----------
    surface_permittivity, deep_permittivity : float
        Real relative permittivity of the top and of the bottom layer; 3.7 and 6.1 in the paper.
    loss_tangent : float
        The same in all layers; 0.01 in the paper.

    Raises
    ------
    InputError
        If a permittivity is not positive or the loss tangent is negative.

    References
    ----------
    Grimm 2018, fits to the surface electrical properties experiment of Apollo 17.
    """

    surface_permittivity: Float[Array, ""] = eqx.field(default=3.7, converter=_scalar)
    deep_permittivity: Float[Array, ""] = eqx.field(default=6.1, converter=_scalar)
    loss_tangent: Float[Array, ""] = eqx.field(default=0.01, converter=_scalar)

    def __check_init__(self):
        require_positive("surface_permittivity", self.surface_permittivity)
        require_positive("deep_permittivity", self.deep_permittivity)
        if not is_traced(self.loss_tangent) and not self.loss_tangent >= 0:
            raise InputError(f"loss_tangent must not be negative, got {self.loss_tangent}")

    def permittivities(self) -> Complex[Array, " layers"]:
        """Return the complex relative permittivity of each layer from the top down."""
        rise = np.linspace(0.0, 1.0, N_LAYERS)
        real = self.surface_permittivity + rise * (
            self.deep_permittivity - self.surface_permittivity
        )
        return as_complex(real, -real * self.loss_tangent)

    def reflection(
        self,
        cos_theta: Float[Array, " theta"],
        frequency_mhz: float | Float[Array, ""],
    ) -> tuple[Complex[Array, " theta"], Complex[Array, " theta"]]:
        """Return the reflection coefficients for waves that arrive at zenith angle theta.

        By recursion over the interfaces from the bottom up, with Fresnel coefficients at each.

        Parameters
        ----------
        cos_theta : (theta,) array
        frequency_mhz : float

        Returns
        -------
        s : (theta,) complex array
            Coefficient of the horizontal electric field (phi component); -1 for a conductor.
        p : (theta,) complex array
            Coefficient of the magnetic field: the reflected theta component is -p cos theta along
            the horizontal and -p sin theta along the vertical; +1 for a conductor.

        References
        ----------
        Born & Wolf, Principles of Optics, section 1.6.4.
        """
        thickness = wavenumber(frequency_mhz) * DEPTH_M / (N_LAYERS - 1)  # in radians of vacuum
        xp = namespace(self, cos_theta, frequency_mhz)
        thickness = xp.asarray(thickness, dtype=np.complex128)
        cosine = xp.asarray(cos_theta, dtype=np.complex128)
        sin2 = 1.0 - cosine**2
        eps = [xp.ones((), dtype=np.complex128), *self.permittivities()]
        # vertical wave numbers over k; the root with Im <= 0 decays downwards under exp(+i w t)
        vertical = [cosine] + [_decaying_root(e - sin2) for e in eps[1:]]
        s, p = xp.zeros_like(vertical[0]), xp.zeros_like(vertical[0])
        for upper in range(N_LAYERS - 1, -1, -1):
            q0, q1 = vertical[upper], vertical[upper + 1]
            y0, y1 = q0 * eps[upper + 1], q1 * eps[upper]
            fresnel_s, fresnel_p = (q0 - q1) / (q0 + q1), (y0 - y1) / (y0 + y1)
            if upper == N_LAYERS - 1:  # nothing comes back from below the last interface
                s, p = fresnel_s, fresnel_p
                continue
            delay = xp.exp(-2j * thickness * q1)
            s = (fresnel_s + s * delay) / (1.0 + fresnel_s * s * delay)
            p = (fresnel_p + p * delay) / (1.0 + fresnel_p * p * delay)
        return s, p


def _decaying_root(z: Complex[Array, " theta"]) -> Complex[Array, " theta"]:
    """The root with Im <= 0, which decays downwards under exp(+i w t)."""
    xp = namespace(z)
    root = xp.sqrt(z)
    return xp.where(root.imag > 0, -root, root)
