"""Assertions that the tests share."""

import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager

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
