"""Linear algebra: LAPACK for NumPy arrays; for JAX arrays, cheaper than XLA's own routines.

XLA has no symmetric rank-k update on the CPU: ``W.T @ W`` computes both triangles. Splitting the
columns and forming only the blocks on and below the diagonal does 5/8 of the work.

SciPy's wrappers of LAPACK keep the interpreter's lock while they compute, so that channels in two
threads would wait for each other. We call the same routines in :mod:`scipy.linalg.cython_lapack`
through ctypes, which releases the lock. The lower triangle of an array in C order is the upper
triangle for LAPACK.
"""

import ctypes
from collections.abc import Callable, Iterator
from functools import lru_cache
from itertools import pairwise
from math import ceil, log2

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int
from scipy.linalg import cython_blas, cython_lapack

from lusee_bayes.core.arrays import Array, Square, namespace
from lusee_bayes.core.checks import is_traced, require_float64
from lusee_bayes.core.errors import InputError

Matrix = Float[Array, "n n"]
# a matrix or a stack of matrices, and right-hand sides for them
Matrices = Float[Array, "*batch n n"]
Columns = Float[Array, "*batch n columns"]
Tall = Float[Array, "rows n"]


@lru_cache
def _routine(name: str) -> Callable[..., None]:
    """A LAPACK or BLAS routine; all its arguments are pointers."""
    module = cython_lapack if name in cython_lapack.__pyx_capi__ else cython_blas
    capsule = module.__pyx_capi__[name]
    name_of = ctypes.PYFUNCTYPE(ctypes.c_char_p, ctypes.py_object)
    pointer_of = ctypes.PYFUNCTYPE(ctypes.c_void_p, ctypes.py_object, ctypes.c_char_p)
    declared = name_of(("PyCapsule_GetName", ctypes.pythonapi))(capsule)
    address = pointer_of(("PyCapsule_GetPointer", ctypes.pythonapi))(capsule, declared)
    return ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * declared.count(b"*"))(address)


def _called(name: str, *arguments: bytes | int | float | np.ndarray | ctypes.Array) -> int:
    """Call a routine with all arguments except info, and return info; arrays are overwritten."""
    routine, info, pointers = _routine(name), ctypes.c_int(0), []
    for argument in arguments:
        if isinstance(argument, np.ndarray):
            require_float64("the matrix", argument)
            pointers.append(argument.ctypes.data)
        elif isinstance(argument, bytes | ctypes.Array):
            pointers.append(argument)
        else:
            kind = ctypes.c_int if isinstance(argument, int) else ctypes.c_double
            pointers.append(ctypes.byref(kind(argument)))
    routine(*pointers, *[ctypes.byref(info)] * (len(routine.argtypes) - len(pointers)))
    return info.value


# strips into which a triangle is split. For W^T W at 5232 x 2304 on two cores, 4 strips take
# 0.40 s and one product 0.49 s; recursive halving takes 0.35 s, but 0.1 GB more memory
N_BLOCKS = 4

# rows of a lower triangle to mirror at once
MIRRORED = 128

# rows to permute at once
PERMUTED = 64

# error of combinations of a few rows of a matrix, relative to its largest row
SPANNED = 1e-12

# share of the trace to be left out, for columns of a matrix that are not considered
SCREENED = 0.01


def cholesky(matrix: Matrices, *, overwrite: bool = False) -> Matrices:
    """Return the lower Cholesky factor, NaN if there is none; read only the lower triangle.

    With ``overwrite``, it replaces a NumPy matrix in memory.
    """
    if namespace(matrix) is np:
        if matrix.ndim > 2:
            return np.stack([cholesky(block) for block in matrix])
        lower = np.ascontiguousarray(matrix) if overwrite else matrix.copy(order="C")
        if _called("dpotrf", b"U", len(lower), lower, max(1, len(lower))) != 0:
            return np.full(matrix.shape, np.nan)
        return lower_triangle(lower, overwrite=True)
    return jax.lax.linalg.cholesky(matrix, symmetrize_input=False)


