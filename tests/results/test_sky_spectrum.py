"""The spectrum of the sky: temperatures of regions, and what the errors of channels share."""

from dataclasses import replace

import healpy
import numpy as np
import pytest
import xarray as xr
from assertions import refuse, within
from astropy import units as u
from astropy.io import fits
from astropy.table import Table
from commands import run

import lusee_bayes as lb
from lusee_bayes.core.harmonics import averaging_rows, modes_to_map, per_mode, taper
from lusee_bayes.report.figures.maps import spectrum_figure
from lusee_bayes.results import sky_spectrum as sp
from lusee_bayes.results.signal_limit import TERM, named_template, signal_limit
from lusee_bayes.sky.prior import IndependentPrior

SMALL = ["lmax=4", "observation.runs.0.cycles=0.1", "prior={model: isotropic, spectrum: sky}"]


def test_published_spectra_are_brightness_temperatures():
    """Against astropy's equivalency, with the formulae written out at two frequencies."""
    for f, tau in ((5.0, 5.0 * 5.0**-2.1), (20.0, 5.0 * 20.0**-2.1)):
        poles = 2.48e-20 * f**-0.52 * (1 - np.exp(-tau)) / tau + 1.06e-20 * f**-0.8 * np.exp(-tau)
        whole = 1.38e-19 * f**-0.76 * np.exp(-3.28 * f**-0.64)
        for law, intensity in ((sp.cane_1979, poles), (sp.novaco_brown_1978, whole)):
            of = intensity * u.W / u.m**2 / u.Hz / u.sr
            expected = of.to(u.Jy / u.sr).to_value(u.K, u.brightness_temperature(f * u.MHz))
            assert law(np.array([f]))[0] == pytest.approx(expected, rel=1e-9)


def test_index_and_turnover_are_those_of_a_parabola():
    """Draws of known parabolas; errors as least squares propagates them, to 5 / sqrt(2 x 4000)."""
    f, rng = np.geomspace(2.0, 50.0, 7), np.random.default_rng(5)
    x = np.log(f / 10.0)
    design = np.stack([np.ones(7), x, x**2], axis=1)
    cells = np.array([[9.0, -2.5, 0.0], [9.0, -1.0, -1.5], [9.0, -2.2, -0.3]]).T
    relative = np.linspace(0.01, 0.03, 7)[:, None, None]
    skies = np.exp(design @ cells)[:, None] * np.exp(relative * rng.normal(size=(7, 4000, 3)))
    skies[3, :400, 2] = -1.0  # a tenth of the draws has no logarithm
    found = sp.IndexMaps.of(f, skies)
    assert found.reference_mhz == pytest.approx(10.0)
    weighted = design / relative[:, 0]
    std = np.sqrt(np.diag(np.linalg.inv(weighted.T @ weighted)))
    for k, name in enumerate(("index", "curvature"), 1):
        within(found.maps[f"{name}_std"][:2] / std[k], 1.0, 5.0 / np.sqrt(8000.0))
        within(found.maps[name][:2], cells[k, :2], 5.0 * std[k] / np.sqrt(4000.0))
    # the first has none in the band; d ln T / dx = 0 at x = -b / 2 c
    turnover, gradient = 10.0 * np.exp(-1.0 / 3.0), np.array([0.0, 1.0, -2.0 / 3.0]) / 3.0
    expected = turnover * np.sqrt(gradient @ np.linalg.inv(weighted.T @ weighted) @ gradient)
    assert found.maps["turnover"][1] == pytest.approx(turnover, abs=0.1 * expected)
    assert found.maps["turnover_std"][1] == pytest.approx(expected, rel=0.06)
    assert np.isnan(found.maps["turnover"][[0, 2]]).all()
    assert all(np.isnan(values[2]) for values in found.maps.values())


def test_rows_average_the_pixels_of_a_map():
    rng = np.random.default_rng(1)
    inside, sky = rng.random((2, healpy.nside2npix(8))) < 0.2, rng.normal(size=36)
    means = [modes_to_map(sky, 8)[one].mean() for one in inside]
    within(averaging_rows(inside, 5) @ sky, means, 1e-12)


