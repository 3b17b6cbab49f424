"""Damaged files of every kind that is read, through the commands that read them.

A command answers a damaged file with a result, or with one line, exit code 2 and nothing written.
`python test/torture_files.py FIRST STOP` runs the cases of a range.
"""

import contextlib
import io
import shutil
import tempfile
import time
from pathlib import Path

import numpy as np
from bag_samples import scan, write_ros1_bag, write_ros2_bag
from torture_cases import answer, run_cases

from gp_ground_seg.cli import main as cli
from gp_ground_seg.data.cloud_files import WRITABLE, encode_file
from gp_ground_seg.data.clouds import cloud_of, name_columns

SLOWEST = 30.0
"""Time that a command may take [s]."""
YAML_PIECES = [b'1' * 5000, *rb"""
*a
&a [*a, *a]
1e999
.nan
-.inf
0x7f
2011-99-99
!!python/name:os
~
[1, 2]
{a: b}
true
"\ud800"
-
?
grid:
r_max: 1
""".split(b'\n'), b'\t', b'\x00', b'\xff', b'\n']  # fmt: skip


def damage(data, rng, is_text):
    """Return the bytes changed in one to three places."""
    data = bytearray(data)
    for _ in range(rng.integers(1, 4)):
        at, size = int(rng.integers(len(data) + 1)), int(rng.choice([1, 4, 30, 500]))
        kind = rng.integers(6)
        if kind == 0:
            data[at : at + size] = rng.bytes(len(data[at : at + size]))
        elif kind == 1:
            del data[at:]
        elif kind == 2:
            del data[at : at + size]
        elif kind == 3:
            data[at:at] = data[at : at + size]
        elif kind == 4:
            data[at : at + size] = bytes(len(data[at : at + size]))
        elif is_text:
            data[at:at] = YAML_PIECES[rng.integers(len(YAML_PIECES))]
        else:
            data[at : at + 4] = rng.choice(
                [b'\xff\xff\xff\xff', b'\xff\xff\xff\x7f', b'\0\0\0\x80']
            )
    return bytes(data)


def make_samples(folder):
    """Valid files: name -> (path of what is damaged, words of the command)."""
    points = scan()
    points.tofile(folder / 'scan.bin')
    root = folder / 'root' / 'sequences' / '00'
    (root / 'velodyne').mkdir(parents=True)
    (root / 'labels').mkdir()
    points.tofile(root / 'velodyne' / '000000.bin')
    np.full(len(points), 40, '<u4').tofile(root / 'labels' / '000000.label')
    with contextlib.redirect_stdout(io.StringIO()) as text:
        assert cli.main(['config', 'dump']) == 0
    (folder / 'robot.yaml').write_text(text.getvalue())
    write_ros2_bag(folder / 'drive.mcap')
    write_ros2_bag(folder / 'drive.db3')
    write_ros1_bag(folder / 'drive.bag')
    write_ros2_bag(folder / 'drive')
    out = ['-o', folder / 'out.mcap']
    robot = folder / 'robot.yaml'
    samples = {
        'scan': (folder / 'scan.bin', ['segment', folder / 'scan.bin']),
        'scan of a root': (root / 'velodyne' / '000000.bin', ['evaluate', folder / 'root']),
        'labels': (root / 'labels' / '000000.label', ['evaluate', folder / 'root']),
        'parameters': (robot, ['config', 'check', robot]),
        'parameters used': (robot, ['segment', folder / 'scan.bin', '--config', robot]),
    }
    for name in ('drive.mcap', 'drive.db3', 'drive.bag'):
        samples[name] = (folder / name, ['segment', folder / name, *out])
    cloud = cloud_of(name_columns(points))
    for suffix in WRITABLE:
        path = folder / f'cloud{suffix}'
        path.write_bytes(encode_file(path, cloud, {}))
        samples[path.name] = (path, ['segment', path, '-o', folder / 'out.npz'])
    for path in sorted((folder / 'drive').iterdir()):
        samples[f'drive/{path.name}'] = (path, ['segment', folder / 'drive', *out])
    return samples


def run_case(number, samples, folder):
    """Damage one file, run its command, restore the file; return what is wrong, or None."""
    rng = np.random.default_rng([41, number])
    name = list(samples)[number % len(samples)]
    path, words = samples[name]
    whole = path.read_bytes()
    outputs = [folder / 'out.mcap', folder / 'out.npz']
    try:
        path.write_bytes(damage(whole, rng, path.suffix == '.yaml'))
        started = time.monotonic()
        try:
            code, _, errors = answer(words)
        except BaseException as error:
            return f'{name}: {type(error).__name__}: {" ".join(str(error).split())[:200]}'
        # `config check` prints a line for each problem, other commands one error.
        mark = str(path) if words[1] == 'check' else 'error: '
        n_lines = sum(mark in line for line in errors.splitlines())
        if code not in (0, 2) or (code == 2 and not (n_lines == 1 or words[1] == 'check')):
            return f'{name}: exit code {code}, {errors[-200:]!r}'
        if code == 2 and any(out.exists() for out in outputs):
            return f'{name}: something was written'
        if time.monotonic() - started > SLOWEST:
            return f'{name}: took {time.monotonic() - started:.0f} s'
        left = [p.name for p in folder.iterdir() if 'out' in p.name and p not in outputs]
        return f'{name}: left {left}' if left else None
    finally:
        path.write_bytes(whole)
        for leftover in folder.glob('*out*'):
            if leftover.is_dir():
                shutil.rmtree(leftover)
            else:
                leftover.unlink()


if __name__ == '__main__':
    with tempfile.TemporaryDirectory() as name:
        files = make_samples(Path(name))
        run_cases(lambda number: run_case(number, files, Path(name)))
