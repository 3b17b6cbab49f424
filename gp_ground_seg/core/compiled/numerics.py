"""Arithmetic of compiled code: a fast exponential, and small dense systems.

Every inner loop runs along a row, so that the compiler can use vector instructions.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from gp_ground_seg.core.frame import FloatArray
from gp_ground_seg.core.gp import kernels
from gp_ground_seg.core.jit import choose, compiled_form, jit

LANES = 8
"""Columns of single precision that vector instructions take at once, and a multiple of those of
double: rows end at multiples of it, because a remainder takes longer than the rest of the row."""
NEGLIGIBLE_EXPONENT = 40.0
"""`exp_neg` is zero beyond this x: exp(-40) is 4e-18, below the rounding of one."""
_HALVINGS = 7
_SCALE = -1.0 / 2.0**_HALVINGS
# Factors instead of quotients: a division takes as long as ten multiplications.
_C2, _C3, _C4, _C5, _C6, _C7 = 1 / 2, 1 / 6, 1 / 24, 1 / 120, 1 / 720, 1 / 5040
_NEGLIGIBLE_SINGLE, _ZERO, _ONE = np.float32(18.0), np.float32(0.0), np.float32(1.0)
_S1, _S2, _S3, _S4, _S5, _S6, _S7 = (
    np.float32((-1.0 / 16.0) ** k / math.factorial(k)) for k in range(1, 8)
)


@compiled_form(choose)
def branch(condition: bool, a: Any, b: Any) -> Any:
    """Return `a` if the condition holds, else `b`: `numpy.where` of numbers would make arrays."""
    return a if condition else b


def exp_neg(x: float) -> float:
    """``exp(-x)``, to an error of 2e-14 for x >= 0, and of 1e-11 of its size for -10 < x < 0.

    The Taylor polynomial of ``exp(-x / 128)``, squared seven times: no branch, no
    table, no call, so that it runs on four numbers at a time. The remainder of the
    polynomial is at most ``x^8 exp(-x) / (128^7 8!)``, 3e-16. Terms are added in pairs,
    because each multiplication waits for the one before. The tail is exactly zero, because
    derivatives multiply it by the square of a distance in length-scales.
    """
    y = min(x, NEGLIGIBLE_EXPONENT) * _SCALE
    square = y * y
    high = (_C4 + _C5 * y) + square * (_C6 + _C7 * y)
    value = (1.0 + y) + square * ((_C2 + _C3 * y) + square * high)
    value *= value
    value *= value
    value *= value
    value *= value
    value *= value
    value *= value
    value *= value
    return 0.0 if x > NEGLIGIBLE_EXPONENT else value


def exp_neg_single(x: Any) -> Any:
    """``exp(-x)`` for x >= 0 in single precision, to an error of 2e-7; zero from 18 on.

    As `exp_neg`, with 16 for 128: ``exp(-18)`` is 1.5e-8, below the rounding of one. It is squared
    as ``1 + below``, of which `below` is kept: each square of the value itself would double its
    rounding, and covariances of places close together would be no covariances any more.
    """
    y = min(x, _NEGLIGIBLE_SINGLE)
    square = y * y
    high = (_S4 + _S5 * y) + square * (_S6 + _S7 * y)
    below = _S1 * y + square * ((_S2 + _S3 * y) + square * high)
    below = (below + below) + below * below
    below = (below + below) + below * below
    below = (below + below) + below * below
    below = (below + below) + below * below
    return _ZERO if y >= _NEGLIGIBLE_SINGLE else _ONE + below


compiled_form(kernels.exp_neg, single=exp_neg_single)(exp_neg)


@jit()
def solve_in_place(matrix: FloatArray, n: int, vector: FloatArray) -> bool:
    """Replace `vector` by the solution of ``A x = vector``; False if not positive definite.

    `matrix` holds the upper triangle of A, in rows of whole vectors. Values left of the
    diagonal and behind column n are arbitrary. Gaussian elimination.
    """
    end = (n + LANES - 1) & -LANES
    for k in range(n):
        row = matrix[k]
        # Written so that NaN fails too.
        if not row[k] > 0.0:
            return False
        inverse = 1.0 / row[k]
        for i in range(k + 1, n):
            factor = row[i] * inverse
            below = matrix[i]
            for j in range(i & -LANES, end):
                below[j] -= factor * row[j]
            vector[i] -= factor * vector[k]
        row[k] = inverse
    for k in range(n - 1, -1, -1):
        row = matrix[k]
        value = vector[k]
        for j in range(k + 1, n):
            value -= row[j] * vector[j]
        vector[k] = value * row[k]
    return True


@jit()
def factorise(a: FloatArray, n: int) -> bool:
    """Replace the upper triangle of ``a[:n, :n]`` by U, ``A = U^T U``; False if not possible."""
    for k in range(n):
        row = a[k]
        # Written so that NaN fails too.
        if not row[k] > 0.0:
            return False
        pivot = math.sqrt(row[k])
        row[k] = pivot
        scale = 1.0 / pivot
        for j in range(k + 1, n):
            row[j] *= scale
        for i in range(k + 1, n):
            weight = row[i]
            below = a[i]
            for j in range(i, n):
                below[j] -= weight * row[j]
    return True


@jit()
def invert_triangle(factor: FloatArray, n: int, whitened: FloatArray) -> None:
    """Set the lower triangle of `whitened` to ``U^-T``."""
    for i in range(n):
        row = whitened[i]
        for j in range(i + 1):
            row[j] = 0.0
        for k in range(i):
            weight = factor[k, i]
            above = whitened[k]
            for j in range(k + 1):
                row[j] -= weight * above[j]
        scale = 1.0 / factor[i, i]
        for j in range(i):
            row[j] *= scale
        row[i] = scale


@jit()
def invert(factor: FloatArray, n: int, whitened: FloatArray, inverse: FloatArray) -> None:
    """Inverse of ``U^T U``, both triangles, in `inverse`.

    `whitened` is working space; its lower triangle becomes ``U^-T``.
    """
    invert_triangle(factor, n, whitened)
    for i in range(n):
        for j in range(i + 1):
            inverse[i, j] = 0.0
    for k in range(n):
        row = whitened[k]
        for i in range(k + 1):
            weight = row[i]
            target = inverse[i]
            for j in range(i + 1):
                target[j] += weight * row[j]
    for i in range(n):
        for j in range(i):
            inverse[j, i] = inverse[i, j]
