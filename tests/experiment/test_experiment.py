"""From a scenario to data, and from data to a map that recovers a sky."""

from dataclasses import replace

import healpy
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from assertions import refuse
from experiments import flagged, mapped
from tables import tables

import lusee_bayes as lb
from lusee_bayes.core.harmonics import map_to_modes
from lusee_bayes.experiment.model import full_model, simulate
from lusee_bayes.sky.prior import read_spectrum
from lusee_bayes.systematics.context import Around, noise_visibilities
from lusee_bayes.testing import small_scenario


def variances(setup) -> np.ndarray:
    """Diagonal of N."""
    return np.asarray(full_model(setup).noise.diagonal())


CHANGES = ["seed=3", "noise={gain: {sigma: 0.02}, beam: {parameters: {length_m: 0.1}}}"]


@pytest.mark.parametrize("override", CHANGES)
def test_neither_noise_nor_seed_enter_a_setup(override, tiny_experiment):
    experiment = lb.build(small_scenario(override))
    for name in ("coupling", "prior", "beams", "background", "signal", "sky", "responses"):
        built = jax.tree.leaves(getattr(experiment.setup, name))
        shared = jax.tree.leaves(getattr(tiny_experiment.setup, name))
        assert len(built) == len(shared)
        for one, other in zip(built, shared, strict=True):
            np.testing.assert_array_equal(one, other)
    setup = replace(tiny_experiment.setup, scenario=experiment.scenario)
    np.testing.assert_array_equal(experiment.data.data, simulate(setup).data)


def test_flagged_data_are_left_out_of_a_and_n(small_experiment):
    setup, whole = small_experiment.setup, small_experiment.data
    flags = np.zeros((16, setup.observation.n_times), dtype=bool)
    flags[3, 5] = flags[:, 10] = True
    gapped, keep = lb.build(small_experiment.scenario, flagged(whole, flags)), ~flags.ravel()
    rows = np.asarray(setup.coupling.dense())[keep]
    np.testing.assert_array_equal(gapped.setup.coupling.dense(), rows)
    np.testing.assert_array_equal(variances(gapped.setup), variances(setup)[keep])
    # leaving a sample out is the limit of giving it no weight
    noise = lb.DiagonalCovariance(jnp.asarray(np.where(keep, variances(setup), 1e30)))
    limit = lb.LinearGaussian(setup.coupling, setup.prior, noise).condition(whole.data).posterior
    posterior = full_model(gapped.setup).condition(gapped.data.data).posterior
    assert float(jnp.abs((posterior.mean - limit.mean) / posterior.std()).max()) < 1e-6


def test_measured_temperatures(small_experiment):
    setup, data = small_experiment.setup, small_experiment.data
    measured = noise_visibilities(setup, Around(data), "measured")
    np.testing.assert_array_equal(measured, data.layout.scatter(data.data))
    flags = np.zeros(measured.shape, dtype=bool)
    flags[2, 4] = True
    gapped = noise_visibilities(setup, Around(flagged(data, flags)), "measured")
    np.testing.assert_array_equal(gapped[~flags], measured[~flags])
    np.testing.assert_allclose(gapped[2, 4], (measured[2, 3] + measured[2, 5]) / 2, rtol=1e-14)
    flags[0] = True
    words = "auto 00R is missing .* use noise.radiometer"
    refuse(words, noise_visibilities, setup, Around(flagged(data, flags)), "measured")


def test_the_map_recovers_the_sky(small_experiment):
    experiment = small_experiment
    _, channel = mapped(experiment)
    # z^2 of the truth averaged over 49 modes: a sky that is no Gaussian draw but has the
    # prior's spectrum stays well below twice its expectation
    assert np.mean(((channel.mean - np.asarray(experiment.data.truth)) / channel.std) ** 2) < 2.0
    scatter = np.sqrt(2 * experiment.data.layout.size)
    assert channel.chi2 == pytest.approx(channel.chi2_expected, abs=5 * scatter)


