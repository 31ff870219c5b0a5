"""Files: layouts that are declared, HDF5 on which its library runs for ever or dies, and YAML."""

import faulthandler
import os
import time
from contextlib import nullcontext
from types import SimpleNamespace

import h5py
import numpy as np
import pytest
from assertions import refuse
from hypothesis import given, settings
from hypothesis import strategies as st

from lusee_bayes.core import formats, layouts, reading
from lusee_bayes.core.layouts import Attribute, Layout, Variable

LAYOUT = Layout(
    "an example",
    {
        "times": Variable(("time",), grows=True),
        "data": Variable(("time", "product"), low=0.0),
        "flags": Variable(("time",), "boolean", optional=True),
        "names": Variable(("product",), "text", choices=("a", "b", "c")),
    },
    {"step": Attribute(low=1.0), "kind": Attribute("text", optional=True)},
)


def arrays(**changes):
    found = {"times": np.arange(3.0), "names": np.array(["a", "b"])}
    found |= {"data": np.ones((3, 2), dtype=np.float32)}
    return {name: v for name, v in (found | changes).items() if v is not None}


def test_what_is_declared_comes_back_in_its_kind():
    found = LAYOUT.checked("x", arrays(flags=np.array([0, 1, 0])), {"step": np.float32(2)})
    assert found.arrays["data"].dtype == np.float64 and found.arrays["flags"].dtype == bool
    assert found.values == {"step": 2.0} and found.sizes == {"time": 3, "product": 2}


NOT_AS_DECLARED = [
    ({"times": None}, "x: .*no times|x has no times"),
    ({"data": np.ones((2, 2))}, r"data has shape \(2, 2\), expected 3"),
    ({"data": np.ones(3)}, r"data has shape \(3,\)"),
    ({"data": np.full((3, 2), np.nan)}, "data contains"),
    ({"data": -np.ones((3, 2))}, "data"),
    ({"data": np.array([["a", "b"]] * 3)}, "data"),
    ({"data": np.ones((3, 2), dtype=complex)}, "data"),
    ({"times": np.array([0.0, 2.0, 1.0])}, "times"),
    ({"names": np.array(["a", "z"])}, "names"),
    ({"flags": np.array([0, 1, 2])}, "flags"),
]


@pytest.mark.parametrize(("changes", "message"), NOT_AS_DECLARED)
def test_what_is_not_as_declared_is_said(changes, message):
    refuse(message, LAYOUT.checked, "x", arrays(**changes), {"step": 2.0})


NO_STEPS = ["two", np.nan, 0.0, [1.0, 2.0], [[1], [1, 2]], None, True, 10**400]


@pytest.mark.parametrize("step", NO_STEPS)
def test_attributes_are_checked(step):
    refuse("step", LAYOUT.checked, "x", arrays(), {} if step is None else {"step": step})


def test_what_no_memory_holds_is_not_read(tmp_path, monkeypatch):
    """1.2 TiB that a file declares without holding them."""
    monkeypatch.setattr(layouts, "memory_limit", lambda: 10**9)
    with h5py.File(tmp_path / "x.h5", "w") as file:
        huge = file.create_dataset("data", shape=(400_000, 400_000), dtype="f8", chunks=True)
        layout = Layout("an example", {"data": Variable(("time", "product"))})
        refuse("1,280 GB; the memory is 1 GB", layout.checked, "x", {"data": huge}, {})


def test_tables_objects_and_arrays(tmp_path):
    (tmp_path / "t.csv").write_text("ell,name\n0,a\n1,b\n")
    table = Layout("a table", {"ell": Variable(("row",)), "name": Variable(("row",), "text")})
    np.testing.assert_array_equal(reading.read_table(tmp_path / "t.csv", table)["ell"], [0.0, 1.0])
    (tmp_path / "t.csv").write_text("ell,name\n0,a\n1\n")
    refuse("line 3.*2 columns", reading.read_table, tmp_path / "t.csv", table)
    (tmp_path / "o.json").write_text("[1]")
    refuse("should be an object", reading.read_model, tmp_path / "o.json", dict, "an object")
    np.save(tmp_path / "a.npz", np.ones(3))
    refuse("a.npz", reading.read_arrays, tmp_path / "a.npz.npy", Layout("arrays"))


