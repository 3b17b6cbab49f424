"""Small files that become gigabytes: refused in one line before they take the memory.

Peak memory of a command is at most 2 GB, or ten times the file if that is more.
`python test/torture_bombs.py FIRST STOP` runs the cases of a range.
"""

import bz2
import io
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path

import numpy as np
from bag_samples import START, cloud
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Ros2Writer
from rosbags.rosbag2.storage_mcap import zstd
from rosbags.typesys import Stores, get_typestore
from torture_cases import run_cases

from gp_ground_seg.data.bag_files import POINT_CLOUD2
from gp_ground_seg.data.files import MAX_POINTS
from gp_ground_seg.data.point_cloud2 import encode_cloud

MOST = 2_000_000_000
PIECE, N_PIECES = bytes(1 << 27), 24  # 3.2 GB


def pack_bz2():
    return bz2.compress(PIECE) * N_PIECES


def pack_zstd():
    return zstd.compress(PIECE) * N_PIECES


def pack_lz4():
    import lz4.frame

    packer = lz4.frame.LZ4FrameCompressor()
    parts = [packer.begin(), *(packer.compress(PIECE) for _ in range(N_PIECES)), packer.flush()]
    return b''.join(parts)


def npy_header(shape, dtype='<f4'):
    file = io.BytesIO()
    layout = {'descr': dtype, 'fortran_order': False, 'shape': shape}
    np.lib.format.write_array_header_1_0(file, layout)
    return file.getvalue()


def write_npz(path, shape, dtype, n_bytes, names='xyz'):
    """Arrays of zeros, packed piece by piece."""
    with zipfile.ZipFile(path, 'w', zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name in names:
            with archive.open(f'{name}.npy', 'w', force_zip64=True) as file:
                file.write(npy_header(shape, dtype))
                for start in range(0, n_bytes, len(PIECE)):
                    file.write(PIECE[: n_bytes - start])


def write_pcd(path):
    """Points of zeros, packed by LZF."""
    import lzf

    n_points = (1 << 30) // 12
    packed = lzf.compress(bytes(12 * n_points))
    header = (
        'VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\n'
        f'WIDTH {n_points}\nHEIGHT 1\nPOINTS {n_points}\nDATA binary_compressed\n'
    )
    sizes = np.array([len(packed), 12 * n_points], '<u4').tobytes()
    path.write_bytes(header.encode() + sizes + packed)


def write_wide_pcd(path):
    """No point, of two fields of many numbers."""
    path.write_text(
        'VERSION 0.7\nFIELDS x y z a\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 500000000\n'
        'WIDTH 0\nHEIGHT 1\nPOINTS 0\nDATA binary\n'
    )


def write_ros1_chunk(path, form, packed):
    """A chunk of 3.2 GB."""
    types = get_typestore(Stores.ROS1_NOETIC)
    bag = Ros1Writer(path)
    bag.set_compression(Ros1Writer.CompressionFormat[form.upper()])
    bag.compressor = lambda _: packed
    with bag:
        connection = bag.add_connection('/points', POINT_CLOUD2, typestore=types)
        bag.write(connection, START, bytes(100))


def write_mcap(path, messages, form='zstd', packed=None, **changes):
    """Messages in chunks of their own, packed, or in place of each a chunk of 3.2 GB."""
    folder = path.with_suffix('')
    bag = Ros2Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP)
    bag.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    with bag:
        bag.storage.compression = form
        if packed:
            bag.storage.compressor = lambda _: packed
        types = get_typestore(Stores.ROS2_JAZZY)
        connection = bag.add_connection('/points', POINT_CLOUD2, typestore=types)
        for raw in messages:
            bag.write(connection, START, raw)
    (folder / f'{folder.name}.mcap').rename(path)


def write_overlapping(path):
    """Chunks of the same time, each accepted by itself."""
    write_mcap(path, [bytes(100 << 20)] * 24)


def write_dense_cloud(path):
    """A cloud whose coordinates share four bytes."""
    points = cloud()
    for field in points.fields:
        field.offset = 0
    points.data, points.point_step = np.zeros(120_000_000, np.uint8), 4
    points.width, points.row_step = 30_000_000, 120_000_000
    write_mcap(path, [encode_cloud(points)])


def write_most(path):
    """The largest cloud that is accepted."""
    points = cloud()
    points.width, points.point_step, points.row_step = MAX_POINTS, 30, 30 * MAX_POINTS
    points.data = np.zeros(30 * MAX_POINTS, np.uint8)
    write_mcap(path, [encode_cloud(points)])


