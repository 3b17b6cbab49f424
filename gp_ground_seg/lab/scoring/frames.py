"""Scores of methods as frames of pandas: rows of sums, which `groupby` adds up.

The only module that imports pandas. A table is sums over some of the rows, then ratios of them.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

from gp_ground_seg.core.errors import require
from gp_ground_seg.lab.scoring.metrics import COUNTS
from gp_ground_seg.lab.scoring.objects import OBJECT_COUNTS

if TYPE_CHECKING:
    from pandas import DataFrame

ALL = 'all'
KEYS = ('method', 'sequence', 'index')
"""Columns of every frame. Method and sequence are in the order of the methods and the scans."""
COLUMNS: dict[str, tuple[str, ...]] = {
    'scans': KEYS,
    'rings': (*KEYS, 'range', *COUNTS),
    'bins': (*KEYS, 'bin', 'n', 'n_ground', 'p'),
    'objects': (*KEYS, 'class', 'range', *OBJECT_COUNTS),
    'times': KEYS,
}
"""Columns that each frame has, even without rows."""

Rows = dict[str, list[dict[str, Any]]]
"""Rows of each frame."""


class Scores(NamedTuple):
    """How methods did on the same scans; one frame for what is grouped alike.

    Attributes
    ----------
    rows : the rows of each frame; each has the columns that its method has
    scans : sums of each scan: `COUNTS` in each convention with its key before them as in
        ``groundgrid_tp``, of `metrics.height_sums`, `OBJECT_COUNTS`, shares; seconds, pose, fit
    rings : `COUNTS` of each ring of a scan, in the convention that counts
    bins : `metrics.count_bins` of each scan
    objects : `OBJECT_COUNTS` of each scan, by class and band
    times : seconds of each stage, of methods that report them
    """

    rows: Rows
    scans: DataFrame
    rings: DataFrame
    bins: DataFrame
    objects: DataFrame
    times: DataFrame

    @property
    def methods(self) -> list[str]:
        """Names of the methods, in order."""
        return list(dict.fromkeys(row['method'] for row in self.rows['scans']))

    @property
    def sequences(self) -> list[str]:
        """Names of the sequences, in order."""
        return list(dict.fromkeys(row['sequence'] for row in self.rows['scans']))

    @property
    def conventions(self) -> list[str]:
        """Keys of the conventions, the one that counts first; none without labels."""
        return [name.removesuffix('_tp') for name in self.scans if name.endswith('_tp')]

    def of(
        self, methods: Collection[str] | None = None, sequences: Collection[str] | None = None
    ) -> Scores:
        """Return the part of some methods and sequences, by default of all."""
        return make_scores([{
            name: [
                row for row in rows
                if (methods is None or row['method'] in methods)
                and (sequences is None or row['sequence'] in sequences)
            ]
            for name, rows in self.rows.items()
        }])  # fmt: skip


def make_scores(parts: Iterable[Rows]) -> Scores:
    """Make frames of rows, in the order of the methods."""
    pandas, parts = require_pandas(), [*parts]
    rows = {name: [row for part in parts for row in part.get(name, ())] for name in COLUMNS}
    methods = list(dict.fromkeys(row['method'] for row in rows['scans']))
    for own in rows.values():
        own.sort(key=lambda row: methods.index(row['method']))
    frames = (
        # Without a row pandas knows no type, and sums up no column.
        pandas.DataFrame(own) if own else pandas.DataFrame(columns=[*COLUMNS[name]], dtype=float)
        for name, own in rows.items()
    )
    return Scores(rows, *frames)


def require_pandas() -> Any:
    """Import pandas, or raise a MissingDependencyError."""
    return require('pandas', 'pandas')


def with_all(frame: DataFrame, column: str = 'sequence') -> DataFrame:
    """Return the rows, and below them each once more in the group `ALL` of a column."""
    concat = require_pandas().concat
    return concat([frame, frame.assign(**{column: ALL})], ignore_index=True)


def sums(frame: DataFrame, *by: str) -> DataFrame:
    """Sum up the rows of each method, or of each group in it, in the order of the rows."""
    return frame.groupby(['method', *by], sort=False).sum(numeric_only=True)


def each(found: DataFrame, methods: Sequence[str]) -> list[DataFrame]:
    """Return the part of each method of what is grouped by methods first."""
    return [found.loc[method] for method in methods]
