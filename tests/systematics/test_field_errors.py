"""Errors of the fields: their columns and beams, what is learned of them, maps beside them."""

from dataclasses import replace

import jax
import numpy as np
import pytest
from assertions import close, refuse
from experiments import differences, rms_of_directions
from reference import real_harmonics

import lusee_bayes as lb
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.harmonics import modes_to_map
from lusee_bayes.core.sphere_grid import SphereGrid
from lusee_bayes.experiment.experiment import doubts
from lusee_bayes.experiment.model import base_model, radiometer, set_up, simulate, systematics
from lusee_bayes.instrument.beams import fields as beam_fields
from lusee_bayes.instrument.beams.fields import AntennaFields, HemisphereGrid, stokes_beam
from lusee_bayes.instrument.products import to_real
from lusee_bayes.results import finished_runs, summaries
from lusee_bayes.runs import sample_run
from lusee_bayes.systematics.context import Setup
from lusee_bayes.systematics.field_errors import STD, FieldErrors, FieldErrorsSection, of_ell

TWO_RUNS = "observation.runs=[{cycles: 0.5}, {cycles: 0.5, turntable_deg: 40}]"


def scenario(fields: str, *overrides: str, lmax: int = 4, step_s: float = 86400.0):
    plain = [f"lmax={lmax}", f"observation.step_s={step_s}", TWO_RUNS]
    noise = [f"noise.fields={{{fields}}}"] if fields else []
    return lb.load_scenario("fiducial", overrides=[*plain, *noise, *overrides])


def errors_of(fields: str) -> tuple[Setup, FieldErrors, np.ndarray]:
    """The setup, the systematic, and unknowns away from their prior means."""
    setup = set_up(scenario(fields))
    ((_, errors),) = systematics(setup)
    return setup, errors, np.random.default_rng(1).standard_normal(len(errors.names))


def test_columns_are_the_derivative_of_the_effect():
    """Central differences: h^2 std^2 of the slope, and rounding over the step."""
    setup, errors, z = errors_of("lmax: 2, std: 0.03")
    model, sky = base_model(setup), np.asarray(setup.sky.modes)
    columns = errors.linearised(model, z)(sky)
    assert columns.shape == (model.n_data, 4 * 4 * 9)
    some = np.random.default_rng(2).choice(len(z), 16, replace=False)
    slopes = differences(errors, model, sky, z, 1e-3 * np.eye(len(z))[some])
    for slope, column in zip(slopes.T, columns.T[some], strict=True):
        close(slope, column, 1e-7)


def test_beams_are_those_of_fields_with_errors():
    """Fields of the antennas plus errors, integrated where they are; the scale is that without.

    Quadratures above the horizon have 48 nodes where the package has 128: 1e-9 of the beams.
    """
    std, lmax = 1e-2, 4
    setup, errors, z = errors_of(f"lmax: 2, std: {std}")
    values, grid = errors.values(z), HemisphereGrid.gauss_legendre(48, 48)
    theta, phi = (x.ravel() for x in np.meshgrid(grid.theta, grid.phi, indexing="ij"))
    of_ells = [values[f"field_error_{k}"].reshape(2, 4, 2, 2 * k + 1) for k in range(3)]
    real, imaginary = np.concatenate(of_ells, axis=3) @ real_harmonics(theta, phi, 2).T
    fields = setup.beam_source.fields(setup.frequency_mhz, grid)
    power = np.abs(np.asarray(fields.e_theta)) ** 2 + np.abs(np.asarray(fields.e_phi)) ** 2
    rms = np.sqrt((power * (grid.weights[:, None] / grid.n_phi)).sum((1, 2)))
    more = (real + 1j * imaginary).reshape(4, 2, *power.shape[1:]) * rms[:, None, None, None]
    # East and North at the zenith, carried along great circles
    cos, sin = np.cos(grid.phi), np.sin(grid.phi)
    e_theta = fields.e_theta + cos * more[:, 0] + sin * more[:, 1]
    wrong = AntennaFields(e_theta, fields.e_phi - sin * more[:, 0] + cos * more[:, 1], grid)
    scale = beam_fields.mean_auto_integral(fields)
    stokes = (to_real(stokes_beam(one)) / scale for one in (fields, wrong))
    before, after = (np.asarray(grid.modes(one, lmax)) for one in stokes)
    nominal = np.asarray(setup.beams.modes)
    change = np.asarray(errors.modes(nominal, values)) - nominal
    assert np.abs(after - before).max() > std * np.abs(before).max()
    assert np.abs(change - (after - before)).max() < 1e-9 * np.abs(before).max()


