"""A scenario's instrument pointed at its sky, its model, and data simulated from it.

A setup contains everything that is fixed before there are data: A, S, the sky, and the emission of
antennas and receivers, which does not depend on the sky. The model d = A m + n includes only
radiometer noise, or every systematic. Simulated data come from the true instrument, with drifts and
fluxes drawn with the scenario's seed.
"""

from collections.abc import Iterable
from dataclasses import replace

import jax
import numpy as np

from lusee_bayes.core import harmonics, progress
from lusee_bayes.core.arrays import Grid, ModesMatrix, on_device, on_host
from lusee_bayes.core.errors import InputError
from lusee_bayes.experiment.scenario import Scenario
from lusee_bayes.instrument.beams.fields import SAME_FREQUENCY_MHZ
from lusee_bayes.instrument.coupling import CouplingMatrix, DenseCoupling
from lusee_bayes.instrument.pointing import Pointing
from lusee_bayes.instrument.products import auto_indices
from lusee_bayes.instrument.visibilities import Visibilities
from lusee_bayes.linear.linear_gaussian import LinearGaussian
from lusee_bayes.noise.covariance import Covariance, KnownFactor, LowRankUpdate
from lusee_bayes.noise.radiometer import radiometer_noise
from lusee_bayes.sky.sky_source import Sky
from lusee_bayes.systematics import gain_drifts, noise_level, registered, sources
from lusee_bayes.systematics import systematic as kinds
from lusee_bayes.systematics.above_lmax import AboveLmax, sky_above
from lusee_bayes.systematics.context import Around, Setup, noise_visibilities, prior_and_family
from lusee_bayes.systematics.horizon import Horizon
from lusee_bayes.systematics.regolith import ground_per_kelvin

# sites closer than this, 30 m, count as one
SAME_SITE_DEG = 1e-3


def set_up(
    scenario: Scenario, data: Visibilities | None = None, stages: progress.Stages | None = None
) -> Setup:
    """Build everything that does not depend on the values of data.

    Parameters
    ----------
    scenario : Scenario
    data : Visibilities, optional
        Use the times and samples of these data, not the scenario's.
    stages : Stages, optional
        Shows the progress.

    Raises
    ------
    InputError
        If the data have another frequency, site or number of ports, or times of unknown meaning, or
        if the scenario's receivers or ground need information that the beams lack.
    """
    stages = stages or progress.Stages()
    if data is not None:
        require_fitting(data, scenario)
    with stages("sky"):
        sky = scenario.sky.at(scenario.frequency_mhz, scenario.lmax)
        prior, family = prior_and_family(scenario, sky)
    with stages("orientation"):
        if data is None:
            observation = scenario.observation.observation()
        else:
            observation = replace(data.observation, fixed_axis=scenario.observation.fixed_axis)
        pointing = Pointing.of(observation, scenario.lmax)
    with stages("beams"):
        receiver = None if data is None else data.receiver
        source = scenario.beam.source().behind(receiver)
        beams = source.beams(scenario.frequency_mhz, scenario.lmax)
        background = np.array(source.background(scenario.frequency_mhz))
        if scenario.noise.regolith is not None:
            ground_per_kelvin(source, scenario.frequency_mhz)  # refuses beams without a ground
        if (noise := scenario.noise.receiver) is not None:
            background[auto_indices(source.n_ports)] += noise.powers(source, scenario.frequency_mhz)
        responses = sources.source_responses(scenario, observation, source, scenario.frequency_mhz)
    if data is not None and data.layout.n_products != beams.n_products:
        raise InputError(
            f"the data have {data.layout.n_products} products, the beams supply "
            f"{beams.n_products}; give beam.rotations_deg an angle for every port"
        )
    with stages("coupling"):
        coupling = CouplingMatrix.build(beams, pointing, None if data is None else data.layout)
        background = np.repeat(background[:, None], observation.n_times, axis=1)
        pieces = observation, sky, source, source, beams, coupling, prior, responses, background
        calibration = None if data is None else data.calibration
        of_data = {"receiver": receiver, "calibration": calibration, "measured": data is not None}
        setup = Setup(scenario, *pieces, **of_data, family=family)
    horizon = scenario.noise.horizon
    setup = setup if horizon is None else Horizon.moved(horizon, setup, {})
    with stages("sky above lmax"):
        return with_sky_above(setup.with_signal())


