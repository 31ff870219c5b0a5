"""Receivers, ground and gain table of channels: their skies and unknowns as one dense Gaussian."""

import shutil
from dataclasses import replace
from html import unescape
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from assertions import assert_same_map, within
from experiments import DenseChannels, channels_of, four_ports, unknowns_report
from matplotlib.figure import Figure
from reference_linear import Answer, white_posterior
from scipy.linalg import block_diag

import lusee_bayes as lb
from lusee_bayes.core.harmonics import per_mode
from lusee_bayes.experiment.model import set_up, true_values
from lusee_bayes.report.pages import map_page
from lusee_bayes.results import sky_spectrum
from lusee_bayes.runs import channels, map_run
from lusee_bayes.runs.channels import map_channels

FREQUENCIES, OCTAVES = np.array([15.0, 20.0, 22.0]), 0.4
NOT_SMOOTH = "noise.receiver={power_k: 20000, slope: -2, relative_std: 0.5}"
RECEIVER = f"{NOT_SMOOTH[:-1]}, smooth_octaves: {OCTAVES}}}"
GROUND = "noise.regolith={std_k: 2000}"
# a tenth of the sky, so that the data leave something of the powers to the other channels
NOISE = "noise.radiometer.factor=1e8"
# of receivers whose powers are known better, of channels that are not smooth
PLAIN = "noise.receiver={power_k: 2000, slope: -2}", "noise.regolith={std_k: 30}"
TABLE = "noise.gain_table={std: 0.01}"
N_MODES, N_PORTS, N_OWN, N_DRAWS = 16, 4, 5, 2000
# of conditions of 1e4 or so
ROUNDING = 1e-10
# of two solutions of the same equations, in standard deviations: z is a difference of data and
# prediction, 1e5 times the noise
ROUGH = 1e-5


def cube_of(response_file, *overrides, frequencies="[15, 20, 22]"):
    return four_ports(response_file, *overrides, f"frequencies_mhz={frequencies}")


def ties(frequencies) -> np.ndarray:
    return np.exp(-0.5 * (np.log2(frequencies[:, None] / frequencies) / OCTAVES) ** 2)


@pytest.fixture(scope="module", autouse=True)
def independent():
    """Skies as independent as the oracle's; test_shared_instrument.py has those that are alike."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sky_spectrum, "correlation_of_departures", lambda u: np.eye(len(u)))
        yield


@pytest.fixture(scope="module")
def scenario(response_file):
    return cube_of(response_file, NOISE, RECEIVER, GROUND, f"output={{draws: {N_DRAWS}}}")


@pytest.fixture(scope="module")
def dense(scenario) -> DenseChannels:
    return DenseChannels.of(scenario)


@pytest.fixture(scope="module")
def expected(dense) -> Answer:
    return solved(dense, (0, 1, 2))


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("smooth")


@pytest.fixture(scope="module")
def cube(scenario, folder):
    return map_channels(scenario, folder)


def solved(dense: DenseChannels, used: tuple[int, ...]) -> Answer:
    """Given the data of some channels: a sky and five unknowns of every one."""
    n, size = len(dense.data), N_MODES + N_OWN
    root = np.linalg.cholesky(ties(FREQUENCIES))
    unmixed = block_diag(*(np.diag([*std, 0.0, 0.0, 0.0, 0.0, 1.0]) for std in dense.prior))
    for port in range(N_MODES, N_MODES + N_PORTS):
        unmixed[port::size, port::size] = root
    own = (np.concatenate(x, axis=1) for x in zip(dense.couplings, dense.templates, strict=True))
    taken = np.repeat([k in used for k in range(n)], [len(rest) for rest in dense.data])
    every = (block_diag(*own), np.concatenate(dense.noise), np.concatenate(dense.data))
    rows, noise, rest = (x[taken] for x in every)
    white = white_posterior(rows @ unmixed, np.ones(n * size), noise, rest)
    return Answer(unmixed @ white.mean, unmixed @ white.covariance @ unmixed.T, white.log_prob)


def part(k: int, sky: bool = True) -> slice:
    start = k * (N_MODES + N_OWN)
    return slice(start, start + N_MODES) if sky else slice(start + N_MODES, start + 21)


@pytest.mark.essential
def test_skies_and_evidence_are_those_of_one_normal_equation(cube, dense, expected):
    for k, channel in enumerate(cube.channels):
        own = part(k)
        covariance = expected.covariance[own, own]
        assert_same_map(channel, Answer(expected.mean[own], covariance, 0.0), ROUNDING)
        bits = np.log2(dense.prior[k]).sum() - 0.5 * np.linalg.slogdet(covariance)[1] / np.log(2)
        assert channel.information_bits == pytest.approx(bits, abs=N_MODES * ROUNDING)
    assert cube.log_evidence == pytest.approx(expected.log_prob, rel=ROUNDING)
    assert abs(cube.log_evidence - sum(channel.log_evidence for channel in cube.channels)) > 0.1
    # other channels do tell: each channel's own posterior would be seen
    own = solved(dense, (1,))
    assert (own.std / expected.std)[part(1)].max() > 1.05
    assert (np.abs(own.mean - expected.mean) / expected.std)[part(1)].max() > 0.05


@pytest.mark.essential
def test_chi2_is_about_what_the_others_tell_of_the_receivers(cube, dense, expected):
    """N of a channel given the others' data: with the covariance that they leave to its five."""
    for k, channel in enumerate(cube.channels):
        others = solved(dense, tuple(j for j in range(3) if j != k))
        t, a, z = dense.templates[k], dense.couplings[k], part(k, sky=False)
        noise = np.diag(dense.noise[k] ** 2) + t @ others.covariance[z, z] @ t.T
        rest = dense.data[k] - t @ others.mean[z] - a @ expected.mean[part(k)]
        chi2 = rest @ np.linalg.solve(noise, rest)
        information = a.T @ np.linalg.solve(noise, a)
        degrees = len(rest) - np.vdot(information, expected.covariance[part(k), part(k)])
        assert channel.chi2 == pytest.approx(chi2, rel=ROUNDING)
        assert channel.chi2_expected == pytest.approx(degrees, rel=ROUNDING)


