"""Dataclasses as trees and files: what is written comes back, and what is damaged is told."""

from dataclasses import dataclass, field, fields, is_dataclass
from typing import Any, Literal

import h5py
import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
import xarray as xr
from assertions import refuse, require_conventions
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from jaxtyping import Bool, Float, Int8, Shaped

from lusee_bayes.core.trees import StoredTree, from_tree, opened_tree, quantity, to_tree, write_tree


@dataclass(frozen=True)
class Row:
    """A row of a table: numbers and text alone."""

    name: str
    n: int
    value: float
    good: bool


@dataclass(frozen=True)
class Remark:
    """Not a row of a table: its text may be absent."""

    words: str
    remedy: str | None = None


@dataclass(frozen=True)
class Inner:
    """A group."""

    weights: Float[np.ndarray, " part"]
    level: Literal["good", "bad"]


@dataclass(frozen=True, kw_only=True)
class Everything:
    """Fields of every kind."""

    sky: Float[np.ndarray, " mode"] = quantity("K", "posterior mean")
    matrix: Float[np.ndarray, "mode mode"] = quantity("K2")
    either: Float[np.ndarray | jax.Array, ""]
    steps: Int8[np.ndarray, "mode part"] = quantity("1")
    flags: Bool[np.ndarray, " mode"] | None = None
    draws: Float[np.ndarray, "draw mode"]
    name: str
    count: int
    share: float
    open: float = np.nan
    asked: bool = False
    evidence: float | None = None
    labels: tuple[str, ...] = ()
    notes: dict[str, Any] = field(default_factory=dict)
    rows: tuple[Row, ...] = ()
    remarks: tuple[Remark, ...] = ()
    inner: Inner
    another: Inner | None = None
    table: pd.DataFrame | None = None


def same(a: Any, b: Any) -> bool:
    """Whether two values are equal, with NaN equal to itself, and of the same type and dtype."""
    if is_dataclass(a):
        pairs = ((getattr(a, f.name), getattr(b, f.name)) for f in fields(a))
        return type(a) is type(b) and all(same(*pair) for pair in pairs)
    if isinstance(a, pd.DataFrame):
        pd.testing.assert_frame_equal(a, b)
        return True
    if isinstance(a, np.ndarray | jax.Array):
        a = np.asarray(a)
        return a.dtype == b.dtype and np.array_equal(a, b, equal_nan=a.dtype.kind == "f")
    if isinstance(a, tuple):
        return isinstance(b, tuple) and len(a) == len(b) and all(map(same, a, b))
    if isinstance(a, float) and np.isnan(a):
        return isinstance(b, float) and np.isnan(b)
    return type(a) is type(b) and a == b


# what netCDF holds as text, and JSON in it
words = st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=8)
numbers = st.floats(width=64)
whole = st.integers(-(2**40), 2**40)
sizes = st.integers(0, 3)
notes = st.dictionaries(words, st.none() | st.booleans() | whole | words | st.lists(whole))


def floats(*shape: int) -> st.SearchStrategy[np.ndarray]:
    return arrays(np.float64, shape, elements=numbers)


def inner(n: int) -> st.SearchStrategy[Inner]:
    return st.builds(Inner, floats(n), st.sampled_from(["good", "bad"]))


rows = st.builds(Row, words, whole, numbers, st.booleans())
# a column has values of one type
tables = st.integers(0, 3).flatmap(
    lambda n: st.fixed_dictionaries(
        {
            "unknown": st.lists(words, min_size=n, max_size=n),
            "first day": st.lists(whole, min_size=n, max_size=n),
            "value [K]": st.lists(numbers, min_size=n, max_size=n),
        }
    )
)


