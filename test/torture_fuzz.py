"""Files and messages found by coverage: what reaches a new line of a reader is mutated further.

Whatever the bytes are, a reader gives a cloud or one line, within a time and without a warning. A
cloud that was read is written, and comes back with every field. `torture.py` runs it, a case is
`N_INPUTS` inputs of one format.
"""

import signal
import sys
from pathlib import Path

import numpy as np
from bag_samples import cloud as sample_message
from foreign_files import CASES

from gp_ground_seg.core.errors import DataError, GroundSegError, PointCloudError
from gp_ground_seg.data import cloud_files
from gp_ground_seg.data.bags import decode_cloud, encode_cloud
from gp_ground_seg.data.cloud_files import decode_file, encode_file
from gp_ground_seg.data.clouds import Cloud, scatter
from gp_ground_seg.data.point_cloud2 import read_fields, read_xyz, select_points

N_INPUTS = 6000
SECONDS = 10
"""Longest time of one input [s]."""
OURS = (
    'AttributeError', 'NameError', 'AssertionError', 'TypeError', 'Warning', 'IndexError',
    'KeyError', 'RecursionError', 'MemoryError', 'OverflowError', 'UnboundLocalError',
)  # fmt: skip
MOST_KEPT = 400  # inputs of a case from which others are made
READERS = str(Path(cloud_files.__file__).parent)
WORDS = [
    b'FIELDS x y z\n', b'SIZE 8 8 8\n', b'TYPE U U U\n', b'COUNT 3 1 1\n', b'COUNT 0 1 1\n',
    b'WIDTH 0\n', b'HEIGHT 2\n', b'POINTS 4294967296\n', b'DATA binary\n', b'DATA ascii\n',
    b'DATA binary_compressed\n', b'property list uchar int a\n', b'property double x\n',
    b'property float16 h\n', b'element face 3\n', b'element vertex 0\n', b'comment \xff\n',
    b'format ascii 1.0\n', b'format binary_big_endian 1.0\n', b'nan', b'-inf', b'1e999', b'1_0',
    b"'descr': [('x', '<f4', (2,))]", b"('x', 'O')", b"'shape': (99999999999,)", b'-1', b' ',
    b'0x10', b'\r', b'\0', b'999999999999999999999', b'_', b'x', b'X', b'\xc3\xa9',
]  # fmt: skip
NUMBERS = [b'\0', b'\xff', b'\x7f', b'\x80', b'\0\0\0\x80', b'\xff' * 4, b'\xff\xff\xff\x7f']


def samples_of_readers():
    """Good and odd inputs by their format."""
    found = {suffix: [] for suffix in ('.pcd', '.ply', '.npy', '.npz')}
    for name, (data, _) in CASES.items():
        if isinstance(data, bytes) and Path(name).suffix in found:
            found[Path(name).suffix].append(data)
    points = np.zeros(5, [('x', 'f4'), ('y', 'f8'), ('z', '>f4'), ('n', 'u2', (2,)), ('b', '?')])
    for suffix, seeds in found.items():
        seeds.append(encode_file(Path(f'a{suffix}'), Cloud(points, np.zeros((5, 3))), {}))
    messages = [sample_message(0, n_ground=5, n_wall=2), sample_message(1, n_ground=0, n_wall=0)]
    return {**found, 'PointCloud2': [bytes(encode_cloud(message)) for message in messages]}


def mutant(rng, seeds, words=WORDS):
    """Change an input in some places, or put the halves of two together."""
    data = bytearray(seeds[rng.integers(len(seeds))])
    for _ in range(rng.integers(1, 5)):
        kind = rng.integers(7)
        at, size = int(rng.integers(len(data) + 1)), int(rng.choice([1, 4, 30, 500]))
        if kind == 0:
            del data[at : at + size]
        elif kind == 5:
            data[at:at] = data[at : at + size]
        elif kind == 6:
            data[at : at + size] = rng.bytes(len(data[at : at + size]))
        elif kind == 1:
            data[at:at] = words[rng.integers(len(words))]
        elif kind == 2:
            number = NUMBERS[rng.integers(len(NUMBERS))]
            data[at : at + len(number)] = number
        elif kind == 3 and data:
            data[at % len(data)] ^= 1 << rng.integers(8)
        else:
            other = seeds[rng.integers(len(seeds))]
            data = data[:at] + other[int(rng.integers(len(other) + 1)) :]
    return bytes(data)