@pytest.mark.essential
def test_receivers_and_ground_are_those_of_one_normal_equation(cube, expected):
    for k, channel in enumerate(cube.channels):
        table, own = channel.unknowns.table, part(k, sky=False)
        scale = table["prior_std"].to_numpy()
        z = (table["value"] - table["prior"]) / scale
        assert list(table["unknown"]) == [*(f"receiver_{i}_k" for i in range(4)), "regolith_k"]
        assert np.abs((z - expected.mean[own]) / expected.std[own]).max() < ROUNDING
        np.testing.assert_allclose(table["std"] / scale, expected.std[own], rtol=ROUNDING)
    assert any("smooth over 0.4 octaves" in line for line in cube.lines())


@pytest.mark.essential
def test_draws_are_of_all_channels_together(cube, expected):
    """Covariances of white draws scatter by 1 / sqrt(n), their squares by sqrt(2 / n)."""
    every = np.r_[part(0), part(1), part(2)]
    lower = np.linalg.cholesky(expected.covariance[np.ix_(every, every)])
    draws = np.concatenate([channel.draws for channel in cube.channels], axis=1)
    assert draws.shape == (N_DRAWS, 48)
    white = np.linalg.solve(lower, (draws - expected.mean[every]).T)
    assert np.abs(white.mean(1)).max() < 4.5 / np.sqrt(N_DRAWS)
    off = white @ white.T / N_DRAWS - np.eye(48)
    assert np.abs(off - np.diag(np.diag(off))).max() < 5 / np.sqrt(N_DRAWS)
    assert np.abs(np.diag(off)).max() < 5 * np.sqrt(2 / N_DRAWS)


@pytest.mark.long
def test_a_resumed_run_is_the_same(scenario, folder, cube, tmp_path, monkeypatch):
    shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
    (tmp_path / "channels" / "22.result.nc").unlink()
    monkeypatch.setattr(channels, "conditioned", None)
    resumed = map_channels(scenario, tmp_path)
    assert resumed.log_evidence == cube.log_evidence
    for here, there in zip(resumed.channels, cube.channels, strict=True):
        np.testing.assert_array_equal(here.draws, there.draws)
        np.testing.assert_array_equal(here.mean, there.mean)
        assert here.coverage == there.coverage != ()


