"""Waterfalls of luseepy's simulator: its own file, and synthetic ones with gaps and odd orders."""

from dataclasses import replace

import astropy.units as u
import jax.numpy as jnp
import numpy as np
import pytest
from assertions import refuse
from astropy.io import fits
from astropy.time import Time, TimeDelta
from commands import judged_map, refused, run
from fits_files import HEADER, write_images
from fits_files import write_products as write
from tables import tables

import lusee_bayes as lb
from lusee_bayes.cli.options import parse_frequencies
from lusee_bayes.core.reading import parse_yaml
from lusee_bayes.experiment.model import set_up
from lusee_bayes.instrument.products import DataLayout, labels
from lusee_bayes.instrument.waterfalls import read_waterfall, write_waterfall

TABLES = tables(__file__)


def test_every_sample_is_in_its_place(tmp_path):
    data = read_waterfall(write(tmp_path / "w.fits")).at(20.0)
    assert data.frequency_mhz == 20.0 and data.n_missing == 0
    expected = 100.0 * np.arange(16)[:, None] + np.arange(12)[None] + 0.1
    np.testing.assert_array_equal(data.grid(), expected)
    observation = data.observation
    assert observation.times[0].isot == "2027-02-01T00:00:00.000"
    np.testing.assert_allclose(observation.hours, 2.0 * np.arange(12), rtol=0, atol=1e-7)
    assert (observation.lat_deg, observation.lon_deg) == (-23.814, 182.258)
    assert observation.step_s == 7200.0 and observation.turntable_deg == (0.0,)


@pytest.mark.parametrize(("lunar_day", "first"), TABLES["ranges"])
def test_ranges_of_time(tmp_path, lunar_day, first):
    path = write(tmp_path / "w.fits", header=HEADER | {"LUNAR_DAY": lunar_day})
    observation = read_waterfall(path).observation
    assert observation.times[0].isot == first
    np.testing.assert_allclose(observation.hours, 2.0 * np.arange(12), rtol=0, atol=1e-6)


def test_lunar_days_begin_at_noon_on_the_far_side(tmp_path):
    """Days of 29.27 to 29.83 days, about new moon: a noon of the mean Sun is within 14 hours of it
    (6.3 degrees of libration at 12.2 degrees a day, and the Sun's own equation)."""
    # new moons of 2025, from almanacs; UTC
    new_moons = ["01-29T12:36", "02-28T00:45", "03-29T10:58", "04-27T19:31", "05-27T03:02"]
    found = []
    for number, new_moon in zip((2500, "2501", 2502, 2503, 2504), new_moons, strict=True):
        path = tmp_path / f"{number}.fits"
        found.append(read_waterfall(write(path, header=HEADER | {"LUNAR_DAY": number})).observation)
        off = (found[-1].times[0] - Time(f"2025-{new_moon}", scale="utc")).to_value(u.hour)
        assert abs(off) < 14.0
    days = np.diff([o.times[0].jd for o in found])
    assert ((days > 29.2) & (days < 29.9)).all()
    # the Sun is highest there and then, by the package's other way to its altitude
    noon = found[2].times[0]
    around = noon + np.arange(-120.0, 121.0, 4.0) * u.s
    middle = lb.Observation(180.0, 0.0, around, np.zeros(61, int), (0.0,), 4.0)
    # light needs 8 minutes, in which the Earth and the Moon move on by 20 arcseconds: 40 s
    assert abs(around[np.argmax(middle.sun_altitude_deg())] - noon) < 50.0 * u.s


def test_any_subset_and_order_of_products(tmp_path):
    """Columns follow the pairs; a pair the other way round is conjugated."""
    data = read_waterfall(write(tmp_path / "w.fits", pairs=[[2, 2], [3, 1], [0, 0]])).at(10.0)
    place = {label: k for k, label in enumerate(labels())}
    grid, time = data.grid(), np.arange(12)
    assert data.n_missing == 12 * 12
    np.testing.assert_array_equal(grid[place["22R"]], time)
    np.testing.assert_array_equal(grid[place["13R"]], 100.0 + time)
    np.testing.assert_array_equal(grid[place["13I"]], -200.0 - time)
    np.testing.assert_array_equal(grid[place["00R"]], 300.0 + time)
    assert np.isnan(grid[place["11R"]]).all()


