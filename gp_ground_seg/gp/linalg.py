"""Small dense linear algebra for compiled code; works on the lower triangle."""

from __future__ import annotations

import math

from gp_ground_seg.compiled import compiled
from gp_ground_seg.polar_grid import FloatArray


@compiled
def cholesky(a: FloatArray, n: int) -> bool:
    """Factor the lower triangle of ``a[:n, :n]`` in place; False if not positive definite."""
    for j in range(n):
        pivot = a[j, j]
        for k in range(j):
            pivot -= a[j, k] * a[j, k]
        if not pivot > 0.0:
            return False
        pivot = math.sqrt(pivot)
        a[j, j] = pivot
        for i in range(j + 1, n):
            value = a[i, j]
            for k in range(j):
                value -= a[i, k] * a[j, k]
            a[i, j] = value / pivot
    return True


@compiled
def invert_cholesky(factor: FloatArray, n: int, whitened: FloatArray, inverse: FloatArray) -> None:
    """Inverse of the matrix with the given factor: ``L^-T L^-1``, both triangles."""
    # Row i of `whitened` is row i of L^-1; its entries beyond i are not used.
    for i in range(n):
        row = whitened[i]
        for j in range(i):
            row[j] = 0.0
        for k in range(i):
            weight = factor[i, k]
            for j in range(k + 1):
                row[j] -= weight * whitened[k, j]
        scale = 1.0 / factor[i, i]
        for j in range(i):
            row[j] *= scale
        row[i] = scale
    for i in range(n):
        for j in range(i + 1):
            inverse[i, j] = 0.0
    for k in range(n):
        for i in range(k + 1):
            weight = whitened[k, i]
            for j in range(i + 1):
                inverse[i, j] += weight * whitened[k, j]
    for i in range(n):
        for j in range(i):
            inverse[j, i] = inverse[i, j]


@compiled
def solve_cholesky(factor: FloatArray, n: int, vector: FloatArray) -> None:
    """Solve ``L L^T x = vector`` in place for the factor L."""
    for i in range(n):
        for k in range(i):
            vector[i] -= factor[i, k] * vector[k]
        vector[i] /= factor[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            vector[i] -= factor[k, i] * vector[k]
        vector[i] /= factor[i, i]
