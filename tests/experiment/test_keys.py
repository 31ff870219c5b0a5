"""The list of a scenario's keys: complete, in words, and true of what scenarios accept."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from assertions import refused

from lusee_bayes.core.reading import parse_yaml
from lusee_bayes.experiment.keys import keys_as_markdown, scenario_keys
from lusee_bayes.experiment.scenario import Scenario, load_scenario

KEYS = scenario_keys()
PAGE = Path(__file__).parents[2] / "docs" / "keys.md"
# how sections and lists that are empty by default come to be there
WITHIN = {
    "noise.gain": "noise.gain={}",
    "noise.beam": "noise.beam={shift_mhz: 4}",
    "noise.pointing": "noise.pointing={clock_s: 60}",
    "noise.receiver": "noise.receiver={power_k: 100}",
    "noise.regolith": "noise.regolith={std_k: 20}",
    "noise.gain_table": "noise.gain_table={std: 0.01}",
    "sources.list.0": "sources.list=[{name: Cas A}]",
    "flight": "flight={}",
    "flight.simulated": "flight.simulated={}",
}


def leaves(tree, prefix=""):
    for name, value in tree.items():
        yield prefix + name
        if isinstance(value, dict):
            yield from leaves(value, f"{prefix}{name}.")
        elif isinstance(value, list) and value and isinstance(value[0], dict):
            yield from leaves(value[0], f"{prefix}{name}.0.")


def test_every_key_of_a_written_scenario_is_listed_and_explained():
    scenario = load_scenario("fiducial", [*WITHIN.values(), "sky.sources=false"])
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
    before = [text for name, text in WITHIN.items() if key.path.startswith(f"{name}.")]
    value = "false" if key.path == "sky.sources" else key.default
    changed = load_scenario(plain, [*before, f"{key.path}={value}"])
    assert changed == load_scenario(plain, before)


RECEIVER = "beam={model: response, file: x, receiver: {model: %s, file: x}}"
OF_KIND = {name: f"beam={{model: {name}, file: x}}" for name in ("luseepy", "response", "sampled")}
OF_KIND |= {name: f"prior.model={name}" for name in ("isotropic", "local_scales")}
OF_KIND |= {name: (RECEIVER % name).replace(", file: x}}", "}}") for name in ("jfet", "capacitor")}


def of_kind(key):
    """Overrides by which the section of a key is there, of its kind."""
    before = [text for name, text in WITHIN.items() if key.path.startswith(f"{name}.")]
    if key.kind == "file":
        before += ["sky={model: file, file: x}" if key.path[0] == "s" else RECEIVER % "file"]
    return before + ([OF_KIND[key.kind]] if key.kind in OF_KIND else [])


def outside(choices):
    """Values that a key does not take, by the words for those that it takes."""
    numbers = re.search(r"(?:number|integer), (.*)", choices)
    if numbers is None:
        of_words = re.fullmatch(r"(list of: )?\w+(, \w+)+", choices)
        return ["neither"] if of_words else []
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


def test_units_are_those_of_the_names():
    units = {
        "v2_hz" if key.path.endswith("_v2_hz") else key.path.rsplit("_", 1)[-1]: key.unit
        for key in KEYS
        if key.unit
    }
    assert units == {
        "mhz": "MHz", "hz": "Hz", "deg": "degrees", "m": "m", "s": "s", "h": "h", "k": "K",
        "day": "s/day", "v2_hz": "V²/Hz",
        "jy": "Jy", "pf": "pF", "nh": "nH", "ohm": "Ohm",
    }  # fmt: skip


def test_a_section_is_listed_alone_and_a_wrong_one_is_corrected():
    assert {key.path.split(".")[1] for key in scenario_keys("noise.gain")} == {"gain"}
    assert [key.path for key in scenario_keys("lmax")] == ["lmax"]
    with refused("no key 'noise.gane'; did you mean 'noise.gain'?"):
        scenario_keys("noise.gane")


def test_the_page_of_keys_is_up_to_date():
    # lusee-bayes keys --markdown writes the table
    assert PAGE.read_text().endswith("\n\n" + keys_as_markdown(KEYS))
