"""Data of one's own: any order, sign, kind of time and flag gives the package's own data set."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta, timezone

import numpy as np
import pandas as pd
import pytest
from astropy.time import Time

import lusee_bayes as lb

N = 5
START = datetime(2027, 1, 15)
TIMES = [START + timedelta(hours=2 * k) for k in range(N)]
RNG = np.random.default_rng(3)
VOLTAGES = RNG.normal(size=(N, 4, 50)) + 1j * RNG.normal(size=(N, 4, 50))
# <s_i conj(s_j)>, by its definition
MATRIX = 1e3 * np.einsum("tis,tjs->tij", VOLTAGES, VOLTAGES.conj()) / 50
PAIRS = [(i, j) for i in range(4) for j in range(i, 4)]


def expected() -> np.ndarray:
    rows = []
    for i, j in PAIRS:
        rows.append(MATRIX[:, i, j].real)
        if i != j:
            rows.append(MATRIX[:, i, j].imag)
    return np.array(rows)


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
    made = make(
        columns(pairs).conj(),
        products=[f"{i}-{j}" for i, j in pairs],
        convention="conj(s_i) s_j",
    )
    np.testing.assert_array_equal(made.grid(), expected())


def test_real_products_in_any_order():
    names = [p.upper() for p in lb.Visibilities.labels.fget(make())]
    order = RNG.permutation(len(names))
    data = expected()[order].T
    made = make(data, products=[names[k] for k in order])
    np.testing.assert_array_equal(made.grid(), expected())
    made = make(expected().T)
    np.testing.assert_array_equal(made.grid(), expected())
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
    np.testing.assert_array_equal(np.isnan(make(masked).grid()[0]), flags[:, 0])
    whole_times = np.arange(N) == 2
    np.testing.assert_array_equal(np.isnan(make(flags=whole_times).grid()).all(0), whole_times)
    autos = make(columns([(3, 3), (0, 0)]), products=["33", "00"])
    assert autos.layout.size == 2 * N
    np.testing.assert_array_equal(autos.grid()[[0, 15]], expected()[[0, 15]])


@pytest.mark.parametrize(
    "times",
    [
        [t.isoformat() for t in TIMES],
        [t.isoformat() + "Z" for t in TIMES],
        [t.replace(tzinfo=UTC).astimezone(timezone(timedelta(hours=-7))) for t in TIMES],
        np.array(TIMES, dtype="datetime64[s]"),
        pd.DatetimeIndex(TIMES),
        pd.DatetimeIndex(TIMES, tz="UTC").tz_convert("Asia/Tokyo"),
        Time([t.isoformat() for t in TIMES], scale="utc").tdb,
    ],
    ids=["iso", "iso-z", "zone", "datetime64", "pandas", "pandas-zone", "tdb"],
)
def test_times_of_any_kind(times):
    observation = make(times=times).observation
    # the day is kept apart, so that rounding is that of a day in double precision
    assert abs((observation.times - Time(TIMES, scale="utc")).sec).max() < 1e-9


def test_angles_are_runs_and_sites_are_places(tmp_path):
    made = make(turntable_deg=[0.0, 0.0, 30.0, 30.0, 0.0], site=(10.0, 5.0), step_s=600.0)
    observation = made.observation
    np.testing.assert_array_equal(observation.run, [0, 0, 1, 1, 2])
    assert observation.turntable_deg == (0.0, 30.0, 0.0)
    assert (observation.lon_deg, observation.lat_deg, observation.step_s) == (10.0, 5.0, 600.0)
    again = lb.read_visibilities(made.write(tmp_path / "mine.nc"))
    assert again.digest() == made.digest()
    assert again.observation.turntable_deg == (0.0, 30.0, 0.0)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"products": ["00", "01"]}, "shape"),
        ({"data": columns(PAIRS).T}, "transpose"),
        ({"data": "text"}, "not an array of numbers"),
        ({"data": [1.0, 2.0]}, "expected (times, products)"),
        ({"products": ["0a"] * 10}, "unknown product '0a'"),
        ({"products": ["04"] * 10}, "port 4"),
        ({"products": ["01R"] * 10}, "the data are complex"),
        ({"data": expected().T, "products": ["01"] * 16}, "name the part"),
        ({"data": expected().T, "products": ["00I"] * 16}, "an auto is real"),
        ({"products": ["00"] * 10}, "more than once"),
        ({"data": columns([(0, 1), (1, 0)]), "products": ["01", "10"]}, "01R is given more than"),
        ({"products": "00"}, "give a list"),
        ({"products": [f"{3 - i}{3 - j}" for i, j in PAIRS[1:]] + ["33"]}, "check the names"),
        ({"convention": "s_i conj(s_i)"}, "did you mean 's_i conj(s_j)'"),
        ({"data": np.full((N, 10), np.inf + 0j)}, "infinity"),
        ({"flags": np.zeros(3, dtype=bool)}, "flags have shape"),
        ({"flags": np.full(N, 0.5)}, "other values than true and false"),
        ({"flags": np.ones(N, dtype=bool)}, "nothing to map"),
        ({"times": TIMES[:3]}, "3 times for data of 5 times"),
        ({"times": TIMES[::-1]}, "times must grow"),
        ({"times": ["yesterday"] * N}, "is not a date"),
        ({"times": np.arange(N)}, "give datetimes"),
        ({"times": [t.replace(year=2060) for t in TIMES]}, "ephemeris"),
        ({"site": "Lusee-Nihgt"}, "did you mean 'LuSEE-Night'"),
        ({"site": 3.0}, "longitude and latitude"),
        ({"site": (0.0, 95.0)}, "lat_deg"),
        ({"turntable_deg": [0.0, 1.0]}, "one for each of 5 times"),
        ({"frequency_mhz": -1.0}, "frequency_mhz must be positive"),
        ({"frequency_mhz": 25e6}, "is this Hz"),
        ({"data": columns(PAIRS)[:1], "times": TIMES[:1]}, "give step_s"),
    ],
)
def test_what_is_wrong_is_said_in_a_sentence(options, words):
    with pytest.raises(lb.InputError) as caught:
        make(**options)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)
