"""Scenarios: defaults, overrides, round trip, and errors that help."""

import re

import pytest
from assertions import refused

from lusee_bayes.core.errors import InputError
from lusee_bayes.experiment.keys import scenario_keys
from lusee_bayes.experiment.scenario import Scenario, load_scenario, scenario_names
from lusee_bayes.experiment.section import FILES


def test_the_fiducial_scenario_is_the_papers():
    scenario = load_scenario("fiducial")
    # section "Simulating the data vector" of arXiv:2508.16773
    assert (scenario.frequency_mhz, scenario.lmax) == (25.0, 47)
    observation = scenario.observation
    assert (observation.lon_deg, observation.lat_deg, observation.step_s) == (
        182.258,
        -23.814,
        7200,
    )
    assert [(r.cycles, r.turntable_deg) for r in observation.runs] == [(1.0, 0.0)]
    assert scenario.noise.radiometer.bandwidth_hz == 1e6
    assert scenario.noise.radiometer.form == "paper"


@pytest.mark.parametrize("name", scenario_names())
def test_a_resolved_scenario_is_the_same_scenario(name, tmp_path):
    scenario = load_scenario(name, ["seed=7", "observation.runs.0.turntable_deg=12.5"])
    (tmp_path / "again.yaml").write_text(scenario.to_yaml())
    assert load_scenario(tmp_path / "again.yaml") == scenario
    assert scenario.seed == 7
    assert scenario.observation.runs[0].turntable_deg == 12.5


def test_overrides_reach_into_sections_that_the_file_leaves_out(tmp_path):
    path = tmp_path / "short.yaml"
    path.write_text("frequency_mhz: 10\n")
    scenario = load_scenario(path, ["noise.radiometer.factor=10", "sky.file=a.hdf5", "nside=null"])
    assert scenario.noise.radiometer.factor == 10.0
    assert scenario.sky.file == "a.hdf5"
    assert scenario.nside is None


def test_scientific_notation_without_a_sign_is_a_number(tmp_path):
    # YAML 1.1 reads 1e6 as text; users write it all the same
    path = tmp_path / "x.yaml"
    path.write_text("noise: {radiometer: {bandwidth_hz: 1e6}}\n")
    assert load_scenario(path).noise.radiometer.bandwidth_hz == 1e6


# a line for each rule and kind of mistake; what single numbers and words may be: test_keys.py
SHIFT, PARAMETERS = "noise.beam.shift_mhz=4", "noise.beam.parameters={length_m: 0.1}"
SCHEDULE = "observation={schedule: nights.csv, window: mean, step_s: 20000, %s}"
FOUR = "frequencies_mhz=[10, 15, 20, 30]"
REFUSED = [
    # names
    ("frequncy_mhz=3", "unknown key 'frequncy_mhz'; did you mean 'frequency_mhz'"),
    ("observation.runs.0.cycels=1", "observation.runs.0.cycels'; did you mean 'cycles'"),
    ("beam.lenth_m=3", "unknown key 'beam.lenth_m'; did you mean 'length_m'?"),
    ("beam.model=dipole", "beam.model is 'dipole', which is unknown; .*monopole"),
    ("sky.model=galaxi", "sky.model is 'galaxi', which is unknown; did you mean 'galaxy'?"),
    ("spectral.fields=[levle]", "spectral.fields"),
    # values
    ("frequency_mhz=2.5e7", "frequency_mhz is 25000000.0, but .*is this Hz"),
    ("spectral.reference_mhz=2e7", "reference_mhz is 20000000.0, but .*is this Hz"),
    ("lmax=many", "lmax is 'many', but .*integer"),
    ("lmax=true", "lmax is True"),
    ("lmax=\uff11\uff12", "lmax is"),
    (f"seed={2**64}", "seed is 18446744073709551616"),
    ("nside=3", "nside is 3, .*power of two"),
    ("noise.gain=3", "noise.gain is 3, but it should be a section"),
    ("flight={simulated: {levels: MMMX}}", "levels"),
    ("flight={simulated: {levels: MMM}}", "levels"),
    # what --set takes
    ("seed", "--set takes key.path=value, got 'seed'"),
    ("observation.runs.3.cycles=1", "'3' is not one of the entries 0..0"),
    ("lmax.x=1", "'lmax' holds a value, not a section"),
    ("seed=[", "not valid YAML"),
    # entries of another kind, and those that have to be there
    ("beam.receiver=open", "fiducial: beam: receiver is an entry of model response, not of"),
    ("beam.quadrature=luseepy", "quadrature is an entry of model luseepy, response, not of"),
    ("beam.moon_temperature_k=250", "temperatures of Moon and antennas need beam.file"),
    (
        "beam={file: arm.fits, antenna_temperature_k: 300}",
        "arm.fits is a scalar beam, which knows of no losses",
    ),
    ("beam={file: arm.fits, height_m: 1}", "height_m is an entry of model monopole"),
    ("prior.sources=false", "sources is an entry of model local_scales, not of"),
    ("prior={model: local_scales, scale: 2}", "of model isotropic, not of local_scales"),
    ("beam.model=luseepy", "beam.file is missing"),
    ("sources.list=[{flux_jy: 3}]", "sources.list.0.name is missing"),
    ("noise.regolith={}", "std_k is missing"),
    ("noise.pointing={treatment: sampled}", "deviation of at least one of clock_s"),
    # entries that exclude or need one another
    (f"{SHIFT} {PARAMETERS}", "give either shift_mhz, file or parameters"),
    ("noise.beam.treatment=ignored", "give either shift_mhz, file or parameters"),
    ("noise.receiver={}", "give either power_v2_hz or power_k"),
    ("noise.receiver={power_k: 1, power_v2_hz: 1e-17}", "give either power_v2_hz or power_k"),
    ("noise.gain.log_sigma_std=0.5", "log_sigma_std .* need treatment 'sampled'"),
    ("noise.gain={log_correlation_std: 0.5}", "log_correlation_std need treatment 'sampled'"),
    ("prior.band_edges=[3, 3]", "band_edges must grow from one to the next"),
    ("prior={band_edges: [2, 4], tilt_std: 0.5}", "give either band_edges or"),
    ("prior={band_edges: [2, 4], log_amplitude_std: 0.5}", "give either band_edges or"),
    ("log_normal={amplitude: 0.1}", "give both amplitude and tilt, or neither"),
    ("log_normal={tilt: -2}", "give both amplitude and tilt, or neither"),
    ("sky.sources=true sources.list=[{name: Cas A}]", "set sky.sources=false"),
    ("sources.list=[{name: Cas A}, {name: Vir A}, {name: Cas A}]", "'Cas A' is there twice"),
    ("sources.list=[{name: X, ra_deg: 10}]", "give both ra_deg and dec_deg, or none"),
    ("sources.list=[{name: X, dec_deg: 10}]", "give both ra_deg and dec_deg, or none"),
    (f"prior.spectrum_file=a.txt {FOUR}", "say which in prior.file_frequency_mhz"),
    (f"prior.spectrum_file=a.txt {FOUR} joint=true", "joint takes the spectral prior"),
    (
        "frequencies_mhz=[10] joint=true spectral={model: positive, fields: [level, index]}",
        "2 fields of the logarithm need at least as many chan",
    ),
    (SCHEDULE % "start: 2027-01-16", "says when data are taken, and so does start"),
    (SCHEDULE % "runs: [{cycles: 2}]", "and so does runs; leave out one of them"),
    (SCHEDULE % "fixed_axis: true", "add window: instant"),
    ("observation.schedule=12", "observation.schedule"),
]  # fmt: skip


