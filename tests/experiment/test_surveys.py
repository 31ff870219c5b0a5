"""Surveys as the template of the prior: of skies that are not the model's, distorted or wrong."""

from dataclasses import replace

import healpy
import numpy as np
import pytest
import wrong_data
from assertions import refuse
from reference_linear import random_covariance
from scipy.linalg import block_diag

import lusee_bayes as lb
from lusee_bayes.core.harmonics import map_to_modes, modes_to_map, n_modes, turn_about_z
from lusee_bayes.experiment.experiment import doubts
from lusee_bayes.experiment.sky_sections import SurveySection
from lusee_bayes.priors.local_scales import embedded_local_scales
from lusee_bayes.priors.surveys import Survey
from lusee_bayes.sky.sky_source import write_alms

LMAX, TOP, NSIDE = 8, 24, 16
ABOVE = f"noise.above_lmax={{least_lmax: {TOP}}}"
# what is done to the survey: scale, zero level over the mean, beam
SCALE, ZERO, BEAM = 0.9, -0.1, 5.0


def declinations(nside):
    place = healpy.pix2ang(nside, np.arange(12 * nside**2), lonlat=True)
    return healpy.Rotator(coord=["G", "C"])(*place, lonlat=True)[1]


def survey_of(sky, path, unseen=False):
    """A map of a sky with another scale, zero level and resolution, without the southern cap."""
    pixels = modes_to_map(sky.modes, NSIDE)
    pixels = healpy.smoothing(SCALE * pixels, np.radians(BEAM)) + ZERO * pixels.mean()
    if unseen:
        pixels[declinations(NSIDE) < -40.0] = healpy.UNSEEN
    healpy.write_map(path, pixels, dtype=np.float32, column_units="K", overwrite=True)
    return f"{{file: {path}, frequency_mhz: 25.0, beam_deg: {BEAM}, zero_std_k: 5000.0}}"


def mapped(data, *surveys):
    """The inference with these surveys, and its squared distance from the truth per mode."""
    given = f"prior={{model: local_scales, surveys: [{', '.join(surveys)}]}}"
    experiment = lb.build(wrong_data.scenario(LMAX, ABOVE, "beam.exact=true", given), data)
    found = lb.infer(experiment)
    off = sky_of(2).modes[: n_modes(LMAX)] - found.posterior.mean
    distance = float(off @ np.linalg.solve(found.solution.covariance, off)) / len(off)
    return experiment, found, distance


def width(found):
    """The length of the vector of all the map's standard deviations."""
    return np.sqrt(np.trace(found.solution.covariance))


def sky_of(seed):
    """The Galaxy of another seed, brighter and fainter by 20 % over large scales."""
    galaxy = modes_to_map(lb.galaxy_sky(25.0, TOP, seed=seed, sources=()).modes, 2 * NSIDE)
    large = np.random.default_rng(seed).standard_normal(n_modes(4)) * (np.arange(n_modes(4)) > 0)
    pixels = galaxy * np.exp(0.15 * modes_to_map(large, 2 * NSIDE))
    return lb.Sky(map_to_modes(pixels, TOP), 25.0, "another Galaxy")


@pytest.fixture(scope="module")
def data():
    return replace(wrong_data.measured(wrong_data.scenario(TOP), sky_of(2), 3), truth=None)


@pytest.fixture(scope="module")
def alone(data):
    return mapped(data)


@pytest.mark.parametrize("unseen", [pytest.param(False, marks=pytest.mark.long), True])
def test_scale_and_zero_level_are_found_and_the_map_gains(tmp_path, data, alone, unseen):
    mean = sky_of(2).modes[0] / np.sqrt(4.0 * np.pi)
    survey = survey_of(sky_of(2), tmp_path / "survey.fits", unseen)
    experiment, found, distance = mapped(data, survey)
    rows = {row["name"]: row for row in found.learned.as_rows()}
    for name, value in (("scale", SCALE), ("zero level (K at the map's frequency)", ZERO * mean)):
        row = rows[f"{name} of survey.fits at 25 MHz"]
        assert abs(row["value"] - value) < 3.5 * row["std"]
    assert width(found) < 0.5 * width(alone[1])
    assert 0.4 < distance < 1.6
    assert dict(found.learned.survey_gains)["survey.fits at 25 MHz"] > 20.0
    assert not [text for text in doubts(experiment, found) if "survey.fits" in text]


def test_a_survey_with_more_contrast_has_the_scale_of_the_best_line(tmp_path, data):
    """As at another frequency: it departs from the sky smoothly and by no small error."""
    path, pixels = tmp_path / "steep.fits", modes_to_map(sky_of(2).modes, 2 * NSIDE)
    steep = map_to_modes(pixels.mean() * np.abs(pixels / pixels.mean()) ** 1.1, TOP)
    row = mapped(data, survey_of(lb.Sky(steep, 25.0, "steep"), path))[1].learned.survey_rows[0]
    smooth = healpy.smoothing(modes_to_map(sky_of(2).modes, NSIDE), np.radians(BEAM))
    scale = np.polyfit(smooth, healpy.read_map(path, dtype=float), 1)[0]
    assert row["std"] < 0.02 and abs(row["value"] - scale) < 2.5 * row["std"]


def wrong_survey(path):
    """The sky with the Galactic centre a radian away."""
    return survey_of(lb.Sky(turn_about_z(sky_of(2).modes, 1.0), 25.0, "turned"), path)


def test_a_wrong_survey_loses_its_weight(tmp_path, data, alone):
    _, found, distance = mapped(data, wrong_survey(tmp_path / "wrong.fits"))
    assert distance < max(1.3, alone[2])
    assert 0.8 < width(found) / width(alone[1]) < 1.3


