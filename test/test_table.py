"""Tables: alignment, units, undefined cells, and the three forms."""

import json
import math

import pytest

from gp_ground_seg.evaluation.table import WIDTH, Column, Table, write_json

TABLE = Table(
    [
        Column('sequence', key='name'),
        Column('points', '_d'),
        Column('IoU [%]', '.2f', 'iou', 100.0),
        Column('change [%]', '+.1f', 'change', 100.0),
    ],
    [['00', 1234567, 0.9876, -0.001], ['08', 5, math.nan, None], ['all', 1234572, 0.5, 0.25]],
    title='Scores',
    notes=['a note'],
    n_sums=1,
)


def test_text_is_aligned_with_rules_below_titles_and_above_sums():
    assert TABLE.text() == (
        'Scores\n'
        'sequence     points  IoU [%]  change [%]\n'
        '----------------------------------------\n'
        '00        1 234 567    98.76        -0.1\n'
        '08                5        -           -\n'
        '----------------------------------------\n'
        'all       1 234 572    50.00       +25.0\n'
        '\n'
        'a note'
    )


def test_markdown_has_the_same_cells():
    assert TABLE.markdown() == (
        'Scores\n\n'
        '| sequence | points | IoU [%] | change [%] |\n'
        '| --- | --: | --: | --: |\n'
        '| 00 | 1 234 567 | 98.76 | -0.1 |\n'
        '| 08 | 5 | - | - |\n'
        '| all | 1 234 572 | 50.00 | +25.0 |\n\n'
        'a note'
    )


def test_json_holds_unscaled_numbers_by_key():
    assert TABLE.json()[0] == {'name': '00', 'points': 1234567, 'iou': 0.9876, 'change': -0.001}
    assert TABLE.json()[1] == {'name': '08', 'points': 5, 'iou': None, 'change': None}


def test_long_titles_are_folded_in_the_terminal_only():
    table = Table([Column('a')], [['b']], title='word ' * 40)
    assert max(map(len, table.text().splitlines())) <= WIDTH
    assert len(table.markdown().splitlines()[0]) > WIDTH


def test_rows_that_name_their_columns():
    rows = [[(Column('a'), 'x'), (Column('b', 'd'), 1)], [(Column('a'), 'y'), (Column('b'), 2)]]
    found = Table.of(rows, title='t', n_sums=1)
    assert found == Table([Column('a'), Column('b', 'd')], [['x', 1], ['y', 2]], 't', n_sums=1)


def test_a_row_of_another_length_is_refused():
    with pytest.raises(ValueError, match='zip'):
        Table([Column('a'), Column('b')], [['only one']]).text()


def test_json_files_have_null_for_what_is_undefined(tmp_path):
    write_json({'a': [math.nan, {'b': (1.0, math.nan)}]}, tmp_path / 'a.json')
    assert json.loads((tmp_path / 'a.json').read_text()) == {'a': [None, {'b': [1.0, None]}]}
