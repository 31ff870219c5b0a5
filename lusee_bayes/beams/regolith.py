"""Reflection of a plane wave by the layered lunar ground."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Complex, Float

from lusee_bayes.beams.fields import wavenumber
from lusee_bayes.checks import AnyArray, InputError, is_traced, require_positive

N_LAYERS = 8
DEPTH_M = 100.0


def _scalar(x) -> Float[Array, ""]:
    return jnp.asarray(x, dtype=jnp.float64)


class Regolith(eqx.Module):
    """Eight homogeneous layers, the last one without end; parameters are differentiable.

    The real permittivity rises linearly over 100 m from ``surface_permittivity`` (top layer) to
    ``deep_permittivity`` (bottom), with one ``loss_tangent``, as the fits to the Apollo 17 surface
    electrical properties experiment suggest (Grimm 2018; 3.7, 6.1 and 0.01 in the paper). Time
    convention exp(+i w t): eps = eps' (1 - i tan delta).
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
        """Complex relative permittivity of each layer from the top down."""
        rise = jnp.linspace(0.0, 1.0, N_LAYERS)
        real = self.surface_permittivity + rise * (
            self.deep_permittivity - self.surface_permittivity
        )
        return jax.lax.complex(real, -real * self.loss_tangent)

    def reflection(
        self,
        cos_theta: Float[AnyArray, " theta"],
        frequency_mhz: float | Float[Array, ""],
    ) -> tuple[Complex[Array, " theta"], Complex[Array, " theta"]]:
        """Reflection coefficients (s, p) for waves arriving at zenith angle theta.

        s: of the horizontal electric field (phi component). p: of the magnetic field, so that the
        reflected theta component is -p cos theta along the horizontal and -p sin theta along the
        vertical; a perfect conductor has s = -1, p = +1. Recursion over the interfaces from the
        bottom up, with Fresnel coefficients at each (Born & Wolf, section 1.6.4).
        """
        thickness = wavenumber(frequency_mhz) * DEPTH_M / (N_LAYERS - 1)  # in radians of vacuum
        thickness = jnp.asarray(thickness, dtype=jnp.complex128)
        cosine = jnp.asarray(cos_theta, dtype=jnp.complex128)
        sin2 = 1.0 - cosine**2
        eps = [jnp.ones((), dtype=jnp.complex128), *self.permittivities()]
        # vertical wave numbers over k; the root with Im <= 0 decays downwards under exp(+i w t)
        vertical = [cosine] + [_decaying_root(e - sin2) for e in eps[1:]]
        s, p = jnp.zeros_like(vertical[0]), jnp.zeros_like(vertical[0])
        for upper in range(N_LAYERS - 1, -1, -1):
            q0, q1 = vertical[upper], vertical[upper + 1]
            y0, y1 = q0 * eps[upper + 1], q1 * eps[upper]
            fresnel_s, fresnel_p = (q0 - q1) / (q0 + q1), (y0 - y1) / (y0 + y1)
            if upper == N_LAYERS - 1:  # nothing comes back from below the last interface
                s, p = fresnel_s, fresnel_p
                continue
            delay = jnp.exp(-2j * thickness * q1)
            s = (fresnel_s + s * delay) / (1.0 + fresnel_s * s * delay)
            p = (fresnel_p + p * delay) / (1.0 + fresnel_p * p * delay)
        return s, p


def _decaying_root(z: Complex[Array, " theta"]) -> Complex[Array, " theta"]:
    root = jnp.sqrt(z)
    return jnp.where(root.imag > 0, -root, root)
