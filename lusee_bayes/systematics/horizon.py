"""The horizon: terrain that hides the sky below an altitude h, which depends on the azimuth.

Antennas are modelled over flat ground: their beams end at altitude 0. Terrain removes the part
below it from the coefficients of every product, ::

    delta b_lm = - int dphi int_0^h(phi) dt cos t P(t, phi) y_lm(t, phi),

with the product's pattern P in the units of its beam. Beams keep their scale. Terrain emits like a
body of the ground's temperature T: a sky of T everywhere looks the same with and without terrain.

**Quadrature.** P y_lm is smooth in the altitude t. As a polynomial through Gauss-Legendre nodes t_q
in a strip that contains all altitudes, it is integrated up to any h exactly::

    int_0^h dt f(t) = sum_q W_q(h) f(t_q),    W_q the integral of Lagrange's polynomial of node q,

so that a harmonic transform on the rings t_q gives all coefficients, differentiable in h. There are
1440 azimuths: they resolve steps of h to a quarter of a degree.

**Altitudes below zero** are outside the antennas' model. They count like the same strip above the
horizon, with the opposite sign: W(-h) = -W(h). That is exact to first order in h, and to third
order where patterns vanish at the horizon as h^2 (antennas over non-conducting ground). There the
data do not depend on h to first order at h = 0, so that the unknowns must be about a known altitude
that is not zero everywhere.

**Turntable.** Terrain does not turn with the antennas. In their frame it differs from run to run:
with a horizon, beams are (runs, products, modes). The model neglects that terrain does not tilt
with the lander, and that it hides point sources and the polarised sky.
"""

from dataclasses import replace
from typing import Annotated

import equinox as eqx
import numpy as np
from jaxtyping import Float
from numpy.polynomial.legendre import leggauss, legint, legval, legvander
from pydantic import Field

from lusee_bayes.core import layouts, reading
from lusee_bayes.core.arrays import Array, Modes, namespace
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.section import NOT_TINY, Section, Temperature, Treatment, requires
from lusee_bayes.instrument.beams.fields import HemisphereGrid
from lusee_bayes.instrument.pointing import offset_names, with_offsets
from lusee_bayes.instrument.products import to_real
from lusee_bayes.systematics.context import Around, Setup
from lusee_bayes.systematics.systematic import ChangedBeams, Unknown, Values, with_added