@pytest.mark.parametrize(("overrides", "message"), REFUSED, ids=lambda text: text[:60])
def test_errors_name_what_is_wrong(overrides, message):
    given = re.split(r" (?=[a-z_.]+=)", overrides)
    with refused(message) as caught:
        load_scenario("fiducial", ["sky.sources=false", *given])
    assert len(str(caught.value)) < 250


def test_errors_of_the_file_itself(tmp_path):
    with pytest.raises(InputError, match="no scenario 'fiducail'.*did you mean 'fiducial'"):
        load_scenario("fiducail")
    (tmp_path / "list.yaml").write_text("- 1\n")
    with pytest.raises(InputError, match="must hold keys and values, got a list"):
        load_scenario(tmp_path / "list.yaml")
    (tmp_path / "bad.yaml").write_text("a: [1\n")
    with pytest.raises(InputError, match="not valid YAML"):
        load_scenario(tmp_path / "bad.yaml")


def test_default_maps_have_two_pixels_for_each_ell():
    for lmax, nside in [(8, 8), (47, 32), (64, 64), (95, 64)]:
        scenario = Scenario(lmax=lmax)
        assert scenario.map_nside == nside
        assert 2 * scenario.map_nside >= lmax


def test_anchored_scenarios_name_the_same_files_in_any_folder(tmp_path, monkeypatch):
    settings = (
        "sky={model: file, file: a.fits}",
        "prior={model: isotropic, mean_file: b.fits}",
        "observation.schedule=c.csv",
        "beam.file=d.nc",
    )
    scenario = load_scenario("fiducial", list(settings))
    monkeypatch.chdir(tmp_path)
    found = scenario.anchored()
    names = found.sky.file, found.prior.mean_file, found.observation.schedule, found.beam.file
    assert names == tuple(str(tmp_path / name) for name in ("a.fits", "b.fits", "c.csv", "d.nc"))
    assert found.anchored() == found
    # what is no file has another name nowhere
    plain = load_scenario("fiducial")
    assert plain.anchored() == plain


def test_every_entry_that_names_a_file_is_known():
    keys = {entry.path.split(".")[-1] for entry in scenario_keys()}
    files = {key for key in keys if key == "file" or key.endswith("_file")}
    assert files <= set(FILES) and set(FILES) - files == {
        *("schedule", "clock", "gain_table", "lines"),
    }


SHIPPED = {
    "noise_x10": "noise.radiometer.factor=10",
    "noise_x100": "noise.radiometer.factor=100",
    "duty_cycle_50": "noise.radiometer.duty_cycle=0.5",
    "gain_1e-2": "noise.gain={sigma: 0.01, correlation_h: 10}",
    "gain_1e-3": "noise.gain={sigma: 0.001, correlation_h: 10}",
    "gain_ignored": "noise.gain={sigma: 0.01, correlation_h: 10, treatment: ignored}",
    "beam_4MHz": "noise.beam={shift_mhz: 4}",
    "beam_0.4MHz": "noise.beam={shift_mhz: 0.4}",
    "beam_ignored": "noise.beam={shift_mhz: 4, treatment: ignored}",
    "two_cycles": "observation.runs=[{cycles: 1}, {cycles: 1, turntable_deg: 30}]",
    "three_cycles": "observation.runs=[{cycles: 1}, {cycles: 1, turntable_deg: 30}, "
    "{cycles: 1, turntable_deg: 60}]",
    "quarter_cycle": "observation.runs=[{cycles: 0.25}]",
}


def test_shipped_scenarios_are_what_their_names_say():
    assert {"fiducial", *SHIPPED} <= set(scenario_names())
    for name, change in SHIPPED.items():
        assert load_scenario(name) == load_scenario("fiducial", [change]), name
