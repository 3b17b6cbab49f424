"""What is recorded of machine, source and parameters."""

import os
import platform
import shutil
import subprocess

from gp_ground_seg import Config, __version__
from gp_ground_seg.evaluation.environment import (
    _commit,
    changed_parameters,
    describe_environment,
    parameters_line,
)


def test_parameters_are_recorded():
    changes = {'label.ground_tolerance': 0.123, 'runtime.backend': 'numpy'}
    config = Config().replace(**changes)
    assert changed_parameters(Config()) == {}
    assert changed_parameters(config) == changes
    assert parameters_line({}) == 'parameters: defaults'
    assert 'runtime.backend=numpy' in parameters_line(changes)


def test_environment():
    environment = describe_environment('no-such-package')
    assert environment.versions['gp_ground_seg'] == __version__
    assert environment.versions['no-such-package'] is None
    assert environment.n_cores == len(os.sched_getaffinity(0))
    assert environment.python == platform.python_version()
    assert environment.cpu
    line = environment.machine(1, 'numba')
    assert ', 1 thread on ' in line and 'no-such-package absent' in line


def git(folder, *words):
    identity = ['-c', 'user.name=a', '-c', 'user.email=a@b', '-c', 'commit.gpgsign=false']
    run = ['git', *identity, *words]
    return subprocess.run(run, cwd=folder, check=True, capture_output=True, text=True).stdout


def test_commit_is_that_of_the_source_or_none(tmp_path):
    source = tmp_path / 'package' / '__init__.py'
    source.parent.mkdir()
    source.write_text('')
    assert _commit(source) is None
    if shutil.which('git') is None:
        return
    git(tmp_path, 'init')
    (tmp_path / 'other').write_text('')
    git(tmp_path, 'add', 'other')
    git(tmp_path, 'commit', '-m', 'another repository')
    assert _commit(source) is None  # inside a repository that is not its own
    git(tmp_path, 'add', 'package')
    git(tmp_path, 'commit', '-m', 'ours')
    commit = git(tmp_path, 'rev-parse', 'HEAD').strip()
    assert _commit(source) == commit
    source.write_text('changed')
    assert _commit(source) == f'{commit}-dirty'
