"""Files that are no scan as they are read: what is said, and that good ones are never refused."""

import os
import re
import subprocess
import sys

import numpy as np
import pytest
from bag_samples import write_ros2_bag
from cli_runner import error_line, run
from conftest import simulated
from evaluation_samples import write_frame

from gp_ground_seg.cli import main as cli
from gp_ground_seg.core.errors import DataError
from gp_ground_seg.data.scan_layout import KITTI, ScanLayout, find_objection
from gp_ground_seg.data.semantic_kitti import read_labels, read_points

SPARSE = 300 * 10**9
DOUBLES = ('--dtype', 'float64')


def missing(points, share, value):
    """Some points without a return, in runs, as on the sky."""
    rng = np.random.default_rng(3)
    lost = np.repeat(rng.random(len(points) // 50 + 1) < share, 50)[: len(points)]
    return np.where(lost[:, None], np.float32(value), points)


GOOD = {
    'as it is': lambda p: p,
    'mostly NaN': lambda p: missing(p, 0.9, np.nan),
    'mostly zero': lambda p: missing(p, 0.9, 0.0),
    'few points': lambda p: p[:: len(p) // 450],
    'one point': lambda p: np.repeat(p[:1], len(p), axis=0),
    'flat': lambda p: p * np.float32([1, 1, 0, 1]),
}
WRONG = {
    'doubles': (lambda p: p.astype('<f8'), '% of the coordinates'),
    'rounded doubles': (
        lambda p: np.round(256.0 * p.astype('<f8')) / 256.0, '% of the coordinates',
    ),
    'millimetres': (
        lambda p: p * np.float32([1000, 1000, 1000, 1]), r'farther than .* m \(millimetres\?',
    ),
    'labels': (
        lambda p: np.where(p[:, 2] < 0, 40, 10 + (7 << 16)).astype('<u4').repeat(4),
        '100% of the coordinates',
    ),
    'NaN': (lambda p: np.full_like(p, np.nan), 'points is finite'),
    'no point': (lambda p: p[:0], 'no points in it'),
    'zeros': (np.zeros_like, 'all points are at the origin'),
}  # fmt: skip


@pytest.fixture(scope='module', params=['vlp-16', 'hdl-64e', 'kitti'])
def scans(request):
    if request.param == 'kitti':
        root = request.getfixturevalue('kitti')
        paths = sorted(root.glob('sequences/*/velodyne/*.bin'))
        return [read_points(path) for path in paths[::6]]
    return [simulated(scene, request.param, 1).points for scene in ('flat', 'rough', 'urban')]


@pytest.mark.parametrize('change', GOOD)
def test_good_scans_are_not_doubted(scans, change):
    assert {find_objection(GOOD[change](points)[:, :3]) for points in scans} == {''}


@pytest.mark.parametrize('change', WRONG)
def test_wrong_data_are_refused_in_a_line_that_names_the_options(scans, tmp_path, change):
    make, problem = WRONG[change]
    layout, path = ScanLayout(doubts='raise'), tmp_path / 'a.bin'
    for points in scans:
        path.write_bytes(make(points).tobytes())
        with pytest.raises(DataError, match=problem) as caught:
            read_points(path, layout)
        assert str(caught.value).startswith(f'{path}: ')
        advice = 'read as 4 columns of float32: --columns and --dtype choose another layout'
        assert str(caught.value).endswith(f'{advice}; --force takes it as it is')


def test_the_library_reads_what_it_is_told(tmp_path):
    points, path = simulated('urban', seed=1).points, tmp_path / 'a.bin'
    for n_columns, dtype in ((3, '<f4'), (4, '<f4'), (5, '<f4'), (4, '<f8'), (7, '<f8')):
        table = np.zeros((len(points), n_columns), dtype)
        table[:, :4] = points[:, :n_columns]
        table.tofile(path)
        read = read_points(path, ScanLayout(n_columns, np.dtype(dtype).name, 'raise'))
        assert (read.dtype, read.flags.writeable) == (np.float32, True)
        expected = points * np.float32([1, 1, 1, n_columns > 3])
        np.testing.assert_array_equal(read, expected)
    # Without a command nothing is judged.
    np.full_like(points, np.nan).tofile(path)
    assert len(read_points(path, KITTI)) == len(points)


@pytest.fixture
def root(tmp_path):
    """A SemanticKITTI folder with two sequences of one frame of doubles, labelled."""
    points = simulated('urban', 'hdl-32e', 1).points
    semantic = np.where(points[:, 2] < -1.5, 40, 10).astype('<u4')
    for sequence in ('00', '01'):
        write_frame(tmp_path / 'root', sequence, 0, points.astype('<f8'), semantic)
    return tmp_path / 'root'


COMMANDS = {
    'segment': 'segment SCAN -o OUT.label',
    'segment folder': 'segment ROOT/sequences/00 -o OUT',
    'plot scan': 'plot scan SCAN -o OUT.png',
    'plot segment': 'plot segment SCAN --azimuth 0 -o OUT.png',
    'kitti-to-bag': 'kitti-to-bag ROOT --sequence 00 OUT.mcap',
    'bench': 'bench ROOT --json OUT.json',
    'evaluate': 'evaluate ROOT --json OUT.json',
    'ablation': 'experiment ablation ROOT --json OUT.json',
    'demo': 'demo --kitti ROOT --output OUT',
}


def words_of(command, root):
    scan = root / 'sequences' / '00' / 'velodyne' / '000000.bin'
    if command == 'demo':
        pytest.importorskip('ros_helpers', reason='ROS is not installed')
    out = root.parent / 'out'
    text = COMMANDS[command].replace('SCAN', str(scan)).replace('ROOT', str(root))
    return text.replace('OUT', str(out)).split()


def what_is_there(root):
    return sorted(path.name for path in root.parent.iterdir())


@pytest.mark.parametrize('command', COMMANDS)
def test_every_command_refuses_wrong_data_and_names_the_option(command, root, capsys):
    assert run(*words_of(command, root)) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith('gp-ground-seg: error: ')
    assert re.search(r'000000\.bin: \d+% of the coordinates are .*; read as 4 columns of', line)
    assert '--columns and --dtype choose another layout; --force takes it' in line
    assert what_is_there(root) == ['root']


@pytest.mark.parametrize('command', ['segment', 'segment folder', 'plot scan'])
def test_the_option_helps_and_force_takes_it_with_a_note(command, root, capsys):
    words = words_of(command, root)
    assert run(*words, *DOUBLES) == 0
    right = capsys.readouterr()
    assert 'read as' not in right.err
    assert run(*words, '--force') == 0
    forced = capsys.readouterr()
    (note,) = [line for line in forced.err.splitlines() if 'note: ' in line and 'read as' in line]
    assert note.endswith('--columns and --dtype choose another layout')
    assert forced.out != right.out


@pytest.mark.parametrize(
    ('words', 'what'),
    [
        ('segment BAG -o OUT.mcap', 'BAG'),
        ('bench BAG', 'BAG'),
        ('bench --from OLD.json', 'OLD.json'),
        ('demo --output OUT', 'a simulated one'),
    ],
)
def test_a_layout_is_for_files_of_scans(tmp_path, monkeypatch, capsys, words, what):
    monkeypatch.chdir(tmp_path)
    write_ros2_bag(tmp_path / 'a.mcap')
    named = words.replace('BAG', 'a.mcap').split()
    for option, value in (DOUBLES, ('--columns', '5')):
        assert run(*named, option, value) == 2
        said = f'{option}: is for .bin scans, which {what.replace("BAG", "a.mcap")} is not'
        assert error_line(capsys) == said
    assert what_is_there(tmp_path / 'a.mcap') == ['a.mcap']


@pytest.mark.parametrize('command', ['segment', 'evaluate'])
def test_a_scan_of_300_gigabytes_is_refused_by_its_size(command, root, capsys):
    (scan,) = root.glob('sequences/00/velodyne/*.bin')
    os.truncate(scan, SPARSE)
    assert run(*words_of(command, root)) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert f'{scan}: {SPARSE} bytes, accepted are at most {1 << 30}' in line
    assert what_is_there(root) == ['root']


def test_other_huge_files_are_refused_by_their_size(root, tmp_path, capsys):
    folder = root / 'sequences' / '00'
    scan, label, times = (
        folder / name for name in ('velodyne/000000.bin', 'labels/000000.label', 'times.txt')
    )
    n_points, yaml = scan.stat().st_size // 32, tmp_path / 'huge.yaml'
    for path in (label, times, yaml):
        path.touch()
    os.truncate(label, SPARSE)
    for words in (
        ['evaluate', root],
        ['plot', 'scan', scan, '--labels', label, '-o', 'a.png'],
        ['kitti-to-bag', root, '--sequence', '00', tmp_path / 'a.mcap'],
    ):
        times.unlink(missing_ok=True)
        assert run(*words, *DOUBLES) == 2
        said = f'{SPARSE} bytes, expected {4 * n_points} for {n_points} points'
        assert error_line(capsys) == f'{label}: {said}'
    times.touch()
    os.truncate(times, SPARSE)
    assert run('evaluate', root, *DOUBLES) == 2
    assert error_line(capsys).startswith(f'{times}: {SPARSE} bytes, accepted are at most ')
    os.truncate(yaml, SPARSE)
    said = f'{yaml}: too large for a parameter file, accepted are {1 << 18} bytes'
    assert run('config', 'check', yaml) == 2
    assert capsys.readouterr().err.splitlines() == [said]
    assert run('segment', scan, *DOUBLES, '--config', yaml, '-o', tmp_path / 'a.label') == 2
    assert error_line(capsys) == said
    with pytest.raises(DataError, match='bytes, expected 4 for 1 points'):
        read_labels('/dev/zero', 1)


def test_too_little_memory_is_one_line(tmp_path):
    """What is read whole and has no limit of its own: a record of 300 GB."""
    (tmp_path / 'record.json').touch()
    os.truncate(tmp_path / 'record.json', SPARSE)
    done = subprocess.run(
        [sys.executable, '-m', 'gp_ground_seg', 'bench', '--from', 'record.json'],
        cwd=tmp_path, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert (done.returncode, done.stdout) == (2, '')
    assert done.stderr == 'gp-ground-seg: error: not enough memory for this input\n'


def test_the_options_are_those_of_every_command_that_reads_scans(capsys):
    for command in COMMANDS.values():
        words = re.split(r' (?=[A-Z-])', command)[0].split()
        with pytest.raises(SystemExit, match='0'):
            cli.main([*words, '--help'])
        text = capsys.readouterr().out
        assert all(option in text for option in ('--columns N', '--dtype {', '--force'))
    for wrong in ('2', '-1', 'x'):
        with pytest.raises(SystemExit, match='2'):
            cli.main(['segment', 'a.bin', '--columns', wrong])
        assert 'at least 3' in capsys.readouterr().err
