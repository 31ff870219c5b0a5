"""Reports: complete, self-contained, in agreement with the files, and in a real browser."""

import base64
import json
import re
import shutil
import subprocess
from html.parser import HTMLParser
from pathlib import Path

import healpy
import numpy as np
import pytest
from commands import posterior_of, refused, run
from experiments import scaled_product
from reference_linear import matrices

import lusee_bayes as lb
from lusee_bayes.core.harmonics import pixel_matrix
from lusee_bayes.judge import left_out
from lusee_bayes.results.finished_runs import read_channels

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")


@pytest.fixture(scope="module")
def sampled(tmp_path_factory):
    scenario = lb.load_scenario("fiducial", ["lmax=2", "observation.runs.0.cycles=0.05"])
    sampler = lb.Sampler(draws=50, warmup=50, seed=scenario.seed)
    return lb.run_sample(scenario, tmp_path_factory.mktemp("run") / "s", sampler=sampler)


def viewer_data(page: str) -> dict:
    (text,) = re.findall(r'<script type="application/json" id="viewer-data">(.*?)</script>', page)
    return json.loads(text)


class Outline(HTMLParser):
    """Tags that are open, links and pictures of a page."""

    def __init__(self):
        super().__init__()
        self.open, self.pictures, self.anchors, self.links = [], [], set(), []

    def handle_starttag(self, tag, attrs):
        attrs = dict(attrs)
        if tag == "img":
            self.pictures.append(attrs)
        if "id" in attrs:
            self.anchors.add(attrs["id"])
        if tag == "a":
            self.links.append(attrs["href"])
        if tag not in ("img", "meta", "link", "input", "br"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


# a map run with all its figures takes half a minute
MAP = pytest.param("small_map", marks=pytest.mark.essential)
SAMPLED = pytest.param("sampled", marks=pytest.mark.long)
CUBE = pytest.param("small_cube", marks=pytest.mark.long)


@pytest.mark.parametrize("which", [MAP, CUBE, SAMPLED])
def test_pages_are_whole_and_need_nothing_else(which, request):
    folder = request.getfixturevalue(which).folder
    page, outline = (folder / "report.html").read_text(), Outline()
    outline.feed(page)
    assert outline.open == []
    assert len(outline.pictures) >= (4 if which == "small_cube" else 6)
    for picture in outline.pictures:
        assert picture["src"].startswith("data:image/png;base64,")
        assert len(picture["alt"]) > 20
    for link in outline.links:  # to a section, or to a file beside the page
        assert (link[0] == "#" and link[1:] in outline.anchors) or (folder / link).is_file()
    assert "://" not in page  # which base64 never holds
    assert len(page) < 8e6


@pytest.mark.essential
def test_a_pixels_posterior_is_that_of_the_file(small_map):
    data = viewer_data((small_map.folder / "report.html").read_text())
    file = posterior_of(small_map.folder)
    mean, covariance = file["mean"].values[0], file["covariance"].values[0]
    channel = small_map.result.channel
    nside = channel.nside
    y = pixel_matrix(nside, 8)
    # regions are means of their pixels
    of = healpy.ud_grade(np.arange(768.0), nside)
    rows = np.stack([y[of == region].mean(0) for region in (0, 300, 767)])
    std = np.sqrt(np.einsum("pi,ij,pj->p", rows, covariance, rows))
    for name, values in (("mean", rows @ mean), ("std", std)):
        got = np.frombuffer(base64.b64decode(data["regions"][name]), dtype="<f4")
        np.testing.assert_allclose(got[[0, 300, 767]], values, rtol=1e-6)
    # what is left of the prior, the monopole apart
    prior = file["prior_std"].values[0, 1:] ** 2
    inner = np.einsum("pi,ij,pj->p", y[:, 1:], covariance[1:, 1:], y[:, 1:])
    share = inner / (y[:, 1:] ** 2 @ prior)
    np.testing.assert_allclose(channel.details.prior_fraction, share, rtol=1e-5)


def test_a_page_of_many_channels_has_a_part_for_each(small_cube):
    """One is shown at a time; selectors stand above them, and the maps have a slider."""
    page = (small_cube.folder / "report.html").read_text()
    summary = json.loads((small_cube.folder / "summary.json").read_text())
    n = len(summary["channels"])
    assert n == 3 and viewer_data(page)["frequencies"] == [20.0, 25.0, 30.0]
    (slider,) = re.findall(r'<input id="viewer-channel" type="range" [^>]*>', page)
    assert 'max="2"' in slider
    selectors = re.findall(r'<select class="channel">\s*(.*?)\s*</select>', page, re.DOTALL)
    options = "".join(f'<option value="{k}">{20 + 5 * k} MHz</option>' for k in range(n))
    assert selectors and all("".join(one.split("\n")) == options for one in selectors)
    parts = re.findall(r'<div data-channel="(\d)"( hidden)?>', page)
    assert parts == [("0", ""), ("1", " hidden"), ("2", " hidden")] * len(selectors)
    # what each says is that channel's
    for channel in summary["channels"]:
        assert f"expected {channel['chi2_expected']:.1f}" in page
        assert f"<td>{channel['frequency_mhz']:g}</td><td>{channel['n_data']}</td>" in page


@pytest.mark.parametrize("which", [MAP, CUBE, SAMPLED])
def test_report_makes_a_page_anew(which, request, tmp_path, capsys, monkeypatch):
    # the title is the folder's name
    folder = request.getfixturevalue(which).folder
    mine = shutil.copytree(folder, tmp_path / folder.name)
    (mine / "report.html").unlink()
    seen = []
    monkeypatch.setattr("webbrowser.open", seen.append)
    assert run("report", mine, "--open") == 0
    assert seen == [(mine / "report.html").as_uri()]
    assert capsys.readouterr().out.split() == ["look", "at", f"{mine}/report.html"]
    assert (mine / "report.html").read_text() == (folder / "report.html").read_text()
    assert not list(mine.glob(".*"))


def test_what_has_no_report_is_told(tmp_path, capsys):
    assert "no results of" in refused(capsys, "report", tmp_path)
    (tmp_path / "manifest.json").write_text('{"kind": "map", "files": [], "discard": []}')
    assert "has no summary.json" in refused(capsys, "report", tmp_path)
    assert not (tmp_path / "report.html").exists()


@pytest.mark.long
def test_what_the_data_do_not_tell_is_said(tmp_path):
    """A product of a gain run is a little too large; a clear case is in test_channel_map.py."""
    scenario = lb.load_scenario("gain_1e-3", ["lmax=8", "observation.runs.0.cycles=0.2"])
    data = scaled_product(lb.build(scenario).data, 8, 1.02)
    made = lb.run_map(scenario, tmp_path / "out", data=data)
    page = (made.folder / "report.html").read_text()
    told = "any one of .* cannot show which"
    assert re.search(rf'class="verdict bad">The data do not fit.*{told}', page, re.DOTALL)
    assert re.search(r"<tr class=bad><td>12R</td>", page)
    (channel,) = read_channels(made.folder / "diagnostics.nc")
    suspects = channel.judged.suspects
    assert "product 12R" in suspects
    assert sum(name.startswith("product") for name in suspects) > 1


@pytest.mark.long
def test_a_page_without_groups(tmp_path, monkeypatch):
    """Noise that couples times, and an A that would be too large to judge its data one by one."""
    monkeypatch.setattr(left_out, "DENSE_BYTES", 0.0)
    gains = "noise.gain={sigma: 0.01, visibilities: model}"
    overrides = ["lmax=4", "observation.runs.0.cycles=0.1", gains]
    made = lb.run_map(lb.load_scenario("fiducial", overrides), tmp_path / "map")
    (channel,) = read_channels(made.folder / "diagnostics.nc")
    assert not channel.judged.groups
    assert np.isnan(channel.judged.z).all()
    assert channel.judged.verdict == made.result.verdict()
    # the rest is judged as ever: chi^2 of all data under the model, by matrices
    experiment = lb.build(made.result.scenario)
    (a, s, n), data = matrices(lb.infer(experiment).model), np.asarray(experiment.data.data)
    expected = data @ np.linalg.solve(a @ s @ a.T + n, data)
    assert channel.instrument.chi2 + channel.judged.prior.chi2 == pytest.approx(expected, rel=1e-4)
    page = (made.folder / "report.html").read_text()
    assert "By product" not in page and made.result.fit.headline in page


# --- in a browser -------------------------------------------------------------------------------

LISTEN, CHECK = (Path(__file__).parent / "in_browser.js").read_text().split("// ---")


def in_browser(page: str, tmp_path, width: int, points) -> dict:
    """What a page says of itself in headless Chromium, at a width in pixels."""
    check = CHECK.replace("POINTS", json.dumps([list(map(float, p)) for p in points]))
    text = page.replace("<style>", f"<script>{LISTEN}</script><style>", 1)
    text = text.replace("</body>", f"<script>{check}</script></body>")
    (tmp_path / "inner.html").write_text(text)
    # a frame is as narrow as it is told, a window is not
    outer = (
        f'<iframe id="f" src="inner.html" style="width:{width}px;height:2000px;border:0"></iframe>'
        '<pre id="out"></pre><script>onload = () => { document.getElementById("out").textContent = '
        'document.getElementById("f").contentDocument.getElementById("found").textContent; };'
        "</script>"
    )
    (tmp_path / "outer.html").write_text(outer)
    flags = "--headless --no-sandbox --disable-gpu --disable-quic --no-first-run "
    flags += "--disable-background-networking --disable-component-update --disable-sync "
    flags += "--allow-file-access-from-files --virtual-time-budget=20000 --dump-dom "
    command = [CHROMIUM, *flags.split(), f"--user-data-dir={tmp_path / 'profile'}"]
    command.append(f"file://{tmp_path / 'outer.html'}")
    dom = subprocess.run(command, capture_output=True, text=True, timeout=120).stdout
    (told,) = re.findall(r'<pre id="out">(.*?)</pre>', dom, re.DOTALL)
    return json.loads(told)


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine")
@pytest.mark.parametrize("width", [1280, 390])
@pytest.mark.parametrize("which", [MAP, CUBE, SAMPLED])
def test_in_a_browser(which, width, request, tmp_path):
    folder = request.getfixturevalue(which).folder
    points = np.random.default_rng(3).uniform([0, -90], [360, 90], (300, 2))
    found = in_browser((folder / "report.html").read_text(), tmp_path, width, points)
    assert found["errors"] == []
    assert found["width"] == width
    assert found["needed"] <= width
    assert found["cut"] == 0
    if which == "small_map":
        alm = healpy.read_alm(folder / "mean_alm.fits")
        expected = healpy.alm2map(alm, 512)[healpy.ang2pix(512, *points.T, lonlat=True)]
        # a pixel's centre may be 0.1 degrees away: 8 of 0.0015 radians
        shown = [p["mean"] for p in found["pixels"]]
        np.testing.assert_allclose(shown, expected, rtol=0, atol=0.012 * expected.max())
