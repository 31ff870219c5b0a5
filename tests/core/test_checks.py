"""Bad input is refused with one sentence that says what, where and what to do."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lusee_bayes.core.checks import (
    is_traced,
    require_finite,
    require_float64,
    require_positive,
    require_shape,
)
from lusee_bayes.core.errors import InputError, nearest


@pytest.mark.parametrize("dtype", [np.float32, np.int64, np.complex128, bool])
def test_only_float64_is_accepted(dtype):
    name = np.dtype(dtype).name
    with pytest.raises(
        InputError, match=rf"the beam must be a float64 array, got an array of {name}"
    ):
        require_float64("the beam", np.ones(3, dtype=dtype))


def test_what_is_no_array_is_refused_by_its_type():
    with pytest.raises(InputError, match="must be a float64 array, got a list"):
        require_float64("x", [1.0])
    with pytest.raises(InputError, match="got a float"):
        require_float64("x", 1.0)


@pytest.mark.parametrize("array", [np.ones(2), jnp.ones(2), np.float64(1.0)])
def test_float64_passes(array):
    require_float64("x", array)


@pytest.mark.parametrize("shape", [(3, 4), (None, 4), (3, None), (None, None)])
def test_fitting_shapes_pass(shape):
    require_shape("x", np.ones((3, 4)), shape)


@pytest.mark.parametrize(
    ("shape", "said"),
    [
        ((3, 5), r"\(3, 5\)"),
        ((None,), r"\(any,\)"),
        ((3, 4, None), r"\(3, 4, any\)"),
        ((), r"\(\)"),
    ],
)
def test_other_shapes_are_refused_with_both_shapes(shape, said):
    with pytest.raises(InputError, match=rf"x has shape \(3, 4\), expected {said}"):
        require_shape("x", np.ones((3, 4)), shape)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_non_finite_entries_are_counted_and_located(bad):
    x = np.ones((2, 5))
    x[1, 3] = x[1, 4] = bad
    with pytest.raises(
        InputError,
        match=r"x holds NaN or infinity \(2 of 10 entries, first at \(1, 3\), \(1, 4\)\)",
    ):
        require_finite("x", x)


def test_at_most_three_offenders_are_listed():
    with pytest.raises(InputError, match=r"5 of 5 entries, first at \(0,\), \(1,\), \(2,\)\)"):
        require_finite("x", np.full(5, np.nan))


@pytest.mark.parametrize("bad", [0.0, -1.0, np.nan, np.inf])
def test_positive_refuses_zero_negative_and_non_finite(bad):
    with pytest.raises(InputError, match=rf"step must be positive, got {bad}; in seconds"):
        require_positive("step", bad, "in seconds")
    with pytest.raises(
        InputError, match=r"step must be positive, fails at 1 of 3 entries, .*\(2,\)"
    ):
        require_positive("step", np.array([1.0, 2.0, bad]))


def test_inside_a_transformation_values_pass_and_dtypes_do_not():
    seen = []

    @jax.jit
    def f(x):
        seen.append(is_traced(1.0, x))
        require_finite("x", x)
        require_positive("x", x)
        require_shape("x", x, (2,))
        require_float64("x", x)
        return x

    f(jnp.array([-1.0, jnp.nan]))
    assert seen == [True]
    assert not is_traced(jnp.ones(2), 1.0)
    with pytest.raises(InputError, match="float32"):
        f(jnp.ones(2, dtype=jnp.float32))


def test_nearest_names_the_close_one_or_all():
    assert nearest("papr", ["paper", "exact"]) == "did you mean 'paper'?"
    assert nearest("zzz", ["paper", "exact"]) == "known: exact, paper"
