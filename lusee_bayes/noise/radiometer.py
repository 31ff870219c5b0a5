"""Radiometer noise: its variances, and covariances between products.

**Sample covariances** of complex Gaussian voltages: the mean of v v* over the N independent samples
in a spectrum, of covariance T = L L*, is T + L H L* / sqrt(N). H is Hermitian and for large N
Gaussian: real numbers of variance one on its diagonal, complex ones of mean square one off it. Its
covariances are those of :func:`.exact_blocks`, divided by N.

**N has two forms.** With T_ij(t) the visibilities of the antennas in K, bandwidth df and
integration time dt (times the duty cycle)::

    paper   sigma_k^2 = (T_ii T_jj + V_k^2) / (2 df dt), independent;
    exact   the voltages are complex Gaussian with covariance T(t), so
            Cov[V_ij, conj(V_kl)] = T_ik conj(T_jl) / (df dt),
            Cov[V_ij, V_kl]       = T_il conj(T_jk) / (df dt),
            which couples all products of one time.

The exact form needs a positive definite T(t), as every covariance of independent voltages is. At
other times, with exchanged products or the dependent responses of ideal dipoles, products are taken
as independent.
"""

import numpy as np
from jaxtyping import Bool, Complex, Float

from lusee_bayes.core import checks
from lusee_bayes.core.arrays import Array, Grid, compiled, namespace
from lusee_bayes.core.errors import InputError, refusing, require_known
from lusee_bayes.instrument.products import DataLayout, auto_indices, ports, to_matrix, without_gaps
from lusee_bayes.noise.covariance import Covariance, DiagonalCovariance
from lusee_bayes.noise.time_blocks import TimeBlockCovariance

Matrices = Complex[np.ndarray, "antennas antennas *rest"]


def sample_covariances(t: Matrices, n_averaged: float, generator: np.random.Generator) -> Matrices:
    """Draw sample covariances.

    Parameters
    ----------
    t : (antennas, antennas, ...) array
        The covariances T.
    n_averaged : float
        Number of independent samples in each.
    generator : Generator

    Raises
    ------
    InputError
        If a T is not positive definite, as that of voltages must be.
    """
    wrong = (
        "the covariance of the voltages is not positive definite, so that its radiometer noise is "
        "undefined; check that autos are positive and correlations below one"
    )
    with refusing(wrong, np.linalg.LinAlgError):
        lower = np.linalg.cholesky(np.moveaxis(t, (0, 1), (-2, -1)))
    n, scale = len(t), 1.0 / np.sqrt(n_averaged)
    hermitian = np.zeros_like(t)
    for i in range(n):
        hermitian[i, i] = generator.standard_normal(t.shape[2:]) * scale
        for j in range(i):
            real, imaginary = generator.standard_normal((2, *t.shape[2:])) * (scale * np.sqrt(0.5))
            hermitian[i, j] = real + 1j * imaginary
            hermitian[j, i] = hermitian[i, j].conj()
    noise = lower @ np.moveaxis(hermitian, (0, 1), (-2, -1)) @ lower.conj().swapaxes(-1, -2)
    return t + np.moveaxis(noise, (-2, -1), (0, 1))


Scalar = float | int | Float[Array, ""]

RADIOMETER_FORMS = ("paper", "exact")
# smallest eigenvalue of T over the largest: that of the products' covariance is about its square
LEAST_EIGENVALUE = 1e-5


