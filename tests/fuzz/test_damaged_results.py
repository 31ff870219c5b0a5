"""Folders of results, damaged in every way: a report, a comparison, or a sentence."""

import shutil
from pathlib import Path

import pytest
from changes import (
    CHANGE,
    SCALE,
    byte_changes,
    change_bytes,
    change_items,
    item_changes,
    require_answer,
)
from hypothesis import given, settings
from hypothesis import strategies as st

import lusee_bayes as lb
from lusee_bayes.report.pages import write_report
from lusee_bayes.results.finished_runs import read_runs
from lusee_bayes.testing.scenarios import small_scenario

FEW, MANY = 2, 60 * SCALE


@pytest.fixture(scope="session")
def sampled(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("sampled") / "run"
    sampler = lb.Sampler(chains=2, warmup=20, draws=12)
    return lb.run_sample(small_scenario(lmax=2), folder, sampler=sampler).folder


@pytest.mark.parametrize(
    ("kind", "n"),
    [
        *(("map", FEW), ("cube", FEW)),
        *(pytest.param(k, MANY, marks=pytest.mark.long) for k in ("map", "cube", "sample")),
    ],
)
def test_damaged_results(kind, n, tmp_path, request):
    if kind == "sample":
        source = request.getfixturevalue("sampled")
    else:
        source = request.getfixturevalue({"map": "small_map", "cube": "small_cube"}[kind]).folder
    folder = tmp_path / "results"
    shutil.copytree(source, folder)
    write_report(folder)  # as it is, it is read
    names = sorted(p.name for p in source.iterdir() if p.is_file() and p.name != "report.html")
    files = st.sampled_from(names)

    def check(name, change, apply):
        path = folder / name
        shutil.copy(source / name, path)
        if apply is None:
            path.unlink()
        else:
            apply(path, change)
        require_answer(lambda: write_report(folder))
        if kind == "map":
            runs = [source, folder]
            require_answer(lambda: read_runs(runs))
        shutil.copy(source / name, path)

    @settings(max_examples=n)
    @given(files, byte_changes())
    def damaged_bytes(name, change):
        check(name, change, change_bytes)

    @settings(max_examples=n)
    @given(files.filter(lambda name: Path(name).suffix in CHANGE), item_changes())
    def damaged_items(name, change):
        check(name, change, change_items)

    for name in names:
        check(name, None, None)
        if n > FEW:
            check(name, ("cut", 0.0, 1, b""), change_bytes)
            check(name, ("insert", 0.0, 1, b"\0\xff\xfe"), change_bytes)
    damaged_bytes()
    damaged_items()