def lower_triangle(matrix: Square, *, overwrite: bool = False) -> Square:
    """Return a matrix with zeros above the diagonal, in less than half the time of ``np.tril``."""
    lower = matrix if overwrite else matrix.copy(order="C")
    for row in range(len(lower)):
        lower[row, row + 1 :] = 0.0
    return lower


def checked_cholesky(name: str, matrix: Matrices) -> Matrices:
    """Return the lower Cholesky factor of a matrix, or of every matrix of a stack.

    Parameters
    ----------
    name : str
        Name of the matrix, for the error message.
    matrix : (..., n, n) array
        Symmetric; only the lower triangle is read.

    Returns
    -------
    (..., n, n) array

    Raises
    ------
    InputError
        If a matrix is not positive definite; the message gives its lowest eigenvalue. Inside a JAX
        transformation, the factor contains NaN instead.
    """
    lower = cholesky(matrix)
    if not is_traced(lower) and not np.isfinite(np.asarray(lower)).all():
        largest = float(np.abs(np.asarray(matrix)).max())
        if not np.isfinite(largest):
            raise InputError(f"{name} contains NaN or infinity: its terms are too large")
        lowest = float(np.linalg.eigvalsh(np.asarray(matrix)).min())
        raise InputError(
            f"{name} is not positive definite: its lowest eigenvalue is {lowest:.3g} "
            f"(largest entry {largest:.3g}); check the term's amplitude and symmetry"
        )
    return lower


def solve_lower(lower: Matrices, x: Columns, *, transpose: bool) -> Columns:
    """Return L^-1 x, or L^-T x with ``transpose``, for lower triangular L."""
    if namespace(lower, x) is np:
        if lower.ndim > 2:
            return np.linalg.solve(lower.swapaxes(-1, -2) if transpose else lower, x)
        lower, solved = np.ascontiguousarray(lower), np.array(x, order="F")
        letters, one = (b"L", b"U", b"N" if transpose else b"T", b"N"), max(1, len(lower))
        _called("dtrsm", *letters, *solved.shape, 1.0, lower, one, solved, one)
        return solved
    sides = {"left_side": True, "lower": True, "transpose_a": transpose}
    return jax.lax.linalg.triangular_solve(lower, x, **sides)


def gram_matrix(w: Float[Array, "rows columns"]) -> Float[Array, "columns columns"]:
    """Return W^T W, symmetric to the last bit."""
    return w.T @ w if namespace(w) is np else symmetric_product(w.T, w)


def symmetric_product(left: Float[Array, "n inner"], right: Float[Array, "inner n"]) -> Matrix:
    """Return the product of two matrices whose product is symmetric.

    Only the lower triangle is computed, so the result is symmetric to the last bit.
    """
    n = right.shape[1]
    if namespace(left, right) is np:
        product = np.empty((n, n))
        for first, end in _strips(n):
            np.matmul(left[first:end], right[:, :end], out=product[first:end, :end])
        return mirrored(product)
    # the symmetric matrix with these strips of rows, each up to its diagonal block
    strips = [left[first:end] @ right[:, :end] for first, end in _strips(n)]
    rows = [jnp.pad(strip, ((0, 0), (0, n - strip.shape[1]))) for strip in strips]
    lower = jnp.tril(jnp.concatenate(rows))
    return lower + jnp.tril(lower, -1).T


def scaled(matrix: Matrix, scale: Float[Array, " n"], *, overwrite: bool = False) -> Matrix:
    """Return M_ij s_i s_j; with ``overwrite``, it replaces a NumPy M in memory."""
    if namespace(matrix, scale) is not np:
        return scale[:, None] * matrix * scale[None]
    product = np.multiply(matrix, scale[None], out=matrix if overwrite else None)
    product *= scale[:, None]
    return product


def times_lower(x: Tall, lower: Matrix, *, transpose: bool) -> Tall:
    """Return x L, or x L^T with ``transpose``, for lower triangular L with zeros above."""
    if namespace(x, lower) is not np:
        return x @ (lower.T if transpose else lower)
    lower, product, one = np.ascontiguousarray(lower), np.array(x, order="C"), max(1, len(lower))
    letters, shape = (b"L", b"U", b"T" if transpose else b"N", b"N"), product.T.shape
    _called("dtrmm", *letters, *shape, 1.0, lower, one, product, one)
    return product


