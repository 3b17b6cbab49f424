"""The command `experiment`: tables, options; what it and `evaluate` refuse."""

import json
import sys

import pytest
from cli_runner import error_line, run
from evaluation_samples import write_streets

from gp_ground_seg.cli.evaluate import EXPERIMENTS
from gp_ground_seg.data import semantic_kitti
from gp_ground_seg.lab import cluster, table1

pytestmark = pytest.mark.usefixtures('compiled_code')


@pytest.fixture(scope='module')
def root(tmp_path_factory):
    return write_streets(tmp_path_factory.mktemp('kitti'), s00=3, s08=1)


CASES = {
    'ablation ROOT --frame-step 3': ({'models': 8, 'pairs': 8}, 8 * 2),
    'steps ROOT --frame-step 3': ({'steps': 9}, 9 * 2),
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


REFUSED = {
    'experiment ablation ROOT --seeds 2': '--seeds: is for simulated scans',
    'experiment ablation --frame-step 2': '--frame-step: is for labelled scans',
    'experiment ablation ROOT --sequences 07': 'no velodyne/*.bin in it; sequences here: 00, 08',
    'experiment ablation --set length_scale.model=latent2': 'length_scale.model',
    'experiment scenes --scenes flat,flat': 'each once',
    'experiment table1': 'ROOT',
    'experiment table1 ROOT --sequences 08': 'in sequence ',
    'experiment scenes --json MINE': '--force',
    'experiment': 'NAME',
    'experiment moon': 'moon',
    'evaluate ROOT --sequences ,': 'no sequence has labels, of 00, 08',
    'evaluate ROOT --json /no/such/folder/x.json': '/no/such/folder',
    'evaluate ROOT --cut=-0.1': 'must be a number, at least 0',
    'evaluate ROOT --set sensor.height=0 --peer patchworkpp': 'set sensor.origin_z above 0',
    'evaluate ROOT --against default': '--against default: the same parameters as given',
    'evaluate ROOT --against no.yaml': 'no.yaml: No such file',
    'evaluate ROOT --against paper --peer patchworkpp': '--peer: not allowed with',
    **{
        f'evaluate MINE --against paper {option} 2': f'{option}: '
        for option in ('--sequences', '--frame-step', '--cut', '--workers')
    },
    # Workers of whole data sets.
    'segment ROOT -o out --workers 99999999999': 'four for each processor',
    **{
        f'segment ROOT -o out --scheduler {address}': 'does not answer'
        for address in ('tcp://127.0.0.1:1', 'tls://127.0.0.1:1', 'somewhere')
    },
    # A missing package.
    **{
        f'{package} segment ROOT -o out {words}': f'{package} is not installed'
        for package, words in (
            ('distributed', '--workers 1'),
            ('cryptography', '--workers 1'),
            ('distributed', '--scheduler tcp://127.0.0.1:1'),
        )
    },
    'pandas evaluate ROOT': 'pandas is not installed',
    'pandas experiment steps ROOT': 'pandas is not installed',
    'tabulate evaluate ROOT --markdown': 'tabulate is not installed',
    'pypatchworkpp evaluate ROOT --peer patchworkpp': 'pypatchworkpp is not installed',
}
"""Commands that stop before any frame is read, and what they say."""


@pytest.mark.parametrize('case', REFUSED)
def test_errors_are_said_before_any_frame_is_read(root, case, capsys, monkeypatch, tmp_path):
    monkeypatch.setattr(semantic_kitti, 'read_points', None)
    monkeypatch.setattr(cluster, 'CONNECT_TIMEOUT', 0.5)
    monkeypatch.chdir(tmp_path)
    target = tmp_path / 'mine.bin'
    target.write_text('mine')
    named = {'ROOT': root, 'MINE': target}
    words = [named.get(word, word) for word in case.split()]
    if 'not installed' in REFUSED[case]:
        monkeypatch.setitem(sys.modules, words.pop(0), None)
    assert run(*words) == 2
    assert REFUSED[case] in error_line(capsys)
    assert [path.read_text() for path in tmp_path.iterdir()] == ['mine']
