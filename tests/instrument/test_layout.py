import jax.numpy as jnp
import numpy as np
import pytest

from lusee_bayes.core.errors import InputError
from lusee_bayes.instrument.layout import DataLayout

FLAGS = np.zeros((3, 5), dtype=bool)
FLAGS[0, 1] = FLAGS[2, 4] = True
FLAGS[:, 3] = True


def test_a_complete_layout_runs_over_time_fastest():
    layout = DataLayout(3, 5)
    assert layout.size == 15
    grid = np.arange(15.0).reshape(3, 5)
    d = layout.gather(jnp.asarray(grid))
    for k, value in enumerate(np.asarray(d)):
        assert grid[layout.product[k], layout.time[k]] == value
    np.testing.assert_array_equal(layout.product, np.repeat([0, 1, 2], 5))
    np.testing.assert_array_equal(layout.time, np.tile(np.arange(5), 3))
    assert np.asarray(layout.present).all()


def test_flagged_samples_are_not_in_the_data():
    layout = DataLayout.from_flags(FLAGS)
    # the positions by a loop in the order of d
    expected = [(p, t) for p in range(3) for t in range(5) if not FLAGS[p, t]]
    assert list(zip(layout.product, layout.time, strict=True)) == expected
    assert layout.size == len(expected) == 10
    np.testing.assert_array_equal(layout.present, ~FLAGS)
    grid = np.random.default_rng(0).standard_normal((3, 5))
    np.testing.assert_array_equal(layout.gather(jnp.asarray(grid)), [grid[e] for e in expected])


def test_no_flag_is_the_complete_layout():
    assert DataLayout.from_flags(np.zeros((3, 5), dtype=bool)).index is None


@pytest.mark.parametrize("rest", [(), (2,)])
@pytest.mark.parametrize("flags", [None, FLAGS])
def test_scatter_is_the_transpose_of_gather(flags, rest):
    layout = DataLayout(3, 5) if flags is None else DataLayout.from_flags(flags)
    rng = np.random.default_rng(1)
    grid = rng.standard_normal((3, 5, *rest))
    data = rng.standard_normal((layout.size, *rest))
    left = np.sum(np.asarray(layout.gather(jnp.asarray(grid))) * data)
    back = np.asarray(layout.scatter(jnp.asarray(data)))
    # sums of fifteen products of order one
    np.testing.assert_allclose(np.sum(grid * back), left, rtol=0, atol=1e-13)
    np.testing.assert_array_equal(layout.gather(jnp.asarray(back)), data)
    if flags is not None:
        assert not back[flags].any()


def test_nothing_left_is_an_error():
    with pytest.raises(InputError, match="all 15 samples are flagged"):
        DataLayout.from_flags(np.ones((3, 5), dtype=bool))
