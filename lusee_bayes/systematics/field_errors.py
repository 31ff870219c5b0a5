"""Smooth errors of each port's field: what no parameter of the antennas describes.

The response of port i is E_i exp(f_i), with f_i(n) a complex function of direction, whose real part
is the relative error of the amplitude and whose imaginary part that of the phase, ::

    f_i(n) = sum_k a_ik Y_k(n),    Re a_ik, Im a_ik ~ N(0, C_ell),    C_ell = c (1 + ell)^-slope,

up to ``lmax``. Beams of products are then P_ij exp(f_i + conj f_j), and the derivative by an
amplitude is the product of Y_k and the beam, whatever the values. c follows from the standard
deviation of either part in any direction.

How strong the errors are is learned with everything else, in rounds. Each takes the strength that
is most probable for the n amplitudes as they were found, uncertain as they are (expectation and
maximisation), ::

    c = sum [(mean of a)^2 + Var(a)] (1 + ell)^slope / n,

but never less than what is expected: where parameters of the antennas describe most of an error,
what is left has a few shapes, and the strength of all would be found far too low for these.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, ClassVar

import equinox as eqx
import numpy as np
from jaxtyping import Complex, Float
from pydantic import Field

from lusee_bayes.core.arrays import Array, Vector, as_complex, namespace
from lusee_bayes.core.harmonics import n_modes
from lusee_bayes.core.section import NOT_TINY, Section, Treatment
from lusee_bayes.core.sphere_grid import SphereGrid
from lusee_bayes.instrument.products import ports, to_matrix, to_real
from lusee_bayes.systematics.context import Around, Setup
from lusee_bayes.systematics.systematic import ChangedBeams, Unknown, Values

# what is learned, by name
STD = "field_std"
# standard deviation in any direction, at most
LARGEST = 0.1


class FieldErrorsSection(Section):
    """Smooth errors of each port's field.

    Attributes
    ----------
    std : float
        Standard deviation of the relative amplitude, and of the phase in radians, in any direction;
        the least, where it is learned.
    lmax : int
        Highest ell of the errors.
    slope : float
        C_ell goes with (1 + ell)^-slope.
    learned : bool
        Whether the data may raise ``std``.
    treatment : {"marginalised", "sampled", "ignored"}
        Found in rounds and marginalised, sampled with the map, or left out of the model.
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
    patterns : (products, rings, phi) array
        The beams without errors.
    harmonics : (harmonics, rings, phi) array
        Y_k.
    grid : SphereGrid
        Exact for the beams' coefficients up to that of the map.
    expectation : FieldErrorsSection
        What the scenario says of them.
    """

    key: ClassVar[str] = "noise.fields"
    section: ClassVar[type[Section]] = FieldErrorsSection
    words: ClassVar[str] = "the fields"
    has_table: ClassVar[bool] = True

    of_ell: Float[Array, " ells"]
    patterns: Float[Array, "products rings phi"]
    harmonics: Float[Array, "harmonics rings phi"]
    grid: SphereGrid
    expectation: FieldErrorsSection = eqx.field(static=True)

    @classmethod
    def build(cls, section: FieldErrorsSection, setup: Setup, around: Around) -> FieldErrors:
        band = setup.beams.lmax + section.lmax
        grid, values = SphereGrid.of(band, band), around.values or {}
        own = np.eye(n_modes(section.lmax), n_modes(band))
        return cls(
            of_ell(values.get(STD, section.std), section.slope, section.lmax),
            grid.synthesise(np.asarray(setup.beam_source.beams(setup.frequency_mhz, band).modes)),
            grid.synthesise(own),
            grid,
            section,
        )

    @classmethod
    def moved(cls, section: FieldErrorsSection, setup: Setup, values: Values) -> Setup:
        """With the beams of these errors."""
        found = cls.build(section, setup, Around(values=values))
        if not any(name in values for name in (found.names[0], found.unknowns[0].name)):
            return setup
        if found.names[0] in values:
            values = found.values(found.centre(values))
        modes = found.modes(np.asarray(setup.beams.modes), values)
        beams = replace(setup.beams, modes=modes)
        return replace(setup, beams=beams, coupling=setup.coupling.of(modes=modes))

    @classmethod
    def in_data(cls, section, setup, model, truth, key):
        """The same: its A is that of the errors."""
        return model

    @property
    def n_ports(self) -> int:
        """Number of ports."""
        return round(np.sqrt(self.patterns.shape[0]))

    @property
    def unknowns(self) -> tuple[Unknown, ...]:
        """Of every ell: the real parts of all ports, order by order, then the imaginary parts."""
        return tuple(
            Unknown(f"field_error_{ell}", std=std, size=2 * self.n_ports * (2 * ell + 1))
            for ell, std in enumerate(self.of_ell)
        )

    def exponents(self, values: Values) -> Complex[Array, "ports rings phi"]:
        """f of every port."""
        parts = [values[u.name].reshape(2, self.n_ports, -1) for u in self.unknowns]
        amplitudes = namespace(*parts).concatenate(parts, axis=2)
        real, imaginary = namespace(*parts).tensordot(amplitudes, self.harmonics, 1)
        return as_complex(real, imaginary)

    def changed(self, values: Values) -> Float[Array, "products rings phi"]:
        """The beams with errors."""
        f = self.exponents(values)
        factors = namespace(f).exp(f[:, None] + f[None].conj())
        return to_real(to_matrix(self.patterns) * factors)

    def modes(self, modes, values):
        """Add what the errors change."""
        more = self.grid.analyse(self.changed(values) - self.patterns)[:, : modes.shape[-1]]
        return modes + (more if modes.ndim == 2 else more[None])

    def linearised(self, model, centre):
        """Through the beams times every Y_k, of which all amplitudes of k are made."""
        coupling, n = model.coupling, self.n_ports
        beams, size = np.asarray(self.changed(self.values(centre))), coupling.modes.shape[-1]
        along = (self.grid.analyse(beams * y)[:, :size] for y in np.asarray(self.harmonics))
        see = coupling.along(along)
        first, second, imaginary = ports(n)
        own = np.equal.outer(np.arange(n), first) + 1.0 * np.equal.outer(np.arange(n), second)
        across = np.equal.outer(np.arange(n), first) - 1.0 * np.equal.outer(np.arange(n), second)
        # i times a product: its real part is less the imaginary one, and that the real one
        other = np.arange(len(first)) + np.where(first == second, 0, np.where(imaginary, -1, 1))
        across = across * np.where(imaginary, 1.0, -1.0)
        product, time = np.asarray(coupling.layout.product), np.asarray(coupling.layout.time)
        stds, ells = np.asarray(self.of_ell), np.arange(len(self.of_ell))

        def columns(sky):
            seen = see(sky)
            straight, crossed = seen[:, product, time], seen[:, other[product], time]
            parts = []
            for ell, std in zip(ells, stds, strict=True):
                k = slice(ell**2, (ell + 1) ** 2)
                real = own[:, None, product] * straight[None, k]
                phase = across[:, None, product] * crossed[None, k]
                parts.append(std * np.concatenate([real, phase]).reshape(-1, len(product)))
            return np.concatenate(parts).T

        return columns

    @property
    def learns(self) -> bool:
        return self.expectation.learned

    def relearned(self, mean: Vector, variance: Vector) -> dict[str, float]:
        expected = self.expectation
        now = np.asarray(self.of_ell)[0] / of_ell(1.0, expected.slope, expected.lmax)[0]
        found = float(now * np.sqrt(np.mean(mean**2 + variance)))
        return {STD: min(max(found, expected.std), LARGEST)}


def of_ell(std: float, slope: float, lmax: int) -> Float[np.ndarray, " ells"]:
    """Square roots of C_ell, which add up to this standard deviation in any direction."""
    ell = np.arange(lmax + 1.0)
    spectrum = (1.0 + ell) ** -slope
    return std * np.sqrt(spectrum * 4.0 * np.pi / ((2.0 * ell + 1.0) @ spectrum))
