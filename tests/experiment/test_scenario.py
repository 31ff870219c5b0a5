"""Scenarios: keys, defaults, overrides, round trip, sections in kinds, and errors that help."""

import re
from itertools import chain
from pathlib import Path

import numpy as np
import pytest
from assertions import refuse, refused
from fits_files import write_images
from tables import tables

from lusee_bayes.core.reading import as_yaml, parse_yaml
from lusee_bayes.core.section import FILES
from lusee_bayes.experiment import instrument_sections, sky_sections
from lusee_bayes.experiment.instrument_sections import ResponseSection, ScalarBeamSection
from lusee_bayes.experiment.keys import keys_as_markdown, scenario_keys
from lusee_bayes.experiment.scenario import Scenario, load_scenario, scenario_names
from lusee_bayes.experiment.sky_sections import FileSkySection, GalaxySection, IsotropicPriorSection

TABLES = tables(__file__)


def test_the_fiducial_scenario_is_the_papers():
    scenario = load_scenario("fiducial")
    # section "Simulating the data vector" of arXiv:2508.16773
    assert (scenario.frequency_mhz, scenario.lmax) == (25.0, 47)
    observation = scenario.observation
    assert (observation.lon_deg, observation.lat_deg) == (182.258, -23.814)
    assert observation.step_s == 7200
    assert [(r.cycles, r.turntable_deg) for r in observation.runs] == [(1.0, 0.0)]
    assert scenario.noise.radiometer.bandwidth_hz == 1e6
    assert scenario.noise.radiometer.form == "paper"


def assert_kept(scenario, folder):
    """Written and read again, a scenario is the same."""
    (folder / "again.yaml").write_text(scenario.to_yaml())
    assert load_scenario(folder / "again.yaml") == scenario


@pytest.mark.parametrize("name", scenario_names())
def test_a_resolved_scenario_is_the_same_scenario(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / name).mkdir()  # results, which do not hide the scenario
    scenario = load_scenario(name, ["seed=7", "observation.runs.0.turntable_deg=12.5"])
    assert_kept(scenario, tmp_path)
    assert (scenario.seed, scenario.observation.runs[0].turntable_deg) == (7, 12.5)


@pytest.fixture
def short(write):
    """A scenario of a file with this text alone."""
    return lambda text, *overrides: load_scenario(write(text, "short.yaml"), overrides)


def test_overrides_reach_into_sections_that_the_file_leaves_out(short):
    given = ["noise.radiometer.factor=10", "sky.file=a.hdf5", "nside=null"]
    scenario = short("frequency_mhz: 10\n", *given)
    assert scenario.noise.radiometer.factor == 10.0
    assert (scenario.sky.file, scenario.nside) == ("a.hdf5", None)


HERE = Path(__file__).parent
MISTAKES = (HERE / "refused_overrides.yaml").read_text("utf-8")
# a line for each rule and kind of mistake; what single numbers and words may be is below
REFUSED = [*chain(*parse_yaml(MISTAKES, "a table").values())]


@pytest.mark.parametrize(("overrides", "message"), REFUSED, ids=lambda text: text[:60])
def test_errors_name_what_is_wrong(overrides, message):
    with refused(message) as caught:
        load_scenario("fiducial", ["sky.sources=false", *re.split(r" (?=[a-z_.]+=)", overrides)])
    assert len(str(caught.value)) < 250


def test_errors_of_the_file_itself(short):
    refuse("scenario 'fiducail'.*'fiducial'", load_scenario, "fiducail")
    refuse("keys and values.*list", short, "- 1\n")
    refuse("not valid YAML", short, "a: [1\n")


def test_default_maps_have_two_pixels_for_each_ell():
    for lmax, nside in [(8, 8), (47, 32), (64, 64), (95, 64)]:
        assert Scenario(lmax=lmax).map_nside == nside >= lmax / 2


def test_anchored_scenarios_name_the_same_files_in_any_folder(tmp_path, monkeypatch):
    settings = ["sky={model: file, file: a.fits}", "prior={model: isotropic, mean_file: b.fits}"]
    settings += ["observation.schedule=c.csv", "beam.file=d.nc"]
    scenario = load_scenario("fiducial", settings)
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
    others = {"schedule", "clock", "gain_table", "lines"}
    assert files <= set(FILES) and set(FILES) - files == others


def test_shipped_scenarios_are_what_their_names_say():
    assert {"fiducial", *TABLES["shipped"]} <= set(scenario_names())
    for name, change in TABLES["shipped"].items():
        assert load_scenario(name) == load_scenario("fiducial", [change]), name


# all keys, as a resolved scenario was written before sections came in kinds
OLD = (HERE / "scenario_of_0.1.yaml").read_text("utf-8")


