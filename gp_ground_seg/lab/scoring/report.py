"""Results: tables for the terminal, as Markdown and JSON; machine, versions and parameters."""

from __future__ import annotations

import json
import math
import os
import platform
import subprocess
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import gp_ground_seg
from gp_ground_seg.core.parameters.config import Config
from gp_ground_seg.core.parameters.schema import ParameterValue
from gp_ground_seg.data.files import write_file
from gp_ground_seg.lab.cluster import package_versions

WIDTH = 100
"""Columns of the terminal that titles and notes are folded to."""

Cell = str | int | float | None
"""Content of a cell; None and NaN are shown as ``-``."""


@dataclass(frozen=True)
class Column:
    """A column of a table.

    `format` is that of its numbers, such as ``.2f``; ``_d`` separates thousands by spaces.
    Without one the column holds text and is aligned left. `key` is its name in JSON, the title
    by default, `scale` the factor between what a cell holds and what is shown. Where the rows
    have units of their own, format and scale are tuples, with an entry for each row.
    """

    title: str
    format: str | tuple[str, ...] = ''
    key: str = ''
    scale: float | tuple[float, ...] = 1

    def show(self, value: Cell, row: int = 0) -> str:
        """Return a cell of a row as it is shown."""
        if isinstance(value, str):
            return value
        if value is None or math.isnan(value):
            return '-'
        form = self.format if isinstance(self.format, str) else self.format[row]
        scale = self.scale if isinstance(self.scale, int | float) else self.scale[row]
        number = round(scale * value) if form.endswith('d') else scale * value
        return format(number, form).replace('_', ' ')

    def plain(self, value: Any) -> Cell:
        """Return a cell as it is in JSON: a number is one of Python, and not scaled."""
        if value is None or isinstance(value, str):
            return value
        if math.isnan(value):
            return None
        return int(value) if str(self.format).endswith('d') else float(value)


def percent(title: str, key: str = '', form: str = '.2f') -> Column:
    """Column of ratios, shown in percent."""
    return Column(title, form, key, 100.0)


def centimetres(title: str, key: str = '') -> Column:
    """Column of lengths in metres, shown in centimetres."""
    return Column(title, '.2f', key, 100.0)


def milliseconds(title: str, key: str = '') -> Column:
    """Column of times in seconds, shown in milliseconds."""
    return Column(title, '.1f', key, 1e3)


@dataclass(frozen=True)
class Table:
    """Columns of unscaled numbers and text, such as those of a frame of pandas.

    The title stands above it, notes below; `n_sums` rows at the end are set apart in `text`.
    """

    columns: Mapping[Column, Iterable[Any]]
    title: str = ''
    notes: Sequence[str] = ()
    n_sums: int = 0

    def text(self) -> str:
        """Return aligned text, columns two spaces apart; of no rows neither titles."""
        above = [fold(self.title)] if self.title else []
        below = ['', *map(fold, self.notes)] if self.notes else []
        return '\n'.join([*above, *self._lines(), *below])

    def _lines(self) -> list[str]:
        lines = self._shown()
        if len(lines) == 1:
            return []
        widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
        marks = ['>' if column.format else '<' for column in self.columns]
        form = '  '.join(f'{{:{mark}{w}}}' for mark, w in zip(marks, widths, strict=True))
        text = [form.format(*line).rstrip() for line in lines]
        rule = '-' * (sum(widths) + 2 * (len(widths) - 1))
        if self.n_sums:
            text.insert(len(text) - self.n_sums, rule)
        text.insert(1, rule)
        return text

    def markdown(self) -> str:
        """Return a Markdown table, title and notes as paragraphs."""
        titles, *rows = self._shown()
        rule = ['--:' if column.format else '---' for column in self.columns]
        table = '\n'.join(f'| {" | ".join(line)} |' for line in [titles, rule, *rows])
        return '\n\n'.join([*([self.title] if self.title else []), table, *self.notes])

    def json(self) -> list[dict[str, Any]]:
        """Return one object per row, unscaled."""
        keys = [column.key or column.title for column in self.columns]
        cells = ([column.plain(cell) for cell in own] for column, own in self.columns.items())
        return [dict(zip(keys, row, strict=True)) for row in zip(*cells, strict=True)]

    def _shown(self) -> list[list[str]]:
        """Titles and rows, every cell as it is shown."""
        shown = (
            [column.title, *(column.show(cell, row) for row, cell in enumerate(cells))]
            for column, cells in self.columns.items()
        )
        return [list(line) for line in zip(*shown, strict=True)]


