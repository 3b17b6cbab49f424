"""Built and tested by colcon, started as ``ros2 run`` does."""

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip('rclpy', reason='ROS is not installed')
pytest.importorskip('colcon_core', reason='colcon is not installed')

from conftest import REPOSITORY, run_shell
from ros_helpers import NAMESPACE, Process

pytestmark = pytest.mark.slow
PACKAGE = 'gp_ground_seg'
EXECUTABLE = 'ground_segmentation_node'


# Where ROS comes from wheels it lies below the interpreter's prefix.
PREFIXES = filter(None, [os.environ.get('AMENT_PREFIX_PATH', ''), sys.prefix])
ENVIRONMENT = {
    **{k: v for k, v in os.environ.items() if k not in ('PYTHONPATH', 'PYTEST_ADDOPTS')},
    'AMENT_PREFIX_PATH': os.pathsep.join(PREFIXES),
}


def build(folder, *words):
    """Build this source, all that colcon makes in `folder`."""
    command = [
        sys.executable, '-m', 'colcon', '--log-base', folder / 'log', 'build',
        '--base-paths', REPOSITORY, '--packages-select', PACKAGE,
        '--install-base', folder / 'install', '--build-base', folder / 'build', *words,
    ]  # fmt: skip
    assert '1 package finished' in run_shell(shlex.join(map(str, command)), folder, ENVIRONMENT)
    return folder


def sourced(folder, command, *words):
    """Command line that runs a shell `command` after ``source install/setup.bash``."""
    setup = folder / 'install' / 'setup.bash'
    return ['bash', '-c', f'source {setup} && {command}', *map(str, words)]


@pytest.fixture(scope='module')
def workspace(tmp_path_factory):
    return build(tmp_path_factory.mktemp('workspace'))


def test_the_package_is_in_the_index_and_imported_from_the_workspace(workspace):
    script = (
        f'from ament_index_python import get_package_prefix as find; import {PACKAGE}; '
        f'print(find("{PACKAGE}"), {PACKAGE}.__file__)'
    )
    command = sourced(workspace, f'{sys.executable} -c "$0"', script)
    said = subprocess.check_output(command, cwd=workspace, env=ENVIRONMENT, text=True)
    prefix, module = map(Path, said.split())
    assert prefix == workspace / 'install' / PACKAGE and prefix in module.parents
    installed = Path(prefix, 'share', PACKAGE)
    assert (installed / 'package.xml').read_bytes() == (REPOSITORY / 'package.xml').read_bytes()
    shared = [*REPOSITORY.glob('config/*'), *REPOSITORY.glob('launch/*.launch.py')]
    assert len(shared) >= 6
    for file in shared:
        assert (installed / file.parent.name / file.name).read_bytes() == file.read_bytes()


def test_the_installed_node_runs_as_ros2_run_starts_it(workspace, tmp_path):
    """``ros2 run`` looks up the prefix and runs lib/PACKAGE/EXECUTABLE with the same words."""
    prefix = workspace / 'install' / PACKAGE
    executable = prefix / 'lib' / PACKAGE / EXECUTABLE
    assert os.access(executable, os.X_OK)
    script = (REPOSITORY / 'scripts' / 'setup_workspace.sh').read_text()
    (warm_up,) = re.findall(r'(install/\S+/gp-ground-seg) warm-up', script)
    for other in executable.with_name('ground_segmentation_lifecycle_node'), workspace / warm_up:
        assert os.access(other, os.X_OK)
    words = [
        '--ros-args', '-r', f'__ns:={NAMESPACE}', '-p', 'learning.mode:=fixed',
        '--params-file', prefix / 'share' / PACKAGE / 'config' / 'paper.yaml',
    ]  # fmt: skip
    command = sourced(workspace, 'exec "$0" "$@"', executable, *words)
    with Process(folder=tmp_path, command=command, **ENVIRONMENT) as node:
        node.wait_until_ready()
        assert f'listening to {NAMESPACE}/points' in node.log
        assert 'grid.n_bins: 120  (default 80)' in node.log
        node.end_well()


def test_links_to_the_sources_are_installed_too(tmp_path):
    build(tmp_path, '--symlink-install')
    assert os.access(tmp_path / 'install' / PACKAGE / 'lib' / PACKAGE / EXECUTABLE, os.X_OK)
