"""Clock and pointing that are off: found within their errors, pointed at where they are ignored."""

from dataclasses import replace

import numpy as np
import pytest
from assertions import close, refuse, within
from experiments import density_of, offset_posterior, pulls, with_known_sky
from scipy import stats

import lusee_bayes as lb
from lusee_bayes.experiment import model as models
from lusee_bayes.experiment.diagnosis import diagnose
from lusee_bayes.experiment.experiment import Experiment, program_pieces
from lusee_bayes.experiment.model import moved, radiometer, set_up, simulate, true_values
from lusee_bayes.experiment.unknowns import pointing_report
from lusee_bayes.instrument.beams.monopoles import source_response
from lusee_bayes.judge.residuals import residuals
from lusee_bayes.sky.galaxy import galactic_unit_vector
from lusee_bayes.systematics.context import Around, Setup
from lusee_bayes.systematics.pointing_offsets import PointingOffsets

ANGLE = "turntable_0_deg"
TWO_RUNS = "observation.runs=[{cycles: 1}, {cycles: 1, turntable_deg: 30}]"
OFF = "clock_s: 60, turntable_0_deg: 0.3, turntable_1_deg: 0.0, clock_drift_s_per_day: 0.0"
PRIORS = "clock_s: 60, turntable_deg: 0.3, clock_drift_s_per_day: 1"


def scenario_of(*overrides, lmax=10, step_s=21600.0):
    plain = [f"lmax={lmax}", f"observation.step_s={step_s}", "observation.window=mean"]
    return lb.load_scenario("fiducial", overrides=[*plain, *overrides])


def about_a_mean(setup: Setup, scale: float, seed: int) -> Setup:
    """A sky that is known to a part of its C_ell: the truth is a draw of the prior."""
    prior = with_known_sky(setup, scale).prior
    mean = setup.sky.modes - prior.colour(np.random.default_rng(seed).standard_normal(prior.size))
    return replace(setup, prior=lb.HarmonicPrior(prior.spectrum, mean=mean))


def with_pointing(setup: Setup, section) -> Setup:
    noise = setup.scenario.noise.model_copy(update={"pointing": section})
    return replace(setup, scenario=setup.scenario.model_copy(update={"noise": noise}))


@pytest.fixture(scope="module")
def known_sky():
    """The sky to 0.1 %, so that the data tell the clock, too."""
    pointing = f"noise.pointing={{{PRIORS}, true_values: {{{OFF}}}}}"
    setup = about_a_mean(set_up(scenario_of(TWO_RUNS, pointing, lmax=8, step_s=43200.0)), 1e-6, 3)
    return Experiment(setup, simulate(setup))


def test_a_clock_and_a_turntable_that_are_off_are_found(known_sky):
    found = lb.infer(known_sky)
    mean, covariance = offset_posterior(found)
    truth = true_values(known_sky.setup)
    assert truth == pytest.approx(dict.fromkeys(truth, 0.0) | {"clock_s": 60.0, ANGLE: 0.3})
    std = np.sqrt(np.diagonal(covariance))
    assert max(map(abs, pulls(known_sky.setup, found).values())) < 3.5
    # they are told apart from none
    assert mean["clock_s"] > 4 * std[0] and mean[ANGLE] > 50 * std[2]
    # chi^2 of the data and the errors of the map are those of data that nothing is wrong with
    n = found.model.n_data
    assert abs(found.solution.chi2 - n) < 4 * np.sqrt(2 * n)
    pull = (found.posterior.mean - known_sky.setup.sky.modes) / found.posterior.std()
    setup = with_pointing(known_sky.setup, None)
    known = lb.infer(Experiment(setup, simulate(setup)))
    expected = (known.posterior.mean - setup.sky.modes) / known.posterior.std()
    assert np.mean(pull**2) == pytest.approx(np.mean(expected**2), abs=0.2)
    assert np.median(found.posterior.std() / known.posterior.std()) < 1.2


def diagnosis(experiment, found):
    return diagnose(experiment.setup, found, residuals(found.solution, experiment.data))


def test_ignored_the_report_points_at_it(known_sky):
    section = known_sky.setup.scenario.noise.pointing.model_copy(update={"treatment": "ignored"})
    experiment = Experiment(with_pointing(known_sky.setup, section), known_sky.data)
    found = lb.infer(experiment)
    assert found.solution.chi2 > 2 * found.model.n_data
    report = pointing_report(experiment, found)
    assert report.offsets is None
    best = diagnosis(experiment, found).proposals[0]
    name, value = best.words.split(" is off by ")
    assert name == ANGLE and float(value) == pytest.approx(0.3, rel=0.03) and best.chi2.fits
    assert "noise.pointing" in best.remedy
    whole = report.preferred[report.preferred["first_day"] < 0].set_index("offset")
    assert whole["value"][ANGLE] == pytest.approx(0.3, rel=0.03)
    days = report.preferred[report.preferred["offset"] == ANGLE]
    # no more than MOST_STRETCHES groups of days, and those of the other run say nothing of it
    assert 10 < len(days) < 32
    assert days["last_day"].max() <= 28


