"""Aligned tables for the terminal."""

from __future__ import annotations

import math
from collections.abc import Sequence


def format_table(
    header: Sequence[str], rows: Sequence[Sequence[str]], n_left: int = 1, rule_before: int = -1
) -> str:
    """Lay out rows below a header, columns two spaces apart.

    Parameters
    ----------
    header : sequence of str
        Titles of the columns.
    rows : sequence of sequence of str
        Cells, as many per row as there are titles.
    n_left : int
        How many columns, from the left, are aligned left; the others right.
    rule_before : int
        Row that a rule is drawn above, for sums; negative = none.
    """
    lines = [header, *rows]
    widths = [max(len(cell) for cell in column) for column in zip(*lines, strict=True)]

    def lay_out(cells: Sequence[str]) -> str:
        aligned = (
            cell.ljust(width) if k < n_left else cell.rjust(width)
            for k, (cell, width) in enumerate(zip(cells, widths, strict=True))
        )
        return '  '.join(aligned).rstrip()

    rule = '-' * (sum(widths) + 2 * (len(widths) - 1))
    text = [lay_out(header), rule]
    for k, row in enumerate(rows):
        if k == rule_before:
            text.append(rule)
        text.append(lay_out(row))
    return '\n'.join(text)


def percent(ratio: float, sign: bool = False) -> str:
    """Format a ratio in percent, without unit; ``-`` if undefined."""
    if math.isnan(ratio):
        return '-'
    return f'{100.0 * ratio:+.2f}' if sign else f'{100.0 * ratio:.2f}'


def milliseconds(seconds: float) -> str:
    """Format a time in milliseconds, without unit; ``-`` if undefined."""
    return '-' if math.isnan(seconds) else f'{1e3 * seconds:.1f}'
