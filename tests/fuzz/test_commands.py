"""Whatever is typed: an answer, or one sentence and exit code 2, with nothing left behind."""

import json
import os
import re
from itertools import chain
from pathlib import Path

import pytest
from changes import SCALE, require_answer
from commands import refused
from hypothesis import example, given, settings
from hypothesis import strategies as st

from lusee_bayes.cli.main import main
from lusee_bayes.cli.options import parse_frequencies
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.reading import parse_yaml
from lusee_bayes.experiment.keys import scenario_keys
from lusee_bayes.experiment.scenario import Scenario, load_scenario
from lusee_bayes.runs import cost, plan_run

FEW, MANY = 30, 3_000 * SCALE
SMALL = ("--set", "lmax=2", "--set", "observation.runs.0.cycles=0.02", "-q")


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """An empty folder to work in."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("a file")
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "program.py").write_text("def model(data=None):\n    pass\n")
    return tmp_path


LONG, NUL, OTHER = "n" * 300, "a\0b", "x\udcff.nc"
TABLE = Path(__file__).with_name("wrong_commands.yaml")
# commands about the scenario fiducial are given SMALL, too
WRONG = [
    *chain(*parse_yaml(TABLE.read_text("utf-8"), "a table").values()),
    (f"map fiducial -o {LONG}", "too long"),
    (f"map fiducial -o {NUL}", "NUL"),
    ("map fiducial --set lmax=" + "9" * 5000, "is not valid YAML"),
    (f"map fiducial --data {OTHER}", r"no data at 'x\\udcff.nc'"),
    (f"info {OTHER}", r"no file at 'x\\udcff.nc'"),
]


@pytest.mark.parametrize(("line", "message"), WRONG, ids=lambda text: ascii(text)[:50])
def test_wrong_input_is_a_sentence(line, message, folder, capsys):
    words = line.split(" ")
    if words[1:2] == ["fiducial"]:
        words[2:2] = SMALL
    before, said = sorted(p.name for p in folder.rglob("*")), refused(capsys, *words)
    assert re.search(message, said) and "Section" not in said, said
    assert sorted(p.name for p in folder.rglob("*")) == before


def test_results_of_another_run_stay(folder, capsys, small_map):
    """Another frequency into the same folder: refused, unless it is asked for."""
    before = {p: p.read_bytes() for p in small_map.folder.rglob("*") if p.is_file()}
    other = ("--set", "frequency_mhz=15", "-o", small_map.folder)
    said = refused(capsys, "map", "fiducial", *SMALL, *other)
    assert "frequency_mhz was 25.0, now 15.0" in said and "--force" in said
    assert before == {p: p.read_bytes() for p in small_map.folder.rglob("*") if p.is_file()}


WORDS = ["fiducial", "map", "-o", "--set", "--draws", "--data", "--frequencies", "-q", "--model"]
WORDS += ["lmax=2", "file", "pipe", ".", "/", "", "-1", "1e9", "--", "--help", "-o=", "10:20:5"]


@pytest.mark.parametrize("n", [FEW, pytest.param(MANY, marks=pytest.mark.long)])
def test_any_words(n, folder, capsys, monkeypatch):
    """The runs themselves are left out: what comes before them is tried."""

    def stop(*_, **__):
        raise InputError("stopped before the run")

    runs = {name: name for name in ("compare", "map", "paper", "plan", "sample")}
    for name, file in (runs | {"validate": "sample", "simulate": "data"}).items():
        monkeypatch.setattr(f"lusee_bayes.runs.{file}_run.run_{name}", stop)
    before = sorted(p.name for p in folder.rglob("*"))
    commands = ["map", "sample", "simulate", "validate", "plan", "compare", "report", "info"]

    @settings(max_examples=n)
    @given(
        st.sampled_from(commands),
        st.lists(st.one_of(st.sampled_from(WORDS), st.text(max_size=5)), max_size=7),
    )
    def check(command, words):
        code, said = main([command, *words]), capsys.readouterr()
        assert code in (0, 2), (code, said)
        if code == 2:
            # info names every bad file
            told, most = said.err.splitlines(), len(words) if command == "info" else 1
            assert 0 < len(told) <= max(most, 1), said.err
            assert all(line.startswith("lusee-bayes: ") for line in told), said.err

    check()
    assert sorted(p.name for p in folder.rglob("*")) == before


# --- scenarios of any content are taken or refused, and come back as they were --------------------


few_and_many = pytest.mark.parametrize("n", [50, pytest.param(500 * SCALE, marks=pytest.mark.long)])

NUMBERS = st.one_of(
    st.integers(), st.floats(), st.integers(-3, 60), st.floats(0.0, 50.0),
    st.sampled_from([10**400, -(10**400), 2**63, 2**62, 1e308, 5e-324, -0.0]),
)  # fmt: skip
TEXTS = st.sampled_from([
    "", "galaxy", "file", "monopole", "response", "marginalised", "sampled", "exact", "isotropic",
    "2027-13-01", "2027-02-30", "2027-01-15", "0001-01-01", "9999-12-31T23:59:60", "/dev/null",
    "\uff11\uff12", "\u0661\u0662", "1e5", "0x10", "1:30", "null", "~", "a" * 300, "../x", "x\0y",
    "\u00e9", "!!python/x",
])  # fmt: skip
LEAVES = st.one_of(NUMBERS, TEXTS, st.booleans(), st.none(), st.text(max_size=8))
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
    cost.require_fits(cost.posterior_cost(scenario), scenario)


@few_and_many
def test_every_entry_with_any_value(n):
    @settings(max_examples=n)
    @given(st.lists(st.tuples(st.sampled_from(PATHS), VALUES), min_size=1, max_size=3))
    def check(entries):
        # YAML takes JSON, and what JSON does not have (NaN, Infinity) as text
        require_answer(lambda: load([f"{path}={json.dumps(value)}" for path, value in entries]))

    check()


@few_and_many
def test_any_text_as_an_override(n):
    @settings(max_examples=n)
    @given(st.one_of(st.text(), st.builds("{}={}".format, st.sampled_from(PATHS), st.text())))
    @example("prior.mean_file=" + 100 * "\u0331" + " x")  # longer than a line, in escaped letters
    def check(override):
        require_answer(lambda: load([override]))
        require_answer(lambda: plan_run.given_variations("fiducial", [override], []))

    check()


@few_and_many
def test_any_file_as_a_scenario(n, tmp_path):
    path, whole = tmp_path / "scenario.yaml", load_scenario("gain_1e-2").to_yaml().encode()

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
    plain = st.sampled_from(["1e-9", "50", "1"])
    parts = st.one_of(st.floats().map(str), st.text(max_size=4), plain)

    @settings(max_examples=n)
    @given(st.tuples(st.lists(parts, min_size=1, max_size=4), st.sampled_from(",:")))
    def check(drawn):
        require_answer(lambda: parse_frequencies(drawn[1].join(drawn[0])))

    check()