UNUSABLE = [
    ({"header": {k: v for k, v in HEADER.items() if k != "DELTAT_SEC"}}, "no DELTAT_SEC"),
    ({"header": HEADER | {"LUNAR_DAY": "tomorrow"}}, "LUNAR_DAY 'tomorrow' is invalid"),
    ({"header": HEADER | {"LUNAR_DAY": "CY202"}}, "LUNAR_DAY 'CY202' is invalid; expected a range"),
    ({"header": HEADER | {"LUNAR_DAY": 2714}}, "expected a number from 2700, the first"),
    ({"header": HEADER | {"LUNAR_DAY": 9900}}, "outside the ephemeris"),
    ({"pairs": [[0, 0], [0, 4]]}, "combinations contains a value outside 0 to 3: 4"),
    ({"pairs": [[0, 1], [1, 0]]}, "the product 01R is listed twice"),
    ({"data": np.zeros((12, 15, 2))}, r"data has 15 products, expected 16"),
    ({"data": np.full((12, 16, 2), np.inf)}, "infinity"),
    ({"frequencies": (10e6, 20e6)}, "is this Hz"),
    ({"header": HEADER | {"BUNIT": "V^2/Hz"}}, "unit 'V.2/Hz'"),
    ({"header": HEADER | {"DELTAT_SEC": -7200.0}}, "DELTAT_SEC is -7200.0, expected"),
]


@pytest.mark.parametrize(("options", "message"), UNUSABLE)
def test_files_that_cannot_be_used(tmp_path, options, message):
    refuse(message, read_waterfall, write(tmp_path / "w.fits", **options))


def test_missing_channels_files_and_ends(tmp_path):
    path, ten = write(tmp_path / "w.fits"), lb.load_scenario("fiducial", ["frequency_mhz=10"])
    refuse("no channel at 25 MHz", lb.read_data, path, lb.load_scenario("fiducial"))
    empty = write(tmp_path / "empty.fits", np.full((12, 16, 2), np.nan))
    refuse("all 192 samples are flagged", lb.read_data, empty, ten)
    refuse("no data at", lb.read_data, tmp_path / "none.fits", ten)
    path.write_bytes(path.read_bytes()[:4000])
    refuse("truncated", lb.read_data, path, ten)


@pytest.mark.long
def test_the_map_from_luseepys_waterfall(tmp_path, test_data):
    """10 MHz, luseepy's beam, sky and noiseless data, the noise of a fiducial observation in N."""
    folder = test_data / "luseepy"
    beam = [f"beam.file={folder / 'synthetic_monopole_beam.fits'}", "beam.quadrature=luseepy"]
    given = ["frequency_mhz=10", *beam, f"sky.file={folder / 'sky_alm.npz'}"]
    rho, summary = judged_map(folder / "waterfall_exact_engine.fits", given, tmp_path / "map")
    assert rho[1:9].min() > 0.9 and rho[1:27].min() > 0.5
    assert summary["ell_cross"] is None or summary["ell_cross"] >= 18
    # nothing but the model's own noise is missing from the data: chi^2 falls short of its mean
    assert summary["chi2"] < summary["chi2_expected"]


# --- writing ------------------------------------------------------------------------------------


def as_luseepy_reads(path):
    """Data, times and products the way luseepy's own class walks through a file: by counting."""
    with fits.open(path) as hdus:
        header = hdus[0].header
        images = {hdu.name.upper(): np.array(hdu.data) for hdu in hdus}
    column, places = 0, {}
    for i, j in images["COMBINATIONS"]:
        places[int(i), int(j)] = column
        column += 1 if i == j else 2
    assert i == j, "luseepy fails on a file whose last product is a cross"
    assert column == images["DATA"].shape[1]
    assert float(header["VERSION"]) < 3.0
    start, end = (Time(t) for t in header["LUNAR_DAY"].split(" to "))
    step = TimeDelta(header["DELTAT_SEC"] * u.s)
    times = np.arange(start, end + step, step).astype(Time)
    assert len(times) == len(images["DATA"]) and len(images["FREQ"]) == images["DATA"].shape[2]
    for port in range(4):
        assert images[f"ZRE_{port}"].shape == images[f"ZIM_{port}"].shape == images["FREQ"].shape
    return images["DATA"], Time(list(times)), places


