"""Beams of files over a grid of parameters: their interpolation, and what data tell of these."""

from dataclasses import replace
from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from assertions import refuse
from experiments import density_of, differences, pulls, rms_of_directions
from fits_files import write_images, write_response

import lusee_bayes as lb
from lusee_bayes.cli.main import main
from lusee_bayes.experiment.experiment import doubts, interpolation_error
from lusee_bayes.experiment.model import base_model, set_up, simulate, systematics
from lusee_bayes.experiment.scenario import Scenario
from lusee_bayes.instrument.beams.fields import HemisphereGrid, mean_auto_integral
from lusee_bayes.instrument.beams.grid import GridBeams, read_beam_grid, weights_along
from lusee_bayes.instrument.beams.luseepy_files import read_response
from lusee_bayes.instrument.beams.monopoles import Monopoles
from lusee_bayes.instrument.products import all_products
from lusee_bayes.testing import check_beam_source

MHZ, LMAX = 10.0, 8
NAMES, MIDDLE = ("surface_permittivity", "zenith_angle_deg"), (3.7, 75.0)
ARMS = {"taper": False, "rotations_deg": (0.0, -90.0, 180.0, 90.0)}
HEAD = {"THETA_MIN": 0.0, "THETA_MAX": 90.0, "PHI_MIN": 0.0, "PHI_MAX": 360.0}


def named(*values):
    return dict(zip(NAMES, values, strict=True))


def write_arm(path, values):
    """The first arm of the embedded antennas in luseepy's format, with their normalisation."""
    antennas = Monopoles().with_values(values)
    theta, phi = np.linspace(0.0, np.pi / 2, 91), np.linspace(0.0, 2 * np.pi, 73)
    fields = antennas.towards(np.asarray(MHZ), theta[:, None], phi[None])
    whole = float(mean_auto_integral(antennas.fields(MHZ, HemisphereGrid.for_lmax(LMAX))))
    images = {"gain_conv": np.array([2 * np.pi / whole]), "freq": np.array([MHZ])}
    for name, field in zip(("Etheta", "EPhi"), fields, strict=True):
        images |= {f"{name}_real": field[:1].real, f"{name}_imag": field[:1].imag}
    write_images(path, images, HEAD | {"THETA_N": 91, "PHI_N": 73})


def write_table(folder, rows):
    lines = [",".join(map(str, row)) for row in [("file", *NAMES), *rows]]
    (folder / "grid.csv").write_text("\n".join(lines) + "\n")
    return str(folder / "grid.csv")


def write_grid(folder, step):
    """Three by three files in steps of permittivity, and of ten times as many degrees."""
    folder.mkdir()
    steps = step * np.arange(-1, 2)
    axes = [np.round(x + by * steps, 9) for x, by in zip(MIDDLE, (1.0, 10.0), strict=True)]
    rows = [(f"{k}.fits", *place) for k, place in enumerate(product(*axes))]
    for file, *place in rows:
        write_arm(folder / file, named(*place))
    return write_table(folder, rows[::-1])


@pytest.fixture(scope="module")
def tables(tmp_path_factory):
    """Grids in fine and in coarse steps."""
    folder = tmp_path_factory.mktemp("grids")
    return {step: write_grid(folder / str(step), step) for step in (0.06, 0.4)}


def scenario(table, step, lmax=LMAX, seed=1, treatment="marginalised", **beam) -> Scenario:
    """Two months of noise, 1 part in 465 of every datum; grids end at 3.5 prior deviations."""
    runs = [{"cycles": 1.0, "turntable_deg": angle} for angle in (0.0, 30.0)]
    error = {"parameters": named(step / 3.5, 10.0 * step / 3.5), "treatment": treatment}
    tree = {"frequency_mhz": MHZ, "lmax": lmax, "seed": seed}
    tree |= {"noise": {"beam": error, "radiometer": {"bandwidth_hz": 10.0}}}
    tree |= {"prior": {"model": "isotropic", "spectrum": "sky"}}
    tree |= {"observation": {"runs": runs, "step_s": 21600.0}}
    if table is not None:
        tree |= {"beam": {"model": "grid", "file": table, **ARMS, **beam}}
    return Scenario.model_validate(tree)


