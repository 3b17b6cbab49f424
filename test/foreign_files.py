"""Files as drivers, recorders and other programs write them, or as nobody should.

`CASES`: name -> (bytes, or a function that writes a bag; names of the fields, or topic and number
of clouds, or the line that refuses it). The points are `XYZ`, in bags three clouds of them.
"""

import contextlib
import io
import sqlite3
import struct
import zipfile

import bag_samples as samples
import lzf
import numpy as np
from mcap.writer import CompressionType, IndexType, Writer

from gp_ground_seg.data.bags import POINT_CLOUD2, cloud_from_points, encode_cloud

XYZ = np.arange(12, dtype='f4').reshape(4, 3)
RAW = XYZ.tobytes()
RING = np.arange(4, dtype='<u2')
CASES = {}


def text_of(table):
    return b''.join(b' '.join(str(v).encode() for v in row) + b'\n' for row in table)


def with_ring(*values):
    return text_of([*row, v] for row, v in zip(XYZ.tolist(), values, strict=True))


def rows(*columns):
    """Binary points of x, y, z and further columns."""
    parts = [XYZ.view('u1'), *(column.reshape(4, 1).view('u1') for column in columns)]
    return np.hstack(parts).tobytes()


# Those of numpy.


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
            archive.writestr(f'{name}.npy', data if isinstance(data, bytes) else npy(data))
    return file.getvalue()


WIDE_TABLE = 'x y z intensity column_5 column_6 ring'
NESTED = npy(np.zeros(4, [('p', [('x', 'f4'), ('y', 'f4')])]))
CASES |= {
    'objects.npy': (npy(np.array([{}, 1]), allow_pickle=True), 'Object arrays cannot be'),
    'shape.npy': (npy_header((9999999999, 3)), r'\.npy; is it whole\? \('),
    'columns.npy': (npy_header((0, 10**12)), '1000000000000 numbers per point'),
    'turned.npy': (npy(np.zeros((3, 200), 'f4')), r'\(3, 200\): is transposed'),
    'nested.npy': (NESTED, 'no field x of one number per point; fields: p'),
    'flat.npy': (npy(np.arange(9.0)), r'array of shape \(9,\): must be \(N, 3\)'),
    'shape.npz': (npz(a=npy_header((10**9, 3)) + bytes(10**6)), r'\.npz; is it whole\? \('),
    'names.npz': (npz(a=XYZ, b=XYZ), r'arrays a \(4, 3\), b \(4, 3\):.*; call it points'),
    'open3d.npz': (
        npz(colors=-XYZ, normals=-XYZ, pose=np.eye(4)[:3], positions=XYZ), 'x y z colors normals'
    ),
    'more_rows.npz': (npz(a=-XYZ[:3], b=XYZ, calib=np.eye(9)), 'x y z'),
    'colours.npz': (npz(colours=XYZ), r'must be x, y, z, or one \(N, 3\)'),
    'structured.npy': (npy(np.rec.fromarrays(XYZ.T, names='X,Y,Z')), 'X Y Z'),
    'fields.npz': (
        npz(points=RING, pose=np.eye(3), **dict(zip('XYZ', XYZ.T, strict=True))), 'points X Y Z'
    ),
    **{
        f'{k}.npz': (npz(pose=np.eye(3)[0], ring=RING, **{k: np.hstack([XYZ, XYZ])}), WIDE_TABLE)
        for k in ('points', 'xyzi', 'arr_0')
    },
    'text.npy': (text_of(XYZ), r"no file of numpy; it begins with b'0.0 1.0 2.0"),
    'pickle.npz': (b'\x80\x04K\x01.', r"no file of numpy; it begins with b'\\x80"),
    'mesh.npz': (npz(vertices=XYZ, faces=np.zeros((9, 3), int)), 'x y z'),
    'boxes.npz': (npz(boxes=np.zeros((9, 7)), lidar=XYZ), 'x y z'),
    'columns_of_2d.npz': (npz(x=XYZ[:, :1], y=RING, z=RING), r"x \('<f4', \(1,"),
    'words.npy': (npy(XYZ.astype(str)), 'no field x of one number per point; fields: x <U'),
    'halves.npy': (npy(XYZ.astype('f2')), 'x y z'),
    'turned_bytes.npy': (npy(np.asfortranarray(XYZ.astype('>f8'))), 'x y z'),
    'image.npy': (npy(XYZ.reshape(2, 2, 3)), r'a table after \.reshape\(-1, 3\)'),
}  # fmt: skip