def old_scenario(path, **changes):
    """The scenario of the old text with some sections' entries changed."""
    tree = parse_yaml(OLD, "the file")
    for section, entries in changes.items():
        tree[section] |= entries
    path.write_text(as_yaml(tree))
    return load_scenario(path)


@pytest.fixture
def response(tmp_path):
    """A file that is known as a four-port response by its images."""
    return str(write_images(tmp_path / "ports.fits", {"h_theta_real": np.zeros((1, 1))}, {}))


@pytest.fixture
def scalar(tmp_path):
    """A FITS file that is none."""
    return str(write_images(tmp_path / "arm.fits", {"Etheta_real": np.zeros((1, 1))}, {}))


# --- scenarios that were written before -----------------------------------------------------------


def test_the_old_fiducial_scenario_is_the_fiducial_scenario(tmp_path):
    found = old_scenario(tmp_path / "old.yaml")
    # it says of which visibilities the noise level is that, which has since been left open
    # nor that its beams are exact
    since = ["noise.radiometer.temperature=model", "beam.exact=false"]
    assert found == load_scenario("fiducial", since)
    assert found.prior == IsotropicPriorSection(spectrum="sky")
    # written again, it has no key of another kind
    tree = parse_yaml(found.to_yaml(), "the file")
    assert set(tree["beam"]) == set(instrument_sections.MonopoleBeamSection.model_fields)
    assert set(tree["sky"]) == set(GalaxySection.model_fields)
    assert tree["prior"]["spectrum"] == "sky"


def test_what_an_old_scenario_says_of_beams_is_kept(tmp_path, scalar, response):
    embedded = {"length_m": 2.5, "loss_tangent": 0.02, "turntable_offset_deg": 3.0}
    of_files = {"quadrature": "luseepy", "moon_temperature_k": 250.0, "turntable_offset_deg": 7.0}
    arm = {"file": scalar, "taper": False, "rotations_deg": [0.0, 90.0], **of_files}
    ports = {"file": response, "receiver": "open", "antenna_temperature_k": 300.0}
    for beam, kind in (
        (embedded, instrument_sections.MonopoleBeamSection),
        (arm, ScalarBeamSection),
        (ports, ResponseSection),
    ):
        prior = {"scale": 2.0, "tilt_std": 0.5}
        found = old_scenario(tmp_path / "old.yaml", beam=beam, prior=prior)
        assert found.beam == kind(**beam)
        assert found.prior == IsotropicPriorSection(**prior)
        assert_kept(found, tmp_path)


def test_an_old_scenario_with_a_sky_from_a_file(tmp_path):
    """``sources`` were said there, too, without effect; sources beside the map may be."""
    sky = {"file": "x.hdf5", "dataset": "map", "file_frequency_mhz": 10.0}
    beside = {"list": [{"name": "Cas A"}]}
    found = old_scenario(tmp_path / "old.yaml", sky=sky | {"sources": True}, sources=beside)
    assert found.sky == FileSkySection(**sky) and not found.sky.sources
    assert [source.name for source in found.sources.list] == ["Cas A"]


def test_a_file_tells_which_sky_or_beams_they_are(short, response, scalar):
    for text, kind in (
        ("sky: {file: x.fits}", FileSkySection),
        ("sky: {model: galaxy, file: x.fits}", FileSkySection),
        ("sky: {model: galaxy, file: null}", GalaxySection),
        ("sky: {seed: 3}", GalaxySection),
    ):
        assert type(short(text).sky) is kind, text
    for file, kind in [(response, ResponseSection), (scalar, ScalarBeamSection)]:
        for found in (short(f"beam: {{file: {file}}}"), short("", f"beam.file={file}")):
            assert found.beam == kind(file=file)


def test_a_prior_takes_the_place_of_another(tmp_path, short):
    """``--set`` leaves the keys of the kind that was there, which the other kind drops."""
    found = load_scenario("fiducial", ["prior.model=local_scales", "prior.sources=false"])
    assert found.prior == sky_sections.LocalScalesPriorSection(sources=False)
    assert_kept(found, tmp_path)
    plain = load_scenario("fiducial", ["prior.model=local_scales"])
    back = short(plain.to_yaml(), "prior.model=isotropic")
    assert back == load_scenario("fiducial", ["prior.spectrum=learned"])
    assert short("prior: {tilt_std: 0.5}").prior == IsotropicPriorSection(tilt_std=0.5)


# --- the section of another file ------------------------------------------------------------------


def test_the_section_of_another_file_is_put_up_alike(response, scalar):
    shared = {"turntable_offset_deg": 7.0, "quadrature": "luseepy", "moon_temperature_k": 250.0}
    own = {"taper": False, "rotations_deg": (0.0, 120.0)}
    arm = ScalarBeamSection(file="own.fits", **own, **shared)
    assert arm.of_file(scalar) == arm.model_copy(update={"file": scalar})
    assert arm.of_file(response) == ResponseSection(file=response, **shared)
    ports = ResponseSection(file="own.fits", receiver="open", **shared)
    assert ports.of_file(scalar) == ScalarBeamSection(file=scalar, **shared)
    embedded = instrument_sections.MonopoleBeamSection(turntable_offset_deg=7.0, length_m=2.0)
    assert embedded.of_file(scalar) == ScalarBeamSection(file=scalar, turntable_offset_deg=7.0)