@pytest.mark.parametrize("n", [2, 3, 5, 6, 9])
def test_weights(n):
    """Those of a node, there; polynomials are exact: of as many terms as nodes, or cubic ones."""
    nodes = np.sort(np.random.default_rng(n).uniform(2.0, 3.0, n))
    for k, node in enumerate(nodes):
        np.testing.assert_allclose(weights_along(nodes, node), np.eye(n)[k], atol=1e-11)
    for value, power in product(np.linspace(*nodes[[0, -1]], 20), range(min(n, 4 if n > 5 else 5))):
        weights = weights_along(nodes, value)
        np.testing.assert_allclose(weights @ nodes**power, value**power, rtol=1e-10)
        np.testing.assert_allclose(weights_along(nodes, jnp.asarray(value)), weights, atol=1e-12)


def test_beams_at_files_are_those_of_the_files_and_the_contract_holds(tables):
    section = scenario(tables[0.4], 0.4, moon_temperature_k=250.0).beam
    grid, places = section.source(), product((3.3, 3.7, 4.1), (71.0, 75.0, 79.0))
    assert section.source().n_ports == 4
    assert grid.values == pytest.approx(named(*MIDDLE))
    for place, source in zip(places, grid.sources, strict=True):
        here, modes = grid.with_values(named(*place)), source.beams(MHZ, LMAX).modes
        np.testing.assert_allclose(here.beams(MHZ, LMAX).modes, modes, atol=1e-13)
        np.testing.assert_allclose(here.background(MHZ), source.background(MHZ), atol=1e-10)
    own = {"values": named(3.5, 74.0), "moon_temperature_k": 0.0}
    one, turned = (section.model_copy(update={**own, "turntable_offset_deg": a}) for a in (0, 30))
    check_beam_source(one.source(), turned.source(), turned_deg=30.0, frequency_mhz=MHZ)


def test_one_kelvin_is_that_of_the_nominal_antennas(tmp_path):
    """Volts are interpolated, and 1 K stays what it is for the nominal antennas."""
    response = replace(read_response(write_response(tmp_path / "r.fits")), moon_k=250.0)
    nodes = np.array([1.0, 1.3, 1.5])
    sources = tuple(replace(response, impedance_ohm=response.impedance_ohm * x) for x in nodes)
    at = {"factor": 1.0}
    grid = GridBeams("grid", {"factor": nodes}, sources, at, at)
    first, second = np.array([one[:2] for one in all_products()]).T
    for x, source in zip(nodes, sources, strict=True):
        ratio = source.per_kelvin(20.0) / response.per_kelvin(20.0)
        scale, here = np.sqrt(ratio[first] * ratio[second]), grid.with_values({"factor": x})
        modes, ground = source.beams(20.0, 3).modes * scale[:, None], source.background(20.0)
        np.testing.assert_allclose(here.beams(20.0, 3).modes, modes, atol=1e-13)
        np.testing.assert_allclose(here.background(20.0), ground * scale, atol=1e-10)
        np.testing.assert_array_equal(here.circuit(20.0).antenna_ohm, response.impedance_ohm[1])


def test_jax_has_the_same_beams_and_slopes_hold_the_ground(tables):
    setup = set_up(scenario(tables[0.06], 0.06, 4, moon_temperature_k=1e4, treatment="sampled"))
    values, source = named(3.71, 74.8), setup.beam_source
    traced = jax.jit(lambda values: source.with_values(values).beams(MHZ, 4).modes)
    got = traced({name: jnp.asarray(value) for name, value in values.items()})
    np.testing.assert_allclose(got, source.with_values(values).beams(MHZ, 4).modes, atol=1e-14)
    ((_, parameters),) = systematics(setup)
    model, centre = base_model(setup), np.array([0.3, -0.2])
    slopes = differences(parameters, model, setup.sky.modes, centre, 1e-3 * np.eye(2))
    got = parameters.linearised(model, centre)(setup.sky.modes)
    np.testing.assert_allclose(got, slopes, atol=1e-6 * np.abs(slopes).max())
    assert np.isfinite(density_of(lb.build(setup.scenario), values))


