"""Each call that writes fails in turn, as SQLite tests itself: nothing is lost, nothing is half.

A first run of a command counts its calls that make, open, flush or rename below the folder of the
test. It is run again for each of them, which fails, and for files of several sizes, where the
kernel takes a part of what is written, and then no more.
"""

import contextlib
import errno
import json
import os
import re
import resource
from functools import cache, partial

import numpy as np
import pytest
from bag_samples import read_messages, scan, write_ros2_bag
from cli_runner import limited, run
from evaluation_samples import write_streets

from gp_ground_seg import Config
from gp_ground_seg.core.errors import DataError
from gp_ground_seg.data import files
from gp_ground_seg.data.bags import new_bag

# What is written counts, not what is computed.
QUICK = ('runtime.backend=numpy', 'learning.mode=fixed', 'grid.n_segments=36', 'grid.n_bins=30')
MINE = b'by hand'
WRITES = os.O_CREAT | os.O_WRONLY | os.O_RDWR
REASON = 'No space left|Input/output error|File too large|disk'


@contextlib.contextmanager
def failing_call(folder, fails_at=-1):
    """List the calls below a folder, one of which fails: the disk is full, or has an error."""
    calls = []

    def wrapped(name, real):
        def call(path, *args, **kwargs):
            place = os.readlink(f'/proc/self/fd/{path}') if isinstance(path, int) else str(path)
            if place.startswith(str(folder)) and (name != 'open' or args[0] & WRITES):
                calls.append(f'{name} {place}')
                if len(calls) - 1 == fails_at:
                    code = errno.EIO if name == 'fsync' else errno.ENOSPC
                    # The kernel knows no name where it has a number.
                    more = () if isinstance(path, int) else (str(path),)
                    raise OSError(code, os.strerror(code), *more)
            return real(path, *args, **kwargs)

        return call

    with pytest.MonkeyPatch.context() as patch:
        for name in ('open', 'mkdir', 'rename', 'replace', 'fsync'):
            patch.setattr(os, name, wrapped(name, getattr(os, name)))
        yield calls


def content(folder):
    """What a reader finds in a folder: the bytes of files, the messages of bags."""
    found = {}
    for path in sorted(folder.rglob('*')):
        name = str(path.relative_to(folder))
        if path.is_dir():
            found[name] = 'folder'
        elif path.read_bytes() == MINE:
            found[name] = MINE
        elif path.suffix in ('.mcap', '.db3'):
            found[name] = read_messages(path)
        elif path.suffix == '.json':  # has times
            found[name] = sorted(json.loads(path.read_bytes()))
        elif path.name != 'metadata.yaml':
            found[name] = path.read_bytes()
    return found


@pytest.fixture(scope='module')
def inputs(tmp_path_factory):
    folder = tmp_path_factory.mktemp('inputs')
    (folder / 'scans').mkdir()
    for k in range(2):
        scan(k, 300, 60).tofile(folder / f'scans/{k}.bin')
    np.save(folder / 'a.npy', scan(0, 300, 60))
    write_streets(folder / 'root', s00=1)
    write_ros2_bag(folder / 'drive.mcap', n_clouds=2, n_ground=300, n_wall=60)
    return folder


COMMANDS = {
    'a file': 'segment scans/0.bin -o {}/out.label',
    'a folder': 'segment scans -o {}/out',
    'a root': 'segment root -o {}/out',
    'a cloud': 'segment a.npy -o {}/out.npz',
    'a bag': 'segment drive.mcap -o {}/out.mcap',
    'an sqlite bag': 'segment drive.mcap -o {}/out.db3',
    'a folder of a bag': 'segment drive.mcap -o {}/out',
    'clouds of a bag': 'segment drive.mcap --format ply -o {}/out',
    'KITTI': 'kitti-to-bag root --sequence 00 {}/out.mcap',
    'scores': 'evaluate root --cut 0 --json {}/out.json',
    'a picture': 'plot scan scans/0.bin -o {}/out.png',
}


