"""Each call that writes fails in turn, as SQLite tests itself: nothing is lost, nothing is half.

A first run of a command counts its calls of `open`, `write`, `fsync`, `rename` and `mkdir` below
the folder of the test. It is run again for each of them, which fails: the disk is full, it has an
error, or it takes a part of what is written.
"""

import builtins
import contextlib
import errno
import io
import json
import os
import resource
import subprocess
import sys

import numpy as np
import pytest
from bag_samples import scan, write_ros2_bag
from cli_runner import run
from conftest import REPOSITORY
from evaluation_samples import write_streets

from gp_ground_seg.cli import tune
from gp_ground_seg.core import jit
from gp_ground_seg.core.errors import DataError
from gp_ground_seg.data import files
from gp_ground_seg.data.bags import BagReader, BagWriter

pytestmark = pytest.mark.usefixtures('compiled_code')

FULL, BROKEN, PARTLY = errno.ENOSPC, errno.EIO, None
NUMPY = ['--set', 'runtime.backend=numpy']


class Disk:
    """Counts the calls that write below a folder, and lets one of them fail.

    With `fault` None a write takes half of its bytes, which is no error.
    """

    def __init__(self, folder, fails_at=-1, fault=FULL):
        self.folder, self.fails_at, self.fault = str(folder), fails_at, fault
        self.calls = []

    def call(self, name, path):
        """Count a call; raise its error if it is the one that fails, return whether it is."""
        place = os.readlink(f'/proc/self/fd/{path}') if isinstance(path, int) else str(path)
        if not place.startswith(self.folder):
            return False
        self.calls.append((name, place))
        if len(self.calls) - 1 != self.fails_at:
            return False
        if self.fault is not PARTLY:
            # The kernel knows no name where it has a number.
            more = () if isinstance(path, int) else (str(path),)
            raise OSError(self.fault, os.strerror(self.fault), *more)
        return True

    def wrapped(self, name):
        real = getattr(os, name)

        def call(path, *args, **kwargs):
            if name != 'open' or args[0] & (os.O_CREAT | os.O_WRONLY | os.O_RDWR):
                self.call(name, path)
            return real(path, *args, **kwargs)

        return call

    def open(self, file, mode='r', buffering=-1, encoding=None, *_args, **_options):
        """`io.open` of a file that is written, of Python's classes."""
        disk = self

        class Raw(io.FileIO):
            def write(self, data):
                data = memoryview(data).cast('B')
                partly = disk.call('write', self.fileno())
                return super().write(data[: len(data) // 2] if partly else data)

        raw_mode = mode.replace('b', '').replace('t', '')
        if not isinstance(file, int):
            self.call('open', file)
        raw = Raw(file, raw_mode)
        if buffering == 0:
            return raw
        kind = io.BufferedRandom if '+' in mode else io.BufferedWriter
        return kind(raw) if 'b' in mode else io.TextIOWrapper(kind(raw), encoding=encoding)

    @contextlib.contextmanager
    def at_work(self):
        real = io.open

        def opened(file, mode='r', *args, **options):
            is_written = {*mode} & {*'wax+'} and not options.get('opener')
            return (self.open if is_written else real)(file, mode, *args, **options)

        with pytest.MonkeyPatch.context() as patch:
            for name in ('open', 'mkdir', 'rename', 'replace', 'fsync'):
                patch.setattr(os, name, self.wrapped(name))
            patch.setattr(io, 'open', opened)
            patch.setattr(builtins, 'open', opened)
            yield self


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
            with BagReader(path) as bag:
                found[name] = list(bag.messages())
        elif path.suffix == '.json':  # has times
            found[name] = sorted(json.loads(path.read_bytes()))
        elif path.name != 'metadata.yaml':
            found[name] = path.read_bytes()
    return found


class Page:
    """Writes the file of `tune` once, by its button."""

    def __init__(self, _server, _inputs, config, *_begin):
        self.config = config

    def add_button(self, _title, write):
        self.write = write

    def run(self):
        self.write(self.config)


@pytest.fixture(scope='module')
def inputs(tmp_path_factory):
    folder = tmp_path_factory.mktemp('inputs')
    (folder / 'scans').mkdir()
    for k in range(3):
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
    'a folder of a bag': 'segment drive.mcap -o {}/out',
    'clouds of a bag': 'segment drive.mcap --format ply -o {}/out',
    'KITTI': 'kitti-to-bag root --sequence 00 {}/out.mcap',
    'scores': 'evaluate root --json {}/out.json',
    'a picture': 'plot scan scans/0.bin -o {}/out.png',
    'tuned': 'tune scans/0.bin -o {}/out.yaml',
}


def words_of(line, folder, *more):
    """Words of a command that writes into a folder."""
    words = line.format(folder).split()
    return [*words, *more, *(NUMPY if words[0] != 'kitti-to-bag' else [])]


@pytest.fixture
def at_inputs(inputs, monkeypatch):
    monkeypatch.chdir(inputs)
    monkeypatch.setattr(tune, 'open_server', lambda _port: contextlib.nullcontext((None, '')))
    monkeypatch.setattr(tune, 'Tuner', Page)


MINE = b'by hand'
FAULTS = {'write': (FULL, PARTLY), 'fsync': (BROKEN,)}
"""Of a call; others fail as on a full disk."""


def errors_of(capsys):
    """Lines on standard error that are no notes."""
    lines = capsys.readouterr().err.splitlines()
    return [line for line in lines if ': note: ' not in line]


def assert_begun_again(line, folder, expected, where):
    """The same command, and `--force` where it has said that its output is there, is whole."""
    target = folder / line.split('{}/')[1]
    is_there = target.is_file() or (target / 'metadata.yaml').exists()
    assert run(*words_of(line, folder, *['--force'] * is_there)) == 0, where
    assert content(folder) == {**expected, 'mine': MINE}, where


@pytest.mark.usefixtures('at_inputs')
@pytest.mark.parametrize('name', COMMANDS)
def test_each_call_that_writes_fails_in_turn(name, tmp_path, capsys):
    line, whole = COMMANDS[name], tmp_path / 'whole'
    whole.mkdir()
    with Disk(whole).at_work() as disk:
        assert run(*words_of(line, whole)) == 0
    names, expected = {call for call, _ in disk.calls}, content(whole)
    assert {'write', 'fsync'} <= names and {'replace', 'rename'} & names
    cases = [
        (k, fault) for k, (call, _) in enumerate(disk.calls) for fault in FAULTS.get(call, (FULL,))
    ]
    for n, (k, fault) in enumerate(cases):
        folder = tmp_path / f'{n}'
        folder.mkdir()
        # Of what is to be one file another one may be there.
        (name,) = expected if n % 2 and len(expected) == 1 else ['mine']
        before = {'mine': MINE, name: MINE}
        for path in before:
            (folder / path).write_bytes(MINE)
        more = ['--force'] * (name != 'mine')
        capsys.readouterr()
        with Disk(folder, k, fault).at_work() as disk:
            code = run(*words_of(line, folder, *more))
        where = f'{disk.calls[k]}, {fault}'
        said = errors_of(capsys)
        if code == 0:
            assert said == [], where
        else:
            assert code == 2 and len(said) == 1, (where, said)
            assert str(folder) in said[0] and os.strerror(fault) in said[0], (where, said)
            assert '.partial-' not in said[0]
        found = content(folder)
        assert found['mine'] == MINE and {*before} <= {*found}, where
        assert all(found[path] in (expected.get(path), before.get(path)) for path in found), where
        if found != before:  # else it is as the first run
            assert_begun_again(line, folder, expected, where)


@pytest.mark.usefixtures('at_inputs')
def test_a_disk_that_is_full_at_any_page_of_a_sqlite_bag(tmp_path, capsys):
    """sqlite writes by itself: the limit is that of the kernel."""
    line, whole = 'segment drive.mcap -o {}/out.db3', tmp_path / 'whole'
    whole.mkdir()
    assert run(*words_of(line, whole)) == 0
    expected, limits = content(whole), resource.getrlimit(resource.RLIMIT_FSIZE)
    for size in range(0, (whole / 'out.db3').stat().st_size, 4 * 4096):
        folder = tmp_path / str(size)
        folder.mkdir()
        (folder / 'mine').write_bytes(MINE)
        capsys.readouterr()
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, limits[1]))
        try:
            code = run(*words_of(line, folder))
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        (said,) = errors_of(capsys)
        assert code == 2 and f'{folder}/out.db3: cannot be written: ' in said, size
        assert [path.name for path in folder.iterdir()] == ['mine']
        assert_begun_again(line, folder, expected, size)


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
        BagWriter(tmp_path / 'drive').__enter__()
    with BagReader(tmp_path / 'drive') as bag:
        assert list(bag.messages()) == before
    assert {path.name for path in tmp_path.iterdir()} == names | {'drive'}