# PCD.


def pcd(fields='x y z', sizes='4 4 4', types='F F F', data='ascii', body=None, **lines):
    """A PCD; `lines` replace those of a usual header, None leaves one out."""
    entries = {
        'VERSION': '0.7', 'FIELDS': fields, 'SIZE': sizes, 'TYPE': types,
        'COUNT': ' '.join('1' for _ in fields.split()), 'WIDTH': '4', 'HEIGHT': '1',
        'VIEWPOINT': '0 0 0 1 0 0 0', 'POINTS': '4', **lines, 'DATA': data,
    }  # fmt: skip
    text = ''.join(f'{key} {words}\n' for key, words in entries.items() if words is not None)
    return text.encode() + (text_of(XYZ) if body is None else body)


def ring_pcd(body, kind='U', name='ring', data='ascii'):
    return pcd(f'x y z {name}', '4 4 4 2', f'F F F {kind}', data, body)


def many(n, body=RAW, data='binary', n_bytes=12):
    """A PCD of so many points in its header, `n_bytes` each unpacked."""
    if data == 'binary_compressed':
        packed = lzf.compress(bytes(n_bytes))
        body = struct.pack('<II', len(packed), min(n * n_bytes, 2**32 - 1)) + packed
    return pcd(data=data, body=body, WIDTH=n, POINTS=n)


def packed(**lines):
    body = lzf.compress(XYZ.T.tobytes())
    return pcd(data='binary_compressed', body=struct.pack('<II', len(body), 48) + body, **lines)


def four(size='4', count='1', **lines):
    """A binary PCD with a fourth field of this size and count."""
    count = f'1 1 1 {count}'
    return pcd('x y z a', f'4 4 4 {size}', 'F F F F', 'binary', RAW, COUNT=count, **lines)


