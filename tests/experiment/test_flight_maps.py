"""Maps of flight files against maps of the same data in K, and against the known sky."""

from dataclasses import replace

import numpy as np
import pytest
from naive_flight import naive_band

import lusee_bayes as lb
from lusee_bayes.core.errors import InputError
from lusee_bayes.experiment.data_files import read_data
from lusee_bayes.experiment.experiment import build, infer
from lusee_bayes.experiment.flight_data import per_kelvin_of, reduce_files
from lusee_bayes.experiment.setup import set_up
from lusee_bayes.flight.gain_model import read_gain_table
from lusee_bayes.instrument.products import auto_indices, labels
from lusee_bayes.instrument.visibilities import Calibration
from lusee_bayes.results.unknowns import unknowns_report
from lusee_bayes.testing.checks import assert_refused

NAMES = "abcd"


@pytest.fixture(scope="module")
def truth(flight):
    return dict(np.load(flight / "truth.npz"))


def scenario_of(flight, *changes):
    luseepy = flight.parent / "luseepy"
    given = [
        "frequency_mhz=10.0",
        "lmax=32",
        "observation={timestamp: instant}",
        f"beam={{model: response, file: {luseepy / 'synthetic_response_v3.fits'}, receiver: jfet, "
        "moon_temperature_k: 250.0}",
        f"sky={{model: file, file: {luseepy / 'sky_alm.npz'}}}",
        "prior={model: isotropic, spectrum: sky}",
        "noise={radiometer: {form: exact, temperature: measured}, "
        "receiver: {power_v2_hz: 4.0e-20, relative_std: 0.1}}",
        f"flight={{gain_table: {flight / 'gain'}, bin_origin: centre}}",
    ]
    return lb.load_scenario("fiducial", [*given, *changes])


def files(flight):
    return [flight / f"session_{name}.h5" for name in NAMES]


@pytest.fixture(scope="module")
def mapped(flight):
    """One map of the four sessions, with everything that is done to them."""
    scenario = scenario_of(flight)
    experiment = build(scenario, read_data(files(flight), scenario))
    return experiment, infer(experiment)


def test_what_the_comb_spoils_and_nothing_else_is_left_out(mapped, truth):
    """Of bins that hold four channels each, the comb is no line: only the others tell."""
    experiment, _ = mapped
    comb = [(s, int(r)) for s, r in truth["comb"] if s == "c"]
    saturated = {(s, int(r)) for s, r in truth["saturated"]}
    names = [(s, int(r)) for s, r in zip(truth["session"], truth["row"], strict=True)]
    times = [name for name in names if name not in saturated]
    flagged = [times[k] for k in np.flatnonzero(experiment.fitting.times)]
    assert flagged == comb
    assert "3 of 124 times" in experiment.fitting.remark


def test_the_map_is_that_of_the_same_data_in_kelvin(flight, truth, mapped):
    """Data that are made by hand, a sum for each product, and know nothing of sessions."""
    _, found = mapped
    per_kelvin = truth["per_kelvin_v2_hz"][0]
    scale = np.sqrt([per_kelvin[int(x[0])] * per_kelvin[int(x[1])] for x in labels()])
    bad = {(s, int(r)) for s, r in [*truth["comb"], *truth["saturated"]] if s == "c"}
    names = [(s, int(r)) for s, r in zip(truth["session"], truth["row"], strict=True)]
    keep = [k for k, name in enumerate(names) if name not in bad]
    combs = [("d", 4), ("d", 5)]
    made = [naive_band(flight, *names[k], 10.0, comb=names[k] in combs) for k in keep]
    data = lb.Visibilities.from_arrays(
        np.array([values for values, _ in made]) / scale,
        truth["times_utc"][keep],
        10.0,
        products=list(labels()),
        site=(float(truth["lon_deg"]), float(truth["lat_deg"])),
        timestamp="instant",
        step_s=float(truth["integration_s"]),
    )
    # how many samples there are is not said by times
    data = replace(data, calibration=Calibration(np.array([n for _, n in made])))
    plain = scenario_of(flight, "flight.leave_out=false")
    other = infer(build(plain, data)).posterior
    std = np.asarray(other.std())
    moved = (np.asarray(found.posterior.mean) - np.asarray(other.mean)) / std
    assert np.abs(moved).max() < 0.01
    np.testing.assert_allclose(np.asarray(found.posterior.std()), std, rtol=1e-3)


