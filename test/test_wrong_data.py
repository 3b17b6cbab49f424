"""Files that are no scan as they are read: what is said, and that good ones are never refused."""

import os
import re
import subprocess
import sys

import numpy as np
import pytest
from bag_samples import write_ros1_bag, write_ros2_bag
from cli_runner import error_line, run
from evaluation_samples import write_frame

from gp_ground_seg.cli import main as cli
from gp_ground_seg.core.errors import DataError
from gp_ground_seg.data.scan_layout import KITTI, ScanLayout, find_doubt
from gp_ground_seg.data.semantic_kitti import read_labels, read_points
from gp_ground_seg.lab.simulation import SCENES, SENSORS, simulate_scan

SPARSE = 300 * 10**9
RING = ('--columns', '5')


def simulated(sensor='hdl-32e', scene='urban', seed=1):
    rng = np.random.default_rng(seed)
    points = simulate_scan(SCENES[scene](seed), SENSORS[sensor], rng).points.astype('<f4')
    return points[: len(points) // 40 * 40]  # so that every size fits every layout


def with_columns(points, n):
    """A scan of `n` columns: ring, time, echo and reflectivity behind the intensity."""
    rng, zero = np.random.default_rng(2), np.zeros(len(points))
    ring, reflectivity = rng.integers(0, 32, len(points)), rng.uniform(0.0, 255.0, len(points))
    time = np.linspace(0.0, 0.1, len(points))
    return np.column_stack([points, ring, time, zero, reflectivity])[:, :n].astype('<f4')


def missing(points, share, value):
    """Some points without a return, in runs, as on the sky."""
    rng = np.random.default_rng(3)
    lost = np.repeat(rng.random(len(points) // 50 + 1) < share, 50)[: len(points)]
    return np.where(lost[:, None], np.float32(value), points)


def alternating(points):
    """Two banks of lasers that fire in turn."""
    order = np.argsort(points[: len(points) // 2 * 2, 2], kind='stable')
    return points[order.reshape(2, -1).T.ravel()]


GOOD = {
    'as it is': (lambda p: p, KITTI),
    'shuffled': (lambda p: np.random.default_rng(0).permutation(p), KITTI),
    'two banks': (alternating, KITTI),
    'mostly NaN': (lambda p: missing(p, 0.9, np.nan), KITTI),
    'mostly zero': (lambda p: missing(p, 0.9, 0.0), KITTI),
    'few points': (lambda p: p[:: len(p) // 450], KITTI),
    'no point': (lambda p: p[:0], KITTI),
    'one point': (lambda p: np.repeat(p[:1], len(p), axis=0), KITTI),
    'zero, eight': (lambda p: with_columns(missing(p, 0.9, 0.0), 8), ScanLayout(8)),
    'no intensity': (lambda p: p * np.float32([1, 1, 1, 0]), KITTI),
    'x y z': (lambda p: p[:, :3], ScanLayout(3)),
    'ring': (lambda p: with_columns(p, 5), ScanLayout(5)),
    'doubles': (lambda p: p.astype('<f8'), ScanLayout(4, 'float64')),
    'doubles, ring': (lambda p: with_columns(p, 5).astype('<f8'), ScanLayout(5, 'float64')),
}
WRONG = {
    'ring': (lambda p: with_columns(p, 5), KITTI, 'repeat every 5, not every 4', '--columns 5 '),
    'six': (lambda p: with_columns(p, 6), KITTI, 'repeat every 6, not', '--columns 6 '),
    'eight': (lambda p: with_columns(p, 8), KITTI, 'repeat every 8, not', '--columns 8 '),
    'twice in one': (lambda p: p, ScanLayout(8), 'repeat every 4, not every 8', '--columns 4 '),
    'x y': (lambda p: p[:, :2], KITTI, 'repeat every 2, not every 4: x and y without z', ''),
    'doubles': (lambda p: p.astype('<f8'), KITTI, '% of the coordinates', '--dtype float64 '),
    'rounded doubles': (
        lambda p: np.round(256.0 * p.astype('<f8')) / 256.0, KITTI,
        '% of the coordinates', '--dtype float64 ',
    ),
    'doubles, ring': (
        lambda p: with_columns(p, 5).astype('<f8'), KITTI,
        '% of the coordinates', '--columns 5 --dtype float64 ',
    ),
    'named wrong': (lambda p: p, ScanLayout(5), 'every 4, not every 5', '--columns 4 '),
    'no doubles': (lambda p: p, ScanLayout(4, 'float64'), '', '--dtype float32 '),
    'millimetres': (
        lambda p: p * np.float32([1000, 1000, 1000, 1]), KITTI,
        'half of the points are farther than', 'millimetres',
    ),
    'labels': (
        lambda p: np.where(p[:, 2] < 0, 40, 10 + (7 << 16)).astype('<u4'), KITTI,
        '100% of the coordinates', 'whole numbers, as of a .label file',
    ),
    'NaN': (lambda p: np.full_like(p, np.nan), KITTI, 'points is finite', 'x begins nan'),
    'zeros': (np.zeros_like, KITTI, 'all points are at the origin', 'x begins 0'),
}  # fmt: skip


@pytest.fixture(scope='module', params=[*SENSORS, 'kitti'])
def scans(request):
    if request.param == 'kitti':
        root = request.getfixturevalue('kitti')
        paths = sorted(root.glob('sequences/*/velodyne/*.bin'))
        return [read_points(path) for path in paths[::6]]
    return [simulated(request.param, scene) for scene in ('flat', 'rough', 'urban')]


@pytest.mark.parametrize('change', GOOD)
def test_good_scans_are_not_doubted(scans, change):
    make, layout = GOOD[change]
    assert {find_doubt(make(points).tobytes(), layout) for points in scans} == {''}


@pytest.mark.parametrize('change', WRONG)
def test_wrong_data_are_named(scans, change):
    make, layout, problem, advice = WRONG[change]
    for points in scans:
        said = find_doubt(make(points[: len(points) // 40 * 40]).tobytes(), layout)
        assert said.startswith(f'read as {layout}, ')
        assert change != 'x y' or 'looks like' not in said
        assert problem in said and advice in f'{said} '


def test_a_file_of_another_size_is_told_from_one_that_is_cut():
    points = simulated('vlp-16')
    for data, layout, said in (
        (points.tobytes()[:-7], KITTI, ''),  # truncated, as the reader says
        (b'0123456789', KITTI, ''),
        (
            with_columns(points, 5)[:-1].tobytes(), KITTI,
            'looks like 5 columns of float32, which --columns 5 reads',
        ),
        (
            points[:-1].astype('<f8').tobytes(), ScanLayout(5, 'float64'),
            'looks like 4 columns of float64, which --columns 4 reads',
        ),
    ):  # fmt: skip
        found = find_doubt(data, layout)
        assert found.endswith(said) if said else not found


def test_the_library_reads_what_it_is_told_and_keeps_points(tmp_path):
    points, path = simulated('vlp-16'), tmp_path / 'a.bin'
    for n_columns, dtype in ((3, '<f4'), (4, '<f4'), (5, '<f4'), (4, '<f8'), (7, '<f8')):
        with_columns(points, n_columns).astype(dtype).tofile(path)
        read = read_points(path, ScanLayout(n_columns, np.dtype(dtype).name, 'raise'))
        assert (read.dtype, read.flags.writeable) == (np.float32, True)
        expected = points * np.float32([1, 1, 1, n_columns > 3])
        np.testing.assert_array_equal(read, expected)
    # Without a layout nothing is judged, as before.
    with_columns(points, 5).tofile(path)
    assert len(read_points(path)) == 5 * len(points) // 4


@pytest.mark.parametrize('kind', ['drive.mcap', 'drive.db3', 'drive.bag'])
def test_a_bag_is_no_scan(tmp_path, capsys, kind):
    (write_ros1_bag if kind == 'drive.bag' else write_ros2_bag)(tmp_path / kind)
    # Whatever its size: cut to whole points here, which the size alone would not tell.
    content = (tmp_path / kind).read_bytes()
    (tmp_path / 'drive.bin').write_bytes(content[: len(content) // 16 * 16])
    assert run('plot', 'scan', tmp_path / 'drive.bin', '-o', tmp_path / 'a.png') == 2
    assert 'begins as a bag does' in error_line(capsys)
    assert not (tmp_path / 'a.png').exists()


@pytest.fixture
def root(tmp_path):
    """A SemanticKITTI folder with two sequences of one frame of five columns, labelled."""
    points = simulated('hdl-32e')
    semantic = np.where(points[:, 2] < -1.5, 40, 10).astype('<u4')
    for sequence in ('00', '01'):
        write_frame(tmp_path / 'root', sequence, 0, with_columns(points, 5), semantic)
    return tmp_path / 'root'


COMMANDS = {
    'segment': 'segment SCAN -o OUT.label',
    'segment folder': 'segment ROOT/sequences/00 -o OUT',
    'pose': 'pose SCAN',
    'plot scan': 'plot scan SCAN -o OUT.png',
    'plot above': 'plot above SCAN -o OUT.png',
    'plot segment': 'plot segment SCAN --azimuth 0 -o OUT.png',
    'kitti-to-bag': 'kitti-to-bag ROOT --sequence 00 OUT.mcap',
    'bench': 'bench ROOT --threads 1 --json OUT.json',
    'evaluate': 'evaluate ROOT --json OUT.json',
    'ablation': 'experiment ablation ROOT --json OUT.json',
    'departures': 'experiment departures ROOT --json OUT.json',
    'sensor-pose': 'experiment sensor-pose ROOT --json OUT.json',
    'coverage': 'experiment coverage ROOT --json OUT.json',
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
    assert '000000.bin: read as 4 columns of float32, ' in line
    assert 'looks like 5 columns of float32, which --columns 5 reads; --force takes it' in line
    assert what_is_there(root) == ['root']


@pytest.mark.parametrize('command', ['segment', 'segment folder', 'pose', 'plot above'])
def test_the_option_helps_and_force_takes_it_with_a_note(command, root, capsys):
    words = words_of(command, root)
    assert run(*words, *RING) == 0
    right = capsys.readouterr()
    assert 'read as' not in right.err
    assert run(*words, '--force') == 0
    forced = capsys.readouterr()
    (note,) = [line for line in forced.err.splitlines() if 'note: ' in line and 'read as' in line]
    assert note.endswith('which --columns 5 reads')
    assert forced.out != right.out


@pytest.mark.parametrize(
    ('words', 'what'),
    [
        ('segment BAG -o OUT.mcap', 'BAG'),
        ('bench BAG', 'BAG'),
        ('bench --from OLD.json', 'OLD.json'),
        ('plot scan --simulate flat -o OUT.png', 'a simulated one'),
        ('demo --output OUT', 'a simulated one'),
    ],
)
def test_a_layout_is_for_files_of_scans(tmp_path, monkeypatch, capsys, words, what):
    monkeypatch.chdir(tmp_path)
    write_ros2_bag(tmp_path / 'a.mcap')
    named = words.replace('BAG', 'a.mcap').split()
    for option, value in (RING, ('--dtype', 'float64')):
        assert run(*named, option, value) == 2
        said = f'{option}: is for .bin scans, which {what.replace("BAG", "a.mcap")} is not'
        assert error_line(capsys) == said
    assert what_is_there(tmp_path / 'a.mcap') == ['a.mcap']


@pytest.mark.parametrize('command', COMMANDS)
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
    n_points, yaml = scan.stat().st_size // 20, tmp_path / 'huge.yaml'
    for path in (label, times, yaml):
        path.touch()
    os.truncate(label, SPARSE)
    for words in (
        ['evaluate', root],
        ['plot', 'above', scan, '--labels', label, '-o', 'a.png'],
        ['kitti-to-bag', root, '--sequence', '00', tmp_path / 'a.mcap'],
    ):
        times.unlink(missing_ok=True)
        assert run(*words, *RING) == 2
        said = f'{SPARSE} bytes, expected {4 * n_points} for {n_points} points'
        assert error_line(capsys) == f'{label}: {said}'
    times.touch()
    os.truncate(times, SPARSE)
    assert run('evaluate', root, *RING) == 2
    assert error_line(capsys).startswith(f'{times}: {SPARSE} bytes, accepted are at most ')
    os.truncate(yaml, SPARSE)
    said = f'{yaml}: too large for a parameter file, accepted are {1 << 18} bytes'
    assert run('config', 'check', yaml) == 2
    assert capsys.readouterr().err.splitlines() == [said]
    assert run('segment', scan, *RING, '--config', yaml, '-o', tmp_path / 'a.label') == 2
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
            cli.main(['pose', 'a.bin', '--columns', wrong])
        assert 'at least 3' in capsys.readouterr().err
