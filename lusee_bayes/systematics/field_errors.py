"""Smooth errors of each port's field that no parameter of the antennas describes.

Port i responds with E_ic + e_ic above the horizon. The components c are East and North at the
zenith, and elsewhere follow from it by parallel transport (Ludwig's third definition), ::

    e_ic(n) = s_i sum_k a_ick Y_k(n),    Re a_ick, Im a_ick ~ N(0, C_ell),

with s_i the rms of E_i over the hemisphere, C_ell = C_0 (1 + ell)^-slope, up to ``lmax``. Errors
are added, since the field that a lander scatters does not vanish where the antenna's own field
does. Beams of products gain E_ic e_jc* + e_ic E_jc* + e_ic e_jc*. C_0 follows from the standard
deviation of either part in any direction.

The strength of the errors is learned with all other unknowns, in rounds. Each round uses the most
probable strength given the posterior of the n amplitudes (expectation maximisation), ::

    C_0 = sum [(mean of a)^2 + Var(a)] (1 + ell)^slope / n,

but never less than the expected strength: if parameters of the antennas describe most of an error,
the rest has only a few shapes, for which the strength of all would be far too low.
"""

from dataclasses import replace
from typing import Annotated

import equinox as eqx
import numpy as np
from jaxtyping import Complex, Float
from pydantic import Field

from lusee_bayes.core import reading, sphere_grid
from lusee_bayes.core.arrays import Array, Vector, as_complex, namespace
from lusee_bayes.core.harmonics import n_modes
from lusee_bayes.core.section import NOT_TINY, Section, Treatment
from lusee_bayes.instrument.beams.fields import HemisphereGrid, beam_scale
from lusee_bayes.instrument.products import ports, to_real
from lusee_bayes.systematics.context import Around, Setup
from lusee_bayes.systematics.polarisation import unit_spectrum
from lusee_bayes.systematics.systematic import ChangedBeams, Unknown, Values

# name of the learned parameter
STD = "field_std"
# unknowns at ell 0, all together or with a number
FIRST = "field_error_0"
# largest standard deviation in any direction
LARGEST = 0.1


class FieldErrorsSection(Section):
    """Smooth errors of each port's field.

    Attributes
    ----------
    std : float
        Standard deviation, in any direction, of the real and the imaginary part of each component,
        relative to the rms of the port's field; a lower limit if ``learned``.
    lmax : int
        Highest ell of the errors.
    slope : float
        C_ell of the errors scales as (1 + ell)^-slope.
    learned : bool
        Let the data increase ``std``.
    treatment : {"marginalised", "sampled", "ignored"}
        Estimate them iteratively and marginalise, sample them with the map, or leave them out.
    """

    std: Annotated[float, Field(gt=0, le=LARGEST), NOT_TINY] = 1e-3
    lmax: Annotated[int, Field(ge=0, le=12)] = 6
    slope: Annotated[float, Field(ge=-2, le=6)] = 1.0
    learned: bool = True
    treatment: Treatment = "marginalised"


