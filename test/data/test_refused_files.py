"""Files that are damaged, lie, or cannot be read or written: one line, and no memory taken."""

import io
import os
import re
import resource
import struct
import subprocess
import sys
import zipfile

import bag_samples as samples
import lzf
import numpy as np
import pytest
from bag_samples import scan, write_ros1_bag, write_ros2_bag
from cli_runner import error_line, run
from evaluation_samples import write_frame
from foreign_files import BE, LE, RAW, XYZ, pcd, ply
from hypothesis import given, settings
from hypothesis import strategies as st

from gp_ground_seg.core.errors import DataError
from gp_ground_seg.data.bags import BagWriter, encode_cloud
from gp_ground_seg.data.cloud_files import WRITABLE, encode_file
from gp_ground_seg.data.clouds import cloud_of, name_columns
from gp_ground_seg.data.inputs import list_inputs

SPARSE = 300 * 10**9


def npy(array, **options):
    file = io.BytesIO()
    np.save(file, array, **options)
    return file.getvalue()


def npy_header(shape):
    file = io.BytesIO()
    layout = {'descr': '<f4', 'fortran_order': False, 'shape': shape}
    np.lib.format.write_array_header_1_0(file, layout)
    return file.getvalue()


def npz(**members):
    file = io.BytesIO()
    with zipfile.ZipFile(file, 'w', zipfile.ZIP_DEFLATED) as archive:
        for name, data in members.items():
            archive.writestr(f'{name}.npy', data)
    return file.getvalue()


def many(n, body=RAW, data='binary', n_bytes=12):
    """A PCD of so many points in its header, `n_bytes` each unpacked."""
    if data == 'binary_compressed':
        packed = lzf.compress(bytes(n_bytes))
        body = struct.pack('<II', len(packed), min(n * n_bytes, 2**32 - 1)) + packed
    return pcd(data=data, body=body, WIDTH=n, POINTS=n)


def four(size='4', kind='F', count='1', **lines):
    """A binary PCD with a fourth field of this size, type and count."""
    return pcd('x y z a', f'4 4 4 {size}', f'F F F {kind}', 'binary', RAW,
               COUNT=f'1 1 1 {count}', **lines)  # fmt: skip


def write_changed(path, **changes):
    """Write a bag with one cloud that is not as it says."""
    points = samples.cloud()
    for name, value in changes.items():
        setattr(points, name, value)
    with BagWriter(path) as bag:
        bag.add_topic('/points')
        bag.write('/points', 0, encode_cloud(points))


def write_wide(path):
    fields = samples.cloud().fields
    fields[3].count = 400_000_000
    write_changed(path, width=0, data=np.zeros(0, np.uint8), row_step=0, fields=fields)


def write_long_record(path):
    """Write a bag with a first record that is said to have 3 GB."""
    write_ros1_bag(path)
    with open(path, 'r+b') as file:
        file.seek(len('#ROSBAG V2.0\n'))
        file.write(struct.pack('<I', 3_000_000_000))


