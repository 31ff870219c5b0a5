"""Whatever is typed: an answer, or one sentence and exit code 2, with nothing left behind."""

from __future__ import annotations

import os
import re
from collections import Counter

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from outcomes import SCALE, TRIED

from lusee_bayes.cli.main import main
from lusee_bayes.core.errors import InputError

FEW, MANY = 120, 3_000 * SCALE
SMALL = ("--set", "lmax=2", "--set", "observation.runs.0.cycles=0.02", "-q")


@pytest.fixture
def here(tmp_path, monkeypatch):
    """An empty folder to work in."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("a file")
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "program.py").write_text("def model(data=None):\n    pass\n")
    return tmp_path


def refused(here, capsys, *arguments: str) -> str:
    """The sentence; nothing else has changed."""
    before = sorted(p.name for p in here.rglob("*"))
    assert main([str(a) for a in arguments]) == 2
    said = capsys.readouterr()
    lines = said.err.strip().splitlines()
    assert len(lines) == 1 and lines[0].startswith("lusee-bayes: "), lines
    assert sorted(p.name for p in here.rglob("*")) == before
    return lines[0]


LONG = "n" * 300
EXAMPLES = {
    # where results go
    "root": (["map", "fiducial", *SMALL, "-o", "/"], "root of all files"),
    "proc": (["map", "fiducial", *SMALL, "-o", "/proc/nope"], "nothing can be written|No such"),
    "under a file": (["map", "fiducial", *SMALL, "-o", "file/x"], "file' is a file; give a folder"),
    "file": (["map", "fiducial", *SMALL, "-o", "file"], "'file' is a file"),
    "pipe": (["map", "fiducial", *SMALL, "-o", "pipe"], "neither a file nor a folder"),
    "too long": (["map", "fiducial", *SMALL, "-o", LONG], "too long"),
    "nul": (["map", "fiducial", *SMALL, "-o", "a\0b"], "NUL"),
    "device": (["simulate", "fiducial", *SMALL, "-o", "/dev/full"], "neither a file nor a folder"),
    "folder": (["simulate", "fiducial", *SMALL, "-o", "."], "is a folder"),
    "simulate under a file": (["simulate", "fiducial", *SMALL, "-o", "file/x.nc"], "is a file"),
    # options
    "negative draws": (["map", "fiducial", *SMALL, "--draws", "-3"], "--draws: expected .*got -3"),
    "half a draw": (["map", "fiducial", *SMALL, "--draws", "1.5"], "--draws: expected .*got 1.5"),
    "no chains": (["sample", "fiducial", *SMALL, "--chains", "0"], "--chains: expected .*got 0"),
    "many frequencies": (["map", "fiducial", "--frequencies=1:50:1e-9"], "channels; at most 4096"),
    "few simulations": (["validate", "fiducial", *SMALL, "--simulations", "50"], "simulations"),
    "misspelt": (["map", "fiducial", "--draw", "3"], "--draw"),
    # scenarios
    "boolean lmax": (["map", "fiducial", "--set", "lmax=true"], "lmax is True"),
    "large seed": (["map", "fiducial", "--set", f"seed={2**64}"], "seed is 18446744073709551616"),
    "digits": (["map", "fiducial", "--set", "lmax=" + "9" * 5000], "lmax is"),
    "other digits": (["map", "fiducial", "--set", "lmax=\uff11\uff12"], "lmax is"),
    "month 13": (["map", "fiducial", "--set", "observation.start=2027-13-01"], "2027-13-01"),
    "30 February": (["map", "fiducial", "--set", "observation.start=2027-02-30"], "2027-02-30"),
    "nside": (["map", "fiducial", "--set", "nside=3"], "nside is 3, .*power of two"),
    "million cycles": (
        ["map", "fiducial", "--set", "observation.runs.0.cycles=1000000"],
        "about .* of memory .*would fit",
    ),
    "large lmax": (["map", "fiducial", "--set", "lmax=383"], "of memory.*lmax=.*would fit"),
    "long name": (["map", LONG], "no scenario"),
    "scenario nul": (["map", "a\0b"], "no scenario"),
    "scenario pipe": (["map", "pipe"], "neither a file nor a folder"),
    "scenario folder": (["map", "."], "is a folder"),
    # data, programs, results
    "data pipe": (["map", "fiducial", *SMALL, "--data", "pipe"], "neither a file nor a folder"),
    "data folder": (["map", "fiducial", *SMALL, "--data", "."], "is a folder"),
    "foreign data": (["map", "fiducial", *SMALL, "--data", "file"], "file"),
    "program": (["sample", "fiducial", *SMALL, "--model", "file"], "no program 'file'"),
    "empty program": (["sample", "fiducial", *SMALL, "--model", "program.py"], "no observed site"),
    "info pipe": (["info", "pipe"], "neither a file nor a folder"),
    "info foreign": (["info", "file"], "file"),
    "report file": (["report", "file"], "is no folder"),
    "report empty": (["report", "."], "holds neither"),
    "compare nothing": (["compare"], "two"),
}  # fmt: skip


@pytest.mark.parametrize("name", EXAMPLES)
def test_wrong_input_is_a_sentence(name, here, capsys):
    arguments, message = EXAMPLES[name]
    said = refused(here, capsys, *arguments)
    assert re.search(message, said), said


def test_results_of_another_run_stay(here, capsys, small_map):
    """Another frequency into the same folder: refused, unless it is asked for."""
    before = {p: p.read_bytes() for p in small_map.folder.rglob("*") if p.is_file()}
    said = refused(
        here, capsys, "map", "fiducial", *SMALL, "--set", "frequency_mhz=15", "-o", small_map.folder
    )
    assert "frequency_mhz is 25.0 there and 15.0 here" in said and "--force" in said
    assert before == {p: p.read_bytes() for p in small_map.folder.rglob("*") if p.is_file()}


WORDS = ["fiducial", "map", "-o", "--set", "--draws", "--data", "--frequencies", "-q", "--model"]
WORDS += ["lmax=2", "file", "pipe", ".", "/", "", "-1", "1e9", "--", "--help", "-o=", "10:20:5"]


@pytest.mark.parametrize("n", [FEW, pytest.param(MANY, marks=pytest.mark.long)])
def test_any_words(n, here, capsys, monkeypatch):
    """The runs themselves are left out: what comes before them is tried."""
    from lusee_bayes.runs import (  # fmt: skip
        compare_run,
        data_run,
        map_run,
        paper_run,
        plan_run,
        sample_run,
        validate_run,
    )

    def stop(*_, **__):
        raise InputError("stopped before the run")

    for module, name in (
        (compare_run, "run_compare"), (map_run, "run_map"), (paper_run, "run_paper"),
        (plan_run, "run_plan"), (sample_run, "run_sample"), (data_run, "run_simulate"),
        (validate_run, "run_validate"),
    ):  # fmt: skip
        monkeypatch.setattr(module, name, stop)
    before = sorted(p.name for p in here.rglob("*"))
    codes: Counter[int] = Counter()
    commands = ["map", "sample", "simulate", "validate", "plan", "compare", "report", "info"]

    @settings(max_examples=n)
    @given(
        st.sampled_from(commands),
        st.lists(st.one_of(st.sampled_from(WORDS), st.text(max_size=5)), max_size=7),
    )
    def check(command, words):
        if "--processes" in words or "--devices" in words:
            return
        code = main([command, *words])
        said = capsys.readouterr()
        assert code in (0, 2), (code, said)
        if code == 2:
            # info names every bad file
            told, most = said.err.splitlines(), len(words) if command == "info" else 1
            assert 0 < len(told) <= max(most, 1), said.err
            assert all(line.startswith("lusee-bayes: ") for line in told), said.err
        codes[code] += 1

    check()
    assert sorted(p.name for p in here.rglob("*")) == before
    for code, number in codes.items():
        TRIED[f"command lines: {'refused' if code else 'accepted'}"] += number
