"""Unknowns of instrument and sky: one function of their values, marginalised or sampled.

A systematic has unknowns with priors, and an effect: the model d = A m + n given their values, as a
function that JAX can differentiate. If sampled, the unknowns are sites of a NumPyro program, and
the model is this function of them. If marginalised, the function is expanded to first order about
values z_0 of all unknowns (in prior standard deviations) and a sky m_0, ::

    d = v(m, z) + n = v(m, z_0) + T (z - z_0) + n,    T = dv/dz at (m_0, z_0),    z ~ N(0, 1),

so that N gains T T^T, with a column of T for each unknown, and the data the mean -T z_0. Later
gains multiply T, too. If the data determine z_0 and m_0 in rounds, this is the Gaussian about the
joint mode of sky and unknowns (Gauss-Newton), without the term that couples z - z_0 and m - m_0.

That mode is away from the bulk of the posterior: a larger gain with a smaller sky fits as well, and
each of the n modes that the data determine gains by being smaller. With the sky integrated out,
ln p(d | z) contains the volume -ln|Lambda| / 2 besides the misfit. The volume has the slope
(Fisher's identity) ::

    g = -tr(C A^T N^-1 dA/dz) = -E[T(s)^T w],    s = C A^T w,    w ~ N(0, N^-1),

with the columns T(s) for a sky s. A prior mean of g in place of 0 has the same slope: with it,
rounds converge to the mode of p(z | d). C and N are those with z known: if they contained its
uncertainty, skies s would scatter along the directions that z hides. Skies s are maps of noise
alone, so that a few draws suffice. (Draws of N(0, C) would not: if an unknown moves an undetermined
mode into view of the data, they scatter without bound.)

Some classes override :meth:`Systematic.marginalised`: many Gaussian unknowns have a separate
covariance (gain drifts, :class:`AdditiveNoise`), errors of beams a covariance averaged over the
skies of the prior, and scales (:class:`Scale`) have no Gaussian term at all.
"""

from __future__ import annotations

import zlib
from abc import abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from operator import attrgetter
from statistics import NormalDist
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from lusee_bayes.core.arrays import Array, DataVector, Modes, Vector, namespace, on_device, scalar
from lusee_bayes.core.errors import InputError, require_known
from lusee_bayes.core.lazy import dist, numpyro
from lusee_bayes.core.section import Section
from lusee_bayes.instrument.coupling import BeamModes, DenseCoupling
from lusee_bayes.instrument.products import DataLayout
from lusee_bayes.linear.linear_gaussian import LinearGaussian
from lusee_bayes.noise import covariance as covariances
from lusee_bayes.sky.prior import IndependentPrior
from lusee_bayes.systematics.context import Around, Setup

# where programs sample the sky
SKY = "sky"
# with more unknowns than this beside an integrated sky, no exact Hessian guides their sampling:
# computing it takes two gradients of the evidence for each
MOST_COLLAPSED = 64

# true values in simulated data, by the names of their sites
Truth = dict[str, float | np.ndarray]
# the derivative T of the data, (data, n), for a sky
Slopes = Callable[[Modes], Float[Array, "data n"]]
# values of a systematic's unknowns, by the names of their sites
Values = Mapping[str, float | Float[Array, "..."]]


class Chart(eqx.Module):
    """One-to-one coordinates of several sites in which a posterior's ridges are straight.

    Values are unconstrained (numpyro's ``biject_to``). Sites that are not among :attr:`names` are
    passed on unchanged.

    Attributes
    ----------
    factorises : bool
        Whether it factorises matrices at every evaluation.
    """

    factorises: ClassVar[bool] = False

    @property
    @abstractmethod
    def names(self) -> tuple[str, ...]:
        """The sites whose coordinates it changes or needs."""

    @abstractmethod
    def to_values(self, x: Values) -> tuple[Values, Float[Array, ""]]:
        """Compute the sites' values.

        Parameters
        ----------
        x : mapping of array
            Coordinates by site.

        Returns
        -------
        values : dict of array
            Unconstrained values by site.
        log_det : () array
            ln|det| of their derivative by x.
        """

    @abstractmethod
    def from_values(self, values: Values) -> Values:
        """Compute the coordinates of unconstrained values by site."""


