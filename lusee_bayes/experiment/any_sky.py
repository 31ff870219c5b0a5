"""The residual chi^2 of data, what no sky absorbs, with the data or the model changed."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from lusee_bayes.core.arrays import on_host
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.harmonics import lmax_of, mean_over_m, n_modes
from lusee_bayes.experiment.mistakes import DataMistake
from lusee_bayes.experiment.model import full_model
from lusee_bayes.experiment.setup import Setup
from lusee_bayes.experiment.terms import Around
from lusee_bayes.instrument.beams import ProductBeams
from lusee_bayes.instrument.coupling import Coupling, CouplingMatrix
from lusee_bayes.instrument.observation import Observation
from lusee_bayes.instrument.pointing import Pointing
from lusee_bayes.instrument.products import auto_indices
from lusee_bayes.instrument.visibilities import Visibilities
from lusee_bayes.linear.fit import ChiSquare
from lusee_bayes.linear.information import Information
from lusee_bayes.linear.metrics import expected_chi2
from lusee_bayes.linear.model import LinearGaussian
from lusee_bayes.linear.posterior import Posterior
from lusee_bayes.linear.split import WIDER, with_sky
from lusee_bayes.sky.priors import HarmonicPrior


@dataclass(frozen=True)
class UnderAnySky:
    """Data, and the model that their residual chi^2 is computed in, under a wide prior.

    Attributes
    ----------
    setup : Setup
    data : Visibilities
    model : LinearGaussian
        Of these data.
    spectrum : (ells,) array
        C_ell of the wide prior, in K^2.
    """

    setup: Setup
    data: Visibilities
    model: LinearGaussian
    spectrum: Float[np.ndarray, " ells"]

    @classmethod
    def of(cls, setup: Setup, data: Visibilities, model: LinearGaussian) -> UnderAnySky:
        """Under a prior that allows any sky, as bright as the data ask for."""
        return cls(setup, data, on_host(model), _any_sky(setup, data))

    def wide(self, coupling: Coupling) -> tuple[ChiSquare, Posterior]:
        """Residual chi^2, and the posterior under the wide prior."""
        n_ells = lmax_of(coupling.shape[1]) + 1
        more = max(0, n_ells - len(self.spectrum))
        spectrum = np.pad(self.spectrum, (0, more), mode="edge")[:n_ells]
        information, posterior = Information.of(
            coupling,
            HarmonicPrior(spectrum),
            self.model.noise,
            self.model.offset,
            np.asarray(self.data.data),
        )
        posterior, n = on_host(posterior), self.model.n_data
        chi2 = float(information.chi2(posterior.mean) + posterior.prior_chi2())
        degrees = n - with_sky(n - expected_chi2(posterior, n))
        return ChiSquare(chi2, float(degrees)), posterior

    def under(self, beams: ProductBeams, observation: Observation, pointing: Pointing) -> ChiSquare:
        """Residual chi^2 with other beams or another observation.

        ``pointing`` is that of the data's own observation, up to the ell that counts.
        """
        lmax = len(pointing.pole_from_galactic.blocks) - 1
        if (observation.times == self.setup.observation.times).all():
            pointing = pointing.placed(observation)
        else:
            pointing = Pointing.of(observation, lmax)
        modes = np.asarray(beams.modes)[:, : n_modes(lmax)]
        beams = ProductBeams(modes, beams.frequency_mhz)
        return self.wide(CouplingMatrix.build(beams, pointing, self.data.layout))[0]

    def without(self, mistake: DataMistake) -> ChiSquare:
        """Residual chi^2 of the data without a mistake, with N for them."""
        layout = self.data.layout
        right = np.asarray(layout.gather(mistake.undone(filled(self.data))))
        data = replace(self.data, data=right)
        try:
            model = on_host(full_model(self.setup, Around(data)))
        except InputError:  # without it, some auto is not positive
            return ChiSquare(np.inf, float(layout.size))
        return replace(self, data=data, model=model).wide(model.coupling)[0]


def _any_sky(setup: Setup, data: Visibilities) -> Float[np.ndarray, " ells"]:
    """C_ell of a prior that allows any sky, as bright as the data ask for, in K^2."""
    prior = on_host(setup.prior if setup.family is None else setup.family.expected())
    power = np.asarray(prior.variance())
    if prior.white_mean is not None:
        power = power + np.asarray(prior.colour(prior.white_mean)) ** 2
    autos = auto_indices(setup.beam_source.n_ports)
    modelled = float(np.median(np.asarray(setup.signal)[autos]))
    brighter = np.nanmedian(np.asarray(data.grid())[autos]) / modelled
    return mean_over_m(power) * (WIDER * np.fmax(1.0, brighter)) ** 2


def filled(data: Visibilities) -> Float[np.ndarray, "products times"]:
    """The data on the full grid, absent samples interpolated in time."""
    grid = np.array(data.grid())
    times = np.arange(grid.shape[1])
    for row in grid:
        there = np.isfinite(row)
        row[~there] = np.interp(times[~there], times[there], row[there]) if there.any() else 0.0
    return grid
