"""Compiled code on disk: used again, never when damaged, planted or out of date."""

import fcntl
import hashlib
import json
import os
import stat
import subprocess
import sys
from pathlib import Path
from unittest.mock import patch

import pytest
from bag_samples import scan
from cli_runner import start

from gp_ground_seg import Config
from gp_ground_seg.cli import options
from gp_ground_seg.core import jit as jit_module

MODULE = """
from gp_ground_seg.core.jit import (
    JIT_ENABLED, announce_compiling, code_folder, is_code_kept, jit, keep_code,
)

@jit(entry=True)
def double(x):
    return 2.0 * x

@jit(entry=True)
def half(x):
    return 0.5 * x
"""
RUN = """
import json, logging, os, pathlib, sys, time
logging.basicConfig(level=logging.INFO, stream=sys.stderr, format='%(message)s')
import small
if 'IDLE' not in os.environ:
    small.announce_compiling()
result = None if 'IDLE' in os.environ else small.double(21.0)
hits, misses = (sum(c.values()) for c in small.double.stats[1:]) if small.JIT_ENABLED else (0, 0)
was_kept = small.is_code_kept()
if 'WAIT' in os.environ:
    pathlib.Path('compiled').touch()
    while not pathlib.Path('go').exists():
        time.sleep(0.01)
if 'COLD' not in os.environ:
    small.half(1.0)
small.keep_code()
folder = small.code_folder()
print(json.dumps([result, hits, misses, was_kept, str(folder) if folder else None]))
"""