def random_channel(runs, frequency_mhz=25.0):
    """Visibilities of one frequency that are random numbers."""
    observation = lb.Observation.from_runs(runs)
    layout = DataLayout(16, observation.n_times)
    values = np.random.default_rng(int(frequency_mhz)).normal(3e3, 1e3, layout.size)
    return lb.Visibilities(jnp.asarray(values), layout, observation, frequency_mhz)


def test_what_is_written_is_read_back_bit_by_bit(tmp_path):
    one, two = (random_channel([lb.Run(0.05)], frequency) for frequency in (25.0, 30.0))
    flags = np.zeros((16, one.layout.n_times), dtype=bool)
    flags[3, 2], flags[:, 5] = True, True
    layout = DataLayout.from_flags(flags)
    two = replace(two, layout=layout, data=layout.gather(two.layout.scatter(two.data)))
    path = write_waterfall(tmp_path / "w.fits", [one, two], np.array([3.0 - 40j, 4.0 - 30j]))
    waterfall = read_waterfall(path)
    for given in (one, two):
        back = waterfall.at(given.frequency_mhz)
        np.testing.assert_array_equal(back.grid(), given.grid())
        assert back.layout.size == given.layout.size
        here, there = back.observation, given.observation
        # two parts of a Julian date, from text to the nanosecond
        assert np.abs((here.times - there.times).to_value(u.s)).max() < 2e-9
        assert (here.lon_deg, here.lat_deg, here.step_s) == (182.258, -23.814, 7200.0)
    data, times, places = as_luseepy_reads(path)
    np.testing.assert_array_equal(data[:, places[2, 3], 0], one.grid()[13])
    np.testing.assert_array_equal(data[:, places[3, 3], 1], two.grid()[15])
    assert np.abs((times - one.observation.times).to_value(u.s)).max() < 1e-6
    with fits.open(path) as hdus:
        np.testing.assert_array_equal(hdus["ZIm_2"].data, [-40.0, -30.0])


def test_what_luseepys_layout_cannot_hold(tmp_path):
    for runs, message in (
        ([lb.Run(0.02, turntable_deg=30.0)], "at the turntable angle 0"),
        ([lb.Run(0.02), lb.Run(0.02)], "at the turntable angle 0"),
        ([lb.Run(2.0, night_only=True)], "need samples every 7200 s; write netCDF"),
    ):
        refuse(message, write_waterfall, tmp_path / "w.fits", 2 * [random_channel(runs)])
    assert not list(tmp_path.iterdir())


@pytest.mark.long
def test_simulate_writes_it_and_map_reads_it(tmp_path):
    path = tmp_path / "w.fits"
    given = ["--set", "lmax=4", "--set", "observation.runs.0.cycles=0.1", "--quiet"]
    assert run("simulate", "fiducial", "-o", path, *["--frequencies", "20,25"], *given) == 0
    data, _, _ = as_luseepy_reads(path)
    # each channel is what its own scenario gives, with a seed of its own
    for k, (f, seed) in enumerate(((20, 1), (25, 2))):
        alone = ["lmax=4", "observation.runs.0.cycles=0.1", f"frequency_mhz={f}", f"seed={seed}"]
        expected = lb.build(lb.load_scenario("fiducial", alone)).data.grid()
        np.testing.assert_array_equal(data[:, :, k].T, expected)
    with fits.open(path) as hdus:
        kept = hdus["scenario"].data.tobytes().decode()
    assert parse_yaml(kept, "the file")["observation"]["runs"][0]["cycles"] == 0.1
    assert run("map", "fiducial", "--data", path, "-o", tmp_path / "map", *given) == 0
    assert (tmp_path / "map" / "posterior.nc").is_file()


@pytest.mark.parametrize(("arguments", "message"), TABLES["not written"])
def test_channels_that_cannot_be_written(tmp_path, monkeypatch, capsys, arguments, message):
    monkeypatch.chdir(tmp_path)
    given = ["--set", "lmax=2", "--set", "observation.runs.0.cycles=0.02", "--quiet"]
    assert message in refused(capsys, "simulate", "fiducial", *arguments, *given)
    assert not list(tmp_path.iterdir())


def test_ranges_of_frequencies():
    assert parse_frequencies("5:50:5") == [5.0 * k for k in range(1, 11)]
    assert parse_frequencies("10.1:10.4:0.1") == pytest.approx([10.1, 10.2, 10.3, 10.4])
    assert parse_frequencies("10,25.5") == [10.0, 25.5]