@pytest.mark.essential
def test_it_is_found_whatever_the_sky_has_beyond_few_multipoles():
    off = "{turntable_deg: 0.5, true_values: {turntable_deg: 0.7}, treatment: ignored}"
    experiment = lb.build(lb.load_scenario("fiducial", ["lmax=24", f"noise.pointing={off}"]))
    best = diagnosis(experiment, lb.infer(experiment)).proposals[0]
    assert best.words.startswith("turntable_deg is off by") and best.chi2.fits


@pytest.mark.long
def test_where_nothing_is_off_the_report_is_silent():
    none = "true_values: {clock_s: 0, turntable_0_deg: 0, turntable_1_deg: 0}"
    nothing = f"noise.pointing={{clock_s: 60, turntable_deg: 0.3, {none}, treatment: ignored}}"
    setup = about_a_mean(set_up(scenario_of(TWO_RUNS, nothing, lmax=6, step_s=86400.0)), 1e-2, 5)
    experiment = Experiment(setup, simulate(setup))
    told = diagnosis(experiment, lb.infer(experiment))
    assert told.chi2.fits and "data fit" in " ".join(told.sentences())


@pytest.mark.long
def test_simulation_based_calibration():
    """100 data sets with clock, turntable, lean and sky drawn from their priors."""
    pointing = "noise.pointing={clock_s: 60, turntable_deg: 0.1, tilt_east_deg: 0.1, %s}"
    first = set_up(scenario_of(pointing % "tilt_north_deg: 0.1", lmax=6, step_s=43200.0))
    # known to 1 %, where the clock is told to some 40 s
    prior = with_known_sky(first, 1e-4).prior
    z, ranks = [], []
    for seed in range(100):
        draw = np.asarray(prior.colour(np.random.default_rng(seed).standard_normal(prior.size)))
        sky = replace(first.sky, modes=first.sky.modes + draw)
        scenario = first.scenario.model_copy(update={"seed": seed})
        setup = replace(first.under(sky), scenario=scenario, prior=prior)
        found = lb.infer(Experiment(setup, simulate(setup)))
        z.append([*pulls(setup, found).values()])
        pull = (found.posterior.mean - sky.modes) / found.posterior.std()
        ranks.append(np.asarray(pull)[[0, 2, 6, 20]])
    every = np.concatenate([z, ranks], axis=1)
    assert every.shape == (100, 8)
    for column in every.T:
        assert stats.kstest(column, "norm").pvalue > 1e-3 / 8
    # and all of their squares: 99.9 % of chi^2
    low, high = stats.chi2(100).interval(1 - 1e-3 / 8)
    assert ((every**2).sum(0) > low).all() and ((every**2).sum(0) < high).all()


def log_p(experiment, values):
    """ln p(d, values) but for a constant, with the sky integrated out and nothing expanded."""
    setup = models.moved(experiment.setup, values)
    model, _ = models.model_about(setup, Around(experiment.data), moving=False)
    prior = experiment.scenario.noise.pointing
    z = [value / getattr(prior, name) for name, value in values.items()]
    return float(model.log_prob(experiment.data.data)) - 0.5 * np.square(z).sum()


@pytest.mark.parametrize("size", [0.2, pytest.param(1.0, marks=pytest.mark.essential)])
def test_offsets_that_can_stand_for_one_another_settle(size):
    """At one turntable angle clock, turntable and lean to the East turn the sky nearly alike.

    Whole steps swing between two points at the smaller size, and run away at the larger one, where
    two modes are about as probable: the truth is not much more so than what is found.
    """
    section = f"{{clock_s: {300 * size}, turntable_deg: {2 * size}, tilt_east_deg: {size}}}"
    experiment = lb.build(scenario_of(f"noise.pointing={section}", lmax=6, step_s=43200.0))
    found = lb.infer(experiment)
    n = found.model.n_data
    assert abs(found.solution.chi2 - n) < 4 * np.sqrt(2 * n)
    assert not found.unsettled
    if size < 1.0:
        assert max(map(abs, pulls(experiment.setup, found).values())) < 4
    values = {name: float(value) for name, value in found.around.values.items()}
    true = {name: true_values(experiment.setup)[name] for name in values}
    assert log_p(experiment, values) > log_p(experiment, true) - 3.0


