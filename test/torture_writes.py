"""Commands that write, killed, interrupted or out of disk at a random moment.

What lies under the name of the output is then nothing, what was there before, or the whole new
output, of a folder of labels each file: `python test/torture_writes.py FIRST STOP`.
"""

import os
import resource
import shutil
import signal
import subprocess
import tempfile
from functools import partial
from pathlib import Path

import numpy as np
from bag_samples import scan, write_ros2_bag
from cli_runner import start
from torture_cases import run_cases

from gp_ground_seg.data.bags import BagReader

HOWS = [signal.SIGKILL, signal.SIGKILL, signal.SIGTERM, signal.SIGINT, signal.SIGHUP, 'full disk']
COMMANDS = {
    'out.mcap': ['segment', '--quiet', 'long.mcap', '-o'],
    'out.db3': ['segment', '--quiet', 'long.mcap', '-o'],
    'out_bag': ['segment', '--quiet', 'long.mcap', '-o'],
    'labels': ['segment', '--quiet', 'root/sequences/00/velodyne', '-o'],
    'kitti.mcap': ['kitti-to-bag', '--quiet', 'root', '--sequence', '00'],
    'kitti_bag': ['kitti-to-bag', '--quiet', 'root', '--sequence', '00'],
    'scan.png': ['plot', 'scan', 'root/sequences/00/velodyne/000000.bin', '-o'],
}
SECONDS = 4.0
"""Most of a command's time from its start to the signal."""


def make_inputs(folder):
    """Inputs that take a second or two."""
    scans = folder / 'root' / 'sequences' / '00' / 'velodyne'
    scans.mkdir(parents=True)
    for k in range(60):
        scan(k, 20_000, 4000).tofile(scans / f'{k:06d}.bin')
    write_ros2_bag(folder / 'long.mcap', 60, n_ground=20_000, n_wall=4000)


def content(path):
    """What a reader finds under a name; None for nothing."""
    if not path.exists():
        return None
    if path.suffix in ('.mcap', '.db3') or (path / 'metadata.yaml').exists():
        with BagReader(path) as bag:
            return list(bag.messages())
    if path.is_dir():
        return {file.name: file.read_bytes() for file in sorted(path.iterdir())}
    return path.read_bytes()


def is_old_or_new(found, old, new):
    """Whether output is whole; of labels each file, which appear one by one."""
    if not isinstance(new, dict):
        return found in (old, new)
    labels = {name: data for name, data in found.items() if name.endswith('.label')}
    return all(data in ((old or {}).get(name), new[name]) for name, data in labels.items())


def finish(folder, name, *words, timeout=None, number=None, **options):
    """Exit code and stderr of the command that writes `name`, with a signal after a time."""
    process = start(*COMMANDS[name], name, *words, cwd=folder, **options)
    try:
        _, said = process.communicate(timeout=timeout)
    except subprocess.TimeoutExpired:
        process.send_signal(number)
        _, said = process.communicate(timeout=60.0)
    return process.returncode, said


def run_case(number, folder, whole):
    """Return what is wrong after one command was stopped, or None."""
    rng = np.random.default_rng([5, number])
    name, how = list(COMMANDS)[number % len(COMMANDS)], HOWS[rng.integers(len(HOWS))]
    out = folder / name
    before = None
    words = ['--force'] if rng.random() < 0.5 else []
    if words:
        shutil.copytree(whole / name, out) if (whole / name).is_dir() else shutil.copy(
            whole / name, out
        )
        before = content(out)
    if how == 'full disk':
        size = int(10.0 ** rng.uniform(0.0, 6.0))
        limit = partial(resource.setrlimit, resource.RLIMIT_FSIZE, (size, size))
        options = {'preexec_fn': limit, 'env': {**os.environ, 'NUMBA_DISABLE_JIT': '0'}}
        expected = {0, 2}
    else:
        options = {'timeout': rng.uniform(0.0, SECONDS), 'number': how}
        expected = {0, -how, 130 if how == signal.SIGINT else 128 + how}
    what = f'{name}, {how}, {words}'
    try:
        status, said = finish(folder, name, *words, **options)
        if status not in expected:
            return f'{what}: exit code {status}: {said[-300:]!r}'
        if 'Traceback' in said and 'cli/main.py' in said:
            return f'{what}: {said[-300:]!r}'
        try:
            found = content(out)
        except Exception as error:
            return f'{what}: what was left is not readable: {error}'
        if status == 0 and found is None:
            return f'{what}: exit code 0, and nothing was written'
        if found is not None and not is_old_or_new(found, before, content(whole / name)):
            return f'{what}: what was left is neither old nor new'
        if words and found is None:
            return f'{what}: what was there before is gone'
        left = [path.name for path in folder.iterdir() if '.partial-' in path.name]
        if left and how in (signal.SIGINT, 'full disk'):
            return f'{what}: left {left}'
        return None
    finally:
        for path in [out, *folder.glob('.*.partial-*')]:
            shutil.rmtree(path, ignore_errors=True)
            path.unlink(missing_ok=True)


if __name__ == '__main__':
    with tempfile.TemporaryDirectory() as folder_name:
        world = Path(folder_name)
        make_inputs(world)
        for target in COMMANDS:
            code, errors = finish(world, target)
            assert code == 0, errors
        (world / 'whole').mkdir()
        for target in COMMANDS:
            (world / target).rename(world / 'whole' / target)
        run_cases(lambda number: run_case(number, world, world / 'whole'))
