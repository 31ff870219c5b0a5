"""Where the model sky is not the true one: errors are what is claimed, and mistakes are named.

The truth is a draw of the prior, whose mean is one sky; the scenario's model sky is another, a few
per cent to a factor off. (truth - mean)^T C^-1 (truth - mean) is then a chi^2 of as many degrees of
freedom as there are modes. Usual mistakes in data of such skies are named by the diagnosis.
"""

import re
from dataclasses import replace

import jax
import numpy as np
import pytest
import wrong_data
from experiments import flagged
from scipy import linalg, stats
from tables import tables

import lusee_bayes as lb
from lusee_bayes.core.harmonics import lmax_of, synthesis_matrix
from lusee_bayes.experiment import diagnosis
from lusee_bayes.experiment.experiment import doubts, under_sky
from lusee_bayes.experiment.model import radiometer, set_up, simulate, true_values
from lusee_bayes.experiment.rounds import settled
from lusee_bayes.experiment.sky_sections import FileSkySection, GalaxySection
from lusee_bayes.instrument.products import to_matrix, to_real
from lusee_bayes.judge.chi2 import ChiSquare
from lusee_bayes.judge.residuals import residuals
from lusee_bayes.noise.instrument_errors import with_gains
from lusee_bayes.systematics.context import Around
from lusee_bayes.systematics.gain_drifts import gains_about
from lusee_bayes.systematics.noise_level import radiometer_about

LMAX = 8
TERMS = tables(__file__)["terms"]


def measured(scenario, seed, scale=1e-3):
    """Data of a draw of a prior about another sky, that prior, and the truth."""
    known = set_up(scenario)
    other = wrong_data.Mixed(seed).at(scenario.frequency_mhz, scenario.lmax).modes
    prior = lb.HarmonicPrior(scale * np.asarray(known.sky.spectrum()), mean=other)
    truth = prior.colour(np.random.default_rng(seed).standard_normal(prior.size)) + other
    with_noise = scenario.model_copy(update={"seed": seed})
    sky = lb.Sky(truth, scenario.frequency_mhz, "other")
    return simulate(replace(known.under(sky), scenario=with_noise)), prior, truth


def distance(inference, truth):
    posterior = inference.posterior
    off = truth - np.asarray(posterior.mean)
    return float(off @ np.linalg.solve(np.asarray(posterior.covariance()), off))


ESSENTIAL = [pytest.mark.long, pytest.mark.essential]


EACH_TERM = [pytest.param(t, marks=[] if t in ("radiometer", "beam") else ESSENTIAL) for t in TERMS]


@pytest.mark.parametrize("term", EACH_TERM)
def test_the_errors_are_what_is_claimed(term):
    scenario = wrong_data.scenario(LMAX, *TERMS[term])
    total, modes = 0.0, 0
    for seed in (1, 2):
        data, prior, truth = measured(scenario, seed)
        found = settled(replace(set_up(scenario, data), prior=prior, family=None), Around(data))
        assert not found.unsettled
        same = found.under(found.model.prior).solution
        np.testing.assert_allclose(same.chi2, found.solution.chi2, rtol=1e-8)
        total, modes = total + distance(found, truth), modes + len(truth)
    p = 2.0 * min(stats.chi2.sf(total, modes), stats.chi2.cdf(total, modes))
    assert p > 1e-3, total / modes


