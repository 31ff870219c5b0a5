"""Data sets: on disk, from arrays of any order and sign, with gaps, product by product."""

from datetime import UTC, datetime, timedelta, timezone

import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
from assertions import close, refuse, within
from astropy import units as u
from astropy.time import Time
from astropy.utils.masked import Masked

import lusee_bayes as lb
from lusee_bayes.instrument import products as pr
from lusee_bayes.instrument.visibilities import read_visibilities


@pytest.fixture
def data():
    observation = lb.Observation.from_runs([lb.Run(0.05), lb.Run(0.03, turntable_deg=30.0)])
    rng = np.random.default_rng(0)
    layout = pr.DataLayout.from_flags(rng.random((16, observation.n_times)) < 0.1)
    values = jnp.asarray(rng.standard_normal(layout.size))
    return lb.Visibilities(values, layout, observation, 25.0, jnp.asarray(rng.standard_normal(9)))


def test_round_trip_is_exact(data, tmp_path):
    again = read_visibilities(data.write(tmp_path / "data.nc"))
    np.testing.assert_array_equal(again.data, data.data)
    np.testing.assert_array_equal(again.layout.index, data.layout.index)
    np.testing.assert_array_equal(again.truth, data.truth)
    np.testing.assert_array_equal(again.observation.run, data.observation.run)
    assert again.observation.turntable_deg == (0.0, 30.0) and again.frequency_mhz == 25.0
    # orientations, the only use of the times, are the same to the last bit
    there, here = (d.observation.mcmf_from_galactic for d in (data, again))
    np.testing.assert_array_equal(here, there)


def altered(data, folder, change):
    """A file of the data, in which something was changed."""
    dataset, path = data.to_dataset(), folder / "altered.nc"
    (change(dataset) or dataset).to_netcdf(path, engine="h5netcdf")
    return path


SECOND = np.timedelta64(1, "s")
BAD_FILES = [
    (lambda d: d["visibility"].values.fill(np.nan), "visibility .where not flagged..*NaN"),
    (lambda d: d["flag"].values.fill(True), "all .* samples are flagged"),
    (lambda d: d.attrs.update(format="other"), "its format is 'other'"),
    (lambda d: d.assign_coords(product=d["product"].values[::-1]), "has products 33R, 23I"),
    (lambda d: d.attrs.update(step_s=-1.0), "step_s is -1.0, expected a number from 0"),
    (lambda d: d.attrs.update(frequency_mhz=25e6), "is this Hz"),
    (lambda d: d["visibility"].attrs.update(units="Jy"), "unit"),
    (lambda d: d["jd1"].attrs.update(scale="lunar"), "scale"),
    (lambda d: d["jd2"].attrs.update(scale="tt"), "different scales"),
    (lambda d: d.assign_coords(time=d["time"] + SECOND), "time and jd1 . jd2 .* differ by 1 s"),
]


@pytest.mark.parametrize(("change", "message"), BAD_FILES)
def test_bad_files_are_refused(data, tmp_path, change, message):
    refuse(message, read_visibilities, altered(data, tmp_path, change))


@pytest.mark.parametrize(("unit", "factor"), [("mK", 1e-3), ("kK", 1e3), ("", 1.0)])
def test_temperatures_in_other_units_are_converted(data, tmp_path, unit, factor):
    path = altered(data, tmp_path, lambda d: d["visibility"].attrs.update(units=unit))
    np.testing.assert_allclose(read_visibilities(path).data, factor * data.data, rtol=1e-15)


# TAI - UTC is 37 s since 2017, TT - TAI 32.184 s, TDB - TT less than 2 ms
SCALES = [("UTC", 0.0), ("tai", 37.0), ("TT", 69.184), ("tdb", 69.184)]


@pytest.mark.parametrize(("scale", "s"), SCALES)
def test_times_in_other_scales_are_brought_to_utc(data, tmp_path, scale, s):

    def rescaled(dataset):
        for name in ("jd1", "jd2"):
            dataset[name].attrs.update(scale=scale)
        return dataset.drop_vars("time")

    path = altered(data, tmp_path, rescaled)
    within((data.observation.times - read_visibilities(path).observation.times).sec, s, 2e-3)


def test_other_files_are_refused(tmp_path):
    refuse("no data at .*lusee-bayes simulate", read_visibilities, tmp_path / "none.nc")
    (tmp_path / "text.nc").write_text("hello")
    refuse("does not contain visibilities", read_visibilities, tmp_path / "text.nc")


