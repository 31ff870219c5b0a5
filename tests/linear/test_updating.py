"""New data added to a saved posterior, against all data at once."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

import lusee_bayes as lb
from lusee_bayes.cli.main import main
from lusee_bayes.experiment.model import full_model
from lusee_bayes.experiment.terms import Around
from lusee_bayes.instrument.layout import DataLayout
from lusee_bayes.linear.updating import deviation_model, updated
from lusee_bayes.results.updatable import read_updatable


def of_run(data: lb.Visibilities, run: int) -> lb.Visibilities:
    """The data of one run by themselves."""
    keep = data.observation.run == run
    observation = data.observation.select(keep)
    flat = jnp.asarray(data.grid()[:, keep].ravel())
    return replace(
        data, data=flat, layout=DataLayout(16, observation.n_times), observation=observation
    )


def two_cycles(*overrides):
    scenario = lb.load_scenario("two_cycles", list(overrides))
    experiment = lb.build(scenario)
    data = experiment.data
    parts = [of_run(data, run) for run in (0, 1)]
    models = [full_model(lb.build(scenario, part).setup, Around(part)) for part in parts]
    return full_model(experiment.setup, Around(data)), data, models, parts


def assert_update_equals(whole, data, models, parts, sigma):
    first = models[0].condition(parts[0].data, form="root")
    got = updated(first, models[1], parts[1].data)
    expected = whole.condition(data.data, form="root")
    std = np.asarray(expected.std())
    assert (np.abs(np.asarray(got.mean - expected.mean)) / std).max() < sigma
    np.testing.assert_allclose(got.std(), std, rtol=sigma)
    assert abs(float(got.log_evidence - expected.log_evidence)) < 100 * sigma
    # the second cycle did say something
    assert (np.abs(np.asarray(first.mean - expected.mean)) / std).max() > 0.5


@pytest.fixture
def exact_tilt(monkeypatch):
    """Tilts about the pole between two runs as exact as about each one's own."""
    monkeypatch.setattr("lusee_bayes.instrument.pointing.LEAST_ORDER", 4)
    monkeypatch.setattr("lusee_bayes.instrument.window_average.TOLERANCE", 1e-13)


@pytest.mark.long
@pytest.mark.parametrize("form", ["paper", "exact"])
def test_a_second_run_adds_to_the_first(form, exact_tilt):
    runs = "observation.runs=[{cycles: 0.2}, {cycles: 0.1, turntable_deg: 30}]"
    parts = two_cycles("lmax=6", runs, f"noise.radiometer.form={form}")
    assert_update_equals(*parts, 1e-8)


@pytest.mark.long
def test_a_second_cycle_at_full_size(exact_tilt):
    """1.2e-10 of a standard deviation is what comes out."""
    assert_update_equals(*two_cycles(), 1e-8)


def test_what_does_not_fit_is_refused():
    runs = "observation.runs=[{cycles: 0.2}, {cycles: 0.1, turntable_deg: 30}]"
    _, _, models, parts = two_cycles("lmax=4", runs)
    first = models[0].condition(parts[0].data, form="root")
    other = replace(models[1], prior=lb.HarmonicPrior(2.0 * models[1].prior.spectrum))
    with pytest.raises(lb.InputError, match=r"has another prior: a variance of .* K\^2 at ell = 0"):
        deviation_model(first, other)
    few = models[1].condition(parts[1].data, form="data")
    with pytest.raises(lb.InputError, match="condition with form='root'"):
        deviation_model(few, models[1])


SMALL = ("--set", "lmax=5", "--set", "observation.runs.0.cycles=0.1")


@pytest.mark.long
def test_from_the_command_line(tmp_path, capsys):
    def run(*arguments):
        return main([str(a) for a in arguments])

    second = ("--set", "observation.start=2027-02-15", "--set", "seed=2")
    assert run("simulate", "fiducial", *SMALL, "-o", tmp_path / "a.nc", "-q") == 0
    assert run("simulate", "fiducial", *SMALL, *second, "-o", tmp_path / "b.nc", "-q") == 0
    mapped = ("map", "fiducial", *SMALL, "-q")
    first, both, third = (tmp_path / name for name in ("first", "both", "third"))
    assert run(*mapped, "--data", tmp_path / "a.nc", "--updatable", "-o", first) == 0
    add = ("--onto", first, "--updatable", "-o", both)
    assert run(*mapped, "--data", tmp_path / "b.nc", *add) == 0
    scenario = lb.load_scenario("fiducial", list(SMALL[1::2]))
    saved = read_updatable(both, scenario)
    assert len(saved.digests) == 2
    before = read_updatable(first, scenario).posterior
    assert (np.asarray(saved.posterior.std()) <= np.asarray(before.std()) * (1 + 1e-12)).all()
    assert saved.posterior.information_bits() > before.information_bits() + 10
    capsys.readouterr()
    for arguments, message in (
        (("--data", tmp_path / "b.nc", "--onto", both), "would count twice"),
        (("--onto", tmp_path / "none"), "no posterior of lusee-bayes map --updatable at"),
        (("--onto", both, "--set", "frequency_mhz=10"), "is of frequency_mhz 25, the scenario"),
    ):
        assert run(*mapped, *arguments, "-o", third) == 2
        assert message in capsys.readouterr().err
    assert not third.exists()
