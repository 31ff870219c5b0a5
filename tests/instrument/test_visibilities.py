"""The data set on disk: everything comes back, and bad files are refused."""

import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr

import lusee_bayes as lb
from lusee_bayes.instrument.layout import DataLayout


@pytest.fixture
def data():
    observation = lb.Observation.from_runs([lb.Run(0.05), lb.Run(0.03, turntable_deg=30.0)])
    rng = np.random.default_rng(0)
    flags = rng.random((16, observation.n_times)) < 0.1
    layout = DataLayout.from_flags(flags)
    values = jnp.asarray(rng.standard_normal(layout.size))
    return lb.Visibilities(values, layout, observation, 25.0, jnp.asarray(rng.standard_normal(9)))


def test_round_trip_is_exact(data, tmp_path):
    again = lb.read_visibilities(data.write(tmp_path / "data.nc"))
    np.testing.assert_array_equal(again.data, data.data)
    np.testing.assert_array_equal(again.layout.index, data.layout.index)
    np.testing.assert_array_equal(again.truth, data.truth)
    np.testing.assert_array_equal(again.observation.run, data.observation.run)
    assert again.observation.turntable_deg == (0.0, 30.0)
    assert again.frequency_mhz == 25.0
    # orientations, the only use of the times, are the same to the last bit
    np.testing.assert_array_equal(
        again.observation.mcmf_from_galactic(), data.observation.mcmf_from_galactic()
    )


def test_missing_samples_are_nan_in_the_grid_and_absent_from_d(data):
    grid = data.grid()
    assert np.isnan(grid).sum() == data.n_missing > 0
    np.testing.assert_array_equal(grid[~np.isnan(grid)], data.data)


def test_a_failed_write_leaves_the_old_file(data, tmp_path, monkeypatch):
    path = data.write(tmp_path / "data.nc")
    before = path.read_bytes()

    def fail(*_, **__):
        raise OSError("disk full")

    monkeypatch.setattr(xr.Dataset, "to_netcdf", fail)
    with pytest.raises(OSError, match="disk full"):
        data.write(path)
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["data.nc"]


def altered(change):
    def write(data, path):
        dataset = data.to_dataset()
        dataset = change(dataset) or dataset
        dataset.to_netcdf(path, engine="h5netcdf")

    return write


def nan(dataset):
    values = dataset["visibility"].values
    first = np.argwhere(~dataset["flag"].values)[0]
    values[tuple(first)] = np.nan


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (nan, "visibility .where not flagged. holds NaN"),
        (lambda d: d["flag"].values.fill(True), "all .* samples are flagged"),
        (lambda d: d.attrs.update(format="other"), "its format is 'other'"),
        (
            lambda d: d.assign_coords(product=["00R", "10R", *d["product"].values[2:]]),
            "has products 00R, 10R",
        ),
        (lambda d: d.attrs.update(step_s=-1.0), "step_s is -1.0, expected a number from 0"),
        (lambda d: d.attrs.update(frequency_mhz=25e6), "is this Hz"),
        (lambda d: d["visibility"].attrs.update(units="V^2/Hz"), "unit"),
        (lambda d: d["visibility"].attrs.update(units="Jy"), "unit"),
        (lambda d: d["jd1"].attrs.update(scale="lunar"), "scale"),
        (lambda d: d["jd2"].attrs.update(scale="tt"), "different scales"),
    ],
)
def test_bad_files_are_refused(data, tmp_path, change, message):
    path = tmp_path / "bad.nc"
    altered(change)(data, path)
    with pytest.raises(lb.InputError, match=message):
        lb.read_visibilities(path)


@pytest.mark.parametrize(("unit", "factor"), [("mK", 1e-3), ("kK", 1e3), ("", 1.0)])
def test_temperatures_in_other_units_are_converted(data, tmp_path, unit, factor):
    path = tmp_path / "other.nc"
    altered(lambda d: d["visibility"].attrs.update(units=unit))(data, path)
    np.testing.assert_allclose(lb.read_visibilities(path).data, factor * data.data, rtol=1e-15)


# TAI - UTC is 37 s since 2017, TT - TAI 32.184 s, TDB - TT less than 2 ms
@pytest.mark.parametrize(
    ("scale", "s"), [("UTC", 0.0), ("tai", 37.0), ("TT", 69.184), ("tdb", 69.184)]
)
def test_times_in_other_scales_are_brought_to_utc(data, tmp_path, scale, s):
    path = tmp_path / "other.nc"
    altered(lambda d: [d[k].attrs.update(scale=scale) for k in ("jd1", "jd2")] and d)(data, path)
    moved = (data.observation.times - lb.read_visibilities(path).observation.times).sec
    np.testing.assert_allclose(moved, s, rtol=0, atol=2e-3)


def test_other_files_are_refused(tmp_path):
    with pytest.raises(lb.InputError, match="no data at .*lusee-bayes simulate"):
        lb.read_visibilities(tmp_path / "none.nc")
    (tmp_path / "text.nc").write_text("hello")
    with pytest.raises(lb.InputError, match="not a file of visibilities"):
        lb.read_visibilities(tmp_path / "text.nc")


def test_lengths_must_fit(data):
    with pytest.raises(lb.InputError, match="the data has shape"):
        lb.Visibilities(data.data[:-1], data.layout, data.observation, 25.0)
    with pytest.raises(lb.InputError, match="times, the observation"):
        short = data.observation.select(data.observation.run == 0)
        lb.Visibilities(data.data, data.layout, short, 25.0)
