"""The model of a setup, and data simulated from it.

d = A m + n has radiometer noise alone, or every systematic. Simulated data hold the true
instrument, its drifts and fluxes, drawn with the scenario's seed.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import jax

from lusee_bayes.core.arrays import Grid, on_device
from lusee_bayes.experiment.instrument_terms import (
    PointingTerm,
    pointed,
    table_factors,
    true_beams,
    true_instrument,
    true_setup,
)
from lusee_bayes.experiment.setup import Setup
from lusee_bayes.experiment.term import Around, Truth, noise_visibilities, radiometer_about
from lusee_bayes.experiment.terms import TERMS
from lusee_bayes.instrument.coupling import CouplingMatrix, DenseCoupling
from lusee_bayes.instrument.visibilities import Visibilities
from lusee_bayes.linear.linear_gaussian import LinearGaussian
from lusee_bayes.noise.covariance import Covariance
from lusee_bayes.noise.radiometer import radiometer_noise
from lusee_bayes.systematics.systematic import Marginalised, Systematic


def radiometer(setup: Setup, around: Around | None = None) -> Covariance:
    """Radiometer term of N, from the visibilities of :func:`.radiometer_about`; in K^2.

    Averages of spectra say themselves how many samples they are made of; other data have the
    scenario's bandwidth and duty cycle.
    """
    section = setup.scenario.noise.radiometer
    visibilities = noise_visibilities(setup, around or Around(), radiometer_about(setup))
    if setup.calibration is not None:
        given = {"bandwidth_hz": 1.0, "step_s": setup.calibration.n_averaged}
    else:
        given = section.model_dump(include={"bandwidth_hz", "duty_cycle"})
        given["step_s"] = setup.observation.live_s
    common = {"form": section.form, "factor": section.factor}
    return radiometer_noise(visibilities, setup.layout, **given, **common)


def systematics(setup: Setup, around: Around | None = None) -> list[tuple[str, Systematic]]:
    """Treatment and systematic, for all that the scenario does not ignore, in their order.

    Where clock and pointing are built around offsets, the others are, too: gains multiply, and
    sources are seen, where the antennas then pointed. Where the gain table is built around its
    errors, what N holds of the others is seen through these gains.
    """
    around = around or Around()
    there = pointed(setup, around.values)
    gains = table_factors(setup, around)
    return [
        (treatment, found if gains is None else found.behind(gains))
        for term in TERMS
        for treatment, found in term.build(
            setup if isinstance(term, PointingTerm) else there, around
        )
    ]


def base_model(setup: Setup, around: Around | None = None) -> LinearGaussian:
    """d = A m + background + n with radiometer noise only."""
    noise = radiometer(setup, around)
    return on_device(LinearGaussian(setup.coupling, setup.prior, noise, setup.offset))


def full_model(setup: Setup, around: Around | None = None) -> LinearGaussian:
    """d = A m + n with every systematic in N that is not ignored.

    Those that are to be sampled, too, to first order: what a Gaussian can say about them.
    """
    around = around or Around()
    return marginalised(base_model(setup, around), systematics(setup, around))


def marginalised(model: LinearGaussian, found: Iterable[tuple[str, Systematic]]) -> LinearGaussian:
    """The model with these systematics (:func:`systematics`) in N."""
    for _, systematic in found:
        model = systematic.marginalised(model)
    return model


def model_to_sample(setup: Setup, around: Around) -> tuple[LinearGaussian, tuple[Systematic, ...]]:
    """The model before anything is sampled, and what is then to be applied to it.

    Systematics that are marginalised come in their place in the order, as sampled ones without a
    site.
    """
    model, later = base_model(setup, around), []
    for treatment, systematic in systematics(setup, around):
        if treatment == "sampled":
            later.append(systematic)
        elif later:
            later.append(Marginalised(systematic))
        else:
            model = systematic.marginalised(model)
    if later and not any(systematic.changes_coupling for systematic in later):
        model = replace(model, coupling=DenseCoupling(model.coupling.dense()))
    return model, tuple(later)


def true_values(setup: Setup) -> Truth:
    """True values of what simulated data hold, by the names of their sites."""
    key = jax.random.key(setup.scenario.seed)
    return {name: value for term in TERMS for name, value in term.truth(setup, key).items()}


def true_signal(setup: Setup, truth: Truth) -> Grid:
    """Visibilities of sky, ground and systematics with the true instrument and values, in K."""
    key = jax.random.key(setup.scenario.seed)
    setup = true_setup(setup, truth)
    true = CouplingMatrix.build(true_beams(setup), setup.pointing)
    visibilities = true.layout.scatter(true @ setup.sky.modes)
    source, frequency_mhz = true_instrument(setup)
    visibilities = visibilities + source.background(frequency_mhz)[:, None]
    for term in TERMS:
        visibilities = term.distort(visibilities, setup, truth, key)
    return visibilities


def simulate(setup: Setup) -> Visibilities:
    """Visibilities of the scenario's sky, with every draw from its seed."""
    truth = true_values(setup)
    visibilities = true_signal(setup, truth)
    noise = radiometer(setup).scaled(truth.get("noise_level", 1.0))
    return Visibilities(
        setup.layout.gather(visibilities) + noise.sample(jax.random.key(setup.scenario.seed)),
        setup.layout,
        setup.observation,
        setup.scenario.frequency_mhz,
        setup.sky.modes,
    )
