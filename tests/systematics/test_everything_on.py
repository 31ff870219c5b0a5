"""Gains, ground, arms, clock, turntable and receivers, all unknown, found together with the sky."""

from dataclasses import replace
from pathlib import Path

import healpy
import numpy as np
import pandas as pd
import pytest
from experiments import pulls, rms_of_directions, with_known_sky
from scipy.stats import chi2 as stats_chi2
from scipy.stats import kstest, norm

import lusee_bayes as lb
from lusee_bayes.core.harmonics import modes_to_map
from lusee_bayes.experiment import experiment, rounds
from lusee_bayes.experiment.model import set_up, simulate
from lusee_bayes.experiment.scenario import Scenario
from lusee_bayes.linear.amplitudes import template_amplitudes
from lusee_bayes.runs import channels
from lusee_bayes.sampling.programs import require_sampleable
from lusee_bayes.systematics.context import Around, Setup

SKIES = {10.0: "ulsa/exp10.0MHz_sky_map_with_absorption.hdf5", 25.0: "surveys/gsm2008_25MHz.fits"}
# half a percent of gains, 5 % of the ground, 0.3 degrees of the arms, 20 s, 0.2 degrees, 10 %
ANTENNAS = {"surface_permittivity": 0.185, "deep_permittivity": 0.3, "zenith_angle_deg": 0.3}
NOISE = {
    "gain": {"sigma": 0.005},
    "beam": {"parameters": ANTENNAS},
    "pointing": {"clock_s": 20.0, "turntable_deg": 0.2},
    "receiver": {"power_k": 2e4, "relative_std": 0.1},
}
# data sets of a calibration
N = 40


def scenario(mhz: float, angles: int, **more) -> Scenario:
    runs = [{"cycles": 1.0, "turntable_deg": 30.0 * k} for k in range(angles)]
    observation = {"runs": runs, "step_s": more.pop("step_s", 7200.0)}
    tree = {"frequency_mhz": mhz, "noise": NOISE, "observation": observation}
    return Scenario.model_validate(tree | more)


def of_another_sky(folder: Path, mhz: float, angles: int, **more) -> tuple[Setup, rounds.Inference]:
    """Infer what data of a published map tell, which is not drawn from the prior."""
    file = SKIES[mhz]
    if not (folder / file).exists():
        pytest.skip(f"needs {folder / file}")
    sky = {"model": "file", "file": str(folder / file), "file_frequency_mhz": mhz}
    truth = set_up(scenario(mhz, angles, sky=sky, **more))
    return truth, lb.infer(lb.build(scenario(mhz, angles, **more), data=simulate(truth)))


@pytest.mark.essential
def test_all_are_found_together(test_data):
    more = {"lmax": 6, "step_s": 21600.0, "prior": {"model": "isotropic"}, "seed": 1}
    truth, found = of_another_sky(test_data, 10.0, 2, **more)
    away = pulls(truth, found)
    assert len(away) == 3 + 3 + 4
    assert not found.unsettled and found.rounds < 20
    assert 0.75 < rms_of_directions(found, truth.sky.modes) < 1.25
    assert max(map(abs, away.values())) < 3.5


@pytest.mark.long
def test_every_unknown_can_be_sampled_beside_all_others(monkeypatch):
    """Programs are traced, not run; what N is about does not matter."""
    for limit in ("MAX_ROUNDS", "MAX_TEMPERED_ROUNDS"):
        monkeypatch.setattr(rounds, limit, 2)
    more = {
        "gain_table": {"std": 0.005},
        "horizon": {"altitude_deg": 3.0, "std_deg": 1.0, "harmonics": 1},
        "fields": {"lmax": 2},
        "polarisation": {"linear": 0.01, "lmax": 2},
    }
    everything = NOISE | more
    given = {"sky": {"sources": False}, "step_s": 5e5, "lmax": 2}
    for kept in ("gain", "beam"):
        noise = {
            key: {**section, "treatment": "marginalised" if key == kept else "sampled"}
            for key, section in everything.items()
        }
        sources = {"list": [{"name": "Cas A"}], "treatment": "sampled"}
        made = lb.build(scenario(10.0, 2, noise=noise, sources=sources, **given))
        program, found = lb.load_program("systematics"), lb.infer(made)
        arguments = program.arguments(found.model, experiment.program_pieces(made))
        latent = require_sampleable(program, arguments, np.asarray(made.data.data), 9)
        # so many errors of fields, or of gains, are sampled with the sky
        assert "sky" in latent and len(latent) > 10


