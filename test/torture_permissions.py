"""Every command on files and folders of another user, who gives no permission.

A command ends with one line, exit code 2 and nothing written. Root makes them those of the user
65534 and does without its privilege over files; anyone else takes the permissions from their own.
`python test/torture_permissions.py FIRST STOP` runs the cases of a range.
"""

import contextlib
import ctypes
import io
import os
import shutil
import tempfile
from pathlib import Path

import numpy as np
from bag_samples import scan, write_ros1_bag, write_ros2_bag
from torture_cases import run_cases

from gp_ground_seg.cli import main as cli

NOBODY = 65534
READERS = [
    'segment IN/scan.bin -o out.label',
    'segment IN -o out',
    'segment IN/root -o out',
    'segment IN/drive.mcap -o out.mcap',
    'segment IN/drive.bag -o out',
    'segment IN/drive -o out',
    'segment IN/drive.db3 -o out.db3',
    'segment good/scan.bin -o out.label --config IN/robot.yaml',
    'segment good/root/sequences/00 -o IN --resume',
    'plot scan IN/scan.bin -o out.png',
    'plot scan good/scan.bin --labels IN/scan.label -o out.png',
    'plot segment IN/drive.mcap --azimuth 0 -o out.svg',
    'tune IN/drive.mcap -o out.yaml',
    'evaluate IN/root --json out.json',
    'evaluate good/root --config IN/robot.yaml --against default',
    'evaluate good/root --against IN/robot.yaml',
    'bench IN/root --json out.json',
    'bench --from IN/record.json',
    'experiment steps IN/root --json out.json',
    'kitti-to-bag IN/root --sequence 00 out.mcap',
    'play IN/drive.mcap',
    'demo --kitti IN/root --output out',
    'config check IN/robot.yaml',
    'config diff IN/robot.yaml default',
    'config dump --config IN/robot.yaml',
]
"""Commands that read IN."""
WRITERS = [
    'segment good/scan.bin -o IN/out.label',
    'segment good/root/sequences/00 -o IN/out',
    'segment good/root -o IN/out',
    'segment good/root/sequences/00 -o IN/out --workers 1',
    'segment good/drive.mcap -o IN/out.mcap',
    'segment good/drive.mcap -o IN/out.db3',
    'segment good/drive.bag -o IN/out',
    'plot scan good/scan.bin -o IN/out.png',
    'evaluate good/root --json IN/out.json',
    'bench good/root --json IN/out.json',
    'experiment steps good/root --json IN/out.json',
    'kitti-to-bag good/root --sequence 00 IN/out.mcap',
    'kitti-to-bag good/root --sequence 00 IN/out',
    'demo --output IN/out',
]
"""Commands that write below IN."""
CASES = [
    *((words, place) for place in ('files', 'unlisted', 'closed') for words in READERS),
    *((words, place) for place in ('closed', 'unwritable') for words in WRITERS),
]


def make_world(folder):
    """Lay out good/ and copies of it without permissions."""
    good = folder / 'good'
    sequence = good / 'root' / 'sequences' / '00'
    (sequence / 'velodyne').mkdir(parents=True)
    (sequence / 'labels').mkdir()
    points = scan(n_ground=6000)
    labels = np.full(len(points), 40, '<u4')
    for path in (good / 'scan.bin', sequence / 'velodyne' / '000000.bin'):
        points.tofile(path)
    for path in (good / 'scan.label', sequence / 'labels' / '000000.label'):
        labels.tofile(path)
    (good / 'robot.yaml').write_text('sensor: {height: 1.7}\n')
    (good / 'record.json').write_text('{}')
    (good / 'manifest.jsonl').write_text('')
    write_ros2_bag(good / 'drive.mcap')
    write_ros2_bag(good / 'drive.db3')
    write_ros1_bag(good / 'drive.bag')
    write_ros2_bag(good / 'drive')
    for place in ('files', 'unlisted', 'closed', 'unwritable'):
        shutil.copytree(good, folder / place)
    for path in (folder / 'files').rglob('*'):
        path.chmod(0o755 if path.is_dir() else 0o000)
    # Their names can be read, they cannot.
    (folder / 'unlisted').chmod(0o644)
    (folder / 'closed').chmod(0o000)
    (folder / 'unwritable').chmod(0o555)
    if os.geteuid() == 0:
        for path in [*folder.glob('[cu]*'), *(folder / 'files').rglob('*')]:
            os.chown(path, NOBODY, NOBODY)


@contextlib.contextmanager
def as_other_user():
    """Take the capabilities from this thread, within the block, by which root reads all files."""
    version, overrides = 0x20080522, 1 << 1 | 1 << 2  # linux/capability.h: DAC_*
    header = (ctypes.c_uint32 * 2)(version, 0)
    before, without = (ctypes.c_uint32 * 6)(), (ctypes.c_uint32 * 6)()
    libc = ctypes.CDLL(None, use_errno=True)
    assert libc.capget(header, before) == 0
    without[:] = before
    without[0] &= ~overrides  # of those in effect
    assert libc.capset(header, without) == 0, os.strerror(ctypes.get_errno())
    try:
        yield
    finally:
        assert libc.capset(header, before) == 0


def answer(words):
    """Exit code, stdout and stderr of a command in this process; None for what it raises."""
    said, errors = io.StringIO(), io.StringIO()
    try:
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(errors):
            code = cli.main([str(word) for word in words])
    except SystemExit as stop:
        code = stop.code
    return code, said.getvalue(), errors.getvalue()


def run_case(number, folder):
    """Return what is wrong with the answer of one command, or None."""
    words, place = CASES[number % len(CASES)]
    words = words.replace('IN', place)
    before = sorted(folder.rglob('*'))
    with as_other_user():
        code, _, errors = answer(words.split())
    lines = [line for line in errors.splitlines() if ': note: ' not in line]
    if code != 2 or len(lines) != 1 or place not in lines[0]:
        return f'{words}: exit code {code}, {errors!r}'
    left = [str(path) for path in folder.rglob('*') if path not in before]
    # A root is written block by block, below its record.
    if left and left != [str(folder / 'out'), str(folder / 'out' / 'manifest.jsonl')]:
        return f'{words}: left {left}'
    shutil.rmtree(folder / 'out', ignore_errors=True)
    return None


@contextlib.contextmanager
def world():
    """Yield a folder of files and folders with and without permissions, as working folder."""
    before = Path.cwd()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        folder.chmod(0o755)
        make_world(folder)
        os.chdir(folder)
        try:
            yield folder
        finally:
            os.chdir(before)
            for name in ('unlisted', 'closed', 'unwritable'):
                (folder / name).chmod(0o755)


if __name__ == '__main__':
    with world() as place:
        run_cases(lambda number: run_case(number, place))