def test_what_n_is_built_around_by_default():
    scenario = wrong_data.scenario(4, "noise.gain={sigma: 0.01}")
    simulated = set_up(scenario)
    data, _, _ = measured(scenario, 1)
    given = set_up(scenario, data)
    assert (radiometer_about(simulated), gains_about(simulated)) == ("model", "posterior")
    assert (radiometer_about(given), gains_about(given)) == ("measured", "posterior")
    grid = np.asarray(data.grid())
    for setup, signal in ((simulated, simulated.signal), (given, grid)):
        level = np.asarray(radiometer(setup, Around(data)).diagonal())[: grid.shape[1]]
        bandwidth_time = 1e6 * np.asarray(setup.observation.live_s)
        np.testing.assert_allclose(level, np.asarray(signal)[0] ** 2 / bandwidth_time, rtol=1e-12)
    # few samples, whose noise would pull the map; and an auto that noise depends on was not taken
    noisy = wrong_data.changed(scenario, "noise.radiometer.bandwidth_hz=100")
    assert radiometer_about(set_up(noisy, data)) == "posterior"
    absent = np.zeros(grid.shape, dtype=bool)
    absent[4] = True
    # a cross: the exact form of the noise depends on it, the independent one does not
    for form, about in (("exact", "posterior"), ("paper", "measured")):
        formed = wrong_data.changed(scenario, f"noise.radiometer.form={form}")
        assert radiometer_about(set_up(formed, flagged(data, absent))) == about
    absent = np.zeros(grid.shape, dtype=bool)
    absent[7] = True
    partly = flagged(data, absent)
    setup = set_up(scenario, partly)
    assert radiometer_about(setup) == "posterior"
    # before there is a prediction, it is about the modelled sky
    about_data = radiometer(setup, Around(partly)).diagonal()
    np.testing.assert_array_equal(about_data, radiometer(replace(setup, measured=False)).diagonal())


@pytest.mark.long
def test_the_error_of_the_mean_temperature_covers_what_never_rises():
    """Twenty skies with spurs and clouds: rms pull 1 +- 0.16; without the prior's discs, 1.65."""
    setup, pulls = set_up(wrong_data.scenario(24, frequency_mhz=10.0)), []
    for seed in range(1, 21):
        experiment = under_sky(setup, GalaxySection(seed=seed, sources=False), seed)
        posterior, truth = lb.infer(experiment).posterior, experiment.data.truth
        pulls.append((truth[0] - posterior.mean[0]) / posterior.std()[0])
    assert 0.68 < np.sqrt(np.mean(np.square(pulls))) < 1.32


def pulls_with_drifts(sigma, lmax, top, test_data, measured=lambda scenario: scenario):
    """ULSA's sky up to ``top``, the embedded one as model, the default prior: three seeds.

    Pulls along independent directions, the part of the prior's variance that is left of each, and
    chi^2 minus its mean in standard deviations.
    """
    file = test_data / "ulsa" / "exp10.0MHz_sky_map_with_absorption.hdf5"
    sky, term = FileSkySection(file=str(file)).at(10.0, top), f"noise.gain={{sigma: {sigma}}}"
    scenario, whole = (wrong_data.scenario(ell, term, frequency_mhz=10.0) for ell in (lmax, top))
    for seed in (1, 2, 3):

        def distort(setup, v, seed=seed):
            key, hours = jax.random.key(100 + seed), setup.observation.hours
            return with_gains(v, lb.GainDrift(sigma, 10.0).sample(key, hours))

        data = wrong_data.measured(whole, sky, seed, distort=distort)
        found = lb.infer(lb.build(measured(scenario), data))
        n, posterior = len(data.data), found.posterior
        both = (np.asarray(one.covariance()) for one in (posterior, posterior.prior))
        share, directions = linalg.eigh(*both)
        off = np.asarray(sky.modes)[: len(share)] - np.asarray(posterior.mean)
        excess = (found.solution.chi2 - n) / np.sqrt(2.0 * n)
        yield directions.T @ off / np.sqrt(share), share, excess


@pytest.mark.long
@pytest.mark.parametrize("sigma", [0.001, 0.005, 0.02])
@pytest.mark.parametrize("lmax", [12, 16, 24])
def test_errors_with_drifts_are_what_is_claimed(sigma, lmax, test_data):
    """In all directions that the data inform, if the instrument is otherwise exact.

    The data fit: what is quadratic in drifts is no independent noise, which would let chi^2 scatter
    by twice as much.
    """
    found = pulls_with_drifts(sigma, lmax, lmax, test_data)
    pulls, share, excess = map(np.stack, zip(*found, strict=True))
    assert np.abs(excess).max() < 4.0
    assert 0.8 < np.mean(pulls[share < 0.5] ** 2) < 1.3
    assert 0.8 < np.mean(pulls**2) < 1.3