@pytest.mark.long
def test_sources_and_gains_are_those_of_the_offsets():
    """Where offsets are known, the model is that of data without any, taken as the offsets say."""
    extra = ["sources.list=[{name: Cas A}, {name: Cyg A}]", "noise.gain={sigma: 0.01}"]
    extra += ["noise.beam={shift_mhz: 1}"]
    setup = set_up(scenario_of("noise.pointing={turntable_deg: 1}", *extra, lmax=5, step_s=43200.0))
    turned = "observation.runs=[{cycles: 1, turntable_deg: 3}]"
    there = set_up(scenario_of(turned, *extra, lmax=5, step_s=43200.0))
    expected = models.full_model(there)
    around = Around(None, None, setup.sky.modes, {"turntable_deg": 3.0})
    found, held = models.model_about(setup, around)
    (offsets,) = (one for one in held if isinstance(one.systematic, PointingOffsets))
    # the columns' own part left out; gains make 1 + sigma^2 of every auto, that part too
    own = offsets.columns @ offsets.centre
    got, wanted = (model.predict(setup.sky.modes) for model in (found, expected))
    within(got + own, wanted, 2e-4 * np.abs(own).max())
    systematic = np.asarray(found.noise.dense()) - offsets.columns @ offsets.columns.T
    systematic -= np.diag(np.asarray(radiometer(setup).diagonal()))
    wanted = np.asarray(expected.noise.dense()) - np.diag(np.asarray(radiometer(there).diagonal()))
    close(systematic, wanted, 1e-9)


@pytest.mark.long
def test_what_is_left_to_sample_is_about_the_offsets():
    """Gains are sampled, a turntable is marginalised: what is left of the model fits."""
    far = "noise.pointing={turntable_deg: 1, true_values: {turntable_deg: 2.0}}"
    gain = "noise.gain={sigma: 1e-9, treatment: sampled}"
    experiment = lb.build(scenario_of(far, gain, lmax=6, step_s=86400.0))
    model = program_pieces(experiment)["gaussian"]()
    n, mean = model.n_data, model.condition(experiment.data.data).posterior.mean
    assert float(model.chi2(mean, experiment.data.data)) < n + 4 * np.sqrt(2 * n)


def test_a_prior_is_learned_about_the_offsets():
    """A turntable off by degrees does not pass for the sky's: the prior is that of none."""
    learned = "prior={model: isotropic, spectrum: learned}"
    off = "noise.pointing={turntable_deg: 1, true_values: {turntable_deg: 2.0}}"
    given = [scenario_of(learned, *more, lmax=6, step_s=43200.0) for more in ((off,), ())]
    with_it, without = (lb.build(scenario).learned.parameters for scenario in given)
    within(with_it, without, 0.1)


def test_what_cannot_be():
    for section, words in (
        ("lat_deg: 1, true_values: {lat_deg: 200}", "with lat_deg = 200: lat_deg must lie"),
        ("clock_s: 1, true_values: {lat_deg: 1}", "true_values has an unknown 'lat_deg'"),
    ):
        refuse(words, simulate, set_up(scenario_of(f"noise.pointing={{{section}}}", lmax=4)))


def test_beams_and_pointing_are_sampled_together():
    """The density is that of antennas and angles built so, of which none is left out."""
    pointing = "noise.pointing={turntable_deg: 0.05, tilt_east_deg: 0.05, treatment: sampled}"
    beam = "noise.beam={parameters: {height_m: 0.01}, treatment: sampled}"
    experiment = lb.build(scenario_of(pointing, beam, lmax=4, step_s=86400.0))
    setup, data = experiment.setup, experiment.data.data
    values = {"turntable_deg": 0.04, "tilt_east_deg": -0.03, "height_m": 2.005}

    def evidence(values):
        there = moved(setup, values)
        model = lb.LinearGaussian(there.coupling, setup.prior, radiometer(setup), there.offset)
        return float(model.log_prob(data))

    priors = stats.norm.logpdf(list(values.values()), [0.0, 0.0, 2.0], [0.05, 0.05, 0.01]).sum()
    # A by two routes leaves 1e-13 of the data, which are 1e5 times the noise
    got = density_of(experiment, values)
    assert got == pytest.approx(evidence(values) + priors, rel=1e-7)
    for name in values:
        others = {key: value for key, value in values.items() if key != name}
        assert abs(evidence(others) + priors - got) > 1e-4 * abs(got), name


def test_sources_are_seen_as_means_over_windows():
    """Cas A rises, sets and turns within windows of a day: against 400 instants in each."""
    setup = set_up(scenario_of("sources.list=[{name: Cas A}]", lmax=4, step_s=86400.0))
    instants, sample, weight = setup.observation.at_nodes(400)
    antennas, direction = setup.beam_source, galactic_unit_vector(350.85, 58.815)
    fine = np.asarray(source_response(instants, direction, 25.0, antennas)) * weight
    expected = np.stack([np.bincount(sample, row) for row in fine])
    got = np.asarray(setup.responses[0])
    # a window of a day is 13 degrees of the sky; where Cas A sets within one, 8 instants tell its
    # mean to some percent of what it is when high
    peak = np.abs(expected).max()
    within(got, expected, 0.02 * peak)
    whole = np.abs(fine.reshape(16, -1, 400)).min(2).max(0) > 0
    assert 5 < whole.sum() < whole.size - 2
    within(got[:, whole], expected[:, whole], 1e-9 * peak)
