"""Small dense linear algebra for compiled code.

Factors are upper triangular, ``A = U^T U``, and every inner loop runs along a
row, so that the compiler can use vector instructions.
"""

from __future__ import annotations

import math

from gp_ground_seg.frame import FloatArray
from gp_ground_seg.jit import compiled_vectors


@compiled_vectors
def factorise(a: FloatArray, n: int) -> bool:
    """Replace the upper triangle of ``a[:n, :n]`` by U; False if not positive definite."""
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


@compiled_vectors
def invert(factor: FloatArray, n: int, whitened: FloatArray, inverse: FloatArray) -> None:
    """Inverse of ``U^T U``, both triangles, in `inverse`.

    `whitened` is working space; its lower triangle becomes ``U^-T``.
    """
    for i in range(n):
        row = whitened[i]
        row[: i + 1] = 0.0
        for k in range(i):
            weight = factor[k, i]
            above = whitened[k]
            for j in range(k + 1):
                row[j] -= weight * above[j]
        scale = 1.0 / factor[i, i]
        for j in range(i):
            row[j] *= scale
        row[i] = scale
    for i in range(n):
        inverse[i, : i + 1] = 0.0
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
