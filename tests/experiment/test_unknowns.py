"""The table of receivers, ground and gain table, and the direction that data cannot tell."""

import json
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from experiments import drawn, four_ports, parts, unknowns_report, with_known_sky
from reference_linear import white_posterior

import lusee_bayes as lb
from lusee_bayes.experiment import model, unknowns
from lusee_bayes.experiment.experiment import Experiment
from lusee_bayes.instrument.products import auto_indices
from lusee_bayes.report.pages import map_page
from lusee_bayes.systematics.context import Setup
from lusee_bayes.systematics.regolith import ground_per_kelvin
from lusee_bayes.testing import small_scenario

RECEIVER, GROUND = "noise.receiver={power_k: 2000}", "noise.regolith={std_k: 30}"
TABLE = "noise.gain_table={std: 0.01}"
COLUMNS = ["unknown", "unit", "value", "std", "prior", "prior_std"]


@pytest.fixture(scope="module")
def experiment(response_file) -> Experiment:
    return lb.build(four_ports(response_file, RECEIVER, GROUND, TABLE))


def joint(experiment: Experiment):
    """Sky and unknowns of the model about what the data told, as one Gaussian in NumPy."""
    found, setup = lb.infer(experiment), experiment.setup
    table = found.systematics[-1]
    factors = np.asarray(table.systematic.factors(table.centre))
    t = np.concatenate([np.asarray(s.columns) for s in found.systematics], axis=1)
    a, prior, noise = parts(setup)
    a, prior = np.concatenate([factors[:, None] * a, t], axis=1), np.append(prior, np.ones(9))
    own = table.columns @ (np.asarray(table.centre) - table.expected)
    rest = np.asarray(experiment.data.data) - factors * np.asarray(setup.offset) + own
    return found, prior, white_posterior(a, prior, noise, rest)


def test_table_and_null_direction_are_those_of_the_joint_posterior(experiment):
    found, prior, expected = joint(experiment)
    report = unknowns_report(experiment, found)
    table = report.table
    assert list(table) == [*COLUMNS, "true"]
    names = [*(f"receiver_{p}_k" for p in range(4)), "regolith_k", *(f"gain_{p}" for p in range(4))]
    assert list(table["unknown"]) == names
    assert list(table["unit"]) == ["K"] * 5 + [""] * 4
    mean = np.array([2000.0] * 4 + [250.0] + [0.0] * 4)
    scale = np.array([200.0] * 4 + [30.0] + [0.01] * 4)
    shift = np.append(np.zeros(5), found.systematics[-1].expected)
    np.testing.assert_allclose(table["prior"], mean, rtol=1e-12)
    np.testing.assert_allclose(table["prior_std"], scale, rtol=1e-12)
    np.testing.assert_allclose(table["std"], scale * expected.std[16:], rtol=1e-5)
    off = (table["value"] - mean - scale * (shift + expected.mean[16:])) / table["std"]
    assert np.abs(off).max() < 1e-4
    truth = model.true_values(experiment.setup)
    wanted = [truth[name] for name in names[:5]] + list(0.01 * truth["gain_table"])
    np.testing.assert_allclose(table["true"], wanted, rtol=1e-12)
    assert (np.abs(table["value"] - table["true"]) < 4 * table["std"]).all()
    # monopole, receivers, ground, and the unit vector of all gains
    pick = np.zeros((7, 25))
    pick[0, 0] = 1.0 / prior[0]
    pick[1:6, 16:21] = np.eye(5)
    pick[6, 21:] = 0.5
    variances, directions = np.linalg.eigh(pick @ expected.covariance @ pick.T)
    assert report.null.share == pytest.approx(variances[-1], rel=1e-5)
    assert abs(report.null.weights @ directions[:, -1]) == pytest.approx(1.0, abs=1e-5)
    common = np.sqrt(pick[6] @ expected.covariance @ pick[6])
    assert report.common == pytest.approx(common, rel=1e-5)
    receivers = (f"receiver {port}" for port in range(4))
    assert report.null.names == ("uniform sky", *receivers, "regolith", "common gain")


def test_only_what_the_model_has_is_listed(response_file):
    bare = lb.build(four_ports(response_file))
    assert unknowns_report(bare, lb.infer(bare)) is None
    ground = lb.build(four_ports(response_file, GROUND))
    report = unknowns_report(ground, lb.infer(ground))
    assert report.null.names == ("uniform sky", "regolith")
    assert list(report.table["unknown"]) == ["regolith_k"]
    # of given data, even with a known sky, no true values are known
    measured = lb.build(four_ports(response_file, GROUND), ground.data)
    assert list(unknowns_report(measured, lb.infer(measured)).table) == COLUMNS


def test_the_null_direction_in_words():
    """Two unknowns of which the data tell the sum only, and one that they tell."""
    ridge = np.array([[0.5, -0.5, 0.0], [-0.5, 0.5, 0.0], [0.0, 0.0, 0.01]])
    names, covariance = ["uniform sky", "regolith", "receiver 0"], 0.8 * ridge + 1e-6 * np.eye(3)
    null = unknowns.NullDirection.of(names, covariance)
    assert null.share == pytest.approx(0.8, abs=1e-5)
    regolith, sky = sorted(null.words().split(", "))
    assert (regolith[:-6], sky[:-6]) == ("regolith", "uniform sky")
    assert {regolith[-5:], sky[-5:]} == {"+0.71", "-0.71"}
    assert null.sentence().endswith("its variance is 80% of the prior variance.")
    # nothing to say where the data tell most of it
    assert unknowns.NullDirection.of(["uniform sky", "regolith"], 0.4 * np.eye(2)).sentence() == ""