@pytest.mark.long
def test_errors_with_every_default_for_measured_data_cover(test_data):
    """Antennas and fields unknown, though they are as expected; the sky goes on above lmax."""
    every = pulls_with_drifts(0.005, 24, 63, test_data, lambda scenario: scenario.of_measured())
    pulls, share, excess = map(np.stack, zip(*every, strict=True))
    assert excess.max() < 4.0
    for these in (share < 0.1, share > 0.1):
        assert 0.2 < np.mean(pulls[these] ** 2) < 1.3


@pytest.mark.long
@pytest.mark.parametrize("seed", [1, 2])
def test_antennas_are_found_below_a_sky_that_goes_far_above_lmax(seed):
    """What is above lmax is hundreds of times the noise, and seen by antennas with other values;
    with those of the expected ones chi^2 is 600 times too large."""
    runs = "observation.runs=[{cycles: 0.6, turntable_deg: 18}, {cycles: 0.7, turntable_deg: -80}]"
    sizes = "lmax=8", runs, "observation.step_s=43200", "sky.sources=false"
    beam = "noise.beam={parameters: {surface_permittivity: 0.185, loss_tangent: 0.003}}"
    above = "noise.above_lmax={least_lmax: 31}", "noise.radiometer.temperature=measured"
    given = *sizes, beam, *above, "prior.model=local_scales", f"seed={seed}"
    setup = set_up(lb.load_scenario("fiducial", given))
    experiment = under_sky(setup, GalaxySection(seed=seed + 40, sources=False), seed)
    assert np.sqrt(experiment.setup.above.power.sum() / setup.layout.size) > 50.0
    found = lb.infer(experiment)
    assert found.fits and found.rounds < 15
    (beams,) = found.moving
    values = beams.systematic.in_units(beams.expected + found.amplitudes(beams).mean)
    std, truth = beams.systematic.stds * found.amplitudes(beams).std, true_values(experiment.setup)
    off = [(values[name] - truth[name]) / one for name, one in zip(values, std, strict=True)]
    assert np.abs(off).max() < 4.0
    posterior, left = found.posterior, np.asarray(experiment.data.truth - found.posterior.mean)
    share, directions = linalg.eigh(posterior.covariance(), posterior.prior.covariance())
    # errors are right to a factor of 1.5; such a sky, of which nearly all is above lmax, is not
    # Gaussian
    assert 1.5**-2 < np.mean((directions.T @ left / np.sqrt(share))[share < 0.1] ** 2) < 1.5**2


@pytest.mark.essential
def test_a_prior_that_does_not_settle_with_n_is_said_to(monkeypatch):
    """Rounds that may never end are cut short, and the map says by how much it still moves."""
    monkeypatch.setattr("lusee_bayes.experiment.rounds.PRIOR_SETTLED", 0.0)
    monkeypatch.setattr("lusee_bayes.experiment.rounds.MAX_LEARNED", 1)
    short = "observation.step_s=60000", "observation.runs.0.cycles=0.5", "prior.model=isotropic"
    scenario = wrong_data.scenario(4, *short, *TERMS["gain drifts"])
    data = wrong_data.measured(scenario, wrong_data.Mixed(1).at(25.0, 4), 1)
    experiment = lb.build(scenario, data)
    assert experiment.learned.still_moves > 0.0
    uncertain = replace(experiment, learned=replace(experiment.learned, averaged=False))
    said = " ".join(doubts(uncertain, lb.infer(experiment)))
    assert re.search(r"too uncertain.*5\d% of a lunar rotation.*did not converge", said)


