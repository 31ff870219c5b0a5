"""What every term of N answers, and the visibilities that N is built around.

A term says of one systematic how the model treats it, and what simulated data hold of it.

Radiometer noise and gain drifts are built around visibilities. Those of the modelled sky are right
where it is the true one, as for simulated data. Measured visibilities hold their own noise: N is
small where an auto came out low, and the map is pulled there. With n times of B tau samples each,
and the exact covariance of p antennas' products, a common amplitude moves by up to
4 p sqrt(n / (B tau)) of its standard deviation. Drifts are not small, and stay in the measured
visibilities. What neither troubles is the map's own prediction, in rounds
(:mod:`lusee_bayes.experiment.rounds`).
"""

from __future__ import annotations

import zlib
from abc import ABC
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from operator import attrgetter
from typing import Any, ClassVar

import jax
import numpy as np
from jaxtyping import PRNGKeyArray

from lusee_bayes.core.arrays import DataVector, Grid, Modes
from lusee_bayes.core.errors import InputError
from lusee_bayes.experiment.noise_sections import NoiseAbout
from lusee_bayes.experiment.scenario import Scenario
from lusee_bayes.experiment.section import is_modelled
from lusee_bayes.experiment.setup import Setup
from lusee_bayes.instrument.products import all_products, auto_indices
from lusee_bayes.instrument.schedule import without_gaps
from lusee_bayes.instrument.visibilities import Visibilities
from lusee_bayes.systematics.systematic import AdditiveNoise, Systematic

# true values of what simulated data hold, by the names of their sites
Truth = dict[str, float | np.ndarray]
# systematics, each with what is done about it
Treated = list[tuple[str, Systematic]]


@dataclass(frozen=True)
class Around:
    """What a systematic may be built around, besides the setup.

    Attributes
    ----------
    data : Visibilities or None
        The measured data; None before there are any.
    visibilities : (products, times) array or None
        Visibilities for the gain term, in K; None for those that the scenario names.
    sky : (modes,) array or None
        For the templates of clock and pointing, in K; None for the scenario's.
    values : mapping of float or None
        Of unknowns that are taken to first order about values, clock and pointing or errors of
        the gain table, by name; None for their prior means.
    seen : (data,) array or None
        Visibilities before the gains of the gain table, in K; None for the measured ones.
    freedom : (data,) array or None
        Share of each datum that sky and others follow, for the gain table; None for none.
    """

    data: Visibilities | None = None
    visibilities: Grid | None = None
    sky: Modes | None = None
    values: Mapping[str, float] | None = None
    seen: DataVector | None = None
    freedom: DataVector | None = None


class Term(ABC):
    """One systematic of a scenario.

    A subclass has :meth:`systematics`, and for simulated data :meth:`drawn` and :meth:`distorted`,
    which are asked where the scenario has its section; or it has the methods that ask them.

    Attributes
    ----------
    key : str
        Path of its section in a scenario, such as ``noise.gain``.
    remedy : str
        What may help where it :meth:`moves` and rounds do not settle.
    """

    key: ClassVar[str]
    remedy: ClassVar[str] = ""

    def section(self, scenario: Scenario) -> Any:
        """What the scenario says of it; None if it has nothing of it."""
        return attrgetter(self.key)(scenario)

    def build(self, setup: Setup, around: Around) -> Treated:
        """Treatment and systematic, for all that the scenario has of it and does not ignore."""
        section = self.section(setup.scenario)
        if not is_modelled(section):
            return []
        return [(section.treatment, found) for found in self.systematics(setup, section, around)]

    def systematics(self, setup: Setup, section: Any, around: Around) -> list[Systematic]:
        """All that the model has of it."""
        raise NotImplementedError

    def moves(self, scenario: Scenario) -> bool:
        """Tell whether it is to first order about values that the data tell, found in rounds."""
        return False

    def truth(self, setup: Setup, key: PRNGKeyArray) -> Truth:
        """True values in simulated data, drawn from their priors.

        Parameters
        ----------
        setup : Setup
        key : PRNG key
            Of the scenario's seed; each term folds it with a number of its own.
        """
        section = self.section(setup.scenario)
        return {} if section is None else self.drawn(setup, section, key)

    def drawn(self, setup: Setup, section: Any, key: PRNGKeyArray) -> Truth:
        """:meth:`truth` of its section."""
        return {}

    def distort(self, visibilities: Grid, setup: Setup, truth: Truth, key: PRNGKeyArray) -> Grid:
        """The visibilities in K that the true values make of those without them."""
        if self.section(setup.scenario) is None:
            return visibilities
        return self.distorted(visibilities, setup, truth, key)

    def distorted(self, visibilities: Grid, setup: Setup, truth: Truth, key: PRNGKeyArray) -> Grid:
        """:meth:`distort` where the scenario has its section."""
        return visibilities