# --- data that do not fit -----------------------------------------------------------------------


def test_another_site_and_other_ports(tmp_path):
    path = write(tmp_path / "w.fits", header=HEADER | {"LUN_LAT_DEG": -20.0, "LUN_LONG_DEG": 10.0})
    scenario = lb.load_scenario("fiducial", ["frequency_mhz=10", "lmax=4"])
    words = "--set observation.lon_deg=10 --set observation.lat_deg="
    refuse(words, lambda: set_up(scenario, lb.read_data(path, scenario)))
    # 182.258 degrees East is 177.742 West
    path = write(tmp_path / "west.fits", header=HEADER | {"LUN_LONG_DEG": -177.742})
    set_up(scenario, lb.read_data(path, scenario))


def test_products_that_the_beams_cannot_supply(tmp_path):
    refuse("product 02R.*2 ports", read_waterfall(write(tmp_path / "w.fits")).at, 10.0, n_ports=2)
    few = read_waterfall(write(tmp_path / "few.fits", pairs=[[0, 0], [0, 1], [1, 1]]))
    data = few.at(10.0, n_ports=2)
    assert (data.layout.n_products, data.n_missing) == (4, 0)
    np.testing.assert_array_equal(data.grid()[:, 3], 100.0 * np.arange(4) + 3.0)


def four_port(path, **changes):
    """luseepy's four-port layout with two products, and what is changed."""
    jd = 2461000.5 + np.arange(5) / 12.0
    images = {
        "data": np.arange(20.0).reshape(5, 2, 2),
        "freq": np.array([10.0, 20.0]),
        "time": np.stack([np.floor(jd), jd % 1.0], axis=1),
        "blackbody_normalization_real": np.tile(4.0 * np.eye(4), (2, 1, 1)),
    } | changes.pop("images", {})
    header = HEADER | {"BUNIT": "V^2/Hz", "TIMESYS": "UTC", "TMOON_K": 250.0}
    write_images(path, images, header | changes.pop("header", {}))
    column = fits.Column("label", "8A", array=np.array(changes.pop("products", ["13I", "00R"])))
    with fits.open(path, mode="append") as hdus:
        hdus.append(fits.BinTableHDU.from_columns([column], name="products"))
    return path


def test_four_port_columns_are_where_the_table_says(tmp_path):
    waterfall = read_waterfall(four_port(tmp_path / "w.fits"))
    place = {label: k for k, label in enumerate(labels())}
    np.testing.assert_array_equal(waterfall.grid[place["13I"], :, 1], np.arange(1, 20, 4) / 4.0)
    np.testing.assert_array_equal(waterfall.grid[place["00R"], :, 0], np.arange(2, 20, 4) / 4.0)
    assert np.isfinite(waterfall.grid).sum() == 20
    assert (waterfall.moon_k, waterfall.antenna_k) == (250.0, 0.0)
    np.testing.assert_allclose(waterfall.observation.hours, 2.0 * np.arange(5), atol=1e-6)


backwards = np.array([[2461000.0, 0.5], [2461000.0, 0.7], [2461000.0, 0.6]])
twice = np.array([[2461000.0, 0.5], [2461000.0, 0.5], [2461000.0, 0.6]])


UNUSABLE_FOUR_PORTS = [
    ({"products": ["13I", "13X"]}, "unknown product '13X'"),
    ({"products": ["13I", "13I"]}, "the product 13I is listed twice"),
    ({"products": ["13I", "00R", "11R"]}, r"data has shape \(5, 2, 2\), expected 5 \(time\)"),
    ({"header": {"BUNIT": "K"}}, r"BUNIT is 'K'; known: V\^2/Hz"),
    ({"header": {"TIMESYS": "LOCAL"}}, "TIMESYS is 'LOCAL'"),
    ({"header": {"TIMEUNIT": "s"}}, "TIMEUNIT is 's'"),
    ({"images": {"time": backwards, "data": np.ones((3, 2, 2))}}, "times must increase"),
    ({"images": {"time": twice, "data": np.ones((3, 2, 2))}}, "times must increase"),
]


@pytest.mark.parametrize(("changes", "message"), UNUSABLE_FOUR_PORTS)
def test_four_port_files_that_cannot_be_used(tmp_path, changes, message):
    refuse(message, read_waterfall, four_port(tmp_path / "w.fits", **changes))
