"""Scenarios: defaults, overrides, round trip, and errors that help."""

import pytest

from lusee_bayes.core.errors import InputError
from lusee_bayes.core.reading import parse_yaml
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


def test_every_entry_of_a_short_file_can_be_set():
    scenario = load_scenario("gain_1e-2", ["observation.runs.0.cycles=0.5", "noise.gain.sigma=0.1"])
    assert scenario.observation.runs[0].cycles == 0.5
    assert scenario.noise.gain.sigma == 0.1


def test_scientific_notation_without_a_sign_is_a_number(tmp_path):
    # YAML 1.1 reads 1e6 as text; users write it all the same
    path = tmp_path / "x.yaml"
    path.write_text("noise: {radiometer: {bandwidth_hz: 1e6}}\n")
    assert load_scenario(path).noise.radiometer.bandwidth_hz == 1e6


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("frequncy_mhz=3", "unknown key 'frequncy_mhz'; did you mean 'frequency_mhz'"),
        ("noise.radiometer.frm=x", "unknown key 'noise.radiometer.frm'; did you mean 'form'"),
        ("observation.runs.0.cycels=1", "observation.runs.0.cycels'; did you mean 'cycles'"),
        ("noise.radiometer.form=papr", "noise.radiometer.form is 'papr', but .*'paper' or 'exact'"),
        ("noise.radiometer.factor=0", "factor is 0, but input should be greater than 0"),
        ("noise.radiometer.bandwidth_hz=-1", "bandwidth_hz is -1, but .*greater than 0"),
        ("noise.radiometer.duty_cycle=1.5", "duty_cycle is 1.5, but .*less than or equal to 1"),
        ("frequency_mhz=60", "frequency_mhz is 60, but .*less than or equal to 50"),
        ("frequency_mhz=2.5e7", "frequency_mhz is 25000000.0, but .*is this Hz"),
        ("spectral.reference_mhz=2e7", "reference_mhz is 20000000.0, but .*is this Hz"),
        ("lmax=many", "lmax is 'many', but .*integer"),
        ("seed", "--set takes key.path=value, got 'seed'"),
        ("observation.runs.3.cycles=1", "'3' is not one of the entries 0..0"),
        ("lmax.x=1", "'lmax' holds a value, not a section"),
        ("seed=[", "not valid YAML"),
    ],
)
def test_errors_name_what_is_wrong(override, message):
    with pytest.raises(InputError, match=message) as caught:
        load_scenario("fiducial", [override])
    assert "\n" not in str(caught.value)


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


def test_yaml_of_the_package_holds_only_known_keys():
    for name in scenario_names():
        assert parse_yaml(load_scenario(name).to_yaml(), "the file")


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
