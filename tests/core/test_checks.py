"""Bad input is refused with one sentence that says what, where and what to do.

And what objects say of themselves: few lines with shapes, units, frequency and dates.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from assertions import refuse

import lusee_bayes as lb
from lusee_bayes.core import checks
from lusee_bayes.core.checks import require_finite, require_float64, require_positive, require_shape

NO_FLOATS = [
    (np.ones(3, dtype=np.float32), "an array of float32"),
    (np.ones(3, dtype=np.int64), "an array of int64"),
    (np.ones(3, dtype=np.complex128), "an array of complex128"),
    (np.ones(3, dtype=bool), "an array of bool"),
    ([1.0], "a list"),
    (1.0, "a float"),
]


@pytest.mark.parametrize(("value", "got"), NO_FLOATS, ids=str)
def test_only_arrays_of_float64_are_accepted(value, got):
    refuse(f"the beam must be a float64 array, got {got}", require_float64, "the beam", value)
    for right in (np.ones(2), jnp.ones(2), np.float64(1.0)):
        require_float64("x", right)


OTHER_SHAPES = [((3, 5), "(3, 5)"), ((None,), "(any,)"), ((3, 4, None), "(3, 4, any)"), ((), "()")]


@pytest.mark.parametrize(("shape", "said"), OTHER_SHAPES)
def test_other_shapes_are_refused_with_both_shapes(shape, said):
    refuse(f"x has shape (3, 4), expected {said}", require_shape, "x", np.ones((3, 4)), shape)
    for right in ((3, 4), (None, 4), (3, None), (None, None)):
        require_shape("x", np.ones((3, 4)), right)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_non_finite_entries_are_counted_and_the_first_three_located(bad):
    x = np.ones((2, 5))
    x[1, 3] = x[1, 4] = bad
    refuse("x: NaN or infinity (2 of 10 entries, first at (1, 3), (1, 4))", require_finite, "x", x)
    refuse(r"5 of 5.*\(0,\), \(1,\), \(2,\)\)", require_finite, "x", np.full(5, bad))


@pytest.mark.parametrize("bad", [0.0, -1.0, np.nan, np.inf])
def test_positive_refuses_zero_negative_and_non_finite(bad):
    words = f"step must be positive, got {bad}; in seconds"
    refuse(words, require_positive, "step", bad, "in seconds")
    words = r"step must be positive, fails at 1 of 3 entries, .*\(2,\)"
    refuse(words, require_positive, "step", np.array([1.0, 2.0, bad]))


def test_inside_a_transformation_values_pass_and_dtypes_do_not():
    seen = []

    @jax.jit
    def f(x):
        seen.append(checks.is_traced(1.0, x))
        require_finite("x", x)
        require_positive("x", x)
        require_shape("x", x, (2,))
        require_float64("x", x)
        return x

    f(jnp.array([-1.0, jnp.nan]))
    assert seen == [True]
    assert not checks.is_traced(jnp.ones(2), 1.0)
    refuse("float32", f, jnp.ones(2, dtype=jnp.float32))


def test_objects_say_what_they_are(small_map, small_cube):
    experiment = lb.build(small_map.result.scenario)
    inference, setup, result = lb.infer(experiment), experiment.setup, small_map.result
    n_data = f"{experiment.data.layout.size} data"
    assert "3 independent channels, 20 to 30 MHz" in repr(small_cube.result)
    for thing, words in [
        (experiment.data, ["16 products", "25 MHz", "K", "00R, 01R", "2027-01-15"]),
        (setup.observation, ["182.258", "7200 s", "0, 30 degrees"]),
        (setup.beams, ["16 products", "25 MHz", "lmax = 8", "81 real"]),
        (setup.sky, ["embedded Galaxy", "25 MHz", "lmax = 8", " K"]),
        (setup.coupling, ["81 unknowns", n_data]),
        (inference.model.noise, ["K^2", n_data]),
        (inference.model, ["d = A m + n", "HarmonicPrior"]),
        (inference.posterior, ["81 unknowns", "ln evidence", "bits"]),
        (result.channel, ["25 MHz", "NSIDE", "mean", " K"]),
        (result, ["25 MHz", "chi2", "bits"]),
    ]:
        text = repr(thing)
        assert text.startswith(type(thing).__name__)
        assert all(word in text for word in words), text
        # five of data with their observation, and one more of an experiment
        assert 1 <= len(text.splitlines()) <= 6
        assert max(map(len, text.splitlines())) <= 120


def test_what_is_traced_has_a_representation():
    seen = []

    def look(modes):
        seen.append(repr(lb.Sky(modes, 25.0)) + repr(lb.HarmonicPrior(modes[:2])))
        return modes

    jax.eval_shape(look, jnp.ones(4))
    assert "traced" in seen[0] and "1.00" not in seen[0]
