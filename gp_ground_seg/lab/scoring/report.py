"""Results as tables and JSON, and on which machine and with what versions they were made."""

import json
import os
import platform
import subprocess
from collections.abc import Mapping, Sequence
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import gp_ground_seg
from gp_ground_seg.core.errors import require
from gp_ground_seg.core.parameters.config import Config

if TYPE_CHECKING:
    from pandas import DataFrame as DataFrame
else:  # pandas is optional
    DataFrame = Any

PEER = 'peer_'
"""Beginning of the names of columns of the other method."""


class Form(NamedTuple):
    """How a column is shown: its title, the format of its numbers, and the factor before it.

    Without a format the column holds text.
    """

    title: str
    format: str = ''
    scale: float = 1.0


SHARE, SIGNED, COUNT = ('.2f', 100.0), ('+.2f', 100.0), (',.0f',)
"""Formats and factors: of ratios in percent and metres in cm; of their differences; counts."""
FORMS = {
    'n_scans': Form('frames', *COUNT),
    'points': Form('points', *COUNT),
    'precision': Form('precision', *SHARE),
    'recall': Form('recall', *SHARE),
    'iou': Form('IoU', *SHARE),
    'difference': Form('difference', *SIGNED),
    'interval': Form('95 % interval'),
    'n_returns': Form('returns', *COUNT),
    'share_ground': Form('as ground', *SHARE),
    'n_objects': Form('objects', *COUNT),
    'n_lost': Form('lost', *COUNT),
    'low_things_n': Form('low returns', *COUNT),
    'low_things': Form('as ground', *SHARE),
    'road_cells_n': Form('road cells', *COUNT),
    'road_cells': Form('false', '.3f', 100.0),
    'ground_cells_n': Form('ground cells', *COUNT),
    'ground_cells': Form('false', '.3f', 100.0),
    'n_points': Form('points', *COUNT),
    'without_model': Form('no model', *SHARE),
    'bias': Form('bias', *SHARE),
    'rmse': Form('RMSE', *SHARE),
    'median_absolute': Form('median', *SHARE),
    'within_1': Form('in 1 std', '.1f', 100.0),
    'within_2': Form('in 2 std', '.1f', 100.0),
    'median': Form('median [ms]', '.2f', 1e3),
    'p99': Form('p99 [ms]', '.2f', 1e3),
}
"""How columns are shown in all tables, by their name in JSON."""


class Table(NamedTuple):
    """A frame of unscaled numbers and text, whose columns have the names that JSON has.

    `forms` are those of columns that are not shown as in `FORMS`. A column in neither is text
    under its name.
    """

    title: str
    frame: DataFrame
    forms: Mapping[str, Form] = {}

    def form(self, name: str) -> Form:
        """Return the form of a column; one of the other method has that of ours."""
        found = self.forms.get(name) or FORMS.get(name)
        if found is None and name.startswith(PEER):
            ours = self.form(name.removeprefix(PEER))
            return ours._replace(title=f'peer {ours.title}')
        return found or Form(name)

    def text(self, *, markdown: bool = False) -> str:
        """Return title and cells, for the terminal or as Markdown; ``-`` is none."""
        forms = [self.form(name) for name in self.frame]
        cells = self.frame.reset_index(drop=True).astype(object)
        for name, (_, style, scale) in zip(cells, forms, strict=True):
            cells[name] = [
                '-' if gone else str(value) if not style
                else f'{value * scale:{style}}'.replace(',', ' ')
                for value, gone in zip(cells[name], cells[name].isna(), strict=True)
            ]  # fmt: skip
        cells = cells.set_axis([form.title for form in forms], axis='columns')
        if markdown:
            sides = ['right' if form.format else 'left' for form in forms]
            table = cells.to_markdown(index=False, disable_numparse=True, colalign=sides)
            return f'{self.title}\n\n{table}'
        table = f'\n{cells.to_string(index=False)}' if len(cells) else ''
        return f'{self.title}{table}'