@pytest.mark.long
def test_a_good_survey_beside_a_wrong_one_is_as_good_as_alone(tmp_path, data):
    good = survey_of(sky_of(2), tmp_path / "good.fits")
    both = mapped(data, wrong_survey(tmp_path / "wrong.fits"), good)[1]
    assert 0.8 < width(both) / width(mapped(data, good)[1]) < 1.3


def test_scale_and_zero_level_are_those_of_one_normal_equation():
    rng, n = np.random.default_rng(4), n_modes(4)
    known, errors = random_covariance(rng, n), random_covariance(rng, n)
    s, mu = 50.0 + rng.standard_normal((2, n))
    beam = np.sort(0.21 + 0.79 * rng.random(n))[::-1]
    survey = Survey("s", s, beam, 0.1, 20.0)
    # s = B (m + e) - scale_std s x_1 - zero_std x_2 y_0
    rows = np.hstack([np.diag(beam), np.diag(beam), -survey.shapes.T])
    prior = block_diag(known, errors, np.eye(2))
    gain = prior @ rows.T @ np.linalg.inv(rows @ prior @ rows.T)
    x = (gain @ (s - beam * mu))[-2:] * [0.1, 20.0]
    c = (prior - gain @ rows @ prior)[-2:, -2:] * np.outer([0.1, 20.0], [0.1, 20.0])
    # small deviations, about which a and b are linear
    near = rng.multivariate_normal(np.zeros(2), 1e-8 * c, 200_000) + x
    expected = [(1.0 / (1.0 + k), -b / (1.0 + k)) for k, b in (x, near.T)]
    # scales that the beam removes say nothing
    survey = Survey("s", np.append(s, 1e6), np.append(beam, 1e-9), 0.1, 20.0)
    rows = survey.calibrated(np.append(mu, 0.0), *(block_diag(c, 1.0) for c in (known, errors)))
    for row, value, scattered in zip(rows, *expected, strict=True):
        assert row["value"] == pytest.approx(value, rel=1e-9)
        assert row["std"] == pytest.approx(1e4 * scattered.std(), rel=0.01)


def test_the_edge_of_a_survey_stays_at_its_edge(tmp_path):
    """Where the beam is taken off, a sharp edge would ring over the whole sky (620 K here)."""
    sky = lb.galaxy_sky(25.0, 47, seed=2, sources=())
    pixels = healpy.smoothing(modes_to_map(sky.modes, 32), np.radians(BEAM))
    pixels[declinations(32) < -40.0] = healpy.UNSEEN
    healpy.write_map(tmp_path / "s.fits", pixels, dtype=np.float64, column_units="K")
    section = SurveySection(file=str(tmp_path / "s.fits"), frequency_mhz=25.0, beam_deg=BEAM)
    sharp = section.at(25.0, 47).sharpened(lb.galaxy_sky(25.0, 47, seed=None, sources=()).modes)
    assert modes_to_map(sharp - sky.modes, 32)[declinations(32) > -10.0].std() < 100.0


def test_several_surveys_share_scale_and_zero_level():
    """T is their mean; each of them, and the embedded template, is one of the possible skies."""
    rng, n = np.random.default_rng(5), n_modes(6)
    plain = embedded_local_scales(25.0, 6)
    skies, beam = plain.mean * (1.0 + 0.1 * rng.standard_normal((2, n))), np.ones(n)
    surveys = [Survey("s", sky, beam, std, 1e3) for sky, std in zip(skies, (0.1, 0.2), strict=True)]
    family = embedded_local_scales(25.0, 6, surveys=surveys)
    np.testing.assert_allclose(family.mean, skies.mean(0), rtol=1e-12)
    scale, zero, *weights = family.wide.T[:5]
    np.testing.assert_allclose(scale, 0.5 * np.hypot(0.1, 0.2) * family.mean, rtol=1e-12)
    np.testing.assert_allclose(zero, np.sqrt(2.0 * np.pi) * 1e3 * (np.arange(n) == 0), rtol=1e-12)
    for sky, weight in zip([*skies, plain.mean], weights, strict=True):
        scaled = sky * family.mean[0] / sky[0]
        np.testing.assert_allclose(family.mean + weight, scaled, rtol=1e-9, atol=1e-6)


UNUSABLE = [
    ("file: nothere.fits", "nothere.fits.*check prior.surveys"),
    ("file: {map}, mask_file: {small}", "the mask has shape"),
    ("file: {map}, mask_file: {dark}", "not all of them masked"),
    ("file: {dark}", "must be positive"),
    ("file: {alm}, mask_file: {small}", "has no pixels for prior.surveys.mask_file"),
]


@pytest.mark.parametrize(("entry", "words"), UNUSABLE)
def test_surveys_that_cannot_be_used_are_refused(tmp_path, entry, words):
    names = {name: tmp_path / f"{name}.fits" for name in ("map", "small", "dark", "alm")}
    for name, nside, value in (("map", NSIDE, 1.0), ("small", 8, 1.0), ("dark", NSIDE, 0.0)):
        healpy.write_map(names[name], np.full(12 * nside**2, value), dtype=np.float64)
    write_alms(names["alm"], lb.galaxy_sky(25.0, 8).modes, {})
    survey = f"{{{entry.format(**names)}, frequency_mhz: 45.0}}"
    given = f"prior={{model: local_scales, surveys: [{survey}]}}"
    refuse(words, lb.build, wrong_data.changed(wrong_data.scenario(LMAX), given))