@pytest.mark.parametrize("joint", [[], pytest.param(["joint=true"], marks=pytest.mark.long)])
def test_files_have_the_spectrum_with_its_covariance(joint, tmp_path, capsys):
    frequencies = ["frequencies_mhz=[18, 20, 25, 30]", "noise.radiometer.factor=1e6"]
    scenario = lb.load_scenario("fiducial", [*SMALL, *frequencies, *joint])
    result = lb.run_map(scenario, tmp_path / "cube").result
    spectrum = result.sky_spectrum()
    table = Table.read(tmp_path / "cube" / "spectrum.ecsv")
    assert table["temperature_k"].unit == "K" and len(table) == 20
    with xr.open_dataset(tmp_path / "cube" / "spectrum.nc", engine="h5netcdf") as file:
        within(file["covariance"] / spectrum.covariance, 1.0, 1e-12)
        std = np.sqrt(np.einsum("aff->af", file["covariance"].values))
        assert file["temperature"].attrs["units"] == "K" and file["truth"].shape == (5, 4)
    within(table["std_k"], std.ravel(), 1e-9)
    for k, channel in enumerate(result.channels):
        monopole = channel.mean[0] / np.sqrt(4.0 * np.pi)
        assert spectrum.temperature[0, k] == pytest.approx(monopole, rel=1e-9)
        assert std[0, k] == pytest.approx(channel.std[0] / np.sqrt(4.0 * np.pi), rel=1e-6)
    for one in spectrum.covariance:
        assert np.linalg.eigvalsh(one).min() > 0.0
    assert run("spectrum", tmp_path / "cube", "--signal", "trough:24:2", "--order", "1") == 0
    printed = capsys.readouterr().out
    assert "largest share from" in printed and "trough at 24 MHz" in printed
    (tmp_path / "rae.csv").write_text("frequency_mhz,temperature_k\n19,8e4\n22,5e4\n")
    shown = ["--figure", tmp_path / "spectrum.png", "--table", tmp_path / "rae.csv"]
    assert run("spectrum", tmp_path / "cube", *shown[2:]) == 2
    assert "give --figure" in capsys.readouterr().err
    assert run("spectrum", tmp_path / "cube", *shown) == 0
    assert (tmp_path / "spectrum.png").read_bytes().startswith(b"\x89PNG")
    axes = spectrum_figure(spectrum, [tmp_path / "rae.csv"]).axes[0]
    drawn = {one.get_label(): one.lines[0].get_xydata() for one in axes.containers}
    within(drawn["rae"], [[19.0, 8e4], [22.0, 5e4]], 1e-12)
    within(drawn["mean sky"][:, 1] / spectrum.temperature[0], 1.0, 1e-12)
    page = (tmp_path / "cube" / "report.html").read_text(encoding="utf-8")
    assert "cap b &lt; -60" in page and "Novaco" not in page
    assert (tmp_path / "cube" / "index.fits").exists() == bool(joint)
    assert ("Spectral index of ln T" in page) == bool(joint)
    if joint:
        index, std = healpy.read_map(tmp_path / "cube" / "index.fits", field=(0, 1))
        true = [modes_to_map(c.truth * per_mode(taper(4)), 8) for c in result.channels]
        # between the end frequencies: the embedded sky has little curvature there
        slope = np.log(true[-1] / true[0]) / np.log(30.0 / 18.0)
        assert np.mean(np.abs(index - slope) < 2.0 * std + 0.02) > 0.9 and np.median(std) < 0.1
        width = fits.getheader(tmp_path / "cube" / "index.fits", 1)["FWHM"]
        within(healpy.gauss_beam(np.radians(width), 4) - taper(4), 0.0, 1e-12)
    named = ["spectrum.nc", *["index.fits"] * bool(joint)]
    assert run("info", *[tmp_path / "cube" / name for name in named]) == 0
    printed = capsys.readouterr().out
    assert f"mean sky: {spectrum.temperature[0, 0]:.6g} to " in printed and "SkyMap" not in printed


