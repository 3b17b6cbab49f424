"""`segment` and `plot` on clouds of every format: files, folders, data sets, bags."""

import re
import struct
import sys

import numpy as np
import pytest
from bag_samples import scan, write_ros2_bag
from cli_runner import error_line, run
from conftest import REPOSITORY

from gp_ground_seg import Config, GroundSegmenter
from gp_ground_seg.core.errors import DataError
from gp_ground_seg.data.cloud_files import WRITABLE, encode_file, read_file
from gp_ground_seg.data.clouds import cloud_of, gather, name_columns
from gp_ground_seg.data.inputs import list_inputs

POINTS = scan()
NAMES = ('x', 'y', 'z', 'intensity')


@pytest.fixture(scope='module')
def expected():
    """Result for `POINTS`; compiled for both precisions, or a command would say that it does."""
    segmenter = GroundSegmenter(Config())
    segmenter.segment(POINTS.astype(np.float64))
    return segmenter.segment(POINTS)


@pytest.fixture
def source(tmp_path):
    POINTS.tofile(tmp_path / 'a.bin')
    return tmp_path / 'a.bin'


def values(result):
    return {
        name: getattr(result, name) for name in ('height', 'ground_z', 'ground_std', 'p_ground')
    }


@pytest.mark.parametrize('suffix', WRITABLE)
def test_every_format_holds_the_results_of_each_point(source, suffix, expected):
    out = source.with_suffix(suffix)
    assert run('segment', source, '-o', out) == 0
    found = read_file(out).fields
    np.testing.assert_array_equal(found['label'], expected.label)
    for k, name in enumerate(NAMES):
        np.testing.assert_array_equal(found[name], POINTS[:, k])
    for name, column in values(expected).items():
        assert found[name].dtype == np.float32
        np.testing.assert_array_equal(found[name], column.astype(np.float32))


@pytest.mark.parametrize('suffix', WRITABLE)
def test_a_cloud_of_any_format_is_segmented_to_its_own(source, suffix, expected):
    again = source.with_name(f'b{suffix}')
    assert run('segment', source, '-o', again, '--quiet') == 0
    assert run('segment', again, '--quiet') == 0
    found = read_file(source.with_name(f'b_ground{suffix}')).fields
    np.testing.assert_array_equal(found['gp_label'], expected.label)
    assert {'gp_height', 'gp_ground_z'} < set(found.dtype.names)
    np.testing.assert_allclose(found['gp_height'], expected.height, atol=2e-3)


def test_a_folder_of_several_formats(tmp_path, expected, capsys):
    folder = tmp_path / 'in'
    folder.mkdir()
    POINTS.tofile(folder / 'a.bin')
    np.hstack([POINTS, POINTS[:, :1]]).tofile(folder / 'b.pcd.bin')
    np.save(folder / 'a.npy', POINTS)
    (folder / 'times.txt').write_text('0.0\n0.1\n')  # no scan
    assert [one.name for one in list_inputs(folder)] == ['a.bin', 'a.npy', 'b']
    assert run('segment', folder, '-o', tmp_path / 'own', '--quiet') == 0
    own = sorted(path.name for path in (tmp_path / 'own').iterdir())
    assert own == ['a.bin.label', 'a.npy.npy', 'b.label', 'outputs.jsonl', 'parameters.yaml']
    assert run('segment', folder, '-o', tmp_path / 'pcd', '--format', 'pcd') == 0
    for name in ('a.bin', 'a.npy', 'b'):
        found = read_file(tmp_path / 'pcd' / f'{name}.pcd').fields
        np.testing.assert_array_equal(found['label'], expected.label)
    # nuScenes' fifth column, known by the name of the file.
    np.testing.assert_array_equal(found['column_5'], POINTS[:, 0])


def test_the_page_says_how_to_read_a_text(tmp_path, monkeypatch, capsys, expected):
    monkeypatch.chdir(tmp_path)
    header = 'x,y,z,intensity'
    np.savetxt('scan.csv', POINTS, delimiter=',', header=header, comments='')
    files = (REPOSITORY / 'docs/api.md').read_text(encoding='utf-8').partition('## Files')[2]
    exec(re.search('```python\n(.*?)```', files, re.DOTALL)[1])
    assert capsys.readouterr().out == f'{expected.label}\n'
    np.testing.assert_allclose(read_file(tmp_path / 'scan.npy').xyz, POINTS[:, :3])


def test_output_beside_its_scan_is_no_scan(tmp_path, caplog):
    for name in ('a', 'a_ground', 'a_ground_obstacles', 'b_ground', 'c_surface'):
        np.save(tmp_path / f'{name}.npy', POINTS)
    caplog.set_level('INFO', 'gp_ground_seg')
    assert [one.name for one in list_inputs(tmp_path)] == ['a', 'b_ground', 'c_surface']
    assert caplog.messages == ['output of earlier runs left out: 2 of 5 files']


def test_clouds_of_a_bag(tmp_path):
    bag = write_bag(tmp_path)
    inputs = list_inputs(bag)
    assert (len(inputs), inputs.topic, inputs[2].name) == (3, '/points', '000002')
    np.testing.assert_array_equal(inputs[2].read().xyz, scan(2)[:, :3])
    assert [one.title for one in inputs] == [f'drive.mcap[{k}]' for k in range(3)]
    with pytest.raises(IndexError):
        inputs[3]
    assert run('segment', bag, '--format', 'npz', '--quiet') == 0
    for k in range(3):
        with np.load(tmp_path / 'drive_ground' / f'{k:06d}.npz') as found:
            np.testing.assert_array_equal(found['i'], scan(k)[:, 3])
            assert found['ring'].dtype == np.uint16 and len(found['label']) == len(scan(k))


