"""Files as drivers, recorders and other programs write them, each with what is read of it.

`CASES`: name -> (bytes, or a function that writes a folder; names of the fields, or the line that
refuses it). The points are `XYZ`, in bags three clouds of them.
"""

import struct
import zlib
from typing import NamedTuple

import numpy as np
from rosbags.typesys import Stores, get_typestore

XYZ = np.arange(12, dtype='f4').reshape(4, 3)
CLOUD = 'sensor_msgs/msg/PointCloud2'
CASES = {}


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


def text_of(table):
    return b''.join(b' '.join(str(v).encode() for v in row) + b'\n' for row in table)


def rows(**columns):
    """Binary points of x, y, z and further columns."""
    dtype = [
        *((n, '<f4') for n in 'xyz'),
        *((n, v.dtype, v.shape[1:]) for n, v in columns.items()),
    ]
    points = np.zeros(4, dtype)
    for name, values in {**dict(zip('xyz', XYZ.T, strict=True)), **columns}.items():
        points[name] = values
    return points.tobytes()


def with_ring(*values):
    return text_of([*row, v] for row, v in zip(XYZ.tolist(), values, strict=True))


RAW = XYZ.tobytes()
RING = np.arange(4, dtype='<u2')
WITH_RING = {'fields': 'x y z ring', 'sizes': '4 4 4 2', 'types': 'F F F U'}
TWICE = {'fields': 'x y z a a', 'sizes': '4 4 4 2 2', 'types': 'F F F U U'}
CASES |= {
    'plain.pcd': (pcd(), 'x y z'),
    'binary.pcd': (pcd(data='binary', body=RAW), 'x y z'),
    'columns.pcd': (pcd(data='binary', body=RAW).replace(b'FIELDS', b'COLUMNS'), 'x y z'),
    'no_width.pcd': (pcd(WIDTH=None, HEIGHT=None), 'x y z'),
    'height_only.pcd': (pcd(WIDTH=None, HEIGHT='2'), 'x y z'),
    'no_points.pcd': (pcd(POINTS=None), 'x y z'),
    'no_size_or_width.pcd': (pcd(WIDTH=None, POINTS=None), 'no WIDTH or POINTS line'),
    'no_count.pcd': (pcd(COUNT=None, VIEWPOINT=None), 'x y z'),
    'no_size_and_type.pcd': (pcd(SIZE=None, TYPE=None), 'x y z'),
    'small_keys.pcd': (pcd().replace(b'FIELDS', b'fields').replace(b'WIDTH', b'width'), 'x y z'),
    'float_as_integer.pcd': (pcd(**WITH_RING, body=with_ring('0.0', 1, 2, 3)), 'x y z ring'),
    'nan_as_integer.pcd': (pcd(**WITH_RING, body=with_ring('nan', '1', '2', '3')), 'x y z ring'),
    'exponent.pcd': (pcd(**WITH_RING, body=with_ring('1e3', '1', '2', '3')), 'x y z ring'),
    'negative_unsigned.pcd': (pcd(**WITH_RING, body=with_ring('-1', '1', '2', '3')), 'x y z ring'),
    'large_integer.pcd': (pcd(**WITH_RING, body=with_ring('70000', '1', '2', '3')), 'x y z ring'),
    'capitals_binary.pcd': (pcd(fields='X Y Z', data='binary', body=RAW), 'X Y Z'),
    'data_capitals.pcd': (pcd(data='BINARY', body=RAW), 'x y z'),
    'name_twice.pcd': (pcd(**TWICE, data='binary', body=rows(a=RING, b=RING)), 'x y z a a_2'),
    'name_twice_text.pcd': (
        pcd(**TWICE, body=text_of([*row, 1, 2] for row in XYZ)), 'x y z a a_2'
    ),
    'x_twice.pcd': (
        pcd('x y z x', '4 4 4 4', 'F F F F', 'binary', rows(a=XYZ[:, 1])), 'x y z x_2'
    ),
    'unknown_type.pcd': (pcd('x y z s', '4 4 4 2', 'F F F S', 'binary', rows(a=RING)), 'x y z'),
    'unknown_type_text.pcd': (
        pcd('x y z s', '4 4 4 2', 'F F F S', body=with_ring(*'abcd')), 'x y z'
    ),
    'empty_line.pcd': (pcd(body=text_of(XYZ).replace(b'\n', b'\n\n')), 'x y z'),
    'blank_at_the_end.pcd': (pcd(body=text_of(XYZ) + b'\n  \n'), 'x y z'),
    'byte_order_mark.pcd': (b'\xef\xbb\xbf' + pcd(), 'x y z'),
    'cr.pcd': (pcd().replace(b'\n', b'\r'), 'x y z'),
    'crlf.pcd': (pcd().replace(b'\n', b'\r\n'), 'x y z'),
    'tabs.pcd': (pcd().replace(b' ', b'\t'), 'x y z'),
    'comment.pcd': (b'# .PCD v0.7\n# x\n\n' + pcd(), 'x y z'),
    'umlaut.pcd': (pcd('x y z höhe', '4 4 4 2', 'F F F U', 'binary', rows(a=RING)), 'x y z höhe'),
    'cut.pcd': (pcd(data='binary', body=RAW[:-3]), 'truncated?'),
    'cut_text.pcd': (pcd(body=text_of(XYZ)[:-14]), 'truncated?'),
    'space_in_a_name.pcd': (pcd('x y z my ring', '4 4 4 2', 'F F F U', COUNT=None), r'a name\?'),
    'no_fields.pcd': (pcd(FIELDS=None), 'no FIELDS line'),
}  # fmt: skip