def with_sky_above(
    setup: Setup, covariance: ModesMatrix | None = None, values: kinds.Truth | None = None
) -> Setup:
    """Add the sky above lmax to a setup, if it is part of the model.

    Parameters
    ----------
    setup : Setup
    covariance : (modes, modes) array, optional
        Prior covariance of all modes up to the highest ell, learned from the data, in K^2.
    values : dict, optional
        Of the instrument that sees it.
    """
    if AboveLmax.treatment(setup.scenario) is None:
        return setup
    coupling = _coupling_above(setup, values or {})
    return replace(setup, above=sky_above(setup, coupling, radiometer(setup), covariance))


def _coupling_above(setup: Setup, values: kinds.Truth) -> CouplingMatrix:
    """A of all modes up to the highest ell that is seen, for these values of the instrument."""
    scenario = setup.scenario.with_section("sources", list=())
    top = scenario.noise.above_lmax.top(scenario.lmax)
    beams = setup.beam_source.beams(setup.frequency_mhz, top)
    coupling = CouplingMatrix.build(beams, Pointing.of(setup.observation, top), setup.layout)
    sky = Sky(np.zeros(harmonics.n_modes(top)), setup.frequency_mhz)
    whole = replace(setup, scenario=scenario, sky=sky, beams=beams, coupling=coupling, hidden=None)
    for cls, section in registered.present(scenario):
        whole = cls.moved(section, whole, values)
    return whole.coupling


def require_fitting(data: Visibilities, scenario: Scenario) -> None:
    """Raise InputError unless the data match frequency and site, and their times have a meaning."""
    if not data.says_window:
        raise InputError(
            "the data do not specify the meaning of their times; use data.stamped('start') (or "
            "'middle', 'end', 'instant'), or read_data with observation.timestamp"
        )
    if scenario.observation.fixed_axis and data.observation.windows is not None:
        raise InputError(
            "the data are means over windows, but a fixed axis of the Moon (luseepy's croissant) "
            "needs instants; remove observation.fixed_axis"
        )
    if abs(data.frequency_mhz - scenario.frequency_mhz) > SAME_FREQUENCY_MHZ:
        raise InputError(
            f"the data are at {data.frequency_mhz:.9g} MHz, not at {scenario.frequency_mhz:.9g}; "
            f"use --set frequency_mhz={data.frequency_mhz:.9g}, or other data for this channel"
        )
    seen, stated = data.observation, scenario.observation
    east = (seen.lon_deg - stated.lon_deg + 180.0) % 360.0 - 180.0
    if max(abs(east), abs(seen.lat_deg - stated.lat_deg)) > SAME_SITE_DEG:
        # luseepy writes a placeholder if no site is configured
        unsettled = ", or reduce with --set flight.site=scenario if their site is a placeholder"
        raise InputError(
            f"the data were taken at longitude {seen.lon_deg:g}, latitude {seen.lat_deg:g} "
            f"degrees, the scenario's site is {stated.lon_deg:g}, {stated.lat_deg:g}; use --set "
            f"observation.lon_deg={seen.lon_deg:.15g} --set observation.lat_deg={seen.lat_deg:.15g}"
            + ("" if data.calibration is None else unsettled)
        )