NO_BAG = 'cannot be read as a bag; '
REFUSED = {
    'missing.npy': (None, 'no such file or folder'),
    'notes.docx': (b'hello', r'not a scan or bag; accepted are \.bin, \.pcd'),
    'points.xyz': (b'1 2 3', 'a text of points: load it by numpy.loadtxt'),
    'odd.bin': (bytes(17), '17 bytes is not a whole number of points of 4 float32'),
    'objects.npy': (npy(np.array([{}, 1]), allow_pickle=True), 'Object arrays cannot be'),
    'shape.npy': (npy_header((9999999999, 3)), r'cannot be read as \.npy \('),
    'columns.npy': (npy_header((0, 10**12)), '1000000000000 numbers per point'),
    'turned.npy': (npy(np.zeros((3, 200), 'f4')), r'\(3, 200\): is transposed'),
    'nested.npy': (
        npy(np.zeros(4, [('p', [('x', 'f4'), ('y', 'f4')])])),
        r'no field x of one number per point; fields: p \(4,\)',
    ),
    'flat.npy': (npy(np.arange(9.0)), r'array of shape \(9,\): must be \(N, 3\)'),
    'shape.npz': (npz(a=npy_header((10**9, 3)) + bytes(10**6)), r'cannot be read as \.npz \('),
    'names.npz': (npz(a=npy(XYZ), b=npy(XYZ)), r'arrays a \(4, 3\), b \(4, 3\):'),
    'none.pcd': (b'no header', 'no DATA line'),
    'commas.pcd': (pcd(body=4 * b'0,1,2\n'), 'a line of 1 words, its header says 3, separated by'),
    'sizes.pcd': (pcd(WIDTH='9'), '4 points, which is not width 9'),
    'many.pcd': (many(8000000), '8000000 points'),
    'packed.pcd': (
        many(40000000, data='binary_compressed'), 'packed bytes cannot hold the 480000000 of its'
    ),
    'lzf.pcd': (many(400000000, data='binary_compressed'), 'its header says 4800000000'),
    'wide.pcd': (four(count='500000000', WIDTH='0', POINTS='0'), '500000003 numbers per point'),
    'bytes.pcd': (four('8', count='900', WIDTH='0', POINTS='0').replace(b' a\n', b' _\n')
                  .replace(b'900', b'900000000'), '7200000012 bytes per point'),
    'count.pcd': (four(count='9' * 11), 'COUNT 99999999999: must be a whole number, at most 4'),
    'type.pcd': (pcd(types='X F F'), 'field x: no type X of 4 bytes'),
    'data.pcd': (pcd(data='other'), 'DATA other: must be'),
    'element.ply': (ply().replace(b'vertex 4', b'vertex'), 'no PLY|element vertex : must have'),
    'many.ply': (ply(form=LE, body=bytes(48)).replace(b'x 4', b'x 4000000'), '4000000 points'),
    'lists.ply': (
        ply(',list uchar int a', bytes(48), BE).replace(b'x 4', b'x 4000000000'), 'truncated?'
    ),
    **{f'hello.{end}': (b'hello', NO_BAG) for end in ('mcap', 'bag', 'db3')},
    **{f'empty.{end}': (b'', NO_BAG) for end in ('mcap', 'bag', 'db3')},
    'points.mcap': (
        lambda path: write_changed(path, width=400_000_000), 'bytes: must be at least 8800000000'
    ),
    'wide.db3': (write_wide, '400000004 numbers per point'),
    'record.bag': (write_long_record, NO_BAG),
}  # fmt: skip
PEAK = """
import sys
from gp_ground_seg.cli.main import main
for name in sys.argv[1:]:
    assert main(['segment', name, '-o', 'out.pcd', '--force']) == 2, name
print([line.split()[1] for line in open('/proc/self/status') if line.startswith('VmHWM')][0])
"""


def test_what_cannot_be_is_refused_with_the_reason_and_takes_no_memory(tmp_path):
    for name, (data, _) in REFUSED.items():
        if callable(data):
            data(tmp_path / name)
        elif data is not None:
            (tmp_path / name).write_bytes(data)
    done = subprocess.run(
        [sys.executable, '-c', PEAK, *REFUSED], cwd=tmp_path, capture_output=True, text=True,
        check=True,
    )  # fmt: skip
    lines = [line for line in done.stderr.splitlines() if ': error: ' in line]
    for line, (name, (_, message)) in zip(lines, REFUSED.items(), strict=True):
        assert line.startswith(f'gp-ground-seg: error: {name}: ')
        assert re.search(message, line), line
    assert not (tmp_path / 'out.pcd').exists()
    assert 1024 * int(done.stdout) < 600_000_000


@pytest.fixture(scope='module')
def whole(tmp_path_factory):
    """A small file of every format."""
    folder = tmp_path_factory.mktemp('whole')
    table = name_columns(scan(n_ground=150, n_wall=50))
    for suffix in WRITABLE:
        path = folder / f'a{suffix}'
        path.write_bytes(encode_file(path, cloud_of(table), {}))
    for name in ('a.mcap', 'a.db3'):
        write_ros2_bag(folder / name, n_clouds=2, n_ground=20, n_wall=5)
    write_ros1_bag(folder / 'a.bag', n_clouds=1)
    return folder


def problem_of(path):
    """Line that a file is refused with; '' if every cloud of it can be read."""
    said = ''
    try:
        for one in list_inputs(path):
            one.read()
    except DataError as error:
        said = str(error)
    assert not said or (said.startswith(f'{path}: ') and '\n' not in said)
    return said


@pytest.mark.parametrize('suffix', [*WRITABLE, '.mcap', '.db3', '.bag'])
@settings(max_examples=60)
@given(data=st.data())
def test_damage_is_reported_in_one_line(whole, tmp_path_factory, suffix, data):
    """A file that was cut is refused; overwritten bytes may go unnoticed."""
    content = (whole / f'a{suffix}').read_bytes()
    place = data.draw(st.integers(0, len(content) - 1) | st.integers(0, 500))
    damaged = tmp_path_factory.mktemp('damaged') / f'a{suffix}'
    damaged.write_bytes(content[:place])
    assert problem_of(damaged)
    junk = data.draw(st.binary(min_size=1, max_size=16))
    damaged.write_bytes(content[:place] + junk + content[place + len(junk) :])
    problem_of(damaged)


@pytest.mark.parametrize('n_bytes', [1, 8, 4095, 4096, 5000])
def test_sqlite_bag_that_lost_its_last_bytes(whole, tmp_path, n_bytes):
    # sqlite itself would read zeros there.
    content = (whole / 'a.db3').read_bytes()[:-n_bytes]
    (tmp_path / 'cut.db3').write_bytes(content)
    expected = f'truncated, {len(content)} bytes where its header says {len(content) + n_bytes}'
    assert expected in problem_of(tmp_path / 'cut.db3')