def radiometer_noise(
    visibilities: Grid,
    layout: DataLayout,
    *,
    bandwidth_hz: Scalar = 1.0e6,
    step_s: Scalar | Float[Array, " samples"] = 7200.0,
    form: str = "exact",
    duty_cycle: Scalar = 1.0,
    factor: Scalar = 1.0,
) -> Covariance:
    """Return the covariance of the radiometer noise around given visibilities.

    Parameters
    ----------
    visibilities : (products, times) array
        Modelled or measured V_k(t) on the full grid, in K. Samples that are absent from the
        layout may be 0 or NaN; :func:`.without_gaps` fills them if noise depends on them.
    layout : DataLayout
    bandwidth_hz : float
    step_s : float or (times,) array
        Integration time in seconds: one for all samples, or the live time of each, such as
        :attr:`.Observation.live_s`. The default is that of :meth:`.Observation.from_runs`.
    form : {"paper", "exact"}
    duty_cycle : float
        Fraction of ``step_s`` spent integrating.
    factor : float
        Factor of the variance: 10 for ten times the noise power.

    Returns
    -------
    Covariance
        In K^2: diagonal in the paper's form, a block per time in the exact one.

    Raises
    ------
    InputError
        For an unknown form, parameters out of range, and autos that are not positive.
    """
    require_known("unknown radiometer form", form, RADIOMETER_FORMS)
    given = {"bandwidth_hz": bandwidth_hz, "step_s": step_s, "factor": factor}
    for name, value in (given | {"duty_cycle": duty_cycle}).items():
        checks.require_positive(f"the radiometer's {name}", value)
    if not checks.is_traced(duty_cycle) and duty_cycle > 1.0:
        raise InputError(f"the radiometer's duty_cycle must not exceed 1, got {duty_cycle}")
    checks.require_float64("the visibilities", visibilities)
    checks.require_shape("the visibilities", visibilities, (layout.n_products, layout.n_times))
    visibilities = without_gaps(visibilities, layout)
    checks.require_finite("the visibilities", visibilities)
    autos = visibilities[auto_indices(round(np.sqrt(layout.n_products)))]
    hint = "it sets the noise level; flag these samples, or use a sky with a positive mean"
    checks.require_positive("the antenna temperature (autos of the visibilities)", autos, hint)
    scale = factor / (bandwidth_hz * step_s * duty_cycle)
    if np.ndim(scale):
        checks.require_shape("the radiometer's step_s", scale, (layout.n_times,))
    else:
        scale = namespace(scale, visibilities).full(layout.n_times, scale)
    if form == "paper":
        return DiagonalCovariance(layout.gather(paper_variance(visibilities) * scale[None]))
    return TimeBlockCovariance(exact_blocks(visibilities) * scale[:, None, None], layout)


def paper_variance(visibilities: Grid) -> Grid:
    """Return (T_ii T_jj + V_k^2) / 2 in K^2, to be divided by df dt."""
    n = round(np.sqrt(visibilities.shape[0]))
    autos = visibilities[auto_indices(n)]
    i, j, _ = ports(n)
    return (autos[i] * autos[j] + visibilities**2) / 2.0


@compiled
def exact_blocks(visibilities: Grid) -> Float[Array, "times products products"]:
    """Return the covariance of the products at every time in K^2, to be divided by df dt.

    A product is Re(c V_ij) with c = 1 or -i, so ::

        Cov[k, l] = Re( c_k conj(c_l) E[dV dV'*] + c_k c_l E[dV dV'] ) / 2.
    """
    i, j, imaginary = ports(round(np.sqrt(visibilities.shape[0])))
    part, xp = np.where(imaginary, -1j, 1.0 + 0j), namespace(visibilities)
    t = xp.moveaxis(to_matrix(visibilities), 2, 0)
    hermitian = t[:, i[:, None], i[None]] * t[:, j[:, None], j[None]].conj()
    pseudo = t[:, i[:, None], j[None]] * t[:, j[:, None], i[None]].conj()
    weights = (part[:, None] * part[None].conj())[None], (part[:, None] * part[None])[None]
    blocks = (weights[0] * hermitian + weights[1] * pseudo).real / 2.0
    independent = paper_variance(visibilities).T[:, :, None] * np.eye(len(i))[None]
    return xp.where(of_voltages(visibilities)[:, None, None], blocks, independent)


def of_voltages(visibilities: Grid) -> Bool[Array, " times"]:
    """Whether T(t) is positive definite, by more than rounding could undo."""
    xp = namespace(visibilities)
    values = xp.linalg.eigvalsh(xp.moveaxis(to_matrix(visibilities), 2, 0))
    return values[:, 0] > LEAST_EIGENVALUE * values[:, -1]