KEYS = scenario_keys()
PAGE = Path(__file__).parents[2] / "docs" / "keys.md"


def leaves(tree, prefix=""):
    for name, value in tree.items():
        yield prefix + name
        if isinstance(value, dict):
            yield from leaves(value, f"{prefix}{name}.")
        elif isinstance(value, list) and value and isinstance(value[0], dict):
            yield from leaves(value[0], f"{prefix}{name}.0.")


def test_every_key_of_a_written_scenario_is_listed_and_explained():
    scenario = load_scenario("fiducial", [*TABLES["within"].values(), "sky.sources=false"])
    written = set(leaves(parse_yaml(scenario.to_yaml(), "the file")))
    listed = {key.path for key in KEYS}
    parents = {path for path in written if any(p.startswith(f"{path}.") for p in listed)}
    assert written - parents <= listed
    assert [key.path for key in KEYS if not key.meaning] == []


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    """A scenario of the schema's defaults alone."""
    path = tmp_path_factory.mktemp("plain") / "plain.yaml"
    path.write_text(Scenario(sky={"sources": False}).to_yaml())
    return str(path)


DEFAULTS = [
    k for k in KEYS
    if k.default not in ("required", "none") and k.kind in ("", "monopole", "galaxy", "isotropic")
]  # fmt: skip


@pytest.mark.parametrize("key", DEFAULTS, ids=lambda key: key.path)
def test_a_default_changes_nothing(plain, key):
    before = [text for name, text in TABLES["within"].items() if key.path.startswith(f"{name}.")]
    value = "false" if key.path == "sky.sources" else key.default
    assert load_scenario(plain, [*before, f"{key.path}={value}"]) == load_scenario(plain, before)


RECEIVER = "beam={model: response, file: x, receiver: {model: %s, file: x}}"
OF_FILES = "luseepy", "response", "sampled", "grid"
OF_KIND = {name: f"beam={{model: {name}, file: x}}" for name in OF_FILES}
OF_KIND |= {name: f"prior.model={name}" for name in ("isotropic", "local_scales")}
OF_KIND |= {name: (RECEIVER % name).replace(", file: x}}", "}}") for name in ("jfet", "capacitor")}


def of_kind(key):
    """Overrides by which the section of a key is there, of its kind."""
    before = [text for name, text in TABLES["within"].items() if key.path.startswith(f"{name}.")]
    if key.kind == "file":
        before += ["sky={model: file, file: x}" if key.path[0] == "s" else RECEIVER % "file"]
    return before + ([OF_KIND[key.kind]] if key.kind in OF_KIND else [])


def outside(choices):
    """Values that a key does not take, by the words for those that it takes."""
    numbers = re.search(r"(?:number|integer), (.*)", choices)
    if numbers is None:
        return ["neither"] if re.fullmatch(r"(list of: )?\w+(, \w+)+", choices) else []
    if " to " in numbers[1]:
        low, high = map(float, numbers[1].split(" to "))
        return [low - 1.0, high + 1.0]
    beside = {">": 0.0, "<": 0.0, ">=": -1.0, "<=": 1.0}
    found = re.findall(r"([<>]=?) ([^,]+)", numbers[1])
    return [float(bound) + beside[sign] for sign, bound in found]


@pytest.mark.parametrize("key", [k for k in KEYS if outside(k.choices)], ids=lambda key: key.path)
def test_what_is_listed_of_a_key_is_enforced_and_the_key_is_named(key):
    for value in outside(key.choices):
        if key.choices.startswith("list of"):
            value = f"[{value}, {value}, {value}, {value}]"
        elif key.choices.startswith("name: "):
            value = f"{{clock_s: {value}, length_m: {value}}}"
        with refused(rf"{re.escape(key.path)}(\.\w+)? is "):
            load_scenario("fiducial", [*of_kind(key), f"{key.path}={value}"])


def test_a_section_is_listed_alone_and_a_wrong_one_is_corrected():
    assert {key.path.split(".")[1] for key in scenario_keys("noise.gain")} == {"gain"}
    assert [key.path for key in scenario_keys("lmax")] == ["lmax"]
    refuse(r"key 'noise\.gane'.*'noise\.gain'", scenario_keys, "noise.gane")


def test_the_page_of_keys_is_up_to_date():
    # lusee-bayes keys --markdown writes the table
    assert PAGE.read_text().endswith("\n\n" + keys_as_markdown(KEYS))
