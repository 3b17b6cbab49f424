"""A decaying exponential that the compiler can turn into vector instructions."""

from __future__ import annotations

from gp_ground_seg.jit import compiled_vectors

NEGLIGIBLE_EXPONENT = 40.0
"""Compiled code takes exp(-x) for nothing beyond this x: 4e-18, below the rounding of one."""
_HALVINGS = 7
_SCALE = -1.0 / 2.0**_HALVINGS
# Factors, not quotients: a division takes as long as ten multiplications.
_C2, _C3, _C4, _C5, _C6, _C7 = 1 / 2, 1 / 6, 1 / 24, 1 / 120, 1 / 720, 1 / 5040


@compiled_vectors
def decay(x: float) -> float:
    """``exp(-x)``, to an error of 1e-14 for x >= 0, and of 1e-11 of its size for -10 < x < 0.

    The Taylor polynomial of ``exp(-x / 128)``, squared seven times: no branch, no
    table, no call, four numbers at a time. What the polynomial leaves out is at most
    ``x^8 exp(-x) / (128^7 8!)``, 3e-16. Terms are added in pairs, as each
    multiplication waits for the one before. The end is nothing and no tiny number, which
    derivatives would multiply by the square of a distance in length-scales.
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
