"""Polarised emission of the sky, which the map does not model: circular, and depolarised linear.

Data contain A_V v + A_E e + A_B b besides A m, with the coefficients of Stokes V, and those of the
E and B modes of linear polarisation. They are independent and Gaussian, with isotropic spectra;
integrating them out adds U U^T to N, U = (A_V C_V^(1/2), A_E C_E^(1/2), A_B C_B^(1/2)). Faraday
rotation turns E into B, so that at these frequencies both have the same power.

**Linear polarisation.** Q and U refer to the directions of increasing theta and phi, in the frame
of the antennas as in :func:`.stokes_pairs`: Q is positive along theta, U half way from theta to
phi. This is healpy's convention (the IAU's U has the other sign, since its angles count from North
towards East). The modes give the sky ::

    Q + i U = -sum_lm (E_lm + i B_lm) N_l D y_lm,    N_l = sqrt((l - 2)! / (l + 2)!),
    D = sin(theta) (d_theta + i d_phi / sin(theta)) (1 / sin(theta)) (d_theta + i d_phi /
        sin(theta)),

where D is the spin-raising operator applied twice, and y are the real harmonics of
:mod:`.core.harmonics`. With y = lambda(theta) f(phi), the real part of -N D y is W f, the imaginary
one X df/dphi. With Legendre's equation, ::

    W = N [2 cot lambda' + (l (l + 1) - 2 m^2 / sin^2) lambda],    X = -2 N (lambda' - cot lambda)
                                                                       / sin.

A product with patterns P_Q and P_U then has the beam e_lm = int P_Q W f + P_U X f' for E, and
b_lm = int P_U W f - P_Q X f' for B. E and B turn with the sky as scalars do, so that A_E and A_B
follow from e and b as A does from the beams of Stokes I. The test is a sum over pixels of
``healpy.alm2map_spin``'s Q and U. U U^T would not reveal a wrong sign of U, which only swaps the
sign of B, and B is not correlated with E.

References
----------
Zaldarriaga and Seljak 1997, PRD 55, 1830; Kamionkowski, Kosowsky and Stebbins 1997, PRD 55, 7368.
"""

from typing import Annotated, Any

import numpy as np
from jaxtyping import Float
from pydantic import Field

from lusee_bayes.core import harmonics, lazy, reading
from lusee_bayes.core.arrays import Array
from lusee_bayes.core.section import Section, Treatment
from lusee_bayes.instrument.beams import fields as beam_fields
from lusee_bayes.instrument.coupling import CouplingMatrix
from lusee_bayes.instrument.pointing import Pointing
from lusee_bayes.instrument.products import to_real
from lusee_bayes.systematics.context import Around, Setup
from lusee_bayes.systematics.systematic import LowRankNoise

# lowest ell of circular and of linear polarisation
CIRCULAR, LINEAR = 0, 2
Share = Annotated[float, Field(ge=0, le=1)]
Modes = Float[Array, "products modes"]


class PolarisationSection(Section):
    """Polarised emission, which the map does not model; none unless linear or circular is set.

    Attributes
    ----------
    linear : float
        rms linearly polarised brightness, sqrt(Q^2 + U^2), relative to the mean of the model sky.
    circular : float
        rms of Stokes V, relative to the mean of the model sky.
    lmax : int
        Highest ell of the polarised emission.
    slope : float
        C_ell scales as (ell + 1)^slope; with -2, all octaves of ell have about the same power.
    treatment : {"marginalised", "sampled", "ignored"}
        Add its covariance to N, sample it with the map, or leave it out of the model.
    """

    linear: Share = 0.0
    circular: Share = 0.0
    lmax: Annotated[int, Field(ge=LINEAR, le=63)] = 10
    slope: Annotated[float, Field(ge=-10, le=10)] = -2.0
    treatment: Treatment = "marginalised"