CASES |= {
    'one_point.pcd': (pcd(body=text_of(XYZ[:1]), WIDTH='1', POINTS='1'), 'x y z'),
    'no_point.pcd': (pcd(body=b'', WIDTH='0', POINTS='0'), 'no points in it'),
    'columns.pcd': (pcd(data='BINARY', body=RAW).replace(b'FIELDS', b'COLUMNS'), 'x y z'),
    'no_width.pcd': (pcd(WIDTH=None, HEIGHT=None), 'x y z'),
    'no_points.pcd': (pcd(POINTS=None), 'x y z'),
    'no_width_or_points.pcd': (pcd(WIDTH=None, POINTS=None), 'no WIDTH or POINTS line'),
    'defaults.pcd': (pcd(SIZE=None, TYPE=None, COUNT=None, VIEWPOINT=None), 'x y z'),
    'small_keys.pcd': (pcd().replace(b'FIELDS', b'fields').replace(b'WIDTH', b'width'), 'x y z'),
    'nan_as_integer.pcd': (ring_pcd(with_ring('nan', 1, 2, 3)), 'x y z ring'),
    'large_integer.pcd': (ring_pcd(with_ring(70000, 1, 2, 3)), 'x y z ring'),
    'capitals.pcd': (pcd(fields='X Y Z', data='binary', body=RAW), 'X Y Z'),
    'x_twice.pcd': (ring_pcd(rows(RING), name='x', data='binary'), 'x y z x_2'),
    'unknown_type.pcd': (ring_pcd(rows(RING), 'S'), 'field ring: no type S of 2 bytes'),
    'word.pcd': (ring_pcd(with_ring(*'abcd')), 'x y z'),
    'word_as_x.pcd': (pcd(body=text_of(XYZ).replace(b'9.0', b'a')), "x: .* 'a' .* at row 3, "),
    'word_as_z.pcd': (pcd(body=text_of(XYZ).replace(b'11.0', b'-')), "z: .* '-' .* at row 3, "),
    'empty_lines.pcd': (pcd(body=text_of(XYZ).replace(b'\n', b'\n\n') + b' \n'), 'x y z'),
    'byte_order_mark.pcd': (b'\xef\xbb\xbf# .PCD v0.7\n\n' + pcd(), 'x y z'),
    'crlf.pcd': (pcd().replace(b'\n', b'\r\n'), 'x y z'),
    'cut.pcd': (pcd(data='binary', body=RAW[:-3]), 'truncated?'),
    'cut_text.pcd': (pcd(body=text_of(XYZ)[:-14]), 'truncated?'),
    'space_in_a_name.pcd': (pcd('x y z my ring', '4 4 4 2', 'F F F U', COUNT=None), r'a name\?'),
    'no_fields.pcd': (pcd(FIELDS=None), 'no FIELDS line'),
    'none.pcd': (b'no header', "no DATA line of a header in it; it begins with b'no header'"),
    'lfs.pcd': (b'version https://git-lfs.github.com/spec/v1\noid', '`git lfs pull` fetches it'),
    'commas.pcd': (pcd(body=4 * b'0,1,2\n'), 'a line of 1 words, its header says 3, separated by'),
    'no_size.pcd': (pcd(data='binary', body=RAW, WIDTH='0', HEIGHT='0'), 'x y z'),
    'no_height.pcd': (pcd(HEIGHT='0'), 'x y z'),
    'no_size_packed.pcd': (packed(WIDTH='0', HEIGHT='0'), 'x y z'),
    'turned.pcd': (pcd(WIDTH='1', HEIGHT='4'), 'x y z'),
    'fraction.pcd': (pcd(WIDTH='4.0'), r'WIDTH 4\.0: must be a whole number'),
    'cut_packed.pcd': (packed()[:-5], 'packed bytes cannot hold the 48 of its header; truncated'),
    'no_body_packed.pcd': (pcd(data='binary_compressed', body=b'ab'), 'body of 0 bytes'),
    'junk_packed.pcd': (
        pcd(data='binary_compressed', body=struct.pack('<II', 40, 48) + bytes(range(40))),
        '40 packed bytes cannot hold the 48',
    ),
    'too_many_given.pcd': (pcd(WIDTH='0', HEIGHT='0', POINTS='5'), 'truncated?'),
    'sizes.pcd': (pcd(WIDTH='9'), '4 points, which is not width 9'),
    'many.pcd': (many(8000000), '8000000 points'),
    'packed.pcd': (
        many(40000000, data='binary_compressed'), 'packed bytes cannot hold the 480000000 of its'
    ),
    'lzf.pcd': (many(400000000, data='binary_compressed'), 'its header says 4800000000'),
    'wide.pcd': (four(count='500000000', WIDTH='0', POINTS='0'), '500000003 numbers per point'),
    'bytes.pcd': (
        four('8', count='900000000', WIDTH='0', POINTS='0').replace(b' a\n', b' _\n'),
        '900000003 numbers per point',
    ),
    'count.pcd': (four(count='9' * 11), 'COUNT 99999999999: must be a whole number, at most 4'),
    'data.pcd': (pcd(data='other'), 'DATA other: must be'),
}  # fmt: skip


# PLY.

LE, BE = 'binary_little_endian', 'binary_big_endian'
LISTS = ',list uchar int a,list uchar uchar b'
FACES = 'element face 2,property list uchar int vertex_indices'
FACE_BYTES = struct.pack('<B3iB4i', 3, 0, 1, 2, 4, 0, 1, 2, 3)


def ply(more='', body=None, form='ascii', before='', after='', kind='float'):
    """A PLY of four vertices with x, y, z and more; `before` and `after` are other elements."""
    vertex = f'element vertex 4,{kind} x,{kind} y,{kind} z{more}'.replace(',', ',property ')
    parts = ['ply', f'format {form} 1.0', 'comment made up', before, vertex, after, 'end_header']
    text = ''.join(f'{line}\n' for part in parts if part for line in part.split(','))
    return text.encode() + (text_of(XYZ) if body is None else body)