def radiometer(setup: Setup, around: Around | None = None) -> Covariance:
    """Radiometer term of N in K^2, from the visibilities of :func:`.radiometer_about`."""
    section, around = setup.scenario.noise.radiometer, around or Around()
    visibilities = noise_visibilities(setup, around, noise_level.radiometer_about(setup))
    given = {"bandwidth_hz": 1.0, "step_s": setup.n_averaged, "factor": section.factor}
    if around.tempered == 1.0:
        return radiometer_noise(visibilities, setup.layout, **given, form=section.form)
    # far from the mode, without the directions in which correlated noise is smallest
    noise = radiometer_noise(visibilities, setup.layout, **given, form="paper")
    return noise.scaled(around.tempered)


def moved(setup: Setup, values: kinds.Truth | None, *, above: bool = False) -> Setup:
    """The setup with these values of the instrument, and its signal for them.

    Parameters
    ----------
    setup : Setup
    values : dict or None
    above : bool
        Whether A of the sky above lmax is needed for them, too.
    """
    made = setup
    for cls, section in registered.present(setup.scenario) if values else ():
        made = cls.moved(section, made, values)
    if made is setup:
        return setup
    if above and setup.above is not None:
        made = replace(made, above=replace(setup.above, coupling=_coupling_above(setup, values)))
    return made.with_signal()


def systematics(
    setup: Setup, around: Around | None = None, *, moving: bool = True
) -> list[tuple[str, kinds.Systematic]]:
    """Treatment and systematic, for all that the scenario does not ignore, in order.

    Without ``moving``, those whose values are found in rounds are left out.

    If the instrument is expanded around values, such as clock and pointing offsets, all systematics
    are: gains and sources then belong to the corrected pointing.
    """
    around = around or Around()
    # far from the mode, what is above lmax is small beside the noise
    placed = moved(setup, around.values, above=around.tempered == 1.0)
    return [
        (treatment, cls.build(section, placed, around))
        for cls, section in registered.present(setup.scenario)
        if (treatment := cls.treatment(setup.scenario)) != "ignored" and (moving or not cls.moves)
    ]


def base_model(setup: Setup, around: Around | None = None) -> LinearGaussian:
    """d = A m + background + n with radiometer noise only."""
    return LinearGaussian(setup.coupling, setup.prior, radiometer(setup, around), setup.offset)


def in_noise(
    setup: Setup, model: LinearGaussian, terms: Iterable[kinds.Systematic], around: Around
) -> list[kinds.Marginalised]:
    """Systematics as terms of N, in order, built around given values.

    Parameters
    ----------
    setup : Setup
    model : LinearGaussian
        Model without them.
    terms : iterable of Systematic
        In order.
    around : Around
    """
    if around.sky is None:
        around = replace(around, sky=setup.sky.modes)
    values, stages = around.values or {}, []
    for systematic in terms:
        before = model
        if systematic.first_order:
            model = systematic.effect(model, systematic.values(systematic.centre(values)))
        elif isinstance(systematic, gain_drifts.GainDrifts):
            model = systematic.averaged(model)
        stages.append((systematic, before, model.coupling.response))
    last, held = model.coupling.response, []
    for systematic, before, response in stages:
        later = last if response is None or last is None else last / response
        if isinstance(systematic, kinds.ChangedBeams):  # of the antennas as they point
            before = replace(before, coupling=before.coupling.of(pointing=model.coupling.pointing))
        if systematic.first_order:
            held.append(on_host(kinds.Expanded.at(systematic, before, around, later)))
        else:
            seen = systematic if later is None else systematic.behind(later)
            held.append(kinds.Marginalised(seen))
    return held


def model_about(
    setup: Setup, around: Around, *, moving: bool = True
) -> tuple[LinearGaussian, tuple[kinds.Marginalised, ...]]:
    """The full model, and the systematics in its N.

    Parameters
    ----------
    setup : Setup
    around : Around
        Values that N is built around.
    moving : bool
        Include systematics whose values are found in rounds.
    """
    model, parts = base_model(setup, around), systematics(setup, around, moving=moving)
    held = in_noise(setup, model, (systematic for _, systematic in parts), around)
    for systematic in held:
        model = systematic.marginalised(model)
    return model, tuple(held)