@st.composite
def everything(draw) -> Everything:
    n, part, n_draws = draw(sizes), draw(sizes), draw(sizes)
    small = arrays(np.int8, (n, part), elements=st.integers(-127, 127))
    columns = draw(st.none() | tables)
    return Everything(
        sky=draw(floats(n)),
        matrix=draw(floats(n, n)),
        either=draw(st.sampled_from([np.asarray, jnp.asarray]))(draw(st.floats(-9.0, 9.0))),
        steps=draw(small),
        flags=draw(st.none() | arrays(bool, n)),
        draws=draw(floats(n_draws, n)),
        name=draw(words),
        count=draw(whole),
        share=draw(numbers),
        asked=draw(st.booleans()),
        evidence=draw(st.none() | st.floats(allow_nan=False)),
        labels=tuple(draw(st.lists(words, max_size=3))),
        notes=draw(notes),
        rows=tuple(draw(st.lists(rows, max_size=3))),
        remarks=tuple(draw(st.lists(st.builds(Remark, words, st.none() | words), max_size=3))),
        inner=draw(inner(part)),
        another=draw(st.none() | inner(part)),
        table=columns and pd.DataFrame(columns),
    )


@given(everything())
@settings(max_examples=100, deadline=None)
def test_what_is_laid_out_comes_back(value):
    assert same(value, from_tree(Everything, to_tree(value), "a tree"))


@given(everything())
@settings(max_examples=25, deadline=None)
def test_what_is_written_comes_back(tmp_path_factory, value):
    path = tmp_path_factory.mktemp("trees") / "value.nc"
    to_tree(value).to_netcdf(path, engine="h5netcdf")
    with xr.open_datatree(path, engine="h5netcdf", decode_times=False) as tree:
        assert same(value, from_tree(Everything, tree, str(path)))
    with h5py.File(path) as file:
        assert same(value, from_tree(Everything, StoredTree(file), str(path)))


def example(**others: Any) -> Everything:
    given = {
        "sky": np.arange(4.0),
        "matrix": np.eye(4),
        "either": np.asarray(1.5),
        "steps": np.ones((4, 2), dtype=np.int8),
        "draws": np.zeros((3, 4)),
        "name": "a name",
        "count": 3,
        "share": 0.5,
        "inner": Inner(np.ones(2), "good"),
        "rows": (Row("first", 1, 2.0, True), Row("second", 2, np.nan, False)),
        "table": pd.DataFrame({"unknown": ["a", "b"], "value": [1.0, 2.0]}),
        "labels": ("one", "two"),
    }
    return Everything(**(given | others))


def test_a_file_is_one_that_others_can_read(tmp_path):
    """Named dimensions, units, attributes, groups and columns, as in any file of xarray's."""
    to_tree(example()).to_netcdf(tmp_path / "value.nc", engine="h5netcdf")
    with xr.open_datatree(tmp_path / "value.nc", engine="h5netcdf") as tree:
        assert tree["sky"].dims == ("mode",) and tree["matrix"].dims == ("mode", "mode_2")
        assert tree["sky"].attrs == {"units": "K", "long_name": "posterior mean"}
        assert tree["matrix"].attrs == {"units": "K2"} and tree["steps"].dtype == np.int8
        assert (tree.attrs["name"], tree.attrs["count"], tree.attrs["asked"]) == ("a name", 3, 0)
        assert "evidence" not in tree.attrs and "another" not in tree.children
        assert tree["inner"].attrs["level"] == "good"
        assert list(tree["rows"]["name"].values) == ["first", "second"]
        assert tree["rows"]["value"].dims == ("rows_row",)
        assert list(tree["table"]["unknown"].values) == ["a", "b"]


@dataclass(frozen=True)
class Sky:
    """Maps of two grids, and what is checked."""

    pixels: Float[np.ndarray, "pixel channel"] = quantity("K", "a map")
    coarse: Float[np.ndarray, " region"] = quantity("1")
    names: Shaped[np.ndarray, " channel"] = quantity("1", checks={"choices": ("auto", "cross")})
    mhz: Float[np.ndarray, " channel"] = quantity("MHz", checks={"grows": True, "unit": "MHz"})


FORMAT = "lusee_bayes example 1"


def sky(**others: Any) -> Sky:
    given = {"pixels": np.ones((192, 2)), "coarse": np.ones(12), "mhz": np.array([20.0, 30.0])}
    return Sky(**(given | {"names": np.array(["auto", "cross"])} | others))


