"""Assertions that the tests share."""

import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import astropy.units as u
import numpy as np
import pytest
import xarray as xr

from lusee_bayes.core.errors import InputError


def close(got: object, expected: object, relative: float) -> None:
    """Assert that arrays agree to a part of the largest expected entry."""
    largest = np.abs(np.asarray(expected)).max()
    np.testing.assert_allclose(got, expected, rtol=0, atol=relative * largest)


def off(got: object, expected: object) -> float:
    """The largest difference, as a part of the largest expected entry."""
    return np.abs(got - expected).max() / np.abs(expected).max()


def assert_same_map(got: object, expected: object, sigma: float) -> None:
    """Assert that means agree to ``sigma`` standard deviations, and these to that part."""
    (mean, std), (other, width) = (_moments(one) for one in (got, expected))
    assert (np.abs(mean - other) / width).max() < sigma
    np.testing.assert_allclose(std, width, rtol=sigma)


def _moments(of: object) -> list[np.ndarray]:
    """Mean and standard deviation of a posterior, a channel or a file."""
    if isinstance(of, xr.Dataset | xr.DataTree):
        return [of[name].values for name in ("mean", "std")]
    return [np.asarray(of.mean), np.asarray(of.std() if callable(of.std) else of.std)]


def within(got: object, expected: object, atol: object) -> None:
    """Assert that arrays agree to so much, whatever their size."""
    np.testing.assert_allclose(got, expected, rtol=0, atol=atol)


def assert_same(got: object, expected: object, *names: str) -> None:
    """Assert that these attributes are the same arrays."""
    for name in names:
        np.testing.assert_array_equal(getattr(got, name), getattr(expected, name), name)


def failed(found: object) -> set[str]:
    """The checks that draws have not passed."""
    return {check.name for check in found.checks if not check.passed}


def require_conventions(path: Path) -> None:
    """Assert that a file follows CF: its name for it, units that are some, and grids of pixels."""
    with xr.open_datatree(path, engine="h5netcdf", decode_cf=False) as tree:
        assert tree.attrs["Conventions"] == "CF-1.13" and tree.attrs["format"]
        for group in tree.subtree:
            variables = {str(name): variable for name, variable in group.variables.items()}
            bounds = {variable.attrs.get("bounds") for variable in variables.values()}
            for name, variable in variables.items():
                said = variable.attrs
                # columns of tables have words for their units, bounds the units of their variable
                if variable.dtype.kind in "fc" and "columns" not in group.attrs:
                    assert "units" in said or name in bounds, f"{path}{group.path}: {name}"
                unit, _, epoch = said.get("units", "1").partition(" since ")
                u.Unit(unit.removesuffix("s") if epoch else unit)
                pixels = {"pixel", "pixels", "region"} & set(variable.dims)
                if pixels and said.get("standard_name") != "healpix_index":
                    grid, n = variables[said["grid_mapping"]].attrs, variable.sizes[pixels.pop()]
                    assert grid["grid_mapping_name"] == "healpix"
                    assert grid["indexing_scheme"] == "ring"
                    assert n == 12 * 4 ** grid["refinement_level"]


def raising(error: BaseException) -> Callable[..., None]:
    """What fails with this error, whatever it is called with."""

    def fail(*_, **__):
        raise error

    return fail


@contextmanager
def refused(words: str) -> Iterator[pytest.ExceptionInfo[InputError]]:
    """Assert that input is refused in one sentence that has these words, or their pattern."""
    with pytest.raises(InputError) as caught:
        yield caught
    text = str(caught.value)
    assert words in text or re.search(words, text), text
    assert "\n" not in text and "Traceback" not in text and "pydantic" not in text


def refuse(words: str, call: Callable[..., object], *arguments: object, **options: object) -> None:
    """Assert that a call is refused so."""
    with refused(words):
        call(*arguments, **options)