def sky(lmax):
    return wrong_data.Mixed(1).at(25.0, lmax)


def diagnosed(wrong, scenario=None):
    scenario = scenario or wrong_data.scenario(LMAX)
    data = wrong.make(scenario, sky(scenario.lmax), 1).with_truth_up_to(scenario.lmax + 1)
    experiment = lb.build(scenario, data)
    found = lb.infer(experiment)
    left = residuals(found.solution, data)
    return left, diagnosis.diagnose(experiment.setup, found, left)


def is_named(wrong, found):
    return any(wrong.cause in proposal.words for proposal in found.proposals[:3])


@pytest.mark.essential
@pytest.mark.parametrize("absent", ["none", "3", "00|11|22|33", "[0-2]"])
def test_the_cause_is_named(absent):
    """One of many: the others take minutes. Some products have no data at all."""
    wrong = next(one for one in wrong_data.WRONG if one.name == "one time 2 % too high")

    def make(*given):
        data = wrong.make(*given)
        dead = [re.search(absent, label) is not None for label in data.labels]
        return flagged(data, np.repeat(dead, data.layout.n_times).reshape(data.grid().shape))

    lacking = replace(wrong, make=make)
    left, found = diagnosed(lacking, wrong_data.scenario(6, "observation.step_s=30000"))
    assert left.level() == "does not fit"
    if absent in ("none", "3"):
        assert is_named(wrong, found) and found.proposals[0].chi2.fits
        assert wrong.cause in " ".join(found.sentences())


@pytest.mark.essential
@pytest.mark.parametrize(("right", "wrong"), [("exact", "paper"), ("paper", "exact")])
def test_the_form_of_the_noise_is_named(right, wrong):
    right, wrong = (wrong_data.scenario(6, f"noise.radiometer.form={f}") for f in (right, wrong))
    data = wrong_data.measured(right, sky(6), 1)
    setup, found = (experiment := lb.build(wrong, data)).setup, lb.infer(experiment)
    (first,) = diagnosis.diagnose(setup, found, residuals(found.solution, data)).proposals
    assert right.noise.radiometer.form in first.remedy and first.chi2.fits


@pytest.mark.essential
def test_a_cause_is_named_even_if_the_simulated_sky_ends_at_lmax():
    """N allows for a sky above it, so that chi^2 without the mistake is too small."""
    above = "noise.above_lmax={margin: 16, least_lmax: 0}"
    _, found = diagnosed(wrong_data.WRONG[0], wrong_data.scenario(6, above))
    assert is_named(wrong_data.WRONG[0], found) and found.sentences()[0] == "Did you mean:"
    assert found.proposals[0].chi2.p < 1e-4


# antennas one and a half, and half, of their standard deviations from the expected ones
OFF = "beam.surface_permittivity=3.98", "beam.zenith_angle_deg=75.3"
NOTHING = wrong_data.Wrong("nothing", "", wrong_data.measured)
PLAIN = "imaginary parts conjugated", "ports 0 and 2 exchanged", "one time 50 % too low"


def of_other_antennas(wrong, mhz=25.0):
    """Data of antennas that are not the expected ones, and the default scenario for measured data.

    The sky ends at lmax, but the model does not.
    """
    above = "noise.above_lmax={margin: 8, least_lmax: 0}"
    scenario = wrong_data.scenario(6, "observation.step_s=30000", above, frequency_mhz=mhz)
    data = wrong.make(wrong_data.changed(scenario, *OFF), wrong_data.Mixed(1).at(mhz, 6), 1)
    return replace(data, truth=None), scenario.of_measured()


@pytest.mark.parametrize("wrong", [NOTHING, *(w for w in wrong_data.WRONG if w.name in PLAIN)])
def test_a_mistake_is_told_from_unknown_antennas(wrong):
    data, scenario = of_other_antennas(wrong)
    assert diagnosis.is_mistaken(set_up(scenario, data), Around(data)) == (wrong is not NOTHING)