@pytest.mark.long
def test_error_bars_of_all_together_are_right():
    """Skies and instruments drawn from their priors: chi^2 of sky and of ten unknowns, and ranks.

    The sky is known to a fifth, so that none is without a signal.
    """
    more = {"lmax": 4, "step_s": 86400.0, "prior": {"model": "isotropic", "spectrum": "sky"}}
    first = with_known_sky(set_up(scenario(10.0, 2, **more)), 0.04)
    prior, chi2, below = first.prior, [], []
    for seed in range(N):
        own = replace(first, scenario=first.scenario.model_copy(update={"seed": seed}))
        white = np.random.default_rng(seed).standard_normal(prior.size)
        sky = np.asarray(prior.colour(white)) + np.asarray(prior.mean)
        truth = own.under(replace(own.sky, modes=sky))
        found = rounds.settled(replace(own, measured=True), Around(simulate(truth)))
        assert not found.unsettled
        columns = np.concatenate([np.asarray(part.columns) for part in found.expanded], axis=1)
        told = template_amplitudes(found.solution, columns)
        off = np.array(list(pulls(truth, found).values()))
        below.append(norm.cdf(off))
        away = off * np.concatenate([found.amplitudes(part).std for part in found.expanded])
        of_sky = prior.size * rms_of_directions(found, sky) ** 2
        chi2.append((of_sky, away @ np.linalg.solve(told.covariance, away)))
    n = prior.size, len(off)
    print(np.mean(chi2, axis=0) / n, [kstest(one, "uniform").pvalue for one in np.transpose(below)])
    for own, size in zip(np.transpose(chi2), n, strict=True):
        assert kstest(own, stats_chi2(size).cdf).pvalue > 1e-3
    assert min(kstest(one, "uniform").pvalue for one in np.transpose(below)) > 1e-3 / len(off)


@pytest.mark.long
@pytest.mark.parametrize(("mhz", "angles"), [(10.0, 1), (10.0, 2), (25.0, 1), (25.0, 2)])
def test_all_are_found_together_at_full_resolution(test_data, mhz, angles):
    truth, found = of_another_sky(test_data, mhz, angles, lmax=16, seed=1)
    away, full = pulls(truth, found), rms_of_directions(found, truth.sky.modes)
    assert not found.unsettled and found.rounds < 20
    assert 0.8 < full < 1.25
    assert max(map(abs, away.values())) < 3.5


@pytest.mark.long
def test_rounds_that_end_in_a_wrong_mode_begin_again(monkeypatch, tmp_path):
    """At 18 MHz at chi^2 7e5 of 864 data; other draws, and the antennas of 25 MHz, lead elsewhere.

    Skies are drawn from the prior, a fifth of the embedded sky about it. 49 modes: the rms of
    directions scatters by 0.1, chi^2 of the data by 42.
    """
    sky = set_up(Scenario.model_validate({"frequency_mhz": 25.0, "lmax": 6})).sky.modes
    values = modes_to_map(np.asarray(sky), 16)
    file, units = tmp_path / "mean.fits", {"coord": "G", "column_units": "K"}
    healpy.write_map(file, values, dtype=np.float64, **units)
    prior = {"model": "isotropic", "spectrum": "sky", "scale": 0.04, "mean_file": str(file)}
    runs = [{"cycles": 0.5}, {"cycles": 0.5, "turntable_deg": 30.0}]
    both = Scenario.model_validate(
        {
            "frequencies_mhz": [18.0, 25.0],
            "lmax": 6,
            "seed": 9,
            "instrument_seed": 9,
            "output": {"covariance": True},
            "prior": prior | {"file_frequency_mhz": 25.0, "spectral_index": -2.5},
            "observation": {"runs": runs, "step_s": 43200.0},
            "noise": NOISE | {"receiver": NOISE["receiver"] | {"smooth_octaves": 1.0}},
        }
    )
    data = []
    for number, channel in enumerate(both.channels(), start=1):
        setup = set_up(channel)
        white = np.random.default_rng(9000 + number).standard_normal(setup.prior.size)
        modes = np.asarray(setup.prior.colour(white)) + np.asarray(setup.prior.mean)
        data.append(simulate(setup.under(replace(setup.sky, modes=modes))))
    assert lb.infer(lb.build(both.channels()[0], data[0])).fits
    monkeypatch.setattr(rounds, "OTHER_WAYS", 0)
    assert not lb.infer(lb.build(both.channels()[0], data[0])).fits
    for one, seen in zip(lb.run_map(both, tmp_path, data=data).result.channels, data, strict=True):
        off = one.mean - np.asarray(seen.truth)
        assert 0.6 < np.sqrt(off @ np.linalg.solve(one.covariance, off) / len(off)) < 1.4
        assert abs(one.chi2_model - one.n_data) < 5 * np.sqrt(2 * one.n_data)


