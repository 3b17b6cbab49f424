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
from cli_runner import PATIENCE, start

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
import json, logging, os, resource, signal, sys
import numba
from gp_ground_seg.core import jit
numba.njit(lambda x: x)(1.0)  # what the first compilation imports and fills is shared too
for line in sys.stdin:
    n, folder, limit, environment = json.loads(line)
    started = []
    while len(started) < n and (process := os.fork()):
        started.append(process)
    if len(started) == n:
        ends = [os.waitpid(process, 0)[1] for process in started]
        print(json.dumps([os.waitstatus_to_exitcode(end) for end in ends]), flush=True)
        continue
    for number, name in ((1, 'out'), (2, 'err')):
        file = open(f'{folder}-{len(started)}.{name}', 'w')
        os.dup2(file.fileno(), number)
    os.chdir(folder)
    os.environ.update(environment)
    sys.dont_write_bytecode = limit is not None
    resource.setrlimit(resource.RLIMIT_FSIZE, 2 * [limit or resource.RLIM_INFINITY])
    logging.basicConfig(level=logging.INFO, stream=sys.stderr, format='%(message)s')
    import small
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
    place = small.code_folder()
    print(json.dumps([result, hits, misses, was_kept, place and str(place)]), flush=True)
    os._exit(0)
"""
"""Forks processes that run the module at the same time, so that numba is imported once: a line
says how many, where, what their files may hold and variables; they end before their codes are
printed."""


@pytest.fixture(scope='module')
def server():
    kept = {k: v for k, v in os.environ.items() if not k.startswith(('NUMBA_', 'XDG_'))}
    pipes = {'stdin': subprocess.PIPE, 'stdout': subprocess.PIPE, 'text': True}
    with subprocess.Popen([sys.executable, '-c', RUN], env=kept, **pipes) as process:
        yield process


class Program:
    """A module with two compiled functions, run in processes of their own."""

    def __init__(self, folder: Path, server):
        self.folder, self.cache = folder, folder / 'cache'
        (folder / 'small.py').write_text(MODULE)
        self._server, self.stderr = server, ''

    def run(self, limit=None, **environment: str) -> list:
        """What a run says; it writes at most `limit` bytes to a file, as to a full disk."""
        return self.run_some(1, limit, **environment)[0]

    def run_some(self, n, limit=None, code=0, **environment: str) -> list[list]:
        """What each of several runs at the same time says; they end with that code."""
        request = n, str(self.folder), limit, {'NUMBA_CACHE_DIR': str(self.cache), **environment}
        print(json.dumps(request), file=self._server.stdin, flush=True)
        codes = json.loads(self._server.stdout.readline())
        said, errors = (
            [Path(f'{self.folder}-{k}.{name}').read_text() for k in range(n)]
            for name in ('out', 'err')
        )
        self.stderr = ''.join(errors)
        assert codes == n * [code], self.stderr
        return [json.loads(text) for text in said if code == 0]

    def code(self) -> Path:
        (found,) = self.cache.rglob('small.double.code')
        return found


COMPILED, LOADED = [42.0, 0, 2, False], [42.0, 2, 0, True]
NOT_KEPT = [42.0, 0, 2, False, None]


@pytest.fixture
def program(tmp_path, server):
    folder = tmp_path / 'program'
    folder.mkdir(0o755)
    return Program(folder, server)


def test_code_is_compiled_once_said_once_and_then_loaded(program):
    """What is compiled is kept although the process is killed then, as a warm-up half way."""
    program.run_some(1, code=-signal.SIGKILL, KILL='1')
    assert program.stderr.count('compiling') == 1
    # A command may need a part of the code: nothing of it is missing.
    assert program.run(PART='1')[:4] == [42.0, 1, 0, False] and program.stderr == ''
    assert program.run()[:4] == [42.0, 1, 1, False] and program.stderr.count('compiling') == 1
    *loaded, folder = program.run()
    assert loaded == LOADED and program.stderr == ''
    # Beside the sources it would survive pip's uninstall, as a package without a version.
    assert Path(folder) in program.code().parents
    assert stat.S_IMODE(os.stat(folder).st_mode) == 0o700
    assert not list(program.folder.rglob('*.nb[ic]'))
    # It is not read from where others can put it.
    Path(folder).chmod(0o701)
    assert program.run() == NOT_KEPT and 'others can open' in program.stderr


def test_code_lies_in_the_cache_of_the_user_by_default_and_never_in_the_current_folder(
    program, monkeypatch
):
    """An empty XDG_CACHE_HOME would mean it to numba."""
    home = program.folder / 'home'
    monkeypatch.setenv('HOME', str(home))
    monkeypatch.delenv('NUMBA_CACHE_DIR', raising=False)
    for folder, base in (('', home / '.cache'), (str(home), home)):
        monkeypatch.setenv('XDG_CACHE_HOME', folder)
        assert jit_module.code_folder.__wrapped__().parent == base / 'gp_ground_seg'
    assert program.run(NUMBA_CACHE_DIR='here') == NOT_KEPT
    assert 'here is no absolute path' in program.stderr
    assert len(program.stderr.splitlines()) == 1
    # Python keeps its own there, where it is let.
    assert {p.name for p in program.folder.iterdir()} - {'__pycache__'} == {'home', 'small.py'}


def plant(path):
    """Put a pickle of a stranger's call in place of code."""
    path.write_bytes(b"cos\nsystem\n(S'touch ran'\ntR.")


