"""Results: frames of pandas as tables and JSON; machine, versions and parameters of a run."""

from __future__ import annotations

import json
import os
import platform
import subprocess
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import gp_ground_seg
from gp_ground_seg.core.errors import require
from gp_ground_seg.core.parameters.config import Config
from gp_ground_seg.data.files import write_file
from gp_ground_seg.lab.cluster import package_versions

if TYPE_CHECKING:
    from pandas import DataFrame, Series

WIDTH = 100
"""Columns of the terminal that titles and notes are folded to."""
PEER = 'peer_'
"""Beginning of the names of columns of the other method."""


class Form(NamedTuple):
    """How a column is shown: its title, the format of its numbers, and the factor before it.

    Without a format the column holds text. The factor may be one for each row.
    """

    title: str
    format: str = ''
    scale: float | Sequence[float] = 1.0


class Table(NamedTuple):
    """A frame of unscaled numbers and text, whose columns have the names that JSON has.

    A column that is not in `forms` is text under its name, and one of the other method has the
    form of ours.
    """

    title: str
    frame: DataFrame
    forms: Mapping[str, Form] = {}
    notes: Sequence[str] = ()

    def shown(self) -> DataFrame:
        """Return the cells as text, under their titles; ``-`` is none."""
        forms = [self._form(name) for name in self.frame]
        cells = self.frame.reset_index(drop=True).astype(object)
        for name, form in zip(cells, forms, strict=True):
            cells[name] = _text(cells[name], form)
        return cells.set_axis([form.title for form in forms], axis='columns')

    def _form(self, name: str) -> Form:
        """Return the form of a column, which has that of ours if it has none of its own."""
        form = self.forms.get(name)
        if form is None and name.startswith(PEER):
            ours = self._form(name.removeprefix(PEER))
            return ours._replace(title=f'peer {ours.title}')
        return form or Form(name)

    def text(self) -> str:
        """Return title, aligned cells and notes for the terminal."""
        cells = self.shown()
        table = [cells.to_string(index=False)] if len(cells) else []
        return '\n'.join([fold(self.title), *table, *map(fold, self.notes)])

    def markdown(self) -> str:
        """Return a Markdown table, title and notes as paragraphs."""
        sides = ['right' if self._form(name).format else 'left' for name in self.frame]
        table = self.shown().to_markdown(index=False, disable_numparse=True, colalign=sides)
        return '\n\n'.join([self.title, table, *self.notes])

    def json(self) -> list[dict[str, Any]]:
        """Return one object per row, unscaled."""
        return records(self.frame)


def frame_of(rows: Any, columns: Sequence[str] | None = None) -> DataFrame:
    """Return a frame of rows or of columns by name, or an empty one of the `columns`."""
    pandas = require_pandas()
    # Without a row pandas knows no type, and sums up no column.
    return pandas.DataFrame(rows) if rows else pandas.DataFrame(columns=columns, dtype=float)


def require_pandas() -> Any:
    """Import pandas, or raise a MissingDependencyError."""
    return require('pandas', 'pandas tabulate')


def _text(values: Series, form: Form) -> list[str]:
    """Return the cells of a column as they are shown, thousands set apart by a blank."""
    if not form.format:
        shown = [str(value) for value in values]
    else:
        scaled = values.astype(float) * form.scale
        shown = [f'{value:{form.format}}'.replace(',', ' ') for value in scaled]
    return ['-' if gone else cell for cell, gone in zip(shown, values.isna(), strict=True)]


def records(frame: DataFrame) -> list[dict[str, Any]]:
    """Return the rows with values of Python, None for NaN."""
    found: list[dict[str, Any]] = (
        frame.astype(object).where(frame.notna(), None).to_dict('records')
    )
    return found


def fold(line: str) -> str:
    """Fold a line for the terminal."""
    return textwrap.fill(line, WIDTH, subsequent_indent='  ', break_on_hyphens=False)


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


def changed_parameters(config: Config) -> dict[str, Any]:
    """Parameters that differ from their defaults, by dotted name."""
    return {spec.name: value for spec, _, value in Config().differences(config)}


def parameters_line(changes: Mapping[str, Any]) -> str:
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
    """Tables to show, every number by scan or segment, the backend, and further facts."""

    tables: dict[str, Table]
    rows: list[dict[str, Any]]
    backend: str
    facts: dict[str, Any]

    def text(self, machine: str, *, markdown: bool) -> str:
        """Return the tables, and below them the line on the machine."""
        tables = self.tables.values()
        shown = [table.markdown() if markdown else table.text() for table in tables]
        return '\n\n'.join([*shown, machine if markdown else fold(machine)])

    def write(self, path: Path, environment: dict[str, Any]) -> None:
        """Write every number as JSON."""
        document = {
            **self.facts,
            'backend': self.backend,
            'environment': environment,
            **{name: table.json() for name, table in self.tables.items()},
            'rows': self.rows,
        }
        write_file(path, (json.dumps(document, indent=2, allow_nan=False) + '\n').encode())