class Unknown(eqx.Module):
    """An unknown number, or several of the same kind: a site of programs.

    Attributes
    ----------
    name : str
        Of the site.
    mean, std : float
        Of the Gaussian prior of each.
    size : int or None
        Number of unknowns; None for a scalar.
    log : bool
        The logarithm is Gaussian: ``mean`` is the median, ``std`` that of the natural logarithm.
    low, high : float
        Ends of the domain, at which the prior is cut off.
    """

    name: str = eqx.field(static=True)
    mean: float | Float[Array, ""] = 0.0
    std: float | Float[Array, ""] = 1.0
    size: int | None = eqx.field(default=None, static=True)
    log: bool = eqx.field(default=False, static=True)
    low: float = eqx.field(default=-np.inf, static=True)
    high: float = eqx.field(default=np.inf, static=True)

    def prior(self) -> dist.Distribution:
        """Return the prior of all its numbers.

        Raises
        ------
        InputError
            If more than 0.25 % of the Gaussian lies outside the domain: the prior then allows
            impossible values.
        """
        mean, std, low, high = self.mean, self.std, self.low, self.high
        if np.isinf(low) and np.isinf(high):
            kind, centre = (dist.LogNormal, jnp.log) if self.log else (dist.Normal, jnp.asarray)
            prior = kind(centre(scalar(mean)), scalar(std))
            return prior if self.size is None else prior.expand([self.size]).to_event(1)
        cdf = NormalDist().cdf
        outside = cdf((low - mean) / std) + cdf((mean - high) / std)
        if outside > 0.0025:
            edge = f"at least {low:g}" if mean - low < high - mean else f"at most {high:g}"
            raise InputError(
                f"the prior of {self.name}, {mean:g} +- {std:g}, has {outside:.1%} of its weight "
                f"outside the allowed range ({edge}); give a smaller deviation, or move the mean"
            )
        ends = {name: end for name, end in (("low", low), ("high", high)) if np.isfinite(end)}
        return dist.TruncatedNormal(mean, std, **ends)

    def at(self, z: float | Float[Array, "..."]) -> float | Float[Array, "..."]:
        """Compute values from numbers in prior standard deviations from the prior mean."""
        off = self.std * z
        return self.mean * namespace(z).exp(off) if self.log else self.mean + off


