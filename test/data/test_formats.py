"""Point clouds in files of every format: written, read, and exchanged with other packages."""

import struct
from pathlib import Path

import numpy as np
import pytest
from foreign_files import XYZ, pcd
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.lib.recfunctions import repack_fields

from gp_ground_seg.core.errors import DataError
from gp_ground_seg.data.cloud_files import WRITABLE, decode_file, encode_file, read_file
from gp_ground_seg.data.clouds import cloud_of, gather
from gp_ground_seg.data.pcd import PcdHeader

lzf = pytest.importorskip('lzf', reason='needs the extra formats')

CODES = ['i1', 'u1', 'i2', 'u2', 'i4', 'u4', 'f4', 'f8']


def sample(n=500, seed=0):
    """A cloud with fields of several types, one of several numbers."""
    rng = np.random.default_rng(seed)
    return gather(
        {
            **{name: rng.normal(0.0, 20.0, n).astype('f4') for name in 'xyz'},
            'intensity': rng.random(n).astype('f4'),
            'ring': rng.integers(0, 64, n).astype('u2'),
            'time': np.arange(n) // 50 * 0.25,  # which can be compressed
            'normal': rng.normal(size=(n, 3)).astype('f4'),
        }
    )


def encode(name, fields, header=None, label=None, **results):
    label = np.zeros(len(fields), np.uint8) if label is None else label
    cloud = cloud_of(fields, header)
    return encode_file(name, cloud, {'label': label, **results})


def assert_fields(found, expected, rtol=0.0):
    """Every field of `expected`, in its type; bit for bit but where a text has fewer digits."""
    for name in expected.dtype.names:
        assert found[name].dtype == expected[name].dtype, name
        if rtol:
            np.testing.assert_allclose(found[name], expected[name], rtol=rtol, err_msg=name)
        else:
            assert found[name].tobytes() == expected[name].tobytes(), name


# Round trips.


@st.composite
def clouds(draw, codes):
    n = draw(st.integers(0, 20))
    columns = {}
    names = draw(st.lists(st.from_regex(r'[A-Za-w][a-z0-9]{0,5}', fullmatch=True), unique=True))
    for name in ('x', 'y', 'z', *dict.fromkeys(names)):
        own = draw(st.sampled_from(['f4', 'f8'] if name in 'xyz' else codes))
        shape = (n,) if name in 'xyz' else draw(st.sampled_from([(n,), (n,), (n, 3)]))
        size = int(np.prod(shape)) * np.dtype(own).itemsize
        columns[name] = np.frombuffer(draw(st.binary(min_size=size, max_size=size)), own)
        columns[name] = columns[name].reshape(shape)
    return gather(columns)


@pytest.mark.parametrize('suffix', WRITABLE)
@settings(max_examples=25)
@given(data=st.data())
def test_what_is_written_is_read_back_bit_for_bit(tmp_path_factory, suffix, data):
    wide = [] if suffix == '.ply' else ['i8', 'u8']
    fields = data.draw(clouds([*CODES, *wide]))
    path = tmp_path_factory.mktemp('trip') / f'a{suffix}'
    found = decode_file(path, encode(path, fields)).fields
    if suffix == '.ply':  # which has no fields of several numbers
        for name in [name for name in fields.dtype.names if fields[name].ndim > 1]:
            parts = np.stack([found[f'{name}_{k}'] for k in range(3)], axis=-1)
            assert parts.tobytes() == fields[name].tobytes()
            fields = fields[[other for other in fields.dtype.names if other != name]]
    assert_fields(found, fields)
    assert found['gp_label' if 'label' in fields.dtype.names else 'label'].dtype == np.uint8


def test_what_a_format_beside_its_points_says_is_kept(tmp_path):
    fields = sample(60)
    header = PcdHeader(20, 3, '1 2 3 0 1 0 0')
    for name, known in (('a.pcd', header), ('a.ply', ['comment mine'])):
        assert decode_file(Path(name), encode(Path(name), fields, known)).header == known
    found = decode_file(Path('a.pcd'), encode(Path('a.pcd'), fields[:10], header))
    assert found.header == (10, 1, header[2])
    path = tmp_path / 'a.npz'
    np.savez(path, pose=np.eye(4), **{name: fields[name] for name in fields.dtype.names})
    path.write_bytes(encode_file(path, read_file(path), {'label': np.zeros(60, np.uint8)}))
    with np.load(path) as found:
        np.testing.assert_array_equal(found['pose'], np.eye(4))


NAMES = (
    'a_b', 'a b', 'a  b', 'a_0', 'a', 'a 1', 'label', 'gp_label', '_', ' ', 'X', 'höhe', '高さ',
    'points', 'self',
)  # fmt: skip


