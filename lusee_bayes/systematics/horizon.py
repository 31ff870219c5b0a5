"""The horizon: terrain that hides the sky below an altitude h, which depends on the azimuth.

Antennas are modelled over flat ground: their beams end at altitude 0. Terrain takes from the
coefficients of every product what lies below it, ::

    delta b_lm = - int dphi int_0^h(phi) dt cos t P(t, phi) y_lm(t, phi),

with the product's pattern P in the units of its beam. Beams keep their scale. What is hidden emits
like a body of the ground's temperature T: a sky of T everywhere looks the same with and without
terrain.

**Quadrature.** P y_lm is smooth in the altitude t. As the polynomial through Gauss-Legendre nodes
t_q in a strip that no altitude leaves it is integrated up to any h exactly::

    int_0^h dt f(t) = sum_q W_q(h) f(t_q),    W_q the integral of Lagrange's polynomial of node q,

so that a harmonic transform on the rings t_q makes all coefficients, differentiable in h. Azimuths
are 1440: steps of h are seen to a quarter of a degree.

**Altitudes below zero** look where the antennas' model has no field. They count as the same strip
above the horizon does, with the opposite sign: W(-h) = -W(h). That is exact to first order in h,
and, where patterns vanish at the horizon as h^2 (antennas over ground that is no conductor), to
third. There the data do not depend on h to first order at h = 0, so that what is not known is to be
about a known altitude that is not zero everywhere.

**Turntable.** Terrain does not turn with the antennas. In their frame it is another one in every
run: beams are (runs, products, modes) where there is a horizon. That it does not lean with the
lander is neglected, as is that point sources set behind it.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, ClassVar

import equinox as eqx
import numpy as np
from jaxtyping import Float
from numpy.polynomial.legendre import leggauss, legvander
from pydantic import Field

from lusee_bayes.core.arrays import Array, Modes, namespace
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.layouts import Layout, Variable
from lusee_bayes.core.reading import read_table
from lusee_bayes.core.section import NOT_TINY, Section, Temperature, Treatment, requires
from lusee_bayes.instrument.beams.fields import HemisphereGrid
from lusee_bayes.instrument.pointing import offset_names, with_offsets
from lusee_bayes.instrument.products import auto_indices, to_real
from lusee_bayes.systematics.context import Around, Setup
from lusee_bayes.systematics.sources import expected_signal
from lusee_bayes.systematics.systematic import ChangedBeams, Unknown, Values, with_added

Altitudes = Float[Array, "runs azimuths"]
COLUMNS = {"azimuth_deg": (-360.0, 360.0), "altitude_deg": (0.0, 45.0)}
TABLE = Layout(
    f"a table of the horizon with the columns {' and '.join(COLUMNS)}",
    {name: Variable(("row",), low=low, high=high) for name, (low, high) in COLUMNS.items()},
)
AZIMUTHS = 1440
# how far from what is known of it the altitude may be, in prior standard deviations
REACH = 6.0


class HorizonSection(Section):
    """Terrain that hides the sky: a known altitude plus a smooth unknown function of azimuth.

    Attributes
    ----------
    file : str
        CSV table of the known altitude, interpolated linearly: columns ``azimuth_deg``, from North
        towards East, and ``altitude_deg``.
    altitude_deg : float
        Known altitude in all directions; if ``file`` is set, a constant added to the table.
    std_deg : float
        Prior standard deviation of the altitude error in each direction.
    harmonics : int
        Highest order of the Fourier series of the error in azimuth.
    moon_temperature_k : float
        Temperature of the terrain, which emits where it hides the sky.
    treatment : {"marginalised", "sampled", "ignored"}
        Add the covariance of the series to N to first order about its iterative estimate, sample
        its coefficients with the map, or assume that the known altitude is exact.
    true_values : dict
        True values in simulated data, by name (horizon_deg, horizon_cos_1_deg, horizon_sin_1_deg,
        ...); the others are drawn from their priors.
    """

    file: str | None = None
    altitude_deg: Annotated[float, Field(ge=0, le=45)] = 0.0
    std_deg: Annotated[float, Field(gt=0, le=7.5), NOT_TINY]
    harmonics: Annotated[int, Field(ge=0, le=60)] = 3
    moon_temperature_k: Temperature = 0.0
    treatment: Treatment = "marginalised"
    true_values: dict[str, Annotated[float, Field(ge=-45, le=45)]] = Field(default_factory=dict)

    _not_about_zero = requires(
        lambda section: section.treatment == "ignored" or section.file or section.altitude_deg,
        "give file or altitude_deg: at altitude 0, where beams vanish, data do not constrain it",
    )

    def altitude_at(self, azimuth: Altitudes) -> Altitudes:
        """Interpolate the known altitude, all in radians.

        Raises
        ------
        InputError
            If the file cannot be read, is not such a table, or has fewer than two rows.
        """
        if self.file is None:
            return np.full(azimuth.shape, np.radians(self.altitude_deg))
        columns = read_table(self.file, TABLE, "check noise.horizon.file")
        rows = [columns[name] for name in COLUMNS]
        if len(rows[0]) < 2:
            raise InputError(f"{self.file} has one row; expected two or more of {TABLE.what}")
        return np.radians(self.altitude_deg + np.interp(np.degrees(azimuth), *rows, period=360.0))


def _rings(n: int, highest: float) -> HemisphereGrid:
    """Gauss-Legendre nodes in altitude, with cos t for weights."""
    altitude = (leggauss(n)[0] + 1.0) * (highest / 2.0)
    return HemisphereGrid(np.pi / 2.0 - altitude, np.cos(altitude), AZIMUTHS)


class Horizon(ChangedBeams):
    """The altitude of the terrain: what is known of it, and a Fourier series of unknowns.

    Coefficients are independent, of standard deviation std / sqrt(1 + harmonics): that of the sum
    is std in every direction.

    Attributes
    ----------
    patterns : (products, rings, azimuths) array
        Of the antennas with the values of other unknowns about which the model is, in the strip
        above altitude 0 and in 1/sr; azimuths from East towards North in the antennas' frame.
    azimuth : (runs, azimuths) array
        The same directions from North towards East on the ground, in radians.
    altitudes : (runs, azimuths) array
        Altitude that is known, in radians.
    before : (runs, products, modes) array
        What the modelled beams have of the horizon already; zero for none.
    highest : float
        Where the strip ends, in radians; altitudes above are taken for this one.
    lmax : int
        Of the beams.
    std_deg : float
        Of each coefficient.
    harmonics : int
    moon_k : float
        Temperature of the terrain, in K.
    """

    key: ClassVar[str] = "noise.horizon"
    section: ClassVar[type[Section]] = HorizonSection
    words: ClassVar[str] = "the horizon"
    unit: ClassVar[str] = "deg"
    moves_setup: ClassVar[bool] = True

    patterns: Float[Array, "products rings azimuths"]
    azimuth: Altitudes
    altitudes: Altitudes
    before: Float[Array, "runs products modes"] | float
    highest: float = eqx.field(static=True)
    lmax: int = eqx.field(static=True)
    std_deg: float = eqx.field(static=True)
    harmonics: int = eqx.field(static=True)
    moon_k: float = eqx.field(static=True)

    @classmethod
    def octaves(cls, section: HorizonSection) -> float:
        return np.inf

    @classmethod
    def build(cls, section: HorizonSection, setup: Setup, around: Around) -> Horizon:
        source, beams, whole = setup.beam_source, setup.beams, HemisphereGrid.for_lmax(0)
        ahead = np.radians(np.array(setup.observation.turntable_deg))[:, None]
        azimuth = np.pi / 2.0 - ahead - 2.0 * np.pi * np.arange(AZIMUTHS) / AZIMUTHS
        altitude = section.altitude_at(azimuth)
        highest = min(float(altitude.max() + np.radians(REACH * section.std_deg)), np.pi / 2.0)
        # polynomials that follow the harmonics, lmax radians for each of angle, and the patterns
        grids = _rings(24 + int(highest * beams.lmax), highest), whole
        sampled = [to_real(source.patterns(beams.frequency_mhz, grid)) for grid in grids]
        patterns, all_round = map(np.asarray, sampled)
        autos = auto_indices(source.n_ports)
        scale = np.asarray(beams.modes)[autos, 0].mean() / whole.modes(all_round, 0)[autos].mean()
        before = 0.0 if setup.hidden is None else setup.hidden
        series = section.std_deg / (1.0 + section.harmonics) ** 0.5, section.harmonics
        parts = patterns * scale, azimuth, altitude, before, highest, beams.lmax, *series
        return cls(*parts, section.moon_temperature_k)

    @classmethod
    def moved(cls, section: HorizonSection, setup: Setup, values: Values) -> Setup:
        """Behind terrain of this altitude: A, what the terrain emits, and the signal.

        Without values it is the known one.
        """
        names = offset_names(("turntable_deg",), setup.observation.n_runs)
        observation = with_offsets(setup.observation, {n: values[n] for n in names if n in values})
        terrain = cls.build(section, replace(setup, observation=observation), Around())
        hidden = np.asarray(terrain.hidden({name: values.get(name, 0.0) for name in terrain.names}))
        emitted = (terrain.before - hidden)[..., 0] * terrain.uniform[0]
        made = replace(
            setup,
            coupling=setup.coupling.of(modes=np.asarray(setup.beams.modes) + hidden),
            background=(setup.background.T + emitted[observation.run]).T,
            hidden=hidden if setup.hidden is None else setup.hidden,
        )
        parts = made.complete, made.sky, made.background, made.responses
        return replace(made, signal=expected_signal(setup.scenario.sources.list, *parts))

    @property
    def unknowns(self) -> tuple[Unknown, ...]:
        orders = range(1, self.harmonics + 1)
        waves = [f"horizon_{wave}_{k}_deg" for k in orders for wave in ("cos", "sin")]
        return tuple(Unknown(name, 0.0, self.std_deg) for name in ("horizon_deg", *waves))

    @property
    def uniform(self) -> Modes:
        """A sky of the terrain's temperature."""
        return np.eye(1, (self.lmax + 1) ** 2)[0] * (np.sqrt(4.0 * np.pi) * self.moon_k)

    def altitude(self, values: Values) -> Altitudes:
        """The altitude in every direction, in radians."""
        orders = np.arange(1.0, self.harmonics + 1.0)[None, None]
        angle, xp = orders * self.azimuth[..., None], namespace(self.azimuth, *values.values())
        waves = xp.stack([xp.cos(angle), xp.sin(angle)], axis=-1).reshape(*angle.shape[:2], -1)
        series = self.stacked(values) * (np.pi / 180.0)
        return self.altitudes + series[0] + waves @ series[1:]

    def hidden(self, values: Values) -> Float[Array, "runs products modes"]:
        """What terrain of these values does to the beams; differentiable."""
        altitude, n = self.altitude(values), self.patterns.shape[1]
        xp = namespace(altitude, self.patterns)
        sign = xp.where(altitude < 0.0, -1.0, 1.0)
        x = 2.0 * xp.minimum(sign * altitude, self.highest) / self.highest - 1.0
        legendre = [xp.ones_like(x), x]
        for k in range(1, n):
            legendre.append(((2 * k + 1) * x * legendre[k] - k * legendre[k - 1]) / (k + 1))
        # (2 k + 1) times the integral of polynomial k from -1 on
        integrals = [x + 1.0, *(legendre[k + 1] - legendre[k - 1] for k in range(1, n))]
        nodes, weights = leggauss(n)
        lagrange = legvander(nodes, n - 1) * weights[:, None] * (self.highest / 4.0)
        inside = sign[:, None] * xp.einsum("qk,krj->rqj", lagrange, xp.stack(integrals))
        return -_rings(n, self.highest).modes(self.patterns[None] * inside[:, None], self.lmax)

    def modes(self, modes, values):
        """Beams behind terrain of these values, in every run."""
        return modes + (self.hidden(values) - self.before)

    def effect(self, model, values):
        """A of these beams; what they lose of a sky of the terrain's temperature, it emits."""
        made = super().effect(model, values)
        return with_added(made, model.coupling @ self.uniform - made.coupling @ self.uniform)

    def linearised(self, model, centre):
        """That of :meth:`effect`: of a sky that is so much warmer than the terrain."""
        of_sky = super().linearised(model, centre)
        return lambda sky: of_sky(np.asarray(sky) - self.uniform)
