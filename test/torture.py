"""Hostile clouds and messages: `make torture`, TORTURE_SCALE=100 for a night.

Each case follows from its number, and is a test of its own; a crash or a hang of the process is a
failure too.
"""

import os
from pathlib import Path

import numpy as np
import pytest
from rclpy.serialization import serialize_message
from ros_helpers import linked_process, street, to_message
from rosgraph_msgs.msg import Clock

from gp_ground_seg import Config, ConfigError, GroundSegmenter, Label, PointCloudError
from gp_ground_seg.core.parameters.config import parameter_specs
from gp_ground_seg.core.pipeline.points import take_points

MAX_DIFFERENT = 0.02
"""Share of the points that rounding may decide differently in the two backends: one candidate
that joins or not changes the labels of its cells."""
SCALE = float(os.environ.get('TORTURE_SCALE', '1'))
SPECIAL = [np.nan, np.inf, -np.inf, 0.0, -0.0, 1e-40, -1e-40, 1e-7, 1e7, 3e38, -3e38, 1e300]


LAYOUTS = (
    np.asfortranarray,
    lambda xyz: np.column_stack([xyz, xyz])[:, :4],
    lambda xyz: np.repeat(xyz, 2, axis=0)[::2],
    lambda xyz: xyz[::-1],
)


