"""Declared layouts: what is not as declared is said, and what is comes back in its own kind."""

import h5py
import numpy as np
import pytest

from lusee_bayes.core import layouts
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.layouts import Attribute, Layout, Variable
from lusee_bayes.core.reading import read_arrays, read_json, read_table, require_file

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
    found = {
        "times": np.arange(3.0),
        "data": np.ones((3, 2), dtype=np.float32),
        "names": np.array(["a", "b"]),
    }
    return {name: v for name, v in (found | changes).items() if v is not None}


def test_what_is_declared_comes_back_in_its_kind():
    found = LAYOUT.checked("x", arrays(flags=np.array([0, 1, 0])), {"step": np.float32(2)})
    assert found.arrays["data"].dtype == np.float64 and found.arrays["flags"].dtype == bool
    assert found.values == {"step": 2.0} and found.sizes == {"time": 3, "product": 2}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"times": None}, "x: .*no times|x has no times"),
        ({"data": np.ones((2, 2))}, r"data has shape \(2, 2\), expected 3"),
        ({"data": np.ones(3)}, r"data has shape \(3,\)"),
        ({"data": np.full((3, 2), np.nan)}, "data holds"),
        ({"data": -np.ones((3, 2))}, "data"),
        ({"data": np.array([["a", "b"]] * 3)}, "data"),
        ({"data": np.ones((3, 2), dtype=complex)}, "data"),
        ({"times": np.array([0.0, 2.0, 1.0])}, "times"),
        ({"names": np.array(["a", "z"])}, "names"),
        ({"flags": np.array([0, 1, 2])}, "flags"),
    ],
)
def test_what_is_not_as_declared_is_said(changes, message):
    with pytest.raises(InputError, match=message):
        LAYOUT.checked("x", arrays(**changes), {"step": 2.0})


@pytest.mark.parametrize(
    "step", ["two", np.nan, 0.0, [1.0, 2.0], [[1], [1, 2]], None, True, 10**400]
)
def test_attributes_are_checked(step):
    with pytest.raises(InputError, match="step"):
        LAYOUT.checked("x", arrays(), {} if step is None else {"step": step})


def test_what_no_memory_holds_is_not_read(tmp_path, monkeypatch):
    """1.2 TiB that a file declares without holding them."""
    monkeypatch.setattr(layouts, "memory_limit", lambda: 10**9)
    with h5py.File(tmp_path / "x.h5", "w") as file:
        huge = file.create_dataset("data", shape=(400_000, 400_000), dtype="f8", chunks=True)
        with pytest.raises(InputError, match=r"holds 1,280 GB of numbers; this machine has 1 GB"):
            Layout("an example", {"data": Variable(("time", "product"))}).checked(
                "x", {"data": huge}, {}
            )


def test_pipes_and_folders_are_no_files(tmp_path):
    import os

    os.mkfifo(tmp_path / "pipe")
    for path, message in ((tmp_path / "pipe", "neither a file"), (tmp_path, "is a folder")):
        with pytest.raises(InputError, match=message):
            require_file(path, "an example")


def test_tables_objects_and_arrays(tmp_path):
    (tmp_path / "t.csv").write_text("ell,name\n0,a\n1,b\n")
    table = Layout("a table", {"ell": Variable(("row",)), "name": Variable(("row",), "text")})
    np.testing.assert_array_equal(read_table(tmp_path / "t.csv", table)["ell"], [0.0, 1.0])
    (tmp_path / "t.csv").write_text("ell,name\n0,a\n1\n")
    with pytest.raises(InputError, match="line 3 has 1 entries for 2 columns"):
        read_table(tmp_path / "t.csv", table)
    (tmp_path / "o.json").write_text("[1]")
    with pytest.raises(InputError, match="holds a list"):
        read_json(tmp_path / "o.json", Layout("an object"))
    np.save(tmp_path / "a.npz", np.ones(3))
    with pytest.raises(InputError, match="a.npz"):
        read_arrays(tmp_path / "a.npz.npy", Layout("arrays"))