LISTED = {
    o: b''.join(struct.pack(f'{o}fffB{k}iBB', *v, k, *range(k), 1, 7) for k, v in enumerate(XYZ))
    for o in '<>'
}
CASES |= {
    'list_last.ply': (ply(LISTS, LISTED['<'], LE), 'x y z'),
    'list_last_big.ply': (ply(LISTS, LISTED['>'], BE), 'x y z'),
    'list_last_text.ply': (ply(',list uchar int a', with_ring(0, '1 5', 0, '2 4 7')), 'x y z'),
    'list_between.ply': (ply(LISTS + ',uchar r', LISTED['<'], LE), 'numbers, and behind them'),
    'list_cut.ply': (ply(LISTS, LISTED['<'][:-1], LE), 'truncated'),
    'faces_first.ply': (
        ply(form=LE, before=FACES, body=FACE_BYTES + RAW), 'elements face 2, vertex 4'
    ),
    'faces_behind.ply': (ply(form=LE, after=FACES, body=RAW + FACE_BYTES), 'x y z'),
    'int64.ply': (ply(',int64 t', rows(np.arange(4)), LE), 'x y z t'),
    'numbered_types.ply': (ply(',uint16 t', with_ring(1, 2, 3, 4), kind='float32'), 'x y z t'),
    'unknown_type.ply': (ply(',quad t', RAW, LE), "line 'property quad t' of its header"),
    'no_type.ply': (ply(','), "line 'property' of its header cannot be read"),
    'float_as_integer.ply': (ply(',uchar t', with_ring('0.0', 1, 2, 'nan')), 'x y z t'),
    'name_twice.ply': (ply(',ushort a,ushort a', rows(RING, RING), LE), 'x y z a a_2'),
    'nan_of_windows.ply': (
        ply(',float i', with_ring('-nan(ind)', '1.#QNAN', '-1.#IND', 3)), 'x y z i'
    ),
    'word_as_y.ply': (ply(body=text_of(XYZ).replace(b'10.0', b'1,5')), "y: .* '1,5' .* row 3, "),
    'word.ply': (ply(',float i', with_ring('a', 1, 2, 3)), 'x y z'),
    'crlf_binary.ply': (ply(body=b'', form=LE).replace(b'\n', b'\r\n') + RAW, 'x y z'),
    'umlaut.ply': (ply(',ushort höhe', rows(RING), LE), 'x y z höhe'),
    'latin1.ply': (ply().replace(b'made up', b'\xfcber'), 'x y z'),
    'element.ply': (ply().replace(b'vertex 4', b'vertex'), 'no PLY with .*, elements vertex$'),
    'many.ply': (ply(form=LE, body=bytes(48)).replace(b'x 4', b'x 4000000'), '4000000 points'),
}  # fmt: skip


# MCAP: channels as (topic, encoding, schema, its encoding).

CLOUD = encode_cloud(cloud_from_points(XYZ, 10**9, 'lidar'))
POINTS = '/points', 'cdr', POINT_CLOUD2, 'ros2msg'
LOG = '/log', 'protobuf', 'foxglove.Log', 'protobuf'
NO_SUMMARY = {
    'index_types': IndexType.NONE, 'use_statistics': False, 'repeat_channels': False,
    'repeat_schemas': False, 'use_summary_offsets': False,
}  # fmt: skip


def mcap(*channels, profile='ros2', times=range(3), **options):
    """Function that writes three messages on each channel, (b'{}' where it has no clouds)."""

    def write(path):
        writer = Writer(str(path), **options)
        writer.start(profile, 'made up')
        for topic, encoding, schema, schema_encoding in channels or [POINTS]:
            number = schema and writer.register_schema(schema, schema_encoding, b'{}')
            channel = writer.register_channel(topic, encoding, number or 0)
            for time in times:
                data = CLOUD if schema == POINT_CLOUD2 else b'{}'
                writer.add_message(channel, time, data, time)
        writer.finish()

    return write


def damaged(change):
    def write(path):
        mcap(compression=CompressionType.NONE)(path)
        path.write_bytes(change(path.read_bytes()))

    return write


def with_one(**changes):
    """Function that writes a bag with one cloud, which is not as it says."""

    def write(path):
        points = samples.cloud()
        for name, value in changes.items():
            setattr(points, name, value)
        samples.write_clouds(path, [encode_cloud(points)])

    return write


def write_long_record(path):
    """Write a bag with a first record that is said to have 3 GB."""
    samples.write_ros1_bag(path)
    with open(path, 'r+b') as file:
        file.seek(len('#ROSBAG V2.0\n'))
        file.write(struct.pack('<I', 3_000_000_000))