HUGE = (
    ('segment SCAN -o a.label', 'SCAN', f'accepted are at most {1 << 30}'),
    ('evaluate ROOT', 'LABEL', 'expected 7204 for 1801 points'),
    ('plot scan SCAN --labels LABEL -o a.png', 'LABEL', 'expected 7204 for 1801 points'),
    ('evaluate ROOT', 'TIMES', 'accepted are at most'),
    ('segment SCAN --config YAML -o a.label', 'YAML', 'too large for a parameter file'),
)


@pytest.mark.parametrize(('words', 'huge', 'message'), HUGE)
def test_huge_files_are_refused_by_their_size(tmp_path, monkeypatch, capsys, words, huge, message):
    monkeypatch.chdir(tmp_path)
    points = scan()
    write_frame(tmp_path, '00', 0, points, np.full(len(points), 40, '<u4'))
    paths = {
        'ROOT': '.', 'SCAN': 'sequences/00/velodyne/000000.bin', 'YAML': 'a.yaml',
        'LABEL': 'sequences/00/labels/000000.label', 'TIMES': 'sequences/00/times.txt',
    }  # fmt: skip
    with open(paths[huge], 'ab') as file:
        os.truncate(file.fileno(), SPARSE)
    assert run(*(paths.get(word, word) for word in words.split())) == 2
    assert re.search(f'{re.escape(paths[huge])}: .*{message}', error_line(capsys))


def test_too_little_memory_is_one_line(tmp_path):
    """The largest scan that is taken, and less memory than that takes."""
    (tmp_path / 'a.bin').touch()
    os.truncate(tmp_path / 'a.bin', 1 << 30)
    limit = 2 * 10**9
    done = subprocess.run(
        [sys.executable, '-m', 'gp_ground_seg', 'segment', 'a.bin', '-o', 'a.label'],
        cwd=tmp_path, capture_output=True, text=True, check=False,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_AS, (limit, limit)),
    )  # fmt: skip
    assert (done.returncode, done.stdout) == (2, '')
    assert done.stderr.splitlines()[-1] == 'gp-ground-seg: error: not enough memory for this input'


ESCAPED = {
    'a\x1b[31m\nb': r'a\x1b[31m\nb',
    os.fsdecode(b'a\xff\xfe'): r'a\udcff\udcfe',
    'a$\\x_{$': 'a$\\x_{$',
    '[a*]{0}%s': '[a*]{0}%s',
    ' \u202e\u2028\x7f ä ': r' \u202e\u2028\x7f ä ',
}


@pytest.mark.usefixtures('compiled_code')
@pytest.mark.parametrize('name', ESCAPED)
def test_any_name_is_read_written_and_shown_escaped(tmp_path, monkeypatch, capsys, name):
    monkeypatch.chdir(tmp_path)
    points = scan(n_ground=6000)
    points.tofile(f'{name}.bin')
    write_ros2_bag(tmp_path / f'{name}.mcap')
    write_frame(tmp_path / name, name, 0, points, np.full(len(points), 40, '<u4'))
    (tmp_path / f'{name}.yaml').write_text('sensor: {height: 1.7}')
    for line in (
        'segment|NAME.bin|-o|NAME.label|--config|NAME.yaml',
        'segment|NAME.mcap|-o|NAME_ground.mcap',
        'segment|NAME|-o|NAME_out',
        'plot|scan|NAME.bin|-o|NAME.svg',
        'evaluate|NAME.mcap|--against|NAME.yaml',
        'config|check|NAME.yaml',
    ):
        assert run(*line.replace('NAME', name).split('|')) == 0
        said = capsys.readouterr()
        assert all(text.isprintable() for text in (said.out + said.err).splitlines()), line
    assert run('segment', f'{name}.bin', '-o', f'{name}.label') == 2
    expected = f'{ESCAPED[name]}.label: exists already; --force replaces it'
    assert error_line(capsys) == expected


@pytest.mark.parametrize(
    'command',
    [
        'segment NAME -o out',
        'evaluate NAME',
        'config dump --config NAME',
        'segment a.bin -o NAME',
        'segment a.mcap -o NAME',
        'plot scan a.bin -o NAME.png',
    ],
)
def test_loops_of_links_and_names_too_long_are_one_line(tmp_path, monkeypatch, capsys, command):
    monkeypatch.chdir(tmp_path)
    scan().tofile('a.bin')
    write_ros2_bag(tmp_path / 'a.mcap')
    for name in ('loop', 'loop.png'):
        os.symlink(f'{name}2', name)
        os.symlink(name, f'{name}2')
    for name in ('loop', 'long' * 100):
        assert run(*command.replace('NAME', name).split()) == 2
        assert name in error_line(capsys)
    assert os.readlink('loop') == 'loop2'
