"""Receivers whose spectra are smooth: all channels' skies and receivers as one dense Gaussian."""

import shutil
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from assertions import assert_same_map, refuse
from experiments import channels_of, four_ports
from reference_linear import Answer, white_posterior
from scipy.linalg import block_diag

import lusee_bayes as lb
from lusee_bayes.experiment.model import radiometer, set_up, true_values
from lusee_bayes.runs import channels
from lusee_bayes.runs.channels import map_channels

FREQUENCIES, OCTAVES = np.array([15.0, 20.0, 22.0]), 0.4
RECEIVER = (
    f"noise.receiver={{power_k: 20000, slope: -2, relative_std: 0.5, smooth_octaves: {OCTAVES}}}"
)
NOT_SMOOTH = "noise.receiver={power_k: 20000, slope: -2, relative_std: 0.5}"
GROUND = "noise.regolith={std_k: 2000}"
# a tenth of the sky, so that the data leave something of the powers to the other channels
NOISE = "noise.radiometer.factor=1e8"
N_MODES, N_PORTS, N_OWN, N_DRAWS = 16, 4, 5, 2000
# of conditions of 1e4 or so
ROUNDING = 1e-10


def cube_of(response_file, *overrides, frequencies="[15, 20, 22]"):
    return four_ports(response_file, NOISE, *overrides, f"frequencies_mhz={frequencies}")


def ties(frequencies) -> np.ndarray:
    octaves = np.log2(frequencies[:, None] / frequencies[None])
    return np.exp(-(octaves**2) / (2.0 * OCTAVES**2))


@dataclass
class Dense:
    """All channels in one normal equation: skies, then receivers port by port, then grounds."""

    couplings: list[np.ndarray]
    templates: list[np.ndarray]
    noise: list[np.ndarray]
    rest: list[np.ndarray]
    prior: list[np.ndarray]

    @classmethod
    def of(cls, scenario):
        found = cls([], [], [], [], [])
        for channel in scenario.channels():
            experiment = lb.build(channel)
            setup = experiment.setup
            columns = [np.asarray(s.columns) for s in lb.infer(experiment).systematics]
            found.couplings.append(np.asarray(setup.coupling.dense()))
            found.templates.append(np.concatenate(columns, axis=1))
            found.noise.append(np.sqrt(np.asarray(radiometer(setup).diagonal())))
            found.rest.append(np.asarray(experiment.data.data) - np.asarray(setup.offset))
            found.prior.append(np.sqrt(np.asarray(setup.prior.variance())))
        return found

    def solve(self, used: tuple[int, ...]) -> Answer:
        """Given the data of some channels: a sky and five unknowns of every one."""
        n = len(self.rest)
        root = np.linalg.cholesky(ties(FREQUENCIES))
        size = N_MODES + N_OWN
        unmixed = np.zeros((n * size, n * size))
        for k in range(n):
            own = slice(k * size, k * size + N_MODES)
            unmixed[own, own] = np.diag(self.prior[k])
            unmixed[k * size + 20, k * size + 20] = 1.0
            for j in range(n):
                for port in range(N_PORTS):
                    at = N_MODES + port
                    unmixed[k * size + at, j * size + at] = root[k, j]
        own = (np.concatenate(x, axis=1) for x in zip(self.couplings, self.templates, strict=True))
        taken = np.repeat([k in used for k in range(n)], [len(rest) for rest in self.rest])
        rows, noise, rest = (
            x[taken] for x in (block_diag(*own), *map(np.concatenate, (self.noise, self.rest)))
        )
        white = white_posterior(rows @ unmixed, np.ones(n * size), noise, rest)
        covariance = unmixed @ white.covariance @ unmixed.T
        return Answer(unmixed @ white.mean, covariance, white.log_prob)


@pytest.fixture(scope="module")
def scenario(response_file):
    return cube_of(response_file, RECEIVER, GROUND, f"output={{draws: {N_DRAWS}}}")


@pytest.fixture(scope="module")
def dense(scenario) -> Dense:
    return Dense.of(scenario)


@pytest.fixture(scope="module")
def expected(dense) -> Answer:
    return dense.solve((0, 1, 2))


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("smooth")


@pytest.fixture(scope="module")
def cube(scenario, folder):
    return map_channels(scenario, folder)


def part(k: int, sky: bool = True) -> slice:
    start = k * (N_MODES + N_OWN)
    return slice(start, start + N_MODES) if sky else slice(start + N_MODES, start + 21)


