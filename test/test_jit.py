"""Compiled code on disk: used again, never when damaged, planted or out of date."""

import json
import os
import stat
import subprocess
import sys
from pathlib import Path
from unittest.mock import patch

import pytest

from gp_ground_seg import jit as jit_module

MODULE = """
from gp_ground_seg.jit import JIT_ENABLED, code_folder, is_code_kept, jit, keep_code

@jit(entry=True)
def double(x):
    return 2.0 * x
"""
RUN = """
import json, logging, sys
logging.basicConfig(level=logging.INFO, stream=sys.stderr, format='%(message)s')
import small
result = small.double(21.0)
hits, misses = (sum(c.values()) for c in small.double.stats[1:]) if small.JIT_ENABLED else (0, 0)
was_kept = small.is_code_kept()
small.keep_code(warm=True)
folder = small.code_folder()
print(json.dumps([result, hits, misses, was_kept, str(folder) if folder else None]))
"""


class Program:
    """A module with one compiled function, run in a process of its own."""

    def __init__(self, folder: Path):
        self.folder, self.cache = folder, folder / 'cache'
        self.cache.mkdir(mode=0o755)
        (folder / 'small.py').write_text(MODULE)
        self.stderr = ''

    def run(self, **environment: str) -> list:
        own = {'NUMBA_CACHE_DIR': str(self.cache), **environment}
        kept = {k: v for k, v in os.environ.items() if not k.startswith(('NUMBA_', 'XDG_'))}
        done = subprocess.run(
            [sys.executable, '-c', RUN],
            env=kept | {k: v for k, v in own.items() if v is not None},
            cwd=self.folder, capture_output=True, text=True, timeout=120,
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        self.stderr = done.stderr
        return json.loads(done.stdout)

    @property
    def entries(self) -> list[Path]:
        return sorted(self.cache.rglob('*.nb[ic]'))

    @property
    def stamp(self) -> Path:
        (found,) = self.cache.rglob('*.stamp')
        return found


COMPILED, LOADED = [42.0, 0, 1, False], [42.0, 1, 0, True]


@pytest.fixture
def program(tmp_path):
    tmp_path.chmod(0o755)
    return Program(tmp_path)


def test_code_is_compiled_once_and_then_loaded(program):
    assert program.run()[:4] == COMPILED
    assert 'compiling' in program.stderr
    assert program.run()[:4] == LOADED
    assert program.stderr == ''


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


def of_other_sources(path):
    path.write_text(json.dumps(json.loads(path.read_text()) | {'sources': 'other'}))


DAMAGES = {
    'zeros in the code': lambda p: zeros(code(p)),
    'code cut off': lambda p: code(p).write_bytes(code(p).read_bytes()[:100]),
    'index cut off': lambda p: index(p).write_bytes(index(p).read_bytes()[:100]),
    'no code': lambda p: code(p).unlink(),
    'planted index': lambda p: index(p).write_bytes(pickle(p)),
    'another index': lambda p: index(p).with_stem(f'other.py3{sys.version_info[1]}').touch(),
    'empty stamp': lambda p: p.stamp.write_bytes(b''),
    'stamp of other sources': lambda p: of_other_sources(p.stamp),
    'no stamp': lambda p: p.stamp.unlink(),
}


def test_code_that_does_not_fit_its_stamp_is_compiled_again(program):
    program.run()
    for name, damage in DAMAGES.items():
        damage(program)
        assert program.run()[:4] == COMPILED, name
        assert program.run()[:4] == LOADED, name
    assert not (program.folder / 'ran').exists()


def test_a_folder_that_others_can_write_to_is_not_used(program):
    program.run()
    DAMAGES['planted index'](program)
    program.entries[0].parent.chmod(0o777)
    assert program.run() == [42.0, 0, 1, False, None]
    assert 'others can write to' in program.stderr
    assert not (program.folder / 'ran').exists()


def test_nothing_is_kept_in_the_current_folder(program):
    """An empty XDG_CACHE_HOME would mean it to numba."""
    assert program.run(NUMBA_CACHE_DIR=None, XDG_CACHE_HOME='') == [42.0, 0, 1, False, None]
    assert 'XDG_CACHE_HOME is no absolute path' in program.stderr
    assert sorted(p.name for p in program.folder.iterdir()) == ['cache', 'small.py']


def test_without_numba_nothing_is_compiled(program):
    assert program.run(NUMBA_DISABLE_JIT='1') == [42.0, 0, 0, False, None]


OTHERS = (0o757, 0, 'others can write'), (0o755, 1, 'belongs to another user')


@pytest.mark.parametrize(('mode', 'uid', 'reason'), [(0o755, 0, ''), (0o700, 0, ''), *OTHERS])
def test_whom_a_folder_belongs_to(tmp_path, mode, uid, reason):
    folder = tmp_path / 'code'
    folder.mkdir()
    folder.chmod(mode)
    own = os.stat(folder)

    def stat_of(path, *arguments, **keywords):
        real = os.stat(path, *arguments, **keywords)
        if path != folder:
            return os.stat_result((stat.S_IFDIR | 0o755, 0, 0, 0, 0, *real[5:]))
        owner = os.getuid() + uid
        return os.stat_result((real.st_mode, *own[1:4], owner, *real[5:]))

    with patch.object(Path, 'stat', stat_of):
        found = jit_module._why_not_trusted(folder)
    assert reason in found if reason else found == ''


def test_of_groups_only_the_users_own_may_write(tmp_path):
    status = os.stat_result((stat.S_IFDIR | 0o775, 0, 0, 0, os.getuid(), 12345678, 0, 0, 0, 0))
    assert jit_module._others_can_write(status)  # a group that does not exist
    user = jit_module.pwd.getpwuid(os.getuid()).pw_name
    for name, members, expected in ((user, [], False), (user, ['eve'], True), ('all', [], True)):
        group = jit_module.grp.struct_group((name, 'x', 12345678, members))
        with patch.object(jit_module.grp, 'getgrgid', lambda gid, group=group: group):
            assert jit_module._others_can_write(status) is expected


def test_the_digest_covers_every_file_that_compiled_code_is_made_from(tmp_path):
    before, real = jit_module._stamp(tmp_path)['sources'], Path.read_bytes
    for name in ('numerics.py', 'config.py', 'jit.py', 'frame.py'):

        def read(path, name=name):
            return real(path) + b'#' * (path.name == name)

        with patch.object(Path, 'read_bytes', read):
            assert jit_module._stamp(tmp_path)['sources'] != before
