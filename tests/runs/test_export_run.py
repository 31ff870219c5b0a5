"""A release of a run: checked by its sums, read without the package, whole or not there."""

import hashlib
import json

import h5py
import numpy as np
import pytest
from assertions import raising
from commands import content, python, refused, run

from lusee_bayes.core.harmonics import pixel_matrix
from lusee_bayes.runs import export_run


@pytest.mark.parametrize("made", ["small_map", "small_cube"])
def test_a_release_stands_alone(made, request, tmp_path, capsys, monkeypatch):
    made, out = request.getfixturevalue(made), tmp_path / "release"
    creator = {"name": "Galilei, Galileo", "nameType": "Personal"}
    command = ["export", made.folder, "--release", out, "--creator", creator["name"]]
    assert run(*command) == 0
    (blank,) = [line for line in capsys.readouterr().out.splitlines() if "TO BE FILLED IN" in line]
    assert blank.startswith("doi: ")
    sums = dict(line.split("  ")[::-1] for line in (out / "SHA256SUMS").read_text().splitlines())
    found = {name: hashlib.sha256(text).hexdigest() for name, text in content(out).items()}
    assert sums == {n: found[n] for n in found.keys() - {"SHA256SUMS", "datacite.json"}}
    kept = {n: text for n, text in content(made.folder).items() if "/" not in n}
    del kept["manifest.json"]
    assert kept.items() <= content(out).items()
    metadata = json.loads((out / "datacite.json").read_text())
    mandatory = "doi creators titles publisher publicationYear types schemaVersion"
    assert {*mandatory.split()} <= metadata.keys() and metadata["creators"] == [creator]
    assert metadata["types"]["resourceTypeGeneral"] == "Dataset"
    assert made.result.verdict() in metadata["descriptions"][0]["description"]
    program = "import runpy, sys; sys.modules['lusee_bayes'] = None; runpy.run_path(sys.argv[1])"
    said = python("-c", program, out / "read_it.py", cwd=tmp_path).stdout
    y = pixel_matrix(made.result.scenario.map_nside, made.result.scenario.lmax)
    for one in made.result.channels:
        assert f"{one.frequency_mhz:g} MHz: mean {(y @ one.mean).mean():.8g} K, std " in said
    assert "exists already" in refused(capsys, *command)
    monkeypatch.setattr(export_run, "render_text", raising(KeyboardInterrupt()))
    assert run("export", made.folder, "--release", tmp_path / "other") == 130
    assert list(tmp_path.iterdir()) == [out]


@pytest.mark.parametrize("made", ["small_map", "small_cube"])
def test_the_mean_is_a_sky_of_pyradiosky(made, request, tmp_path, capsys):
    """SkyH5 as its memo has it: what is required, units, Stokes I alone."""
    made, path = request.getfixturevalue(made), tmp_path / "sky.skyh5"
    assert run("export", made.folder, "--skyh5", path) == 0
    with h5py.File(path) as file:
        header = {name: item[()] for name, item in file["Header"].items() if name != "hpx_frame"}
        assert file["Header/hpx_frame/frame"][()] == b"galactic"
        stokes = file["Data/stokes"]
        assert (stokes.attrs["unit"], file["Header/freq_array"].attrs["unit"]) == ("K", "Hz")
        for k, one in enumerate(made.result.channels):
            y = pixel_matrix(one.nside, made.result.scenario.lmax)
            np.testing.assert_allclose(stokes[0, k], y @ one.mean, rtol=1e-9)
        assert stokes.shape[0] == 4 and not stokes[1:].any()
    assert header["component_type"] == b"healpix" and header["hpx_order"] == b"ring"
    np.testing.assert_allclose(header["freq_array"] / 1e6, made.result.frequencies_mhz)
    assert header["Ncomponents"] == len(header["hpx_inds"]) == 12 * header["nside"] ** 2
    assert "either --release" in refused(capsys, "export", made.folder)
