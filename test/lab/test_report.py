"""Tables in their three forms; what is recorded of machine, source and parameters."""

import math
import subprocess

import pandas as pd

from gp_ground_seg import __version__
from gp_ground_seg.lab.scoring import report
from gp_ground_seg.lab.scoring.report import Form, Table

TABLE = Table(
    'Scores',
    pd.DataFrame({
        'name': ['00', '08', 'all'],
        'points': [1234567.0, math.nan, 1234572.0],
        'iou': [0.9876, math.nan, 0.5],
        'peer_iou': [0.25, 2e-20, None],
        'change': [-0.001, None, 0.25],
    }),
    {
        'name': Form('sequence'), 'points': Form('points', ',.0f'),
        'iou': Form('IoU [%]', '.2f', 100.0), 'change': Form('change', '+.1f', 100.0),
    },
)  # fmt: skip
CELLS = [
    ['sequence', 'points', 'IoU [%]', 'peer IoU [%]', 'change'],
    ['00', '1 234 567', '98.76', '25.00', '-0.1'],
    ['08', '-', '-', '0.00', '-'],
    ['all', '1 234 572', '50.00', '-', '+25.0'],
]


def test_forms_of_a_table():
    title, *lines = TABLE.text().splitlines()
    assert title == 'Scores'
    assert [line.split() for line in lines] == [' '.join(row).split() for row in CELLS]
    assert len({*map(len, lines)}) == 1
    title, table = TABLE.text(markdown=True).split('\n\n')
    titles, rule, *rows = (line.split('|')[1:-1] for line in table.splitlines())
    assert [[cell.strip() for cell in row] for row in (titles, *rows)] == CELLS
    assert [mark[-1] == ':' for mark in rule] == [False, True, True, True, True]
    assert report.records(TABLE.frame) == [
        {'name': '00', 'points': 1234567, 'iou': 0.9876, 'peer_iou': 0.25, 'change': -0.001},
        {'name': '08', 'points': None, 'iou': None, 'peer_iou': 2e-20, 'change': None},
        {'name': 'all', 'points': 1234572, 'iou': 0.5, 'peer_iou': None, 'change': 0.25},
    ]


def test_the_environment_is_recorded():
    environment = report.describe_environment('no-such-package')
    assert environment['versions'].items() >= {
        'gp_ground_seg': __version__, 'no-such-package': None
    }.items()  # fmt: skip
    environment |= {'n_cores': 1, 'commit': f'{"a" * 40}-dirty'}
    line = report.machine_line(environment, 'numba')
    assert ', 1 thread on 1 core, numba; Python' in line and 'no-such-package absent' in line
    assert line.endswith(f'commit {"a" * 12} (changed since)')
    assert 'commit' not in report.machine_line({**environment, 'commit': None}, 'numpy')


def test_commit_is_that_of_the_source_or_none(tmp_path):
    source = tmp_path / 'package' / '__init__.py'
    source.parent.mkdir()
    source.write_text('')
    assert report._commit(source) is None

    def git(*words):
        identity = ['-c', 'user.name=a', '-c', 'user.email=a@b', '-c', 'commit.gpgsign=false']
        subprocess.run(['git', *identity, *words], cwd=tmp_path, check=True, capture_output=True)

    git('init')
    git('commit', '--allow-empty', '-m', 'another repository')
    assert report._commit(source) is None  # inside a repository that is not its own
    git('add', 'package')
    git('commit', '-m', 'ours')
    commit = report._commit(source)
    assert len(commit) == 40
    source.write_text('changed')
    assert report._commit(source) == f'{commit}-dirty'