def test_the_strength_becomes_that_of_the_largest_evidence():
    """Amplitudes seen in noise: at the fixpoint, on a grid of the evidence."""
    section, lmax, rng = FieldErrorsSection(slope=2.5, lmax=5), 5, np.random.default_rng(3)
    sizes = [4 * (2 * ell + 1) for ell in range(lmax + 1)]
    scatter = 2e-3 * rng.uniform(0.5, 2.0, sum(sizes))
    true = np.repeat(of_ell(8e-3, 2.5, lmax), sizes)
    seen = rng.normal(size=len(true)) * np.hypot(true, scatter)
    nothing, values = np.zeros((1, 1, 1)), {STD: section.std}
    beams = np.zeros((1, 2, 1, 1), complex), nothing[0], np.ones(1), nothing, SphereGrid.of(1, 1)
    for _ in range(60):
        there = of_ell(values[STD], section.slope, lmax)
        errors, std = FieldErrors(there, *beams, section), np.repeat(there, sizes)
        variance = 1.0 / (1.0 + (std / scatter) ** 2)
        values = errors.relearned(variance * std * seen / scatter**2, variance)

    def log_evidence(std):
        variance = np.repeat(of_ell(std, section.slope, lmax), sizes) ** 2 + scatter**2
        return -0.5 * (np.log(variance) + seen**2 / variance).sum()

    stds = np.geomspace(4e-3, 16e-3, 241)
    best = int(np.argmax([log_evidence(std) for std in stds]))
    assert 0 < best < 240 and values[STD] == pytest.approx(stds[best], rel=0.012)
    # errors that are less than expected are not believed
    assert errors.relearned(0.0 * seen, 1e-3 * variance)[STD] == section.std


@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.long)])
def test_maps_beside_errors_of_the_fields(seed):
    """Sky and errors of twenty times the expected strength: the map is off by what it says.

    The errors have 144 amplitudes, which determine their size to 6 % at best.
    """
    truth, *given = (
        scenario(fields, "prior={model: isotropic}", f"seed={seed}", lmax=6, step_s=43200.0)
        for fields in ("lmax: 2, std: 2e-3", "lmax: 2, std: 1e-4", "")
    )
    setup, full = set_up(truth), []
    draw = np.asarray(setup.prior.sample(jax.random.key(seed)))
    setup = setup.under(replace(setup.sky, modes=draw * np.sign(draw[0])))
    data = simulate(setup)
    for one in given:
        found = lb.infer(experiment := lb.build(one, data=data))
        full.append(rms_of_directions(found, setup.sky.modes))
        told = " ".join(doubts(experiment, found)).partition("require field errors of ")[2][:4]
        assert (0.16 < float(told or 0) < 0.24) == bool(one.noise.fields) and not found.unsettled
    assert 0.75 < full[0] < 1.25 and full[1] > 5.0


@pytest.mark.essential
def test_beams_of_measured_data_are_not_exact_unless_a_scenario_says_so():
    """Ground, arms and fields that differ from the model's, drawn as is expected of them.

    49 modes: the rms of directions scatters by 0.1, so that 1.4 is beyond four of that. With exact
    beams it is larger by orders of magnitude.
    """
    shared = [TWO_RUNS, "observation.step_s=43200", "lmax=6"]
    measured = lb.load_scenario("fiducial", overrides=[*shared, "beam.exact=false"]).of_measured()
    # of a sky that ends at lmax
    data = simulate(set_up(measured.with_section("noise", above_lmax=None)))
    for exact in (True, False):
        model = lb.load_scenario("fiducial", overrides=[*shared, f"beam.exact={exact}".lower()])
        posterior = lb.infer(lb.build(model, replace(data, truth=None))).posterior
        off = posterior.mean - data.truth
        full = np.sqrt(off @ np.linalg.solve(posterior.covariance(), off) / len(off))
        assert full > 10.0 if exact else 0.6 < full < 1.4