@pytest.mark.long
def test_the_main_job_on_ulsa(test_data):
    # thresholds from the first attempt on record: rho > 0.9 to ell 10, > 0.5 to 28, cross >= 20
    path = test_data / "ulsa" / "exp10.0MHz_sky_map_with_absorption.hdf5"
    scenario = lb.load_scenario("fiducial", [f"sky.file={path}", "frequency_mhz=10"])
    _, channel = mapped(lb.build(scenario))
    spectra = channel.spectra()
    assert spectra["rho"][1:11].min() > 0.9 and spectra["rho"][1:29].min() > 0.5
    assert channel.ell_cross >= 20
    # residuals at the few per cent level away from the cap that never rises
    maps, away = channel.maps(), channel.highest_altitude > np.sin(np.radians(10.0))
    assert np.median(np.abs(maps["residual"][away])) / maps["truth"].mean() < 0.05


FILE_LMAX, NSIDE = 6, 16


@pytest.fixture
def files(tmp_path, monkeypatch):
    """C_ell and a mean map, in the current folder: paths are relative to it, as all are."""
    monkeypatch.chdir(tmp_path)
    ell = np.arange(12)
    spectrum = 1e9 * (ell + 1.0) ** -2.0
    lines = [f"{k} {c:.17g}" for k, c in zip(ell, spectrum, strict=True)]
    (tmp_path / "cl.txt").write_text("# ell C_ell\n" + "\n".join(lines) + "\n")
    theta, phi = healpy.pix2ang(NSIDE, np.arange(12 * NSIDE**2))
    pixels = 3e4 * (1.0 + 0.3 * np.cos(theta) + 0.2 * np.sin(theta) * np.cos(phi))
    healpy.write_map("mean.fits", pixels, coord="G", column_units="K", dtype=np.float64)
    return spectrum, pixels


def test_the_map_is_that_of_the_same_prior_in_python(files, tmp_path):
    spectrum, pixels = files
    own = "prior={spectrum_file: cl.txt, mean_file: mean.fits}"
    scenario = small_scenario(own, lmax=FILE_LMAX, cycles=0.1)
    experiment = lb.build(scenario)
    found = lb.infer(experiment).posterior
    prior = lb.HarmonicPrior(spectrum[: FILE_LMAX + 1], mean=map_to_modes(pixels, FILE_LMAX))
    model = replace(full_model(experiment.setup), prior=prior)
    ours = model.condition(experiment.data.data).posterior
    # the same numbers through the same code
    np.testing.assert_allclose(found.mean, ours.mean, rtol=1e-12)
    np.testing.assert_allclose(found.log_evidence, ours.log_evidence, rtol=1e-12)
    # and what it says is what was said: without data there is the prior alone
    assert not np.allclose(found.mean, full_model(experiment.setup).prior.mean)
    (tmp_path / "again.yaml").write_text(scenario.to_yaml())
    assert lb.load_scenario(tmp_path / "again.yaml") == scenario


def test_files_of_another_frequency_are_scaled(files):
    spectrum, pixels = files
    own = "prior={spectrum_file: cl.txt, mean_file: mean.fits, file_frequency_mhz: 50, scale: 2}"
    prior = small_scenario(own, lmax=FILE_LMAX).prior.prior(lb.galaxy_sky(25.0, FILE_LMAX))
    # half the frequency: 2^2.5 times as bright
    np.testing.assert_allclose(prior.spectrum, 2 * 2**5 * spectrum[: FILE_LMAX + 1], rtol=1e-14)
    np.testing.assert_allclose(prior.mean, 2**2.5 * map_to_modes(pixels, FILE_LMAX), rtol=1e-14)


@pytest.mark.parametrize(("text", "words"), tables(__file__)["bad spectra"])
def test_a_bad_spectrum_is_refused(write, text, words):
    refuse(words, read_spectrum, write(text, "cl.txt"), FILE_LMAX)


def test_missing_and_coarse_files_are_refused(files):
    sky = lb.galaxy_sky(25.0, FILE_LMAX)
    healpy.write_map("coarse.fits", np.ones(12), coord="G", dtype=np.float64)
    for override, words in (
        ("prior.spectrum_file=no.txt", "check prior.spectrum_file"),
        ("prior.mean_file=no.fits", "check prior.mean_file"),
        ("prior.mean_file=coarse.fits", "too large for a map of NSIDE 1"),
    ):
        refuse(words, small_scenario(override).prior.prior, sky)
