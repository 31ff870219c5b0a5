"""Files on which HDF5's library runs for ever, or dies, are refused."""

import faulthandler
import os
import time

import h5py
import numpy as np
import pytest

from lusee_bayes.core import formats
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.formats import require_readable_hdf5


@pytest.fixture
def path(tmp_path):
    with h5py.File(tmp_path / "x.h5", "w") as file:
        file["data"] = np.arange(1000.0)
        file["data"].attrs["unit"] = "K"
    return tmp_path / "x.h5"


def test_a_whole_file_is_readable(path):
    require_readable_hdf5(path)


def test_a_file_without_end_is_refused(path, monkeypatch):
    monkeypatch.setattr(formats, "LIMIT_S", 0.2)
    monkeypatch.setattr(formats, "_read_all", lambda path, size: time.sleep(60))
    start = time.monotonic()
    with pytest.raises(InputError, match="does not come to an end with it within 0.2 s"):
        require_readable_hdf5(path)
    assert time.monotonic() - start < 30


def test_a_file_that_ends_the_process_is_refused(path, monkeypatch):
    def end(path, size):
        faulthandler.disable()  # of pytest, which would print where
        os.abort()

    monkeypatch.setattr(formats, "_read_all", end)
    with pytest.raises(InputError, match="HDF5's library fails on it"):
        require_readable_hdf5(path)
