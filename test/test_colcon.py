"""Built and tested by colcon, started as ``ros2 run`` does."""

import os
import signal
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest

pytest.importorskip('rclpy', reason='ROS is not installed')
pytest.importorskip('colcon_core', reason='colcon is not installed')

from conftest import REPOSITORY
from ros_helpers import ISOLATION, NAMESPACE, Process

PACKAGE = 'gp_ground_seg'
EXECUTABLE = 'ground_segmentation_node'


class Workspace:
    """A colcon workspace over this source, all it makes in a folder of its own."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        # Where ROS comes from wheels it lies below the interpreter's prefix.
        prefixes = [os.environ.get('AMENT_PREFIX_PATH', ''), sys.prefix]
        self._environment = {
            **{k: v for k, v in os.environ.items() if k not in ('PYTHONPATH', 'PYTEST_ADDOPTS')},
            'AMENT_PREFIX_PATH': os.pathsep.join(filter(None, prefixes)),
        }

    def colcon(self, verb: str, *words: str) -> subprocess.CompletedProcess:
        command = [sys.executable, '-m', 'colcon', '--log-base', str(self.folder / 'log'), verb]
        environment = self._environment
        if verb == 'test':
            # The tests that it runs need no compiled code, which would be compiled for it.
            environment = {**environment, 'NUMBA_DISABLE_JIT': '1'}
        if verb != 'test-result':
            command += ['--base-paths', str(REPOSITORY), '--packages-select', PACKAGE]
            command += ['--install-base', str(self.folder / 'install')]
            command += ['--build-base', str(self.folder / 'build')]
        return subprocess.run(
            [*command, *words], cwd=self.folder, env=environment,
            capture_output=True, text=True, timeout=1800.0,
        )  # fmt: skip

    def sourced(self, command: str, *words: str) -> list[str]:
        """Command line that runs a shell `command` after ``source install/setup.bash``."""
        setup = self.folder / 'install' / 'setup.bash'
        return ['bash', '-c', f'source {setup} && {command}', 'bash', *words]

    @property
    def environment(self) -> dict[str, str]:
        return {**self._environment, **ISOLATION}


@pytest.fixture(scope='module')
def workspace(tmp_path_factory):
    result = Workspace(tmp_path_factory.mktemp('workspace'))
    built = result.colcon('build')
    assert built.returncode == 0, built.stdout + built.stderr
    assert '1 package finished' in built.stdout
    return result


def python_in(workspace, script):
    done = subprocess.run(
        workspace.sourced(f'{sys.executable} -c "$1"', script),
        cwd=workspace.folder, env=workspace.environment, capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_the_package_is_in_the_index_and_imported_from_the_workspace(workspace):
    prefix = python_in(
        workspace,
        f'from ament_index_python import get_package_prefix as find; print(find("{PACKAGE}"))',
    )
    assert Path(prefix) == workspace.folder / 'install' / PACKAGE
    module = python_in(workspace, f'import {PACKAGE}; print({PACKAGE}.__file__)')
    assert Path(prefix) in Path(module).parents
    installed = Path(prefix, 'share', PACKAGE)
    assert (installed / 'package.xml').read_bytes() == (REPOSITORY / 'package.xml').read_bytes()
    for file in (REPOSITORY / 'config').iterdir():
        if file.is_file():
            assert (installed / 'config' / file.name).read_bytes() == file.read_bytes()


def test_the_installed_node_runs_as_ros2_run_starts_it(workspace, tmp_path):
    """``ros2 run`` looks up the prefix and runs lib/PACKAGE/EXECUTABLE with the same words."""
    prefix = workspace.folder / 'install' / PACKAGE
    executable = prefix / 'lib' / PACKAGE / EXECUTABLE
    assert os.access(executable, os.X_OK)
    assert os.access(executable.with_name('gp-ground-seg'), os.X_OK)
    words = [
        '--ros-args', '-r', f'__ns:={NAMESPACE}', '-p', 'learning.mode:=fixed',
        '--params-file', str(prefix / 'share' / PACKAGE / 'config' / 'vlp16.yaml'),
    ]  # fmt: skip
    command = workspace.sourced('exec "$0" "$@"', *words)
    command[3] = str(executable)
    with Process(folder=tmp_path, command=command, **workspace.environment) as node:
        node.wait_until_ready()
        assert f'listening to {NAMESPACE}/points' in node.log
        assert 'grid.n_segments: 120  (default 180)' in node.log
        code, _ = node.stop(signal.SIGINT)
    assert code == 0, node.log
    assert 'Traceback' not in node.log


def test_colcon_test_collects_our_tests(workspace):
    """It returns 0 as well where it finds none."""
    done = workspace.colcon(
        'test', '--return-code-on-test-failure',
        '--pytest-args', 'test/test_package.py', 'test/test_config.py',
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    results = workspace.folder / 'build' / PACKAGE / 'pytest.xml'
    (suite,) = ElementTree.parse(results).getroot().iter('testsuite')
    assert int(suite.get('tests')) > 50
    assert suite.get('failures') == suite.get('errors') == '0'
    done = workspace.colcon('test-result', '--test-result-base', str(workspace.folder / 'build'))
    assert done.returncode == 0
    assert f'Summary: {suite.get("tests")} tests, 0 errors, 0 failures' in done.stdout
