"""The command `evaluate`, by what it prints and writes."""

import argparse
import fcntl
import json
import os
import pty
import struct
import subprocess
import sys
import termios
from pathlib import Path

import pytest
from evaluation_samples import real_kitti, write_streets

from gp_ground_seg.cli import evaluate as command
from gp_ground_seg.errors import ConfigError, DataError
from gp_ground_seg.evaluation import evaluate as runner


def run(*words):
    parser = argparse.ArgumentParser()
    command.add_parser(parser.add_subparsers(required=True))
    arguments = parser.parse_args(['evaluate', *(str(word) for word in words)])
    return arguments.run(arguments)


@pytest.fixture(scope='module')
def root(tmp_path_factory):
    return write_streets(tmp_path_factory.mktemp('kitti'), s00=2, s08=1)


def table(output, title):
    """Rows below the rule of a table, split at runs of two blanks, by first cell."""
    lines = output.splitlines()
    start = next(k for k, line in enumerate(lines) if line.startswith(title))
    rows = {}
    rule = next(k for k in range(start, len(lines)) if lines[k].startswith('---'))
    for line in lines[rule + 1 :]:
        if not line:
            break
        if line.startswith('---'):
            continue
        cells = [cell.strip() for cell in line.split('  ') if cell.strip()]
        rows[cells[0]] = cells[1:]
    return rows


def test_tables_say_what_the_json_says(root, tmp_path, capsys):
    target = tmp_path / 'scores.json'
    assert run(root, '--json', target, '--peer', 'patchworkpp') == 0
    output = capsys.readouterr().out
    document = json.loads(target.read_text())
    ours, peer = (document['methods'][name] for name in ('gp_ground_seg', 'patchworkpp'))
    for key, title in (('groundgrid', 'GroundGrid convention'), ('patchwork', 'Patchwork conv')):
        rows = table(output, title)
        for name, n_frames in (('00', '2'), ('08', '1'), ('all', '3')):
            scores = ours['pooled'] if name == 'all' else ours['sequences'][name]
            its = peer['pooled'] if name == 'all' else peer['sequences'][name]
            ratios = ('precision', 'recall', 'f1', 'accuracy', 'iou')
            expected = [f'{100 * scores[key][ratio]:.2f}' for ratio in ratios]
            difference = scores[key]['iou'] - its[key]['iou']
            expected += [f'{100 * its[key]["iou"]:.2f}', f'{100 * difference:+.2f}']
            assert rows[name] == [n_frames, *expected]
    headline = f'IoU {100 * ours["pooled"]["groundgrid"]["iou"]:.2f} %'
    assert output.startswith(f'{headline}, Patchwork++ ')
    times = table(output, 'Time per frame')
    assert float(times['Patchwork++'][0]) == pytest.approx(
        peer['ms_per_frame']['median'], abs=0.051
    )
    assert float(times['Patchwork++'][2]) == pytest.approx(
        document['median_time_ratio']['patchworkpp'], abs=0.0051
    )
    assert document['environment']['versions']['pypatchworkpp']
    assert document['n_threads'] >= 1


def test_class_table(root, tmp_path, capsys):
    run(root, '--json', tmp_path / 'scores.json')
    rows = table(capsys.readouterr().out, 'Classes')
    classes = json.loads((tmp_path / 'scores.json').read_text())['methods']['gp_ground_seg'][
        'classes'
    ]
    assert len(rows) == len(classes)
    assert rows['road'][:2] == ['ground', '12 000']
    assert rows['building'][0] == 'obstacle'
    assert rows['vegetation'][0] == rows['unlabelled'][0] == rows['outlier'][0] == 'left out'
    assert rows['vegetation'][-1] == '-'
    shares = [float(cells[-1]) for cells in rows.values() if cells[-1] != '-']
    assert sum(shares) == pytest.approx(100.0, abs=0.1)


def test_without_a_peer_nothing_of_it_is_shown(root, capsys):
    run(root, '--sequences', '08')
    output = capsys.readouterr().out
    assert 'Patchwork++' not in output
    assert '1 frame of 1 sequence)' in output
    assert 'ours / this' not in output


