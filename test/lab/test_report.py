"""Tables in their three forms; what is recorded of machine, source and parameters."""

import json
import math
import os
import platform
import shutil
import subprocess

import numpy as np
import pandas as pd
import pytest

from gp_ground_seg import Config, __version__
from gp_ground_seg.lab.scoring import report
from gp_ground_seg.lab.scoring.report import Column, Table

TABLE = Table(
    {
        Column('sequence', key='name'): ['00', '08', 'all'],
        Column('points', '_d'): np.array([1234567, 5, 1234572]),
        Column('IoU [%]', '.2f', 'iou', 100.0): pd.Series([0.9876, math.nan, 0.5]),
        Column('change [%]', '+.1f', 'change', 100.0): [-0.001, None, 0.25],
    },
    title='Scores',
    notes=['a note'],
    n_sums=1,
)
FORMS = {
    'text': (
        'Scores\n'
        'sequence     points  IoU [%]  change [%]\n'
        '----------------------------------------\n'
        '00        1 234 567    98.76        -0.1\n'
        '08                5        -           -\n'
        '----------------------------------------\n'
        'all       1 234 572    50.00       +25.0\n'
        '\n'
        'a note'
    ),
    'markdown': (
        'Scores\n\n'
        '| sequence | points | IoU [%] | change [%] |\n'
        '| --- | --: | --: | --: |\n'
        '| 00 | 1 234 567 | 98.76 | -0.1 |\n'
        '| 08 | 5 | - | - |\n'
        '| all | 1 234 572 | 50.00 | +25.0 |\n\n'
        'a note'
    ),
    'json': [
        {'name': '00', 'points': 1234567, 'iou': 0.9876, 'change': -0.001},
        {'name': '08', 'points': 5, 'iou': None, 'change': None},
        {'name': 'all', 'points': 1234572, 'iou': 0.5, 'change': 0.25},
    ],
}


@pytest.mark.parametrize('form', FORMS)
def test_forms_of_a_table(form):
    assert getattr(TABLE, form)() == FORMS[form]


def test_long_titles_are_folded_in_the_terminal_only():
    table = Table({Column('a'): ['b']}, title='word ' * 40)
    assert max(map(len, table.text().splitlines())) <= report.WIDTH
    assert len(table.markdown().splitlines()[0]) > report.WIDTH


def test_rows_of_several_units_of_another_length_and_none():
    what = Column('what')
    number = Column('n', ('.1f', '.3f'), scale=(100, 1))
    table = Table({what: ['share', 'time'], number: [0.5, 2]})
    assert table.text().splitlines()[2:] == ['share   50.0', 'time   2.000']
    assert table.json() == [{'what': 'share', 'n': 0.5}, {'what': 'time', 'n': 2}]
    with pytest.raises(ValueError, match='zip'):
        Table({what: ['share', 'time'], number: [0.5]}).text()
    nothing = Table({what: []}, 'title', ['nothing'])
    assert (nothing.text(), nothing.json()) == ('title\n\nnothing', [])


def test_counts_are_whole_numbers_also_where_a_column_has_gaps():
    column = Column('lost', '_d')
    table = Table({column: pd.Series([1200.0, math.nan])})
    assert table.text().splitlines()[2:] == ['1 200', '    -']
    assert table.json() == [{'lost': 1200}, {'lost': None}]
    assert isinstance(table.json()[0]['lost'], int)


def test_json_files_have_null_for_what_is_undefined(tmp_path):
    report.write_json({'a': [math.nan, {'b': (1.0, math.nan)}]}, tmp_path / 'a.json')
    assert json.loads((tmp_path / 'a.json').read_text()) == {'a': [None, {'b': [1.0, None]}]}
    report.write_json([np.int64(3), np.float64(math.nan), np.bool_(True)], tmp_path / 'b.json')
    assert json.loads((tmp_path / 'b.json').read_text()) == [3, None, True]


def test_parameters_and_environment_are_recorded():
    changes = {'label.ground_tolerance': 0.123, 'runtime.backend': 'numpy'}
    assert report.changed_parameters(Config()) == {}
    assert report.changed_parameters(Config().replace(**changes)) == changes
    assert report.parameters_line({}) == 'parameters: defaults'
    assert 'runtime.backend=numpy' in report.parameters_line(changes)
    environment = report.describe_environment('no-such-package')
    assert environment['versions']['gp_ground_seg'] == __version__
    assert environment['versions']['no-such-package'] is None
    assert environment['n_cores'] == len(os.sched_getaffinity(0))
    assert environment['python'] == platform.python_version()
    assert environment['cpu']
    line = report.machine_line({**environment, 'n_cores': 1, 'commit': f'{"a" * 40}-dirty'})
    assert ', 1 core; Python' in line and 'no-such-package absent' in line
    assert line.endswith(f'commit {"a" * 12} (changed since)')
    assert 'commit' not in report.machine_line({**environment, 'commit': None})


def git(folder, *words):
    identity = ['-c', 'user.name=a', '-c', 'user.email=a@b', '-c', 'commit.gpgsign=false']
    run = ['git', *identity, *words]
    return subprocess.run(run, cwd=folder, check=True, capture_output=True, text=True).stdout


def test_commit_is_that_of_the_source_or_none(tmp_path):
    source = tmp_path / 'package' / '__init__.py'
    source.parent.mkdir()
    source.write_text('')
    assert report._commit(source) is None
    if shutil.which('git') is None:
        return
    git(tmp_path, 'init')
    (tmp_path / 'other').write_text('')
    git(tmp_path, 'add', 'other')
    git(tmp_path, 'commit', '-m', 'another repository')
    assert report._commit(source) is None  # inside a repository that is not its own
    git(tmp_path, 'add', 'package')
    git(tmp_path, 'commit', '-m', 'ours')
    commit = git(tmp_path, 'rev-parse', 'HEAD').strip()
    assert report._commit(source) == commit
    source.write_text('changed')
    assert report._commit(source) == f'{commit}-dirty'
