"""The spectra of a session as they lie in files: pieces of rows, chunks of HDF5."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from jaxtyping import Float32

from lusee_bayes.core.errors import InputError
from lusee_bayes.instrument.flight.spectrometer import FLIGHT_PRODUCTS, N_CHANNELS

N_PRODUCTS = len(FLIGHT_PRODUCTS)
# luseepy lets h5py choose its chunks, which for a long session hold a thousand spectra of few
# channels. Unless all chunks of these spectra are kept, each is decompressed again for every slab
LARGEST_CACHE = 1 << 29
# two chunks must not compete for one place, which makes for many more places than chunks
PLACES = 1_000_003


def cache_for(chunks: tuple[int, ...] | None) -> dict[str, Any]:
    """Return what :class:`h5py.File` has to be told, to read or write spectra piece by piece.

    Parameters
    ----------
    chunks : (rows, products, channels) or None
        None for a dataset without chunks.
    """
    if chunks is None:
        return {}
    spectra = chunks[0] * N_PRODUCTS * (N_CHANNELS + chunks[2]) * 4
    size = min(int(1.25 * spectra), LARGEST_CACHE)
    return {"rdcc_nbytes": max(size, 1 << 20), "rdcc_nslots": PLACES, "rdcc_w0": 1.0}


def guessed_chunks(n_rows: int) -> tuple[int, ...]:
    """Return the chunks that h5py chooses for the spectra of a session."""
    with h5py.File("guess", "w", driver="core", backing_store=False) as file:
        cube = file.create_dataset("data", (n_rows, N_PRODUCTS, N_CHANNELS), "f4", chunks=True)
        return cube.chunks


def whole_spectra(
    path: Path, blocks: Iterable[Float32[np.ndarray, "_ products _"]], n_rows: int
) -> Iterator[tuple[int, Float32[np.ndarray, "_ products channels"]]]:
    """Yield the first row and the counts of every block, with all 2048 channels.

    Raises
    ------
    InputError
        If there are more or fewer rows than the session has, or other products.
    """
    first = 0
    for block in blocks:
        n, products, bins = block.shape
        if products != N_PRODUCTS or bins > N_CHANNELS or first + n > n_rows:
            raise InputError(
                f"{path}: rows {first} to {first + n} have the shape {block.shape}, expected at "
                f"most {n_rows - first} rows of {N_PRODUCTS} products and {N_CHANNELS} channels"
            )
        full = np.full((n, products, N_CHANNELS), np.nan, dtype=np.float32)
        full[..., :bins] = block
        yield first, full
        first += n
    if first != n_rows:
        raise InputError(f"{path}: there are counts of {first} spectra for {n_rows} rows")