@pytest.mark.parametrize(("common", "told"), [(None, False), (0.5, False), (0.95, True)])
def test_the_common_gain_is_told_where_it_keeps_its_prior(experiment, common, told):
    report = replace(unknowns_report(experiment, lb.infer(experiment)), common=common)
    words = "common gain of all ports is unconstrained"
    assert any(words in line for line in report.lines()) == told


@pytest.mark.long
def test_unknowns_of_added_data_are_said_to_be_of_the_new_data(response_file, tmp_path):
    """As numbers: those of these data mapped alone."""
    first = four_ports(response_file, GROUND, "output.information=true")
    lb.run_map(first, tmp_path / "first")
    second = first.model_copy(update={"seed": 7})
    alone = lb.build(second)
    run = lb.run_map(second, tmp_path / "both", earlier=tmp_path / "first")
    expected = unknowns_report(alone, lb.infer(alone))
    pd.testing.assert_frame_equal(run.result.channel.unknowns.table, expected.table)
    note = "by the new data only"
    assert any(note in line for line in run.result.lines())
    assert note in map_page(tmp_path / "both", "both")
    assert note not in map_page(tmp_path / "first", "first")


def test_a_run_writes_them(experiment, tmp_path):
    run = lb.run_map(experiment.scenario, tmp_path / "map")
    table = pd.read_csv(tmp_path / "map" / "unknowns.csv", keep_default_na=False)
    assert len(table) == 9
    summary = json.loads((tmp_path / "map" / "summary.json").read_text())["channels"][0]["unknowns"]
    np.testing.assert_allclose([row["value"] for row in summary["rows"]], table["value"], rtol=1e-9)
    assert summary["null_share"] > 0.5
    assert sum(weight**2 for weight in summary["null_direction"].values()) == pytest.approx(1.0)
    lines = run.result.lines()
    assert any(line.startswith("receiver_0_k: ") and line.endswith(" K") for line in lines)
    assert any("regolith_k" in line and "(unconstrained: " in line for line in lines)
    assert summary["null_sentence"] in lines
    page = map_page(tmp_path / "map", "a run")
    assert "Receivers, ground and gain table" in page
    assert summary["null_sentence"] in page
    for text in ("<td>regolith_k</td><td>K</td>", "<td>gain_3</td><td></td>"):
        assert text in page


def at_truth(setup: Setup) -> Setup:
    """The same with receivers and ground that are known to be the truth."""
    noise, truth = setup.scenario.noise, model.true_values(setup)
    ignored = {"treatment": "ignored"}
    fixed = {k: getattr(noise, k).model_copy(update=ignored) for k in ("receiver", "regolith")}
    scenario = setup.scenario.model_copy(update={"noise": noise.model_copy(update=fixed)})
    background = np.array(setup.beam_source.background(20.0))
    background += (truth["regolith_k"] - 250.0) * ground_per_kelvin(setup.beam_source, 20.0)
    background[auto_indices()] += [truth[f"receiver_{port}_k"] for port in range(4)]
    at_all_times = np.tile(background[:, None], setup.layout.n_times)
    return replace(setup, scenario=scenario, background=at_all_times)


@pytest.mark.long
def test_receivers_and_ground_that_are_not_known_cost_the_monopole_alone(response_file):
    """Of 20 data sets no mode with ell >= 1 moves by 0.1 standard deviations."""
    # known to a fifth, as one who maps a sky with structure knows it
    first = with_known_sky(model.set_up(four_ports(response_file, RECEIVER, GROUND)), 0.04)
    moved = []
    for seed in range(20):
        experiment = drawn(first, seed)
        setup, data = experiment.setup, experiment.data
        unknown, exact = (lb.infer(Experiment(s, data)).posterior for s in (setup, at_truth(setup)))
        off = np.asarray(unknown.mean) - np.asarray(exact.mean)
        moved.append(off / np.asarray(unknown.std()))
    moved = np.abs(moved)
    assert moved[:, 1:].max() < 0.1 and moved[:, 0].max() > 0.1
    # taken for their prior means they move them by many: the test can tell
    wrong = replace(at_truth(first), background=first.background)
    wrong = replace(wrong, scenario=wrong.scenario.model_copy(update={"seed": 19}))
    off = np.asarray(lb.infer(Experiment(wrong, data)).posterior.mean) - np.asarray(unknown.mean)
    assert np.abs(off / np.asarray(unknown.std()))[1:].max() > 1.0


@pytest.mark.parametrize(("lost", "width"), [(0.0, 1e2), (1e-3, 1e1), (1e-1, 1.0)])
def test_the_prior_that_allows_any_sky_is_as_wide_as_rounding_permits(lost, width):
    """Rounding may leave A^T N^-1 A with negative eigenvalues: -``lost`` in the prior's units."""
    found = lb.infer(lb.build(small_scenario(lmax=3, cycles=0.1)))
    information, widths = found.solution.information, np.sqrt(found.model.prior.variance())
    values, vectors = np.linalg.eigh(information.matrix * np.outer(widths, widths))
    direction = vectors[:, 0] / widths
    less = np.outer(direction, direction) * ((values[0] + lost) * (lost > 0.0))
    kept = replace(information, matrix=information.matrix - less)
    found = replace(found, solution=replace(found.solution, kept_information=kept))
    wide = found.under_any_sky().model.prior
    np.testing.assert_allclose(wide.variance(), (width * widths) ** 2, rtol=1e-12)