class AdditiveTerm(Term):
    """A noise term with a covariance of its own: it is built, drawn and added as all of them are.

    Parameters
    ----------
    key : str
        Path of its section in the scenario, an entry of which has to be ``treatment``.
    make : callable
        ``make(setup, section)``: the :class:`AdditiveNoise`.
    """

    def __init__(self, key: str, make: Callable[[Setup, Any], AdditiveNoise]):
        self.key = key
        self._make = make

    def systematics(self, setup: Setup, section: Any, around: Around) -> list[Systematic]:
        return [self._make(setup, section)]

    def distorted(self, visibilities: Grid, setup: Setup, truth: Truth, key: PRNGKeyArray) -> Grid:
        own = jax.random.fold_in(key, zlib.crc32(self.key.encode()))
        return self._make(setup, self.section(setup.scenario)).distort(visibilities, own)


# in standard deviations of a common amplitude
HARMLESS_BIAS = 0.1


def radiometer_about(setup: Setup) -> NoiseAbout:
    """Which visibilities set the level of the radiometer noise."""
    chosen = setup.scenario.noise.radiometer.temperature
    if chosen is not None or not setup.measured:
        return chosen or "model"
    harmless = _has_autos(setup) and common_bias(setup) < HARMLESS_BIAS
    return "measured" if harmless else "posterior"


def gains_about(setup: Setup) -> NoiseAbout:
    """Which visibilities the covariance of gain drifts is built around."""
    return setup.scenario.noise.gain.visibilities or ("posterior" if setup.measured else "model")


def common_bias(setup: Setup) -> float:
    """How far noise in measured visibilities moves a common amplitude, in standard deviations."""
    section, observation = setup.scenario.noise.radiometer, setup.observation
    if setup.calibration is not None:
        samples = np.asarray(setup.calibration.n_averaged)
    else:
        samples = section.bandwidth_hz * section.duty_cycle * np.asarray(observation.live_s)
    n_antennas = setup.beam_source.n_ports
    ratio = section.factor * observation.n_times / float(np.median(samples))
    return float(4.0 * n_antennas * np.sqrt(ratio))


def _has_autos(setup: Setup) -> bool:
    """Whether every port that was used has its auto somewhere."""
    seen, n = np.asarray(setup.layout.present).any(1), setup.beam_source.n_ports
    products = np.array(all_products(n), dtype=object)
    used = set(products[seen, :2].ravel())
    return all(seen[k] for port, k in enumerate(auto_indices(n)) if port in used)


def noise_visibilities(setup: Setup, around: Around, about: NoiseAbout) -> Grid:
    """The visibilities that a term of N is built around, in K.

    Before there is a prediction it is the measured ones', or, if autos that noise depends on were
    never measured, the modelled sky's.
    """
    if about == "model" or around.data is None:
        return setup.signal
    if about == "posterior" and around.visibilities is not None:
        return around.visibilities
    if about == "posterior" and not _has_autos(setup):
        return setup.signal
    return measured_visibilities(around.data, setup.signal)


def measured_visibilities(data: Visibilities, model: Grid) -> Grid:
    """Visibilities that set a noise level: the measured ones, absent samples interpolated.

    A time without any sample takes the model's (it enters nothing).

    Raises
    ------
    InputError
        If an auto was never measured, but other products of its port were.
    """
    some = data.layout.present.any(0)
    try:
        measured = without_gaps(data.layout.scatter(data.data), data.layout)
    except InputError as error:
        raise InputError(
            f"{error}, or use noise.radiometer.temperature=posterior and "
            "noise.gain.visibilities=posterior"
        ) from error
    return np.where(some[None], measured, model)