def full_model(setup: Setup, around: Around | None = None) -> LinearGaussian:
    """d = A m + n with every systematic in N that is not ignored.

    Sampled systematics are included to first order, in the Gaussian approximation.
    """
    return model_about(setup, around or Around())[0]


class InPlace(kinds.Marginalised):
    """A systematic at its place among sampled ones, in a model whose N contains it already.

    Attributes
    ----------
    systematic : Marginalised
        As part of N.
    """

    def sampled(self, model: LinearGaussian) -> LinearGaussian:
        """Apply its effects except the term of N."""
        return replace(self.marginalised(model), noise=model.noise)


def model_to_sample(
    setup: Setup, around: Around
) -> tuple[LinearGaussian, tuple[kinds.Systematic | kinds.Marginalised, ...]]:
    """The model before sampling, and the systematics to apply to it.

    Marginalised systematics keep their place in the order, like sampled ones without a site, since
    sampled gains also multiply them. N is factorised once, unless it depends on a sampled noise
    level or prior.
    """
    model, later = on_device(base_model(setup, around)), []
    treated, whole = systematics(setup, around), model
    sampled = [systematic for treatment, systematic in treated if treatment == "sampled"]
    others = (s for t, s in treated if t != "sampled" or not s.scales_sky)
    held = iter(in_noise(setup, model, others, around))
    for treatment, systematic in treated:
        as_noise = None if treatment == "sampled" and systematic.scales_sky else next(held)
        if treatment == "sampled":
            later.append(systematic)
            continue
        whole = as_noise.marginalised(whole)
        if later:
            later.append(as_noise)
        else:
            model = as_noise.marginalised(model)
    if later and not any(isinstance(systematic, kinds.Scale) for systematic in sampled):
        noise, gains = on_device(whole.noise), any(s.scales_sky or s.needs_sky for s in sampled)
        if gains and isinstance(noise, LowRankUpdate):
            noise = replace(noise, base=KnownFactor(noise.base, noise.base.factor()))
        else:
            noise = KnownFactor(noise, noise.factor())
        model = replace(model, noise=noise)
        later = [InPlace(s) if isinstance(s, kinds.Marginalised) else s for s in later]
    if later and not any(systematic.changes_coupling for systematic in later):
        model = replace(model, coupling=DenseCoupling(model.coupling.dense()))
    return model, tuple(later)


def true_values(setup: Setup) -> kinds.Truth:
    """True values of the systematics in simulated data, by the names of their sites."""
    truth: kinds.Truth = {}
    for cls, section in registered.present(setup.scenario):
        truth |= cls.truth(section, setup, jax.random.key(cls.true_seed(section, setup.scenario)))
    return truth


def true_model(setup: Setup, truth: kinds.Truth) -> LinearGaussian:
    """The model of simulated data: true instrument, true values and radiometer noise."""
    key, true = jax.random.key(setup.scenario.seed), moved(setup, truth, above=True)
    model = LinearGaussian(true.coupling, setup.prior, radiometer(setup), true.offset)
    for cls, section in registered.present(setup.scenario):
        model = cls.in_data(section, true, model, truth, key)
    return model


def true_signal(setup: Setup, truth: kinds.Truth) -> Grid:
    """Visibilities of sky, ground and systematics with the true instrument and values, in K."""
    return setup.layout.scatter(true_model(setup, truth).predict(setup.sky.modes))


def simulate(setup: Setup) -> Visibilities:
    """Simulate visibilities of the scenario's sky, with all draws from its seed.

    The truth is the simulated sky, including modes above lmax.
    """
    model, truth = true_model(setup, true_values(setup)), setup.sky.modes
    noise = model.noise.sample(jax.random.key(setup.scenario.seed))
    if setup.above is not None:
        truth = np.concatenate([truth, setup.above.modes])
    where = setup.layout, setup.observation, setup.frequency_mhz
    return Visibilities(model.predict(setup.sky.modes) + noise, *where, truth)