def test_the_known_sky_is_within_the_error_bars(mapped):
    experiment, found = mapped
    sky = np.asarray(experiment.setup.sky.modes)
    off = found.posterior.whiten(sky[None])[0]
    # an isotropic prior of the sky's own C_ell: chi^2 of the modes scatters by sqrt(2 n)
    n = len(off)
    assert np.sum(off**2) == pytest.approx(n, abs=5.0 * np.sqrt(2.0 * n))
    report = unknowns_report(experiment, found)
    told = report.table.set_index("unknown")
    truth_k = 4e-20 / per_kelvin_of(experiment.scenario)
    for port in range(4):
        row = told.loc[f"receiver_{port}_k"]
        assert abs(row["value"] - truth_k[port]) < 5.0 * row["std"]
        assert row["std"] < 0.1 * row["prior_std"]


@pytest.mark.long
def test_gains_that_are_off_are_found_and_the_map_holds(flight, monkeypatch):
    """Gains of every level of every port off by 1 %: the map is within wider error bars."""
    drawn = 1.0 + 0.01 * np.random.default_rng(4).standard_normal((3, 4))
    original = read_gain_table

    def off(path, model="quadratic"):
        table = original(path, model)
        return replace(
            table,
            mean=table.mean * drawn[:, :, None],
            component=table.component * drawn[:, :, None, None],
        )

    monkeypatch.setattr("lusee_bayes.experiment.flight_data.read_gain_table", off)
    known = scenario_of(flight, "flight.gain_std=0.01", "noise.gain_table={}")
    experiment = build(known, read_data(files(flight), known))
    assert experiment.fitting.times.sum() == 3
    found = infer(experiment)
    sky = np.asarray(experiment.setup.sky.modes)
    off_by = found.posterior.whiten(sky[None])[0]
    n = len(off_by)
    assert np.sum(off_by**2) == pytest.approx(n, abs=5.0 * np.sqrt(2.0 * n))
    told = unknowns_report(experiment, found).table.set_index("unknown")
    gains = told[told.index.str.startswith("gain")]
    # values were divided by gains that are too large: the true gain is below the table's
    assert len(gains) == 6
    for name, row in gains.iterrows():
        level, port = name.split("_")[-1][:2]
        true = (1.0 / drawn["LMH".index(level.upper()), int(port)] - 1.0) / 0.01
        value, std = row["value"] / row["prior_std"], row["std"] / row["prior_std"]
        assert abs(value - true) < 5.0 * std
    # taken for exact, nothing fits
    exact = scenario_of(flight)
    assert build(exact, read_data(files(flight), exact)).fitting.remark.startswith("More than")


ASKED = [
    ("flight.gain_table=null", "names no gain table"),
    ("flight.bin_origin=null", "flight.bin_origin=centre"),
    ("observation.timestamp=null", "observation.timestamp=middle"),
    ("flight=null", "give it a section flight"),
]


@pytest.mark.parametrize(("change", "told"), ASKED)
def test_what_files_leave_open_is_asked_for_by_name(flight, change, told):
    scenario = scenario_of(flight, change)
    with pytest.raises(InputError, match=told):
        read_data(files(flight)[:1], scenario)


def test_beams_have_to_know_volts(flight):
    embedded = scenario_of(flight, "beam={model: monopole}", "noise.receiver=null")
    with pytest.raises(InputError, match="these beams know no volts"):
        read_data(files(flight)[:1], embedded)
    volts = "flight.per_kelvin_v2_hz=5.0e-23"
    said = scenario_of(flight, "beam={model: monopole}", "noise.receiver=null", volts)
    data = read_data(files(flight)[:1], said)
    autos = data.grid()[auto_indices()]
    assert 1e5 < autos.min() < autos.max() < 2e5
    assert_refused(lambda: read_data(files(flight)[:1], scenario_of(flight, volts)))


def test_a_session_is_given_once_and_other_files_are_not_mixed(flight):
    scenario = scenario_of(flight)
    one = files(flight)[0]
    assert_refused(lambda: reduce_files([one, one], scenario))
    assert_refused(lambda: read_data([one, flight / "truth.npz"], scenario))


def test_another_site_is_named(flight):
    elsewhere = scenario_of(flight, "observation.lat_deg=-20.0")
    data = read_data(files(flight)[:1], elsewhere)
    with pytest.raises(InputError, match="use --set observation"):
        set_up(elsewhere, data)
    ours = scenario_of(flight, "observation.lat_deg=-20.0", "flight.site=scenario")
    assert read_data(files(flight)[:1], ours).observation.lat_deg == -20.0
