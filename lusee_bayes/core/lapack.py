"""LAPACK's routines on NumPy arrays, while other threads of Python go on.

SciPy's wrappers keep the interpreter's lock while they compute, so that channels in two threads
would wait for each other. The same routines are taken from :mod:`scipy.linalg.cython_lapack` and
called through ctypes, which lets go of the lock. The lower triangle of an array in C order is the
upper one in LAPACK's.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from functools import lru_cache

import numpy as np
from jaxtyping import Float
from scipy.linalg import cython_blas, cython_lapack


@lru_cache
def _routine(name: str) -> Callable[..., None]:
    """A routine of LAPACK or BLAS, all of whose arguments are pointers."""
    module = cython_lapack if name in cython_lapack.__pyx_capi__ else cython_blas
    capsule = module.__pyx_capi__[name]
    api = ctypes.pythonapi
    api.PyCapsule_GetName.restype = ctypes.c_char_p
    api.PyCapsule_GetName.argtypes = [ctypes.py_object]
    api.PyCapsule_GetPointer.restype = ctypes.c_void_p
    api.PyCapsule_GetPointer.argtypes = [ctypes.py_object, ctypes.c_char_p]
    address = api.PyCapsule_GetPointer(capsule, api.PyCapsule_GetName(capsule))
    n_arguments = api.PyCapsule_GetName(capsule).count(b"*")
    return ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * n_arguments)(address)


def _in_place(name: str, letters: bytes, matrix: Float[np.ndarray, "n n"]) -> int:
    """Call a routine with the arguments letters, n, matrix, n, info; return info."""
    _require(matrix, matrix.flags.c_contiguous, "C")
    n, info = ctypes.c_int(len(matrix)), ctypes.c_int(0)
    words = [ctypes.c_char_p(letters[k : k + 1]) for k in range(len(letters))]
    pointers = (ctypes.byref(n), matrix.ctypes.data, ctypes.byref(n), ctypes.byref(info))
    _routine(name)(*words, *pointers)
    return info.value


def factorise(matrix: Float[np.ndarray, "n n"]) -> bool:
    """Put L, with L L^T the matrix, into its lower triangle, and zeros above.

    Parameters
    ----------
    matrix : (n, n) array
        Symmetric, in C order; only the lower triangle is read.

    Returns
    -------
    bool
        Whether there is one; if not, the matrix is spoilt.
    """
    found = _in_place("dpotrf", b"U", matrix) == 0
    for row in range(len(matrix)):
        matrix[row, row + 1 :] = 0.0
    return found


def invert_factorised(lower: Float[np.ndarray, "n n"]) -> None:
    """Put (L L^T)^-1 into the lower triangle of L, in C order; above it nothing is changed."""
    _in_place("dpotri", b"U", lower)


def invert_triangle(lower: Float[np.ndarray, "n n"]) -> None:
    """Put L^-1 into the lower triangle of L, in C order; above it nothing is changed."""
    _in_place("dtrtri", b"UN", lower)


def solve_triangle(
    lower: Float[np.ndarray, "n n"], columns: Float[np.ndarray, "n columns"], *, transpose: bool
) -> None:
    """Put L^-1 x, or L^-T x, into x.

    Parameters
    ----------
    lower : (n, n) array
        L in C order; above the diagonal nothing is read.
    columns : (n, columns) array
        x in Fortran's order.
    transpose : bool
    """
    _require(lower, lower.flags.c_contiguous, "C")
    _require(columns, columns.flags.f_contiguous, "Fortran's")
    n, n_columns = (ctypes.byref(ctypes.c_int(k)) for k in columns.shape)
    words = [ctypes.c_char_p(letter) for letter in (b"L", b"U", b"N" if transpose else b"T", b"N")]
    one, stride = ctypes.byref(ctypes.c_double(1.0)), ctypes.byref(ctypes.c_int(max(1, len(lower))))
    matrices = lower.ctypes.data, stride, columns.ctypes.data, stride
    _routine("dtrsm")(*words, n, n_columns, one, *matrices)


def _require(matrix: np.ndarray, ordered: bool, order: str) -> None:
    if matrix.dtype != np.float64 or not ordered:
        raise ValueError(f"LAPACK needs float64 in {order} order, got {matrix.dtype}")