# PLY.


def ply(properties='float x,float y,float z', body=None, form='ascii', before='', after=''):
    """A PLY of four vertices; `before` and `after` are other elements."""
    vertex = ','.join(['element vertex 4', *(f'property {p}' for p in properties.split(','))])
    lines = [
        'ply',
        f'format {form} 1.0',
        'comment made up',
        'obj_info x',
        before,
        vertex,
        after,
        'end_header',
    ]
    text = ''.join(f'{line}\n' for part in lines if part for line in part.split(','))
    return text.encode() + (text_of(XYZ) if body is None else body)


LE, BE = 'binary_little_endian', 'binary_big_endian'
FACES = 'element face 2,property list uchar int vertex_indices'
FACE_BYTES = struct.pack('<B3iB4i', 3, 0, 1, 2, 4, 0, 1, 2, 3)
CAMERA = 'element camera 2,property float view_px,property int viewportx'
LISTED = 'float x,float y,float z,list uchar int views'
MIDDLE = 'float x,list uchar ushort views,float y,list int float w,float z,uchar r'


def listed_rows(order='<'):
    return b''.join(
        struct.pack(f'{order}fffB{k % 3}i', *row, k % 3, *range(k % 3))
        for k, row in enumerate(XYZ)
    )


def middle_rows(order='<'):
    return b''.join(
        struct.pack(f'{order}fB{k}HfI{3 - k}ffB', x, k, *range(k), y, 3 - k, *range(3 - k), z, k)
        for k, (x, y, z) in enumerate(XYZ)
    )