def test_settings_change_the_result_and_are_said(root, tmp_path, capsys):
    settings = ['label.ground_tolerance=0.011', 'sensor.height=1.7', 'growth.seed_range=19.5']
    settings += ['runtime.n_threads=1', 'lines.max_gap=1.25', 'grid.r_max=15.0']
    run(root, '--json', tmp_path / 'a.json')
    run(root, '--json', tmp_path / 'b.json', *(f'--set={setting}' for setting in settings))
    a, b = (json.loads((tmp_path / f'{name}.json').read_text()) for name in 'ab')
    assert a['config_changes'] == {}
    assert b['config_changes']['label.ground_tolerance'] == 0.011
    assert b['n_threads'] == 1
    recall = [d['methods']['gp_ground_seg']['pooled']['groundgrid']['recall'] for d in (a, b)]
    assert recall[1] < recall[0]
    output = capsys.readouterr().out
    assert 'parameters: defaults' in output
    assert all(setting in output for setting in settings)
    assert max(len(line) for line in output.splitlines() if 'every number' not in line) <= 100


def test_width_on_real_frames(capsys):
    run(real_kitti(), '--sequences', '00', '--peer', 'patchworkpp')
    output = capsys.readouterr().out
    assert max(len(line) for line in output.splitlines()) <= 100
    iou = float(output.split()[1])
    assert iou > 94.0


def test_json_is_not_overwritten_without_force(root, tmp_path, monkeypatch):
    target = tmp_path / 'scores.json'
    target.write_text('mine')
    with monkeypatch.context() as patched:
        # Refused before any frame is read.
        patched.setattr(runner, 'read_points', None)
        with pytest.raises(DataError, match='--force'):
            run(root, '--json', target)
    assert target.read_text() == 'mine'
    run(root, '--json', target, '--force')
    assert json.loads(target.read_text())['n_frames'] == 3
    assert [path.name for path in tmp_path.iterdir()] == ['scores.json']


def test_a_run_that_fails_leaves_nothing(tmp_path):
    root = write_streets(tmp_path / 'kitti', s00=2)
    broken = root / 'sequences/00/velodyne/000001.bin'
    broken.write_bytes(broken.read_bytes()[:-3])
    (tmp_path / 'out').mkdir()
    with pytest.raises(DataError, match=r'000001\.bin'):
        run(root, '--json', tmp_path / 'out' / 'scores.json')
    assert list((tmp_path / 'out').iterdir()) == []


@pytest.mark.parametrize(
    ('words', 'error', 'message'),
    [
        (['--sequences', '07'], DataError, 'no sequence 07; sequences here: 00, 08'),
        (['--sequences', ','], DataError, 'no sequence asked for'),
        (['--set', 'label.ground_tolerence=1'], ConfigError, 'label.ground_tolerance'),
        (['--json', '/no/such/folder/x.json'], DataError, '/no/such/folder'),
    ],
)
def test_errors_are_said(root, words, error, message):
    with pytest.raises(error, match=message):
        run(root, *words)


def test_a_root_without_sequences(tmp_path):
    with pytest.raises(DataError, match='SemanticKITTI layout'):
        run(tmp_path)


SCRIPT = """
import argparse, sys
from gp_ground_seg.cli import evaluate
parser = argparse.ArgumentParser()
evaluate.add_parser(parser.add_subparsers())
arguments = parser.parse_args(sys.argv[1:])
sys.exit(arguments.run(arguments))
"""


def test_progress_only_on_a_terminal(root):
    words = [sys.executable, '-c', SCRIPT, 'evaluate', str(root)]
    repository = Path(__file__).parents[1]
    quiet = subprocess.run(words, cwd=repository, capture_output=True, timeout=120)
    assert (quiet.returncode, quiet.stderr) == (0, b'')
    terminal, end = pty.openpty()
    fcntl.ioctl(end, termios.TIOCSWINSZ, struct.pack('HHHH', 24, 80, 0, 0))
    shown = subprocess.run(words, cwd=repository, stdout=subprocess.PIPE, stderr=end, timeout=120)
    os.close(end)
    progress = os.read(terminal, 100_000)
    os.close(terminal)
    assert b'/3' in progress
    assert shown.returncode == 0, progress
    # The tables are the same either way, but for the times.
    assert shown.stdout.splitlines()[3:12] == quiet.stdout.splitlines()[3:12]