@pytest.mark.parametrize('suffix', WRITABLE)
def test_no_column_is_lost_when_written(tmp_path, suffix):
    columns = {name: np.full(3, k, 'u2') for k, name in enumerate(NAMES)}
    columns['a'] = np.arange(100, 106, dtype='u2').reshape(3, 2)
    fields = gather({**{name: np.arange(3, dtype='f4') for name in 'xyz'}, **columns})
    path = tmp_path / f'a{suffix}'
    found = decode_file(path, encode(path, fields, label=np.full(3, 77, 'u1'))).fields
    values = [v for name in found.dtype.names[3:] for v in np.ravel(found[name])]
    expected = [77] * 3 + [v for column in columns.values() for v in column.ravel()]
    assert sorted(values) == sorted(expected)
    for name in ('a_b', 'a_0', 'label', 'gp_label', 'X', 'höhe', '高さ'):
        np.testing.assert_array_equal(found[name], columns[name])
    np.testing.assert_array_equal(found['gp_gp_label'], 77)


@pytest.mark.parametrize('kind', ['i8', 'u8'])
def test_long_integers_in_a_ply_keep_their_value_or_are_refused(kind):
    path, xyz = Path('a.ply'), {name: np.zeros(2, 'f4') for name in 'xyz'}
    fields = gather({**xyz, 't': np.array([5, 2**53 - 1], kind)})
    found = decode_file(path, encode(path, fields)).fields
    np.testing.assert_array_equal(found['t'], [5, 2**53 - 1])
    with pytest.raises(DataError, match='field t: PLY has no type'):
        encode(path, gather({**xyz, 't': np.array([5, 2**53 + 1], kind)}))


# Files of other writers.


FLAT = ('x', 'y', 'z', 'intensity', 'ring', 'time')


@pytest.mark.parametrize('kind', ['ASCII', 'BINARY', 'BINARY_COMPRESSED'])
def test_files_of_pypcd4(tmp_path, kind):
    pypcd4 = pytest.importorskip('pypcd4')
    flat, path = sample()[[*FLAT]], tmp_path / 'a.pcd'
    columns, types = [flat[n] for n in FLAT], [flat.dtype[n].type for n in FLAT]
    theirs = pypcd4.PointCloud.from_points(columns, FLAT, types)
    theirs.save(path, encoding=getattr(pypcd4.Encoding, kind))
    assert_fields(read_file(path).fields, flat, 1e-5 if kind == 'ASCII' else 0.0)
    path.write_bytes(encode(path, flat))
    assert_fields(pypcd4.PointCloud.from_path(path).pc_data, flat)


@pytest.mark.parametrize('order', '<>=')
def test_files_of_plyfile(tmp_path, order):
    plyfile = pytest.importorskip('plyfile')
    flat, path = repack_fields(sample()[[*FLAT]]), tmp_path / 'a.ply'
    element = plyfile.PlyElement.describe(flat, 'vertex', comments=['theirs'])
    plyfile.PlyData([element], text=order == '=', byte_order=order).write(path)
    assert_fields(read_file(path).fields, flat, 1e-6 if order == '=' else 0.0)
    path.write_bytes(encode(path, flat))
    assert_fields(plyfile.PlyData.read(path)['vertex'].data, flat)


def test_padding_and_fields_of_several_numbers_as_pcl_writes_them():
    """Simple files of other programs are in `foreign_files`."""
    dtype = [('xyz', '<f4', 3), ('a', 'V4'), ('intensity', '<f4'), ('ring', '<u2'), ('b', 'V10')]
    points = np.zeros(4, dtype)
    points['xyz'], points['intensity'], points['ring'] = XYZ, [1, 2, 3, 4], [5, 6, 7, 8]
    padded = decode_file(Path('a.pcd'), pcd(
        'x y z _ intensity ring _', '4 4 4 1 4 2 1', 'F F F U F U U', 'binary', points.tobytes(),
        COUNT='1 1 1 4 1 1 10', WIDTH='2', HEIGHT='2', VIEWPOINT='0 0 1.7 1 0 0 0',
    ))  # fmt: skip
    assert padded.fields.dtype.names == ('x', 'y', 'z', 'intensity', 'ring')
    assert padded.header[:3] == (2, 2, '0 0 1.7 1 0 0 0')
    np.testing.assert_array_equal(padded.fields['ring'], [5, 6, 7, 8])
    # Compressed: the numbers of a point beside each other.
    columns = XYZ.T.tobytes() + np.arange(20, dtype='<f4').tobytes()
    packed = lzf.compress(columns)
    body = struct.pack('<II', len(packed), len(columns)) + packed
    compressed = decode_file(Path('a.pcd'), pcd(
        'x y z fpfh', '4 4 4 4', 'F F F F', 'binary_compressed', body, COUNT='1 1 1 5'
    ))  # fmt: skip
    np.testing.assert_array_equal(compressed.fields['fpfh'], np.arange(20).reshape(4, 5))
    for cloud in (padded, compressed):
        np.testing.assert_array_equal(cloud.xyz, XYZ)