LISTED_TEXT = text_of([*row, k, *range(k)] for k, row in enumerate(XYZ))
MIDDLE_TEXT = text_of(
    [x, k, *range(k), y, 3 - k, *range(3 - k), z, k] for k, (x, y, z) in enumerate(XYZ)
)
CASES |= {
    'plain.ply': (ply(), 'x y z'),
    'little.ply': (ply(form=LE, body=RAW), 'x y z'),
    'big.ply': (ply(form=BE, body=XYZ.astype('>f4').tobytes()), 'x y z'),
    'list_last.ply': (ply(LISTED, listed_rows(), LE), 'x y z'),
    'list_last_big.ply': (ply(LISTED, listed_rows('>'), BE), 'x y z'),
    'list_last_text.ply': (ply(LISTED, LISTED_TEXT), 'x y z'),
    'list_between.ply': (ply(MIDDLE, middle_rows(), LE), 'x y z r'),
    'list_between_big.ply': (ply(MIDDLE, middle_rows('>'), BE), 'x y z r'),
    'list_between_text.ply': (ply(MIDDLE, MIDDLE_TEXT), 'x y z r'),
    'bool.ply': (ply('float x,float y,float z,bool b', rows(b=RING.astype('u1')), LE), 'x y z b'),
    'unknown_text.ply': (
        ply('float x,float y,float z,decimal d', with_ring(0, 1, 2, 3)), 'x y z d'
    ),
    'lists_first.ply': (
        ply('list uchar int v,list uchar int w,float x,float y,float z,list uchar int u',
            b''.join(bytes(2) + row.tobytes() + bytes(1) for row in XYZ), LE),
        'x y z',
    ),
    'list_called_x.ply': (
        ply('list uchar int x,float y,float z', bytes(36), LE),
        'property x of the vertices: is a list',
    ),
    'list_cut.ply': (ply(LISTED, listed_rows()[:-2], LE), 'truncated?'),
    'list_cut_text.ply': (ply(LISTED, LISTED_TEXT[:-20]), 'truncated?'),
    'faces_first.ply': (ply(form=LE, before=FACES, body=FACE_BYTES + RAW), 'x y z'),
    'faces_first_text.ply': (
        ply(before=FACES, body=b'3 0 1 2\n4 0 1 2 3\n' + text_of(XYZ)), 'x y z'
    ),
    'faces_cut.ply': (ply(form=LE, before=FACES, body=FACE_BYTES[:-2]), 'truncated?'),
    'many_faces.ply': (
        ply(form=LE, before=FACES.replace('2', '4000000000'), body=FACE_BYTES + RAW), 'truncated?'
    ),
    'camera_first.ply': (ply(form=LE, before=CAMERA, body=bytes(16) + RAW), 'x y z'),
    'camera_first_text.ply': (ply(before=CAMERA, body=b'0 0\n0 0\n' + text_of(XYZ)), 'x y z'),
    'faces_behind.ply': (ply(form=LE, after=FACES, body=RAW + FACE_BYTES), 'x y z'),
    'capitals.ply': (ply('float X,float Y,float Z'), 'X Y Z'),
    'int64.ply': (
        ply('float x,float y,float z,int64 t', rows(t=np.arange(4)), LE), 'x y z t'
    ),
    'uint64.ply': (ply('float x,float y,float z,uint64 t', with_ring(1, 2, 3, 4)), 'x y z t'),
    'long_names.ply': (
        ply('float32 x,float32 y,float32 z,float64 t', with_ring(1, 2, 3, 4)), 'x y z t'
    ),
    'list_of_unknown.ply': (ply(LISTED.replace('uchar', 'quad'), RAW, LE), 'is a list'),
    'unknown_type.ply': (ply('float x,float y,float z,quad t', RAW, LE), 'is a quad'),
    'float_as_integer.ply': (
        ply('float x,float y,float z,uchar t', with_ring('0.0', 1, 2, 'nan')), 'x y z t'
    ),
    'name_twice.ply': (
        ply('float x,float y,float z,ushort a,ushort a', rows(a=RING, b=RING), LE), 'x y z a a_2'
    ),
    'byte_order_mark.ply': (b'\xef\xbb\xbf' + ply(), 'x y z'),
    'nan_of_windows.ply': (
        ply('float x,float y,float z,float i', with_ring('-nan(ind)', '1.#QNAN', '-1.#IND', 3)),
        'x y z i',
    ),
    'word.ply': (ply('float x,float y,float z,float i', with_ring('a', 1, 2, 3)), 'x y z'),
    'cr.ply': (ply().replace(b'\n', b'\r'), 'x y z'),
    'cr_binary.ply': (ply(body=b'', form=LE).replace(b'\n', b'\r') + RAW, 'x y z'),
    'cr_before_a_line_feed.ply': (
        ply('uchar r,float x,float y,float z', b'', LE).replace(b'\n', b'\r')
        + b''.join(b'\n' + row.tobytes() for row in XYZ),
        'r x y z',
    ),
    'crlf.ply': (ply().replace(b'\n', b'\r\n'), 'x y z'),
    'crlf_binary.ply': (ply(body=b'', form=LE).replace(b'\n', b'\r\n') + RAW, 'x y z'),
    'empty_line.ply': (ply(body=text_of(XYZ).replace(b'\n', b'\n\n')), 'x y z'),
    'umlaut.ply': (ply('float x,float y,float z,ushort höhe', rows(a=RING), LE), 'x y z höhe'),
    'latin1.ply': (ply().replace(b'made up', b'\xfcber'), 'x y z'),
    'only_faces.ply': (
        b'ply\nformat ascii 1.0\nelement face 0\nproperty list uchar int a\nend_header\n',
        'no vertices',
    ),
}  # fmt: skip


