"""The command `evaluate`, by what it prints, writes and draws."""

import json

import numpy as np
import pytest
from cli_runner import error_line, run
from evaluation_samples import street, write_streets
from matplotlib.image import imread

from gp_ground_seg.evaluation import evaluate as runner
from gp_ground_seg.evaluation.metrics import RATIOS, Confusion


def rows_of(output, title=''):
    """Rows below the rule of a table, split at runs of two blanks, by first cell."""
    lines = output.splitlines()
    start = next(k for k, line in enumerate(lines) if line.startswith(title))
    rule = next(k for k in range(start, len(lines)) if lines[k].startswith('---'))
    rows = {}
    for line in lines[rule + 1 :]:
        if not line:
            break
        if not line.startswith('---'):
            first, *cells = (cell.strip() for cell in line.split('  ') if cell.strip())
            rows[first] = cells
    return rows


@pytest.fixture(scope='module')
def root(tmp_path_factory):
    return write_streets(tmp_path_factory.mktemp('kitti'), s00=2, s08=1)


@pytest.fixture(scope='module')
def evaluated(root, tmp_path_factory):
    """Files of a run beside Patchwork++."""
    folder = tmp_path_factory.mktemp('evaluated')
    options = ('--json', 'a.json'), ('--reliability', 'a.png')
    words = [word for option, name in options for word in (option, folder / name)]
    assert run('evaluate', root, *words, '--worst', 2, '--peer', 'patchworkpp') == 0
    return folder


def test_tables_hold_the_sums_of_the_frames(root, evaluated, capsys):
    run('evaluate', root, '--peer', 'patchworkpp')
    output, errors = capsys.readouterr()
    assert errors == ''  # no progress where standard error is no terminal
    assert max(len(line) for line in output.splitlines()) <= 100
    document = json.loads((evaluated / 'a.json').read_text())
    frames = document['rows']
    for key, title in (('groundgrid', 'GroundGrid conv'), ('patchwork', 'Patchwork conv')):
        rows = rows_of(output, title)
        for name, n_frames in (('00', '2'), ('08', '1'), ('all', '3')):
            sums = []
            for method in ('gp_ground_seg', 'patchworkpp'):
                own = [f for f in frames if f['method'] == method and f['sequence'] == name]
                own = own or [f for f in frames if f['method'] == method]
                counts = [sum(f[f'{key}_{n}'] for f in own) for n in ('tp', 'fp', 'fn', 'tn')]
                sums.append(Confusion(*counts))
            ours, its = sums
            cells = [f'{100 * getattr(ours, ratio):.2f}' for ratio in RATIOS]
            cells += [f'{100 * its.iou:.2f}', f'{100 * (ours.iou - its.iou):+.2f}']
            assert rows[name] == [n_frames, *cells]
            (row,) = (row for row in document[key] if row['sequence'] == name)
            assert row['iou'] == pytest.approx(ours.iou)
    headline = f'IoU {100 * document["groundgrid"][-1]["iou"]:.2f} %, Patchwork++ '
    assert output.startswith(headline)
    times = {row['method']: row for row in document['times']}
    seconds = [f['seconds'] for f in frames if f['method'] == 'patchworkpp']
    assert times['Patchwork++']['median'] == pytest.approx(np.median(seconds))
    ratio = times['gp_ground_seg']['median'] / times['Patchwork++']['median']
    assert times['Patchwork++']['ratio'] == pytest.approx(ratio)
    assert document['environment']['versions']['pypatchworkpp']
    assert document['n_threads'] >= 1
    for row in frames:
        assert row['points'] == len(street()[0])
        assert row['main_error_class'] in ('road', 'building')
        # Pose and state of learning are those of our method only.
        assert (row.get('status') in ('converged', 'budget')) == (row['method'] != 'patchworkpp')