@pytest.mark.essential
def test_simulated_gains_are_about_what_the_map_predicts():
    """What the instrument would see as it is expected is off by more than the radiometer's noise.

    A sky unlike its prior is no misfit: what counts is what no sky explains.
    """
    more = {"lmax": 4, "step_s": 43200.0, "prior": {"model": "isotropic"}}
    found = lb.infer(lb.build(scenario(25.0, 2, **more)))
    n = found.model.n_data
    assert abs(found.solution.chi2 - n) < 5.0 * np.sqrt(2.0 * n)
    elsewhere = found.under(found.model.prior.widened(0.03))
    assert elsewhere.solution.chi2 > n + 10.0 * np.sqrt(2.0 * n)
    assert elsewhere.fits


@pytest.mark.long
def test_eight_channels_share_an_instrument(monkeypatch, tmp_path):
    """Half a cycle at each of two angles, at the size of a map.

    Errors of ground, arms and turntable are at most half of the best channel's (0.53 of it for one
    of six if products are correlated), values right, and maps, too: 625 directions, whose rms
    scatters by 0.03.
    """
    noise = {"radiometer": {"form": "paper"}, "gain": NOISE["gain"], "receiver": NOISE["receiver"]}
    noise["receiver"] = noise["receiver"] | {"smooth_octaves": 1.0}
    noise["pointing"] = {"turntable_deg": 0.2}
    noise["beam"] = {"parameters": ANTENNAS | {"loss_tangent": 0.002}}
    runs = [{"cycles": 0.5}, {"cycles": 0.5, "turntable_deg": 30.0}]
    tree = {
        "frequencies_mhz": [10.0, 12.9, 15.7, 18.6, 21.4, 24.3, 27.1, 30.0],
        "lmax": 24,
        "noise": noise,
        "observation": {"runs": runs, "step_s": 14400.0},
        "output": {"draws": 0, "covariance": True},
    }
    shares, tied = [], channels.tie_channels
    spy = lambda *given: shares.extend(given[2]) or tied(*given)  # noqa: E731
    monkeypatch.setattr(channels, "tie_channels", spy)
    cube = lb.run_map(Scenario.model_validate(tree), tmp_path / "cube").result
    stds = [dict(zip(s.octaves, s.covariance.diagonal() ** 0.5, strict=True)) for s in shares]
    alone = pd.DataFrame(stds)
    assert not any(test.disagrees for test in cube.shared_tests)
    for one in cube.channels:
        off = one.mean - one.truth
        assert 0.8 < np.sqrt(off @ np.linalg.solve(one.covariance, off) / len(off)) < 1.2
        offsets = one.pointing.offsets.rename(columns={"offset": "unknown"})
        rows = pd.concat([one.unknowns.table, offsets]).set_index("unknown")
        rows = rows[~rows.index.str.startswith("receiver")]
        assert len(rows) == 6
        assert (abs(rows["value"] - rows["true"]) < 3.5 * rows["std"]).all()
        assert (rows["std"] / rows["prior_std"] < 0.5 * alone.min()[rows.index]).all()