# MCAP, by https://mcap.dev/spec.


class Channel(NamedTuple):
    """A channel, and its messages."""

    topic: str
    encoding: str
    schema: str
    schema_encoding: str
    definition: str
    messages: list


def record(kind, body):
    return struct.pack('<BQ', kind, len(body)) + body


def string(value):
    data = value.encode()
    return struct.pack('<I', len(data)) + data


def mapping(entries, form='<HQ'):
    body = b''.join(struct.pack(form, *entry) for entry in entries)
    return struct.pack('<I', len(body)) + body


def clouds(n=3):
    """Three messages of four points in CDR."""
    types = get_typestore(Stores.ROS2_JAZZY)
    new = types.types
    fields = [new['sensor_msgs/msg/PointField'](name, 4 * k, 7, 1) for k, name in enumerate('xyz')]
    stamp = new['builtin_interfaces/msg/Time'](1, 0)
    header = new['std_msgs/msg/Header'](stamp, 'lidar')
    data = np.frombuffer(RAW, np.uint8)
    message = new[CLOUD](header, 1, 4, fields, False, 12, 48, data, True)
    return [bytes(types.serialize_cdr(message, CLOUD))] * n


def definition():
    return get_typestore(Stores.ROS2_JAZZY).generate_msgdef(CLOUD, ros_version=2)[0]


def points(topic='/points', first=0, **changes):
    messages = [(first + k, data) for k, data in enumerate(clouds())]
    channel = Channel(topic, 'cdr', CLOUD, 'ros2msg', definition(), messages)
    return channel._replace(**changes)


def beside(encoding, schema='foxglove.Log', schema_encoding=None, topic='/log', **changes):
    """A channel of something else with one message."""
    kind = encoding if schema_encoding is None else schema_encoding
    return Channel(topic, encoding, schema, kind, '{}', [(1, b'{}')])._replace(**changes)


def schema_record(number, channel):
    parts = map(string, (channel.schema, channel.schema_encoding, channel.definition))
    return record(3, struct.pack('<H', number) + b''.join(parts))


def head(number, channel):
    """Schema and channel; a channel without a schema has the number 0 for it."""
    schema = schema_record(number, channel) if channel.schema else b''
    names = string(channel.topic) + string(channel.encoding) + struct.pack('<I', 0)
    return schema + record(4, struct.pack('<HH', number, number if schema else 0) + names)


def mcap(*channels, profile='ros2', chunked=True, index=True, summary='ACS', crc=None, packed=''):
    """An MCAP file; `summary` has A for channels, C for chunks, S for statistics, or nothing."""
    numbered = list(enumerate(channels, 1))
    heads = b''.join(head(*entry) for entry in numbered)
    entries = [(time, n, data) for n, c in numbered for time, data in c.messages]
    file = bytearray(b'\x89MCAP0\r\n' + record(1, string(profile) + string('made up')))
    body, places = heads, {}
    for time, n, data in entries:
        places.setdefault(n, []).append((time, len(body)))
        body += record(5, struct.pack('<HIQQ', n, 0, time, time) + data)
    start, chunk_index = len(file), b''
    if chunked:
        check = zlib.crc32(body) if crc is None else crc
        raw = {'zstd': pack_zstd, 'lz4': pack_lz4}.get(packed, bytes)(body)
        times = struct.pack('<QQ', 0, 99)
        sizes = struct.pack('<QI', len(body), check) + string(packed)
        file += record(6, times + sizes + struct.pack('<Q', len(raw)) + raw)
        end, offsets = len(file), []
        for n, at in places.items() if index else ():
            offsets.append((n, len(file)))
            file += record(7, struct.pack('<H', n) + mapping(at, '<QQ'))
        chunk_index = record(8, times + struct.pack('<QQ', start, end - start) + mapping(offsets)
                             + struct.pack('<Q', len(file) - end) + string(packed)
                             + struct.pack('<QQ', len(raw), len(body)))  # fmt: skip
    else:
        file += body
    file += record(15, struct.pack('<I', 0))
    start = len(file)
    counts = mapping((n, len(at)) for n, at in places.items())
    numbers = (len(entries), len(channels), len(channels), 0, 0, int(chunked), 0, 99)
    statistics = record(11, struct.pack('<QHIIIIQQ', *numbers) + counts)
    for name, part in (('A', heads), ('C', chunk_index), ('S', statistics)):
        file += part if name in summary else b''
    place = start if len(file) > start else 0
    return bytes(file + record(2, struct.pack('<QQI', place, 0, 0)) + b'\x89MCAP0\r\n')


