"""Receivers, ground and gain table of runs of several frequencies."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from experiments import four_ports, unknowns_report
from matplotlib.figure import Figure
from reference_linear import white_posterior

import lusee_bayes as lb
from lusee_bayes.core.harmonics import per_mode
from lusee_bayes.experiment.model import radiometer
from lusee_bayes.report.map_page import map_page
from lusee_bayes.runs import map_run
from lusee_bayes.runs.channels import map_channels

RECEIVER, GROUND = "noise.receiver={power_k: 2000, slope: -2}", "noise.regolith={std_k: 30}"
TABLE = "noise.gain_table={std: 0.01}"
NUMBERS = ["value", "std", "prior", "prior_std", "true"]
# rounding of two solutions of the same equations, in standard deviations: z is a difference of
# data and prediction, 1e5 times the noise
ROUNDING = 1e-5


def cube_of(response_file, *overrides, frequencies="[15, 20]"):
    return four_ports(response_file, *overrides, f"frequencies_mhz={frequencies}")


@pytest.mark.long
def test_a_channel_has_those_of_its_own_map(response_file, tmp_path, monkeypatch):
    drawn = dict.fromkeys(map_run.MAP.figures, lambda _: Figure())
    drawn["unknowns"] = map_run.MAP.figures["unknowns"]
    monkeypatch.setattr(map_run, "MAP", replace(map_run.MAP, figures=drawn))
    run = lb.run_map(cube_of(response_file, RECEIVER, GROUND, TABLE), tmp_path / "cube")
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
        assert np.abs(off).max() < ROUNDING
        for name in NUMBERS[1:]:
            np.testing.assert_allclose(here[name], expected.table[name], rtol=ROUNDING)
        (found,) = (c for c in run.result.channels if c.frequency_mhz == channel.frequency_mhz)
        assert found.unknowns.null.names == expected.null.names
        assert found.unknowns.null.share == pytest.approx(expected.null.share, rel=ROUNDING)
        np.testing.assert_allclose(found.unknowns.null.weights, expected.null.weights, atol=1e-4)
    # the mean power of receivers goes with frequency
    receivers = written[written["unknown"] == "receiver_0_k"]["prior"]
    assert receivers.iloc[0] == pytest.approx(receivers.iloc[1] * (20.0 / 15.0) ** 2)
    lines = run.result.lines()
    untold = "Receivers, ground and gain table: the data do not tell regolith_k (at 2 of 2 frequenc"
    (line,) = (line for line in lines if line.startswith(untold))
    (sentence,) = (line for line in lines if line.startswith("One combination of what looks alike"))
    worst = max(nulls, key=lambda frequency: nulls[frequency].share)
    assert f"at 2 of 2 frequencies. At {worst:g} MHz ({nulls[worst].words()}, in" in sentence
    page = map_page(tmp_path / "cube", "a run")
    assert line in page and sentence in page
    assert "Powers of receivers" in page and page.count("<td>regolith_k</td><td>K</td>") == 2


def test_in_a_joint_posterior_they_are_those_of_all_skies_and_unknowns_together(
    response_file, tmp_path
):
    """Every sky and every unknown as one Gaussian in NumPy."""
    spectral = "spectral.components=[power_law]"
    given = (RECEIVER, GROUND, "joint=true", spectral)
    scenario = cube_of(response_file, *given, frequencies="[15, 20, 25]")
    channels = map_channels(scenario, tmp_path)
    prior = channels.joint.prior
    n_modes, n_own = 16, 5
    stds = [np.sqrt(np.asarray(per_mode(c))) for c in (prior.spectra[0], *prior.residual)]
    stds = np.concatenate([*stds, np.ones(3 * n_own)])
    rows, noise, rest, tables = found = [], [], [], []
    for number, channel in enumerate(scenario.channels()):
        experiment = lb.build(channel)
        inference = lb.infer(experiment)
        a = np.asarray(experiment.setup.coupling.dense())
        t = np.concatenate([np.asarray(s.columns) for s in inference.systematics], axis=1)
        row = np.zeros((len(a), len(stds)))
        row[:, :n_modes] = float(prior.mixing[number, 0]) * a
        row[:, (1 + number) * n_modes : (2 + number) * n_modes] = a
        row[:, 4 * n_modes + number * n_own : 4 * n_modes + (number + 1) * n_own] = t
        rows.append(row)
        noise.append(np.sqrt(np.asarray(radiometer(experiment.setup).diagonal())))
        rest.append(np.asarray(experiment.data.data) - np.asarray(experiment.setup.offset))
        tables.append(unknowns_report(experiment, inference).table)
    a, noise, rest = map(np.concatenate, found[:3])
    expected = white_posterior(a, stds, noise, rest)
    alone = pd.concat(tables, ignore_index=True)
    table = channels.unknowns.table
    scale, own = table["prior_std"].to_numpy(), slice(4 * n_modes, None)
    std = scale * expected.std[own]
    off = (table["value"] - table["prior"] - scale * expected.mean[own]) / std
    assert np.abs(off).max() < 1e-4
    np.testing.assert_allclose(table["std"], std, rtol=1e-4)
    np.testing.assert_allclose(table["true"], alone["true"], rtol=1e-12)
    # other channels do tell: the test would see a table of each channel's own data
    assert (np.abs(table["value"] - alone["value"]) / std).max() > 0.05
    assert all(channel.unknowns.null is None for channel in channels.channels)