LARGE_AND_SMALL = [pytest.param("imaginary parts conjugated", marks=pytest.mark.essential)]
LARGE_AND_SMALL += [pytest.param("33R 1 % too high", marks=pytest.mark.long)]


@pytest.mark.parametrize("name", LARGE_AND_SMALL)
def test_unknown_antennas_do_not_absorb_a_mistake(name):
    """They could: with fields and a sky above lmax, both learned, conjugated data fit."""
    (wrong,) = (one for one in wrong_data.WRONG if one.name == name)
    data, scenario = of_other_antennas(wrong)
    experiment = lb.build(scenario, data)
    kept = "unknowns stay as expected" in " ".join(experiment.doubts)
    assert kept == (name in PLAIN)
    if kept:  # such data say nothing about the sky above lmax
        expected = set_up(scenario, data).above.power
        np.testing.assert_array_equal(experiment.setup.above.power, expected)
    left = residuals((found := lb.infer(experiment)).solution, data)
    dense = found.model.coupling.dense() @ found.model.prior.colour_columns(np.eye(49))
    covariance = dense @ dense.T + found.model.noise.dense()
    fields = [part.columns for part in found.moving if part.systematic.learns]
    unused = sum(np.trace(u.T @ np.linalg.solve(covariance, u)) for u in fields)
    assert found.unused() == pytest.approx(unused, rel=1e-4)
    assert left.level() == "does not fit"
    named = diagnosis.diagnose(experiment.setup, found, left)
    assert is_named(wrong, named) and named.sentences()[0].startswith("Explains most of chi2")


SOME = [w for w in wrong_data.WRONG if w.name.startswith(("noise", "02I", "port 2 ", "constant"))]
NONE_AND_SOME = [pytest.param(NOTHING, marks=pytest.mark.essential)]
NONE_AND_SOME += [pytest.param(one, marks=pytest.mark.long) for one in SOME]


@pytest.mark.parametrize("wrong", NONE_AND_SOME)
def test_what_unknown_fields_absorb_is_named(wrong, tmp_path):
    """Without errors of the fields, many of the data scatter less than the model expects."""
    data, scenario = of_other_antennas(wrong)
    (found,) = lb.run_map(scenario, tmp_path / "run", data=data).result.channels
    named = found.diagnosis is not None and is_named(wrong, found.diagnosis)
    assert named == (wrong is not NOTHING)
    assert named or found.judged.level == "consistent"


@pytest.mark.long
def test_a_mistake_in_one_channel_is_named_there(tmp_path):
    """The other channel still finds the antennas."""
    wrong = wrong_data.WRONG[0]
    (right, scenario), (bad, _) = of_other_antennas(NOTHING, 20.0), of_other_antennas(wrong)
    several = lb.load_scenario(scenario, ["frequencies_mhz=[20, 25]"])
    found = lb.run_map(several, tmp_path / "run", data=[right, bad]).result
    assert found.fit.level == "does not fit" and found.channels[0].instrument.p > 1e-6
    assert is_named(wrong, found.channels[1].diagnosis)


@pytest.mark.long
def test_all_wrong_data_make_a_map_and_most_causes_are_named():
    named = 0
    for wrong in wrong_data.WRONG:
        left, found = diagnosed(wrong)
        assert left.level() == "does not fit", wrong.name
        named += is_named(wrong, found)
    assert len(wrong_data.WRONG) == 36
    assert named >= 34
    for wrong in wrong_data.UNMODELLED:
        left, found = diagnosed(wrong)
        assert left.level() == "does not fit", wrong.name
        assert not any(proposal.explains for proposal in found.proposals), wrong.name
        assert found.proposals or "The model has no noise.beam, noise." in found.sentences()[0]