class Systematic(eqx.Module):
    """Something unknown about the instrument or the sky.

    A subclass has :attr:`unknowns` and :meth:`effect`. For use in a scenario, it also has a
    section, its key, :meth:`build`, and a line in :mod:`.systematics.registered`.

    Attributes
    ----------
    unknowns : tuple of Unknown
        The sites, with their priors; a field or a property of the subclass.
    key : str
        Path of its section in a scenario, such as ``noise.gain``.
    section : type
        The schema of that section, if it is ``noise.KEY``.
    words : str
        Its name in messages.
    unit : str
        Of all unknowns; empty for pure numbers, or if their names contain it.
    draw : int or None
        Number folded into the seed of simulated data; by default one derived from the key.
    needs_sky : bool
        Whether the sky must be sampled with it, regardless of its number of unknowns.
    changes_coupling : bool
        Whether A depends on it: if not, A is made dense once.
    first_order : bool
        Whether :meth:`marginalised` expands the effect to first order.
    moves : bool
        Whether it expands about values and a sky that the data determine in rounds.
    moves_setup : bool
        Whether :meth:`moved` includes all effects of its true values on simulated data.
    scales_sky : bool
        Whether its effect is a factor of all visibilities.
    in_common : bool
        Whether all channels share the values of its unknowns.
    has_table : bool
        Whether reports have a separate table of its unknowns.
    learns : bool
        Whether a parameter of its prior is learned in rounds, as in :meth:`.FieldErrors.relearned`.
    """

    unknowns: ClassVar[tuple[Unknown, ...]] = ()
    section: ClassVar[type[Section]]
    draw: ClassVar[int | None] = None
    key, words, unit = "", "a systematic", ""
    changes_coupling, first_order = True, True
    needs_sky, moves, moves_setup, scales_sky, in_common, has_table, learns = (False,) * 7

    # --- in a scenario ---

    @classmethod
    def treatment(cls, scenario: Any) -> str | None:
        """Its treatment in a scenario; None if the scenario does not have it."""
        section = attrgetter(cls.key)(scenario)
        return None if section is None else section.treatment

    @classmethod
    def build(cls, section: Any, setup: Setup, around: Around) -> Systematic:
        """Build it from a scenario's section.

        Parameters
        ----------
        section : Section
            Of the type :attr:`section`.
        setup : Setup
            With the values of other unknowns in :attr:`Around.values`.
        around : Around
            The data, sky and values around which it may be built.
        """
        raise NotImplementedError(f"{cls.__name__} has no scenario's section")

    @classmethod
    def moved(cls, section: Any, setup: Setup, values: Values) -> Setup:
        """The setup with these values of the instrument and the old signal; by default the same."""
        return setup

    @classmethod
    def in_rounds(cls, section: Any) -> bool:
        """Whether a section makes it move, see :attr:`moves`."""
        return cls.moves

    @classmethod
    def octaves(cls, section: Any) -> float:
        """Number of octaves of frequency over which its unknowns keep their values.

        Zero if every channel has its own, infinity if all channels share one value.
        """
        return np.inf if cls.in_common else 0.0

    @classmethod
    def true_seed(cls, section: Any, scenario: Any) -> int:
        """Seed of the true values in simulated data, the instrument's if channels share them."""
        shared = scenario.instrument_seed if cls.octaves(section) else None
        return scenario.seed if shared is None else shared

    @classmethod
    def truth(cls, section: Any, setup: Setup, key: PRNGKeyArray) -> Truth:
        """Draw the true values in simulated data from their priors, except for given ones.

        Parameters
        ----------
        section : Section
        setup : Setup
        key : PRNG key
            Of :meth:`true_seed`.
        """
        built = cls.build(section, setup, Around())
        values = built.values(built.drawn(cls.own_key(key)))
        drawn = {name: value if value.ndim else float(value) for name, value in values.items()}
        said = getattr(section, "true_values", {})
        for name in said:
            require_known(f"{cls.key}.true_values has an unknown", name, drawn)
        return drawn | {name: float(value) for name, value in said.items()}

    @classmethod
    def own_key(cls, key: PRNGKeyArray) -> PRNGKeyArray:
        """The scenario's key, folded with a number of this systematic."""
        return jax.random.fold_in(key, cls.draw or zlib.crc32(cls.key.encode()))

    @classmethod
    def in_data(
        cls, section: Any, setup: Setup, model: LinearGaussian, truth: Truth, key: PRNGKeyArray
    ) -> LinearGaussian:
        """The model with the true values of simulated data.

        It is unchanged if :attr:`moves_setup`: its A already has the true values.

        Parameters
        ----------
        section : Section
        setup : Setup
            Moved to all true values (:meth:`moved`), as the model's A is.
        model : LinearGaussian
            Without it.
        truth : dict
            True values of all systematics.
        key : PRNG key
            Of the scenario's seed, for all other draws.
        """
        if cls.moves_setup:
            return model
        built = cls.build(section, setup, Around())
        return built.effect(model, {u.name: truth[u.name] for u in built.unknowns})

    # --- its unknowns ---

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all unknown numbers."""
        return tuple(
            name
            for u in self.unknowns
            for name in ([u.name] if u.size is None else [f"{u.name}_{k}" for k in range(u.size)])
        )

    def drawn(self, key: PRNGKeyArray) -> Float[np.ndarray, " n"]:
        """Draw all of them from N(0, 1): in prior standard deviations from the prior mean."""
        return np.asarray(jax.random.normal(key, (len(self.names),)))

    def _each(self, field: str) -> Vector:
        """A field of :class:`Unknown` for every number."""
        numbers = [np.full(u.size or 1, float(getattr(u, field))) for u in self.unknowns]
        return np.concatenate(numbers)

    @property
    def means(self) -> Vector:
        """Prior means, in the units of the names."""
        return self._each("mean")

    @property
    def stds(self) -> Vector:
        """Prior standard deviations."""
        return self._each("std")

    def inside(self, z: Vector) -> Vector:
        """The nearest numbers in the domains, with room for the steps of derivatives."""
        low, high = ((self._each(end) - self.means) / self.stds for end in ("low", "high"))
        return np.clip(z, low + STEP, high - STEP)

    def values(self, z: Float[Array, " n"]) -> dict[str, float | Float[Array, "..."]]:
        """Values by site, from numbers in prior standard deviations from the prior mean."""
        ends = np.cumsum([u.size or 1 for u in self.unknowns], dtype=int)
        parts = zip(self.unknowns, namespace(z).split(z, ends[:-1]), strict=False)
        return {u.name: u.at(part[0] if u.size is None else part) for u, part in parts}

    def stacked(self, values: Values) -> Float[Array, " n"]:
        """Values by site as one array."""
        xp = namespace(*values.values())
        return xp.concatenate([xp.atleast_1d(xp.asarray(values[u.name])) for u in self.unknowns])

    def in_units(self, z: Float[np.ndarray, " n"]) -> dict[str, float]:
        """Values by name, from numbers in prior standard deviations from the prior mean."""
        return dict(zip(self.names, (self.means + self.stds * z).tolist(), strict=True))

    def centre(self, values: Mapping[str, float]) -> Vector:
        """Numbers in prior standard deviations from the prior mean, from values by name.

        A number without a value is at its mean.
        """
        pairs = zip(self.names, self.means, strict=True)
        return np.array([values.get(name, mean) - mean for name, mean in pairs]) / self.stds

    def true(self, truth: Truth) -> dict[str, float]:
        """True values by name, from true values by site."""
        z = {u.name: (np.asarray(truth[u.name]) - u.mean) / u.std for u in self.unknowns}
        return self.in_units(self.stacked(z))

    def like_the_sky(self) -> tuple[tuple[str, ...], Float[np.ndarray, "parts n"]]:
        """Parts of it that may look like a uniform sky: words, and unit vectors of its unknowns."""
        labels = tuple(name.removesuffix("_k").replace("_", " ") for name in self.names)
        return labels, np.eye(len(labels))

    # --- its effect ---

    def effect(self, model: LinearGaussian, values: Values) -> LinearGaussian:
        """The model given values of the unknowns, differentiable in them.

        Parameters
        ----------
        model : LinearGaussian
            Without it.
        values : mapping of array
            By site.
        """
        raise NotImplementedError(f"{type(self).__name__} has no effect of its values")

    def linearised(self, model: LinearGaussian, centre: Vector) -> Slopes:
        """Prepare T, the derivative of the data by the unknowns in prior std's, for any sky.

        Parameters
        ----------
        model : LinearGaussian
            With all systematics before it.
        centre : (n,) array
            Expansion point, in prior standard deviations.

        Returns
        -------
        callable
            Computes the (data, n) array T, in K, for a (modes,) sky in K.
        """

        def columns(sky: Modes) -> Float[Array, "data n"]:
            coupling, prior, unit = model.coupling, model.prior, np.ones(1)
            if not self.changes_coupling:  # one mode: the strength of this sky
                coupling, prior = DenseCoupling((coupling @ sky)[:, None]), IndependentPrior(unit)
                sky = unit
            noise = covariances.DiagonalCovariance(np.ones(model.n_data))
            bare = LinearGaussian(coupling, prior, noise, model.offset)
            return np.asarray(_columns(*on_device((self, bare, sky, centre))))

        return columns

    def behind(self, gains: DataVector) -> Systematic:
        """The same with its term of N multiplied by later gains; by default unchanged.

        Parameters
        ----------
        gains : (data,) array
        """
        return self

    def chart(self, model: LinearGaussian) -> Chart | None:
        """Return coordinates of its sites, and of the sky's, in which ridges are straight.

        Parameters
        ----------
        model : LinearGaussian
            To which :meth:`sampled` is applied.

        Returns
        -------
        Chart or None
            None if it needs no such coordinates.
        """
        return None

    def marginalised(self, model: LinearGaussian) -> LinearGaussian:
        """Integrate it out of the model, as a term of N (and of the mean).

        Here it is to first order about the prior means of the unknowns and of the sky, without
        later systematics; :class:`Expanded` is about any values.

        Parameters
        ----------
        model : LinearGaussian
            The model without it.

        Returns
        -------
        LinearGaussian
            The model averaged over its prior.
        """
        around = Around(sky=model.prior.colour(model.prior.white_mean))
        return Expanded.at(self, model, around).marginalised(model)

    def differences(
        self, made: Callable[[Values], Array], centre: Vector
    ) -> Iterator[Float[np.ndarray, "..."]]:
        """Derivatives of a function of the values by the unknowns in prior std's, one by one."""
        for step in STEP * np.eye(len(centre)):
            up, down = (np.asarray(made(self.values(centre + way))) for way in (step, -step))
            yield (up - down) / (2.0 * STEP)

    def averaged(self, model: LinearGaussian) -> LinearGaussian:
        """The same, except that N does not change."""
        return replace(self.marginalised(model), noise=model.noise)

    def sampled(self, model: LinearGaussian) -> LinearGaussian:
        """Sample its unknowns; call this inside a NumPyro program.

        Parameters
        ----------
        model : LinearGaussian
            The model without it.

        Returns
        -------
        LinearGaussian
            The model given the values of its sites.
        """
        values = {u.name: numpyro.sample(u.name, u.prior()) for u in self.unknowns}
        return self.effect(model, values)


