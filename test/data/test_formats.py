"""Point clouds in files of every format: read, written, foreign, damaged."""

import io
import re
import struct
import subprocess
import sys
import tempfile
import zipfile
from functools import partial
from pathlib import Path

import bag_samples
import numpy as np
import pytest
from foreign_files import LE, XYZ, pcd, ply
from hypothesis import given, settings
from hypothesis import strategies as st

from gp_ground_seg.core.errors import DataError
from gp_ground_seg.data.bags import BagWriter, encode_cloud
from gp_ground_seg.data.cloud_files import WRITABLE, decode_file, encode_file, read_file
from gp_ground_seg.data.clouds import cloud_of, gather, name_columns
from gp_ground_seg.data.pcd import PcdHeader
from gp_ground_seg.data.ply import PlyHeader

pytestmark = pytest.mark.usefixtures('compiled_code')

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


def assert_fields(found, expected):
    """Every field of `expected`, in its type, bit for bit."""
    for name in expected.dtype.names:
        assert found[name].dtype == expected[name].dtype, name
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
    taken = 'gp_label' if 'label' in fields.dtype.names else 'label'
    assert found[taken].dtype == np.uint8


def test_what_a_format_beside_its_points_says_is_kept(tmp_path):
    fields = sample(60)
    header = PcdHeader(20, 3, '1 2 3 0 1 0 0')
    path = tmp_path / 'a.pcd'
    again = decode_file(path, encode(path, fields, header))
    assert again.header == header
    found = decode_file(path, encode(path, again.fields[:10], again.header))
    assert found.header[:3] == (10, 1, header[2])
    path = tmp_path / 'a.ply'
    remarks = PlyHeader(('comment mine',))
    assert decode_file(path, encode(path, fields, remarks)).header == remarks
    path = tmp_path / 'a.npz'
    np.savez(path, pose=np.eye(4), **{name: fields[name] for name in fields.dtype.names})
    path.write_bytes(encode_file(path, read_file(path), {'label': np.zeros(60, np.uint8)}))
    with np.load(path) as found:
        np.testing.assert_array_equal(found['pose'], np.eye(4))