@pytest.mark.long
def test_absent_samples_do_not_matter():
    def make(scenario, sky, seed):
        data = wrong_data.WRONG[0].make(scenario, sky, seed)
        return flagged(data, np.random.default_rng(3).uniform(size=data.grid().shape) < 0.1)

    _, found = diagnosed(replace(wrong_data.WRONG[0], make=make))
    assert is_named(wrong_data.WRONG[0], found) and found.proposals[0].chi2.fits


def test_a_mistake_is_proposed_even_if_only_groups_of_data_do_not_fit():
    whole, closer = ChiSquare(5412.0, 5136.0), ChiSquare(4948.0, 4947.0)
    finer = diagnosis.Proposal("lmax is too low", "use --set lmax=16", closer)
    assert whole.fits and finer.suffices(whole)
    assert not replace(finer, chi2=ChiSquare(5405.0, 5135.0)).suffices(whole)
    assert "Did you mean" in diagnosis.Diagnosis(whole, (finer,), 9).sentences()[0]


def test_chi2_of_mixed_data_is_that_of_matrices():
    """(W d - b)^T (A S A^T + N)^-1 (W d - b), written out."""
    # noise that is loud enough for the inverse of a matrix
    scenario = wrong_data.scenario(4, "observation.step_s=60000", "noise.radiometer.factor=1e6")
    data = wrong_data.measured(scenario, sky(4), 1)
    setup, model = set_up(scenario, data), lb.infer(lb.build(scenario, data)).model
    spectrum = 1e2 * np.asarray(setup.sky.spectrum())
    here = diagnosis.UnderAnySky(setup, Around(data), model, spectrum)
    base, solution = here.wide(model.coupling)
    a, s = np.asarray(model.coupling.dense()), np.asarray(lb.HarmonicPrior(spectrum).variance())
    inverse = np.linalg.inv(a @ np.diag(s) @ a.T + np.asarray(model.noise.dense()))

    def expected(grid):
        d = np.asarray(data.layout.gather(grid))
        return d @ inverse @ d

    grid = np.asarray(data.grid())
    assert base.chi2 == pytest.approx(expected(grid), rel=1e-4)
    tried = list(diagnosis.MixedProducts.of(here, solution).tried())
    for chi2, mistake in tried[:40:5] + tried[-40::7]:
        right = expected(mistake.undone(grid))
        assert chi2 == pytest.approx(right, rel=1e-4, abs=1e-3 * base.chi2), mistake.words


def test_mixings_are_those_of_voltages():
    """V_ij of s_i' = c_i s_p(i) is c_i conj(c_j) V_p(i)p(j)."""
    real = np.random.default_rng(1).standard_normal((16, 5))
    v = np.asarray(to_matrix(real))
    ports, signs = (2, 0, 3, 1), (1.0, -1.0, 1.0, 1.0)
    order, c = np.array(ports), np.array(signs)
    expected = to_real((c[:, None] * c[None])[..., None] * v[order][:, order])
    np.testing.assert_allclose(diagnosis.port_mixing(ports, signs) @ real, np.asarray(expected))
    *_, mixing = next(diagnosis.data_mistakes(4))
    np.testing.assert_allclose(mixing @ real, np.asarray(to_real(v.conj())))


def test_beams_of_other_azimuths():
    """B(theta, -phi), and B(theta, 90 degrees - phi), at some directions."""
    setup = set_up(wrong_data.scenario(6))
    found = {m.words: m.beams for m in diagnosis.model_mistakes(setup) if "azimuth" in m.words}
    theta, phi = np.array([0.3, 0.8, 1.2]), np.array([0.1, 2.0, 4.0])

    def at(beams, phi):
        return np.asarray(beams.modes) @ synthesis_matrix(theta, phi, lmax_of(49)).T

    mirrored, from_north = found.values()
    np.testing.assert_allclose(at(mirrored, phi), at(setup.beams, -phi), atol=1e-12)
    np.testing.assert_allclose(at(from_north, phi), at(setup.beams, np.pi / 2 - phi), atol=1e-12)
