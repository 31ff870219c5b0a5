"""Every file, damaged in every way, is read or refused in a sentence: no traceback, no hang."""

import shutil
from dataclasses import replace
from pathlib import Path

import changes
import h5py
import numpy as np
import pytest
from assertions import require_conventions
from astropy.io import fits
from hypothesis import given, settings
from hypothesis import strategies as st
from layout_4 import write_layout_4

import lusee_bayes as lb
from lusee_bayes.experiment.data_files import reduce_files
from lusee_bayes.flight import gain_model, reduced, session_files
from lusee_bayes.instrument import visibilities, waterfalls
from lusee_bayes.instrument.beams.sampled import read_beam, sampled_beams, write_sampled_beams
from lusee_bayes.report.describe import describe
from lusee_bayes.report.pages import write_report
from lusee_bayes.results.finished_runs import read_channels, read_information, read_runs
from lusee_bayes.runs import folder as folder_module
from lusee_bayes.runs import map_run
from lusee_bayes.sky.sky_source import write_alms
from lusee_bayes.testing import small_scenario

FEW, MANY = 2, 150 * changes.SCALE


def read_sky(path: Path) -> object:
    overrides = ["lmax=2", f"sky={{model: file, file: '{path}'}}"]
    return lb.load_scenario("fiducial", overrides).sky.at(25.0, 2)


def read_spectra(path: Path) -> object:
    session = session_files.read_session(path)
    with session.spectra() as read:
        return read(0, session.n_rows)


LMAX_2 = small_scenario(lmax=2)
# of files, named in words, beside their description
READ = {
    "visibilities.nc windows.nc": [visibilities.read_visibilities],
    "waterfall.fits": [waterfalls.read_waterfall, lambda path: lb.read_data(path, LMAX_2)],
    "four_port.fits": [waterfalls.read_waterfall],
    "scalar_beam.fits response.fits": [lambda path: read_beam(path).beams(10.0, 2)],
    "sampled_fields.nc sampled_fields.fits": [lambda path: read_beam(path).beams(25.0, 2)],
    "sampled_products.nc": [lambda path: read_beam(path).beams(25.0, 2)],
    "posterior.nc cube.nc": [],
    "information.nc": [lambda path: read_information(path, LMAX_2)],
    "diagnostics.nc": [read_channels],
    "map.fits cube.fits alm.fits alms.npz sky.hdf5": [read_sky],
    "session.h5 session_4.h5 session.fits": [read_spectra],
    "reduced.nc": [lambda path: reduced.read_reduced(path).at(25.0, np.ones(4))],
    "gains.nc": [gain_model.read_gain_table],
}
READERS = {name: [describe, *read] for names, read in READ.items() for name in names.split()}

# files of the package
OWN = tuple(name for name in READERS if name.endswith(".nc"))
LUSEEPYS = {
    "scalar_beam.fits": "synthetic_monopole_beam.fits",
    "response.fits": "synthetic_response_v3.fits",
    "four_port.fits": "four_port_covariance.fits",
}


@pytest.fixture(scope="session")
def files(tmp_path_factory, small_map, small_cube) -> Path:
    """A file of every kind."""
    folder, experiment = tmp_path_factory.mktemp("files"), lb.build(small_scenario(lmax=2))
    experiment.data.write(folder / "visibilities.nc")
    experiment.data.stamped("start").write(folder / "windows.nc")
    channels = [replace(experiment.data, frequency_mhz=f) for f in (20.0, 25.0)]
    waterfalls.write_waterfall(folder / "waterfall.fits", channels, np.array([1 + 1j, 1 + 2j]), "")
    theta, phi = np.linspace(0.0, 90.0, 7), np.arange(0.0, 360.0, 45.0)
    fields = np.ones((4, 7, 8), dtype=complex)
    sampled = sampled_beams(25.0, e_theta=fields, e_phi=fields, theta_deg=theta, phi_deg=phi)
    write_sampled_beams(folder / "sampled_fields.nc", sampled)
    write_sampled_beams(folder / "sampled_fields.fits", sampled)
    products = sampled_beams([20.0, 30.0], products=np.ones((2, 4, 48)))
    write_sampled_beams(folder / "sampled_products.nc", products)
    with pytest.MonkeyPatch.context() as patch:
        # neither figures nor a page, which take longer than the map
        patch.setattr(map_run, "MAP", replace(map_run.MAP, figures={}))
        patch.setattr(folder_module, "PAGES", {})
        run = lb.run_map(small_scenario("output.information=true", lmax=2), folder / "run")
    shutil.copy(run.folder / "posterior.nc", folder / "information.nc")
    for name in ("posterior.nc", "diagnostics.nc"):
        shutil.copy(small_map.folder / name, folder / name)
    shutil.copy(small_map.folder / "map.fits", folder / "map.fits")
    shutil.copy(small_cube.folder / "posterior.nc", folder / "cube.nc")
    shutil.copy(small_cube.folder / "mean.fits", folder / "cube.fits")
    write_alms(folder / "alm.fits", np.arange(1.0, 10.0), {"FREQ": 25.0})
    np.savez(folder / "alms.npz", freq=np.array([20.0, 25.0]), alm=np.ones((2, 6), dtype=complex))
    write_sessions(folder)
    with h5py.File(folder / "sky.hdf5", "w") as file:
        file["smooth_absorb"] = np.linspace(1.0, 2.0, 192)
    return folder


