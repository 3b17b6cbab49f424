"""The command `experiment`: its tables, and the rows below them."""

import json

import pytest
from cli_runner import run
from evaluation_samples import write_streets

from gp_ground_seg import Config
from gp_ground_seg.cli.evaluate import EXPERIMENTS
from gp_ground_seg.lab import table1

pytestmark = pytest.mark.usefixtures('compiled_code')


@pytest.fixture(scope='module')
def root(tmp_path_factory):
    return write_streets(tmp_path_factory.mktemp('kitti'), s00=3, s08=1)


CASES = {
    'ablation ROOT --frame-step 3': ({'models': 8, 'pairs': 8}, 8 * 2),
    'steps ROOT --sequences 08': ({'steps': 9}, 9),
    'pseudo-inputs ROOT --frame-step 3': ({'pseudo_inputs': 7}, 7 * 2),
    'scenes --scenes low_boxes,bank,ramp --sensors vlp-16 --seeds 1':
        ({'scenes': 3, 'low': 1, 'rough': 3}, 2 * 3),
    'table1 ROOT': ({'variances': 2 * 3 + 4, 'errors': 2 * 3 + 4}, 2 * 3),
    'speed ROOT --frame-step 3': ({'times': 5, 'stages': 4}, 5 * 2 * 3),
}  # fmt: skip
"""Words of the command, the lengths of its tables, and the number of all rows."""


@pytest.mark.parametrize('case', CASES)
def test_tables_and_the_rows_below_them(case, root, tmp_path, capsys, monkeypatch):
    fewer = EXPERIMENTS['scenes']._replace(places=(0.0,))
    monkeypatch.setitem(EXPERIMENTS, 'scenes', fewer)
    chosen = {('00', '000000'): (3, 4), ('00', '000001'): (5,)}
    monkeypatch.setattr(table1, 'CHOICES', chosen)
    monkeypatch.setattr(table1, 'N_REPEATS', 1)
    words = [root if word == 'ROOT' else word for word in case.split()]
    own = ['--set', 'grid.n_bins=40', '--json', tmp_path / 'a.json', '--markdown']
    assert run('experiment', *words, *own) == 0
    document = json.loads((tmp_path / 'a.json').read_text())
    assert document['experiment'] == words[0]
    assert document['config_changes'] == {'grid.n_bins': 40}
    assert document['config'] == Config().replace(**{'grid.n_bins': 40}).nested()
    tables = {key: found for key, found in document.items() if isinstance(found, list)}
    lengths, n_rows = CASES[case]
    rows = tables.pop('rows')
    assert len(rows) == n_rows
    if words[0] in ('ablation', 'speed'):
        fixed = 'not learned', 'theta fixed', 'interpolation'
        for row in rows:
            mode = 'fixed' if any(word in row['method'] for word in fixed) else 'every_frame'
            assert row['mode'] == (None if row['method'] == 'Patchwork++' else mode)
            assert 'numpy' not in row['method'] or row['backend'] == 'numpy'
    if words[0] == 'scenes':
        found = [(row['sequence'], row['index']) for row in rows]
        assert found == 2 * [(f'vlp-16 {name}', '0/0') for name in ('low_boxes', 'bank', 'ramp')]
    assert {name: len(rows) for name, rows in tables.items()} == lengths
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith('| ')]
    assert len(lines) == sum(lengths.values()) + len(lengths)
