"""Progress where nobody looks at a terminal: few plain lines."""

from __future__ import annotations

import io

import pytest
from rich.console import Console

from lusee_bayes.core import progress
from lusee_bayes.core.progress import Stages


@pytest.mark.parametrize(("line_s", "expected"), [(0.0, range(5, 100, 5)), (10.0, [])])
def test_a_file_has_a_line_for_each_five_percent_of_long_stages(line_s, expected, monkeypatch):
    monkeypatch.setattr(progress, "LINE_S", line_s)
    file = io.StringIO()
    with Stages(Console(file=file)).progress("channels [x]", 200) as done:
        for number in range(1, 201):
            done(number, "20 MHz")
    *lines, last = file.getvalue().splitlines()
    assert lines == [f"  channels [x]: {2 * p} of 200 ({p}%) 20 MHz" for p in expected]
    assert last.split()[-1] == "s"