@pytest.mark.long
@pytest.mark.essential
def test_skies_and_evidence_are_those_of_one_normal_equation(cube, dense, expected):
    for k, channel in enumerate(cube.channels):
        own = part(k)
        covariance = expected.covariance[own, own]
        assert_same_map(channel, Answer(expected.mean[own], covariance, 0.0), ROUNDING)
        bits = np.log2(dense.prior[k]).sum() - 0.5 * np.linalg.slogdet(covariance)[1] / np.log(2)
        assert channel.information_bits == pytest.approx(bits, abs=N_MODES * ROUNDING)
    assert cube.log_evidence == pytest.approx(expected.log_prob, rel=ROUNDING)
    alone = sum(channel.log_evidence for channel in cube.channels)
    assert abs(cube.log_evidence - alone) > 0.1
    # other channels do tell: each channel's own posterior would be seen
    own = dense.solve((1,))
    assert (own.std / expected.std)[part(1)].max() > 1.05
    assert (np.abs(own.mean - expected.mean) / expected.std)[part(1)].max() > 0.05


@pytest.mark.long
@pytest.mark.essential
def test_chi2_is_about_what_the_others_tell_of_the_receivers(cube, dense, expected):
    """N of a channel given the others' data: with the covariance that they leave to its five."""
    for k, channel in enumerate(cube.channels):
        others = dense.solve(tuple(j for j in range(3) if j != k))
        t, a, z = dense.templates[k], dense.couplings[k], part(k, sky=False)
        noise = np.diag(dense.noise[k] ** 2) + t @ others.covariance[z, z] @ t.T
        rest = dense.rest[k] - t @ others.mean[z] - a @ expected.mean[part(k)]
        chi2 = rest @ np.linalg.solve(noise, rest)
        information = a.T @ np.linalg.solve(noise, a)
        degrees = len(rest) - np.vdot(information, expected.covariance[part(k), part(k)])
        assert channel.chi2 == pytest.approx(chi2, rel=ROUNDING)
        assert channel.chi2_expected == pytest.approx(degrees, rel=ROUNDING)


@pytest.mark.long
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


@pytest.mark.long
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
    scenario = cube_of(response_file, RECEIVER)
    setup, n_seeds = set_up(scenario.channels()[0]), 150
    values = np.zeros((n_seeds, 3, N_PORTS))
    for seed in range(n_seeds):
        channels = scenario.model_copy(update={"seed": 10 * seed}).channels()
        for k, channel in enumerate(channels):
            truth = true_values(replace(setup, scenario=channel))
            mean = 20000.0 * (channel.frequency_mhz / 10.0) ** -2
            powers = np.array([truth[f"receiver_{port}_k"] for port in range(N_PORTS)])
            values[seed, k] = (powers / mean - 1.0) / 0.5
    flat = values.reshape(n_seeds, -1)
    found = flat.T @ flat / n_seeds
    wanted = np.kron(ties(FREQUENCIES), np.eye(N_PORTS))
    assert np.abs(found - wanted).max() < 4.5 * np.sqrt(2 / n_seeds)
    assert np.abs(flat.mean(0)).max() < 4.0 / np.sqrt(n_seeds)
    # a smooth function: between 20 and 22 MHz, 0.1375 octaves apart, a third of what it varies by
    steps = values[:, 1] - values[:, 2]
    variance = 2.0 * (1.0 - wanted[4, 8])
    assert steps.var() == pytest.approx(variance, rel=4 * np.sqrt(2 / (4 * n_seeds)))


def test_seeds_of_simulated_receivers(response_file):
    """A cube has one function; another seed, port or treatment of the scenario another, or not."""
    scenario = cube_of(response_file, RECEIVER)
    assert {c.noise.receiver.smooth_seed for c in scenario.channels()} == {scenario.seed}
    assert len({c.seed for c in scenario.channels()}) == 3
    plain = cube_of(response_file, "noise.receiver={power_k: 2000}")
    assert all(c.noise == plain.noise for c in plain.channels())
    one = four_ports(response_file, RECEIVER, "frequency_mhz=22")
    last = scenario.channels()[2]
    setup = set_up(last)
    assert true_values(setup) == true_values(replace(setup, scenario=one))


def test_refused_in_one_sentence(response_file):
    given = response_file, "spectral={components: [power_law]}", RECEIVER
    refuse("with joint, leave it out", cube_of, *given, "joint=true")
    refuse("greater than 0", cube_of, *given, "noise.receiver.smooth_octaves=0")


@pytest.mark.usefixtures("numbers_alone")
def test_after_earlier_data_residuals_are_those_of_the_new_ones(response_file, tmp_path):
    """No other frequency is near: what ties channels changes none of their numbers."""
    given = (response_file, GROUND, "output={draws: 50, information: true}")
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
        likely = [one.log_likelihood.mean() for one in (got, expected)]
        assert likely[0] == pytest.approx(likely[1], abs=5.0)