def test_a_folder_is_not_replaced_by_a_file(tmp_path):
    (tmp_path / 'file').mkdir()
    with pytest.raises(DataError, match='not replaced'):
        files.write_file(tmp_path / 'file', b'')
    assert [p.name for p in tmp_path.iterdir()] == ['file']


DOUBLE = """
from gp_ground_seg.core import jit

@jit.jit(entry=True)
def double(x):
    return 2.0 * x
"""
COMPILE = """
import json, os, sys
import numba
from test_write_faults import Disk, double_in

for line in sys.stdin:
    read, write = os.pipe()
    if os.fork() == 0:
        os.write(write, json.dumps(double_in(*json.loads(line))).encode())
        os._exit(0)
    os.close(write)
    with open(read) as said:
        print(said.read(), flush=True)
"""


def double_in(folder, *fault):
    """Use compiled code that is kept in `folder`; what a process finds that has just begun."""
    os.environ['NUMBA_CACHE_DIR'] = folder
    jit.code_folder.cache_clear()
    with Disk(folder, *fault).at_work() as disk:
        from double import double

        result = double(21.0)
    return result, sum(double.stats.cache_hits.values()), disk.calls


@pytest.mark.slow
def test_each_call_that_keeps_compiled_code_fails_in_turn(tmp_path):
    """The result is there, and the next process but one has its code from disk."""
    if not jit.HAVE_NUMBA:
        pytest.skip('nothing is compiled')
    (tmp_path / 'double.py').write_text(DOUBLE)
    tests = REPOSITORY / 'test'
    paths = map(str, [REPOSITORY, tests, tests / 'data', tmp_path])
    changed = {'PYTHONPATH': os.pathsep.join(paths), 'NUMBA_DISABLE_JIT': '0'}
    command, pipes = [sys.executable, '-c', COMPILE], {'stdin': subprocess.PIPE}
    pipes |= {'stdout': subprocess.PIPE, 'stderr': subprocess.DEVNULL}
    with subprocess.Popen(command, env=os.environ | changed, text=True, **pipes) as process:

        def use(folder, *fault):
            process.stdin.write(json.dumps([str(folder), *fault]) + '\n')
            process.stdin.flush()
            return json.loads(process.stdout.readline())

        result, _, calls = use(tmp_path / 'whole')
        assert result == 42.0 and {'mkdir', 'open', 'write', 'replace'} <= {c for c, _ in calls}
        for k, (call, place) in enumerate(calls):
            for fault in FAULTS.get(call, (FULL,)):
                folder, where = tmp_path / f'{k}{fault}', f'{call} {place}, {fault}'
                assert use(folder, k, fault)[0] == 42.0, where
                assert use(folder)[0] == 42.0, where
                assert use(folder)[:2] == [42.0, 1], where
                left = [path.name for path in folder.rglob('*')]
                assert not [name for name in left if 'tmp' in name], (where, left)