class Program:
    """A module with one compiled function, run in a process of its own."""

    def __init__(self, folder: Path):
        self.folder, self.cache = folder, folder / 'cache'
        (folder / 'small.py').write_text(MODULE)
        self.stderr = ''

    def run(self, limit=None, **environment: str) -> list:
        """What a run says; it writes at most `limit` bytes to a file, as to a full disk."""
        process = self.start(limit, **environment)
        said, self.stderr = process.communicate(timeout=120)
        assert process.returncode == 0, self.stderr
        return json.loads(said)

    def start(self, limit=None, **environment: str) -> subprocess.Popen:
        changed = {'NUMBA_CACHE_DIR': str(self.cache), **environment}
        kept = {k: v for k, v in os.environ.items() if not k.startswith(('NUMBA_', 'XDG_'))}
        size = '' if limit is None else f'ulimit -f {limit // 1024}; '
        return subprocess.Popen(
            ['bash', '-c', size + 'exec "$@"', '-', sys.executable, '-c', RUN],
            env=kept | {k: v for k, v in changed.items() if v is not None},
            cwd=self.folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip

    @property
    def entries(self) -> list[Path]:
        return sorted(self.cache.rglob('*.nb[ic]'))

    @property
    def notes(self) -> Path:
        (found,) = self.cache.rglob('kept.json')
        return found


COMPILED, LOADED = [42.0, 0, 1, False], [42.0, 1, 0, True]
NOT_KEPT = [42.0, 0, 1, False, None]


@pytest.fixture
def program(tmp_path):
    tmp_path.chmod(0o755)
    return Program(tmp_path)


def test_code_is_compiled_once_said_once_and_then_loaded(program):
    program.run(IDLE='1', COLD='1')
    assert program.stderr == ''
    assert program.run(COLD='1')[:4] == COMPILED
    assert 'compiling' in program.stderr
    # A command may need a part of the code: that is not all, but nothing of it is missing.
    assert program.run(COLD='1')[:4] == [42.0, 1, 0, False] and program.stderr == ''
    assert program.run()[:3] == LOADED[:3]
    *loaded, folder = program.run()
    assert loaded == LOADED and program.stderr == ''
    # Beside the sources it would survive pip's uninstall, as a package without a version.
    assert all(Path(folder) in entry.parents for entry in program.entries)
    assert stat.S_IMODE(os.stat(folder).st_mode) == 0o700
    assert not list(program.folder.glob('__pycache__/*.nb[ic]'))


def test_code_lies_in_the_cache_of_the_user_by_default_and_never_in_the_current_folder(program):
    """An empty XDG_CACHE_HOME would mean it to numba."""
    home = program.folder / 'home'
    for folder, base in (('', home / '.cache'), (str(home), home)):
        *_, found = program.run(NUMBA_CACHE_DIR=None, HOME=str(home), XDG_CACHE_HOME=folder)
        assert Path(found).parent == base / 'gp_ground_seg'
    assert program.run(NUMBA_CACHE_DIR='here') == NOT_KEPT
    assert 'here is no absolute path' in program.stderr
    # Python keeps its own there, where it is let.
    assert {p.name for p in program.folder.iterdir()} - {'__pycache__'} == {'home', 'small.py'}


def code(program):
    return next(entry for entry in program.entries if entry.suffix == '.nbc')


def index(program):
    return next(entry for entry in program.entries if entry.suffix == '.nbi')


def pickle(program):
    """An index that is a pickle of a stranger's call."""
    return b"cos\nsystem\n(S'touch " + str(program.folder / 'ran').encode() + b"'\ntR."


def zeros(path):
    content = path.read_bytes()
    path.write_bytes(content[:4096] + bytes(len(content[4096:8192])) + content[8192:])


DAMAGES = {
    'zeros in the code': lambda p: zeros(code(p)),
    'code cut off': lambda p: code(p).write_bytes(code(p).read_bytes()[:100]),
    'index cut off': lambda p: index(p).write_bytes(index(p).read_bytes()[:100]),
    'no code': lambda p: code(p).unlink(),
    'planted index': lambda p: index(p).write_bytes(pickle(p)),
    'no notes': lambda p: p.notes.unlink(),
    'empty notes': lambda p: p.notes.write_bytes(b''),
}


OFTEN = ('planted index',)


@pytest.mark.parametrize(
    'names', [OFTEN, pytest.param(DAMAGES.keys() - {*OFTEN}, marks=pytest.mark.slow)]
)
def test_damaged_code_is_compiled_again(program, names):
    program.run()
    for name in names:
        DAMAGES[name](program)
        assert program.run()[:4] == COMPILED, name
    assert program.run()[:4] == LOADED
    assert not (program.folder / 'ran').exists()


@pytest.mark.parametrize('limit', [pytest.param(0, marks=pytest.mark.slow), 1024])
def test_a_full_disk_ends_nothing(program, limit):
    """With the larger one numba writes its index, and no code."""
    *result, _ = program.run(limit, PYTHONDONTWRITEBYTECODE='1')
    assert result == COMPILED
    (line,) = [line for line in program.stderr.splitlines() if 'not kept on disk' in line]
    assert 'File too large' in line
    assert 'Traceback' not in program.stderr
    assert program.run()[:4] == COMPILED
    # And it does not matter where all is there.
    assert program.run(limit)[:4] == LOADED and program.stderr == ''


def test_a_process_that_starts_leaves_what_another_compiles(program):
    with program.start(WAIT='1') as first:
        while not (program.folder / 'compiled').exists():
            assert first.poll() is None
        before = {path: path.stat().st_ino for path in program.entries}
        is_noted = bool(list(program.cache.rglob('kept.json')))
        second = program.run(COLD='1')
        after = {path: path.stat().st_ino for path in program.entries}
        (program.folder / 'go').touch()
        first.communicate(timeout=120)
    assert before and not is_noted
    assert second[:3] == LOADED[:3] and after == before
    assert program.run()[:4] == LOADED


def test_what_several_find_damaged_is_kept_again(program):
    program.run()
    DAMAGES['planted index'](program)
    for process in [program.start() for _ in range(3)]:
        said, errors = process.communicate(timeout=120)
        assert json.loads(said)[0] == 42.0 and 'not kept' not in errors
    assert program.run()[:4] == LOADED


def test_code_of_earlier_sources_goes_when_later_is_kept(program):
    ours = program.cache / 'gp_ground_seg'
    ours.mkdir(parents=True, mode=0o700)
    sources = {
        'earlier': jit_module._CORE, 'used': jit_module._CORE, 'gone': '/no/such/sources',
        'other': program.folder, 'unknown': '',
    }  # fmt: skip
    for name, place in sources.items():
        (ours / name).mkdir()
        (ours / name / 'lock').write_text(str(place))
    with (ours / 'used' / 'lock').open() as lock:
        fcntl.flock(lock, fcntl.LOCK_SH)
        program.run(COLD='1')
        assert len(list(ours.iterdir())) == 6
        *_, folder = program.run()
    left = {path.name for path in ours.iterdir()}
    assert left == {'used', 'other', 'unknown', Path(folder).name}


@pytest.mark.parametrize(
    ('where', 'mode', 'reason'),
    [
        ('.', 0o701, 'others can open'),
        pytest.param('..', 0o777, 'others can write to', marks=pytest.mark.slow),
    ],
)
def test_code_is_not_read_from_where_others_can_put_it(program, where, mode, reason):
    *_, folder = program.run()
    DAMAGES['planted index'](program)
    # As if it had been noted, too.
    notes = json.loads(program.notes.read_text())
    planted = hashlib.sha256(pickle(program)).hexdigest()
    notes[index(program).relative_to(folder).as_posix()] = planted
    program.notes.write_text(json.dumps(notes))
    Path(folder, where).chmod(mode)
    assert program.run() == NOT_KEPT
    assert reason in program.stderr
    assert not (program.folder / 'ran').exists()


@pytest.mark.skipif(os.getuid() != 0, reason='only root gives files to others')
def test_code_is_not_read_from_a_folder_of_another_user(program):
    *_, folder = program.run()
    os.chown(folder, 65534, -1)
    assert program.run() == NOT_KEPT
    assert 'belongs to another user' in program.stderr


def test_a_user_without_home_is_told_in_one_line(program):
    home = program.folder / 'home'
    home.touch()
    assert program.run(NUMBA_CACHE_DIR=None, HOME=str(home)) == NOT_KEPT
    assert len(program.stderr.splitlines()) == 1


def test_without_numba_nothing_is_compiled(program):
    assert program.run(NUMBA_DISABLE_JIT='1') == [42.0, 0, 0, False, None]


def test_the_digest_covers_every_file_that_compiled_code_is_made_from():
    before, real = jit_module._digest(), Path.read_bytes
    for name in ('numerics.py', 'config.py', 'jit.py', 'frame.py'):

        def read(path, name=name):
            return real(path) + b'#' * (path.name == name)

        with patch.object(Path, 'read_bytes', read):
            assert jit_module._digest() != before


@pytest.mark.skipif(not jit_module.JIT_ENABLED, reason='nothing is compiled')
def test_few_scans_do_not_wait_for_the_compiler(tmp_path):
    """And have the labels of numpy."""
    scan(1).tofile(tmp_path / 'a.bin')
    labels, cache = [], str(tmp_path / 'none')
    for more, n_notes in ([], 1), (['--quiet'], 0), (['--set', 'runtime.backend=numpy'], 0):
        process = start(
            'segment', 'a.bin', '-o', 'a.label', '--force', *more, cwd=tmp_path,
            env={**os.environ, 'NUMBA_CACHE_DIR': cache, 'NUMBA_DISABLE_JIT': '0'},
        )  # fmt: skip
        said = process.communicate(timeout=60)[1]
        assert process.returncode == 0, said
        assert said.count('segmented with numpy; to have compiled code, run') == n_notes
        assert 'compiling' not in said
        labels.append((tmp_path / 'a.label').read_bytes())
    assert len(set(labels)) == 1


def test_many_scans_or_a_backend_asked_for_are_compiled(monkeypatch):
    for is_missing in (True, False):
        monkeypatch.setattr(options, 'has_to_compile', lambda found=is_missing: found)
        for backend in ('auto', 'numba', 'numpy'):
            config = Config().replace(**{'runtime.backend': backend})
            for n_scans in (1, options.COMPILING_PAYS - 1, options.COMPILING_PAYS):
                found = options.spare_compiling(config, n_scans)
                is_few = n_scans < options.COMPILING_PAYS
                expected = 'numpy' if is_missing and is_few and backend == 'auto' else backend
                assert found == config.replace(**{'runtime.backend': expected})
