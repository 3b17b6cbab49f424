"""Tables in their three forms; what is recorded of machine, source and parameters."""

import json
import math
import os
import platform
import shutil
import subprocess

import pytest

from gp_ground_seg import Config, __version__
from gp_ground_seg.lab.scoring import report
from gp_ground_seg.lab.scoring.report import Column, Table

TABLE = Table(
    [
        [
            (Column('sequence', key='name'), name),
            (Column('points', '_d'), n_points),
            (Column('IoU [%]', '.2f', 'iou', 100.0), iou),
            (Column('change [%]', '+.1f', 'change', 100.0), change),
        ]
        for name, n_points, iou, change in (
            ('00', 1234567, 0.9876, -0.001),
            ('08', 5, math.nan, None),
            ('all', 1234572, 0.5, 0.25),
        )
    ],
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
    table = Table([[(Column('a'), 'b')]], title='word ' * 40)
    assert max(map(len, table.text().splitlines())) <= report.WIDTH
    assert len(table.markdown().splitlines()[0]) > report.WIDTH


def test_rows_of_several_units_of_another_length_and_none():
    rows = [[(Column('what'), 'share'), (Column('n', '.1f', scale=100), 0.5)],
            [(Column('what'), 'time'), (Column('n', '.3f'), 2)]]  # fmt: skip
    assert Table(rows).text().splitlines()[2:] == ['share   50.0', 'time   2.000']
    assert Table(rows).json() == [{'what': 'share', 'n': 0.5}, {'what': 'time', 'n': 2}]
    with pytest.raises(ValueError, match='zip'):
        Table([rows[0], rows[1][:1]]).text()
    nothing = Table([], 'title', ['nothing'])
    assert (nothing.text(), nothing.json()) == ('title\n\nnothing', [])


def test_json_files_have_null_for_what_is_undefined(tmp_path):
    report.write_json({'a': [math.nan, {'b': (1.0, math.nan)}]}, tmp_path / 'a.json')
    assert json.loads((tmp_path / 'a.json').read_text()) == {'a': [None, {'b': [1.0, None]}]}


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
