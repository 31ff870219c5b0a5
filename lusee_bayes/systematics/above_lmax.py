"""The sky above the map's lmax: the antennas see it, and it is integrated out.

::

    d = A m + A' m' + n,    m' ~ N(mu', S'),

where m' are the modes from lmax + 1 up to the highest ell seen (:meth:`AboveLmaxSection.top`), S'
is their part of the prior's covariance, and A' is that of the instrument as inferred. Integrating
m' out adds A' mu' to the mean of the data, and A' S' A'^T to N. This omits directions that together
change chi^2 by less than one, and the correlation of m' with m, through which the data constrain m'
better than N assumes. If the prior is learned, S' is the mean over its uncertain parameters, those
learned up to lmax and, for smaller scales, further ones from the hyperprior, times the factor that
the data prefer (:func:`.variance_factor`).

Simulated data contain the modes of the scenario's sky up to the same ell.
"""

from typing import Annotated

import numpy as np
from pydantic import Field

from lusee_bayes.core import harmonics, linalg
from lusee_bayes.core.arrays import DataVector, ModesMatrix
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.section import Section, Treatment
from lusee_bayes.instrument.coupling import CouplingMatrix
from lusee_bayes.linear.normal_matrix import normal_matrix
from lusee_bayes.noise.covariance import Covariance
from lusee_bayes.systematics.context import Above, Around, Setup
from lusee_bayes.systematics.systematic import LowRankNoise, with_added

# largest change of chi^2 by all omitted directions together
LEFT_OUT = 1.0
# most numbers in its effect on the data: 4 GB
MOST_NUMBERS = 5e8


class AboveLmaxSection(Section):
    """The sky above the map's lmax.

    Attributes
    ----------
    margin : int
        Number of multipoles above lmax that the antennas can see.
    least_lmax : int
        Minimum value of the highest ell that the antennas see.
    treatment : {"marginalised", "sampled", "ignored"}
        Add its covariance to N, sample it with the map, or end the model at lmax.
    """

    margin: Annotated[int, Field(ge=1, le=64)] = 16
    least_lmax: Annotated[int, Field(ge=0, le=harmonics.LARGEST_LMAX)] = 63
    treatment: Treatment = "marginalised"

    def top(self, lmax: int) -> int:
        """Highest ell that is seen."""
        return min(max(lmax + self.margin, self.least_lmax), harmonics.LARGEST_LMAX)


class AboveLmax(LowRankNoise):
    """The contribution of the sky above lmax to the data; its root is A' S'^(1/2).

    Attributes
    ----------
    mean : (data,) array
        A' mu', in K.
    """

    key, section, words = "noise.above_lmax", AboveLmaxSection, "the sky above lmax"

    mean: DataVector

    @classmethod
    def build(cls, section: AboveLmaxSection, setup: Setup, around: Around) -> "AboveLmax":
        return cls("above_lmax", setup.layout, *setup.above.seen)

    @classmethod
    def truth(cls, section, setup, key):
        """Nothing: the true values are the scenario's sky, not drawn."""
        return {}

    @classmethod
    def in_data(cls, section, setup, model, truth, key):
        """Add the modes of the scenario's sky."""
        above = setup.above
        below = np.zeros(above.coupling.shape[1] - len(above.modes))
        return with_added(model, above.coupling @ np.concatenate([below, above.modes]))

    def effect(self, model, values):
        return with_added(super().effect(model, values), self.mean)

    def marginalised(self, model):
        """Add the covariance to N, and the mean to that of the data."""
        return with_added(super().marginalised(model), self.mean)


def sky_above(
    setup: Setup, coupling: CouplingMatrix, noise: Covariance, learned: ModesMatrix | None = None
) -> Above:
    """Compute the possible contribution of the sky above lmax to the data.

    Parameters
    ----------
    setup : Setup
    coupling : CouplingMatrix
        A of all modes up to the highest ell.
    noise : Covariance
        Of the radiometer.
    learned : (modes, modes) array, optional
        Prior covariance of all modes, learned from the data, in K^2; by default the expected one.
    """
    scenario, n, above, lmax = setup.scenario, setup.prior.size, setup.above, coupling.lmax
    if above is None:
        sky = scenario.sky.at(scenario.frequency_mhz, lmax)
        family = scenario.prior.family(scenario.frequency_mhz, lmax)
        modes = np.asarray(sky.modes)[n:]
    else:
        modes, family = above.modes, above.family
    if family is None:
        prior = scenario.prior.prior(sky)
        covariance, mean = prior.covariance(), prior.mean
    else:
        covariance, mean = learned, family.mean
        if learned is None:
            covariance = family.at(family.hyperprior.start()).covariance
    covariance = np.asarray(covariance)[n:, n:]
    root = linalg.checked_cholesky("the prior above lmax", covariance)
    if noise.size < len(root):  # of few data: what their combinations see
        white = np.asarray(noise.factor().whiten(np.asarray(coupling.dense())[:, n:]))
        information, rows = (white**2).sum(0), linalg.times_lower(white, root, transpose=False)
        combinations = linalg.main_directions(rows @ rows.T, LEFT_OUT)
        directions = np.linalg.qr(rows.T @ combinations)[0]
    else:
        seen = np.asarray(normal_matrix(coupling, noise))[n:, n:]
        information = np.diagonal(seen)
        directions = linalg.main_directions(linalg.sandwich(seen, root), LEFT_OUT)
    power = information * np.diagonal(covariance)
    power = np.add.reduceat(power, np.arange(scenario.lmax + 1, lmax + 1) ** 2 - n)
    if (n_data := noise.size) * directions.shape[1] > MOST_NUMBERS:
        raise InputError(f"its effect on {n_data:,} data needs too much memory; average the data")
    directions = np.pad(root @ directions, ((n, 0), (0, 0)))
    expected = np.zeros(len(directions)) if mean is None else np.array(mean)
    expected[:n] = 0.0
    return Above(coupling, modes, family, covariance, directions, expected, power)
