"""Whether HDF5's library can read a file: tried in a process of its own, with a time limit.

On damaged metadata the library may run for ever, or end the process, and nothing in Python can
interrupt it.
"""

from __future__ import annotations

import faulthandler
import os
import signal
import sys
import time
import warnings
from functools import lru_cache
from pathlib import Path

import h5py

from lusee_bayes.core.errors import InputError

# a file is read whole up to this size; of a larger one, all metadata and the first value of each
# array
WHOLE_BYTES = 200_000_000
# a whole file of that size takes less than a tenth of it
LIMIT_S = 20.0


def require_readable_hdf5(path: Path) -> None:
    """Check that HDF5's library comes to an end with a file. What it raises is left to the reader.

    Raises
    ------
    InputError
        If it does not within ``LIMIT_S``, or if it ends the process.
    """
    status = path.stat()
    _probe(str(path), status.st_mtime_ns, status.st_size)


@lru_cache(maxsize=64)
def _probe(path: str, mtime_ns: int, size: int) -> None:
    # a process of macOS may not go on behind a fork
    if sys.platform != "linux":
        return
    with warnings.catch_warnings():
        # of threads that are not copied: the child needs none of them
        warnings.simplefilter("ignore")
        child = os.fork()
    if child == 0:
        _read_all(path, size)
    limit, status = time.monotonic() + LIMIT_S, 0
    pause = 1e-3
    while True:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            break
        if time.monotonic() > limit:
            os.kill(child, signal.SIGKILL)
            os.waitpid(child, 0)
            raise InputError(
                f"{path} is damaged: HDF5's library does not come to an end with it within "
                f"{LIMIT_S:g} s"
            )
        time.sleep(pause)
        pause = min(2 * pause, 0.05)
    if os.WIFSIGNALED(status):
        raise InputError(f"{path} is damaged: HDF5's library fails on it")


def _read_all(path: str, size: int) -> None:
    """In the child: read, and leave without a word."""
    try:
        # whatever it prints is of no use
        faulthandler.disable()
        os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
        with h5py.File(path) as file:
            _read(file, size)
            file.visititems(lambda _, item: _read(item, size))
    finally:
        os._exit(0)


def _read(item: h5py.Group | h5py.Dataset, size: int) -> None:
    for name in item.attrs:
        try:
            item.attrs[name]
        except (OSError, KeyError, RuntimeError, ValueError, TypeError):
            continue  # the reader says it
    if isinstance(item, h5py.Dataset) and item.size:
        whole = size <= WHOLE_BYTES and item.size * item.dtype.itemsize <= 5 * WHOLE_BYTES
        try:
            item[()] if whole or not item.shape else item[(0,) * len(item.shape)]
        except (OSError, KeyError, RuntimeError, ValueError, TypeError, MemoryError):
            return
