"""How near arrays have to be to what is expected, in one line."""

from __future__ import annotations

import numpy as np


def close(got: object, expected: object, relative: float) -> None:
    """Assert that arrays agree to a part of the largest expected entry."""
    largest = np.abs(np.asarray(expected)).max()
    np.testing.assert_allclose(got, expected, rtol=0, atol=relative * largest)


def within(got: object, expected: object, atol: object) -> None:
    """Assert that arrays agree to so much, whatever their size."""
    np.testing.assert_allclose(got, expected, rtol=0, atol=atol)
