"""Compiled code on disk: used again, never when damaged, planted or out of date."""

import fcntl
import json
import os
import signal
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
from gp_ground_seg.core.jit import code_folder, has_to_compile, is_code_kept, jit

@jit(entry=True)
def double(x):
    return 2.0 * x

@jit(entry=True)
def half(x):
    return 0.5 * x
"""
RUN = """
import json, logging, os, signal, sys
logging.basicConfig(level=logging.INFO, stream=sys.stderr, format='%(message)s')
import small
from gp_ground_seg.core import jit
jit._patience = float(os.environ.get('PATIENCE', '60'))
was_kept = small.is_code_kept()
assert small.has_to_compile() == (jit.JIT_ENABLED and not was_kept)
result, used = small.double(21.0), [small.double]
if 'KILL' in os.environ:
    os.kill(os.getpid(), signal.SIGKILL)
if 'PART' not in os.environ:
    small.half(1.0)
    used.append(small.half)
stats = [one.stats for one in used if jit.JIT_ENABLED]
hits, misses = (sum(sum(one[k].values()) for one in stats) for k in (1, 2))
folder = small.code_folder()
print(json.dumps([result, hits, misses, was_kept, str(folder) if folder else None]))
"""


class Program:
    """A module with two compiled functions, run in a process of its own."""

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

    def code(self, name: str = 'double', kind: str = 'nbc') -> Path:
        (found,) = self.cache.rglob(f'small.{name}-*.{kind}')
        return found


COMPILED, LOADED = [42.0, 0, 2, False], [42.0, 2, 0, True]
NOT_KEPT = [42.0, 0, 2, False, None]


@pytest.fixture
def program(tmp_path):
    tmp_path.chmod(0o755)
    return Program(tmp_path)


def test_code_is_compiled_once_said_once_and_then_loaded(program):
    """What is compiled is kept although the process is killed then, as a warm-up half way."""
    with program.start(KILL='1') as process:
        assert process.wait(timeout=120) == -signal.SIGKILL
        assert process.stderr.read().count('compiling') == 1
    # A command may need a part of the code: nothing of it is missing.
    assert program.run(PART='1')[:4] == [42.0, 1, 0, False] and program.stderr == ''
    assert program.run()[:4] == [42.0, 1, 1, False] and program.stderr.count('compiling') == 1
    *loaded, folder = program.run()
    assert loaded == LOADED and program.stderr == ''
    # Beside the sources it would survive pip's uninstall, as a package without a version.
    assert Path(folder) in program.code().parents
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
    # A user without a home is told in one line.
    home.rename(program.folder / 'was_home')
    home.touch()
    assert program.run(NUMBA_CACHE_DIR=None, HOME=str(home)) == NOT_KEPT
    assert len(program.stderr.splitlines()) == 1
    # Python keeps its own there, where it is let.
    assert {p.name for p in program.folder.iterdir()} - {'__pycache__', 'was_home'} == {
        'home',
        'small.py',
    }


def plant(path):
    """Put a pickle of a stranger's call in place of code."""
    path.write_bytes(b"cos\nsystem\n(S'touch ran'\ntR.")


DAMAGES = {
    'planted': plant,
    'zeros': lambda path: path.write_bytes(path.read_bytes()[:-4096] + bytes(4096)),
    'cut off': lambda path: path.write_bytes(path.read_bytes()[:100]),
    'missing': lambda path: path.unlink(),
}
OFTEN = 'planted'


@pytest.mark.parametrize(
    'names', [[OFTEN], pytest.param(DAMAGES.keys() - {OFTEN}, marks=pytest.mark.slow)]
)
def test_damaged_code_is_compiled_again_and_that_of_other_functions_loaded(program, names):
    program.run()
    for name in names:
        DAMAGES[name](program.code(kind='nbi' if name == 'planted' else 'nbc'))
        assert program.run()[:4] == [42.0, 1, 1, False], name
        assert program.run()[:4] == LOADED, name
    # Without the list of files nobody knows that they are all there, until they are loaded.
    next(program.cache.rglob('all')).unlink()
    assert program.run()[:4] == [*LOADED[:3], False]
    assert program.run()[:4] == LOADED
    assert not (program.folder / 'ran').exists()


def test_a_full_disk_ends_nothing(program):
    *result, _ = program.run(1024, PYTHONDONTWRITEBYTECODE='1')
    assert result == COMPILED
    (line,) = [line for line in program.stderr.splitlines() if 'not kept on disk' in line]
    assert 'File too large' in line
    assert 'Traceback' not in program.stderr
    assert program.run()[:4] == COMPILED
    # And it does not matter where all is there.
    assert program.run(1024)[:4] == LOADED and program.stderr == ''


def test_one_process_compiles_and_others_wait_for_its_files(program):
    processes = [program.start() for _ in range(3)]
    found = [json.loads(process.communicate(timeout=120)[0]) for process in processes]
    assert {result for result, *_ in found} == {42.0}
    assert sum(misses for _, _, misses, *_ in found) == 2
    assert sum(hits for _, hits, *_ in found) == 4
    # One that is suspended, or hangs, is not waited for without end.
    program.code().unlink()
    with next(program.cache.rglob('lock')).open() as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        assert program.run(PATIENCE='0.2')[:4] == [42.0, 1, 1, False]
    assert program.run()[:4] == LOADED


@pytest.mark.parametrize(
    ('change', 'reason'),
    [
        (lambda folder: folder.chmod(0o701), 'others can open'),
        pytest.param(
            lambda folder: folder.parent.chmod(0o777),
            'others can write to',
            marks=pytest.mark.slow,
        ),
        pytest.param(
            lambda folder: os.chown(folder, 65534, -1),
            'belongs to another user',
            marks=[
                pytest.mark.slow,
                pytest.mark.skipif(os.getuid() != 0, reason='only root gives files to others'),
            ],
        ),
    ],
)
def test_code_is_not_read_from_where_others_can_put_it(program, change, reason):
    *_, folder = program.run()
    plant(index := program.code(kind='nbi'))
    checksum = index.with_name('small.double.sha256')
    checksum.write_bytes(jit_module._digest_of(checksum))
    change(Path(folder))
    assert program.run() == NOT_KEPT
    assert reason in program.stderr
    assert not (program.folder / 'ran').exists()


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
    """They are segmented with numpy, and have its labels."""
    scan(1).tofile(tmp_path / 'a.bin')
    labels, cache = [], str(tmp_path / 'none')
    env = os.environ | {'NUMBA_CACHE_DIR': cache, 'NUMBA_DISABLE_JIT': '0'}
    for more, n_notes in ([], 1), (['--set', 'runtime.backend=numpy'], 0):
        words = 'segment', 'a.bin', '-o', 'a.label', '--force', *more
        process = start(*words, cwd=tmp_path, env=env)
        said = process.communicate(timeout=60)[1]
        assert process.returncode == 0, said
        assert said.count('segmented with numpy; to have compiled code, run') == n_notes
        assert 'compiling' not in said
        labels.append((tmp_path / 'a.label').read_bytes())
    assert labels[0] == labels[1]


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