DAMAGES = {
    'cut off': lambda path: path.write_bytes(path.read_bytes()[:100]),
    'missing': lambda path: path.unlink(),
}


@pytest.mark.parametrize(
    'name', ['planted', *(pytest.param(n, marks=pytest.mark.slow) for n in DAMAGES)]
)
def test_damaged_code_is_compiled_again_and_that_of_other_functions_loaded(program, name):
    program.run()
    DAMAGES.get(name, plant)(program.code())
    assert program.run()[:4] == [42.0, 1, 1, False]
    # Without the list of files nobody knows that they are all there, until they are loaded.
    next(program.cache.rglob('all')).unlink()
    assert program.run()[:4] == [*LOADED[:3], False]
    assert program.run()[:4] == LOADED
    assert not (program.folder / 'ran').exists()


def test_a_full_disk_ends_nothing(program):
    *result, _ = program.run(1024)
    assert result == COMPILED
    (line,) = [line for line in program.stderr.splitlines() if 'not kept on disk' in line]
    assert 'File too large' in line
    assert 'Traceback' not in program.stderr
    assert program.run()[:4] == COMPILED
    # And it does not matter where all is there.
    assert program.run(1024)[:4] == LOADED and program.stderr == ''


def test_one_process_compiles_and_others_wait_for_its_files(program):
    found = program.run_some(3)
    assert {result for result, *_ in found} == {42.0}
    assert sum(misses for _, _, misses, *_ in found) == 2
    assert sum(hits for _, hits, *_ in found) == 4
    # One that is suspended, or hangs, is not waited for without end.
    program.code().unlink()
    with next(program.cache.rglob('*.double.lock')).open() as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        assert program.run(PATIENCE='0.2')[:4] == [42.0, 1, 1, False]
    assert program.run()[:4] == LOADED


def test_a_folder_is_private_if_nobody_else_can_change_it_or_one_above(tmp_path):
    folder = tmp_path / 'a' / 'b'
    folder.mkdir(0o700, parents=True)
    jit_module._require_private(folder)
    folder.parent.chmod(0o1777)  # as /tmp
    jit_module._require_private(folder)
    folder.parent.chmod(0o777)
    with pytest.raises(PermissionError, match='others can write to'):
        jit_module._require_private(folder)
    folder.parent.chmod(0o755)
    if os.getuid() == 0:
        os.chown(folder, 65534, -1)  # root's are trusted
    with (
        patch('os.getuid', return_value=7),
        pytest.raises(PermissionError, match='belongs to another user'),
    ):
        jit_module._require_private(folder)


def test_the_digest_covers_every_file_that_compiled_code_is_made_from():
    before, real = jit_module._digest(), Path.read_bytes
    for name in ('numerics.py', 'config.py', 'jit.py', 'frame.py'):

        def read(path, name=name):
            return real(path) + b'#' * (path.name == name)

        with patch.object(Path, 'read_bytes', read):
            assert jit_module._digest() != before


@pytest.mark.skipif(not jit_module.JIT_ENABLED, reason='nothing is compiled')
def test_few_scans_do_not_wait_for_the_compiler(tmp_path):
    """They are segmented with numpy, unless compiled code is asked for."""
    scan(1).tofile(tmp_path / 'a.bin')
    env = os.environ | {'NUMBA_CACHE_DIR': str(tmp_path / 'none'), 'NUMBA_DISABLE_JIT': '0'}
    with start('segment', 'a.bin', '-o', 'a.label', cwd=tmp_path, env=env) as process:
        said = process.communicate(timeout=PATIENCE)[1]
    assert process.returncode == 0, said
    assert said.count('segmented with numpy; to have compiled code, run') == 1
    assert 'compiling' not in said
    many = options.COMPILING_PAYS
    for is_missing in (True, False):
        with patch.object(options, 'has_to_compile', lambda found=is_missing: found):
            for backend in ('auto', 'numba', 'numpy'):
                config = Config().replace(**{'runtime.backend': backend})
                for n_scans in (1, many - 1, many):
                    found = options.spare_compiling(config, n_scans).runtime.backend
                    is_spared = is_missing and n_scans < many and backend == 'auto'
                    assert found == ('numpy' if is_spared else backend)
