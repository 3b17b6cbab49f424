"""Arithmetic of compiled code: a fast exponential, and small dense systems.

Every inner loop runs along a row, so that the compiler can use vector instructions. Elements are
taken by two unsigned indices: the references to a view of a row are counted, which takes longer
than a short row, and a signed index could count from the end.
"""

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from gp_ground_seg.core.frame import FloatArray
from gp_ground_seg.core.gp import kernels
from gp_ground_seg.core.jit import choose, compiled_form, jit

LANES = 8
"""Columns of single precision that vector instructions take at once, and a multiple of those of
double: rows end at multiples of it, because a remainder takes longer than the rest of the row."""


@compiled_form(choose)
def branch(condition: bool, a: Any, b: Any) -> Any:
    """Return `a` if the condition holds, else `b`: `numpy.where` of numbers would make arrays."""
    return a if condition else b


@compiled_form(kernels.nearer_first)
def nearer_first(r_a: float, r_b: float) -> tuple[float, float]:
    """Do what the twin does."""
    return choose(r_a < r_b, r_a, r_b), choose(r_a < r_b, r_b, r_a)


def _make_exp_neg(number: type, halvings: int, negligible: float) -> Callable[[Any], Any]:
    """Return ``exp(-x)`` for x >= 0 of a type of numbers; zero from `negligible` on.

    The Taylor polynomial of degree 7 of ``exp(-x / 2^halvings)``, squared as often: no branch, no
    table, no call, so that vector instructions take several numbers at once. Terms are added in
    pairs, because each multiplication waits for the one before, and multiplied by factors, because
    a division takes as long as ten multiplications. It is squared as ``1 + below``, of which
    `below` is kept: each square of the value itself would double its rounding, and covariances of
    places close together would be no covariances any more. The tail is exactly zero, because
    derivatives multiply it by the square of a distance in length-scales.
    """
    zero, one, end = number(0.0), number(1.0), number(negligible)
    c1, c2, c3, c4, c5, c6, c7 = (
        number((-(0.5**halvings)) ** k / math.factorial(k)) for k in range(1, 8)
    )

    def exp_neg(x: Any) -> Any:
        y = min(x, end)
        square = y * y
        high = (c4 + c5 * y) + square * (c6 + c7 * y)
        below = c1 * y + square * ((c2 + c3 * y) + square * high)
        for _ in range(halvings):
            below = (below + below) + below * below
        return zero if y >= end else one + below

    return exp_neg


NEGLIGIBLE_EXPONENT, NEGLIGIBLE_SINGLE = 40.0, 18.0
"""x from which ``exp(-x)`` is zero, by precision: it is 4e-18 and 2e-8, below the rounding of
one."""
exp_neg = _make_exp_neg(np.float64, 7, NEGLIGIBLE_EXPONENT)
"""``exp(-x)``, to an error of 1e-15 for x >= 0, and of 1e-11 of its size for -10 < x < 0."""
exp_neg_single = _make_exp_neg(np.float32, 4, NEGLIGIBLE_SINGLE)
"""``exp(-x)`` for x >= 0 in single precision, to an error of 2e-7."""
compiled_form(kernels.exp_neg, single=exp_neg_single)(exp_neg)


@jit()
def solve_in_place(matrix: FloatArray, n: int, vector: FloatArray) -> bool:
    """Replace `vector` by the solution of ``A x = vector``; False if not positive definite.

    `matrix` holds the upper triangle of A, in rows of whole vectors. Values left of the
    diagonal and behind column n are arbitrary. Gaussian elimination.
    """
    end, stop, one = np.uintp((n + LANES - 1) & -LANES), np.uintp(n), np.uintp(1)
    for k in range(stop):
        # Written so that NaN fails too.
        if not matrix[k, k] > 0.0:
            return False
        inverse = 1.0 / matrix[k, k]
        for i in range(k + one, stop):
            factor = matrix[k, i] * inverse
            for j in range(i & ~np.uintp(LANES - 1), end):
                matrix[i, j] -= factor * matrix[k, j]
            vector[i] -= factor * vector[k]
        matrix[k, k] = inverse
    for k in range(n - 1, -1, -1):
        value = vector[k]
        for j in range(np.uintp(k + 1), stop):
            value -= matrix[k, j] * vector[j]
        vector[k] = value * matrix[k, k]
    return True


@jit(part=True)
def _factorise(a: FloatArray) -> float:
    """Replace the upper triangle of A by U, ``A = U^T U``; return log |U|, NaN if none is."""
    stop, one, log_root = np.uintp(len(a)), np.uintp(1), 0.0
    for k in range(stop):
        # Written so that NaN fails too.
        if not a[k, k] > 0.0:
            return math.nan
        pivot = math.sqrt(a[k, k])
        a[k, k] = pivot
        log_root += math.log(pivot)
        scale = 1.0 / pivot
        for j in range(k + one, stop):
            a[k, j] *= scale
        for i in range(k + one, stop):
            weight = a[k, i]
            for j in range(i, stop):
                a[i, j] -= weight * a[k, j]
    return log_root


@compiled_form(kernels.inverted)
def inverted(covariance: FloatArray) -> tuple[FloatArray, float]:
    """Do what the twin does."""
    factor, shape, log_root = covariance, covariance.shape, _factorise(covariance)
    stop, one = np.uintp(len(factor)), np.uintp(1)
    inverse, whitened = np.full(shape, np.nan), np.empty(shape)
    if math.isnan(log_root):
        return inverse, log_root
    # The lower triangle of `whitened` becomes U^-T.
    for i in range(stop):
        for j in range(i + one):
            whitened[i, j] = inverse[i, j] = 0.0
        for k in range(i):
            weight = factor[k, i]
            for j in range(k + one):
                whitened[i, j] -= weight * whitened[k, j]
        scale = 1.0 / factor[i, i]
        for j in range(i):
            whitened[i, j] *= scale
        whitened[i, i] = scale
    for k in range(stop):
        for i in range(k + one):
            weight = whitened[k, i]
            for j in range(i + one):
                inverse[i, j] += weight * whitened[k, j]
    for i in range(stop):
        for j in range(i):
            inverse[j, i] = inverse[i, j]
    return inverse, log_root


@jit()
def times(matrix: FloatArray, vector: FloatArray) -> FloatArray:
    """Product of a matrix and a vector."""
    result = np.zeros(len(matrix))
    for i in range(np.uintp(len(matrix))):
        for j in range(np.uintp(len(vector))):
            result[i] += matrix[i, j] * vector[j]
    return result