Altitudes = Float[Array, "runs azimuths"]
COLUMNS = {"azimuth_deg": (-360.0, 360.0), "altitude_deg": (0.0, 45.0)}
TABLE = layouts.Layout(
    f"a table of the horizon with the columns {' and '.join(COLUMNS)}",
    {name: layouts.Variable(("row",), low=low, high=high) for name, (low, high) in COLUMNS.items()},
)
AZIMUTHS = 1440
# largest deviation from the known altitude, in prior standard deviations
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
    _within_reach = requires(
        lambda section: sum(map(abs, section.true_values.values())) <= REACH * section.std_deg,
        f"true_values lie more than {REACH:g} std_deg from the known altitude; raise std_deg",
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
        columns = reading.read_table(self.file, TABLE, "check noise.horizon.file")
        rows = [columns[name] for name in COLUMNS]
        if len(rows[0]) < 2:
            raise InputError(f"{self.file} has one row; expected two or more of {TABLE.what}")
        return np.radians(self.altitude_deg + np.interp(np.degrees(azimuth), *rows, period=360.0))


def _rings(n: int, highest: float) -> HemisphereGrid:
    """Gauss-Legendre nodes in altitude, with cos t for weights."""
    altitude = (leggauss(n)[0] + 1.0) * (highest / 2.0)
    return HemisphereGrid(np.pi / 2.0 - altitude, np.cos(altitude), AZIMUTHS)


class Horizon(ChangedBeams):
    """The altitude of the terrain: a known part, and a Fourier series of unknowns.

    Coefficients are independent, with the standard deviation std / sqrt(1 + harmonics): the sum has
    std in every direction.

    Attributes
    ----------
    unknowns : tuple of Unknown
        The coefficients, in degrees.
    patterns : (products, rings, azimuths) array
        Of the antennas, at the expansion point of other unknowns, in the strip above altitude 0, in
        1/sr; azimuths from East towards North in the antennas' frame.
    azimuth : (runs, azimuths) array
        The same directions from North towards East on the ground, in radians.
    altitudes : (runs, azimuths) array
        Known altitude, in radians.
    before : (runs, products, modes) array
        The horizon's effect that the modelled beams already include; zero for none.
    highest : float
        Upper end of the strip, in radians; higher altitudes are clipped to it.
    lmax : int
        Of the beams.
    moon_k : float
        Temperature of the terrain, in K.
    """

    key, section, words, unit = "noise.horizon", HorizonSection, "the horizon", "deg"
    moves_setup, in_common = True, True

    unknowns: tuple[Unknown, ...] = eqx.field()
    patterns: Float[Array, "products rings azimuths"]
    azimuth: Altitudes
    altitudes: Altitudes
    before: Float[Array, "runs products modes"] | float
    highest: float = eqx.field(static=True)
    lmax: int = eqx.field(static=True)
    moon_k: float = eqx.field(static=True)

    @classmethod
    def build(cls, section: HorizonSection, setup: Setup, around: Around) -> "Horizon":
        source, beams = setup.beam_source, setup.beams
        ahead = np.radians(np.array(setup.observation.turntable_deg))[:, None]
        azimuth = np.pi / 2.0 - ahead - 2.0 * np.pi * np.arange(AZIMUTHS) / AZIMUTHS
        altitude = section.altitude_at(azimuth)
        if section.treatment != "ignored" and not altitude.any():
            wrong = f"{section.file} has altitude 0 everywhere; raise noise.horizon.altitude_deg"
            raise InputError(wrong)
        highest = min(float(altitude.max() + np.radians(REACH * section.std_deg)), np.pi / 2.0)
        # polynomials that follow the patterns, and the harmonics: lmax radians per radian
        frequency, grid = beams.frequency_mhz, _rings(24 + int(highest * beams.lmax), highest)
        patterns = np.asarray(to_real(source.patterns(frequency, grid)))
        patterns = patterns * source.pattern_scale(frequency)
        before = 0.0 if setup.hidden is None else setup.hidden
        orders, std_deg = section.harmonics, section.std_deg / (1.0 + section.harmonics) ** 0.5
        waves = [f"{wave}_{k}_" for k in range(1, orders + 1) for wave in ("cos", "sin")]
        unknowns = tuple(Unknown(f"horizon_{wave}deg", 0.0, std_deg) for wave in ("", *waves))
        parts = patterns, azimuth, altitude, before, highest, beams.lmax
        return cls(unknowns, *parts, section.moon_temperature_k)

    @classmethod
    def moved(cls, section: HorizonSection, setup: Setup, values: Values) -> Setup:
        """Add terrain of this altitude: A, the terrain's emission, and the signal.

        Without values, the altitude is the known one.
        """
        names = offset_names(("turntable_deg",), setup.observation.n_runs)
        observation = with_offsets(setup.observation, {n: values[n] for n in names if n in values})
        terrain = cls.build(section, replace(setup, observation=observation), Around())
        hidden = np.asarray(terrain.hidden({name: values.get(name, 0.0) for name in terrain.names}))
        emitted = (terrain.before - hidden)[..., 0] * terrain.uniform[0]
        return replace(
            setup,
            coupling=setup.coupling.of(modes=np.asarray(setup.beams.modes) + hidden),
            background=setup.background + emitted[observation.run].T,
            hidden=hidden if setup.hidden is None else setup.hidden,
        )

    @property
    def uniform(self) -> Modes:
        """A sky of the terrain's temperature."""
        return np.eye(1, (self.lmax + 1) ** 2)[0] * (np.sqrt(4.0 * np.pi) * self.moon_k)

    def altitude(self, values: Values) -> Altitudes:
        """The altitude in every direction, in radians."""
        orders = np.arange(1.0, 1.0 + len(self.unknowns) // 2)[None, None]
        angle, xp = orders * self.azimuth[..., None], namespace(self.azimuth, *values.values())
        waves = xp.stack([xp.cos(angle), xp.sin(angle)], axis=-1).reshape(*angle.shape[:2], -1)
        series = self.stacked(values) * (np.pi / 180.0)
        return self.altitudes + series[0] + waves @ series[1:]

    def hidden(self, values: Values) -> Float[Array, "runs products modes"]:
        """Effect of terrain with these values on the beams; differentiable."""
        altitude, n = self.altitude(values), self.patterns.shape[1]
        xp = namespace(altitude, self.patterns)
        sign = xp.where(altitude < 0.0, -1.0, 1.0)
        x = 2.0 * xp.minimum(sign * altitude, self.highest) / self.highest - 1.0
        nodes, weights = leggauss(n)
        # Legendre coefficients of Lagrange's polynomials, and of their integrals
        lagrange = legvander(nodes, n - 1).T * weights * (np.arange(n) + 0.5)[:, None]
        integrals = legint(lagrange, lbnd=-1) * (self.highest / 2.0)
        inside = sign[None] * legval(x[None], integrals[:, :, None, None], tensor=False)
        seen = self.patterns[None] * inside.swapaxes(0, 1)[:, None]
        return -_rings(n, self.highest).modes(seen, self.lmax)

    def modes(self, modes, values):
        """Beams behind terrain with these values, in every run."""
        return modes + (self.hidden(values) - self.before)

    def effect(self, model, values):
        """Use A of these beams; terrain emits as the hidden sky would at its temperature."""
        made = super().effect(model, values)
        return with_added(made, model.coupling @ self.uniform - made.coupling @ self.uniform)

    def linearised(self, model, centre):
        """Differentiate :meth:`effect`: only the sky minus the terrain's temperature matters."""
        of_sky = super().linearised(model, centre)
        return lambda sky: of_sky(np.asarray(sky) - self.uniform)