def test_classes_rings_and_probabilities(evaluated):
    document = json.loads((evaluated / 'a.json').read_text())
    classes = {row['class']: row for row in document['classes']}
    assert (classes['road']['counts_as'], classes['road']['points']) == ('ground', 12_000)
    assert classes['building']['counts_as'] == 'obstacle'
    assert classes['building']['missed'] is classes['road']['false'] is None
    assert {classes[n]['counts_as'] for n in ('vegetation', 'unlabelled')} == {'left out'}
    assert classes['vegetation']['share_of_errors'] is None
    for name in ('share_of_points', 'share_of_errors'):
        assert sum(row[name] or 0.0 for row in classes.values()) == pytest.approx(1.0)
    ious = sorted(
        f['groundgrid_iou'] for f in document['rows'] if f['method'] == 'gp_ground_seg'
    )  # fmt: skip
    assert [row['iou'] for row in document['worst']] == ious[:2]
    assert {row['most errors on'] for row in document['worst']} <= {'road', 'building'}
    assert imread(evaluated / 'a.png').shape[2] == 4
    rings = {row['range']: row for row in document['rings']}
    assert rings['> 50 m']['iou'] is rings['> 50 m']['patchworkpp_iou'] is None
    assert sum(row['share_of_errors'] for row in rings.values()) == pytest.approx(1.0)
    pooled = document['probabilities'][-1]
    bins = [row for row in document['reliability'] if row['sequence'] == 'all']
    assert sum(row['points'] for row in bins) == pooled['points']
    gaps = [
        row['points'] * abs(row['share_ground'] - row['mean_p']) for row in bins if row['points']
    ]
    assert sum(gaps) / pooled['points'] == pytest.approx(pooled['ece'])


def test_settings_change_the_result_and_are_said(root, tmp_path, capsys):
    settings = ['label.ground_tolerance=0.011', 'sensor.height=1.7', 'growth.seed_range=19.5']
    settings += ['runtime.n_threads=1', 'lines.max_gap=1.25', 'grid.r_max=15.0']
    run('evaluate', root, '--json', tmp_path / 'a.json')
    words = [f'--set={setting}' for setting in settings]
    run('evaluate', root, '--json', tmp_path / 'b.json', *words)
    a, b = (json.loads((tmp_path / f'{name}.json').read_text()) for name in 'ab')
    assert a['config_changes'] == {}
    assert b['config_changes']['label.ground_tolerance'] == 0.011
    assert b['n_threads'] == 1
    assert b['groundgrid'][-1]['recall'] < a['groundgrid'][-1]['recall']
    output = capsys.readouterr().out
    assert 'Patchwork++' not in output
    assert 'parameters: defaults' in output
    assert all(setting in output for setting in settings)
    assert max(len(line) for line in output.splitlines() if 'every number' not in line) <= 100


@pytest.mark.parametrize('option', ['--json', '--reliability'])
def test_files_are_not_overwritten_without_force(root, tmp_path, option, monkeypatch, capsys):
    target = tmp_path / 'mine'
    target.write_text('mine')
    with monkeypatch.context() as patched:
        patched.setattr(runner, 'read_points', None)  # refused before any frame is read
        assert run('evaluate', root, option, target) == 2
    assert '--force' in error_line(capsys)
    assert target.read_text() == 'mine'
    assert run('evaluate', root, option, target, '--force') == 0
    assert target.read_bytes() != b'mine'
    assert list(tmp_path.iterdir()) == [target]


def test_a_run_that_fails_leaves_nothing(tmp_path, capsys):
    root = write_streets(tmp_path / 'kitti', s00=2)
    broken = root / 'sequences/00/velodyne/000001.bin'
    broken.write_bytes(broken.read_bytes()[:-3])
    (tmp_path / 'out').mkdir()
    assert run('evaluate', root, '--json', tmp_path / 'out' / 'scores.json') == 2
    assert '000001.bin' in capsys.readouterr().err
    assert list((tmp_path / 'out').iterdir()) == []


@pytest.mark.parametrize(
    ('words', 'message'),
    [
        (['--sequences', '07'], 'no sequence 07; sequences here: 00, 08'),
        (['--sequences', ','], 'no sequence asked for; sequences here: 00, 08'),
        (['--sequences', '../sequences/00'], 'no sequence ../sequences/00'),
        (['--set', 'label.ground_tolerence=1'], 'label.ground_tolerance'),
        (['--json', '/no/such/folder/x.json'], '/no/such/folder'),
    ],
)
def test_errors_are_said(root, words, message, capsys):
    assert run('evaluate', root, *words) == 2
    assert message in error_line(capsys)


def test_frames_without_a_scored_point_and_a_root_without_sequences(tmp_path, capsys):
    root = write_streets(tmp_path / 'kitti', s00=1)
    label = root / 'sequences/00/labels/000000.label'
    label.write_bytes(bytes(len(label.read_bytes())))  # all unlabelled
    assert run('evaluate', root, '--worst', 2) == 0
    capsys.readouterr()
    for wrong, message in ((root, 'no scored point'), (tmp_path, 'SemanticKITTI layout')):
        assert run('evaluate', wrong, '--reliability', tmp_path / 'a.png') == 2
        assert message in error_line(capsys)
    assert not (tmp_path / 'a.png').exists()