@pytest.fixture
def path(tmp_path):
    with h5py.File(tmp_path / "x.h5", "w") as file:
        file["data"] = np.arange(1000.0)
        file["data"].attrs["unit"] = "K"
    return tmp_path / "x.h5"


def test_a_file_without_end_is_refused(path, monkeypatch):
    formats.require_readable_hdf5(path)  # a whole one is read
    formats._probe.cache_clear()
    monkeypatch.setattr(formats, "LIMIT_S", 0.2)
    monkeypatch.setattr(formats, "_read_all", lambda path, size: time.sleep(60))
    start = time.monotonic()
    refuse(r"reading.*0\.2 s", formats.require_readable_hdf5, path)
    assert time.monotonic() - start < 30


def test_a_name_whose_search_has_no_end_is_refused_even_where_none_can_be_listed(path, monkeypatch):
    """As of a file whose root HDF5 neither lists nor, asked for an attribute, comes back from."""

    class Attributes(dict):
        def __iter__(self):
            raise RuntimeError("cannot iterate")

        def get(self, name):
            time.sleep(60)

    file = SimpleNamespace(attrs=Attributes())
    formats._probe.cache_clear()
    monkeypatch.setattr(formats, "LIMIT_S", 0.2)
    monkeypatch.setattr(formats.h5py, "File", lambda path: nullcontext(file))
    refuse(r"reading.*0\.2 s", formats.require_readable_hdf5, path)


def test_a_file_that_ends_the_process_is_refused(path, monkeypatch):
    def end(path, size):
        faulthandler.disable()  # of pytest, which would print where
        os.abort()

    monkeypatch.setattr(formats, "_read_all", end)
    refuse("HDF5's library fails on it", formats.require_readable_hdf5, path)


TEXT = st.text(max_size=10)
LEAVES = st.one_of(st.none(), st.booleans(), st.integers(), st.floats(allow_nan=False), TEXT)
TREES = st.recursive(
    LEAVES,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(TEXT, inner, max_size=3),
    max_leaves=8,
)


@settings(max_examples=50, database=None, deadline=None, derandomize=True)
@given(TREES)
def test_what_is_written_comes_back(tree):
    assert reading.parse_yaml(reading.as_yaml(tree), "the text") == tree


PLAIN = [
    ("1e6", 1e6), ("-1E-3", -1e-3), ("010", 10), ("1:30", "1:30"), ("2027-02-30", "2027-02-30"),
    ("2027-01-15T00:00:00Z", "2027-01-15T00:00:00Z"), (".5", 0.5), ("5.", 5.0), ("yes", "yes"),
    ("true", True), ("~", None),
]  # fmt: skip


@pytest.mark.parametrize(("text", "value"), PLAIN)
def test_numbers_are_decimal_and_dates_are_text(text, value):
    found = reading.parse_yaml(text, "the text")
    assert (type(found), found) == (type(value), value)


NO_YAML = [
    ("a: 1\nb: 2\na: 3", r"duplicate key \"a\".* \(line 3\)"),
    ("[" * 500 + "]" * 500, "is not valid YAML"),
    ("a: [1", "is not valid YAML"),
    ("!!python/object:os.system {}", "is not valid YAML"),
    ("a\0b", "is not valid YAML"),
]


@pytest.mark.parametrize(("text", "message"), NO_YAML)
def test_what_is_not_valid_is_refused(text, message):
    refuse(message, reading.parse_yaml, text, "the text")


def test_files_are_utf8(tmp_path):
    path = tmp_path / "x.yaml"
    path.write_bytes("a: é".encode("latin-1"))
    refuse(r"x\.yaml.*scenario.*utf-8", reading.read_yaml, path, "a scenario")
    path.write_bytes(b"\xef\xbb\xbfa: 1")
    assert reading.read_yaml(path, "a scenario") == {"a": 1}