def test_lengths_must_fit(data):
    make, observation = lb.Visibilities, data.observation
    refuse("the data has shape", make, data.data[:-1], data.layout, observation, 25.0)
    short = observation.select(observation.run == 0)
    refuse("times, the observation", make, data.data, data.layout, short, 25.0)


# --- data of one's own ----------------------------------------------------------------------------


N = 5
START = datetime(2027, 1, 15)
TIMES = [START + timedelta(hours=2 * k) for k in range(N)]
RNG = np.random.default_rng(3)
VOLTAGES = RNG.normal(size=(N, 4, 50)) + 1j * RNG.normal(size=(N, 4, 50))
# <s_i conj(s_j)>, by its definition
MATRIX = 1e3 * np.einsum("tis,tjs->tij", VOLTAGES, VOLTAGES.conj()) / 50


PAIRS = [(i, j) for i in range(4) for j in range(i, 4)]


def expected() -> np.ndarray:
    every = [(MATRIX[:, i, j].real, MATRIX[:, i, j].imag)[: 1 + (i != j)] for i, j in PAIRS]
    return np.concatenate(every)


def columns(pairs) -> np.ndarray:
    return np.stack([MATRIX[:, i, j] for i, j in pairs], axis=1)


def make(data=None, times=TIMES, frequency_mhz=25.0, **options) -> lb.Visibilities:
    data = columns(PAIRS) if data is None else data
    return lb.Visibilities.from_arrays(data, times, frequency_mhz, **options)


def test_complex_correlations_in_the_packages_order():
    made = make()
    np.testing.assert_array_equal(made.grid(), expected())
    assert made.observation.step_s == pytest.approx(7200.0, rel=1e-12)
    assert (made.observation.lon_deg, made.observation.lat_deg) == (182.258, -23.814)


def test_any_order_of_products_and_of_their_ports():
    pairs = [PAIRS[k] if k % 3 else PAIRS[k][::-1] for k in RNG.permutation(len(PAIRS))]
    made = make(columns(pairs), products=[f"{i}{j}" for i, j in pairs])
    np.testing.assert_array_equal(made.grid(), expected())
    # the other convention: every array is the conjugate, and said so once
    names = [f"{i}-{j}" for i, j in pairs]
    made = make(columns(pairs).conj(), products=names, convention="conj(s_i) s_j")
    np.testing.assert_array_equal(made.grid(), expected())


def test_real_products_in_any_order():
    names = [p.upper() for p in lb.Visibilities.labels.fget(make())]
    order = RNG.permutation(len(names))
    made = make(expected()[order].T, products=[names[k] for k in order])
    np.testing.assert_array_equal(made.grid(), expected())
    np.testing.assert_array_equal(make(expected().T).grid(), expected())
    # 10I is the imaginary part of the conjugate
    made = make(np.stack([MATRIX[:, 0, 0].real, MATRIX[:, 1, 0].imag], 1), products=["00", "10I"])
    np.testing.assert_array_equal(made.grid()[2], MATRIX[:, 0, 1].imag)


def test_flags_nan_and_products_without_a_column_are_absent():
    data, flags = columns(PAIRS), np.zeros((N, len(PAIRS)), dtype=bool)
    data[1, 2] = complex(np.nan, 1.0)  # 02
    flags[3, 0] = True  # 00
    data[3, 0] = np.inf  # not looked at
    absent = np.zeros((16, N), dtype=bool)
    absent[3:5, 1] = absent[0, 3] = True
    made = make(data, flags=flags)
    np.testing.assert_array_equal(made.grid(), np.where(absent, np.nan, expected()))
    masked = np.ma.array(columns(PAIRS), mask=flags)
    for one in (masked, Masked(columns(PAIRS), mask=flags)):
        np.testing.assert_array_equal(np.isnan(make(one).grid()[0]), flags[:, 0])
    whole_times = np.arange(N) == 2
    np.testing.assert_array_equal(np.isnan(make(flags=whole_times).grid()).all(0), whole_times)
    autos = make(columns([(3, 3), (0, 0)]), products=["33", "00"])
    assert autos.layout.size == 2 * N
    np.testing.assert_array_equal(autos.grid()[[0, 15]], expected()[[0, 15]])


