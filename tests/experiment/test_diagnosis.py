"""Usual mistakes in data of skies that are not the model's: named by the diagnosis."""

from dataclasses import replace

import numpy as np
import pytest
import wrong_data

from lusee_bayes.core.arrays import on_host
from lusee_bayes.core.harmonics import lmax_of, synthesis_matrix
from lusee_bayes.experiment.diagnosis import (
    MixedProducts,
    UnderAnySky,
    data_mistakes,
    diagnose,
    model_mistakes,
    port_mixing,
)
from lusee_bayes.experiment.experiment import build, infer
from lusee_bayes.experiment.setup import set_up
from lusee_bayes.instrument.products import to_matrix, to_real
from lusee_bayes.judge.residuals import residuals
from lusee_bayes.sky.prior import HarmonicPrior

LMAX = 8
QUICK = ("azimuth from North", "one time 2 % too high")


def sky(frequency_mhz=25.0, lmax=LMAX):
    return wrong_data.Mixed(1).at(frequency_mhz, lmax)


def diagnosed(wrong, scenario=None):
    scenario = scenario or wrong_data.scenario(LMAX)
    data = wrong.make(scenario, sky(lmax=scenario.lmax), 1)
    experiment = build(scenario, data)
    found = infer(experiment)
    chi2 = float(found.model.chi2(found.posterior.mean, data.data))
    left = residuals(found.model, found.posterior, data, chi2 + float(found.posterior.prior_chi2()))
    return left, diagnose(experiment, found, left)


def is_named(wrong, found):
    return any(wrong.cause in proposal.words for proposal in found.proposals[:3])


@pytest.mark.parametrize("name", QUICK)
def test_the_cause_is_named(name):
    wrong = next(one for one in wrong_data.WRONG if one.name == name)
    left, found = diagnosed(wrong)
    assert left.level() == "does not fit"
    assert is_named(wrong, found) and found.proposals[0].fits
    assert wrong.cause in " ".join(found.sentences())


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
        assert not any(proposal.fits for proposal in found.proposals), wrong.name


def test_data_that_fit_need_no_mistake():
    left, found = diagnosed(wrong_data.Wrong("good", "", wrong_data.measured))
    assert left.level() != "does not fit"
    assert found.fits and "fit as they are" in " ".join(found.sentences())


@pytest.mark.long
@pytest.mark.essential
def test_absent_samples_do_not_matter():
    def make(scenario, sky, seed):
        data = wrong_data.WRONG[0].make(scenario, sky, seed)
        grid = np.array(data.grid())
        rng = np.random.default_rng(3)
        grid[rng.uniform(size=grid.shape) < 0.1] = np.nan
        layout = type(data.layout).from_flags(np.isnan(grid))
        return replace(data, data=np.asarray(layout.gather(grid)), layout=layout)

    _, found = diagnosed(replace(wrong_data.WRONG[0], make=make))
    assert is_named(wrong_data.WRONG[0], found) and found.proposals[0].fits


def test_chi2_of_mixed_data_is_that_of_matrices():
    """(W d - b)^T (A S A^T + N)^-1 (W d - b), written out."""
    # noise that is loud enough for the inverse of a matrix
    loud = "noise.radiometer.factor=1e6"
    scenario = wrong_data.scenario(4, "observation.step_s=60000", loud)
    data = wrong_data.measured(scenario, sky(lmax=4), 1)
    setup = set_up(scenario, data)
    experiment = build(scenario, data)
    model = on_host(infer(experiment).model)
    spectrum = 1e2 * np.asarray(setup.sky.spectrum())
    here = UnderAnySky(setup, data, model, spectrum)
    base, posterior = here.wide(model.coupling)
    a, s = np.asarray(model.coupling.dense()), np.asarray(HarmonicPrior(spectrum).variance())
    inverse = np.linalg.inv(a @ np.diag(s) @ a.T + np.asarray(model.noise.dense()))

    def expected(grid):
        d = np.asarray(data.layout.gather(grid))
        return d @ inverse @ d

    grid = np.asarray(data.grid())
    assert base.chi2 == pytest.approx(expected(grid), rel=1e-4)
    mixed = MixedProducts.of(here, posterior)
    tried = list(mixed.tried())
    for chi2, mistake in tried[:40:5] + tried[-40::7]:
        right = expected(mistake.undone(grid))
        assert chi2 == pytest.approx(right, rel=1e-4, abs=1e-3 * base.chi2), mistake.words


def test_mixings_are_those_of_voltages():
    """V_ij of s_i' = c_i s_p(i) is c_i conj(c_j) V_p(i)p(j)."""
    rng = np.random.default_rng(1)
    real = rng.standard_normal((16, 5))
    v = np.asarray(to_matrix(real))
    ports, signs = (2, 0, 3, 1), (1.0, -1.0, 1.0, 1.0)
    order, c = np.array(ports), np.array(signs)
    expected = to_real((c[:, None] * c[None])[..., None] * v[order][:, order])
    np.testing.assert_allclose(port_mixing(ports, signs) @ real, np.asarray(expected))
    first = next(data_mistakes(4))
    np.testing.assert_allclose(first.mixing @ real, np.asarray(to_real(v.conj())))


def test_beams_of_other_azimuths():
    """B(theta, -phi), and B(theta, 90 degrees - phi), at some directions."""
    setup = set_up(wrong_data.scenario(6))
    found = {m.words: m.beams for m in model_mistakes(setup) if "azimuth" in m.words}
    theta, phi = np.array([0.3, 0.8, 1.2]), np.array([0.1, 2.0, 4.0])

    def at(beams, phi):
        return np.asarray(beams.modes) @ synthesis_matrix(theta, phi, lmax_of(49)).T

    mirrored, from_north = found.values()
    np.testing.assert_allclose(at(mirrored, phi), at(setup.beams, -phi), atol=1e-12)
    np.testing.assert_allclose(at(from_north, phi), at(setup.beams, np.pi / 2 - phi), atol=1e-12)