def sandwich(matrix: Matrix, lower: Matrix) -> Matrix:
    """Return L^T M L for symmetric M and lower triangular L, symmetric to the last bit."""
    if namespace(matrix, lower) is np:
        return _sandwiched(2, np.array(matrix, order="C"), lower)
    return symmetric_product(lower.T @ matrix, lower)


def inverse_sandwich(
    matrix: Matrix, lower: Matrix, *, transpose: bool = False, overwrite: bool = False
) -> Matrix:
    """Return L^-1 M L^-T, or L^-T M L^-1, for symmetric M and lower triangular L.

    With ``overwrite``, it may replace a NumPy M in memory.
    """
    if namespace(matrix, lower) is not np:
        solved = solve_lower(lower, matrix, transpose=transpose)
        return solve_lower(lower, solved.T, transpose=transpose)
    if transpose:  # reversing rows and columns turns one into the other
        return _reversed(_sandwiched(1, _reversed(matrix), _reversed(lower.T)))
    return _sandwiched(1, matrix if overwrite else np.array(matrix, order="C"), lower)


def _sandwiched(kind: int, matrix: np.ndarray, lower: np.ndarray) -> np.ndarray:
    """LAPACK's reduction of symmetric problems, in n^3 operations instead of 3 n^3, in place."""
    n, reduced = len(lower), np.ascontiguousarray(matrix)
    _called("dsygst", kind, b"U", n, reduced, n, np.ascontiguousarray(lower), n)
    return mirrored(reduced)


def outer_sandwich(matrix: Matrix, lower: Matrix) -> Matrix:
    """Return L M L^T for symmetric M and lower triangular L, symmetric to the last bit."""
    # reversing rows and columns turns L^T M L into L M L^T
    return _reversed(sandwich(_reversed(matrix), _reversed(lower.T)))


def precise_residual(
    vector: Float[Array, " rows"], matrix: Tall, x: Float[Array, " n"]
) -> Float[Array, " rows"]:
    """Return v - M x, as precisely as if sums had half as many digits more.

    The leading bits of M and x, few enough to leave room for the sums, are multiplied without
    rounding. The remainder is smaller by this number of bits, and so is its rounding error.

    References
    ----------
    Ozaki, Ogita, Oishi & Rump 2012, Numer. Algorithms 59, 95.
    """
    xp = namespace(vector, matrix, x)
    bits = (np.finfo(np.float64).nmant - ceil(log2(len(x)))) // 2

    def leading(values: Array, largest: Array) -> Array:
        step = xp.ldexp(xp.ones_like(largest), xp.frexp(largest)[1] - bits)
        return xp.round(values / step) * step

    head = leading(matrix, xp.abs(matrix).max(axis=1, keepdims=True))
    top = leading(x, xp.abs(x).max(keepdims=True))
    return ((vector - head @ top) - head @ (x - top)) - (matrix - head) @ x


def invert_lower(lower: Matrix, *, overwrite: bool = False) -> Matrix:
    """Return L^-1 for lower triangular L; entries above the diagonal are not read.

    With ``overwrite``, it replaces a NumPy L, which must have zeros above the diagonal.
    """
    if namespace(lower) is np:
        inverse = lower if overwrite else lower_triangle(lower)
        _called("dtrtri", b"U", b"N", len(inverse), inverse, len(inverse))
        return inverse
    return solve_lower(jnp.tril(lower), jnp.eye(lower.shape[0]), transpose=False)


def inverse_from_cholesky(lower: Matrix) -> Matrix:
    """Return (L L^T)^-1 for lower triangular L, symmetric to the last bit."""
    if namespace(lower) is np:
        inverse = lower.copy(order="C")
        _called("dpotri", b"U", len(inverse), inverse, len(inverse))
        return mirrored(inverse)
    return gram_matrix(invert_lower(lower))