def pack_zstd(data):
    from rosbags.rosbag2.reader import zstd

    return zstd.compress(data)


def pack_lz4(data):
    import lz4.frame

    return lz4.frame.compress(data)


THREE = '/points 3'
UNORDERED = points(messages=points().messages[::-1])
CASES |= {
    'plain.mcap': (mcap(points()), THREE),
    'zstd.mcap': (mcap(points(), packed='zstd'), THREE),
    'lz4.mcap': (mcap(points(), packed='lz4'), THREE),
    'no_chunks.mcap': (mcap(points(), chunked=False), THREE),
    'no_order.mcap': (mcap(UNORDERED, chunked=False), THREE),
    'no_summary.mcap': (mcap(points(), summary=''), THREE),
    'no_statistics.mcap': (mcap(points(), summary='AC'), THREE),
    'no_channels_in_summary.mcap': (mcap(points(), summary='CS'), THREE),
    'no_chunk_index.mcap': (mcap(points(), summary='AS'), THREE),
    'no_message_index.mcap': (mcap(points(), index=False), THREE),
    'protobuf_beside.mcap': (mcap(points(), beside('protobuf')), THREE),
    'protobuf_first.mcap': (mcap(beside('protobuf'), points()), THREE),
    'json_beside.mcap': (mcap(points(), beside('json', 'Log', 'jsonschema')), THREE),
    'json_without_schema.mcap': (mcap(points(), beside('json', '', '')), THREE),
    'json_on_the_topic.mcap': (
        mcap(beside('json', 'Log', 'jsonschema', '/points'), points()), THREE
    ),
    'foreign_in_no_summary.mcap': (mcap(points(), beside('protobuf'), summary=''), THREE),
    'flatbuffer_beside.mcap': (mcap(points(), beside('flatbuffer', 'Grid')), THREE),
    'idl.mcap': (mcap(points(schema_encoding='ros2idl')), THREE),
    'omgidl_beside.mcap': (mcap(points(), beside('cdr', 'a::B', 'omgidl')), THREE),
    'two_types_beside.mcap': (
        mcap(points(), beside('cdr', 'a/msg/A'), beside('cdr', 'a/msg/B')), THREE
    ),
    'two_publishers.mcap': (mcap(points(), points(first=10)), '/points 6'),
    'no_profile.mcap': (mcap(points(), profile=''), THREE),
    'other_profile.mcap': (mcap(points(), profile='foxglove'), THREE),
    'ros1_profile.mcap': (
        mcap(points(encoding='ros1', schema_encoding='ros1msg'), profile='ros1'), 'rosbags-convert'
    ),
    'ros1_profile_alone.mcap': (mcap(points(), profile='ros1'), 'rosbags-convert'),
    'ros1_messages.mcap': (
        mcap(points(encoding='ros1', schema='sensor_msgs/PointCloud2'), profile=''),
        r'no .*PointCloud2 topic; topics here: /points \(sensor_msgs/PointCloud2, ros1\)',
    ),
    'only_foxglove.mcap': (
        mcap(beside('protobuf', 'foxglove.PointCloud')),
        r'topics here: /log \(foxglove.PointCloud, protobuf\)',
    ),
    'cut.mcap': (mcap(points())[:-200], 'mcap recover'),
    'bad_crc.mcap': (mcap(points(), crc=5), 'cannot be read as a bag'),
}  # fmt: skip


# metadata.yaml of a rosbag2 folder.


def sqlite(path, topics=(('/points', CLOUD, 'cdr'),), qos=''):
    """A file as rosbag2 of Humble writes it."""
    import sqlite3

    with sqlite3.connect(path) as db:
        db.execute('CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, '
                   'serialization_format TEXT, offered_qos_profiles TEXT)')  # fmt: skip
        db.execute('CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, '
                   'timestamp INTEGER, data BLOB)')  # fmt: skip
        for number, topic in enumerate(topics, 1):
            db.execute('INSERT INTO topics VALUES(?, ?, ?, ?, ?)', (number, *topic, qos))
        for time, data in enumerate(clouds()):
            row = time, data
            db.execute('INSERT INTO messages(topic_id, timestamp, data) VALUES(1, ?, ?)', row)
    db.close()