def words_of(line, folder, *more):
    """Words of a command that writes into a folder."""
    words = line.format(folder).split()
    settings = [word for setting in QUICK for word in ('--set', setting)]
    return [*words, *more, *(settings if words[0] != 'kitti-to-bag' else [])]


@pytest.fixture
def at_inputs(inputs, monkeypatch):
    monkeypatch.chdir(inputs)
    # The same text each time, which takes longer than all else.
    monkeypatch.setattr(Config, 'to_yaml', cache(Config.to_yaml))


@pytest.mark.usefixtures('at_inputs')
@pytest.mark.parametrize('name', COMMANDS)
def test_each_call_that_writes_fails_in_turn(name, tmp_path, capsys):
    line, whole = COMMANDS[name], tmp_path / 'whole'
    whole.mkdir()
    with failing_call(whole) as calls:
        assert run(*words_of(line, whole)) == 0
    # What is on disk gets its name, and then its folder is: no hole by a power failure. Bags
    # rename their files first, below a name that is hidden.
    order = ''.join(call[0] for call in calls if call[0] in 'fr')
    assert re.fullmatch('r*(f+rf+)+', order)
    expected = content(whole)
    size = max(path.stat().st_size for path in whole.rglob('*'))
    faults = [(call, failing_call, k) for k, call in enumerate(calls)]
    small = partial(limited, resource.RLIMIT_FSIZE)
    faults += [('write', small, size * k // 4) for k in range(4)]
    for n, (call, fault, k) in enumerate(faults):
        folder, where = tmp_path / f'{n}', f'{call} {k}'
        folder.mkdir()
        # Of what is to be one file another one may be there.
        (name,) = expected if n % 2 and len(expected) == 1 else ['mine']
        before = {'mine': MINE, name: MINE}
        for path in before:
            (folder / path).write_bytes(MINE)
        words = words_of(line, folder, *['--force'] * (name != 'mine'))
        capsys.readouterr()
        with fault(folder, k) if fault is failing_call else fault(k):
            code = run(*words)
        said = [text for text in capsys.readouterr().err.splitlines() if ': note: ' not in text]
        assert len(said) == code / 2 and (code == 2 or fault is failing_call), (where, said)
        for text in said:
            assert str(folder) in text and '.partial-' not in text, where
            assert re.search(REASON, text), where
        found = content(folder)
        assert found['mine'] == MINE and {*before} <= {*found}, where
        assert all(found[path] in (expected.get(path), before.get(path)) for path in found), where
        if found != before:  # else it is as the first run
            # The same command, with `--force` where it has said that its output is there.
            target = folder / line.split('{}/')[1]
            is_there = target.is_file() or (target / 'metadata.yaml').exists()
            assert run(*words_of(line, folder, *['--force'] * is_there)) == 0, where
            assert content(folder) == {**expected, 'mine': MINE}, where


def test_the_next_run_removes_what_a_killed_one_left_of_its_target(tmp_path):
    """Of a run that is still going nothing is removed."""
    target = tmp_path / 'a [x]'
    for name in ('a [x]', 'a x', 'mine'):
        files.write_file(tmp_path / f'.{name}.partial-1/a', MINE)
    with files.staged_file(target, force=True) as first:
        first.write_bytes(b'1')
        with files.staged_file(target, force=True) as second:
            second.write_bytes(b'2')
        assert (target.read_bytes(), first.read_bytes()) == (b'2', b'1')
    assert target.read_bytes() == b'1'
    names = {'.a x.partial-1', '.mine.partial-1', 'a [x]'}
    assert {path.name for path in tmp_path.iterdir()} == names
    # It was killed while it replaced a bag.
    (tmp_path / '.drive.partial-1').mkdir()
    before = write_ros2_bag(tmp_path / '.drive.partial-1/replaced')
    with pytest.raises(DataError, match='drive: exists already'):
        new_bag(tmp_path / 'drive', {}).__enter__()
    assert read_messages(tmp_path / 'drive') == before
    assert {path.name for path in tmp_path.iterdir()} == names | {'drive'}