def fold(line: str) -> str:
    """Fold a line for the terminal."""
    return textwrap.fill(line, WIDTH, subsequent_indent='  ', break_on_hyphens=False)


def written(tables: Iterable[Table], lines: Sequence[str], *, markdown: bool) -> str:
    """Tables, and below them lines on the run, for the terminal or as Markdown."""
    shown = [table.markdown() if markdown else table.text() for table in tables]
    below = [*lines] if markdown else ['\n'.join(map(fold, lines))]
    return '\n\n'.join([*shown, *below])


def _plain(value: Any) -> Any:
    """Nested mappings and sequences with numbers of Python, NaN as None: JSON has no NaN."""
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, dict):
        return {key: _plain(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(entry) for entry in value]
    return None if isinstance(value, float) and math.isnan(value) else value


def write_json(document: Any, path: str | Path) -> None:
    """Write a document as JSON, NaN as null."""
    text = json.dumps(_plain(document), indent=2, allow_nan=False) + '\n'
    write_file(Path(path), text.encode())


def describe_environment(*packages: str) -> dict[str, Any]:
    """Describe machine and software of a run, with the versions of further `packages`.

    The commit is None outside git.
    """
    return {
        'cpu': _cpu_name(),
        'n_cores': len(os.sched_getaffinity(0)),
        'python': platform.python_version(),
        'versions': package_versions(*packages),
        'commit': _commit(Path(gp_ground_seg.__file__)),
    }


def machine_line(environment: Mapping[str, Any], backend: str = '') -> str:
    """One line on where a measurement ran."""
    cores = '1 core' if environment['n_cores'] == 1 else f'{environment["n_cores"]} cores'
    if backend:
        n_workers = environment.get('n_workers')
        threads = f'workers with {n_workers} threads in all' if n_workers else '1 thread'
        cores = f'{threads} on {cores}, {backend}'
    versions = ', '.join(f'{name} {v or "absent"}' for name, v in environment['versions'].items())
    machine = f'machine: {environment["cpu"]}, {cores}; Python {environment["python"]}, {versions}'
    if not environment['commit']:
        return machine  # installed, not run from a checkout
    commit, _, dirty = environment['commit'].partition('-')
    return f'{machine}, commit {commit[:12]}{" (changed since)" if dirty else ""}'


def changed_parameters(config: Config) -> dict[str, ParameterValue]:
    """Parameters that differ from their defaults, by dotted name."""
    return {spec.name: value for spec, _, value in Config().differences(config)}


def parameters_line(changes: dict[str, ParameterValue]) -> str:
    """One line on the parameters of a run."""
    words = ', '.join(f'{name}={value}' for name, value in changes.items())
    return f'parameters: {words or "defaults"}'


def _cpu_name() -> str:
    try:
        lines = Path('/proc/cpuinfo').read_text(encoding='utf-8').splitlines()
    except OSError:
        lines = []
    names = (line.partition(':')[2].strip() for line in lines if line.startswith('model name'))
    return next(names, platform.processor() or platform.machine())


def _commit(source: Path) -> str | None:
    """Commit that holds the file `source`, None if git does not know the file.

    An installed package may lie inside another repository, whose commit says nothing of it.
    """
    if _git(source.parent, 'ls-files', '--error-unmatch', source.name) is None:
        return None
    return _git(source.parent, 'describe', '--always', '--abbrev=40', '--dirty', '--exclude=*')


def _git(folder: Path, *words: str) -> str | None:
    try:
        run = subprocess.run(
            ['git', *words], cwd=folder, capture_output=True, text=True, timeout=10.0
        )
    except (OSError, subprocess.TimeoutExpired):
        return None
    return run.stdout.strip() if run.returncode == 0 else None


class Report(NamedTuple):
    """Tables to show, every number by scan or segment, backend, further facts."""

    tables: dict[str, Table]
    rows: list[dict[str, Any]]
    backend: str
    facts: dict[str, Any]

    def write(self, path: Path, environment: dict[str, Any]) -> None:
        """Write every number as JSON."""
        document = {
            **self.facts,
            'backend': self.backend,
            'environment': environment,
            **{name: table.json() for name, table in self.tables.items()},
            'rows': self.rows,
        }
        write_json(document, path)
