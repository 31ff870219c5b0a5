"""An isotropic Gaussian sky in real harmonic coefficients: S = diag(C_ell)."""

from __future__ import annotations

import equinox as eqx
import numpy as np
from jaxtyping import Float

from lusee_bayes.core.arrays import Array, namespace
from lusee_bayes.core.checks import (
    extent,
    is_traced,
    require_finite,
    require_float64,
    require_shape,
)
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.harmonics import n_modes, per_mode
from lusee_bayes.sky.priors.independent import DiagonalPrior


def require_spectrum(spectrum: Float[Array, " ells"]) -> None:
    """Raise an InputError unless C_ell is float64, finite and not negative."""
    require_float64("the prior spectrum", spectrum)
    require_finite("the prior spectrum", spectrum)
    if is_traced(spectrum):
        return
    negative = np.asarray(spectrum) < 0
    if negative.any():
        ell = int(np.argmax(negative))
        raise InputError(
            f"the prior spectrum is negative at ell = {ell}: C_ell = {float(spectrum[ell]):.3g}; "
            "a variance cannot be"
        )


class HarmonicPrior(DiagonalPrior):
    """S = diag(C_ell): an isotropic Gaussian sky in real harmonic coefficients, about a mean sky.

    Attributes
    ----------
    spectrum : (ells,) array
        C_ell in K^2 for ell = 0..lmax; C_0 is the prior variance of the monopole.
    mean : (modes,) array or None
        The prior mean, in K, Galactic, real packed; None for zero.

    Raises
    ------
    InputError
        If the spectrum or the mean is not float64 or not finite, the spectrum is negative, or the
        mean has another lmax, or power at an ell where the spectrum has none.
    """

    spectrum: Float[Array, " ells"]
    mean: Float[Array, " modes"] | None = eqx.field(default=None, kw_only=True)

    def __check_init__(self):
        require_spectrum(self.spectrum)
        if self.mean is None:
            return
        require_float64("the prior mean", self.mean)
        require_shape("the prior mean", self.mean, (self.size,))
        require_finite("the prior mean", self.mean)
        if is_traced(self.spectrum, self.mean):
            return
        fixed = np.flatnonzero((np.asarray(self.mean) != 0.0) & ~(np.asarray(self.variance()) > 0))
        if fixed.size:
            raise InputError(
                f"the prior mean has power at ell = {int(np.sqrt(fixed[0]))}, where C_ell is zero; "
                "give that ell a variance"
            )

    def description(self) -> tuple[str, ...]:
        about = "zero" if self.mean is None else "a mean sky"
        return (
            f"independent coefficients about {about}, lmax = {self.spectrum.shape[0] - 1}",
            f"{self.size} real coefficients, Galactic; C_ell {extent(self.spectrum, 'K^2')}",
        )

    @property
    def white_mean(self) -> Float[Array, " white"] | None:
        return None if self.mean is None else self.whiten(self.mean)

    @property
    def widths(self) -> Float[Array, " modes"]:
        # the derivative of sqrt at an ell without power is zero here, not infinite
        xp, power = namespace(self.spectrum), self.spectrum > 0
        root = xp.sqrt(xp.where(power, self.spectrum, 1.0))
        return per_mode(xp.where(power, root, 0.0))

    @property
    def size(self) -> int:
        return n_modes(self.spectrum.shape[0] - 1)

    def widened(self, factor):
        return HarmonicPrior(self.spectrum * factor**2, mean=self.mean)

    def variance(self):
        return per_mode(self.spectrum)

    def require_density(self) -> None:
        if not is_traced(self.spectrum) and not np.asarray(self.spectrum).all():
            ell = int(np.argmin(np.asarray(self.spectrum)))
            raise InputError(
                f"the prior spectrum is zero at ell = {ell} and has no density; drop that ell"
            )