def random_cloud(rng):
    """Cloud of a random kind, size, type and layout."""
    n = int(
        rng.choice([0, 1, 2, 3, 7, 60, 500, 3000, 9000], p=[0.03] * 4 + [0.08] * 2 + [0.24] * 3)
    )
    azimuth, r = rng.uniform(-np.pi, np.pi, n), rng.gamma(2.0, rng.choice([0.5, 5.0, 40.0]), n)
    z = rng.normal(rng.choice([-1.73, 0.0, -0.2, 5.0]), rng.choice([0.0, 0.02, 1.0, 50.0]), n)
    if rng.random() < 0.5:  # rings of beams, walls where they end
        depression = rng.choice(np.linspace(0.02, 0.5, 16), n)
        height = rng.uniform(0.2, 3.0)
        r = np.minimum(height / np.tan(depression), rng.choice([5.0, 30.0, 100.0]))
        z = -r * np.tan(depression) + rng.normal(0.0, 0.02, n)
    xyz = np.column_stack([r * np.cos(azimuth), r * np.sin(azimuth), z])
    kind = rng.integers(8)
    if kind == 0 and n:  # many points in one place
        xyz[: n // 2] = xyz[0]
    elif kind == 1:  # values on the edges of cells and tiles
        xyz = np.round(xyz * 2.0) / 2.0
    elif kind == 2:  # in one line, plane or axis
        xyz[:, rng.integers(3)] = rng.choice([0.0, 1.0, -1.73])
    elif kind == 3:
        xyz *= 10.0 ** rng.uniform(-20, 20)
    elif kind == 4:  # tilted
        xyz = xyz @ np.linalg.qr(rng.normal(size=(3, 3)))[0]
    if rng.random() < 0.5 and n:
        where = rng.random(xyz.shape) < rng.choice([0.001, 0.05, 0.9])
        xyz[where] = rng.choice(SPECIAL, where.sum())
    dtype = rng.choice(['float32', 'float64', 'float16', '>f4'])
    with np.errstate(over='ignore', invalid='ignore'):
        xyz = xyz.astype(dtype)
    return LAYOUTS[rng.integers(4)](xyz)


def random_config(rng):
    """Some parameters anywhere in their declared ranges; those that contradict are drawn again."""
    others = ('runtime', 'frame', 'input', 'output', 'diagnostics')
    specs = [s for s in parameter_specs() if s.name.split('.')[0] not in others]
    while True:
        changes = {}
        for index in rng.choice(len(specs), rng.choice([0, 1, 3, 10, 40]), replace=False):
            spec = specs[index]
            low, high = spec.minimum, spec.maximum
            if spec.type in (bool, str):
                value = rng.choice(spec.choices or [False, True])
            elif rng.random() < 0.3:
                value = rng.choice([low, high])
            elif low > 0.0:
                value = min(np.exp(rng.uniform(*np.log([low, high]))), high)
            else:
                value = rng.uniform(low, high)
            changes[spec.name] = spec.type(value)
        # Another test tries large grids; here they would take the night.
        changes['grid.n_segments'] = min(changes.get('grid.n_segments', 180), 720)
        changes['grid.n_bins'] = min(changes.get('grid.n_bins', 160), 400)
        changes['faces.cell_size'] = max(changes.get('faces.cell_size', 0.5), 0.25)
        changes['learning.max_evaluations'] = min(changes.get('learning.max_evaluations', 4), 8)
        try:
            return Config().replace(**changes)
        except ConfigError:
            continue


def check(points, result):
    """Raise AssertionError unless what must always hold does."""
    # Finite, not at the origin, and not where very many are: test_points has what is taken.
    n = len(points)
    known = np.isfinite(take_points(points, (0.0, 0.0, 0.0))).all(axis=1)
    label, height = result.label, result.height
    assert label.shape == height.shape == result.p_ground.shape == (n,), 'length'
    assert np.isin(label, [Label.UNKNOWN, Label.GROUND, Label.OBSTACLE]).all(), 'classes'
    assert ((label == Label.UNKNOWN) == ~known).all(), 'UNKNOWN is what is no return'
    ground = label == Label.GROUND
    assert np.isfinite(height[ground]).all(), 'NaN height on ground'
    for std in (result.ground_std, result.return_std):
        assert np.isfinite(std[ground]).all(), 'NaN std on ground'
    assert (result.margin[ground] >= 0.0).all(), 'negative margin on ground'
    assert (result.p_ground[ground] >= 0.5).all(), 'p_ground of ground below one half'
    assert (np.isnan(result.p_ground) == ~known).all(), 'p_ground'


def segment_or_error(segmenter, points):
    """Return the result, or the error as one line."""
    try:
        return segmenter.segment(points)
    except PointCloudError as error:
        return str(error)


@pytest.mark.parametrize('number', range(round(1000 * SCALE)))
def test_clouds(number):
    """Segment a random cloud under random parameters; raise unless what must hold does."""
    rng = np.random.default_rng([2112, number])
    points, config = random_cloud(rng), random_config(rng)
    before = points.tobytes()
    compiled, plain = (
        GroundSegmenter(config.replace(**{'runtime.backend': name})) for name in ('numba', 'numpy')
    )
    results = [segment_or_error(segmenter, points) for segmenter in (compiled, compiled, plain)]
    assert points.tobytes() == before, 'the input was written to'
    if isinstance(results[0], str):
        assert results[0] == results[1] == results[2], results
        assert '\n' not in results[0], 'an error of more than a line'
        return
    for result in results:
        assert not isinstance(result, str), result
        check(points, result)
    one, again, other = results
    assert np.array_equal(one.label, again.label), 'labels depend on the scan before'
    assert np.array_equal(one.height, again.height, equal_nan=True), 'so do heights'
    n_different = np.count_nonzero(one.label != other.label)
    assert n_different <= max(2, MAX_DIFFERENT * len(points)), (
        f'numba and numpy differ in {n_different} of {len(points)} labels'
    )


MAX_RSS = 1.5e9
"""Memory that the node may hold [bytes]."""


def damaged_message(rng):
    """Serialized valid cloud with bytes flipped, mostly in what comes before the points."""
    data = bytearray(serialize_message(to_message(street(100, seed=int(rng.integers(1000))))))
    for _ in range(rng.integers(1, 6)):
        data[rng.integers(min(len(data), rng.choice([60, 250, len(data)])))] = rng.integers(256)
    return bytes(data[: rng.integers(1, len(data) + 1)] if rng.random() < 0.1 else data)


@pytest.fixture(scope='module')
def node_and_link(tmp_path_factory, compiled_code):
    """A node in a process of its own, what talks to it, and a publisher of times."""
    with linked_process(tmp_path_factory.mktemp('node'), {'use_sim_time': True}) as (node, link):
        node.wait_until_settled()
        yield node, link, link.probe.create_publisher(Clock, '/clock', 1)


@pytest.mark.parametrize('number', range(round(400 * SCALE)))
@pytest.mark.filterwarnings('default')
def test_ros(number, node_and_link):
    """Send a damaged cloud and a time; after ten, a valid cloud must be answered."""
    (node, link, clock), rng = node_and_link, np.random.default_rng([17, number])
    link.publisher.publish(damaged_message(rng))
    now = Clock()
    now.clock.sec = int(rng.choice([-(2**31), -5, -1, 0, 2**31 - 1]))
    now.clock.nanosec = int(rng.choice([0, 10**9, 2**32 - 1]))
    clock.publish(now)
    if number % 10 != 9:
        return
    seen = len(link.ground.messages)
    link.publish_until(
        to_message(street(2000)),
        lambda: any(m.width for m in link.ground.messages[seen:]),
        'answer to a valid cloud',
    )
    memory = int(Path(f'/proc/{node.popen.pid}/statm').read_text().split()[1]) * 4096
    assert memory < MAX_RSS, f'the node holds {memory / 1e6:.0f} MB'
    assert 'Traceback' not in node.log, node.log.partition('Traceback')[2][:500]
