"""What is known of a channel besides its posterior."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from lusee_bayes.experiment.experiment import Experiment
from lusee_bayes.experiment.rounds import Inference
from lusee_bayes.linear.fit import ChiSquare
from lusee_bayes.linear.metrics import highest_altitude
from lusee_bayes.results.draws import doubts
from lusee_bayes.results.unknowns import Unknowns


@dataclass(frozen=True)
class Observed:
    """What is known of a channel besides its posterior: for :func:`channel_of_information`.

    Attributes
    ----------
    frequency_mhz : float
    prior_std : (modes,) array
        Of the channel's own prior, in K.
    truth : (modes,) array or None
    highest_altitude : (pixels,) array
    n_missing, rounds : int
    instrument : ChiSquare
        What no sky explains of the channel's own data.
    doubts : tuple of str
    unknowns : Unknowns or None
        Receivers, ground and gain table, where the model has them.
    """

    frequency_mhz: float
    prior_std: Float[np.ndarray, " modes"]
    truth: Float[np.ndarray, " modes"] | None
    highest_altitude: Float[np.ndarray, " pixels"]
    n_missing: int
    rounds: int
    instrument: ChiSquare
    doubts: tuple[str, ...] = ()
    unknowns: Unknowns | None = None

    @classmethod
    def of(
        cls,
        experiment: Experiment,
        inference: Inference,
        instrument: ChiSquare,
        unknowns: Unknowns | None = None,
    ) -> Observed:
        """Of an experiment, and what no sky explains of its data."""
        data, nside = experiment.data, experiment.scenario.map_nside
        return cls(
            experiment.scenario.frequency_mhz,
            np.sqrt(np.asarray(experiment.setup.prior.variance())),
            None if data.truth is None else np.asarray(data.truth),
            highest_altitude(data.observation, nside),
            data.n_missing,
            inference.rounds,
            instrument,
            doubts(experiment, inference),
            unknowns,
        )