class Marginalised(eqx.Module):
    """A systematic as part of N; among sampled ones it keeps its place, but has no site.

    Attributes
    ----------
    systematic : Systematic
        The systematic.
    """

    systematic: Systematic | Marginalised

    names, needs_sky = (), False

    @property
    def changes_coupling(self) -> bool:
        """Whether A depends on it."""
        return self.systematic.changes_coupling

    def marginalised(self, model: LinearGaussian) -> LinearGaussian:
        """The model with it in N."""
        return self.systematic.marginalised(model)

    def sampled(self, model: LinearGaussian) -> LinearGaussian:
        """The same: no site is sampled."""
        return self.marginalised(model)


class Expanded(Marginalised):
    """A systematic to first order about values, as part of N.

    Attributes
    ----------
    centre : (n,) array
        z_0, in prior standard deviations.
    columns : (data, n) array
        T: the effect of one prior standard deviation of each unknown on the data, in K.
    expected : (n,) array
        Shifted prior mean, in prior standard deviations.
    shift : (data,) array
        T (expected - z_0), before later gains.
    """

    centre: Float[Array, " n"]
    columns: Float[Array, "data n"]
    expected: Float[Array, " n"]
    shift: DataVector

    @classmethod
    def at(
        cls,
        systematic: Systematic,
        model: LinearGaussian,
        around: Around,
        gains: DataVector | None = None,
    ) -> Expanded:
        """Expand a systematic about values and a sky.

        Parameters
        ----------
        systematic : Systematic
        model : LinearGaussian
            With all systematics before it, at their values.
        around : Around
            The sky m_0, and values of the unknowns by name; others are at their prior means.
        gains : (data,) array, optional
            Later gains.
        """
        centre = systematic.centre(around.values or {})
        slopes = systematic.linearised(model, centre)
        later, expected = 1.0 if gains is None else gains, np.zeros(len(centre))
        if systematic.moves and around.volume is not None:
            still = slopes(np.zeros(model.prior.size))  # of all but the sky
            *terms, doubt = around.volume
            slope = [(slopes(s) - still).T @ (later * w) for s, w in zip(*terms, strict=True)]
            del still
            # less where the mean over terms does not exceed ``doubt`` standard errors by far
            mean, error = np.mean(slope, 0), doubt * np.std(slope, 0, ddof=1) / np.sqrt(len(slope))
            expected = -mean * np.clip(1.0 - (error / np.where(mean, mean, np.inf)) ** 2, 0.0, 1.0)
        columns = slopes(np.asarray(around.sky))
        shift = columns @ (expected - centre)
        columns = columns if gains is None else columns * gains[:, None]
        return cls(systematic, centre, columns, expected, shift)

    def marginalised(self, model: LinearGaussian) -> LinearGaussian:
        """Apply the effect at z_0, add T T^T to N and T (expected - z_0) to the mean."""
        noise = model.noise + covariances.LowRankCovariance(self.columns, self.systematic.words)
        at_centre = self.systematic.effect(model, self.systematic.values(self.centre))
        return with_added(replace(at_centre, noise=noise), self.shift)


