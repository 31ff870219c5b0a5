"""The prior on skies of several frequencies: few maps with known spectra, and residuals.

::

    m_f = sum_c s_fc a_c + r_f,    a_c ~ N(0, C^c_ell),    r_f ~ N(0, R^f_ell),

so S = sum_c s_c s_c^T (x) C^c + diag(R^f). The spectra are a power law, its curvature and its
turnover; the residual is the remainder.
"""

from collections.abc import Callable, Mapping

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from lusee_bayes.core import checks
from lusee_bayes.core.arrays import Array, namespace
from lusee_bayes.core.errors import InputError, require_known
from lusee_bayes.core.harmonics import per_mode, power_spectrum

# spectra relative to the power law: x is frequency / reference, y frequency / turnover; ionised gas
# absorbs 1 - exp(-tau), with tau proportional to nu^-2.1 (Altenhoff et al. 1960)
SPECTRA = {
    "power_law": lambda x, y: np.ones_like(x),
    "curvature": lambda x, y: np.log(x),
    "turnover": lambda x, y: -np.expm1(-(y**-2.1)),
}


def require_names(
    kind: str, several: str, names: tuple[str, ...], known: Mapping[str, Callable], n_channels: int
) -> None:
    """Refuse unknown names, and more names than channels.

    Parameters
    ----------
    kind, several : str
        Singular and plural of the named things, for the message.
    names : tuple of str
    known : mapping
        Known names.
    n_channels : int

    Raises
    ------
    InputError
    """
    for name in names:
        require_known(f"unknown {kind}", name, known)
    if not names or n_channels < len(names):
        raise InputError(
            f"{len(names)} {several} need at least as many channels, got {n_channels}; name fewer "
            f"in spectral.{kind}s, or give more frequencies"
        )


def check_components(names: tuple[str, ...], n_channels: int, residual: float | None) -> None:
    """Refuse spectral components that ``n_channels`` channels cannot separate.

    Parameters
    ----------
    names : tuple of str
        Keys of ``SPECTRA``.
    n_channels : int
    residual : float, optional
        None for the residual of a fit of the components, which then must not be exact.

    Raises
    ------
    InputError
        For unknown names, a negative residual, and fewer channels than the components need.
    """
    require_names("component", "spectral components", names, SPECTRA, n_channels)
    if residual is not None and residual < 0.0:
        raise InputError(f"the residual must not be negative, got {residual}")
    if residual is None and n_channels == len(names):
        raise InputError(
            f"{len(names)} spectral components fit any skies of {n_channels} channels exactly; "
            "give spectral.residual, name fewer in spectral.components, or give more frequencies"
        )


class SpectralPrior(checks.Described, eqx.Module):
    """N(0, S) over the skies of all channels; see the module's equations.

    Attributes
    ----------
    frequencies_mhz : (channels,) array
        Frequencies in MHz.
    mixing : (channels, components) array
        s_fc.
    spectra : (components, ells) array
        C^c_ell, in K^2.
    residual : (channels, ells) array, optional
        R^f_ell, in K^2; None for no residual.
    names : tuple of str
        Names of the components.

    Raises
    ------
    InputError
        If shapes do not match, or numbers are not finite or not positive.
    """

    frequencies_mhz: Float[Array, " channels"]
    mixing: Float[Array, "channels components"]
    spectra: Float[Array, "components ells"]
    residual: Float[Array, "channels ells"] | None = None
    names: tuple[str, ...] = eqx.field(static=True, default=())

    def __check_init__(self):
        channels, components = self.mixing.shape
        checks.require_array("the frequencies", self.frequencies_mhz, (channels,))
        checks.require_array("the mixing", self.mixing)
        checks.require_array("the components' spectra", self.spectra, (components, None))
        checks.require_positive("the components' C_ell", self.spectra)
        if self.residual is not None:
            name, hint = "the residual spectra", "omit them without a residual"
            checks.require_array(name, self.residual, (channels, self.spectra.shape[1]))
            checks.require_positive(name, self.residual, hint)

    @classmethod
    def components(
        cls,
        frequencies_mhz: Float[Array, " channels"],
        skies: Float[Array, "channels modes"],
        names: tuple[str, ...] = tuple(SPECTRA),
        *,
        index: float = -2.5,
        reference_mhz: float = 20.0,
        turnover_mhz: float = 5.0,
        residual: float | None = None,
    ) -> "SpectralPrior":
        """Fit components of ``SPECTRA`` times a power law to model skies.

        The components' C_ell are those of the fit.

        Parameters
        ----------
        frequencies_mhz : (channels,) array
            Frequencies in MHz.
        skies : (channels, modes) array
            Model skies, in K.
        names : tuple of str
            Keys of ``SPECTRA``.
        index : float
            Spectral index of the power law.
        reference_mhz, turnover_mhz : float
            Frequencies of ``SPECTRA`` in MHz.
        residual : float, optional
            Rms of each channel's residual over that of its sky. 0 is no residual; None uses the
            residual of the fit.

        Raises
        ------
        InputError
            For unknown names, and for fewer channels than the components need.
        """
        frequencies, skies = np.asarray(frequencies_mhz), np.asarray(skies)
        check_components(names, len(frequencies), residual)
        x, y = frequencies / reference_mhz, frequencies / turnover_mhz
        power_law = x**index
        shapes = np.stack([SPECTRA[name](x, y) for name in names], axis=1)
        # in units of the power law, so that no channel dominates the fit
        maps, *_ = np.linalg.lstsq(shapes, skies / power_law[:, None], rcond=None)
        mixing = shapes * power_law[:, None]
        # correct for the residuals' variance that the fit absorbs
        free = len(frequencies) / max(len(frequencies) - len(names), 1)
        left_over = np.sqrt(free) * (skies - mixing @ maps)
        of, share = (left_over, 1.0) if residual is None else (skies, residual)
        spectra = None if share == 0 else jnp.asarray(share**2 * power_spectrum(of))
        return cls(*map(jnp.asarray, (frequencies, mixing, power_spectrum(maps))), spectra, names)

    def description(self) -> tuple[str, ...]:
        residual = "no residual" if self.residual is None else "a residual in each"
        return (
            f"{self.n_channels} channels, {checks.extent(self.frequencies_mhz, 'MHz')}, "
            f"lmax = {self.lmax}",
            f"{self.n_components} component maps ({checks.listed(self.names)}), {residual}; "
            "Galactic, K",
        )

    @property
    def n_channels(self) -> int:
        """Number of frequencies."""
        return self.mixing.shape[0]

    @property
    def n_components(self) -> int:
        """Number of component maps."""
        return self.mixing.shape[1]

    @property
    def lmax(self) -> int:
        """Highest ell."""
        return self.spectra.shape[1] - 1

    @property
    def roots(self) -> Float[Array, "components modes"]:
        """Prior standard deviations of the component maps, in K."""
        return namespace(self).sqrt(per_mode(self.spectra))

    def residual_root(self, channel: int) -> Float[Array, " modes"] | None:
        """Return prior standard deviations of a channel's residual, in K; None if it has none."""
        if self.residual is None:
            return None
        return namespace(self).sqrt(per_mode(self.residual[channel]))
