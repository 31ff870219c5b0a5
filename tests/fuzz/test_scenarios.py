"""Scenarios of any content are taken or refused in a sentence, and come back as they were."""

import json

import pytest
from changes import SCALE, require_answer
from hypothesis import given, settings
from hypothesis import strategies as st

from lusee_bayes.cli.options import parse_frequencies
from lusee_bayes.core.reading import parse_yaml
from lusee_bayes.experiment.keys import scenario_keys
from lusee_bayes.experiment.scenario import Scenario, load_scenario
from lusee_bayes.runs.cost import posterior_cost, require_fits
from lusee_bayes.runs.plan_run import given_variations

few_and_many = pytest.mark.parametrize("n", [50, pytest.param(500 * SCALE, marks=pytest.mark.long)])

NUMBERS = st.one_of(
    st.integers(), st.floats(), st.integers(-3, 60), st.floats(0.0, 50.0),
    st.sampled_from([10**400, -(10**400), 2**63, 2**62, 1e308, 5e-324, -0.0]),
)  # fmt: skip
WORDS = st.sampled_from([
    "", "galaxy", "file", "monopole", "response", "marginalised", "sampled", "exact", "isotropic",
    "2027-13-01", "2027-02-30", "2027-01-15", "0001-01-01", "9999-12-31T23:59:60", "/dev/null",
    "\uff11\uff12", "\u0661\u0662", "1e5", "0x10", "1:30", "null", "~", "a" * 300, "../x", "x\0y",
    "\u00e9", "!!python/x",
])  # fmt: skip
LEAVES = st.one_of(NUMBERS, WORDS, st.booleans(), st.none(), st.text(max_size=8))
VALUES = st.recursive(
    LEAVES,
    lambda inner: (
        st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=6), inner, max_size=3)
    ),
    max_leaves=6,
)


PATHS = sorted({*(key.path for key in scenario_keys())})


def load(overrides: list[str]) -> None:
    scenario = load_scenario("fiducial", overrides)
    # what is taken can be written and read again, and is small enough or refused
    again = parse_yaml(scenario.to_yaml(), "the resolved scenario")
    assert Scenario.model_validate(again) == scenario
    require_fits(posterior_cost(scenario), scenario)


@few_and_many
def test_every_entry_with_any_value(n):
    @settings(max_examples=n)
    @given(st.lists(st.tuples(st.sampled_from(PATHS), VALUES), min_size=1, max_size=3))
    def check(entries):
        # YAML takes JSON, and what JSON does not have (NaN, Infinity) as text
        overrides = [f"{path}={json.dumps(value)}" for path, value in entries]
        require_answer(lambda: load(overrides))

    check()


@few_and_many
def test_any_text_as_an_override(n):
    @settings(max_examples=n)
    @given(st.one_of(st.text(), st.builds("{}={}".format, st.sampled_from(PATHS), st.text())))
    def check(override):
        require_answer(lambda: load([override]))
        require_answer(lambda: given_variations("fiducial", [override], []))

    check()


@few_and_many
def test_any_file_as_a_scenario(n, tmp_path):
    path = tmp_path / "scenario.yaml"
    whole = load_scenario("gain_1e-2").to_yaml().encode()

    @settings(max_examples=n)
    @given(
        st.one_of(
            st.binary(max_size=60),
            st.text(alphabet="{}[]:,-&*!|>'\"#%@ \n\tab01~", max_size=60).map(str.encode),
            st.tuples(st.integers(0, len(whole)), st.binary(max_size=4)).map(
                lambda cut: whole[: cut[0]] + cut[1] + whole[cut[0] :]
            ),
            st.sampled_from([2, 40, 3000]).map(lambda depth: b"[" * depth),
        )
    )
    def check(content):
        path.write_bytes(content)
        require_answer(lambda: load_scenario(path))

    check()


@few_and_many
def test_any_frequencies(n):
    parts = st.one_of(
        st.floats().map(str), st.text(max_size=4), st.sampled_from(["1e-9", "50", "1"])
    )

    @settings(max_examples=n)
    @given(st.tuples(st.lists(parts, min_size=1, max_size=4), st.sampled_from(",:")))
    def check(drawn):
        text = drawn[1].join(drawn[0])
        require_answer(lambda: parse_frequencies(text))

    check()