def spectrum_of(f, temperature, covariance):
    shares = np.stack([np.full((1, len(f)), 0.9), np.full((1, len(f)), 0.1)])
    given = ("observed sky",), ("gains", "ground"), f, temperature[None], covariance[None]
    return sp.SkySpectrum(*given, None, shares)


@pytest.mark.parametrize(("injected", "found"), [(-0.025, False), (800.0, True)])
def test_limits_on_a_signal_cover_it(injected, found):
    """100 data sets of a sky that turns over, of another family than the polynomial."""
    f = np.arange(5.0, 51.0)
    sky = sp.cane_1979(f) * np.exp(-((4.0 / f) ** 2.1))
    trough = -np.exp(-0.5 * ((f - 17.5) / 3.0) ** 2)
    alike = np.exp(-0.5 * (np.log2(f[:, None] / f) / 0.3) ** 2)
    covariance = np.outer(sky, sky) * (0.7 * alike + 0.3 * np.eye(len(f))) * 1e-6
    rng, name = np.random.default_rng(5), "trough:17.5:3"
    errors = rng.multivariate_normal(np.zeros(len(f)), covariance, size=100)
    spectra = [spectrum_of(f, sky + injected * trough + one, covariance) for one in errors]
    limits = [signal_limit(one, *named_template(name)) for one in spectra]
    pulls = np.array([(one.amplitude - injected) / one.std for one in limits])
    # 100 draws: of the mean 0.1, of the rms 0.07
    assert abs(pulls.mean()) < 0.35 and abs(np.sqrt((pulls**2).mean()) - 1.0) < 0.25
    # 95 +- 2 of them; a limit is at least the amplitude
    assert sum(one.limit > abs(injected) for one in limits) >= 88
    assert all(one.limit > 1.6 * one.std for one in limits)
    assert [one.detected for one in limits].count(not found) <= 1
    assert sum(one.fit.fits for one in limits) >= 98
    expected = np.sqrt(limits[0].std ** 2 - 0.9 * limits[0].without[TERM] ** 2)
    assert limits[0].without["gains"] == pytest.approx(expected, rel=1e-6)
    assert ("detected" if found else "without errors from gains") in limits[0].sentence()


def test_a_sky_with_one_more_term_is_no_signal():
    """Its polynomial is too low by a term that looks like a trough of 1.5 standard deviations."""
    f, template = np.arange(14.0, 36.0, 3.0), named_template("trough:20:3")
    sky = sp.cane_1979(f) * np.exp(-((4.0 / f) ** 2.1))
    covariance = np.outer(sky, sky) * (0.7 + 0.3 * np.eye(len(f))) * 1e-6
    exact = signal_limit(spectrum_of(f, sky, covariance), *template, order=4)
    covariance *= (exact.amplitude / exact.without[TERM] / 1.5) ** 2
    noise = np.random.default_rng(6).multivariate_normal(np.zeros(len(f)), covariance, size=60)
    limits = [signal_limit(spectrum_of(f, sky + n, covariance), *template, order=4) for n in noise]
    whole, stds = (np.array([getattr(one, n) for one in limits]) for n in ("amplitude", "std"))
    alone = whole / [one.without[TERM] for one in limits]
    assert (alone**2).mean() > 1.5**2 and ((whole / stds) ** 2).mean() < 1.1**2
    assert sum(one.fit.fits for one in limits) >= 58


@pytest.mark.parametrize("order", [3, 4, 5])
def test_a_power_law_that_a_smooth_sky_contains_is_not_detected(order):
    """The whole sky may be "excess": only chi^2 tells, which is that of noise."""
    f = np.linspace(12.0, 45.0, 12)
    sky, rng = sp.cane_1979(f) * np.exp(-((4.0 / f) ** 2.1)), np.random.default_rng(8)
    covariance = np.outer(sky, sky) * (0.5 + 0.5 * np.eye(len(f))) * 9e-6
    seen, excess = rng.multivariate_normal(sky, covariance, 40), named_template("excess")
    limits = [signal_limit(spectrum_of(f, y, covariance), *excess, order=order) for y in seen]
    assert not any(one.detected for one in limits) and all(one.limit > 0 for one in limits)
    assert 0.3 < np.sqrt(np.mean([(one.amplitude / one.std) ** 2 for one in limits])) < 1.3


