"""The report of a run of several frequencies, out of what it has left in its folder."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from lusee_bayes.core.files import require_files
from lusee_bayes.core.formats import opened
from lusee_bayes.core.layouts import Layout, Variable
from lusee_bayes.core.reading import entries, read_json
from lusee_bayes.judge.chi2 import stands_out
from lusee_bayes.judge.cube_fit import N_TESTS
from lusee_bayes.report.rendering import render_run, rows_if_there, sentences
from lusee_bayes.report.sections import flight_section
from lusee_bayes.report.viewer import Maps, viewer
from lusee_bayes.results.saved import (
    CHANNEL_SUMMARY,
    CHANNEL_UNKNOWNS,
    COVERAGE,
    CUBE_SUMMARY,
    JOINT_SUMMARY,
    JOINT_TEST,
    PULLS,
)

NEEDED = ("summary.json", "spectra.csv", "scenario.yaml", "mean.fits", "std.fits")
CUBE_MAPS = Layout("maps of every channel", {"maps": Variable(("channel", "pixel"))})


def cube_page(folder: Path, name: str) -> str:
    """The page as text, of the folder and the name of a run. InputError as :func:`.map_page`."""
    require_files(folder, NEEDED, "map")
    path = folder / "summary.json"
    summary = read_json(path, CUBE_SUMMARY)
    channels = entries(path, summary, "channels", CHANNEL_SUMMARY)
    frequencies = [channel["frequency_mhz"] for channel in channels]
    maps = {
        key: _read_cube(folder / f"{key}.fits")
        for key in ("mean", "std", "truth")
        if (folder / f"{key}.fits").is_file()
    }
    for channel in channels:
        channel["bad"] = stands_out(channel["instrument_p"], N_TESTS * len(channels))
    tests = entries(path, summary, "tests", JOINT_TEST)
    for test in tests:
        test["bad"] = test["level"] != "consistent"
    return render_run(
        "cube.html",
        path,
        summary,
        name=name,
        channels=channels,
        unmapped=sentences(path, summary, "unmapped"),
        viewer=viewer(frequencies, maps),
        joint=_joint(path, summary),
        coverage=_coverage(path, channels),
        pulls=entries(path, summary, "pulls", PULLS) if summary.get("pulls") else [],
        tests=tests,
        unknowns=rows_if_there(folder / "unknowns.csv", CHANNEL_UNKNOWNS),
        untold=sentences(path, summary, "unknowns"),
        flight=flight_section(folder),
    )


def _read_cube(path: Path) -> Maps:
    with opened(path, CUBE_MAPS.what) as hdus:
        there = {} if hdus[0].data is None else {"maps": hdus[0].data}
        return CUBE_MAPS.checked(path, there, {}).arrays["maps"]


def _joint(path: Path, summary: dict[str, Any]) -> dict[str, Any] | None:
    """How a posterior of all channels was found; None where each has its own."""
    if summary.get("joint") is None:
        return None
    (joint,) = entries(path, {"joint": [summary["joint"]]}, "joint", JOINT_SUMMARY)
    return joint | {"components": sentences(path, joint, "components")}


def _coverage(path: Path, channels: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Bands of latitude of every channel; none where the sky is not known."""
    if "coverage" not in channels[0]:
        return []
    return [
        {
            "frequency_mhz": channel["frequency_mhz"],
            "bands": entries(path, channel, "coverage", COVERAGE),
        }
        for channel in channels
    ]