TOPIC = """\
    - topic_metadata:
        name: {}
        type: {}
        serialization_format: {}
        offered_qos_profiles: "{}"
      message_count: {}
"""
CLOUDS = TOPIC.format('/points', CLOUD, 'cdr', '', 3)
METADATA = """\
rosbag2_bagfile_information:
  version: 5
  storage_identifier: sqlite3
  duration:
    nanoseconds: 2
  starting_time:
    nanoseconds_since_epoch: 0
  message_count: 3
  topics_with_message_count:
{topics}  compression_format: ""
  compression_mode: ""
  relative_file_paths:
    - drive.db3
  files:
    - path: drive.db3
      starting_time:
        nanoseconds_since_epoch: 0
      duration:
        nanoseconds: 2
      message_count: 3
""".replace('{topics}', CLOUDS)


def folder(change=str, **options):
    """Function that writes a folder whose metadata.yaml is changed."""

    def write(path):
        path.mkdir()
        sqlite(path / 'drive.db3', **options)
        said = change(METADATA)
        (path / 'metadata.yaml').write_bytes(said if isinstance(said, bytes) else said.encode())

    return write


def replaced(old, new):
    assert old in METADATA
    return folder(lambda text: text.replace(old, new))


NAMED = r'metadata\.yaml: .*ros2 bag reindex'
CASES |= {
    'plain': (folder(), THREE),
    'reindexed': (replaced('storage_identifier: sqlite3', 'storage_identifier: ""'), THREE),
    'no_storage': (replaced('  storage_identifier: sqlite3\n', ''), THREE),
    'null_storage': (replaced('storage_identifier: sqlite3', 'storage_identifier:'), THREE),
    'wrong_storage': (replaced('storage_identifier: sqlite3', 'storage_identifier: mcap'), THREE),
    'version_10': (replaced('version: 5', 'version: 10'), THREE),
    'no_times': (replaced('  duration:\n    nanoseconds: 2\n  starting_time:', '  x:'), THREE),
    'bad_qos': (replaced('profiles: ""', 'profiles: "- history: [{"'), THREE),
    'other_qos': (replaced('profiles: ""', 'profiles: "- history: 1\\n  depth: 5"'), THREE),
    'null_compression': (replaced('compression_mode: ""', 'compression_mode:'), THREE),
    'folder_in_its_paths': (replaced('    - drive.db3', '    - old/drive.db3'), THREE),
    'windows_paths': (replaced('    - drive.db3', r'    - C:\logs\drive.db3'), THREE),
    'null_count': (replaced('message_count: 3\n  compr', 'message_count:\n  compr'), THREE),
    'json_topic': (
        folder(
            lambda text: text.replace(CLOUDS, CLOUDS + TOPIC.format('/a', 'A', 'json', '', 0)),
            topics=(('/points', CLOUD, 'cdr'), ('/a', 'A', 'json'), ('/b', 'b/msg/B', 'cdr')),
        ),
        THREE,
    ),
    'empty': (folder(lambda _: ''), NAMED),
    'a_list': (folder(lambda _: '- 1'), NAMED),
    'cut': (folder(lambda text: text[:300]), NAMED),
    'cut_in_a_word': (folder(lambda text: text[: text.index('relative') + 4]), NAMED),
    'no_yaml': (folder(lambda _: 'a: ['), NAMED),
    'no_text': (folder(lambda _: b'\xff\xfe\0'), NAMED),
    'no_topics': (replaced('topics_with', 'x'), THREE),
    'null': (folder(lambda _: 'rosbag2_bagfile_information:\n'), NAMED),
    'null_topics': (replaced(CLOUDS, ''), THREE),
    'null_files': (replaced('    - drive.db3\n', ''), NAMED),
    'paths_as_text': (
        replaced('relative_file_paths:\n    - drive.db3', 'relative_file_paths: drive.db3'), NAMED
    ),
    'missing_file': (replaced('    - drive.db3', '    - no.db3'), r'metadata\.yaml: no\.db3: '),
    'other_plugin': (replaced('- drive.db3', '- metadata.yaml'), r'accepted are \.mcap and \.db3'),
}  # fmt: skip
