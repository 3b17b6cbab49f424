"""Arithmetic of compiled code: a fast exponential, and small dense systems.

Every inner loop runs along a row, so that the compiler can use vector instructions.
"""

from __future__ import annotations

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