def write_sessions(folder: Path) -> None:
    """Three spectra in every layout, and what is made of them."""
    flight = "flight={per_kelvin_v2_hz: 1e-21, simulated: {kind: %s}}"
    size = ["observation.step_s=900", "observation.runs=[{cycles: 0.0012}]"]
    for name, kind in (("session.h5", "hdf5"), ("session.fits", "fits")):
        scenario = lb.load_scenario("fiducial", ["lmax=2", *size, flight % kind])
        made = lb.run_simulate_flight(scenario, folder / name.replace(".", "_"))
        shutil.copy(made.sessions[0], folder / name)
    write_layout_4(folder / "session_4.h5")
    known = lb.load_scenario(str(made.scenario), ["observation.average_s=null"])
    reduced.write_reduced(folder / "reduced.nc", reduce_files(list(made.sessions), known))
    shutil.copy(made.scenario.parent / "gains.nc", folder / "gains.nc")


@pytest.fixture(scope="session")
def luseepys(tmp_path_factory, test_data) -> Path:
    """luseepy's own files, fewer channels of them."""
    folder = tmp_path_factory.mktemp("luseepys")
    for name, source in LUSEEPYS.items():
        with fits.open(test_data / "luseepy" / source) as opened:
            hdus = fits.HDUList([hdu.copy() for hdu in opened])
            if name == "scalar_beam.fits":
                for hdu in (one for one in hdus if one.shape[:1] == (50,)):
                    hdu.data = hdu.data[8:12]
                hdus[0].header.update({"FREQ_MIN": 9.0, "FREQ_MAX": 12.0, "FREQ_N": 4})
            hdus.writeto(folder / name)
    return folder


@pytest.mark.parametrize("name", OWN)
def test_own_files_follow_the_conventions(name, files):
    require_conventions(files / name)


@pytest.mark.parametrize("n", [FEW, pytest.param(MANY, marks=pytest.mark.long)])
@pytest.mark.parametrize("name", READERS)
def test_damaged_files(name, n, tmp_path, request):
    folder = request.getfixturevalue("luseepys" if name in LUSEEPYS else "files")
    source, target = folder / name, tmp_path / name

    for reader in READERS[name]:
        reader(source)  # as it is, it is read

    def read(change, apply):
        shutil.copy(source, target)
        for one in change:
            apply(target, one)
        before = sorted(tmp_path.iterdir())
        for reader in READERS[name]:
            changes.require_answer(lambda reader=reader: reader(target))
        assert sorted(tmp_path.iterdir()) == before

    @settings(max_examples=n)
    @given(st.lists(changes.byte_changes(), min_size=1, max_size=3))
    def damaged_bytes(change):
        read(change, changes.change_bytes)

    @settings(max_examples=n)
    @given(st.lists(changes.item_changes(), min_size=1, max_size=2))
    def damaged_items(change):
        read(change, changes.change_items)

    damaged_bytes()
    if source.suffix != ".npz":
        damaged_items()


# --- folders of results: a report, a comparison, or a sentence ------------------------------------


OF_RESULTS = 60 * changes.SCALE


@pytest.fixture(scope="session")
def sampled(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("sampled") / "run"
    sampler = lb.Sampler(chains=2, warmup=20, draws=12)
    return lb.run_sample(small_scenario(lmax=2), folder, sampler=sampler).folder


RESULTS = [
    *(("map", FEW), ("cube", FEW)),
    *(pytest.param(k, OF_RESULTS, marks=pytest.mark.long) for k in ("map", "cube", "sample")),
]


@pytest.mark.parametrize(("kind", "n"), RESULTS)
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
        changes.require_answer(lambda: write_report(folder))
        if kind == "map":
            changes.require_answer(lambda: read_runs([source, folder]))
        shutil.copy(source / name, path)

    @settings(max_examples=n)
    @given(files, changes.byte_changes())
    def damaged_bytes(name, change):
        check(name, change, changes.change_bytes)

    @settings(max_examples=n)
    @given(files.filter(lambda name: Path(name).suffix in changes.CHANGE), changes.item_changes())
    def damaged_items(name, change):
        check(name, change, changes.change_items)

    for name in names:
        check(name, None, None)
        if n > FEW:
            check(name, ("cut", 0.0, 1, b""), changes.change_bytes)
            check(name, ("insert", 0.0, 1, b"\0\xff\xfe"), changes.change_bytes)
    damaged_bytes()
    damaged_items()