@pytest.mark.long
def test_simulated_receivers_have_the_covariance(response_file):
    """Over seeds, ports and pairs of frequencies: products of normals scatter by 1 to sqrt 2."""
    scenario = cube_of(response_file, NOISE, RECEIVER)
    setup, n_seeds = set_up(scenario.channels()[0]), 150
    values = np.zeros((n_seeds, 3, N_PORTS))
    for seed in range(n_seeds):
        for k, channel in enumerate(scenario.model_copy(update={"seed": 10 * seed}).channels()):
            truth = true_values(replace(setup, scenario=channel))
            mean = 20000.0 * (channel.frequency_mhz / 10.0) ** -2
            powers = np.array([truth[f"receiver_{port}_k"] for port in range(N_PORTS)])
            values[seed, k] = (powers / mean - 1.0) / 0.5
    flat = values.reshape(n_seeds, -1)
    found, wanted = flat.T @ flat / n_seeds, np.kron(ties(FREQUENCIES), np.eye(N_PORTS))
    assert np.abs(found - wanted).max() < 4.5 * np.sqrt(2 / n_seeds)
    assert np.abs(flat.mean(0)).max() < 4.0 / np.sqrt(n_seeds)
    # a smooth function: between 20 and 22 MHz, 0.1375 octaves apart, a third of what it varies by
    steps, variance = values[:, 1] - values[:, 2], 2.0 * (1.0 - wanted[4, 8])
    assert steps.var() == pytest.approx(variance, rel=4 * np.sqrt(2 / (4 * n_seeds)))


def test_seeds_of_simulated_receivers(response_file):
    """A cube has one function; another seed, port or treatment of the scenario another, or not."""
    scenario = cube_of(response_file, NOISE, RECEIVER)
    assert {c.instrument_seed for c in scenario.channels()} == {scenario.seed}
    assert len({c.seed for c in scenario.channels()}) == 3
    one = four_ports(response_file, RECEIVER, "frequency_mhz=22")
    setup = set_up(scenario.channels()[2])
    assert true_values(setup) == true_values(replace(setup, scenario=one))


@pytest.mark.essential
@pytest.mark.usefixtures("numbers_alone")
def test_after_earlier_data_residuals_are_those_of_the_new_ones(response_file, tmp_path):
    """No other frequency is near: what ties channels changes none of their numbers."""
    given = (response_file, NOISE, GROUND, "output={draws: 50, information: true}")
    alone, tied = (
        cube_of(*given, receiver, frequencies="[15, 20]")
        for receiver in (NOT_SMOOTH, f"{NOT_SMOOTH[:-1]}, smooth_octaves: 0.01}}")
    )
    lb.run_map(alone, tmp_path / "first")
    new = channels_of(alone.model_copy(update={"seed": 7}))
    made = [
        lb.run_map(scenario, tmp_path / name, data=new, earlier=tmp_path / "first").result
        for name, scenario in (("alone", alone), ("tied", tied))
    ]
    for expected, got in zip(*(one.channels for one in made), strict=True):
        assert got.n_data == expected.n_data == new[0].layout.size
        for name in ("chi2", "chi2_expected", "chi2_model"):
            assert getattr(got, name) == pytest.approx(getattr(expected, name), rel=1e-6)
        # of 16 modes: half a chi^2 of 16 about the likelihood of the mean, 50 times
        assert got.log_likelihood.mean() == pytest.approx(expected.log_likelihood.mean(), abs=5.0)


# --- channels of their own, and joint ones -------------------------------------------------------


@pytest.mark.long
def test_a_channel_has_those_of_its_own_map(response_file, tmp_path, monkeypatch):
    drawn = dict.fromkeys(map_run.MAP.figures, lambda _: Figure())
    drawn["unknowns"] = map_run.MAP.figures["unknowns"]
    monkeypatch.setattr(map_run, "MAP", replace(map_run.MAP, figures=drawn))
    scenario = cube_of(response_file, *PLAIN, TABLE, frequencies="[15, 20]")
    run = lb.run_map(scenario, tmp_path / "cube")
    written = pd.read_csv(tmp_path / "cube" / "unknowns.csv", keep_default_na=False)
    assert list(written)[:3] == ["frequency_mhz", "unknown", "unit"]
    nulls = {}
    for channel in run.result.scenario.channels():
        experiment = lb.build(channel)
        expected = unknowns_report(experiment, lb.infer(experiment))
        nulls[channel.frequency_mhz] = expected.null
        here = written[written["frequency_mhz"] == channel.frequency_mhz].reset_index(drop=True)
        assert list(here["unknown"]) == list(expected.table["unknown"]) and len(here) == 9
        off = (here["value"] - expected.table["value"]) / expected.table["std"]
        assert np.abs(off).max() < ROUGH
        for name in ["std", "prior", "prior_std", "true"]:
            np.testing.assert_allclose(here[name], expected.table[name], rtol=ROUGH)
        (found,) = (c for c in run.result.channels if c.frequency_mhz == channel.frequency_mhz)
        assert found.unknowns.null.names == expected.null.names
        assert found.unknowns.null.share == pytest.approx(expected.null.share, rel=ROUGH)
        np.testing.assert_allclose(found.unknowns.null.weights, expected.null.weights, atol=1e-4)
    # the mean power of receivers goes with frequency
    receivers = written[written["unknown"] == "receiver_0_k"]["prior"]
    assert receivers.iloc[0] == pytest.approx(receivers.iloc[1] * (20.0 / 15.0) ** 2)
    lines = run.result.lines()
    untold = "Receivers, ground and gain table: the data do not constrain regolith_k (at 2 of 2 "
    (line,) = (line for line in lines if line.startswith(untold))
    (sentence,) = (line for line in lines if line.startswith("One parameter combination"))
    worst = max(nulls, key=lambda frequency: nulls[frequency].share)
    assert f"at 2 of 2 frequencies. At {worst:g} MHz ({nulls[worst].words()}, in" in sentence
    page = unescape(map_page(tmp_path / "cube", "a run"))
    assert line in page and sentence in page
    assert "Powers of receivers" in page and page.count("<td>regolith_k</td><td>K</td>") == 2