class Polarisation(LowRankNoise):
    """Stokes V, E and B modes of the sky, as noise of their angular power spectra.

    The setup's antennas see it, as its observation points them. Beam files that are interpolated
    linearly between frequencies have products, not fields: the polarised products then come from
    interpolated fields, with the scale of the beams.
    """

    key, section, words = "noise.polarisation", PolarisationSection, "the polarised sky"

    @classmethod
    def treatment(cls, scenario: Any) -> str | None:
        section = scenario.noise.polarisation
        some = section is not None and (section.linear or section.circular)
        return section.treatment if some else None

    @classmethod
    def build(cls, section: PolarisationSection, setup: Setup, around: Around) -> "Polarisation":
        grid, lmax = beam_fields.HemisphereGrid.for_lmax(section.lmax), section.lmax
        with reading.naming(cls.key):
            fields = setup.beam_source.fields(setup.beams.frequency_mhz, grid)
        scale = beam_fields.beam_scale(fields, setup.beams)
        mean = float(setup.sky.modes[0]) / np.sqrt(4.0 * np.pi)
        beams: list[tuple[float, int, Modes]] = []
        if section.circular:
            v = beam_fields.product_modes(fields, lmax, stokes="V", normalise=False)
            beams.append((section.circular, CIRCULAR, v))
        if section.linear:
            # each has half of the power
            each = section.linear / np.sqrt(2.0)
            beams += [(each, LINEAR, modes) for modes in linear_modes(fields, lmax)]
        pointing, columns = Pointing.of(setup.observation, lmax), []
        for share, lowest, modes in beams:
            std = mean * np.sqrt(harmonics.per_mode(unit_spectrum(lmax, lowest, section.slope)))
            coupling = CouplingMatrix.of_modes(scale * np.asarray(modes), pointing, setup.layout)
            columns.append((coupling.dense() * (share * std)[None])[:, lowest**2 :])
        return cls("polarisation", setup.layout, np.concatenate(columns, axis=1))


def unit_spectrum(lmax: int, lowest: int, slope: float) -> Float[np.ndarray, " ells"]:
    """C_ell for ell = 0..lmax that scale as (ell + 1)^slope, for a field whose rms is one.

    Parameters
    ----------
    lmax : int
    lowest : int
        C_ell is zero below.
    slope : float
    """
    ell = np.arange(lmax + 1.0)
    shape = np.where(ell >= lowest, (ell + 1.0) ** slope, 0.0)
    return 4.0 * np.pi * shape / ((2.0 * ell + 1.0) @ shape)


def linear_modes(fields: beam_fields.AntennaFields, lmax: int) -> tuple[Modes, Modes]:
    """Return the coefficients of the products' beams for E and for B modes.

    Parameters
    ----------
    fields : AntennaFields
    lmax : int
        At least 2; the grid has more than twice as many azimuths.

    Returns
    -------
    e, b : (products, modes) array
        Real packed; e @ E + b @ B are the visibilities of a sky with these modes in the frame of
        the antennas, in the unit of the fields squared. Zero for ell < 2.
    """
    grid, (ell, m) = fields.grid, harmonics.mode_numbers(lmax)
    table = lazy.special.sph_legendre_p_all(lmax, lmax, grid.theta, diff_n=1)
    polar, slope = np.swapaxes(table[:, ell, np.abs(m)], 1, 2)
    sin, cot = np.sin(grid.theta)[:, None], 1.0 / np.tan(grid.theta)[:, None]
    product = ell * (ell + 1.0)
    n = np.where(ell < LINEAR, 0.0, 1.0 / np.sqrt(np.maximum(product * (product - 2.0), 1.0)))
    weights = grid.weights[:, None] * n * (2.0 * np.pi / grid.n_phi)
    even = weights * (2.0 * cot * slope + (product - 2.0 * m**2 / sin**2) * polar)
    # df_m / dphi is m f_-m
    odd = -2.0 * weights * m * (slope - cot * polar) / sin
    azimuth = harmonics.azimuth_functions(grid.phi, lmax)
    patterns = (to_real(beam_fields.stokes_beam(fields, stokes)) for stokes in "QU")
    q, u = (np.asarray(pattern) @ azimuth for pattern in patterns)

    def summed(pattern: Array, polar: Array, orders: Array) -> Modes:
        return np.einsum("ktc,tc->kc", pattern[..., lmax + orders], polar)

    return summed(q, even, m) + summed(u, odd, -m), summed(u, even, m) - summed(q, odd, -m)
