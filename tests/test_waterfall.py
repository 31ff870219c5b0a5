"""Waterfalls of luseepy's simulator: its own file, and synthetic ones with gaps and odd orders."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr
from fits_files import write_images

from lusee_bayes.checks import InputError
from lusee_bayes.cli import main
from lusee_bayes.commands.options import read_data
from lusee_bayes.harmonics import from_healpy
from lusee_bayes.inspection import describe
from lusee_bayes.products import labels
from lusee_bayes.waterfall import read_waterfall

PAIRS = [[i, j] for i in range(4) for j in range(i, 4)]
HEADER = {
    "LUNAR_DAY": "2027-02-01 00:00:00 to 2027-02-02 00:00:00",
    "DELTAT_SEC": 7200.0,
    "LUN_LAT_DEG": -23.814,
    "LUN_LONG_DEG": 182.258,
}


def write(path, data=None, pairs=PAIRS, header=HEADER, frequencies=(10.0, 20.0), without=()):
    """A value for every product, time and channel: 100 product + time + channel / 10."""
    if data is None:
        n = sum(1 if i == j else 2 for i, j in pairs)
        product, time, channel = np.arange(n), np.arange(12), np.arange(len(frequencies))
        data = 100.0 * product[None, :, None] + time[:, None, None] + channel / 10.0
    images = {"data": data, "freq": np.array(frequencies), "combinations": np.array(pairs)}
    kept = {name: image for name, image in images.items() if name not in without}
    return write_images(path, kept, header)


def test_every_sample_is_in_its_place(tmp_path):
    waterfall = read_waterfall(write(tmp_path / "w.fits"))
    data = waterfall.at(20.0)
    assert data.frequency_mhz == 20.0 and data.n_missing == 0
    expected = 100.0 * np.arange(16)[:, None] + np.arange(12)[None] + 0.1
    np.testing.assert_array_equal(data.grid(), expected)
    observation = data.observation
    assert observation.times[0].isot == "2027-02-01T00:00:00.000"
    np.testing.assert_allclose(observation.hours, 2.0 * np.arange(12), rtol=0, atol=1e-7)
    assert (observation.lat_deg, observation.lon_deg) == (-23.814, 182.258)
    assert observation.step_s == 7200.0 and observation.turntable_deg == (0.0,)


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


def test_gaps_are_missing_samples_and_counted(tmp_path):
    data = 100.0 + np.zeros((12, 16, 2))
    data[3, :, 0], data[5, 7, 0], data[6, 7, 0] = np.nan, np.inf, -np.inf
    waterfall = read_waterfall(write(tmp_path / "w.fits", data))
    assert (waterfall.at(10.0).n_missing, waterfall.at(20.0).n_missing) == (18, 0)
    assert "16 samples missing" in describe(tmp_path / "w.fits")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"without": ("combinations",)}, "has no image 'combinations'"),
        ({"header": {k: v for k, v in HEADER.items() if k != "DELTAT_SEC"}}, "no DELTAT_SEC"),
        ({"header": HEADER | {"LUNAR_DAY": "tomorrow"}}, "LUNAR_DAY is 'tomorrow'"),
        ({"pairs": [[0, 0], [0, 4]]}, "the ports 0 and 4"),
        ({"pairs": [[0, 1], [1, 0]]}, "the same pair of ports twice"),
        ({"data": np.zeros((12, 15, 2))}, r"data has shape \(12, 15, 2\), expected \(times, 16"),
        ({"header": HEADER | {"DELTAT_SEC": -7200.0}}, "step_s"),
        ({"header": HEADER | {"LUN_LAT_DEG": 123.0}}, "lat_deg must lie in -90..90"),
    ],
)
def test_files_that_cannot_be_used(tmp_path, options, message):
    with pytest.raises(InputError, match=message):
        read_waterfall(write(tmp_path / "w.fits", **options))


def test_missing_channels_files_and_ends(tmp_path):
    path = write(tmp_path / "w.fits")
    with pytest.raises(InputError, match=r"no channel at 25 MHz \(it has 10, 20\)"):
        read_data(path, 25.0)
    with pytest.raises(InputError, match="all 192 samples are flagged"):
        read_data(write(tmp_path / "empty.fits", np.full((12, 16, 2), np.nan)), 10.0)
    with pytest.raises(InputError, match="no data at"):
        read_data(tmp_path / "none.fits", 25.0)
    path.write_bytes(path.read_bytes()[:4000])
    with pytest.raises(InputError, match="cut short"):
        read_data(path, 10.0)


def test_what_info_says_of_luseepys_files(test_data):
    folder = test_data / "luseepy"
    text = describe(folder / "waterfall_exact_engine.fits")
    assert "channels at 5, 10, 15, 20, 25, 30, 35, 40, 45, 50 MHz" in text
    assert "16 products (00R 01R" in text and "328 times of 7200 s, 0 samples missing" in text
    text = describe(folder / "synthetic_monopole_beam.fits")
    assert "50 frequencies from 1 to 50 MHz" in text and "91 angles" in text


@pytest.mark.long
def test_the_map_from_luseepys_waterfall(tmp_path, test_data):
    """10 MHz, luseepy's beam and its noiseless data: rho and SNR of the mean of the posterior."""
    folder = test_data / "luseepy"
    sky = np.load(folder / "sky_alm.npz")
    alm = sky["alm"][list(sky["freq"]).index(10.0)]
    truth = from_healpy(alm)
    arguments = [
        "map",
        "fiducial",
        "--data",
        str(folder / "waterfall_exact_engine.fits"),
        "--set",
        f"beam.file={folder / 'synthetic_monopole_beam.fits'}",
        "--set",
        "frequency_mhz=10",
        "--set",
        "beam.quadrature=rectangle",
        "-o",
        str(tmp_path / "map"),
        "--quiet",
    ]
    assert main(arguments) == 0
    with xr.open_dataset(tmp_path / "map" / "posterior.nc", engine="h5netcdf") as posterior:
        mean = posterior["mean"].values
    rho, snr = [], []
    for ell in range(1, 48):
        a, b = mean[ell**2 : (ell + 1) ** 2], truth[ell**2 : (ell + 1) ** 2]
        rho.append((a * b).sum() / np.sqrt((a**2).sum() * (b**2).sum()))
        snr.append(np.sqrt((b**2).sum() / ((a - b) ** 2).sum()))
    rho, snr = np.array([1.0, *rho]), np.array([np.inf, *snr])
    assert rho[1:9].min() > 0.9
    assert rho[1:27].min() > 0.5
    assert (snr[:18] > 1).all()
