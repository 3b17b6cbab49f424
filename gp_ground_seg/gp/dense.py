"""Small positive definite systems for plain numpy code.

Straight to LAPACK: on matrices of a few dozen rows SciPy's checked wrappers cost
more than the work.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import LinAlgError, lapack

from gp_ground_seg.frame import FloatArray


def factorise(a: FloatArray) -> FloatArray:
    """Lower Cholesky factor of `a` (n, n); what is above the diagonal is left as it was.

    Raises
    ------
    LinAlgError
        If `a` is not positive definite.
    """
    factor: FloatArray
    factor, info = lapack.dpotrf(a, lower=1, clean=0)
    if info != 0 or not np.isfinite(factor[-1, -1]):
        raise LinAlgError(f'not positive definite at row {info}')
    return factor


def solve(factor: FloatArray, b: FloatArray) -> FloatArray:
    """Solve ``A x = b`` (n, ...) for the factor of A."""
    x: FloatArray = lapack.dpotrs(factor, b, lower=1)[0]
    return x


def whiten(factor: FloatArray, b: FloatArray) -> FloatArray:
    """Solve ``L x = b`` (n, k) for the factor L."""
    x: FloatArray = lapack.dtrtrs(factor, b, lower=1)[0]
    return x


def inverse(factor: FloatArray) -> FloatArray:
    """Inverse of A (n, n) for its factor, both triangles."""
    lower = np.tril(lapack.dpotri(factor, lower=1)[0])
    result: FloatArray = lower + np.tril(lower, -1).T
    return result


def log_determinant(factor: FloatArray) -> float:
    """Logarithm of the determinant of A for its factor."""
    return 2.0 * float(np.log(np.diagonal(factor)).sum())