def frame_of(rows: Any, columns: Sequence[str] | None = None) -> DataFrame:
    """Return a frame of rows or of columns by name, or an empty one of the `columns`."""
    pandas = require_pandas()
    # Without a row pandas knows no type, and sums up no column.
    return pandas.DataFrame(rows) if rows else pandas.DataFrame(columns=columns, dtype=float)


def require_pandas() -> Any:
    """Import pandas, or raise a MissingDependencyError."""
    return require('pandas', 'pandas tabulate')


def records(frame: DataFrame) -> list[dict[str, Any]]:
    """Return the rows with values of Python, None for NaN."""
    return list(frame.astype(object).where(frame.notna(), None).to_dict('records'))


class Report(NamedTuple):
    """Tables to show, every number by scan or segment, the backend, and the parameters."""

    tables: dict[str, Table]
    rows: list[dict[str, Any]]
    backend: str
    config: Config

    def text(self, machine: str, *, markdown: bool) -> str:
        """Return the tables, and below them the line on the machine."""
        tables = [table.text(markdown=markdown) for table in self.tables.values()]
        return '\n\n'.join([*tables, machine])

    def encode(self, environment: Mapping[str, Any], **facts: Any) -> bytes:
        """Return every number as JSON, and further `facts`."""
        document = {
            'config_changes': changed_parameters(self.config),
            'config': self.config.nested(),
            **facts,
            'backend': self.backend,
            'environment': environment,
            **{name: records(table.frame) for name, table in self.tables.items()},
            'rows': self.rows,
        }
        return (json.dumps(document, indent=2, allow_nan=False) + '\n').encode()


def changed_parameters(config: Config) -> dict[str, Any]:
    """Parameters that differ from their defaults, by dotted name."""
    return {spec.name: value for spec, _, value in Config().differences(config)}


def describe_environment(*packages: str) -> dict[str, Any]:
    """Describe machine and software of a run, with the versions of further `packages`.

    The commit is None outside git.
    """
    return {
        'cpu': _cpu_name(),
        'n_cores': len(os.sched_getaffinity(0)),
        'python': platform.python_version(),
        'versions': {
            'gp_ground_seg': gp_ground_seg.__version__,
            **{name: _version_of(name) for name in ('numpy', 'scipy', 'numba', *packages)},
        },
        'commit': _commit(Path(gp_ground_seg.__file__)),
    }


def machine_line(environment: Mapping[str, Any], backend: str) -> str:
    """One line on where a measurement ran."""
    cores = '1 core' if environment['n_cores'] == 1 else f'{environment["n_cores"]} cores'
    n_workers = environment.get('n_workers')
    threads = f'workers with {n_workers} threads in all' if n_workers else '1 thread'
    versions = ', '.join(f'{name} {v or "absent"}' for name, v in environment['versions'].items())
    machine = (
        f'machine: {environment["cpu"]}, {threads} on {cores}, {backend}; '
        f'Python {environment["python"]}, {versions}'
    )
    if not environment['commit']:
        return machine  # installed, not run from a checkout
    commit, _, dirty = environment['commit'].partition('-')
    return f'{machine}, commit {commit[:12]}{" (changed since)" if dirty else ""}'


def _version_of(package: str) -> str | None:
    with suppress(PackageNotFoundError):
        return version(package)
    return None


def _cpu_name() -> str:
    with suppress(OSError):
        for line in Path('/proc/cpuinfo').read_text(encoding='utf-8').splitlines():
            if line.startswith('model name'):
                return line.partition(':')[2].strip()
    return platform.machine()


def _commit(source: Path) -> str | None:
    """Commit that holds the file `source`, None if git does not know the file.

    An installed package may lie inside another repository, whose commit says nothing of it.
    """
    said = ''
    for words in (
        ('ls-files', '--error-unmatch', source.name),
        ('describe', '--always', '--abbrev=40', '--dirty', '--exclude=*'),
    ):
        try:
            said = subprocess.run(
                ['git', *words], cwd=source.parent, check=True, capture_output=True, text=True,
                timeout=10.0,
            ).stdout.strip()  # fmt: skip
        except (OSError, subprocess.SubprocessError):
            return None
    return said
