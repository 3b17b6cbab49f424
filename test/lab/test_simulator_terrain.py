"""Where rays meet terrain and solids: dense sampling, obvious twins, by hand."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gp_ground_seg.lab.simulation import DRIVES, SCENES, Kind
from gp_ground_seg.lab.simulation import terrain as landforms
from gp_ground_seg.lab.simulation.objects import Cylinder, Hull, nearest_solid, standing_box
from gp_ground_seg.lab.simulation.terrain import first_hit, polyline

SENSOR_POSITION = np.array([0.0, 0.0, 1.73])

TERRAINS = {
    'ramp': landforms.ramp(9.0, 0.15, 0.2),
    'vertical kerb': landforms.kerb(4.0, 0.15, face_width=0.0),
    'steps': polyline(0.0, [(3, 0), (3, 0.8), (3.3, -0.2), (5, -0.2), (12, 0.8), (12, -1)], 0.1),
    'rough': landforms.rough(np.random.default_rng(3), rms=0.2, wavelengths=(0.7, 9.0)),
    'rubble': landforms.smooth_then_rough(np.random.default_rng(4), 9.0, 3.0),
    'rough kerb': landforms.Sum(
        (landforms.kerb(4.0, 0.15), landforms.rough(np.random.default_rng(5), 0.1, (0.7, 9.0)))
    ),
    'ditch across a crest': landforms.Sum(
        (landforms.ditch(1.3, 8.0, 4.0, 1.5, 1.0), landforms.crest(8.0, 10.0, 0.1, 6.0))
    ),
}


@pytest.fixture(params=TERRAINS, scope='module')
def terrain(request):
    return TERRAINS[request.param]


def clearance(terrain, origin, direction, t):
    x, y, z = (origin[k] + t * direction[:, k, None] for k in range(3))
    return z - terrain.height(x, y)


@pytest.mark.parametrize(
    ('elevations', 'height', 'max_range', 'n_rays', 'n_samples'),
    [((-0.5, 0.1), 1.73, 60.0, 200, 3000), ((-0.06, 0.02), 0.7, 30.0, 40, 30_000)],
    ids=['steep', 'grazing'],
)
def test_hit_is_the_first_crossing(terrain, elevations, height, max_range, n_rays, n_samples):
    """On the surface, and a fine sampling of the way there finds no earlier crossing."""
    rng = np.random.default_rng(0)
    azimuth, elevation = rng.uniform(-np.pi, np.pi, n_rays), rng.uniform(*elevations, n_rays)
    x, y, up = np.cos(azimuth), np.sin(azimuth), np.tan(elevation)
    direction = np.column_stack([x, y, up]) * np.cos(elevation)[:, None]
    position = np.array([0.0, 0.0, float(terrain.height(0.0, 0.0)) + height])
    t = first_hit(terrain, np.tile(position, (n_rays, 1)), direction, max_range)
    way = np.minimum(t, max_range)[:, None] - 1e-7
    for share in np.array_split(np.linspace(0.0, 1.0, n_samples), 10):
        assert clearance(terrain, position, direction, way * share).min() > -1e-8
    hit = np.isfinite(t)
    assert hit.sum() > 50 or elevations[1] < 0.1
    ahead, behind = (
        clearance(terrain, position, direction[hit], t[hit, None] + hair) for hair in (1e-7, -1e-7)
    )
    # At a vertical face the ray goes from well above to well below.
    assert ((np.abs(behind) < 1e-6) | ((behind > 0.0) & (ahead <= 0.0))).all()
    assert (ahead < 1e-6).all()


def test_slope_and_bend_bound_hold(terrain):
    """Slope equals a central difference; no second difference exceeds the bend bound."""
    rng = np.random.default_rng(6)
    at = rng.uniform(-30.0, 30.0, (2000, 2))
    heading = rng.uniform(-np.pi, np.pi, 2000)
    direction = np.column_stack([np.cos(heading), np.sin(heading)])
    step = 1e-4
    here = terrain.along(at, direction)
    before = terrain.along(at - step * direction, direction, at).height
    after = terrain.along(at + step * direction, direction, at).height
    np.testing.assert_allclose(here.slope, (after - before) / (2.0 * step), atol=1e-6)
    axes = terrain.gradient(at)
    np.testing.assert_allclose(np.sum(axes * direction, axis=1), here.slope, atol=1e-9)
    second = (after - 2.0 * here.height + before) / step**2
    assert (second <= here.bend + 1e-5).all()


@pytest.mark.parametrize(
    ('terrain', 'u', 'expected'),
    [
        (landforms.kerb(4.0, 0.15, 0.1, 0.0), [-9, -3.9, 0, 4.05, 4.2], [0.15, 0, 0, 0.075, 0.15]),
        (
            landforms.ditch(0.0, 10.0, 4.0, 2.0, 1.0),
            [9, 10.5, 12, 13.5, 15],
            [0, -0.5, -1, -0.5, 0],
        ),
        (landforms.ramp(10.0, 0.1), [9, 20], [0, 1]),
        (landforms.crest(10.0, 10.0, 0.1, 4.0), [10, 20, 22, 24, 34], [0, 1, 1.1, 1, 0]),
        (polyline(0.0, [(3, 0), (3, 1), (5, 1)], 0.1), [2.999, 3.001, 4, 5, 7], [0, 1, 1, 1, 1.2]),
        (polyline(0.0, [(3, 0), (3, 1)]), [2.999, 3.001, 9], [0, 1, 1]),
    ],
)
def test_landform_heights(terrain, u, expected):
    np.testing.assert_allclose(terrain.height(np.array(u), np.zeros(len(u))), expected, atol=1e-12)


def inside(solid, points):
    """Obvious twin of `Solid.entry`: whether points lie in the solid."""
    x, y = points[..., 0] - solid.x, points[..., 1] - solid.y
    if isinstance(solid, Hull):
        planes = zip(solid.normals, solid.limits, strict=True)
        outline = np.all([x * u + y * v <= limit for (u, v, _), limit in planes], axis=0)
    else:
        outline = np.hypot(x, y) <= solid.radius
    return outline & (points[..., 2] >= solid.bottom) & (points[..., 2] <= solid.top)


@st.composite
def draw_solid(draw):
    x = draw(st.sampled_from([-20.0, -7.0, 6.0, 15.0]))
    y, bottom, height = (draw(st.floats(*ends)) for ends in ((-20, 20), (-3, 4), (0.3, 6)))
    length, width, yaw = (draw(st.floats(*ends)) for ends in ((0.3, 8), (0.3, 3), (-4, 4)))
    if draw(st.booleans()):
        return Cylinder(Kind.POLE, x, y, bottom, bottom + height, width)
    box = standing_box(landforms.flat(), x, y, (length, width, height), yaw)
    return replace(box, bottom=bottom, top=bottom + height)


@given(
    solid=draw_solid().filter(lambda s: math.hypot(s.x, s.y) > s.radius + 0.1),
    seed=st.integers(0, 2**32 - 1),
)
def test_entry_is_where_the_inside_begins_and_no_ray_through_the_middle_misses(solid, seed):
    rng = np.random.default_rng(seed)
    middle = np.array([solid.x, solid.y, (solid.bottom + solid.top) / 2])
    spread = np.array([solid.radius, solid.radius, (solid.top - solid.bottom) / 2])
    around = middle + 1.3 * spread * rng.uniform(-1.0, 1.0, (30, 3))
    along_axis = middle + spread * [0.0, 0.0, 1.0] * rng.uniform(-0.98, 0.98, (20, 1))
    direction = np.concatenate([around, along_axis]) - SENSOR_POSITION
    distance = np.linalg.norm(direction, axis=1)
    direction /= distance[:, None]
    entry = solid.entry(np.tile(SENSOR_POSITION, (50, 1)), direction)
    assert (entry[30:] < distance[30:]).all()
    way = np.minimum(entry, 60.0)[:, None] * np.linspace(0.0, 1.0 - 1e-9, 500)
    assert not inside(solid, SENSOR_POSITION + way[..., None] * direction[:, None]).any()
    hit = np.isfinite(entry)
    # A point on the face is inside once the solid is grown by a hair.
    at = SENSOR_POSITION + entry[hit, None] * direction[hit]
    assert inside(solid, at + 1e-9 * (middle - at)).all()


def test_axis_parallel_rays_and_starts_inside():
    box = standing_box(landforms.flat(), 5.0, 0.0, (2.0, 2.0, 1.0))
    origin = np.array([[0.0, 0.0, 0.0], [0.0, 1.5, 0.0], [5.0, 0.0, 0.0], [5.0, 0.0, 4.0]])
    direction = np.array([[1.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    np.testing.assert_allclose(box.entry(origin, direction), [4.0, np.inf, np.inf, 3.0])
    rod = Cylinder(Kind.POLE, 5.0, 0.0, -1.0, 1.0, 0.5)
    np.testing.assert_allclose(rod.entry(origin, direction), [4.5, np.inf, np.inf, 3.0])


def test_common_start_gives_what_single_starts_give():
    """Sorting by azimuth leaves out no ray, also behind the sensor and for solids around it."""
    rng = np.random.default_rng(0)
    direction = np.column_stack([rng.normal(size=(3000, 2)), rng.uniform(-0.5, 0.6, 3000)])
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    solids = *SCENES['urban'](0).solids, Cylinder(Kind.POLE, 0.5, 0.0, 2.0, 3.0, 2.0)
    fast = nearest_solid(solids, SENSOR_POSITION, direction)
    plain = nearest_solid(solids, np.tile(SENSOR_POSITION, (3000, 1)), direction)
    np.testing.assert_array_equal(fast[0], plain[0])
    np.testing.assert_array_equal(fast[1], plain[1])
    assert np.isfinite(fast[0]).sum() > 500


@pytest.mark.parametrize('name', DRIVES)
@pytest.mark.parametrize('seed', range(3))
def test_lane_of_the_drive_is_free(name, seed):
    """No solid is where a car 2 m wide and 2 m high drives along x."""
    scene = SCENES[name](seed)
    x, y, above = np.meshgrid(
        np.arange(-5.0, 90.0, 0.1), np.linspace(-1.0, 1.0, 9), np.linspace(0.1, 2.0, 5)
    )
    lane = np.stack([x, y, scene.terrain.height(x, y) + above], axis=-1).reshape(-1, 3)
    assert not any(inside(solid, lane).any() for solid in scene.solids)