@pytest.mark.parametrize("smooth", [pytest.param(False, marks=pytest.mark.long), True])
def test_in_a_joint_posterior_they_are_those_of_all_skies_and_unknowns(
    smooth, response_file, tmp_path
):
    """Every sky and every unknown as one Gaussian in NumPy."""
    own = (NOISE, RECEIVER, GROUND) if smooth else PLAIN
    given = (*own, "joint=true", "spectral.components=[power_law]")
    more = f"output={{draws: {N_DRAWS}, covariance: true}}"
    scenario = cube_of(response_file, *given, more, frequencies="[15, 20, 25]")
    channels = map_channels(scenario, tmp_path)
    prior = channels.joint.prior
    stds = [np.sqrt(np.asarray(per_mode(c))) for c in (prior.spectra[0], *prior.residual)]
    stds = np.concatenate([*stds, np.ones(3 * N_OWN)])
    dense, unmixed = DenseChannels.of(scenario), np.eye(len(stds))
    for port in range(4 * N_MODES, 4 * N_MODES + N_PORTS if smooth else 0):
        alike = ties(np.asarray(prior.frequencies_mhz))
        unmixed[port::N_OWN, port::N_OWN] = np.linalg.cholesky(alike)
    skies = np.zeros((3 * N_MODES, len(stds)))
    skies[:, :N_MODES] = np.kron(np.asarray(prior.mixing), np.eye(N_MODES))
    skies[:, N_MODES : 4 * N_MODES] = np.eye(3 * N_MODES)
    a = block_diag(*dense.couplings) @ skies
    a[:, 4 * N_MODES :] = block_diag(*dense.templates) @ unmixed[4 * N_MODES :, 4 * N_MODES :]
    noise, rest = np.concatenate(dense.noise), np.concatenate(dense.data)
    expected = white_posterior(a, stds, noise, rest)
    experiments = [lb.build(channel) for channel in scenario.channels()]
    tables = [unknowns_report(e, lb.infer(e)).table for e in experiments]
    alone, table = pd.concat(tables, ignore_index=True), channels.table("unknowns", "table")
    scale, own = table["prior_std"].to_numpy(), unmixed[4 * N_MODES :]
    mean, std = own @ expected.mean, np.sqrt(np.diagonal(own @ expected.covariance @ own.T))
    assert np.abs(((table["value"] - table["prior"]) / scale - mean) / std).max() < 1e-4
    np.testing.assert_allclose(table["std"], scale * std, rtol=1e-4)
    np.testing.assert_allclose(table["true"], alone["true"], rtol=1e-12)
    # other channels do tell: the test would see a table of each channel's own data
    assert (np.abs(table["value"] - alone["value"]) / table["std"]).max() > 0.05
    assert all(channel.unknowns.null is None for channel in channels.channels)
    mean, covariance = skies @ expected.mean, skies @ expected.covariance @ skies.T
    for k, channel in enumerate(channels.channels):
        sky = slice(k * N_MODES, (k + 1) * N_MODES)
        assert_same_map(channel, Answer(mean[sky], covariance[sky, sky], 0.0), 1e-4)
        gone = covariance[sky, sky] - channel.covariance
        within(gone / np.outer(channel.std, channel.std), 0.0, 1e-4)
        z = np.linalg.solve(np.linalg.cholesky(covariance[sky, sky]), (channel.draws - mean[sky]).T)
        assert np.abs(z @ z.T / N_DRAWS - np.eye(N_MODES)).max() < 5 * np.sqrt(2 / N_DRAWS)
    assert channels.log_evidence == pytest.approx(expected.log_prob, rel=1e-9)
    assert len(channels.shared_tests) == (3 if smooth else 0)
