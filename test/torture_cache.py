"""Damage of compiled code on disk: it is compiled again, and nothing planted is run.

`python test/torture_cache.py FIRST STOP`.
"""

import os
import shutil
import tempfile
from pathlib import Path

import numpy as np
from test_jit import LOADED, Program, pickle
from torture_cases import run_cases

ANSWER = 42.0


def damage(path, rng, planted):
    """Damage one file in a way drawn at random."""
    content = bytearray(path.read_bytes())
    at = int(rng.integers(len(content) + 1))
    size = int(rng.choice([1, 8, 512, 4096]))
    kind = rng.choice(['flip', 'zero', 'cut', 'insert', 'delete', 'plant', 'empty', 'link', 'dir'])
    if kind == 'flip':
        for where in rng.integers(len(content), size=rng.integers(1, 9)):
            content[where] ^= 1 << int(rng.integers(8))
    elif kind == 'zero':
        content[at : at + size] = bytes(len(content[at : at + size]))
    elif kind == 'cut':
        del content[at:]
    elif kind == 'insert':
        content[at:at] = rng.bytes(size)
    elif kind == 'plant':
        content = planted
    elif kind == 'empty':
        content = b''
    path.unlink()
    if kind == 'link':
        path.symlink_to('/etc/passwd')
    elif kind == 'dir':
        path.mkdir()
    elif kind != 'delete':
        path.write_bytes(content)
    return kind


def run_case(number, folder, program):
    """Return what is wrong after a few files were damaged, or None."""
    rng = np.random.default_rng([3, number])
    kept = folder / 'kept'
    shutil.rmtree(program.cache)
    shutil.copytree(kept, program.cache)
    files = [*program.entries, program.notes]
    chosen = rng.choice(len(files), rng.integers(1, len(files) + 1), replace=False)
    kinds = [damage(files[index], rng, pickle(program)) for index in chosen]
    for run in range(2):
        result = program.run()
        if result[0] != ANSWER:
            return f'{kinds}, run {run}: {result}'
    if result[:4] != LOADED and not {'link', 'dir'} & set(kinds):
        return f'{kinds}: not kept again: {result} {program.stderr[-300:]}'
    if (program.folder / 'ran').exists():
        return f'{kinds}: planted code was run'
    return None


if __name__ == '__main__':
    os.umask(0o022)
    with tempfile.TemporaryDirectory() as name:
        world = Path(name)
        world.chmod(0o755)
        small = Program(world)
        small.run()
        shutil.copytree(small.cache, world / 'kept')
        run_cases(lambda number: run_case(number, world, small))