ANY_KIND = {
    "iso": [t.isoformat() for t in TIMES],
    "iso-z": [t.isoformat() + "Z" for t in TIMES],
    "zone": [t.replace(tzinfo=UTC).astimezone(timezone(timedelta(hours=-7))) for t in TIMES],
    "datetime64": np.array(TIMES, dtype="datetime64[s]"),
    "pandas": pd.DatetimeIndex(TIMES),
    "pandas-zone": pd.DatetimeIndex(TIMES, tz="UTC").tz_convert("Asia/Tokyo"),
    "tdb": Time([t.isoformat() for t in TIMES], scale="utc").tdb,
}


@pytest.mark.parametrize("times", ANY_KIND.values(), ids=list(ANY_KIND))
def test_times_of_any_kind(times):
    # the day is kept apart, so that rounding is that of a day in double precision
    assert abs((make(times=times).observation.times - Time(TIMES, scale="utc")).sec).max() < 1e-9


def test_angles_are_runs_and_sites_are_places(tmp_path):
    made = make(turntable_deg=[0.0, 0.0, 30.0, 30.0, 0.0], site=(10.0, 5.0), step_s=600.0)
    observation = made.observation
    np.testing.assert_array_equal(observation.run, [0, 0, 1, 1, 2])
    assert observation.turntable_deg == (0.0, 30.0, 0.0)
    assert (observation.lon_deg, observation.lat_deg, observation.step_s) == (10.0, 5.0, 600.0)
    again = read_visibilities(made.write(tmp_path / "mine.nc"))
    assert again.digest() == made.digest()
    assert again.observation.turntable_deg == (0.0, 30.0, 0.0)


def test_times_are_written_whatever_their_format_is(tmp_path):
    days = Time([t.isoformat() for t in TIMES], precision=0, out_subfmt="date") + 0.4 * u.s
    own = make(times=days)
    assert read_visibilities(own.write(tmp_path / "own.nc")).digest() == own.digest()


def test_quantities_have_units():
    plain = make(turntable_deg=30.0, step_s=7200.0, live_s=600.0)
    given = {"turntable_deg": np.pi / 6.0 * u.rad, "step_s": 2.0 * u.h, "live_s": 10.0 * u.min}
    seen = make(1e3 * columns(PAIRS) * u.mK, frequency_mhz=25e6 * u.Hz, **given)
    np.testing.assert_allclose(seen.data, plain.data, rtol=1e-14)
    assert (seen.frequency_mhz, seen.observation.step_s) == (25.0, 7200.0)
    assert seen.observation.turntable_deg == pytest.approx((30.0,), rel=1e-14)
    np.testing.assert_allclose(seen.observation.live_s, plain.observation.live_s, rtol=1e-14)
    refuse("frequency_mhz is in 'K', expected MHz", make, frequency_mhz=25.0 * u.K)


WRONG = [
    ({"products": ["00", "01"]}, "shape"),
    ({"data": columns(PAIRS).T}, "transpose"),
    ({"data": "text"}, "not an array of numbers"),
    ({"data": [1.0, 2.0]}, "expected (times, products)"),
    ({"products": ["0a"] * 10}, "unknown product '0a'"),
    ({"products": ["04"] * 10}, "port 4"),
    ({"products": ["01R"] * 10}, "the data are complex"),
    ({"data": expected().T, "products": ["01"] * 16}, "name the part"),
    ({"data": expected().T, "products": ["00I"] * 16}, "an auto is real"),
    ({"products": ["00"] * 10}, "listed twice"),
    ({"data": columns([(0, 1), (1, 0)]), "products": ["01", "10"]}, "01R is listed twice"),
    ({"products": "00"}, "give a list"),
    ({"products": [f"{3 - i}{3 - j}" for i, j in PAIRS[1:]] + ["33"]}, "check the names"),
    ({"convention": "s_i conj(s_i)"}, "did you mean 's_i conj(s_j)'"),
    ({"data": np.full((N, 10), np.inf + 0j)}, "infinity"),
    ({"flags": np.zeros(3, dtype=bool)}, "flags have shape"),
    ({"flags": np.full(N, 0.5)}, "must be true or false"),
    ({"flags": np.ones(N, dtype=bool)}, "nothing to map"),
    ({"times": TIMES[:3]}, "3 times for data of 5 times"),
    ({"times": TIMES[::-1]}, "times must increase"),
    ({"times": ["yesterday"] * N}, "is not a date"),
    ({"times": np.arange(N)}, "give datetimes"),
    ({"times": [t.replace(year=2060) for t in TIMES]}, "ephemeris"),
    ({"times": Time(TIMES, scale="ut1")}, "times are in ut1"),
    ({"site": "Lusee-Nihgt"}, "did you mean 'LuSEE-Night'"),
    ({"site": 3.0}, "longitude and latitude"),
    ({"site": (0.0, 95.0)}, "lat_deg"),
    ({"turntable_deg": [0.0, 1.0]}, "one for each of 5 times"),
    ({"frequency_mhz": -1.0}, "frequency_mhz must be positive"),
    ({"frequency_mhz": 25e6}, "is this Hz"),
    ({"data": columns(PAIRS)[:1], "times": TIMES[:1]}, "give step_s"),
]