WIDE_FIELDS = samples.cloud().fields
WIDE_FIELDS[3].count = 400_000_000
WIDE = {'width': 0, 'data': np.zeros(0, np.uint8), 'row_step': 0, 'fields': WIDE_FIELDS}
NO_BAG = 'cannot be read as a bag; '
THREE = '/points 3'


def message_of(value):
    """Function that writes a bag whose messages have a value of another type of sqlite."""

    def write(path):
        samples.write_ros2_bag(path, 3)
        with contextlib.closing(sqlite3.connect(path)) as bag:
            bag.execute(f'UPDATE messages SET {value}')
            bag.commit()

    return write


CASES |= {
    **{f'empty.{end}': (b'', NO_BAG) for end in ('mcap', 'bag', 'db3')},
    'points.mcap': (with_one(width=400_000_000), 'bytes: must be at least 8800000000'),
    'wide.db3': (with_one(**WIDE), '400000004 numbers per point'),
    'whole.db3': (message_of('data = 1000000000'), f"{NO_BAG}.*not 'int'"),
    'time.db3': (message_of("timestamp = 'a'"), NO_BAG),
    'negative.db3': (message_of('timestamp = -5'), f'{NO_BAG}.*is recorded at -5 ns'),
    'no_bytes.db3': (message_of("data = x''"), '0 bytes that are no sensor_msgs/msg/PointCloud2'),
    'zeros.db3': (message_of('data = zeroblob(99)'), '99 bytes that are no sensor_msgs'),
    'record.bag': (write_long_record, NO_BAG),
    'plain.mcap': (mcap(), THREE),
    'no_chunks.mcap': (mcap(times=(2, 0, 1), use_chunking=False), THREE),
    'no_summary.mcap': (mcap(POINTS, LOG, **NO_SUMMARY), THREE),
    'no_statistics.mcap': (mcap(use_statistics=False), THREE),
    'no_message_index.mcap': (mcap(index_types=IndexType.CHUNK), THREE),
    'protobuf_beside.mcap': (mcap(POINTS, LOG), THREE),
    'json_without_schema.mcap': (mcap(POINTS, ('/log', 'json', '', '')), THREE),
    'json_on_the_topic.mcap': (mcap(('/points', 'json', 'A', 'jsonschema'), POINTS), THREE),
    'two_publishers.mcap': (mcap(POINTS, (*POINTS[:3], 'ros2idl')), '/points 6'),
    'no_profile.mcap': (mcap(profile=''), THREE),
    'ros1_messages.mcap': (
        mcap(('/points', 'ros1', 'sensor_msgs/PointCloud2', 'ros1msg'), profile=''),
        r'no .*PointCloud2 topic; topics here: /points \(sensor_msgs/PointCloud2, ros1\)',
    ),
    'only_foxglove.mcap': (mcap(LOG), r'topics here: /log \(foxglove.Log, protobuf\)'),
    'cut.mcap': (damaged(lambda data: data[:-200]), 'mcap recover'),
    'bad_crc.mcap': (damaged(lambda data: data.replace(b'lidar', b'ladar')), r'\(.*crc'),
}  # fmt: skip


# metadata.yaml of a rosbag2 folder.


def folder(change):
    """Function that writes a folder of three clouds, its metadata.yaml changed."""

    def write(path):
        samples.write_clouds(path, [CLOUD] * 3)
        metadata = path / 'metadata.yaml'
        before = metadata.read_text()
        metadata.write_text(change(before))
        assert metadata.read_text() != before

    return write


def replaced(old, new):
    return folder(lambda text: text.replace(old, new))


REINDEX = r'cannot be read as a bag; .*`ros2 bag reindex` writes metadata\.yaml anew'
CASES |= {
    'whole_paths': (replaced('- whole', '- /old/whole'), THREE),
    'too_many': (
        replaced('message_count: 3', 'message_count: 4'),
        'topic /points lists 4 messages, 3 could be read',
    ),
    'null_count': (replaced('message_count: 3', 'message_count:'), 'no message on /points'),
    'windows_paths': (replaced('- windows', r'- C:\logs\windows'), REINDEX),
    'empty': (folder(lambda text: ''), REINDEX),
    'cut': (folder(lambda text: text[:300]), REINDEX),
    'missing_file': (replaced('- missing', '- no'), REINDEX),
}  # fmt: skip
