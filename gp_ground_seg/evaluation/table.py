"""Results as a table: for the terminal, as Markdown and JSON."""

from __future__ import annotations

import json
import math
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

WIDTH = 100
"""Columns of the terminal that titles and notes are folded to."""

Cell = str | int | float | None
"""What a row holds; None and NaN are shown as ``-``."""


@dataclass(frozen=True)
class Column:
    """A column of a table.

    Attributes
    ----------
    title : str
        Heading, with the unit: ``RMSE [cm]``.
    format : str
        Format of its numbers, such as ``.2f`` or ``+.1f``; ``_d`` separates thousands by
        spaces. Without one the column holds text and is aligned left.
    key : str
        Name in JSON; the title by default.
    scale : float
        Factor between what a row holds and what is shown: 100 for a ratio in percent.
    """

    title: str
    format: str = ''
    key: str = ''
    scale: float = 1

    def show(self, value: Cell) -> str:
        """Return a cell as it is shown."""
        if isinstance(value, str):
            return value
        if value is None or math.isnan(value):
            return '-'
        return format(self.scale * value, self.format).replace('_', ' ')


def percent(title: str, key: str = '', form: str = '.2f') -> Column:
    """Column of ratios, shown in percent."""
    return Column(title, form, key, 100.0)


def centimetres(title: str, key: str = '') -> Column:
    """Column of lengths in metres, shown in centimetres."""
    return Column(title, '.2f', key, 100.0)


def milliseconds(title: str, key: str = '') -> Column:
    """Column of times in seconds, shown in milliseconds."""
    return Column(title, '.1f', key, 1e3)


Row = list[tuple[Column, Cell]]
"""A row that names the column of each cell."""


@dataclass(frozen=True)
class Table:
    """Rows of unscaled numbers and text, as many cells in each as there are columns.

    The title stands above it, notes below; `n_sums` rows at the end are set apart in `text`.
    """

    columns: Sequence[Column]
    rows: Sequence[Sequence[Cell]]
    title: str = ''
    notes: Sequence[str] = ()
    n_sums: int = 0

    @classmethod
    def of(cls, rows: Sequence[Row], **options: Any) -> Table:
        """Make a table of at least one row."""
        columns = [column for column, _ in rows[0]]
        return cls(columns, [[cell for _, cell in row] for row in rows], **options)

    def text(self) -> str:
        """Return aligned text, columns two spaces apart."""
        lines = self._shown()
        widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
        text = []
        for line in lines:
            cells = zip(self.columns, line, widths, strict=True)
            aligned = (c.rjust(w) if column.format else c.ljust(w) for column, c, w in cells)
            text.append('  '.join(aligned).rstrip())
        rule = '-' * (sum(widths) + 2 * (len(widths) - 1))
        if self.n_sums:
            text.insert(len(text) - self.n_sums, rule)
        text.insert(1, rule)
        above = [fold(self.title)] if self.title else []
        below = ['', *map(fold, self.notes)] if self.notes else []
        return '\n'.join([*above, *text, *below])

    def markdown(self) -> str:
        """Return a Markdown table, title and notes as paragraphs."""
        titles, *rows = self._shown()
        rule = ['--:' if column.format else '---' for column in self.columns]
        table = '\n'.join(f'| {" | ".join(line)} |' for line in [titles, rule, *rows])
        return '\n\n'.join([*([self.title] if self.title else []), table, *self.notes])

    def json(self) -> list[dict[str, Any]]:
        """Return one object per row, unscaled, NaN as None."""
        keys = [column.key or column.title for column in self.columns]
        return [dict(zip(keys, plain(row), strict=True)) for row in self.rows]

    def _shown(self) -> list[list[str]]:
        """Titles and rows, every cell as it is shown."""
        rows = [
            [column.show(cell) for column, cell in zip(self.columns, row, strict=True)]
            for row in self.rows
        ]
        return [[column.title for column in self.columns], *rows]


def fold(line: str) -> str:
    """Fold a line for the terminal."""
    return textwrap.fill(line, WIDTH, subsequent_indent='  ', break_on_hyphens=False)


def plain(value: Any) -> Any:
    """Return nested mappings and sequences with NaN as None, as JSON has no NaN."""
    if isinstance(value, dict):
        return {key: plain(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [plain(entry) for entry in value]
    return None if isinstance(value, float) and math.isnan(value) else value


def write_json(document: Any, path: str | Path) -> None:
    """Write a document as JSON, NaN as null."""
    text = json.dumps(plain(document), indent=2, allow_nan=False) + '\n'
    Path(path).write_text(text, encoding='utf-8')