def judged_map(table, step, seed):
    """Judge a map through the grid of data that have the exact beams between its files."""
    truth, model = set_up(scenario(None, step, seed=seed)), scenario(table, step, seed=seed)
    experiment = lb.build(model, data=simulate(truth))
    inference = lb.infer(experiment)
    full, away = rms_of_directions(inference, truth.sky.modes), pulls(truth, inference)
    (part,) = inference.expanded
    said = [text for text in doubts(experiment, inference) if "between the files" in text]
    widths, error = inference.amplitudes(part).std, interpolation_error(experiment.setup)
    return full, [*away.values()], widths, max(error.values()), said


@pytest.mark.parametrize("seed", [1, *(pytest.param(k, marks=pytest.mark.long) for k in (2, 3))])
def test_data_tell_parameters_between_files(tables, seed):
    full, away, widths, error, said = judged_map(tables[0.06], 0.06, seed)
    assert full < 1.3 and np.abs(away).max() < 3.0 and widths.max() < 0.4
    assert error < 0.1 and not said
    full, away, _, error, said = judged_map(tables[0.4], 0.4, seed)
    assert full > 1.3 and np.abs(away).max() > 4.0
    assert error > 1.0 and "of surface_permittivity 3.7" in said[0]


FAR = pytest.param(4.3, False, marks=pytest.mark.essential)


@pytest.mark.parametrize(("high", "fits"), [(3.8, True), FAR])
def test_a_parameter_beyond_the_files_makes_a_map_and_a_doubt(tables, high, fits):
    """The value is held at 3.76, the end; a little beyond it the first order suffices."""
    own = "noise.beam=null", f"beam.surface_permittivity={high}"
    truth = set_up(lb.load_scenario(scenario(None, 0.06), own))
    experiment = lb.build(scenario(tables[0.06], 0.06), data=simulate(truth))
    inference = lb.infer(experiment)
    assert inference.fits == fits == (rms_of_directions(inference, truth.sky.modes) < 1.3)
    assert any("held at the end of its range" in text for text in doubts(experiment, inference))


def test_what_cannot_be_is_refused(tables, tmp_path, capsys):
    table = tables[0.4]
    words = "surface_permittivity is 4.2, but the files cover 3.3 to 4.1; give a value in"
    refuse(words, read_beam_grid, table, {"surface_permittivity": 4.2})
    refuse("did you mean 'zenith_angle_deg'", read_beam_grid, table, {"zenit_angle_deg": 75.0})
    refuse("give a smaller deviation", lb.build, scenario(table, 4.0))
    rows = [("a", 1, 2), ("b", 1, 3), ("c", 2, 2), ("d", 2, 3)]
    said = "has no files for surface_permittivity 2, zenith_angle_deg 3; expected one file"
    refuse(said, read_beam_grid, write_table(tmp_path, rows[:3]))
    words = "has 2 files for surface_permittivity 1, zenith_angle_deg 3; expected one file"
    refuse(words, read_beam_grid, write_table(tmp_path, [*rows, rows[1]]))
    refuse("parameter.*one value.*none", read_beam_grid, write_table(tmp_path, rows[:2]))
    refuse("zenith_angle_deg", read_beam_grid, write_table(tmp_path, [*rows, ("e", 3, "steep")]))
    refuse("no beam file at", read_beam_grid, write_table(tmp_path, rows))
    assert main(["info", table]) == 0
    assert "9 beam files, 4 ports, over a grid of" in capsys.readouterr().out