@eqx.filter_jit
def _columns(systematic, model, sky, centre):
    return jax.jacfwd(lambda z: systematic.effect(model, systematic.values(z)).predict(sky))(centre)


# step of a derivative, in prior standard deviations: exact to 1e-8 / 6 times the third derivative
STEP = 1e-4


class ChangedBeams(Systematic):
    """Something that changes the beams; a subclass has :meth:`modes`."""

    moves: ClassVar[bool] = True

    @abstractmethod
    def modes(self, modes: BeamModes, values: Values) -> BeamModes:
        """Beams in the frame of the lander with values of the unknowns, from beams without them."""

    def effect(self, model, values):
        """Use A of these beams."""
        coupling = model.coupling
        return replace(model, coupling=coupling.of(modes=self.modes(coupling.modes, values)))

    def linearised(self, model, centre):
        """Differentiate the beams."""
        coupling, beams = model.coupling, np.asarray(model.coupling.modes)
        slopes = self.differences(lambda values: self.modes(beams, values), centre)
        see, layout = coupling.along(slopes), coupling.layout
        response = 1.0 if coupling.response is None else coupling.response
        return lambda sky: np.stack([layout.gather(one) * response for one in see(sky)], axis=1)


class AdditiveNoise(Systematic):
    """Gaussian noise with a separate covariance, added to the data.

    A new kind is a subclass with one method, :meth:`covariance`.

    Attributes
    ----------
    name : str
        Its site is ``NAME_noise``.
    layout : DataLayout
        The data that the covariance is over.
    """

    changes_coupling, first_order = False, False

    name: str = eqx.field(static=True)
    layout: DataLayout

    @abstractmethod
    def covariance(self) -> covariances.Covariance:
        """Return its covariance over the entries of the data vector, in K^2."""

    @property
    def unknowns(self) -> tuple[Unknown, ...]:
        return (Unknown(f"{self.name}_noise", size=self.covariance().rank),)

    def effect(self, model, values):
        """Add the noise that (rank,) unit normals give."""
        return with_added(model, self.covariance().colour(values[f"{self.name}_noise"]))

    def marginalised(self, model: LinearGaussian) -> LinearGaussian:
        """Add the covariance to N."""
        return replace(model, noise=model.noise + self.covariance())