NAMES = (
    'a b', 'a_b', 'a  b', 'a_b_2', 'a', 'a_0', 'a 1', 'label', 'gp_label', '_', ' ', 'field', 'X',
    'höhe', '高さ', 'points', 'file', 'allow_pickle', 'self',
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
    # A name that can be kept is; nothing else takes it.
    for name in ('a_b', 'a_b_2', 'a_0', 'label', 'gp_label', 'field', 'X', 'höhe', '高さ'):
        np.testing.assert_array_equal(found[name], columns[name])
    np.testing.assert_array_equal(found['gp_gp_label'], 77)


def test_long_integers_in_a_ply_keep_their_value_or_are_refused(tmp_path):
    path = tmp_path / 'a.ply'
    xyz = {name: np.zeros(2, 'f4') for name in 'xyz'}
    for kind in ('i8', 'u8'):
        fields = gather({**xyz, 't': np.array([5, 2**53 - 1], kind)})
        found = decode_file(path, encode(path, fields))
        np.testing.assert_array_equal(found.fields['t'], [5, 2**53 - 1])
        fields = gather({**xyz, 't': np.array([5, 2**53 + 1], kind)})
        with pytest.raises(DataError, match='field t: PLY has no type'):
            encode(path, fields)
        found = decode_file(path, encode(path, fields, PlyHeader(has_long=True)))
        assert_fields(found.fields, fields)


# Files of other writers.


def test_files_of_pypcd4(tmp_path):
    pypcd4 = pytest.importorskip('pypcd4')
    fields = sample()
    flat = fields[['x', 'y', 'z', 'intensity', 'ring', 'time']]
    types = [flat.dtype[name].type for name in flat.dtype.names]
    columns = [flat[name] for name in flat.dtype.names]
    theirs = pypcd4.PointCloud.from_points(columns, flat.dtype.names, types)
    for kind in ('BINARY', 'BINARY_COMPRESSED'):
        theirs.save(tmp_path / 'a.pcd', encoding=getattr(pypcd4.Encoding, kind))
        assert_fields(read_file(tmp_path / 'a.pcd').fields, flat)
    theirs.save(tmp_path / 'a.pcd', encoding=pypcd4.Encoding.ASCII)
    np.testing.assert_allclose(read_file(tmp_path / 'a.pcd').fields['x'], flat['x'], rtol=1e-5)
    (tmp_path / 'b.pcd').write_bytes(encode(tmp_path / 'b.pcd', flat))
    assert_fields(pypcd4.PointCloud.from_path(tmp_path / 'b.pcd').pc_data, flat)


def test_ply_is_read_by_plyfile(tmp_path):
    plyfile = pytest.importorskip('plyfile')
    fields = sample()[['x', 'y', 'z', 'ring', 'time']]
    fields = gather({name: fields[name] for name in fields.dtype.names})
    (tmp_path / 'b.ply').write_bytes(encode(tmp_path / 'b.ply', fields))
    assert_fields(plyfile.PlyData.read(tmp_path / 'b.ply')['vertex'].data, fields)
    for order, text in (('<', False), ('>', False), ('=', True)):
        element = plyfile.PlyElement.describe(fields, 'vertex', comments=['theirs'])
        plyfile.PlyData([element], text=text, byte_order=order).write(tmp_path / 'a.ply')
        found = read_file(tmp_path / 'a.ply').fields
        np.testing.assert_allclose(found['x'], fields['x'], rtol=1e-6)
        np.testing.assert_array_equal(found['ring'], fields['ring'])


def padded_pcd():
    """As PCL saves a Velodyne cloud: padding of several bytes, organised."""
    dtype = np.dtype([('xyz', '<f4', 3), ('a', 'V4'), ('intensity', '<f4'), ('ring', '<u2'),
                      ('b', 'V10')])  # fmt: skip
    points = np.zeros(4, dtype)
    points['xyz'], points['intensity'], points['ring'] = XYZ, [1, 2, 3, 4], [5, 6, 7, 8]
    return pcd(
        'x y z _ intensity ring _', '4 4 4 1 4 2 1', 'F F F U F U U', 'binary', points.tobytes(),
        COUNT='1 1 1 4 1 1 10', WIDTH='2', HEIGHT='2', VIEWPOINT='0 0 1.7 1 0 0 0',
    )  # fmt: skip


def descriptor_pcd():
    """As PCL compresses fields of several numbers: those of a point beside each other."""
    columns = XYZ.T.tobytes() + np.arange(20, dtype='<f4').tobytes()
    packed = lzf.compress(columns)
    body = struct.pack('<II', len(packed), len(columns)) + packed
    return pcd(
        'x y z fpfh', '4 4 4 4', 'F F F F', 'binary_compressed', body, COUNT='1 1 1 5'
    )  # fmt: skip


def test_fields_of_several_numbers_as_pcl_writes_them():
    """Simple files of other programs are in `foreign_files`."""
    padded = decode_file(Path('a.pcd'), padded_pcd())
    assert padded.fields.dtype.names == ('x', 'y', 'z', 'intensity', 'ring')
    assert padded.header[:3] == (2, 2, '0 0 1.7 1 0 0 0')
    np.testing.assert_array_equal(padded.fields['ring'], [5, 6, 7, 8])
    packed = decode_file(Path('a.pcd'), descriptor_pcd())
    np.testing.assert_array_equal(packed.fields['fpfh'], np.arange(20).reshape(4, 5))
    for cloud in (padded, packed):
        np.testing.assert_array_equal(cloud.xyz, XYZ)


@pytest.mark.parametrize('n', [0, 1])
def test_a_text_of_one_point_or_none(n):
    cloud = decode_file(Path('a.pcd'), pcd(body=b'1 2 3\n' * n, WIDTH=f'{n}', POINTS=f'{n}'))
    assert cloud.xyz.tolist() == [[1.0, 2.0, 3.0]] * n


def test_arrays_of_every_kind(tmp_path):
    xyz = dict(zip('XYZ', np.arange(9.0).reshape(3, 3), strict=True))
    np.savez(tmp_path / 'fields.npz', **xyz, points=np.arange(3), pose=np.eye(4))
    np.save(tmp_path / 'fields.npy', gather(xyz))
    for name in ('fields.npy', 'fields.npz'):
        np.testing.assert_array_equal(read_file(tmp_path / name).xyz.T, list(xyz.values()))
    table = np.random.default_rng(1).normal(size=(9, 5))
    fields = name_columns(table)
    np.save(tmp_path / 'table.npy', np.asfortranarray(table))
    assert_fields(read_file(tmp_path / 'table.npy').fields, fields)
    # The only table is that of the points, whatever it is called.
    for name in ('points', 'xyzi', 'arr_0'):
        arrays = {name: table, 'ring': np.arange(9), 'pose': np.eye(3)[0]}
        np.savez_compressed(tmp_path / 'table.npz', **arrays)
        found = read_file(tmp_path / 'table.npz').fields
        assert_fields(found, fields)
        assert found.dtype.names == ('x', 'y', 'z', 'intensity', 'column_5', 'ring')


# Files that are damaged, or lie.


def refused(path, data):
    """The line that a file is refused with; None if it is read."""
    try:
        decode_file(path, bytes(data))
    except DataError as error:
        said = str(error)
    else:
        return None
    assert said.startswith(f'{path}: ')
    assert '\n' not in said
    return said


@pytest.mark.parametrize('suffix', WRITABLE)
def test_damaged_files_are_refused_in_one_line(tmp_path, suffix):
    path = tmp_path / f'a{suffix}'
    whole = encode(path, sample(200))
    numbers = np.random.default_rng(5)
    n_times = 200
    for cut in numbers.integers(len(whole), size=n_times // 4):
        assert refused(path, whole[:cut])
    n_refused = 0
    for _ in range(n_times):
        data = bytearray(whole)
        for place in numbers.integers(min(len(whole), 2000), size=numbers.integers(1, 5)):
            data[place] = numbers.integers(256)
        n_refused += refused(path, data) is not None
    assert n_refused >= n_times // 20


def zip_of(**members):
    file = io.BytesIO()
    with zipfile.ZipFile(file, 'w', zipfile.ZIP_DEFLATED) as archive:
        for name, data in members.items():
            archive.writestr(f'{name}.npy', data)
    return file.getvalue()


def npy_header(shape):
    file = io.BytesIO()
    layout = {'descr': '<f4', 'fortran_order': False, 'shape': shape}
    np.lib.format.write_array_header_1_0(file, layout)
    return file.getvalue()


def npy_bytes(array, **options):
    file = io.BytesIO()
    np.save(file, array, **options)
    return file.getvalue()


LIES = {
    'objects.npy': (npy_bytes(np.array([{}, 1]), allow_pickle=True), 'Object arrays cannot be'),
    'shape.npy': (
        npy_bytes(XYZ).replace(b'(4, 3)', b'(9999999999, 3)'), r'cannot be read as \.npy \('
    ),
    'columns.npy': (npy_header((0, 10**12)), '1000000000000 numbers per point'),
    'columns.npz': (zip_of(points=npy_header((0, 10**9))), '1000000000 numbers per point'),
    'shape.npz': (
        zip_of(points=npy_header((10**9, 3)) + bytes(10**6)), r'cannot be read as \.npz \('
    ),
    'turned.npy': (npy_bytes(np.zeros((3, 200), 'f4')), r'\(3, 200\): is transposed'),
    'nested.npy': (
        npy_bytes(np.zeros(4, [('p', [('x', 'f4'), ('y', 'f4'), ('z', 'f4')])])),
        r'no field x of one number per point; fields: p \(4,\)',
    ),
    'commas.pcd': (pcd(body=4 * b'0,1,2\n'), 'a line of 1 words, its header says 3, separated by'),
    'wide_text.pcd': (pcd(COUNT='1 1 500000000'), '500000002 numbers per point'),
    'flat.npy': (npy_bytes(np.arange(9.0)), r'array of shape \(9,\): must be \(N, 3\)'),
    'names.npz': (zip_of(a=npy_bytes(XYZ), b=npy_bytes(XYZ)), r'arrays a \(4, 3\), b \(4, 3\):'),
    'flat.npz': (zip_of(a=npy_bytes(np.arange(9.0))), r'arrays a \(9,\): must be x, y, z, or one'),
    'sizes.pcd': (padded_pcd().replace(b'WIDTH 2', b'WIDTH 9'), '4 points, which is not width 9'),
    'many.pcd': (
        padded_pcd().replace(b'WIDTH 2', b'WIDTH 4000000').replace(b'POINTS 4', b'POINTS 8000000'),
        '8000000 points',
    ),
    'lzf.pcd': (
        descriptor_pcd().replace(b'POINTS 4', b'POINTS 400000000')
        .replace(b'WIDTH 4', b'WIDTH 400000000'),
        'its header says 12800000000',
    ),
    'packed.pcd': (
        descriptor_pcd().replace(b'POINTS 4', b'POINTS 40000000')
        .replace(b'WIDTH 4', b'WIDTH 40000000')
        .replace(struct.pack('<I', 4 * 32), struct.pack('<I', 40000000 * 32)),
        'packed bytes cannot hold the 1280000000 of its header',
    ),
    'wide.pcd': (
        padded_pcd().replace(b'COUNT 1', b'COUNT 500000000').replace(b'WIDTH 2', b'WIDTH 0')
        .replace(b'POINTS 4', b'POINTS 0'),
        '500000004 numbers per point',
    ),
    'bytes.pcd': (
        padded_pcd().replace(b'1 1 10', b'1 1 4294967295'), '4294967317 bytes per point'
    ),
    'size.pcd': (
        descriptor_pcd().replace(b'SIZE 4 4 4 4', b'SIZE 4 4 4 2147483647'),
        'SIZE 2147483647: must be a whole number, at most 65536',
    ),
    'nowidth.pcd': (padded_pcd().replace(b'WIDTH 2', b'WIDTH'), 'WIDTH : must be a whole number'),
    'form.pcd': (padded_pcd().replace(b'DATA binary', b'DATA\xff'), 'DATA : must be ascii'),
    'type.pcd': (padded_pcd().replace(b'TYPE F', b'TYPE X'), 'field x: no type X of 4 bytes'),
    'data.pcd': (padded_pcd().replace(b'DATA binary', b'DATA other'), 'DATA other: must be'),
    'none.pcd': (b'no header', 'no DATA line'),
    'element.ply': (
        ply().replace(b'vertex 4', b'vertex'), "line 'element vertex' of its header cannot be"
    ),
    'property.ply': (
        ply().replace(b'element vertex 4\n', b''), "line 'property float x' of its header cannot"
    ),
    'many.ply': (ply(form=LE, body=bytes(48)).replace(b'x 4', b'x 4000000'), '4000000 points'),
}  # fmt: skip


def bag_of(suffix, write=bag_samples.write_ros2_bag):
    """Bytes of a bag."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, f'a{suffix}')
        write(path)
        return path.read_bytes()


def write_changed(path, **changes):
    """Write a bag with one cloud that is not as it says."""
    points = bag_samples.cloud()
    for name, value in changes.items():
        setattr(points, name, value)
    with BagWriter(path) as bag:
        bag.add_topic('/points')
        bag.write('/points', 0, encode_cloud(points))


def write_wide(path):
    fields = bag_samples.cloud().fields
    fields[3].count = 400_000_000
    write_changed(path, width=0, data=np.zeros(0, np.uint8), row_step=0, fields=fields)


def long_record(bag, place, form):
    """The bag with a first record that is said to have 3 GB."""
    size = struct.pack(form, 3_000_000_000)
    return bag[:place] + size + bag[place + len(size) :]


LIES |= {
    'points.mcap': (
        bag_of('.mcap', partial(write_changed, width=400_000_000)),
        'bytes: must be at least 8800000000',
    ),
    'wide.db3': (bag_of('.db3', write_wide), '400000004 numbers per point'),
    # Behind the magic of the format; in MCAP behind the kind of the record as well.
    'record.mcap': (long_record(bag_of('.mcap'), 9, '<Q'), 'cannot be read as a bag'),
    'record.bag': (
        long_record(bag_of('.bag', bag_samples.write_ros1_bag), len('#ROSBAG V2.0\n'), '<I'),
        'cannot be read as a bag',
    ),
}


PEAK = """
import sys
from gp_ground_seg.cli.main import main
for name in sys.argv[1:]:
    assert main(['segment', name, '-o', 'out.pcd', '--force']) == 2, name
print([line.split()[1] for line in open('/proc/self/status') if line.startswith('VmHWM')][0])
"""


def test_files_that_cannot_be_are_refused_with_the_reason_and_take_no_memory(tmp_path):
    for name, (data, _) in LIES.items():
        (tmp_path / name).write_bytes(data)
    done = subprocess.run(
        [sys.executable, '-c', PEAK, *LIES], cwd=tmp_path, capture_output=True, text=True,
        check=True,
    )  # fmt: skip
    for line, (name, (_, message)) in zip(done.stderr.splitlines(), LIES.items(), strict=True):
        assert line.startswith(f'gp-ground-seg: error: {name}')
        assert re.search(message, line), line
    assert not (tmp_path / 'out.pcd').exists()
    assert 1024 * int(done.stdout) < 600_000_000
