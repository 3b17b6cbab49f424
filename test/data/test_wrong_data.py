"""Files that are no scan as they are read: what is said, and that good ones are never refused."""

import numpy as np
import pytest
from conftest import simulated

from gp_ground_seg.core.errors import DataError
from gp_ground_seg.data.cloud_files import find_objection, read_file


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
FAR = r'\d+% of the points are beyond 10 km, about .*; scans are in metres'
WRONG = {
    'doubles': (lambda p: p.astype('<f8'), FAR),
    'rounded doubles': (
        lambda p: np.round(256.0 * p.astype('<f8')) / 256.0, '% of the coordinates are below',
    ),
    'millimetres': (lambda p: p * np.float32([1000, 1000, 1000, 1]), FAR),
    'a map': (lambda p: p + np.float32([448_250.5, 5_411_900.25, 312.0, 0]), FAR),
    'labels': (
        lambda p: np.where(p[:, 2] < 0, 40, 10 + (7 << 16)).astype('<u4').repeat(4),
        '100% of the coordinates are below',
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
        return [read_file(path).xyz for path in paths[::6]]
    return [simulated(scene, request.param, 1).points for scene in ('flat', 'rough', 'urban')]


@pytest.mark.parametrize('change', [*GOOD, *WRONG])
def test_wrong_data_are_refused_in_a_line_that_names_the_option(scans, tmp_path, change):
    path = tmp_path / 'a.bin'
    for points in scans:
        if change in GOOD:
            assert find_objection(GOOD[change](points)[:, :3]) == ''
            continue
        make, problem = WRONG[change]
        path.write_bytes(make(points).tobytes())
        with pytest.raises(DataError, match=f'{path}: .*{problem}.*; a .bin holds float32: --col'):
            read_file(path)


def test_the_line_for_a_map_can_be_followed(tmp_path):
    points, place = simulated('urban', seed=1).points[:, :3], (448_250.5, 5_411_900.25, 312.0)
    np.save(tmp_path / 'map.npy', points.astype(float) + place)
    with pytest.raises(DataError, match=r'km, about 4482\d.*, 54119\d.*; scans') as caught:
        read_file(tmp_path / 'map.npy')
    line = str(caught.value).partition('as in ')[2].replace('near.npy', f'{tmp_path}/near.npy')
    given = {'numpy': np, 'points': np.load(tmp_path / 'map.npy')}
    exec(line.replace('(X, Y, Z)', str(place)), given)
    np.testing.assert_allclose(read_file(tmp_path / 'near.npy').xyz, points, atol=1e-5)


@pytest.mark.parametrize('order', ['of the beams', 'none'])
@pytest.mark.parametrize('columns', range(3, 11))
def test_another_number_of_columns_is_seen(scans, tmp_path, columns, order):
    """Read as it is never refused, with another number named, or at least not praised.

    Points of a room, of a radar, or of a sample have no order.
    """
    path, rng = tmp_path / 'a.bin', np.random.default_rng(1)
    n_named = n_wrong = 0
    for points in scans[-1:] if order == 'none' else scans:
        points = points[: len(points) // 2520 * 2520]
        points = rng.permutation(points) if order == 'none' else points
        more = rng.uniform(0.0, 60.0, (len(points), 7)), np.zeros((len(points), 7))
        for extra in (*more, rng.integers(0, 256, (len(points), 7)))[: 2 + (order == 'none')]:
            table = np.hstack([points[:, :3], extra])[:, :columns].astype('<f4')
            table.tofile(path)
            read = read_file(path, columns).xyz
            assert (read.dtype, read.flags.writeable) == (np.float32, True)
            four = np.zeros((len(points), 4))
            four[:, : min(columns, 4)] = table[:, :4]
            np.testing.assert_array_equal(read, four)
            for wrong in (n for n in range(3, 11) if columns % n and n % columns):
                n_wrong += 1
                try:
                    read_file(path, wrong)
                except DataError as error:
                    n_named += f'use --columns {columns}' in str(error)
    assert n_named >= 0.9 * n_wrong


def in_turns(points):
    """In the order of a sensor whose lower and upper beams fire in turns."""
    x, y, z, _ = points.T
    degrees = np.round(np.degrees(np.arctan2(z, np.hypot(x, y))))
    beam = np.unique(degrees, return_inverse=True)[1]
    half = (beam.max() + 2) // 2
    turn = np.where(beam < half, 2 * beam, 2 * (beam - half) + 1)
    return points[np.lexsort((turn, np.floor(np.arctan2(y, x) * 300.0)))]


@pytest.mark.parametrize('sensor', ['vlp-16', 'hdl-32e'])
def test_beams_in_turns_and_lost_returns_are_no_other_columns(tmp_path, sensor):
    path, rng = tmp_path / 'a.bin', np.random.default_rng(2)
    points = in_turns(simulated('urban', sensor, 1).points)
    for share in (0.0, 0.4, 0.9):
        lost = (rng.random(len(points)) < share)[:, None] & (np.arange(4) < 3)
        table = np.where(lost, np.float32(0.0), points)[: len(points) // 840 * 840]
        table.tofile(path)
        np.testing.assert_array_equal(read_file(path).xyz, table)