def same(first, second):
    """Whether two structured arrays have equal values, NaN for NaN, whatever their types."""
    columns = scatter(first), scatter(second)
    pairs = zip(*(found.values() for found in columns), strict=True)
    return [*columns[0]] == [*columns[1]] and all(
        one.shape == two.shape and np.array_equal(one, two, equal_nan=one.dtype.kind in 'fc')
        for one, two in pairs
    )


def read_cloud_file(suffix, data):
    """Read, write and read again; return what is wrong, or None."""
    path = Path(f'a{suffix}')
    cloud = decode_file(path, data)
    n = len(cloud.fields)
    if cloud.xyz.shape != (n, 3) or cloud.xyz.dtype not in ('f4', 'f8'):
        return f'{cloud.xyz.shape} of {n} points, {cloud.xyz.dtype}'
    label = np.arange(n, dtype='u1')
    try:
        again = decode_file(path, encode_file(path, cloud, {'label': label}))
    except DataError as error:
        return None if 'has no type' in str(error) else f'written, and not read: {error}'
    joined = cloud.join({'label': label})
    names = again.fields.dtype.names
    is_kept = len(names) >= len(joined.fields.dtype.names)
    if not (is_kept and np.array_equal(again.xyz, cloud.xyz, equal_nan=True)):
        return f'written, and another cloud: {names}, before {joined.fields.dtype.names}'
    if suffix in ('.npy', '.npz') and not same(again.fields, joined.fields):
        return 'written, and other values'
    return None


def read_message(data):
    """Read a message and select from it; return what is wrong, or None."""
    cloud = decode_cloud(data)
    xyz = read_xyz(cloud)
    fields = read_fields(cloud)
    if len(xyz) != len(fields) or len(xyz) != cloud.height * cloud.width:
        return f'{len(xyz)} points, {len(fields)} fields'
    kept = select_points(cloud, np.ones(len(xyz), dtype=bool))
    again = decode_cloud(encode_cloud(kept))
    return None if same(read_fields(again), fields) else 'selected, and other values'


def run_input(name, data, lines):
    """Read one input, add the lines that it reaches; return what is wrong, or None."""

    def trace(frame, event, _argument):
        if not frame.f_code.co_filename.startswith(READERS):
            return None
        lines.add((frame.f_code.co_filename, frame.f_lineno, event))
        return trace

    signal.alarm(SECONDS)
    sys.settrace(trace)
    try:
        return read_message(data) if name == 'PointCloud2' else read_cloud_file(name, data)
    except GroundSegError as error:
        said = str(error)
        is_ours = name in ('.pcd', '.ply', 'PointCloud2') and any(word in said for word in OURS)
        if is_ours or len(said) > 800 or not isinstance(error, DataError | PointCloudError):
            return f'said {said[:300]!r}'
    except BaseException as error:
        return f'{type(error).__name__}: {" ".join(str(error).split())[:200]}'
    finally:
        sys.settrace(None)
        signal.alarm(0)
    return None


def fuzz(number, seeds_of):
    """Return what is wrong with one of the inputs of a case, or None."""

    def on_alarm(*_):
        raise TimeoutError(f'no end within {SECONDS} s')

    signal.signal(signal.SIGALRM, on_alarm)
    rng = np.random.default_rng([48, number])
    name = list(seeds_of)[number % len(seeds_of)]
    seeds, known = list(seeds_of[name]), set()
    for k in range(len(seeds) + N_INPUTS):
        data = seeds[k] if k < len(seeds_of[name]) else mutant(rng, seeds)
        lines = set()
        if wrong := run_input(name, data, lines):
            Path('build').mkdir(exist_ok=True)
            Path(f'build/fuzz-{number}{name}').write_bytes(data)
            return f'{name}, input {k} (build/fuzz-{number}{name}): {wrong}'
        if lines - known and len(seeds) < MOST_KEPT:
            seeds.append(data)
        known |= lines
    return None