def test_templates_and_what_has_no_limit(write):
    f = np.arange(5.0, 51.0)
    bent = spectrum_of(f, 1e5 * (1.0 + 0.5 * np.sin(f)), np.eye(len(f)))
    assert "raise --order" in signal_limit(bent, *named_template("constant")).sentence()
    file = write("frequency_mhz,temperature_k\n10,0\n20,-0.02\n30,0\n", "dip.csv")
    name, template = named_template(str(file))
    assert name == "dip, at its peak"
    np.testing.assert_array_equal(template(np.array([15.0, 31.0])), [-0.5, np.nan])
    assert named_template("excess")[1](np.array([20.0]))[0] == 1.0
    for text in ("trough:1", "trough:17:0", "nothing"):
        refuse("expected trough|no template", named_template, text)
    refuse("no region", signal_limit, bent, *named_template("excess"), region="cap")
    refuse("vanishes", signal_limit, bent, *named_template("trough:900:1"))
    refuse("--order is -1", signal_limit, bent, *named_template("excess"), order=-1)
    few = spectrum_of(f[:6], bent.temperature[0, :6], np.eye(6))
    refuse("at least 9", signal_limit, few, *named_template("excess"))


def test_skies_that_are_alike_have_errors_that_are_alike():
    """Two channels measure some departures of their skies and miss others: errors of 4000 skies.

    A measured mean is (1 - c) u + noise of variance c (1 - c), with the posterior variance c.
    """
    rng, rho, c = np.random.default_rng(3), 0.9, np.repeat([1e-4, 0.5, 0.95], [100, 50, 50])
    row, u = rng.normal(size=200), rng.normal(size=(4000, 2, 200))
    u[:, 1] = rho * u[:, 0] + np.sqrt(1.0 - rho**2) * u[:, 1]
    means = (1.0 - c) * u + np.sqrt(c * (1.0 - c)) * rng.normal(size=u.shape)
    errors = np.cov(((means - u) @ row).T)
    given, none = (("sky",), ()), np.zeros((1, 0))
    std, zero = np.sqrt([row**2 @ c]), np.zeros(1)
    channel = sp.RegionTemperatures(*given, zero, std, None, none, none.T, none.T, None)
    measured = [mean / np.sqrt(mean**2 @ (1.0 - c)) for mean in means[0]]
    departures = [sp.Departure(mean, (row * c)[None], none) for mean in measured]
    each = [(mhz, channel, one) for mhz, one in zip([10.0, 11.0], departures, strict=True)]
    covariance = sp.SkySpectrum.of(each).covariance[0]
    # 1 / sqrt(4000) of the draws, 1 / sqrt(150) of the measured correlation; three of each
    np.testing.assert_allclose(np.diag(covariance), np.diag(errors), rtol=0.07)
    assert covariance[0, 1] == pytest.approx(errors[0, 1], rel=0.15)
    assert errors[0, 1] > 0.5 * errors[0, 0]
    noise = lb.DiagonalCovariance(np.ones(9))
    # unknown maps of a joint posterior: its covariance between channels, not that of its draws
    posterior = lb.LinearGaussian(rng.normal(size=(9, 4)), IndependentPrior(np.ones(4)), noise)
    posterior = posterior.condition(np.ones(9)).posterior
    slopes = rng.normal(size=(3, 1, 4))
    each = [replace(channel, common=one, draws=np.zeros((5, 1))) for one in slopes]
    each = sp.combined(each, posterior)
    covariance = sp.SkySpectrum.of([(0.0, one, None) for one in each]).covariance[0]
    exact = slopes[:, 0] @ posterior.covariance() @ slopes[:, 0].T
    np.testing.assert_allclose(covariance[np.tril_indices(3, -1)], exact[np.tril_indices(3, -1)])