def write_bag(folder):
    write_ros2_bag(folder / 'drive.mcap')
    return folder / 'drive.mcap'


@pytest.mark.parametrize(
    ('drive', 'hint'),
    [
        ('sequences/00/velodyne', 'sequences/00'),
        ('samples/LIDAR_TOP', ''),
    ],
)
def test_data_sets_are_known_by_their_folders(tmp_path, drive, hint):
    (tmp_path / drive).mkdir(parents=True)
    POINTS.tofile(tmp_path / drive / '000007.bin')
    if hint:
        with pytest.raises(DataError, match=f'give one of its sequences .*{hint}'):
            list_inputs(tmp_path)
        folder = (tmp_path / drive).parent
    else:
        folder = tmp_path
    (one,) = list_inputs(folder)
    assert one.name == '000007'
    np.testing.assert_array_equal(one.read().xyz, POINTS)


def test_pictures_of_a_frame_of_a_bag_or_folder(tmp_path, capsys):
    pytest.importorskip('matplotlib')
    bag, out = write_bag(tmp_path), tmp_path / 'a.png'
    assert run('plot', 'scan', bag, '--frame', '1', '-o', out) == 0
    first = out.read_bytes()
    assert run('plot', 'scan', bag, '--frame', '2', '-o', out, '--force') == 0
    assert out.read_bytes() != first
    capsys.readouterr()
    assert run('plot', 'scan', bag, '--frame', '3', '-o', tmp_path / 'b.png') == 2
    assert '--frame 3: must be 0 to 2 here' in error_line(capsys)


@pytest.mark.parametrize(
    ('words', 'message'),
    [
        (['a.npy', '-o', 'a.npy', '--force'], 'a.npy: is the input'),
        (['folder', '-o', 'folder', '--force'], 'is the input'),
        (['a.npy', '-o', 'a.xyz'], 'a.xyz: must be a folder, or end in .label, .pcd'),
        (['a.npy', '-o', 'taken.pcd'], 'taken.pcd: exists already'),
        (['folder', '-o', 'x.pcd'], 'x.pcd: must be a folder'),
        (['a.npy', '-o', 'x.pcd', '--format', 'ply'], 'x.pcd: ends in .pcd, which is not ply'),
        (['a.npy', '--topic', '/a'], '--topic: is for bags'),
        (['a.npy', '--columns', '5'], '--columns: is for .bin scans, which a.npy is not'),
        (['drive.mcap', '--format', 'pcd', '--columns', '5'], '--columns: is for .bin scans'),
        (['wide.npy', '-o', 'x.ply'], 'field t: PLY has no type uint64'),
        (['far.npy', '-o', 'x.pcd'], 'are beyond 10 km, about'),
        (['none.npy', '-o', 'x.pcd'], 'none of 200 points is finite'),
        (['empty.npy', '-o', 'x.pcd'], 'no points in it'),
        (['a.csv', '-o', 'x.pcd'], 'a.csv: a text of points: load it by numpy.loadtxt or pandas'),
        (['texts', '-o', 'x'], 'folder; a.XYZ may be a text of points: load it by'),
    ],
)  # fmt: skip
def test_refused(tmp_path, monkeypatch, capsys, words, message):
    monkeypatch.chdir(tmp_path)
    np.save('a.npy', POINTS)
    (tmp_path / 'folder').mkdir()
    np.save('folder/b.npy', POINTS)
    (tmp_path / 'taken.pcd').write_text('mine')
    fields = name_columns(POINTS)
    np.save(
        'wide.npy',
        gather({**{n: fields[n] for n in 'xyz'}, 't': np.full(len(fields), 2**60, 'u8')}),
    )
    np.save('far.npy', 1000.0 * POINTS)
    np.save('none.npy', np.full((200, 3), np.nan))
    np.save('empty.npy', np.zeros((0, 3)))
    (tmp_path / 'texts').mkdir()
    for name in ('a.csv', 'texts/a.XYZ', 'texts/times.txt'):
        (tmp_path / name).write_text('1 2 3\n')
    write_bag(tmp_path)
    before = {path: path.read_bytes() for path in tmp_path.rglob('*') if path.is_file()}
    assert run('segment', *words) == 2
    assert message in error_line(capsys)
    assert {path: path.read_bytes() for path in tmp_path.rglob('*') if path.is_file()} == before


@pytest.mark.parametrize(
    ('name', 'module', 'packages'),
    [
        ('a.pcd', 'lzf', 'python-neo-lzf'),
    ],
)
def test_a_missing_package_is_named(tmp_path, monkeypatch, capsys, name, module, packages):
    path = tmp_path / name
    cloud = cloud_of(name_columns(np.zeros((50, 3), np.float32)))
    whole = encode_file(path, cloud, {'label': np.zeros(50, np.uint8)})
    compressed = b'DATA binary_compressed\n' + struct.pack('<II', 9, 50 * 13)
    path.write_bytes(whole.replace(b'DATA binary\n', compressed))
    monkeypatch.setitem(sys.modules, module, None)
    assert run('segment', path, '-o', tmp_path / 'out.npy') == 2
    line = error_line(capsys)
    assert line.startswith(f'{module} is not installed')
    assert line.endswith(f'pip install {packages}')
