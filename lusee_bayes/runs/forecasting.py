"""The information in an observation, from the posterior covariance alone: no data are needed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from lusee_bayes.core.arrays import namespace
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.harmonics import sum_over_m
from lusee_bayes.core.linalg import solve_lower
from lusee_bayes.experiment.model import full_model
from lusee_bayes.experiment.setup import Setup, set_up
from lusee_bayes.experiment.terms import Around, pointing_offsets
from lusee_bayes.instrument.layout import DataLayout
from lusee_bayes.instrument.products import all_products
from lusee_bayes.linear.metrics import effective_resolution_deg, prior_fraction_per_ell
from lusee_bayes.linear.model import LinearGaussian
from lusee_bayes.linear.posterior import Posterior
from lusee_bayes.linear.templates import template_amplitudes
from lusee_bayes.results.forecast import Forecast, Variation


def expected_snr_squared(posterior: Posterior) -> Float[np.ndarray, " ells"]:
    """sum_m (S - C) / sum_m C for each ell, of a posterior over harmonic coefficients.

    NaN at an ell where the prior has no power.
    """
    prior = sum_over_m(posterior.prior.variance())
    left = sum_over_m(posterior.std() ** 2)
    ratio = np.divide(prior, left, out=np.full_like(prior, np.nan), where=left > 0)
    return ratio - 1.0


def informed_modes(posterior: Posterior) -> int:
    """How many eigen-directions of C relative to S keep less than half of the prior's variance.

    Counted on the covariance of the whitened sky, whose eigenvalues lie between 0 and 1: on
    Lambda, whose largest is 1e13, rounding would blur the threshold.
    """
    xp = namespace(posterior.lower)
    lower = xp.tril(posterior.lower)
    half = np.asarray(solve_lower(lower, xp.eye(lower.shape[0]), transpose=False))
    return int((np.linalg.eigvalsh(half.T @ half) < 0.5).sum())


def without_ports(setup: Setup, lost: Sequence[int]) -> Setup:
    """The setup with every product of the ``lost`` ports flagged at all times.

    Raises
    ------
    InputError
        For a port that does not exist, or if none is left.
    """
    layout = setup.layout
    n_ports = round(np.sqrt(layout.n_products))
    for port in lost:
        if not 0 <= port < n_ports:
            raise InputError(f"there is no port {port} to lose; ports are 0 to {n_ports - 1}")
    dead = np.array([p.i in lost or p.j in lost for p in all_products(n_ports)])
    left = DataLayout.from_flags(~np.asarray(layout.present) | dead[:, None])
    instrument = replace(setup.instrument, layout=left)
    coupling = instrument.coupling_of(setup.beams)
    return replace(setup, instrument=instrument, coupling=coupling)


def expected_posterior(setup: Setup) -> Posterior:
    """The posterior of a setup, of which all but the mean is known without data.

    N is the model's, with marginalised systematics and noise levels from the modelled sky.
    """
    return _expected(setup)[1]


def _expected(setup: Setup) -> tuple[LinearGaussian, Posterior]:
    model = full_model(setup)
    # the covariance is that of any data; these are the shortest to write
    return model, model.condition(np.zeros(model.n_data))


def expected_offsets(setup: Setup, model: LinearGaussian, posterior: Posterior) -> dict[str, float]:
    """Expected standard deviations of clock and pointing, in the units that their names end with.

    To first order about the scenario's sky and no offsets; empty where the model has none.
    """
    section = setup.scenario.noise.pointing
    if section is None or section.treatment == "ignored":
        return {}
    offsets = pointing_offsets(setup, Around())
    no_data = np.zeros(model.n_data)
    amplitudes = template_amplitudes(model, posterior, no_data, offsets.templates)
    return offsets.in_units(amplitudes.std)


def forecast(variation: Variation) -> Forecast:
    """Build A, S and N of a variation and take the numbers from its posterior covariance.

    Raises
    ------
    InputError
        With the variation's name, for whatever is wrong with its scenario.
    """
    try:
        setup = set_up(variation.scenario)
        if variation.lost:
            setup = without_ports(setup, variation.lost)
        model, posterior = _expected(setup)
        return Forecast(
            variation=variation,
            days=float(setup.observation.live_s.sum()) / 86400.0,
            n_data=setup.layout.size,
            information_bits=float(posterior.information_bits()),
            modes=informed_modes(posterior),
            snr_squared=expected_snr_squared(posterior),
            resolution_deg=effective_resolution_deg(prior_fraction_per_ell(posterior)),
            offsets=expected_offsets(setup, model, posterior),
        )
    except InputError as error:
        raise InputError(f"{variation.source}, {variation.name}: {error}") from error
