"""What goes to PyPI: installed and used without this repository."""

import os
import shutil
import signal
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest
from conftest import REPOSITORY

import gp_ground_seg

LEFT_OUT = shutil.ignore_patterns(
    '.*', '__pycache__', '*.egg-info', 'build', 'dist', 'install', 'log', 'demo_output', 'test'
)
VERSION = gp_ground_seg.__version__
SHARED = sorted(
    path.relative_to(REPOSITORY).as_posix()
    for path in [*REPOSITORY.glob('config/*'), *REPOSITORY.glob('launch/*.py')]
)


def python(*words, folder, **environment):
    """Run Python in `folder`, where nothing of the repository is found."""
    cleared = {k: v for k, v in os.environ.items() if k not in ('PYTHONPATH', 'AMENT_PREFIX_PATH')}
    return subprocess.run(
        [sys.executable, *map(str, words)], cwd=folder, env={**cleared, **environment},
        capture_output=True, text=True, timeout=300.0,
    )  # fmt: skip


@pytest.fixture(scope='module')
def built(tmp_path_factory):
    """Folder with the sdist, and with the wheel that is built from it."""
    folder = tmp_path_factory.mktemp('distribution')
    source = shutil.copytree(REPOSITORY, folder / 'source', ignore=LEFT_OUT)
    done = python('setup.py', '-q', 'sdist', '-d', folder, folder=source)
    assert done.returncode == 0, done.stderr
    pip = '-m', 'pip', '--disable-pip-version-check'
    how = '--no-deps', '--no-build-isolation', '-w', folder
    (sdist,) = folder.glob('*.tar.gz')
    done = python(*pip, 'wheel', '-q', *how, sdist, folder=folder)
    assert done.returncode == 0, done.stderr
    return folder


@pytest.fixture(scope='module')
def installed(built):
    """Folder into which the wheel is installed, as into a prefix."""
    (wheel,) = built.glob('*.whl')
    target = built / 'site'
    words = '-q', '--disable-pip-version-check', '--no-deps', '--target', target, wheel
    done = python('-m', 'pip', 'install', *words, folder=built)
    assert done.returncode == 0, done.stderr
    return target


@pytest.mark.slow
def test_the_files_of_both(built):
    (wheel,) = built.glob('*.whl')
    assert wheel.name == f'gp_ground_seg-{VERSION}-py3-none-any.whl'
    (sdist,) = built.glob('*.tar.gz')
    with tarfile.open(sdist) as archive:
        _, *names = archive.getnames()
    names = {name.partition('/')[2] for name in names}
    assert {'LICENSE', 'README.md', 'CHANGELOG.rst', 'package.xml', *SHARED} <= names
    assert not any(name.startswith(('test', 'docs/images')) for name in names)
    modules = {
        p.relative_to(REPOSITORY).as_posix() for p in REPOSITORY.glob('gp_ground_seg/**/*.py')
    }
    names = set(zipfile.ZipFile(wheel).namelist())
    assert modules == {name for name in names if name.endswith('.py') and '.data/' not in name}
    share = f'gp_ground_seg-{VERSION}.data/data/share/gp_ground_seg'
    assert {f'{share}/{name}' for name in (*SHARED, 'package.xml')} <= names


@pytest.mark.slow
def test_what_pypi_would_object_to(built):
    pytest.importorskip('twine', reason='twine is not installed')
    files = [*built.glob('*.whl'), *built.glob('*.tar.gz')]
    done = python('-m', 'twine', 'check', '--strict', *files, folder=built)
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.count('PASSED') == 2


@pytest.mark.slow
def test_the_wheel_segments_a_scan(installed, tmp_path):
    scan = str(REPOSITORY / 'docs' / 'scans' / 'vls128_street.npz')
    words = '-m', 'gp_ground_seg', 'plot', 'scan', scan, '-o', 'scan.png'
    found = {'PYTHONPATH': str(installed), 'NUMBA_DISABLE_JIT': '1'}
    quick = '--set', 'runtime.backend=numpy'
    done = python(*words, *quick, folder=tmp_path, **found)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / 'scan.png').stat().st_size > 10_000
    where = python('-c', 'import gp_ground_seg as g; print(g.__file__)', folder=tmp_path, **found)
    assert installed in Path(where.stdout).parents


@pytest.mark.parametrize(
    ('words', 'complaint'),
    [
        ((), 'no ROS 2: source /opt/ros/jazzy/setup.bash'),
        (('src',), 'src has no src: name the workspace, or start this in it'),
        (('elsewhere',), 'elsewhere: no such folder'),
    ],
)
def test_the_script_for_a_workspace_refuses_in_one_line(tmp_path, words, complaint):
    (tmp_path / 'src').mkdir()
    script = REPOSITORY / 'scripts' / 'setup_workspace.sh'
    done = subprocess.run(
        [script, *words], cwd=tmp_path, env={'PATH': os.environ['PATH']},
        capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert line.startswith('setup_workspace.sh: error: ') and line.endswith(complaint)
    assert [path.name for path in tmp_path.rglob('*')] == ['src']


@pytest.mark.slow
def test_the_node_of_the_wheel_starts(installed, tmp_path):
    """With the transport for large clouds, which is a file beside it."""
    ros = pytest.importorskip('ros_helpers')
    code = (
        f'import sys; sys.path.insert(0, {str(installed)!r}); '
        'from gp_ground_seg.cli.node import main; from gp_ground_seg.ros import start_stop; '
        'print(start_stop._find_profile(), file=sys.stderr); sys.exit(main())'
    )
    words = *ros.IN_NAMESPACE, '-p', 'runtime.backend:=numpy'
    with ros.Process(*words, folder=tmp_path, start=('-c', code)) as node:
        node.wait_until_ready()
        profile = installed / 'share/gp_ground_seg/config/fastdds_large_clouds.xml'
        assert node.log.splitlines()[0] == str(profile)
        assert node.stop(signal.SIGINT)[0] == 0
