"""Files of every kind: what is read of them, the one line that refuses them, and little memory."""

import contextlib
import os
import re
import resource
from pathlib import Path

import numpy as np
import pytest
from bag_samples import scan, write_ros1_bag, write_ros2_bag
from cli_runner import error_line, limited, run
from evaluation_samples import write_frame
from foreign_files import CASES, XYZ
from hypothesis import given, settings
from hypothesis import strategies as st

from gp_ground_seg.core import errors
from gp_ground_seg.core.errors import DataError
from gp_ground_seg.data.cloud_files import WRITABLE, decode_file, encode_file
from gp_ground_seg.data.clouds import cloud_of, name_columns
from gp_ground_seg.data.inputs import list_inputs


def read(path):
    """Names of the fields, or topic and number of clouds; all clouds. Else the line, and none."""
    try:
        inputs = list_inputs(path)
        clouds = [one.read() for one in inputs]
    except DataError as error:
        said = str(error)
        assert said.startswith(f'{path}: ') and '\n' not in said and len(said) < 800
        return said, []
    return f'{inputs.topic} {len(clouds)}' if inputs.topic else clouds[
        0
    ].fields.dtype.names, clouds


def resident(key):
    """Memory of this process [bytes]: now by VmRSS, the most so far by VmHWM."""
    return 1024 * int(re.search(rf'{key}:\s*(\d+)', Path('/proc/self/status').read_text())[1])


@pytest.mark.filterwarnings('error')
@pytest.mark.parametrize('name', CASES)
def test_what_is_needed_is_read_of_every_file_or_the_reason_said(tmp_path, name):
    """One part that is not needed does not stop the reading; what cannot be takes no memory."""
    content, expected = CASES[name]
    path = tmp_path / name
    if callable(content):
        content(path)
    else:
        path.write_bytes(content)
    Path('/proc/self/clear_refs').write_text('5')
    before = resident('VmRSS')
    found, clouds = read(path)
    assert resident('VmHWM') < before + 200_000_000
    for cloud in clouds:
        np.testing.assert_array_equal(cloud.xyz, XYZ[:1] if name == 'one_point.pcd' else XYZ)
    if clouds:
        assert found in (expected, tuple(expected.split()))
    else:
        assert re.search(expected, found)


def test_what_is_left_out_is_told_once(tmp_path, caplog):
    caplog.set_level('INFO', 'gp_ground_seg')
    errors._logged.clear()
    for name in ['nan_as_integer.pcd'] * 2:
        decode_file(tmp_path / name, CASES[name][0])
    assert caplog.messages == ['field ring: has numbers that are no uint16; read as float64']


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


WORDS = [
    b'FIELDS x y z\n', b'SIZE 8 8 8\n', b'TYPE U U U\n', b'COUNT 3 1 1\n', b'COUNT 0 1 1\n',
    b'WIDTH 0\n', b'HEIGHT 2\n', b'POINTS 4294967296\n', b'DATA binary\n', b'DATA ascii\n',
    b'DATA binary_compressed\n', b'property list uchar int a\n', b'property double x\n',
    b'element vertex 0\n', b'format ascii 1.0\n', b'nan', b'-inf', b'1e999', b'1_0',
    b"'descr': [('x', '<f4', (2,))]", b"('x', 'O')", b"'shape': (99999999999,)", b'-1', b' ',
    b'?\n', b'1' * 300, b'\t', b'0x10', b'\r', b'\0',
    b'999999999999999999999', b'\xc3\xa9', b'\xff' * 4, b'\0\0\0\x80',
]  # fmt: skip
N_DAMAGED = round(60 + 2000 * float(os.environ.get('TORTURE_SCALE', '0')))
"""Files of a format, more in `make torture`."""


@pytest.mark.parametrize('suffix', [*WRITABLE, '.mcap', '.db3', '.bag'])
@settings(max_examples=N_DAMAGED)
@given(data=st.data())
def test_damage_is_reported_in_one_line(whole, tmp_path_factory, suffix, data):
    """A file that was cut is refused; another that is read is written as the same cloud."""
    content = (whole / f'a{suffix}').read_bytes()
    damaged = tmp_path_factory.mktemp('damaged') / f'a{suffix}'
    damaged.write_bytes(content[: data.draw(st.integers(0, len(content) - 1))])
    assert not read(damaged)[1]
    foreign = [one for name, (one, _) in CASES.items() if name.endswith(suffix)]
    content = data.draw(st.sampled_from([content, *(x for x in foreign if type(x) is bytes)]))
    for _ in range(data.draw(st.integers(1, 4))):
        place = data.draw(st.integers(0, len(content)) | st.integers(0, 500))
        junk = data.draw(st.binary(max_size=16) | st.sampled_from(WORDS))
        size = data.draw(st.sampled_from([0, 1, 4, len(junk), 30, 500]))
        content = content[:place] + junk + content[place + size :]
    damaged.write_bytes(content)
    clouds = read(damaged)[1]
    with contextlib.suppress(DataError):  # a PLY has no type for long integers
        for cloud in clouds if suffix in WRITABLE else []:
            label = np.zeros(len(cloud.xyz), np.uint8)
            again = decode_file(damaged, encode_file(damaged, cloud, {'label': label}))
            np.testing.assert_array_equal(again.xyz, cloud.xyz)


@pytest.mark.parametrize('n_bytes', [1, 8, 4095, 4096, 5000])
def test_sqlite_bag_that_lost_its_last_bytes(whole, tmp_path, n_bytes):
    # sqlite itself would read zeros there.
    content = (whole / 'a.db3').read_bytes()[:-n_bytes]
    (tmp_path / 'cut.db3').write_bytes(content)
    expected = f'truncated, {len(content)} bytes where its header says {len(content) + n_bytes}'
    assert expected in read(tmp_path / 'cut.db3')[0]


HUGE = (
    ('segment SCAN -o a.label', 'SCAN', f'accepted are at most {1 << 30}'),
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
        os.truncate(file.fileno(), 300 * 10**9)
    assert run(*(paths.get(word, word) for word in words.split())) == 2
    assert re.search(f'{re.escape(paths[huge])}: .*{message}', error_line(capsys))


def test_too_little_memory_is_one_line(tmp_path, capsys):
    """The largest scan that is taken, and less memory than that takes."""
    (tmp_path / 'a.bin').touch()
    os.truncate(tmp_path / 'a.bin', 1 << 30)
    with limited(resource.RLIMIT_AS, resident('VmSize') + (1 << 29)):
        assert run('segment', tmp_path / 'a.bin', '-o', tmp_path / 'a.label') == 2
    assert error_line(capsys) == 'not enough memory for this input'


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
    # A loop of links, and a name that is too long for a file.
    for a, b in ('ab', 'ba'):
        os.symlink(f'{a}.npy', f'{b}.npy')
    for bad in ('a.npy', 400 * 'a' + '.npy'):
        for words in (('segment', bad, '-o', 'out'), ('segment', f'{name}.bin', '-o', bad)):
            assert run(*words) == 2
            assert bad in error_line(capsys)