def test_pixels_have_a_grid(tmp_path):
    """That of CF 1.13, of each resolution, which readers of the file do not need."""
    path = write_tree(tmp_path / "sky.nc", sky(), FORMAT, {"frame": "galactic"})
    require_conventions(path)
    with xr.open_dataset(path, engine="h5netcdf") as file:
        assert file.attrs["frame"] == "galactic"
        for name, n in (("pixels", 192), ("coarse", 12)):
            index = file[f"{file[name].dims[0]}_index"]
            assert index.attrs["standard_name"] == "healpix_index"
            np.testing.assert_array_equal(index, np.arange(n))
        assert "grid_mapping" not in file["mhz"].attrs
    with opened_tree(path, FORMAT, "a sky") as tree:
        assert same(sky(), from_tree(Sky, tree, str(path)))
    other = opened_tree(path, "lusee_bayes example 2", "a sky")
    refuse("format.*'lusee_bayes example 1'", other.__enter__)


NOT_AS_ASKED = [
    ({"names": np.array(["auto", "sum"])}, "names is 'sum'"),
    ({"mhz": np.array([30.0, 20.0])}, "mhz does not increase"),
    ({"mhz": np.array([20.0, np.nan])}, "mhz.*NaN"),
    ({"mhz": np.array([20e6, 30e6])}, "is this Hz"),
]


@pytest.mark.parametrize(("changes", "words"), NOT_AS_ASKED)
def test_what_fields_ask_for_is_checked(changes, words):
    refuse(words, from_tree, Sky, to_tree(sky(**changes)), "a file")


def test_what_is_absent_has_its_default():
    """As in a file of a version that did not have the field yet."""
    tree = to_tree(example())
    for name in ("labels", "notes", "open", "remarks"):
        del tree.attrs[name]
    del tree["rows"], tree["table"]
    assert same(example(labels=(), rows=(), table=None), from_tree(Everything, tree, "a file"))


def without(tree: xr.DataTree, name: str) -> None:
    if name in tree.attrs:
        del tree.attrs[name]
    else:
        del tree[name]


def put(tree: xr.DataTree, name: str, array: np.ndarray, *dims: str) -> None:
    tree.dataset = tree.to_dataset().drop_vars(name).assign({name: (dims, array)})


DAMAGED = [
    (lambda t: without(t, "name"), "a file has no name (it has "),
    (lambda t: without(t, "sky"), "a file has no sky (it has "),
    (lambda t: without(t, "inner"), "a file has no inner (it has "),
    (lambda t: without(t["inner"], "level"), "a file: inner has no level"),
    (lambda t: t.attrs.update(count="many"), "count is 'many', expected"),
    (lambda t: t.attrs.update(count=2.5), "count is 2.5, expected a whole number"),
    (lambda t: t.attrs.update(count=np.nan), "count is nan, expected"),
    (lambda t: t.attrs.update(share=np.ones(2)), "expected a number"),
    (lambda t: t.attrs.update(name=3), "name is 3, expected text"),
    (lambda t: t.attrs.update(labels="{one"), "labels is '{one', expected JSON"),
    (lambda t: t.attrs.update(labels="[1, 2]"), "labels is '[1, 2]': Input should be a valid str"),
    (lambda t: t.attrs.update(notes="[]"), "notes is '[]': Input should be a valid dict"),
    (lambda t: t.attrs.update(notes=5), "notes is 5, expected text"),
    (lambda t: put(t, "sky", np.ones((4, 4)), "mode", "mode_2"), "sky has shape (4, 4), expected"),
    (lambda t: put(t, "draws", np.ones((3, 5)), "draw", "other"), "expected draw x 4 (mode)"),
    (lambda t: put(t, "sky", np.ones(4, dtype=complex), "mode"), "sky has .* complex128, expe"),
    (lambda t: put(t, "steps", np.ones((4, 2)), "mode", "part"), "steps has .* float64, expec"),
    (lambda t: without(t["rows"], "n"), "a file: rows has no n (it has "),
    (lambda t: put(t["rows"], "n", np.array(["a", "b"]), "rows_row"), "rows: n has .* <U1, exp"),
    (lambda t: without(t["table"], "value"), "a file: table has no column value (it has "),
    (lambda t: t["table"].attrs.update(columns="x"), "table is 'x', expected JSON"),
]


@pytest.mark.parametrize(("damage", "words"), DAMAGED)
def test_what_is_damaged_is_told_in_a_sentence(damage, words):
    tree = to_tree(example())
    damage(tree)
    refuse(words, from_tree, Everything, tree, "a file")
