"""`segment` and `plot` on clouds of every format: files, folders, data sets, bags."""

import re

import numpy as np
import pytest
from bag_samples import scan, write_ros2_bag
from cli_runner import run
from conftest import REPOSITORY

from gp_ground_seg import Config, GroundSegmenter
from gp_ground_seg.core.errors import DataError
from gp_ground_seg.data.cloud_files import WRITABLE, read_file
from gp_ground_seg.data.inputs import list_inputs

POINTS = scan()


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


@pytest.mark.parametrize('suffix', WRITABLE)
def test_every_format_holds_the_results_of_each_point_and_is_segmented(source, suffix, expected):
    out, again = source.with_suffix(suffix), source.with_name(f'a_ground{suffix}')
    assert run('segment', source, '-o', out) == 0
    found = read_file(out).fields
    np.testing.assert_array_equal(found['label'], expected.label)
    for k, name in enumerate([*'xyz', 'intensity']):
        np.testing.assert_array_equal(found[name], POINTS[:, k])
    for name in ('height', 'ground_z', 'ground_std', 'p_ground'):
        assert found[name].dtype == np.float32
        np.testing.assert_array_equal(found[name], getattr(expected, name).astype(np.float32))
    # To its own format, where the names are taken.
    assert run('segment', out, '--quiet') == 0
    found = read_file(again).fields
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
    assert own == ['a.bin.label', 'a.npy.npy', 'b.label', 'parameters.yaml']
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


FOLDERS = {
    'own output': (
        ['a.npy', 'a_ground.npy', 'a_ground_obstacles.npy', 'b_ground.npy', 'c_surface.npy'],
        ['a', 'b_ground', 'c_surface'],
    ),
    'numbers': (['a11.npy', 'a2.npy', 'a1.npy', 'a10.npy'], ['a1', 'a2', 'a10', 'a11']),
    'two numbers': (
        ['s2_f1.bin', 's10_f2.bin', 's2_f10.bin', 's2_f2.bin'],
        ['s2_f1', 's2_f2', 's2_f10', 's10_f2'],
    ),
    'zeros before': (['10.npy', '2.npy', '0001.npy'], ['0001', '2', '10']),
    'names before numbers': (['b_1.npy', 'a_2.npy', '1.npy'], ['1', 'a_2', 'b_1']),
    'letters first': (['1b.ply', 'a1.ply', '1a.ply'], ['1a', '1b', 'a1']),
    'SemanticKITTI': (['velodyne/000007.bin', 'labels/000007.label'], ['000007']),
    'nuScenes': (['samples/LIDAR_TOP/a__LIDAR_TOP__1.pcd.bin'], ['a__LIDAR_TOP__1']),
    'sequences': (['sequences/00/velodyne/0.bin'], r'no \.bin, .* file in it, and not a rosbag2'),
}


@pytest.mark.parametrize('kind', FOLDERS)
def test_what_a_folder_has(tmp_path, caplog, kind):
    files, expected = FOLDERS[kind]
    for name in files:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    caplog.set_level('INFO', 'gp_ground_seg')
    if isinstance(expected, str):
        with pytest.raises(DataError, match=expected):
            list_inputs(tmp_path)
    else:
        assert [one.name for one in list_inputs(tmp_path)] == expected
    n_left_out = 2 if kind == 'own output' else 0
    said = f'output of earlier runs left out: {n_left_out} of {len(files)} files'
    assert caplog.messages == [said] * (n_left_out > 0)


def test_clouds_and_pictures_of_a_bag(tmp_path, capsys):
    bag = tmp_path / 'drive.mcap'
    write_ros2_bag(bag)
    assert [one.title for one in list_inputs(bag)] == [f'drive.mcap[{k}]' for k in range(3)]
    assert run('segment', bag, '--format', 'npz', '--quiet') == 0
    for k in range(3):
        with np.load(tmp_path / 'drive_ground' / f'{k:06d}.npz') as found:
            np.testing.assert_array_equal(found['i'], scan(k)[:, 3])
            assert found['ring'].dtype == np.uint16 and len(found['label']) == len(scan(k))
    pytest.importorskip('matplotlib')
    for frame in range(3):
        assert run('plot', 'scan', bag, '--frame', frame, '-o', tmp_path / f'{frame}.png') == 0
    assert run('plot', 'segment', bag, '--segment', 9, '-o', tmp_path / 'a.png') == 0
    assert 'note: the first of 3 clouds, drive.mcap[0] ...: see --frame' in capsys.readouterr().err
    assert len({(tmp_path / f'{frame}.png').read_bytes() for frame in range(3)}) == 3
