import jax.numpy as jnp
import numpy as np
import pytest
from closeness import close

from lusee_bayes.instrument.products import (
    Product,
    all_products,
    auto_indices,
    labels,
    to_matrix,
    to_real,
)

# the order luseepy writes its waterfalls in
LUSEEPY = ["00R", "01R", "01I", "02R", "02I", "03R", "03I", "11R"]
LUSEEPY += ["12R", "12I", "13R", "13I", "22R", "23R", "23I", "33R"]


def hermitian(rng, n, *rest):
    """<s conj(s)> of a few random voltages, antennas on the first two axes."""
    s = rng.standard_normal((n, 5, *rest)) + 1j * rng.standard_normal((n, 5, *rest))
    return np.einsum("ik...,jk...->ij...", s, s.conj())


def test_labels_are_those_of_luseepy():
    assert list(labels()) == LUSEEPY
    assert all_products()[4] == Product(0, 2, "I")
    assert [LUSEEPY[k] for k in auto_indices()] == ["00R", "11R", "22R", "33R"]


@pytest.mark.parametrize("n", [1, 2, 3, 4])
def test_every_real_number_of_a_hermitian_matrix_appears_once(n):
    assert len(set(labels(n))) == len(labels(n)) == n * n
    assert all(p.i <= p.j and (p.part == "R" or p.i < p.j) for p in all_products(n))


def test_each_product_is_the_entry_its_label_names():
    v = hermitian(np.random.default_rng(1), 4)
    got = to_real(jnp.asarray(v))
    for label, value in zip(LUSEEPY, got, strict=True):
        entry = v[int(label[0]), int(label[1])]
        assert value == (entry.real if label[2] == "R" else entry.imag)


@pytest.mark.parametrize("rest", [(), (3,), (3, 2)])
@pytest.mark.parametrize("n", [1, 2, 4])
def test_matrix_and_products_are_inverse(n, rest):
    v = hermitian(np.random.default_rng(2), n, *rest)
    products = to_real(jnp.asarray(v))
    assert products.shape == (n * n, *rest)
    back = np.asarray(to_matrix(products))
    # a copy of numbers: exact, except that autos lose an imaginary rounding error
    close(back, v, 1e-14)
    np.testing.assert_array_equal(back, back.conj().swapaxes(0, 1))
    np.testing.assert_array_equal(to_real(jnp.asarray(back)), products)