def spanning_rows(
    matrix: Float[np.ndarray, "rows columns"], kind: np.ndarray
) -> tuple[np.ndarray, Float[np.ndarray, "rows few"]]:
    """Find a few rows of a matrix whose combinations give all of its rows.

    Parameters
    ----------
    matrix : (rows, columns) array
    kind : (rows,) array
        Rows are combined only with rows of their own kind.

    Returns
    -------
    (few,) array of int
        Indices of these rows.
    (rows, few) array
        Factors: their product with these rows is the matrix, to ``SPANNED`` of its largest row.
    """
    # shorter rows with the same scalar products
    residual = np.linalg.qr(matrix.T, mode="r").T.copy()
    picked, along = [], []
    least = SPANNED**2 * (residual**2).sum(axis=1).max()
    while (squares := (residual**2).sum(axis=1)).max() > least:
        k = int(squares.argmax())
        unit = residual[k] / np.sqrt(squares[k])
        # einsum, since the threads of BLAS would wait for each other every time
        along.append(np.where(kind == kind[k], np.einsum("rc,c->r", residual, unit), 0.0))
        picked.append(k)
        residual -= along[-1][:, None] * unit
    coordinates = np.stack(along, axis=1)
    return np.array(picked), np.linalg.solve(coordinates[picked].T, coordinates.T).T


def pivoted_cholesky(
    matrix: Square, least: float
) -> tuple[Float[np.ndarray, "n rank"], Int[np.ndarray, " n"]]:
    """Factorise a positive semidefinite matrix, the largest remaining diagonal entry first.

    Parameters
    ----------
    matrix : (n, n) array
        Only the lower triangle is read.
    least : float
        Where to stop: the remaining diagonal entries are not larger.

    Returns
    -------
    (n, rank) array
        F, with F F^T the matrix but for the remainder.
    (n,) array of int
        The rows' order: F[order] is lower triangular.
    """
    n, lower = len(matrix), np.array(matrix, order="C")
    pivots, rank = (ctypes.c_int * n)(), (ctypes.c_int * 1)()
    _called("dpstrf", b"U", n, lower, n, pivots, rank, least, np.empty(2 * n))
    order = np.array(pivots) - 1
    return np.tril(lower[:, : rank[0]])[np.argsort(order)], order


def main_directions(matrix: Matrix, left_out: float) -> Float[np.ndarray, "n few"]:
    """Return the fewest orthonormal directions X for which tr(M - M X X^T) < ``left_out``.

    They are eigenvectors of a positive semidefinite M, found among the few columns of its pivoted
    Cholesky factor: all others together have at most ``SCREENED`` of ``left_out``.
    """
    columns, _ = pivoted_cholesky(matrix, SCREENED * left_out / len(matrix))
    basis, triangle = np.linalg.qr(columns)
    squares, directions = np.linalg.eigh(triangle @ triangle.T)
    without = np.trace(matrix) - squares.sum() + np.cumsum(squares)
    return basis @ directions[:, np.searchsorted(without, left_out) :]


def mirrored(lower: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n n"]:
    """Make a lower triangle symmetric in place, in blocks that fit the cache."""
    for first, end in pairwise([*range(0, len(lower), MIRRORED), len(lower)]):
        lower[:first, first:end] = lower[first:end, :first].T
        block = lower[first:end, first:end]
        block[:] = np.tril(block) + np.tril(block, -1).T
    return lower


def permuted(
    matrix: Float[np.ndarray, "n m"], rows: Int[np.ndarray, " n"], columns: Int[np.ndarray, " m"]
) -> Float[np.ndarray, "n m"]:
    """Return M_rows,columns, in blocks that fit the cache."""
    result = np.empty_like(matrix)
    for first in range(0, len(rows), PERMUTED):
        block = slice(first, first + PERMUTED)
        result[block] = matrix[rows[block]].take(columns, axis=1)
    return result


def _reversed(matrix: Matrix) -> Matrix:
    """Reverse rows and columns; copied for NumPy, since BLAS has no negative strides."""
    turned = matrix[::-1, ::-1]
    return np.ascontiguousarray(turned) if namespace(matrix) is np else turned


def _strips(n: int) -> Iterator[tuple[int, int]]:
    """First row and end of each strip of a triangle with n rows."""
    return pairwise(np.linspace(0, n, min(N_BLOCKS, n) + 1).astype(int).tolist())
