"""Priors of files: the same map as of the same prior built in Python."""

from __future__ import annotations

from dataclasses import replace

import healpy
import numpy as np
import pytest

import lusee_bayes as lb
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.harmonics import map_to_modes
from lusee_bayes.experiment.model import full_model
from lusee_bayes.sky.prior import read_spectrum
from lusee_bayes.testing.cases import small_scenario

LMAX, NSIDE = 6, 16


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
    scenario = small_scenario(
        "prior={spectrum_file: cl.txt, mean_file: mean.fits}", lmax=LMAX, cycles=0.1
    )
    experiment = lb.build(scenario)
    found = lb.infer(experiment).posterior
    prior = lb.HarmonicPrior(spectrum[: LMAX + 1], mean=map_to_modes(pixels, LMAX))
    model = replace(full_model(experiment.setup), prior=prior)
    ours = model.condition(experiment.data.data)
    # the same numbers through the same code
    np.testing.assert_allclose(found.mean, ours.mean, rtol=1e-12)
    np.testing.assert_allclose(found.log_evidence, ours.log_evidence, rtol=1e-12)
    # and what it says is what was said: without data there is the prior alone
    assert not np.allclose(found.mean, full_model(experiment.setup).prior.mean)
    (tmp_path / "again.yaml").write_text(scenario.to_yaml())
    assert lb.load_scenario(tmp_path / "again.yaml") == scenario


def test_files_of_another_frequency_are_scaled(files):
    spectrum, pixels = files
    scenario = small_scenario(
        "prior={spectrum_file: cl.txt, mean_file: mean.fits, file_frequency_mhz: 50, scale: 2}",
        lmax=LMAX,
    )
    sky = lb.galaxy_sky(25.0, LMAX)
    prior = scenario.prior.prior(sky)
    # half the frequency: 2^2.5 times as bright
    np.testing.assert_allclose(prior.spectrum, 2 * 2**5 * spectrum[: LMAX + 1], rtol=1e-14)
    np.testing.assert_allclose(prior.mean, 2**2.5 * map_to_modes(pixels, LMAX), rtol=1e-14)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("0 1\n1 2\n3 4\n", "no C_ell at ell = 2"),
        ("2 1\n3 2\n", "no C_ell at ell = 0"),
        ("0 1\n1 2\n", "no C_ell at ell = 2 and 4 more up to lmax = 6"),
        ("0 1\n0 2\n", "does not grow"),
        ("".join(f"{ell} 0\n" for ell in range(9)), "cl.txt: C_ell is zero"),
        ("0 -1\n", "outside 0 to inf"),
        ("0 nan\n", "NaN"),
        ("0 1 2\n", "expected ell and C_ell"),
        ("0.5 1\n", "expected ell and C_ell"),
        ("ell cl\n0 one\n", "no numbers"),
        ("", "no numbers"),
        ("\0\1", "cl.txt"),
    ],
)
def test_a_bad_spectrum_is_refused(tmp_path, text, words):
    path = tmp_path / "cl.txt"
    path.write_text(text)
    with pytest.raises(InputError) as caught:
        read_spectrum(path, LMAX)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_missing_and_coarse_files_are_refused(files):
    sky = lb.galaxy_sky(25.0, LMAX)
    with pytest.raises(InputError, match="check prior.spectrum_file"):
        small_scenario("prior.spectrum_file=no.txt").prior.prior(sky)
    with pytest.raises(InputError, match="check prior.mean_file"):
        small_scenario("prior.mean_file=no.fits").prior.prior(sky)
    healpy.write_map("coarse.fits", np.ones(12), coord="G", dtype=np.float64)
    with pytest.raises(InputError, match="too large for a map of NSIDE 1"):
        small_scenario("prior.mean_file=coarse.fits").prior.prior(sky)
