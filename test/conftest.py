"""Shared by test modules: labelled frames where they are at hand, small scans, both backends."""

import importlib.util
import os
import signal
import subprocess
import sys
from functools import cache, lru_cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import settings

from gp_ground_seg.core.backend import Backend, NumpyBackend
from gp_ground_seg.core.compiled.backend import NumbaBackend
from gp_ground_seg.core.jit import JIT_ENABLED
from gp_ground_seg.core.segmenter import warm_up
from gp_ground_seg.lab.simulation import SCENES, SENSORS, simulate_scan

# The duration of an example depends on the machine more than on the code.
settings.register_profile('default', deadline=None)
settings.load_profile('default')


def pytest_configure(config):
    # Not in pyproject.toml: there it holds where plugins are imported too, as launch_testing is.
    config.addinivalue_line('filterwarnings', 'error')
    # As in a terminal, also where a shell runs the tests in the background.
    signal.signal(signal.SIGINT, signal.default_int_handler)


# `make test` has two processes: one compiles first, and the other has work until that is done.
# What takes long is not last.
FIRST = 'frozen simulator_scan sensor_pose likelihood write_faults wrong_data jit config'
FIRST += ' simulator_terrain cli_main layout cli_bags kernels config_files point_cloud2 formats'
FIRST += ' files scale segmenter ros_start_stop step_edges pages ros_process ros_managed'
FIRST += ' ros_node cli_demo'


def pytest_collection_modifyitems(items):
    order = {f'test_{name}': k for k, name in enumerate(FIRST.split())}
    items.sort(key=lambda item: order.get(item.path.stem, len(order)))


REPOSITORY = Path(__file__).resolve().parent.parent
ROAD, OTHER_OBJECT = 40, 99  # classes of SemanticKITTI


def load_script(path):
    """A script of the repository as a module."""
    spec = importlib.util.spec_from_file_location(Path(path).stem, REPOSITORY / path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def run_python(script, *words, **environment):
    """Output and errors of a script, run by this Python in a process of its own."""
    done = subprocess.run(
        [sys.executable, '-c', script, *map(str, words)], check=False, timeout=120,
        env={**os.environ, 'PYTHONPATH': os.pathsep.join(sys.path), **environment},
        capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout, done.stderr


def run_shell(script, folder, environment):
    """What a script of bash prints, which ends with code 0 and without a traceback."""
    done = subprocess.run(
        ['bash', '-e', '-c', script], cwd=folder, env=environment, check=False, timeout=3000,
        stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    )  # fmt: skip
    assert done.returncode == 0 and 'Traceback' not in done.stdout, done.stdout
    return done.stdout


def find_kitti() -> Path | None:
    """Folder of labelled KITTI frames: GP_GROUND_SEG_KITTI, or beside the repository."""
    named = os.environ.get('GP_GROUND_SEG_KITTI')
    folder = Path(named) if named else REPOSITORY.parent / 'shared' / 'kitti'
    return folder if (folder / 'sequences').is_dir() else None


@pytest.fixture(scope='session')
def kitti() -> Path:
    folder = find_kitti()
    if folder is None:
        pytest.skip('no labelled KITTI frames: set GP_GROUND_SEG_KITTI to their folder')
    return folder


def hilly_scan(n_points: int = 4000, seed: int = 0, sensor_height: float = 1.73) -> np.ndarray:
    """Ground that rises gently with boxes on it, (N, 3) float64; cheap, for unit tests."""
    rng = np.random.default_rng(seed)
    r = 3.0 + 37.0 * rng.random(n_points) ** 1.5
    azimuth = rng.uniform(-np.pi, np.pi, n_points)
    x, y = r * np.cos(azimuth), r * np.sin(azimuth)
    z = -sensor_height + 0.02 * x + 0.1 * np.sin(0.3 * x) + rng.normal(0.0, 0.02, n_points)
    standing = rng.random(n_points) < 0.2
    z[standing] += rng.uniform(0.5, 2.0, standing.sum())
    return np.column_stack([x, y, z])


@cache
def scene_of(name: str, seed: int = 0):
    """Simulated scene, made once for all tests."""
    return SCENES[name](seed)


@lru_cache(maxsize=100)
def simulated(scene, sensor='vlp-16', seed: int = 0):
    """Scan of a scene by a sensor, names or what they name, made once for all tests.

    `seed` is that of the noise, and of a scene given by its name. The points are read-only.
    """
    scene = scene_of(scene, seed) if isinstance(scene, str) else scene
    sensor = SENSORS[sensor] if isinstance(sensor, str) else sensor
    made = simulate_scan(scene, sensor, np.random.default_rng(seed))
    made.points.setflags(write=False)
    return made


@pytest.fixture(scope='session')
def sequence(tmp_path_factory):
    """Folder of two simulated scans with labels, as SemanticKITTI has them."""
    folder = tmp_path_factory.mktemp('sequence')
    for name in ('velodyne', 'labels'):
        (folder / name).mkdir()
    for k in range(2):
        made = simulated('urban', seed=k)
        made.points.astype('<f4').tofile(folder / 'velodyne' / f'{k:06d}.bin')
        labels = np.where(made.is_ground, ROAD, OTHER_OBJECT).astype('<u4')
        labels.tofile(folder / 'labels' / f'{k:06d}.label')
    return folder


def fewer(n: int, n_plain: int) -> int:
    """Return `n`, or `n_plain` where the compiled twins run as plain Python, 100 times slower."""
    return n if JIT_ENABLED else n_plain


BACKENDS = NumpyBackend(), NumbaBackend()


@pytest.fixture(scope='module', params=[NumpyBackend, NumbaBackend], ids=['numpy', 'numba'])
def backend(request: pytest.FixtureRequest) -> Backend:
    """Each backend in turn."""
    if request.param is NumbaBackend:
        request.getfixturevalue('compiled_code')
    return request.param()


@pytest.fixture(scope='session')
def compiled_code():
    """Code compiled once for this checkout; for tests whose nodes and commands load it."""
    if JIT_ENABLED:
        warm_up()


@pytest.fixture
def scan() -> np.ndarray:
    return hilly_scan()