class LowRankNoise(AdditiveNoise):
    """Noise U U^T.

    Attributes
    ----------
    root : (data, rank) array
        U, in K.
    """

    root: Float[Array, "data rank"]

    def behind(self, gains: DataVector) -> LowRankNoise:
        return replace(self, root=self.root * np.asarray(gains)[:, None])

    def covariance(self) -> covariances.LowRankCovariance:
        return covariances.LowRankCovariance(self.root, self.words)


class Temperatures(Systematic):
    """Temperatures whose emission adds to the data of any sky; independent Gaussian priors.

    Their means are part of the background.

    Attributes
    ----------
    unknowns : tuple of Unknown
        With names that end with ``_k``, in K.
    per_kelvin : (data, n) array
        Contribution of each kelvin to the data.
    """

    unit, changes_coupling = "K", False

    unknowns: tuple[Unknown, ...] = eqx.field()
    per_kelvin: Float[Array, "data n"]

    def effect(self, model, values):
        """Add the emission of their deviations from the means."""
        deviations = {u.name: values[u.name] - u.mean for u in self.unknowns}
        return with_added(model, self.per_kelvin @ self.stacked(deviations))


class Scale(Systematic):
    """A systematic without a Gaussian term: marginalised, it stays at its median."""

    changes_coupling, first_order = False, False

    def marginalised(self, model: LinearGaussian) -> LinearGaussian:
        """Return the model unchanged."""
        return model


def sky_is_sampled(systematics: Sequence[Systematic | Marginalised]) -> bool:
    """Whether they have too many unknowns in total to marginalise the sky while sampling."""
    n = sum(len(systematic.names) for systematic in systematics)
    return n > MOST_COLLAPSED or any(systematic.needs_sky for systematic in systematics)


def with_added(model: LinearGaussian, signal: DataVector) -> LinearGaussian:
    """Add a signal in K to the mean of a model's data."""
    return replace(model, offset=signal if model.offset is None else model.offset + signal)


def multiplied(model: LinearGaussian, response: DataVector) -> LinearGaussian:
    """Multiply a model's sky, offset and unknowns in N by gains."""
    offset = None if model.offset is None else model.offset * response
    coupling, noise = model.coupling.with_response(response), model.noise
    if isinstance(noise, covariances.LowRankUpdate):
        root = (noise.update.root.T * response[None]).T
        noise = replace(noise, update=replace(noise.update, root=root))
    return replace(model, coupling=coupling, noise=noise, offset=offset)