class FieldErrors(ChangedBeams):
    """Smooth errors of each port's field.

    Attributes
    ----------
    of_ell : (ells,) array
        Square roots of C_ell.
    fields : (ports, 2, rings, phi) complex array
        E up to the band of the grid, in sqrt(K / K / sr).
    above : (rings, phi) array
        One above the horizon, up to the same band.
    sizes : (ports,) array
        s, in the unit of E.
    harmonics : (harmonics, rings, phi) array
        Y_k.
    grid : SphereGrid
        Exact for the beams' coefficients up to those of the map.
    expectation : FieldErrorsSection
        The scenario's section.
    """

    key, section, words = "noise.fields", FieldErrorsSection, "the fields"
    moves_setup, has_table = True, True

    of_ell: Float[Array, " ells"]
    fields: Complex[Array, "ports 2 rings phi"]
    above: Float[Array, "rings phi"]
    sizes: Float[Array, " ports"]
    harmonics: Float[Array, "harmonics rings phi"]
    grid: sphere_grid.SphereGrid
    expectation: FieldErrorsSection = eqx.field(static=True)

    @classmethod
    def build(cls, section: FieldErrorsSection, setup: Setup, around: Around) -> "FieldErrors":
        band, values = setup.beams.lmax + 2 * section.lmax, around.values or {}
        grid, sky = sphere_grid.SphereGrid.of(band, band), HemisphereGrid.for_lmax(band)
        source, mhz = setup.beam_source, setup.frequency_mhz
        with reading.naming(cls.key):
            beam = source.fields(mhz, sky)
        theta, phi = np.asarray(beam.e_theta), np.asarray(beam.e_phi)
        cos, sin = np.cos(sky.phi), np.sin(sky.phi)
        fields = np.stack([cos * theta - sin * phi, sin * theta + cos * phi], axis=1)
        power = sky.integrate((np.abs(fields) ** 2).sum(1))
        unit = np.sqrt(beam_scale(beam, source.beams(mhz, 0)) / 2.0)
        parts = np.stack([fields.real, fields.imag, np.ones_like(fields.real)])
        real, imaginary, above = grid.synthesise(sky.modes(parts, band))
        return cls(
            of_ell(values.get(STD, section.std), section.slope, section.lmax),
            unit * as_complex(real, imaginary),
            above[0, 0],
            unit * np.sqrt(power / (2.0 * np.pi)),
            grid.synthesise(np.eye(n_modes(section.lmax), n_modes(band))),
            grid,
            section,
        )

    @classmethod
    def moved(cls, section: FieldErrorsSection, setup: Setup, values: Values) -> Setup:
        """Use beams with these errors."""
        if not (one_by_one := f"{FIRST}_0" in values) and FIRST not in values:
            return setup
        errors = cls.build(section, setup, Around(values=values))
        if one_by_one:
            values = errors.values(errors.centre(values))
        modes = errors.modes(np.asarray(setup.beams.modes), values)
        beams = replace(setup.beams, modes=modes)
        return replace(setup, beams=beams, coupling=setup.coupling.of(modes=modes))

    @property
    def unknowns(self) -> tuple[Unknown, ...]:
        """Amplitudes of every ell: parts, ports, components, orders."""
        return tuple(
            Unknown(f"field_error_{ell}", std=std, size=4 * len(self.sizes) * (2 * ell + 1))
            for ell, std in enumerate(self.of_ell)
        )

    def errors(self, values: Values) -> Complex[Array, "ports 2 rings phi"]:
        """e of every port."""
        parts = [values[u.name].reshape(2, len(self.sizes), 2, -1) for u in self.unknowns]
        amplitudes = namespace(*parts).concatenate(parts, axis=3)
        real, imaginary = namespace(*parts).tensordot(amplitudes, self.harmonics, 1)
        return self.sizes[:, None, None, None] * as_complex(real, imaginary)

    def modes(self, modes, values):
        """Add the change that the errors cause."""
        e = self.errors(values)
        xp = namespace(e)
        crossed = xp.einsum("icrp,jcrp->ijrp", self.fields + 0.5 * self.above * e, e.conj())
        more = self.grid.analyse(to_real(crossed + crossed.swapaxes(0, 1).conj()))
        return modes + xp.broadcast_to(more[:, : modes.shape[-1]], modes.shape)

    def linearised(self, model, centre):
        """Combine all derivatives from the data that every Y_k conj(E_jc + e_jc) would give."""
        coupling, n, ells = model.coupling, len(self.sizes), np.arange(len(self.of_ell))
        field = np.conj(self.fields + self.above * self.errors(self.values(centre)))
        parts, size = np.stack([field.real, field.imag]), coupling.modes.shape[-1]
        rows = [self.grid.analyse(parts * y)[..., :size].reshape(-1, size) for y in self.harmonics]
        # in sets of as many rows as products
        used = np.concatenate(rows)
        sets = np.concatenate([used, np.zeros((-len(used) % n**2, size))]).reshape(-1, n**2, size)
        see, layout, (i, j, imaginary) = coupling.along(sets), coupling.layout, ports(n)
        first, second, imaginary = (x[np.asarray(layout.product)] for x in (i, j, imaginary))
        data, time, sizes = np.arange(len(first)), np.asarray(layout.time), np.asarray(self.sizes)
        scale = np.repeat(np.asarray(self.of_ell), 2 * ells + 1)
        place = [slice(ell**2, (ell + 1) ** 2) for ell in ells]

        def columns(sky):
            seen = see(sky).reshape(-1, layout.n_times)[: len(used)]
            seen = seen.reshape(-1, 2, n, 2, layout.n_times)
            # ports, components, harmonics, times
            seen = np.moveaxis(seen[:, 0] + 1j * seen[:, 1], 0, 2) * scale[:, None]
            blocks = []
            for orders in place:
                block = np.zeros((len(data), 2, n, 2, orders.stop - orders.start))
                for own, other, sign in ((first, second, 1.0), (second, first, -1.0)):
                    by_real = sizes[own, None, None] * seen[other, :, orders, time]
                    by_real = by_real.conj() if sign < 0 else by_real
                    for part, slope in enumerate((by_real, sign * 1j * by_real)):
                        slope = np.where(imaginary[:, None, None], slope.imag, slope.real)
                        block[data, part, own] += slope
                blocks.append(block.reshape(len(data), -1))
            return np.concatenate(blocks, axis=1)

        return columns

    @property
    def learns(self) -> bool:
        return self.expectation.learned

    @property
    def size(self) -> float:
        """Standard deviation over the scenario's."""
        expected = self.expectation
        as_expected = of_ell(expected.std, expected.slope, expected.lmax)
        return float(np.asarray(self.of_ell)[0] / as_expected[0])

    def relearned(self, mean: Vector, variance: Vector) -> dict[str, float]:
        """Learn the standard deviation from the posterior of the amplitudes.

        Parameters
        ----------
        mean, variance : (n,) array
            In prior standard deviations.
        """
        least, now = self.expectation.std, self.size * self.expectation.std
        return {STD: min(max(float(now * np.sqrt(np.mean(mean**2 + variance))), least), LARGEST)}


def of_ell(std: float, slope: float, lmax: int) -> Float[np.ndarray, " ells"]:
    """Square roots of C_ell that give this standard deviation in any direction."""
    return std * np.sqrt(unit_spectrum(lmax, 0, -slope))