@pytest.mark.essential
def test_a_report_has_the_share_of_the_variance_that_they_add(tmp_path):
    """As saved, against dense posteriors with and without the unknowns in N."""
    parameters = "noise.beam={parameters: {zenith_angle_deg: 1.0}}"
    own = parameters, "prior={model: isotropic, spectrum: sky}"
    given = scenario("std: 1.0e-3, lmax: 1, learned: false", *own, lmax=3, step_s=2e5)
    run = lb.run_map(given, tmp_path / "map")
    found = lb.infer(experiment := lb.build(given))
    a, noise = np.asarray(found.model.coupling.dense()), radiometer(experiment.setup).diagonal()
    inverse = np.diag(1.0 / np.asarray(found.model.prior.variance()))
    known = np.linalg.inv(a.T @ (a / np.asarray(noise)[:, None]) + inverse)
    of = {part.systematic.words: np.asarray(part.columns) for part in found.expanded}
    whole = np.linalg.inv(a.T @ np.linalg.solve(np.asarray(found.model.noise.dense()), a) + inverse)
    left = {"all together": known}
    for name in of:  # the others stay unknown
        rest = np.concatenate([columns for other, columns in of.items() if other != name], axis=1)
        n = np.diag(np.asarray(noise)) + rest @ rest.T
        left[name] = np.linalg.inv(a.T @ np.linalg.solve(n, a) + inverse)
    channel = finished_runs.FinishedRun.read(run.folder).channel
    theta = channel.theta
    expected = {name: 1.0 - np.trace(one) / np.trace(whole) for name, one in left.items()}
    assert theta.shares == pytest.approx(expected, rel=1e-4) and set(of) < set(expected)
    grid = np.stack([modes_to_map(one, channel.nside) for one in np.eye(len(whole))])
    before, after = (np.einsum("mp,mn,np->p", grid, one, grid) for one in (whole, known))
    np.testing.assert_allclose(theta.pixel_share, 1.0 - after / before, rtol=1e-4)
    assert theta.table["n"].tolist() == [1, 16, 48]
    assert theta.table["unknown"].tolist()[1:] == ["field_error_0", "field_error_1"]
    assert theta.corner["unknown"].tolist() == ["zenith_angle_deg"]
    text = (run.folder / "summary.json").read_text(encoding="utf-8")
    summary = summaries.MapSummary.model_validate_json(text).channels[0].theta
    assert summary["shares"] == pytest.approx(theta.shares, rel=1e-12)
    page = (run.folder / "report.html").read_text(encoding="utf-8")
    assert "<td>field_error_1</td><td>48</td>" in page and "Posterior of pairs of unknowns" in page
    assert "fraction of the variance due to unknowns" in page


@pytest.mark.long
def test_samples_of_measured_data_have_them_too(tmp_path):
    given = lb.load_scenario("fiducial", ["lmax=2", "beam.exact=false", "observation.step_s=2e5"])
    data, sampler = simulate(set_up(given)), lb.Sampler(chains=1, warmup=20, draws=4)
    lb.run_sample(given, tmp_path / "run", data=data, sampler=sampler)
    found, expected = lb.load_scenario(tmp_path / "run" / "scenario.yaml"), given.of_measured()
    assert found.noise.beam == expected.noise.beam is not None
    assert found.noise.fields == expected.noise.fields is not None


def test_validations_of_measured_data_have_them_too(tmp_path, monkeypatch):
    def stop(scenario, *_, **__):
        raise InputError(f"{scenario.noise.fields}, {scenario.noise.above_lmax}")

    monkeypatch.setattr(sample_run, "measured_experiment", stop)
    given = lb.load_scenario("fiducial", ["lmax=2", "beam.exact=false", "observation.step_s=2e5"])
    data = simulate(set_up(given)).write(tmp_path / "data.nc")
    refuse("std=0.001.*margin=16", sample_run.run_validate, given, tmp_path / "run", data=data)