@pytest.mark.parametrize(("options", "words"), WRONG)
def test_what_is_wrong_is_said_in_a_sentence(options, words):
    refuse(words, make, **options)


# --- layouts --------------------------------------------------------------------------------------


FLAGS = np.zeros((3, 5), dtype=bool)
FLAGS[0, 1] = FLAGS[2, 4] = True
FLAGS[:, 3] = True


@pytest.mark.parametrize("flags", [np.zeros((3, 5), dtype=bool), FLAGS])
def test_flagged_samples_are_not_in_the_data(flags):
    layout = pr.DataLayout.from_flags(flags)
    # the positions by a loop in the order of d
    expected = [(p, t) for p in range(3) for t in range(5) if not flags[p, t]]
    assert list(zip(layout.product, layout.time, strict=True)) == expected
    assert layout.size == len(expected) == 15 - flags.sum()
    np.testing.assert_array_equal(layout.present, ~flags)
    grid = np.random.default_rng(0).standard_normal((3, 5))
    np.testing.assert_array_equal(layout.gather(jnp.asarray(grid)), [grid[e] for e in expected])


@pytest.mark.parametrize("rest", [(), (2,)])
@pytest.mark.parametrize("flags", [None, FLAGS])
def test_scatter_is_the_transpose_of_gather(flags, rest):
    layout = pr.DataLayout(3, 5) if flags is None else pr.DataLayout.from_flags(flags)
    rng = np.random.default_rng(1)
    grid = rng.standard_normal((3, 5, *rest))
    data = rng.standard_normal((layout.size, *rest))
    left = np.sum(np.asarray(layout.gather(jnp.asarray(grid))) * data)
    back = np.asarray(layout.scatter(jnp.asarray(data)))
    # sums of fifteen products of order one
    within(np.sum(grid * back), left, 1e-13)
    np.testing.assert_array_equal(layout.gather(jnp.asarray(back)), data)
    if flags is not None:
        assert not back[flags].any()


# --- products -------------------------------------------------------------------------------------


# the order luseepy writes its waterfalls in
LUSEEPY = ["00R", "01R", "01I", "02R", "02I", "03R", "03I", "11R"]
LUSEEPY += ["12R", "12I", "13R", "13I", "22R", "23R", "23I", "33R"]


def hermitian(rng, n, *rest):
    """<s conj(s)> of a few random voltages, antennas on the first two axes."""
    s = rng.standard_normal((n, 5, *rest)) + 1j * rng.standard_normal((n, 5, *rest))
    return np.einsum("ik...,jk...->ij...", s, s.conj())


def test_labels_are_those_of_luseepy():
    assert list(pr.labels()) == LUSEEPY
    assert pr.all_products()[4] == pr.Product(0, 2, "I")
    assert [LUSEEPY[k] for k in pr.auto_indices()] == ["00R", "11R", "22R", "33R"]


def test_each_product_is_the_entry_its_label_names():
    v = hermitian(np.random.default_rng(1), 4)
    for label, value in zip(LUSEEPY, pr.to_real(jnp.asarray(v)), strict=True):
        entry = v[int(label[0]), int(label[1])]
        assert value == (entry.real if label[2] == "R" else entry.imag)


@pytest.mark.parametrize("rest", [(), (3,), (3, 2)])
@pytest.mark.parametrize("n", [1, 2, 4])
def test_matrix_and_products_are_inverse(n, rest):
    v = hermitian(np.random.default_rng(2), n, *rest)
    products = pr.to_real(jnp.asarray(v))
    assert products.shape == (n * n, *rest)
    back = np.asarray(pr.to_matrix(products))
    # a copy of numbers: exact, except that autos lose an imaginary rounding error
    close(back, v, 1e-14)
    np.testing.assert_array_equal(back, back.conj().swapaxes(0, 1))
    np.testing.assert_array_equal(pr.to_real(jnp.asarray(back)), products)