def write_wide_cloud(path):
    """A cloud of no point, of a field of many numbers."""
    points = cloud()
    points.fields[3].count = 400_000_000
    points.data, points.width, points.row_step = np.zeros(0, np.uint8), 0, 0
    write_mcap(path, [encode_cloud(points)])


def write_packed_messages(path):
    """A folder whose messages are packed one by one."""
    bag = Ros2Writer(path, version=9, storage_plugin=StoragePlugin.MCAP)
    types = get_typestore(Stores.ROS2_JAZZY)
    with bag:
        connection = bag.add_connection('/points', POINT_CLOUD2, typestore=types)
        bag.write(connection, START, pack_zstd())
    text = (path / 'metadata.yaml').read_text()
    text = text.replace("compression_format: ''", 'compression_format: zstd')
    text = text.replace("compression_mode: ''", 'compression_mode: message')
    assert 'mode: message' in text
    (path / 'metadata.yaml').write_text(text)


MAKERS = {
    'columns.npy': lambda path: path.write_bytes(npy_header((0, 10**12))),
    'columns.npz': lambda path: write_npz(path, (0, 10**9), '<f4', 0, ['points']),
    'int8.npz': lambda path: write_npz(path, (3 * 10**8,), '|i1', 3 * 10**8),
    'small_int8.npz': lambda path: write_npz(path, (4 * 10**7,), '|i1', 4 * 10**7),
    'double.npz': lambda path: write_npz(path, (10**8, 3), '<f8', 24 * 10**8, ['points']),
    'lie.npz': lambda path: write_npz(path, (10**12,), '<f4', 10**6),
    'packed.pcd': write_pcd,
    'wide.pcd': write_wide_pcd,
    'bz2.bag': lambda path: write_ros1_chunk(path, 'bz2', pack_bz2()),
    'lz4.bag': lambda path: write_ros1_chunk(path, 'lz4', pack_lz4()),
    'lz4.mcap': lambda path: write_mcap(path, [bytes(100)], 'lz4', pack_lz4()),
    'zstd.mcap': lambda path: write_mcap(path, [bytes(100)], 'zstd', pack_zstd()),
    'overlapping.mcap': write_overlapping,
    'dense.mcap': write_dense_cloud,
    'most.mcap': write_most,
    'wide.mcap': write_wide_cloud,
    'messages': write_packed_messages,
}
"""What makes a file of each name."""
COMMANDS = [
    'segment FILE -o out --force',
    'segment FILE --format ply -o out --force',
    'plot scan FILE -o out.png --force',
    'evaluate FILE --against paper --force',
]

# The peak in getrusage is at least that of the process that starts this one.
PROGRAM = """
import sys
from gp_ground_seg.cli.main import main
code = main(sys.argv[1:])
print([line.split()[1] for line in open('/proc/self/status') if line.startswith('VmHWM')][0])
sys.exit(code)
"""


def run_measured(words, cwd):
    """Exit code, standard error and peak memory [bytes] of a command."""
    program = [sys.executable, '-c', PROGRAM, *words]
    done = subprocess.run(program, cwd=cwd, capture_output=True, text=True, check=False)
    return done.returncode, done.stderr, 1024 * int(done.stdout.split()[-1])


def run_case(number, folder):
    """Return what is wrong with the answer to one bomb, or None."""
    name = list(MAKERS)[number % len(MAKERS)]
    words = COMMANDS[number // len(MAKERS) % len(COMMANDS)].replace('FILE', name)
    path = folder / name
    if not path.exists():
        MAKERS[name](path)
    files = path.iterdir() if path.is_dir() else [path]
    size = sum(file.stat().st_size for file in files)
    code, errors, peak = run_measured(words.split(), folder)
    lines = [line for line in errors.splitlines() if ': note: ' not in line]
    if peak > max(MOST, 10 * size):
        return f'{words}: {peak / 1e6:.0f} MB for a file of {size} bytes: {lines}'
    if name == 'most.mcap' and code == 0:
        return None
    if code != 2 or len(lines) != 1 or name not in lines[0]:
        return f'{words}: exit code {code}: {errors[-300:]!r}'
    return None


if __name__ == '__main__':
    with tempfile.TemporaryDirectory() as temporary:
        run_cases(lambda number: run_case(number, Path(temporary)))
